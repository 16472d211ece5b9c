//! The control stream: models, plans, engagements, stops.

use super::*;

fn plan() -> Plan<3> {
    let t: Vec<f64> = (0..60).map(|i| f64::from(i) / 30.0).collect();
    let x: Vec<_> = t
        .iter()
        .map(|t| hand() + Vector3::new((3.0 * t).sin() * 0.3, 0.1 * t, 0.0))
        .collect();
    select::bounded(&t, &x, 0.005).unwrap()
}

fn play(bench: &Bench, engagement: u32, plan: u32) -> Engage {
    Engage {
        drive: Drive::Play { plan },
        ..bench.mirror(engagement)
    }
}

#[test]
fn a_session_introduces_the_robot_and_takes_authority() {
    let bench = Bench::fresh(None);
    assert_eq!(bench.control, [RobotControl::Info(info())]);
    assert!(matches!(bench.orders[..], [Order::Operator(true)]));

    let skill = example(2, 24);
    let id = skill.id().0;
    let bench = Bench::fresh(Some(skill));
    let held = Info {
        model: Some(id),
        ..info()
    };
    assert_eq!(bench.control, [RobotControl::Info(held)]);
}

#[test]
fn an_engagement_is_acknowledged_once_when_the_servo_reports_it() {
    let mut bench = Bench::ready(None);
    let engage = bench.mirror(1);
    bench.engage(&engage);
    let [Order::Engage(engagement)] = &bench.orders[..] else {
        panic!("{:?}", bench.orders)
    };
    assert_eq!((engagement.number, engagement.lease_s), (1, 0.65));
    assert!((engagement.scale - 0.1).abs() < 1e-7);
    assert_eq!(bench.control, [], "nothing is promised before it is done");
    bench.forget();

    bench.pass(3);
    bench.reports(RobotState::Engaged);
    bench.reports(RobotState::Engaged);
    let mapping = report(RobotState::Engaged).mapping;
    let expected = [
        RobotControl::Engaged {
            engagement: 1,
            t_us: bench.stamp(0).0 / 1000,
            hand_m: mapping.hand_m.cast::<f32>().into(),
            tip_m: mapping.tip_m.cast::<f32>().into(),
        },
        RobotControl::State {
            state: RobotState::Engaged,
            cause: Cause::Requested,
        },
    ];
    assert_eq!(bench.control, expected);
}

#[test]
fn another_sessions_engagement_of_the_same_number_is_no_acknowledgement() {
    let mut bench = Bench::ready(None);
    let former = Report {
        engagement: 1,
        engaged_at: Mono(bench.now.0 - 5000 * MS),
        ..report(RobotState::Holding)
    };
    bench.report(&former);
    let engage = bench.mirror(1);
    bench.engage(&engage);
    bench.forget();
    bench.report(&former);
    assert_eq!(bench.control, []);
    bench.reports(RobotState::Engaged);
    assert!(matches!(
        bench.control[0],
        RobotControl::Engaged { engagement: 1, .. }
    ));
}

#[test]
fn an_engage_the_servo_declines_is_answered() {
    let mut bench = Bench::ready(None);
    let engage = bench.mirror(1);
    bench.engage(&engage);
    bench.forget();
    let declined = |at| Report {
        declined: (1, at),
        moving: true,
        ..report(RobotState::Ready)
    };
    bench.report(&declined(Mono(bench.now.0 - 5000 * MS)));
    assert_eq!(bench.control, [], "another session's");
    bench.report(&declined(bench.now));
    bench.report(&declined(bench.now));
    let reason = Refusal::Moving;
    assert_eq!(bench.control, [RobotControl::Refused { reason }]);
}

