//! The control stream: models, plans, engagements, stops.

use super::*;

fn plan() -> PosePlan {
    let t: Vec<f64> = (0..60).map(|i| f64::from(i) / 30.0).collect();
    let x: Vec<_> = t
        .iter()
        .map(|t| hand() + Vector3::new((3.0 * t).sin() * 0.3, 0.1 * t, 0.0))
        .collect();
    select::bounded(&t, &x, 0.005).unwrap().into()
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
    let lease_s = engagement.lease.until.secs_since(engagement.lease.from);
    assert_eq!((engagement.ticket, lease_s), (bench.session.ticket(), 0.65));
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
            hand_q: None,
            tip_q: WireRotation::default(),
        },
        RobotControl::State {
            state: RobotState::Engaged,
            cause: Cause::Requested,
            changes: RobotState::Engaged as u32,
        },
    ];
    assert_eq!(bench.control, expected);
}

#[test]
fn another_sessions_engagement_of_the_same_number_is_no_acknowledgement() {
    let mut bench = Bench::ready(None);
    let former = Report {
        engagement: Ticket {
            epoch: EPOCH - 1,
            number: 1,
        },
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
    let declined = |epoch| Report {
        declined: Ticket { epoch, number: 1 },
        moving: true,
        ..report(RobotState::Ready)
    };
    bench.report(&declined(EPOCH - 1));
    assert_eq!(bench.control, [], "another session's");
    bench.report(&declined(EPOCH));
    bench.report(&declined(EPOCH));
    let reason = Refusal::Moving;
    assert_eq!(bench.control, [RobotControl::Refused { reason }]);
}

#[test]
fn a_request_whose_lease_is_over_when_it_arrives_came_too_late() {
    for (lease_ms, refused) in [(250, Some(Refusal::StaleReference)), (350, None)] {
        let mut bench = Bench::ready(None);
        let engage = Engage {
            lease_ms,
            ..bench.mirror(1)
        };
        bench.pass(300);
        assert_eq!(bench.refusal(&engage), refused, "{lease_ms} ms");
    }
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
    bench.reports(RobotState::Engaged);
    bench.reports(RobotState::Ready);
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
            ..good.clone()
        },
        Engage {
            path_turn_bound_urad: 3_141_593,
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
fn a_model_that_comes_while_the_arm_follows_is_used_from_the_next_engage_on() {
    let (old, new) = (example(2, 24), example(3, 24));
    let mut bench = Bench::mirroring(Some(old.clone()));
    let (id, bytes) = (new.id().0, new.to_bytes().to_vec());
    bench.control(&OperatorControl::Model { id, bytes });
    assert_eq!(bench.control, [RobotControl::ModelStored { id }]);
    assert_eq!(
        bench.session.skill().as_deref(),
        Some(&new),
        "the next session begins with it"
    );
    let predicts = |session: &Session, skill: &Skill| {
        let state = HandState::first(Stamp::ZERO, Vector3::new(0.1, 0.2, 2.5));
        let tag = telemime_protocol::wire::v1::model_tag(&skill.id().0);
        session.forecast(&state, tag, &STEADY) == skill.predictor().forecast(&state, &STEADY)
    };
    assert!(predicts(&bench.session, &old) && !predicts(&bench.session, &new));
    bench.control(&OperatorControl::Release { engagement: 1 });
    bench.reports(RobotState::Ready);
    let engage = bench.mirror(2);
    bench.engage(&engage);
    assert!(predicts(&bench.session, &new) && !predicts(&bench.session, &old));
    // At rest there is nothing to wait for.
    bench.control(&OperatorControl::Release { engagement: 2 });
    bench.reports(RobotState::Ready);
    let (id, bytes) = (old.id().0, old.to_bytes().to_vec());
    bench.control(&OperatorControl::Model { id, bytes });
    assert!(predicts(&bench.session, &old) && !predicts(&bench.session, &new));
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
    let expected = plan.curve().unwrap();
    assert_eq!(trajectory.duration_s, expected.end_s());
    for t_s in [0.0, 0.7, 1.9] {
        assert_eq!(trajectory.curve.position_at(t_s), expected.position_at(t_s));
    }
}

#[test]
fn a_stop_is_ordered_and_confirmed_even_on_top_of_a_stop() {
    let mut bench = Bench::mirroring(None);
    bench.control(&OperatorControl::EmergencyStop);
    assert_eq!(bench.brakes, [Cause::OperatorStop]);
    assert_eq!(bench.control, [], "confirmed by the servo, not by us");
    let stopped = Report {
        cause: Cause::OperatorStop,
        transitions: 9,
        ..report(RobotState::Stopped)
    };
    bench.report(&stopped);
    let confirmation = RobotControl::State {
        state: RobotState::Stopped,
        cause: Cause::OperatorStop,
        changes: 9,
    };
    assert_eq!(bench.control, std::slice::from_ref(&confirmation));
    bench.forget();

    bench.control(&OperatorControl::EmergencyStop);
    assert_eq!(bench.control, [confirmation]);
}

#[test]
fn a_reset_leaves_the_stop_it_means_and_never_a_local_one() {
    let mut bench = Bench::ready(None);
    bench.control(&OperatorControl::Reset { changes: 9 });
    assert!(
        bench.orders.is_empty() && bench.control.is_empty(),
        "nothing is stopped"
    );
    for (cause, changes, granted) in [
        (Cause::OperatorStop, 8, false),
        (Cause::LocalStop, 9, false),
        (Cause::OperatorStop, 9, true),
    ] {
        bench.report(&Report {
            cause,
            transitions: 9,
            ..report(RobotState::Stopped)
        });
        bench.forget();
        bench.control(&OperatorControl::Reset { changes });
        let ordered = matches!(
            bench.orders[..],
            [Order::Reset {
                operator: true,
                stop: Some(9)
            }]
        );
        let refused = bench.refusals() == [Refusal::NotYours];
        assert_eq!(
            (ordered, refused),
            (granted, !granted),
            "{cause:?} {changes}"
        );
    }
}

#[test]
fn an_old_request_is_not_meant_any_more() {
    let mut bench = Bench::ready(None);
    let engage = bench.mirror(1);
    let old = Engage {
        t_us: bench.stamp(501).0 / 1000,
        ..engage.clone()
    };
    assert_eq!(bench.refusal(&old), Some(Refusal::StaleReference));
    let late = Engage {
        t_us: bench.stamp(300).0 / 1000,
        ..engage
    };
    assert_eq!(bench.refusal(&late), None);
    let [Order::Engage(engagement)] = &bench.orders[..] else {
        panic!("{:?}", bench.orders)
    };
    let lease_s = engagement.lease.until.secs_since(bench.now);
    assert!(
        (lease_s - 0.35).abs() < 1e-3,
        "the lease counts from the request: {lease_s}"
    );
}

#[test]
fn a_request_that_finds_no_place_before_the_servo_is_refused_and_the_next_is_granted() {
    let mut bench = Bench::ready(None);
    let (first, second) = (bench.mirror(1), bench.mirror(2));
    bench.engage(&first);
    let lost = bench.orders.pop().unwrap();
    bench.session.handle_lost(&lost);
    bench.drain();
    assert_eq!(bench.refusals(), [Refusal::Moving]);
    // The servo knows nothing of it.
    bench.report(&report(RobotState::Ready));
    assert_eq!(bench.refusal(&second), None);
    // What is lost of an engagement that is under way refuses nothing.
    bench.reports(RobotState::Engaged);
    let motion = Motion {
        engagement: 2,
        ..bench.motion(1, 20)
    };
    bench.forget();
    bench.send(&motion);
    let lost = bench.orders.pop().unwrap();
    bench.session.handle_lost(&lost);
    bench.drain();
    assert_eq!(bench.refusals(), []);
}

#[test]
fn a_servo_that_was_not_told_of_its_operator_is_told_again() {
    let mut bench = Bench::fresh(None);
    bench.session.handle_lost(&Order::Operator(true));
    bench.forget();
    for told in [1, 0] {
        bench.orders.clear();
        bench.report(&report(RobotState::Idle));
        let present = |order: &&Order| matches!(order, Order::Operator(true));
        assert_eq!(bench.orders.iter().filter(present).count(), told);
    }
}

#[test]
fn one_request_at_a_time() {
    let mut bench = Bench::ready(None);
    let (first, second) = (bench.mirror(1), bench.mirror(2));
    assert_eq!(bench.refusal(&first), None);
    assert_eq!(bench.refusal(&second), Some(Refusal::AlreadyEngaged));
}

#[test]
fn only_the_present_engagement_is_released() {
    let mut bench = Bench::mirroring(None);
    bench.control(&OperatorControl::Release { engagement: 2 });
    bench.control(&OperatorControl::Release { engagement: 0 });
    assert!(bench.orders.is_empty());
    bench.control(&OperatorControl::Release { engagement: 1 });
    assert!(matches!(bench.orders[..], [Order::Release(_)]));
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
    for payload in [vec![], vec![250], vec![5, 0]] {
        assert_eq!(bench.frame(payload.clone(), true), Ok(()));
        assert!(bench.frame(payload, false).is_err());
    }
    assert!(bench.orders.is_empty() && bench.control.is_empty());
    assert_eq!(bench.frame(OperatorControl::Goodbye.encode(), true), Ok(()));
    assert_eq!(bench.goodbyes, 1, "ignorable does not mean ignored");
}
