//! Too much of everything: handshakes, garbage, streams, frames, and a peer that never reads. The arm and whoever drives it
//! must not notice. What it costs a robot's process in memory and late ticks is asserted by `tests/interop/flood.py`.

use std::net::SocketAddr;
use std::time::Duration;

use quinn::udp::Transmit;
use quinn::{AsyncUdpSocket, Connection, Endpoint};
use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use telemime::ground::{Pair, run_virtual};
use telemime_endpoint::control::Control;
use telemime_operator::daemon::Summary;
use telemime_operator::task::Outcome;
use telemime_protocol::wire::frame::{self, MAX_FRAME_LEN};
use telemime_protocol::wire::hello::{Answer, Hello};
use telemime_protocol::wire::v1::{Message, OperatorControl, RobotState, VERSION};
use telemime_robot::daemon::Notice as RobotNotice;
use telemime_robot::door;
use telemime_sim::link::{LinkConfig, Loss};
use tokio::time::timeout;

use crate::scene::{delayed, finish, mirroring, rig, shaped};

/// Dials again and again, for ever.
fn dials(endpoint: Endpoint, robot: SocketAddr) {
    tokio::task::spawn_local(async move {
        let mut again = tokio::time::interval(Duration::from_millis(5));
        loop {
            if let Ok(connecting) = endpoint.connect(robot, "telemime") {
                let _ = connecting.await;
            }
            again.tick().await;
        }
    });
}

/// `count` strangers with the right key that never hear an answer, so that each handshake begins and none ends.
fn deaf_strangers(pair: &mut Pair, count: u8) {
    for n in 0..count {
        let endpoint = pair.stranger(&delayed(0.02), u64::from(n)).unwrap();
        let own = endpoint.local_addr().unwrap();
        let silence = LinkConfig {
            loss: Loss::random(1.0),
            ..LinkConfig::default()
        };
        pair.network.link(pair.robot_addr(), own, silence, 0);
        dials(endpoint, pair.robot_addr());
    }
}

fn completed(summary: &Summary) {
    assert_eq!(
        (summary.outcome.clone(), summary.sessions),
        (Outcome::Completed, 1)
    );
}

/// Greets as the paired operator would.
async fn greeted(pair: &mut Pair, seed: u64) -> (Endpoint, Connection, Control) {
    let endpoint = pair.stranger(&delayed(0.02), seed).unwrap();
    let connecting = endpoint.connect(pair.robot_addr(), "telemime").unwrap();
    let connection = connecting.await.unwrap();
    let mut control = Control::open(&connection).await.unwrap();
    let hello = Hello {
        min: VERSION,
        max: VERSION,
        features: 0,
    };
    control.write(&hello.encode()).await.unwrap();
    let answer = control.answer().await.unwrap();
    assert!(matches!(answer, Answer::Ack { .. }), "{answer:?}");
    (endpoint, connection, control)
}

#[test]
fn handshakes_that_never_end_keep_no_operator_out() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        deaf_strangers(&mut pair, 5 * door::PLACES as u8);
        pair.run_for(1.0).await;
        let operator = mirroring(&mut pair, &delayed(0.05), 61);
        let (summary, _, _) = finish(operator).await;
        completed(&summary.unwrap());
    })
    .unwrap();
}

/// Random bytes from an address of their own, some of them nearly a first packet of QUIC version 1.
async fn garbage(pair: &Pair, count: usize) {
    let socket = pair.network.socket(SocketAddr::from(([10, 9, 9, 9], 9)));
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(62);
    for i in 0..count {
        let len = rng.random_range(1..1200);
        let mut packet: Vec<u8> = (0..len).map(|_| rng.random()).collect();
        if i % 2 == 0 && len > 5 {
            packet[..5].copy_from_slice(&[0xc3, 0, 0, 0, 1]);
        }
        let transmit = Transmit {
            destination: pair.robot_addr(),
            ecn: None,
            contents: &packet,
            segment_size: None,
            src_ip: None,
        };
        socket.try_send(&transmit).unwrap();
        if i % 50 == 0 {
            pair.run_for(1e-3).await;
        }
    }
}

/// Where the tip was at every tick while an operator mirrored, and what the session counted.
fn mirrored(flooded: bool) -> (Vec<[f64; 3]>, String) {
    run_virtual(async move {
        let mut pair = Pair::start(&rig()).unwrap();
        let operator = mirroring(&mut pair, &shaped(), 62);
        assert!(pair.wait_for(5.0, |r| r.state == RobotState::Engaged).await);
        if flooded {
            deaf_strangers(&mut pair, 40);
            garbage(&pair, 100_000).await;
        }
        let (summary, _, _) = finish(operator).await;
        completed(&summary.unwrap());
        pair.run_for(1.0).await;
        let notices = pair.robot.notices();
        let counted = notices.iter().rev().find_map(|n| match n {
            RobotNotice::Disconnected { counters, .. } => Some(format!("{counters:?}")),
            _ => None,
        });
        let tips = pair
            .robot
            .reports()
            .iter()
            .map(|r| r.tip_m.into())
            .collect();
        (tips, counted.expect("the session ended"))
    })
    .unwrap()
}

#[test]
fn a_session_does_not_feel_strangers_and_garbage() {
    let (calm, flooded) = (mirrored(false), mirrored(true));
    assert_eq!(calm.1, flooded.1);
    // The same motion to the bit, for as long as both were watched.
    let ticks = calm.0.len().min(flooded.0.len());
    assert!(ticks > 4000, "{ticks}");
    assert_eq!(calm.0[..ticks], flooded.0[..ticks]);
}

#[test]
fn there_is_one_stream_and_no_other() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let (_endpoint, connection, _control) = greeted(&mut pair, 63).await;
        let second = timeout(Duration::from_millis(900), connection.open_bi()).await;
        assert!(second.is_err(), "a second stream each way");
        let aside = timeout(Duration::from_millis(900), connection.open_uni()).await;
        assert!(aside.is_err(), "a stream one way");
        assert!(
            connection.close_reason().is_none(),
            "and the session goes on"
        );
    })
    .unwrap();
}

#[test]
fn a_frame_that_claims_too_much_ends_the_session_before_it_is_read() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let (_endpoint, connection, control) = greeted(&mut pair, 64).await;
        let (writer, _frames) = control.into_frames();
        let claim = (MAX_FRAME_LEN as u32 + 1).to_le_bytes();
        writer.raw(claim.to_vec()).unwrap();
        let closed = connection.closed().await.to_string();
        assert!(closed.contains("limit"), "{closed}");
        greeted(&mut pair, 65).await;
    })
    .unwrap();
}

#[test]
fn a_peer_that_never_reads_is_given_up_and_the_stop_holds() {
    const STOPS: usize = 40_000;
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let (_endpoint, connection, mut control) = greeted(&mut pair, 66).await;
        // Each is answered, and no answer is read.
        let stop = frame::encode(&OperatorControl::EmergencyStop.encode(), false);
        let flood = stop.repeat(STOPS);
        let written = control.write(&flood).await;
        let closed = timeout(Duration::from_secs(20), connection.closed()).await;
        let closed = closed.expect("given up").to_string();
        assert!(closed.contains("does not read"), "{closed} {written:?}");
        let report = pair.robot.reports().last().copied().unwrap();
        assert_eq!(report.state, RobotState::Stopped);
        // Whoever comes next finds a robot that answers.
        greeted(&mut pair, 67).await;
    })
    .unwrap();
}