#[test]
fn the_arms_state_decides_whether_it_may_engage() {
    let mut bench = Bench::fresh(None);
    for _ in 0..4 {
        bench.exchange(0, 100);
    }
    let engage = bench.mirror(1);
    assert_eq!(
        bench.refusal(&engage),
        Some(Refusal::Moving),
        "no report yet"
    );
    for (state, expected) in [
        (RobotState::Stopped, Refusal::Stopped),
        (RobotState::Engaged, Refusal::AlreadyEngaged),
        (RobotState::Coasting, Refusal::AlreadyEngaged),
    ] {
        bench.reports(state);
        let engage = bench.mirror(1);
        assert_eq!(bench.refusal(&engage), Some(expected));
    }
    for state in [RobotState::Ready, RobotState::Holding] {
        bench.report(&Report {
            moving: true,
            ..report(state)
        });
        let engage = bench.mirror(1);
        assert_eq!(bench.refusal(&engage), Some(Refusal::Moving));
    }
    bench.reports(RobotState::Holding);
    let engage = bench.mirror(1);
    assert_eq!(bench.refusal(&engage), None);
}

#[test]
fn an_engagement_is_never_repeated() {
    let mut bench = Bench::ready(None);
    let engage = bench.mirror(3);
    assert_eq!(bench.refusal(&engage), None);
    for number in [3, 2, 0] {
        let engage = bench.mirror(number);
        assert_eq!(bench.refusal(&engage), Some(Refusal::OldEngagement));
    }
    let engage = bench.mirror(4);
    assert_eq!(bench.refusal(&engage), None);
}

#[test]
fn a_reference_needs_a_known_clock_and_a_recent_hand() {
    let mut bench = Bench::fresh(None);
    bench.reports(RobotState::Ready);
    for _ in 0..3 {
        bench.exchange(0, 100);
        let engage = bench.mirror(1);
        assert_eq!(bench.refusal(&engage), Some(Refusal::ClockUnknown));
    }
    bench.exchange(0, 100);
    for (ms_ago, expected) in [
        (510, Some(Refusal::StaleReference)),
        (-510, Some(Refusal::StaleReference)),
        (490, None),
    ] {
        let mut engage = bench.mirror(1);
        let state = HandState::first(bench.stamp(ms_ago), hand());
        if let Drive::Mirror { state: wire, .. } = &mut engage.drive {
            *wire = WireState::quantise(&state).unwrap();
        }
        assert_eq!(bench.refusal(&engage), expected, "{ms_ago} ms");
    }
}

#[test]
fn a_bound_without_a_grid_is_no_mapping() {
    let mut bench = Bench::ready(None);
    let engage = Engage {
        path_bound_um: 20_000_000,
        ..bench.mirror(1)
    };
    assert_eq!(bench.refusal(&engage), Some(Refusal::BadMapping));
}

#[test]
fn impossible_requests_end_the_session() {
    let mut bench = Bench::ready(None);
    let good = bench.mirror(1);
    for bad in [
        Engage {
            scale: f32::NAN,
            ..good.clone()
        },
        Engage {
            rotation: [1.0, 1.0, 0.0, 0.0],
            ..good.clone()
        },
        Engage {
            path_bound_um: 0,
            ..good
        },
    ] {
        let payload = OperatorControl::Engage(bad).encode();
        assert!(matches!(
            bench.frame(payload, false),
            Err(DecodeError::Invalid { .. })
        ));
    }
    assert!(bench.orders.is_empty());
}

#[test]
fn a_model_is_kept_if_its_hash_is_right() {
    let mut bench = Bench::ready(None);
    let skill = example(2, 24);
    let (id, bytes) = (skill.id().0, skill.to_bytes().to_vec());
    let mut other = id;
    other[0] ^= 1;
    bench.control(&OperatorControl::Model {
        id: other,
        bytes: bytes.clone(),
    });
    let mut damaged = bytes.clone();
    damaged.truncate(100);
    bench.control(&OperatorControl::Model { id, bytes: damaged });
    assert_eq!(bench.refusals(), [Refusal::BadModel; 2]);
    assert_eq!(bench.session.skill(), None);
    bench.forget();

    bench.control(&OperatorControl::Model { id, bytes });
    assert_eq!(bench.control, [RobotControl::ModelStored { id }]);
    assert_eq!(bench.session.skill().as_deref(), Some(&skill));
}

