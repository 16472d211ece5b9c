//! Bytes that are no message, each with the name of the reason (docs/protocol.md §2, §3).

mod finished;
mod motions;

use telemime_protocol::checkpoint::PosePlan;
use telemime_protocol::skill::{Skill, SkillError};
use telemime_protocol::wire::arm::{WireArm, WireCapsule, WireJoint, WireJointKind, WirePlace};
use telemime_protocol::wire::bend::{WireBend, WireHeld};
use telemime_protocol::wire::frame::{Deframer, MAX_FRAME_LEN};
use telemime_protocol::wire::hello::{Answer, Hello, HelloError};
use telemime_protocol::wire::knots::KnotBlock;
use telemime_protocol::wire::pair::{PairDecodeError, PairMessage};
use telemime_protocol::wire::v1::*;
use telemime_protocol::wire::{DecodeError, codec};

use super::Vector;
use super::meaning::moving;
use super::messages::{OPERATOR_CONTROL, OPERATOR_DATAGRAM, ROBOT_CONTROL, ROBOT_DATAGRAM};

fn name(error: &DecodeError) -> &'static str {
    match error {
        DecodeError::TooLong { .. } => "TooLong",
        DecodeError::Malformed(_) => "Malformed",
        DecodeError::Trailing(_) => "Trailing",
        DecodeError::NotCanonical => "NotCanonical",
        DecodeError::Invalid { .. } => "Invalid",
    }
}

fn greeting_name(error: &HelloError) -> &'static str {
    match error {
        HelloError::Magic => "Magic",
        HelloError::Kind(_) => "Kind",
        HelloError::Range { .. } => "Range",
        HelloError::Text => "Text",
    }
}

/// Why these bytes of a kind are rejected.
fn reason(kind: &str, bytes: &[u8]) -> &'static str {
    let error = match kind {
        OPERATOR_CONTROL => OperatorControl::decode(bytes).err(),
        ROBOT_CONTROL => RobotControl::decode(bytes).err(),
        OPERATOR_DATAGRAM => OperatorDatagram::decode(bytes).err(),
        ROBOT_DATAGRAM => RobotDatagram::decode(bytes).err(),
        "u64" => codec::decode::<u64, 16>(bytes).err(),
        "i64" => codec::decode::<i64, 16>(bytes).err(),
        "plan" => codec::decode::<PosePlan, MAX_PLAN_LEN>(bytes).err(),
        "frame" => {
            let mut deframer = Deframer::default();
            deframer.push(bytes);
            deframer.next_frame().err()
        }
        "skill" => match Skill::from_bytes(bytes).err() {
            Some(SkillError::Decode(e)) => Some(e),
            // Every other error is about what a field holds.
            Some(_) => return "Invalid",
            None => None,
        },
        "operator greeting" => {
            return greeting_name(&Hello::decode(bytes).expect_err("no greeting"));
        }
        "pairing" => {
            return match PairMessage::decode(bytes).expect_err("no message") {
                PairDecodeError::Magic => "Magic",
                PairDecodeError::Kind(_) => "Kind",
                PairDecodeError::Name => "Name",
                PairDecodeError::Text => "Text",
            };
        }
        "robot greeting" => return greeting_name(&Answer::decode(bytes).expect_err("no greeting")),
        other => panic!("no decoder for {other}"),
    };
    name(&error.expect("bytes that are no message"))
}

fn greetings(say: &mut impl FnMut(&'static str, &str, Vec<u8>, &'static str)) {
    let hello = |min, max| {
        Hello {
            min,
            max,
            features: 0,
        }
        .encode()
    };
    say(
        "operator greeting",
        "another protocol",
        b"GET / HTTP/1.1\r\n".to_vec(),
        "Magic",
    );
    say(
        "operator greeting",
        "an answer",
        [b"TLMM".as_slice(), &[2; 15]].concat(),
        "Kind",
    );
    say(
        "operator greeting",
        "an unknown kind",
        b"TLMM\x09".to_vec(),
        "Kind",
    );
    say("operator greeting", "no versions", hello(3, 2), "Range");
    say("robot greeting", "a hello", hello(1, 1), "Kind");
    say(
        "robot greeting",
        "not UTF-8",
        b"TLMM\x03\x02\x00\x02\xff\xfe".to_vec(),
        "Text",
    );
    for (name, tail, expected) in [
        ("of a kind nobody knows", &b"\x09"[..], "Kind"),
        ("with a name of nothing", b"\x01\0", "Name"),
        ("with a name of other bytes", b"\x01\x03a b", "Name"),
        (
            "with a reason that is not UTF-8",
            b"\x07\x04\0\x02\xff\xfe",
            "Text",
        ),
    ] {
        say("pairing", name, [b"TLMP", tail].concat(), expected);
    }
    say("pairing", "a greeting", hello(1, 1), "Magic");
    let mut huge = (MAX_FRAME_LEN as u32 + 1).to_le_bytes().to_vec();
    say("frame", "one byte too long", huge.clone(), "TooLong");
    huge[3] |= 0x80;
    say("frame", "ignorable and too long", huge, "TooLong");
    say(
        "u64",
        "251 in two bytes too many",
        vec![0xfc, 251, 0, 0, 0],
        "NotCanonical",
    );
    say("u64", "5 in three bytes", vec![0xfb, 5, 0], "NotCanonical");
    say(
        "u64",
        "of 128 bits",
        [vec![0xfe], vec![1; 15]].concat(),
        "Malformed",
    );
    say("u64", "a marker of nothing", vec![0xff], "Malformed");
    say("u64", "cut short", vec![0xfc, 1, 2, 3], "Malformed");
    say("u64", "two of them", vec![5, 5], "Trailing");
    say("i64", "-1 in three bytes", vec![0xfb, 1, 0], "NotCanonical");
}

