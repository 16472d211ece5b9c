//! Datagrams that are none, motions but for their cutting apart (docs/protocol.md §5).

use telemime_protocol::wire::bend::{WireBend, WireHeld};
use telemime_protocol::wire::knots::KnotBlock;
use telemime_protocol::wire::v1::*;

use super::super::meaning::moving;
use super::super::messages::{OPERATOR_DATAGRAM, ROBOT_DATAGRAM};
use super::with;

pub(super) fn datagrams(say: &mut impl FnMut(&'static str, &str, Vec<u8>, &'static str)) {
    let sent = |change: fn(&mut Motion)| {
        let mut motion = moving(3);
        change(&mut motion);
        OperatorDatagram::Motion(motion).encode()
    };
    let good = sent(|_| ());
    say(
        OPERATOR_DATAGRAM,
        "an unknown message",
        vec![99],
        "Malformed",
    );
    say(
        OPERATOR_DATAGRAM,
        "cut short",
        good[..good.len() - 1].to_vec(),
        "Malformed",
    );
    say(
        OPERATOR_DATAGRAM,
        "and more",
        [good.clone(), vec![0]].concat(),
        "Trailing",
    );
    say(
        OPERATOR_DATAGRAM,
        "too long",
        vec![0; MAX_DATAGRAM_LEN + 1],
        "TooLong",
    );
    say(
        OPERATOR_DATAGRAM,
        "no time of the session",
        sent(|m| m.state.t_us = i64::MAX),
        "Invalid",
    );
    say(
        OPERATOR_DATAGRAM,
        "a hand beyond 100 m",
        sent(|m| m.state.x[0] = -1_000_001),
        "Invalid",
    );
    say(
        OPERATOR_DATAGRAM,
        "a rotation beyond half a turn",
        sent(|m| m.pose.turn.as_mut().expect("it turns").q.0[1] = 31_417),
        "Invalid",
    );
    say(
        OPERATOR_DATAGRAM,
        "a turn's exponent of 11",
        sent(|m| m.pose.turn.as_mut().expect("it turns").memory.exponents[1] = 0x1b),
        "Invalid",
    );
    say(
        OPERATOR_DATAGRAM,
        "weights of more than 1",
        sent(|m| m.params.weights[2] = [12, 3, 1]),
        "Invalid",
    );
    let go = |change: fn(&mut WireBend)| {
        let mut bend = WireBend {
            plan_us: 1_500_000,
            rate: 64,
            left: [0; 3],
            held: Some(WireHeld {
                state: moving(3).state,
                gain: 255,
                straight: 128,
                weight: [64, 10, 100, 0, -5, 127],
            }),
        };
        change(&mut bend);
        OperatorDatagram::Go {
            epoch: 7,
            engagement: 1,
            seq: 44,
            t_us: 3_200_000,
            lease_ms: 650,
            bend: Some(bend),
        }
        .encode()
    };
    say(
        OPERATOR_DATAGRAM,
        "a plan's rate above 1.5",
        go(|b| b.rate = 193),
        "Invalid",
    );
    say(
        OPERATOR_DATAGRAM,
        "a plan at no time of a session",
        go(|b| b.plan_us = i64::MIN),
        "Invalid",
    );
    say(
        OPERATOR_DATAGRAM,
        "a displacement beyond 100 m",
        go(|b| b.left[1] = 1_000_001),
        "Invalid",
    );
    say(
        OPERATOR_DATAGRAM,
        "a weight below 0",
        go(|b| b.held.as_mut().expect("it holds on").weight[2] = -1),
        "Invalid",
    );
    say(
        OPERATOR_DATAGRAM,
        "a weight beside the diagonal above a half",
        go(|b| b.held.as_mut().expect("it holds on").weight[3] = 65),
        "Invalid",
    );
    let plain = OperatorDatagram::Go {
        epoch: 7,
        engagement: 1,
        seq: 44,
        t_us: 3_200_000,
        lease_ms: 650,
        bend: None,
    };
    let plain = plain.encode();
    say(
        OPERATOR_DATAGRAM,
        "an option tag of 2",
        with(plain.clone(), plain.len() - 1, 2),
        "Malformed",
    );
    // One of n + 1 zeros, a one and n bits: 33 less one, in a motion.
    let many = sent(|m| m.knots = KnotBlock(vec![0b0000_0100, 0b0010_0000]));
    say(OPERATOR_DATAGRAM, "33 knots", many, "Invalid");
    let endless = sent(|m| m.knots = KnotBlock(vec![0; 9]));
    say(
        OPERATOR_DATAGRAM,
        "a number of knots that has no end",
        endless,
        "Invalid",
    );
    let telemetry = |q: Vec<f32>, tip| {
        RobotDatagram::Telemetry(Telemetry {
            epoch: 7,
            tip_m: [tip, 0.0, 0.0],
            q,
            ..Telemetry::default()
        })
        .encode()
    };
    say(
        ROBOT_DATAGRAM,
        "eleven joints",
        telemetry(vec![0.0; 11], 0.0),
        "Invalid",
    );
    say(
        ROBOT_DATAGRAM,
        "a joint that is no number",
        telemetry(vec![f32::NAN], 0.0),
        "Invalid",
    );
    say(
        ROBOT_DATAGRAM,
        "a tip at infinity",
        telemetry(vec![], f32::INFINITY),
        "Invalid",
    );
}
