//! Everything but mirror: the model, play, stops, and what the robot says.

use super::*;

/// What the robot counts its changes to.
const CHANGES: u32 = 5;

fn refused(reason: Refusal) -> RobotControl {
    RobotControl::Refused { reason }
}

pub(super) fn state(state: RobotState, cause: Cause) -> RobotControl {
    RobotControl::State {
        state,
        cause,
        changes: CHANGES,
    }
}

fn plan() -> PosePlan {
    let x = [home(), home() + Vector3::x(), home()];
    select::bounded(&[0.0, 1.0, 2.0], &x, 0.01).unwrap().into()
}

#[test]
fn the_model_is_sent_unless_the_robot_holds_it() {
    let skill = example(2, 24);
    let id = skill.id().0;
    for held in [None, Some([7; 16])] {
        let mut bench = Bench::fresh(SessionConfig::default(), Some(skill.clone()));
        bench.hears(&RobotControl::Info(info(held)));
        let bytes = skill.to_bytes().to_vec();
        assert_eq!(bench.control, [OperatorControl::Model { id, bytes }]);
        assert!(!bench.session.is_ready() && bench.events.is_empty());
        bench.hears(&RobotControl::ModelStored { id: [7; 16] });
        assert!(!bench.session.is_ready());
        bench.hears(&RobotControl::ModelStored { id });
        bench.hears(&RobotControl::ModelStored { id });
        assert!(bench.session.is_ready());
        assert_eq!(bench.events, [Event::Ready]);
    }
    let mut bench = Bench::fresh(SessionConfig::default(), Some(skill));
    bench.hears(&RobotControl::Info(info(Some(id))));
    assert!(bench.session.is_ready());
    assert_eq!((bench.control, bench.events), (vec![], vec![Event::Ready]));
}

#[test]
fn without_a_hand_there_is_nothing_to_engage() {
    let mut bench = Bench::ready(SessionConfig::default(), None);
    bench.session.engage(bench.now);
    bench.drain();
    assert_eq!(bench.events, [Event::Refused(Refusal::StaleReference)]);
    assert!(bench.control.is_empty());
}

#[test]
fn every_refusal_but_a_divergence_ends_the_attempt() {
    for reason in [
        Refusal::Stopped,
        Refusal::AlreadyEngaged,
        Refusal::OldEngagement,
        Refusal::StaleReference,
        Refusal::ClockUnknown,
        Refusal::BadModel,
        Refusal::BadPlan,
        Refusal::BadMapping,
        Refusal::Moving,
    ] {
        let mut bench = Bench::engaged(SessionConfig::default(), None);
        bench.hears(&refused(reason));
        assert_eq!(bench.events, [Event::Refused(reason)]);
        bench.sample(home() + Vector3::x());
        assert!(bench.datagrams.is_empty(), "{reason:?}");
        assert_eq!(bench.session.poll_timeout(), None, "{reason:?}");
        bench.session.engage(bench.now);
        bench.drain();
        assert!(
            matches!(&bench.control[..], [.., OperatorControl::Engage(e)] if e.engagement == 2),
            "and the next has a number of its own"
        );
    }
}

/// A trigger that bounces: the second request is declined while the third is under way, which is then granted.
#[test]
fn what_is_granted_after_it_was_given_up_is_let_go() {
    let release = |engagement| OperatorControl::Release { engagement };
    let mut bench = Bench::ready(SessionConfig::default(), None);
    bench.sample(home());
    bench.session.engage(bench.now);
    bench.session.release();
    bench.session.engage(bench.now);
    bench.drain();
    bench.forget();
    bench.hears(&refused(Refusal::Moving));
    assert_eq!(bench.control, [release(2)], "it may yet be granted");
    assert_eq!(bench.events, [Event::Refused(Refusal::Moving)]);
    bench.hears(&granted(2));
    assert_eq!(bench.control, [release(2), release(2)]);
    assert_eq!(bench.events.len(), 1, "nobody is told that it follows");

    // Asked again before the grant comes: what is granted is not what is asked for.
    bench.session.engage(bench.now);
    bench.drain();
    bench.forget();
    bench.hears(&granted(2));
    assert_eq!(bench.control, [release(2)]);
    assert!(
        bench
            .events
            .iter()
            .all(|e| !matches!(e, Event::Engaged { .. }))
    );
    bench.hears(&granted(3));
    assert!(matches!(
        bench.events.last(),
        Some(Event::Engaged { engagement: 3, .. })
    ));
    bench.session.release();
    bench.drain();
    assert_eq!(bench.control.last(), Some(&release(3)));
}

#[test]
fn a_stop_is_said_before_a_model_that_has_waited() {
    let mut bench = Bench::engaged(SessionConfig::default(), Some(example(2, 24)));
    bench
        .session
        .replace_skill(std::sync::Arc::new(example(3, 24)));
    bench.session.stop(bench.now);
    bench.drain();
    assert!(
        matches!(
            bench.control[..],
            [
                OperatorControl::EmergencyStop,
                OperatorControl::Model { .. }
            ]
        ),
        "{:?}",
        bench.control
    );
}