/// `bytes` with one changed.
fn with(mut bytes: Vec<u8>, at: usize, to: u8) -> Vec<u8> {
    bytes[at] = to;
    bytes
}

fn control(say: &mut impl FnMut(&'static str, &str, Vec<u8>, &'static str)) {
    let engage = |drive| {
        OperatorControl::Engage(Engage {
            engagement: 1,
            t_us: 3_010_000,
            drive,
            scale: 0.125,
            rotation: [0.5, -0.5, 0.5, -0.5],
            path_bound_um: 200,
            path_turn_bound_urad: 200,
            sample_us: 200,
            lease_ms: 200,
        })
    };
    let play = engage(Drive::Play { plan: 1 }).encode();
    // From the end: lease 1, samples 1, both bounds 1, rotation 16, scale 4.
    let from_end = |n| play.len() - n;
    let (samples, turned, bound) = (from_end(2), from_end(3), from_end(4));
    let (rotation, scale) = (from_end(20), from_end(24));
    let scaled = |v: f32| {
        let mut bytes = play.clone();
        bytes[scale..scale + 4].copy_from_slice(&v.to_le_bytes());
        bytes
    };
    say(OPERATOR_CONTROL, "nothing", vec![], "Malformed");
    say(OPERATOR_CONTROL, "an unknown message", vec![8], "Malformed");
    say(
        OPERATOR_CONTROL,
        "a marker wider than its field",
        vec![4, 0xfd, 0, 0, 0, 0, 1, 0, 0, 0],
        "Malformed",
    );
    say(
        OPERATOR_CONTROL,
        "release, cut short",
        vec![4, 0xfb, 1],
        "Malformed",
    );
    say(
        OPERATOR_CONTROL,
        "a goodbye and more",
        vec![7, 0],
        "Trailing",
    );
    say(
        OPERATOR_CONTROL,
        "its index in three bytes",
        vec![0xfb, 7, 0],
        "NotCanonical",
    );
    say(OPERATOR_CONTROL, "engage, scale 0", scaled(0.0), "Invalid");
    say(
        OPERATOR_CONTROL,
        "engage, scale beyond 10",
        scaled(10.5),
        "Invalid",
    );
    say(
        OPERATOR_CONTROL,
        "engage, scale not a number",
        scaled(f32::NAN),
        "Invalid",
    );
    say(
        OPERATOR_CONTROL,
        "engage, not a rotation",
        with(play.clone(), rotation + 3, 0x40),
        "Invalid",
    );
    say(
        OPERATOR_CONTROL,
        "engage, an orientation's path bound above half a turn",
        [
            &play[..turned],
            &codec::encode(&3_141_593_u32),
            &play[turned + 1..],
        ]
        .concat(),
        "Invalid",
    );
    say(
        OPERATOR_CONTROL,
        "engage, no path bound",
        with(play.clone(), bound, 0),
        "Invalid",
    );
    say(
        OPERATOR_CONTROL,
        "engage, no interval of samples",
        with(play.clone(), samples, 0),
        "Invalid",
    );
    let mut mirror = moving(1);
    let drive = |m: &Motion| {
        engage(Drive::Mirror {
            state: m.state,
            model: 0,
            params: m.params,
            pose: m.pose,
        })
        .encode()
    };
    mirror.state.x[2] = 1_000_001;
    say(
        OPERATOR_CONTROL,
        "engage, a hand beyond 100 m",
        drive(&mirror),
        "Invalid",
    );
    let plan = OperatorControl::Plan {
        id: 1,
        bytes: vec![0; MAX_PLAN_LEN + 1],
    };
    let head = plan.encode()[..8].to_vec();
    say(
        OPERATOR_CONTROL,
        "a model that claims 2^60 bytes",
        [vec![0; 17], vec![0xfd, 0, 0, 0, 0, 0, 0, 0, 16]].concat(),
        "Malformed",
    );
    say(
        OPERATOR_CONTROL,
        "a plan that is not there",
        head,
        "Malformed",
    );
    let info = |change: fn(&mut Info)| {
        let mut info = Info {
            name: "mime7".to_owned(),
            joints: 7,
            speed_m_s: 1.5,
            accel_m_s2: 13.0,
            radius_m: 0.25,
            lag_s: 0.0625,
            model: None,
            state: RobotState::Idle,
        };
        change(&mut info);
        RobotControl::Info(info).encode()
    };
    let arm = |change: fn(&mut WireArm)| {
        let place = WirePlace {
            m: [0.0, 0.0, 0.25],
            q: [1.0, 0.0, 0.0, 0.0],
        };
        let mut arm = WireArm {
            joints: vec![WireJoint {
                place,
                axis: [0.0, 0.0, 1.0],
                kind: WireJointKind::Revolute,
                limits: Some([-2.5, 2.5]),
            }],
            tip: place,
            capsules: vec![WireCapsule {
                link: 1,
                from: [0.0; 3],
                to: [0.125, 0.0, 0.0],
                radius_m: 0.0625,
            }],
        };
        change(&mut arm);
        RobotControl::Arm(arm).encode()
    };
    type Wrong = (&'static str, fn(&mut WireArm));
    let wrong: [Wrong; 8] = [
        ("eleven joints", |a| a.joints = vec![a.joints[0]; 11]),
        ("65 capsules", |a| a.capsules = vec![a.capsules[0]; 65]),
        ("an axis of no length", |a| a.joints[0].axis = [0.0; 3]),
        ("limits out of order", |a| {
            a.joints[0].limits = Some([1.0, -1.0])
        }),
        ("a tip that is nowhere", |a| a.tip.m[1] = f32::NAN),
        ("a quaternion of length two", |a| a.tip.q[0] = 2.0),
        ("a capsule of nothing", |a| a.capsules[0].radius_m = 0.0),
        ("a capsule of a joint that is not there", |a| {
            a.capsules[0].link = 2
        }),
    ];
    for (name, change) in wrong {
        say(
            ROBOT_CONTROL,
            &format!("arm, {name}"),
            arm(change),
            "Invalid",
        );
    }
    say(
        ROBOT_CONTROL,
        "info, a long name",
        info(|i| i.name = "n".repeat(65)),
        "Invalid",
    );
    say(
        ROBOT_CONTROL,
        "info, no speed",
        info(|i| i.speed_m_s = 0.0),
        "Invalid",
    );
    say(
        ROBOT_CONTROL,
        "info, endless acceleration",
        info(|i| i.accel_m_s2 = f32::INFINITY),
        "Invalid",
    );
    say(
        ROBOT_CONTROL,
        "info, a radius that is none",
        info(|i| i.radius_m = f32::NAN),
        "Invalid",
    );
    say(
        ROBOT_CONTROL,
        "info, negative lag",
        info(|i| i.lag_s = -0.001),
        "Invalid",
    );
    say(
        ROBOT_CONTROL,
        "info, a name not UTF-8",
        with(info(|_| ()), 2, 0xff),
        "Malformed",
    );
    say(
        ROBOT_CONTROL,
        "an unknown refusal",
        vec![4, 11],
        "Malformed",
    );
    say(
        ROBOT_CONTROL,
        "an unknown state",
        vec![5, 6, 0, 0],
        "Malformed",
    );
    say(
        ROBOT_CONTROL,
        "an unknown cause",
        vec![5, 0, 11, 0],
        "Malformed",
    );
}

fn datagrams(say: &mut impl FnMut(&'static str, &str, Vec<u8>, &'static str)) {
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

pub(crate) fn rejects() -> Vec<Vector> {
    let mut all = Vec::new();
    let mut say = |kind: &'static str, name: &str, bytes: Vec<u8>, expected: &'static str| {
        assert_eq!(reason(kind, &bytes), expected, "{kind}: {name}");
        all.push(Vector {
            kind,
            name: format!("not: {name}"),
            bytes,
            means: Err(expected),
        });
    };
    greetings(&mut say);
    control(&mut say);
    datagrams(&mut say);
    motions::motions(&mut say);
    finished::plans_and_skills(&mut say);
    all
}
