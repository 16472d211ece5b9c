//! The examples in docs/protocol.md are true: bytes are encoded, numbers computed, by the code.

mod bytes;
mod example;
mod values;

use std::collections::BTreeMap;
use std::fmt::Display;
use std::path::Path;

use nalgebra::SVector;
use telemime_endpoint::Mono;
use telemime_protocol::checkpoint::{Checkpoint, Grid, Plan, PosePlan};
use telemime_protocol::wire::codec;
use telemime_protocol::wire::frame::Frame;
use telemime_protocol::wire::v1::{
    Drive, Engage, Message, OperatorControl, OperatorDatagram, Refusal, RobotControl,
};
use telemime_robot::rig::{Rig, RigOptions};
use telemime_robot::servo;
use telemime_robot::servo::thread::Times;
use telemime_robot::session::{Output, Session, SessionConfig};

use bytes::bytes;
use values::values;

fn document() -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/protocol.md");
    std::fs::read_to_string(path).unwrap()
}

/// The content of every fenced block that begins with "```kind", with what follows the kind.
fn blocks<'a>(text: &'a str, kind: &str) -> Vec<(&'a str, &'a str)> {
    let fence = format!("```{kind} ");
    let mut found = Vec::new();
    let mut rest = text;
    while let Some(at) = rest.find(&fence) {
        let (title, after) = rest[at + fence.len()..].split_once('\n').unwrap();
        let (body, after) = after.split_once("```").unwrap();
        found.push((title.trim(), body));
        rest = after;
    }
    found
}

fn hex(bytes: &[u8]) -> String {
    let pairs: Vec<_> = bytes.iter().map(|b| format!("{b:02x}")).collect();
    pairs.join(" ")
}

/// Fails with all that the document should say instead.
fn same<K: Ord + Display>(written: &BTreeMap<K, String>, expected: &BTreeMap<K, String>) {
    let wrong = expected.iter().filter(|(k, v)| written.get(k) != Some(v));
    let wrong: String = wrong.map(|(k, v)| format!("{k} = {v}\n")).collect();
    assert!(wrong.is_empty(), "docs/protocol.md should say\n{wrong}");
    let stray = written.keys().filter(|k| !expected.contains_key(k));
    let stray: String = stray.map(|k| format!("{k}\n")).collect();
    assert!(stray.is_empty(), "no code stands behind\n{stray}");
}

#[test]
fn the_bytes_in_the_specification_are_those_of_the_code() {
    let text = document();
    let mut written = BTreeMap::new();
    for (title, body) in blocks(&text, "hex") {
        for line in body.lines() {
            let line = line.split('#').next().unwrap_or_default();
            // One block may hold several short encodings, each line under its own name.
            let (name, digits) = line.split_once(" = ").unwrap_or((title, line));
            let bytes = digits
                .split_whitespace()
                .map(|pair| u8::from_str_radix(pair, 16).unwrap());
            let all: &mut Vec<u8> = written.entry(name.trim()).or_default();
            all.extend(bytes);
        }
    }
    let written: BTreeMap<_, _> = written.iter().map(|(n, b)| (*n, hex(b))).collect();
    let expected: BTreeMap<_, _> = bytes().iter().map(|(n, b)| (*n, hex(b))).collect();
    same(&written, &expected);
}

#[test]
fn the_numbers_in_the_specification_are_those_of_the_code() {
    let text = document();
    let written: BTreeMap<_, _> = blocks(&text, "values")
        .iter()
        .flat_map(|(_, body)| body.lines())
        .filter_map(|line| line.split_once(" = "))
        .map(|(name, value)| (name.trim().to_owned(), value.trim().to_owned()))
        .collect();
    same(&written, &values());
}

#[test]
fn a_plan_that_does_not_begin_at_zero_is_refused() {
    let rig = Rig::load(&RigOptions::default()).unwrap();
    let (rings, _handle) = servo::rings();
    let report = rig.servo(rings).tick(Mono(0));
    let mut session = Session::new(SessionConfig::default(), rig.info(), 1, None, Mono(0));
    session.handle_report(&report, Times::default());
    // Before it knows the clock it judges no request at all.
    for _ in 0..4 {
        let pong = OperatorDatagram::Pong {
            epoch: 1,
            t1_us: 0,
            t2_us: 0,
            t3_us: 0,
        };
        session.handle_datagram(Mono(1), &pong.encode());
    }
    let point = |t_s| Checkpoint {
        t_s,
        x: SVector::from([0.0, 0.0, t_s]),
    };
    let late = Plan::quantise(Grid::for_bound(0.004).unwrap(), &[point(0.5), point(1.0)]).unwrap();
    let late = PosePlan::from(late);
    let mut ask = |message: OperatorControl| {
        let frame = Frame {
            ignorable: false,
            payload: message.encode(),
        };
        session.handle_control(Mono(1), &frame).unwrap();
        let mut said = Vec::new();
        while let Some(output) = session.poll_output() {
            if let Output::Control(bytes) = output {
                said.push(RobotControl::decode(&bytes).unwrap());
            }
        }
        said
    };
    ask(OperatorControl::Plan {
        id: 1,
        bytes: codec::encode(&late),
    });
    let said = ask(OperatorControl::Engage(Engage {
        engagement: 1,
        t_us: 0,
        drive: Drive::Play { plan: 1 },
        scale: 0.1,
        rotation: [1.0, 0.0, 0.0, 0.0],
        path_bound_um: 1000,
        path_turn_bound_urad: 0,
        sample_us: 33_333,
        lease_ms: 650,
    }));
    assert_eq!(
        said,
        [RobotControl::Refused {
            reason: Refusal::BadPlan
        }]
    );
}