#[test]
fn what_a_declined_request_took_is_not_counted() {
    let mut bench = Bench::ready(SessionConfig::default(), None);
    bench.sample(home());
    for reason in [Refusal::ClockUnknown, Refusal::Moving] {
        bench.session.engage(bench.now);
        (0..30).for_each(|i| bench.sample(home() * f64::from(1 + i % 2)));
        let counters = bench.session.counters();
        assert!(counters.samples == 30 && counters.messages > 5 && counters.knots > 5);
        bench.hears(&refused(reason));
        assert_eq!(bench.session.counters(), Counters::default());
    }
    bench.session.engage(bench.now);
    for i in 0..10 {
        bench.now.0 += 33 * MS;
        let x = home() + Vector3::x() * 0.1 * f64::from((i - 6).max(0));
        let sample = HandSample {
            resting: i < 7,
            ..HandSample::at(bench.now, x)
        };
        bench.session.handle_sample(bench.now, sample);
    }
    let counters = bench.session.counters();
    assert_eq!((counters.rest_samples, counters.samples), (7, 3));
    assert!(0 < counters.rest_messages && counters.rest_messages < counters.messages);
    assert!(0 < counters.rest_knots && counters.rest_knots <= counters.knots);
    bench.hears(&granted(3));
    bench.hears(&refused(Refusal::NotYours));
    // What was driven is let go, and its path told to the end; nothing of it is taken back.
    let knots = bench.session.counters().knots;
    let kept = Counters { knots, ..counters };
    assert_eq!(bench.session.counters(), kept, "that was no request");
    assert!(knots >= counters.knots);
}

#[test]
fn after_a_divergence_the_model_is_named_no_more() {
    let mut bench = Bench::engaged(SessionConfig::default(), Some(example(2, 24)));
    bench.sample(home() + Vector3::x() * 0.3);
    let before = bench.motions();
    assert!(
        before
            .first()
            .is_some_and(|m| m.model != 0 && m.checksum.is_some())
    );
    bench.hears(&refused(Refusal::Diverged));
    bench.forget();
    bench.idle(450);
    let after = bench.motions();
    assert_eq!(after.len(), 2, "the engagement goes on");
    assert!(after.iter().all(|m| m.model == 0));
}

#[test]
fn an_arm_that_holds_is_never_engaged_again_by_itself() {
    for (now, cause) in [
        (RobotState::Holding, Cause::LeaseExpired),
        (RobotState::Stopped, Cause::LocalStop),
    ] {
        let mut bench = Bench::engaged(SessionConfig::default(), None);
        bench.hears(&state(RobotState::Coasting, Cause::NewsLate));
        bench.idle(200);
        assert_eq!(bench.datagrams.len(), 1, "coasting is not the end");
        bench.hears(&state(now, cause));
        bench.forget();
        for i in 0..100 {
            bench.sample(home() + Vector3::x() * (0.01 * f64::from(i)));
        }
        bench.hears(&state(RobotState::Ready, Cause::Requested));
        bench.idle(1000);
        assert!(bench.control.is_empty() && bench.datagrams.is_empty());
        assert_eq!(bench.session.state(), RobotState::Ready);
    }
}

#[test]
fn a_stop_is_repeated_until_the_robot_has_stopped() {
    let mut bench = Bench::engaged(SessionConfig::default(), None);
    bench.session.stop(bench.now);
    bench.idle(100);
    assert_eq!(bench.control, [OperatorControl::EmergencyStop]);
    assert_eq!(
        bench.datagrams,
        vec![OperatorDatagram::Stop { epoch: EPOCH }; 11],
        "at once and every 10 ms, and no motion"
    );
    bench.hears(&state(RobotState::Coasting, Cause::NewsLate));
    bench.forget();
    bench.idle(20);
    assert_eq!(bench.datagrams.len(), 2, "no other state ends it");
    assert!(!bench.session.reset(), "there is nothing to leave yet");
    bench.session.engage(bench.now);
    bench.session.play(&plan(), None);
    bench.drain();
    assert!(bench.control.is_empty());
    assert_eq!(bench.events, vec![Event::Refused(Refusal::Stopped); 2]);
    assert!(bench.session.stop_is_unconfirmed());
    bench.hears(&state(RobotState::Stopped, Cause::OperatorStop));
    bench.forget();
    bench.idle(1000);
    bench.sample(home());
    assert!(bench.datagrams.is_empty());
    assert_eq!(bench.session.poll_timeout(), None);
    assert!(bench.session.reset());
    bench.drain();
    assert_eq!(
        bench.control,
        [OperatorControl::Reset { changes: CHANGES }],
        "the stop it was told of"
    );
}

