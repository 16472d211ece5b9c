//! Who may speak to the robot, and what it makes of nonsense.

use quinn::{Connection, ConnectionError, Endpoint, VarInt};
use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use telemime::ground::{Pair, run_virtual};
use telemime_endpoint::Identity;
use telemime_endpoint::control::Control;
use telemime_operator::daemon::DaemonError;
use telemime_operator::task::Outcome;
use telemime_protocol::wire::hello::{Answer, Hello, RejectCode};
use telemime_protocol::wire::v1::{
    Info, Message, OperatorControl, OperatorDatagram, RobotControl, RobotState, VERSION,
};
use telemime_robot::daemon::Notice as RobotNotice;
use telemime_robot::refused::{Reason, Refused};
use telemime_robot::servo::Report;

use crate::scene::{delayed, finish, mirroring, replay, rig, shaped, skill, unseen};

/// Connects, greets, and returns what the robot answers.
async fn greet(endpoint: &Endpoint, pair: &Pair, greeting: &[u8]) -> (Connection, Control, Answer) {
    let connecting = endpoint.connect(pair.robot_addr(), "telemime").unwrap();
    let connection = connecting.await.unwrap();
    let mut control = Control::open(&connection).await.unwrap();
    control.write(greeting).await.unwrap();
    let answer = control.answer().await.unwrap();
    (connection, control, answer)
}

fn hello(min: u16, max: u16) -> Vec<u8> {
    let features = 0;
    Hello { min, max, features }.encode()
}

fn refusals(pair: &Pair) -> Vec<Refused> {
    let refused = |n: &RobotNotice| match n {
        RobotNotice::Refused(refused) => Some(refused.clone()),
        _ => None,
    };
    pair.robot.notices().iter().filter_map(refused).collect()
}

#[test]
fn a_second_operator_is_refused_and_the_first_goes_on() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let first = mirroring(&mut pair, &shaped(), 31);
        pair.run_for(3.0).await;
        let second = mirroring(&mut pair, &delayed(0.01), 32);
        let (refused, _, _) = finish(second).await;
        let Err(DaemonError::Rejected { code, text, .. }) = refused else {
            panic!("{refused:?}")
        };
        assert_eq!(code, RejectCode::Busy);
        assert!(text.contains("another operator"), "{text}");
        let (summary, _, _) = finish(first).await;
        let summary = summary.unwrap();
        assert_eq!((summary.outcome, summary.sessions), (Outcome::Completed, 1));
        // It asked again while it had patience; that is told once and then counted.
        let refusals = refusals(&pair);
        let told: Vec<_> = refusals.iter().map(|r| (r.reason, r.times)).collect();
        assert_eq!(told, [(Reason::Busy, 1), (Reason::Busy, 10)]);
    })
    .unwrap();
}

#[test]
fn an_operator_waits_for_its_place_while_it_has_patience() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let first = mirroring(&mut pair, &shaped(), 35);
        pair.run_for(3.0).await;
        let second = mirroring(&mut pair, &delayed(0.01), 36);
        pair.run_for(1.0).await;
        first.quit();
        finish(first).await.0.unwrap();
        let summary = finish(second).await.0.unwrap();
        assert_eq!((summary.outcome, summary.sessions), (Outcome::Completed, 1));
    })
    .unwrap();
}

#[test]
fn a_foreign_key_is_no_operator() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let foreign = Identity::ephemeral().unwrap();
        let operator = pair
            .operator_as(
                &foreign,
                replay(unseen()),
                Some(skill()),
                Default::default(),
                &delayed(0.05),
                33,
            )
            .unwrap();
        let (refused, _, _) = finish(operator).await;
        let Err(DaemonError::Unreachable { why, .. }) = refused else {
            panic!("{refused:?}")
        };
        assert!(why.contains("does not accept our key"), "{why}");
        let told: Vec<_> = refusals(&pair)
            .iter()
            .map(|r| (r.reason, r.times))
            .collect();
        assert_eq!(told, [(Reason::UnknownKey, 1), (Reason::UnknownKey, 10)]);
        let idle = pair
            .robot
            .reports()
            .iter()
            .all(|r| r.state == RobotState::Idle);
        assert!(idle, "it never had authority");
        let connected = |n: &&RobotNotice| matches!(n, RobotNotice::Connected { .. });
        assert_eq!(pair.robot.notices().iter().filter(connected).count(), 0);
    })
    .unwrap();
}

#[test]
fn another_version_and_no_greeting_are_told_why() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let link = delayed(0.02);
        let later = hello(VERSION + 1, VERSION + 8);
        let not_ours = b"GET / HTTP/1.1\r\n\r\n".to_vec();
        for (greeting, expected, close, word) in [
            (later, RejectCode::Version, 2, "version"),
            (not_ours, RejectCode::Malformed, 3, "Telemime"),
        ] {
            let endpoint = pair.stranger(&link, 34).unwrap();
            let (connection, control, answer) = greet(&endpoint, &pair, &greeting).await;
            let Answer::Reject { code, text } = answer else {
                panic!("{answer:?}")
            };
            assert_eq!(code, expected);
            assert!(text.contains(word), "{text}");
            // Having read the answer, the stream is done with.
            drop(control);
            let ConnectionError::ApplicationClosed(closed) = connection.closed().await else {
                panic!("not closed by the robot")
            };
            assert_eq!(closed.error_code, VarInt::from_u32(close));
        }
        let endpoint = pair.stranger(&link, 35).unwrap();
        let (_connection, _control, answer) = greet(&endpoint, &pair, &hello(0, 90)).await;
        assert!(
            matches!(
                answer,
                Answer::Ack {
                    version: VERSION,
                    ..
                }
            ),
            "a range that holds ours: {answer:?}"
        );
    })
    .unwrap();
}