#[test]
fn a_plan_is_played_from_its_beginning() {
    let mut bench = Bench::ready(None);
    let request = play(&bench, 1, 7);
    assert_eq!(bench.refusal(&request), Some(Refusal::BadPlan), "unknown");
    bench.control(&OperatorControl::Plan {
        id: 7,
        bytes: vec![1, 2, 3],
    });
    assert_eq!(bench.refusals(), [Refusal::BadPlan; 2], "not a plan");
    bench.forget();

    let plan = plan();
    bench.control(&OperatorControl::Plan {
        id: 7,
        bytes: codec::encode(&plan),
    });
    assert_eq!(bench.control, [RobotControl::PlanStored { id: 7 }]);
    let request = play(&bench, 1, 6);
    assert_eq!(
        bench.refusal(&request),
        Some(Refusal::BadPlan),
        "another one"
    );
    let request = play(&bench, 1, 7);
    assert_eq!(bench.refusal(&request), None);
    let [
        Order::Engage(Engagement {
            source: Source::Play(trajectory),
            ..
        }),
    ] = &bench.orders[..]
    else {
        panic!("{:?}", bench.orders)
    };
    let expected = plan.spline().unwrap();
    assert_eq!(trajectory.duration_s, expected.span_s().1);
    for t_s in [0.0, 0.7, 1.9] {
        assert_eq!(
            trajectory.spline.eval(t_s).unwrap().x,
            expected.eval(t_s).unwrap().x
        );
    }
}

#[test]
fn a_stop_is_ordered_and_confirmed_even_on_top_of_a_stop() {
    let mut bench = Bench::mirroring(None);
    bench.control(&OperatorControl::EmergencyStop);
    assert!(matches!(
        bench.orders[..],
        [Order::Stop(Cause::OperatorStop)]
    ));
    assert_eq!(bench.control, [], "confirmed by the servo, not by us");
    let stopped = Report {
        cause: Cause::OperatorStop,
        ..report(RobotState::Stopped)
    };
    bench.report(&stopped);
    let confirmation = RobotControl::State {
        state: RobotState::Stopped,
        cause: Cause::OperatorStop,
    };
    assert_eq!(bench.control, std::slice::from_ref(&confirmation));
    bench.forget();

    bench.control(&OperatorControl::EmergencyStop);
    assert_eq!(bench.control, [confirmation]);
    bench.control(&OperatorControl::Reset);
    assert!(matches!(
        bench.orders[..],
        [
            Order::Stop(Cause::OperatorStop),
            Order::Reset { operator: true }
        ]
    ));
}

#[test]
fn only_the_present_engagement_is_released() {
    let mut bench = Bench::mirroring(None);
    bench.control(&OperatorControl::Release { engagement: 2 });
    bench.control(&OperatorControl::Release { engagement: 0 });
    assert!(bench.orders.is_empty());
    bench.control(&OperatorControl::Release { engagement: 1 });
    assert!(matches!(bench.orders[..], [Order::Release]));
}

#[test]
fn the_end_of_a_session_takes_authority_away() {
    let mut bench = Bench::mirroring(None);
    bench.control(&OperatorControl::Goodbye);
    assert_eq!(bench.goodbyes, 1);
    bench.session.handle_closed();
    bench.drain();
    assert!(matches!(bench.orders[..], [Order::Operator(false)]));
}

#[test]
fn an_unknown_message_ends_the_session_unless_it_may_be_ignored() {
    let mut bench = Bench::ready(None);
    for payload in [vec![], vec![250], vec![4, 0]] {
        assert_eq!(bench.frame(payload.clone(), true), Ok(()));
        assert!(bench.frame(payload, false).is_err());
    }
    assert!(bench.orders.is_empty() && bench.control.is_empty());
    assert_eq!(bench.frame(OperatorControl::Reset.encode(), true), Ok(()));
    assert_eq!(bench.orders.len(), 1, "ignorable does not mean ignored");
}