#[test]
fn a_plan_is_engaged_once_stored_and_kept_going() {
    let mut bench = Bench::ready(SessionConfig::default(), None);
    let plan = plan();
    bench.session.play(&plan, None);
    bench.idle(1000);
    let bytes = codec::encode(&plan);
    assert_eq!(bench.control, [OperatorControl::Plan { id: 1, bytes }]);
    assert!(bench.datagrams.is_empty(), "nothing goes on yet");
    bench.forget();

    bench.hears(&RobotControl::PlanStored { id: 9 });
    assert!(bench.control.is_empty(), "another one");
    bench.hears(&RobotControl::PlanStored { id: 1 });
    bench.hears(&RobotControl::PlanStored { id: 1 });
    let [OperatorControl::Engage(engage)] = &bench.control[..] else {
        panic!("{:?}", bench.control)
    };
    assert_eq!(
        (engage.engagement, &engage.drive, engage.lease_ms),
        (1, &Drive::Play { plan: 1 }, 650)
    );
    let begun = bench.now;
    bench.idle(1000);
    let expected: Vec<_> = (1..=10)
        .map(|i| OperatorDatagram::Go {
            epoch: EPOCH,
            engagement: 1,
            seq: i,
            t_us: begun.0 / 1000 + 100_000 * i64::from(i),
            lease_ms: 650,
            bend: None,
        })
        .collect();
    assert_eq!(bench.datagrams, expected);
    bench.hears(&granted(1));
    bench.hears(&state(RobotState::Ready, Cause::PlanFinished));
    bench.forget();
    bench.idle(1000);
    assert!(bench.datagrams.is_empty());
}

#[test]
fn release_and_goodbye_name_the_engagement_once() {
    let farewell = [
        OperatorControl::Release { engagement: 1 },
        OperatorControl::Goodbye,
    ];
    let mut bench = Bench::engaged(SessionConfig::default(), None);
    bench.session.release();
    bench.session.release();
    bench.session.goodbye();
    bench.sample(home() + Vector3::x());
    assert_eq!(bench.control, farewell);
    assert!(bench.datagrams.is_empty());

    let mut bench = Bench::engaged(SessionConfig::default(), None);
    bench.session.goodbye();
    bench.drain();
    assert_eq!(bench.control, farewell);
}

#[test]
fn pings_are_answered_and_foreign_datagrams_counted() {
    let mut bench = Bench::ready(SessionConfig::default(), None);
    bench.receives(&RobotDatagram::Ping {
        epoch: EPOCH,
        t1_us: -5,
    });
    let t_us = bench.now.0 / 1000;
    let pong = OperatorDatagram::Pong {
        epoch: EPOCH,
        t1_us: -5,
        t2_us: t_us,
        t3_us: t_us,
    };
    assert_eq!(bench.datagrams, [pong]);
    bench.forget();
    bench.receives(&RobotDatagram::Ping {
        epoch: EPOCH + 1,
        t1_us: 0,
    });
    bench.receives(&RobotDatagram::Telemetry(Telemetry {
        epoch: EPOCH - 1,
        ..telemetry(1, 0)
    }));
    let mut long = RobotDatagram::Telemetry(telemetry(1, 0)).encode();
    long.push(0);
    for bytes in [&[][..], &[0xff; 64], &long] {
        bench.session.handle_datagram(bench.now, bytes);
    }
    bench.drain();
    assert_eq!(bench.session.counters().dropped, 5);
    assert!(bench.datagrams.is_empty() && bench.events.is_empty());
}

#[test]
fn an_unknown_message_ends_the_session_unless_it_may_be_ignored() {
    let mut bench = Bench::ready(SessionConfig::default(), None);
    for payload in [vec![], vec![200], vec![5, 0]] {
        assert_eq!(bench.frame(payload.clone(), true), Ok(()));
        assert!(bench.frame(payload, false).is_err());
    }
    assert!(bench.events.is_empty());
    let known = state(RobotState::Holding, Cause::LeaseExpired);
    assert_eq!(bench.frame(known.encode(), true), Ok(()));
    assert_eq!(bench.session.state(), RobotState::Holding);
}

#[test]
fn the_scale_keeps_the_motion_within_the_arm() {
    let stats = *example(1, 1).stats();
    let info = info(None);
    let scale = default_scale(&stats, &info);
    let acceleration = 0.8 * 13.0 / stats.acceleration95_m_s2;
    assert!(
        (scale - acceleration).abs() < 1e-6,
        "the tightest limit: {scale}"
    );
    let slow = Stats {
        speed95_m_s: 0.01,
        acceleration95_m_s2: 0.01,
        reach_m: 0.01,
        ..stats
    };
    assert_eq!(default_scale(&slow, &info), 1.0, "never magnified");
    let config = SessionConfig {
        scale: Some(0.25),
        ..SessionConfig::default()
    };
    assert_eq!(Bench::ready(config, None).session.scale(), Some(0.25));
    assert_eq!(Bench::fresh(config, None).session.scale(), None);
}
