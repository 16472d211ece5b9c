//! Bytes that are no message, each with the name of the reason (docs/protocol.md §2, §3).

mod control;
mod datagrams;
mod finished;
mod motions;

use telemime_protocol::checkpoint::PosePlan;
use telemime_protocol::skill::{Skill, SkillError};
use telemime_protocol::wire::frame::{Deframer, MAX_FRAME_LEN};
use telemime_protocol::wire::hello::{Answer, Hello, HelloError};
use telemime_protocol::wire::pair::{PairDecodeError, PairMessage};
use telemime_protocol::wire::v1::*;
use telemime_protocol::wire::{DecodeError, codec};

use super::Vector;
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
    control::control(&mut say);
    datagrams::datagrams(&mut say);
    motions::motions(&mut say);
    finished::plans_and_skills(&mut say);
    all
}