#[test]
fn garbage_from_a_paired_peer_is_counted_and_does_no_harm() {
    const DATAGRAMS: usize = 500;
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let endpoint = pair.stranger(&delayed(0.02), 36).unwrap();
        let (connection, control, answer) = greet(&endpoint, &pair, &hello(VERSION, VERSION)).await;
        let Answer::Ack { epoch, .. } = answer else {
            panic!("{answer:?}")
        };
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(36);
        for i in 0..DATAGRAMS {
            let len = rng.random_range(0..200);
            let mut bytes: Vec<u8> = (0..len).map(|_| rng.random()).collect();
            // Some are nearly right: the kind and the epoch.
            if i % 2 == 0 && bytes.len() > 2 {
                bytes[..2].copy_from_slice(&[rng.random_range(0..2), epoch as u8]);
            }
            let stop = OperatorDatagram::decode(&bytes);
            assert!(!matches!(stop, Ok(OperatorDatagram::Stop { .. })));
            connection.send_datagram(bytes.into()).unwrap();
            pair.run_for(2e-3).await;
        }
        // The session is as good as before: it stores a model.
        let (writer, mut frames) = control.into_frames();
        let (id, bytes) = (skill().id().0, skill().to_bytes().to_vec());
        let model = OperatorControl::Model { id, bytes }.encode();
        writer.message(&model).unwrap();
        loop {
            let frame = frames.recv().await.unwrap().unwrap();
            match RobotControl::decode(&frame.payload).unwrap() {
                RobotControl::ModelStored { id: stored } => break assert_eq!(stored, id),
                RobotControl::Info(_) | RobotControl::Arm(_) | RobotControl::State { .. } => {}
                other => panic!("{other:?}"),
            }
        }
        writer.message(&OperatorControl::Goodbye.encode()).unwrap();
        pair.run_for(0.1).await;
        let dropped = pair.robot.notices().iter().find_map(|n| match n {
            RobotNotice::Disconnected { counters, .. } => Some(counters.dropped),
            _ => None,
        });
        assert_eq!(dropped, Some(DATAGRAMS as u32));
        let reports = pair.robot.reports();
        let still = |r: &&Report| (r.tip_m - reports[0].tip_m).norm() < 1e-4 && !r.moving;
        assert_eq!(reports.iter().filter(still).count(), reports.len());
    })
    .unwrap();
}

#[test]
fn a_malformed_control_message_ends_the_session_and_only_that() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let endpoint = pair.stranger(&delayed(0.02), 37).unwrap();
        let (connection, control, _) = greet(&endpoint, &pair, &hello(VERSION, VERSION)).await;
        let (writer, _frames) = control.into_frames();
        writer.message(&[200, 1, 2]).unwrap();
        let closed = connection.closed().await.to_string();
        assert!(closed.contains("control message"), "{closed}");

        let operator = mirroring(&mut pair, &delayed(0.02), 38);
        let (summary, _, _) = finish(operator).await;
        assert_eq!(summary.unwrap().outcome, Outcome::Completed);
    })
    .unwrap();
}

#[test]
fn a_new_session_is_told_at_once_that_the_arm_holds() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let operator = mirroring(&mut pair, &delayed(0.05), 39);
        pair.run_for(3.0).await;
        operator.done.abort();
        pair.run_for(2.5).await;
        let endpoint = pair.stranger(&delayed(0.02), 40).unwrap();
        let (_connection, control, _) = greet(&endpoint, &pair, &hello(VERSION, VERSION)).await;
        let (_writer, mut frames) = control.into_frames();
        let first = frames.recv().await.unwrap().unwrap();
        let first = RobotControl::decode(&first.payload).unwrap();
        let RobotControl::Info(Info { state, model, .. }) = first else {
            panic!("{first:?}")
        };
        assert_eq!(state, RobotState::Holding);
        assert_eq!(model, Some(skill().id().0), "and which model it holds");
    })
    .unwrap();
}

#[test]
fn what_somebody_on_the_way_replays_moves_nothing() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        pair.network.record();
        let operator = mirroring(&mut pair, &delayed(0.05), 41);
        assert!(
            pair.wait_for(10.0, |r| r.state == RobotState::Engaged)
                .await
        );
        pair.run_for(1.0).await;
        // All of a living session, its handshake and its motions: QUIC takes no packet twice.
        assert!(pair.network.replay() > 50);
        pair.network.record();
        let (summary, _, _) = finish(operator).await;
        let summary = summary.unwrap();
        assert_eq!((summary.outcome, summary.sessions), (Outcome::Completed, 1));
        let dropped = pair.robot.notices().iter().find_map(|n| match n {
            RobotNotice::Disconnected { counters, .. } => Some(counters.dropped),
            _ => None,
        });
        assert_eq!(dropped, Some(0), "the session has seen none of it");

        // All of a session that is over, to a robot at rest that serves another one.
        let endpoint = pair.stranger(&delayed(0.02), 42).unwrap();
        let (_connection, _control, _) = greet(&endpoint, &pair, &hello(VERSION, VERSION)).await;
        pair.run_for(1.0).await;
        let since = pair.now();
        assert!(pair.network.replay() > 50);
        pair.run_for(3.0).await;
        let reports = pair.robot.reports();
        let after = reports.iter().filter(|r| r.at >= since);
        let still = |r: &Report| r.state == RobotState::Ready && !r.moving;
        assert!(after.clone().count() > 2000 && after.clone().all(still));
    })
    .unwrap();
}
