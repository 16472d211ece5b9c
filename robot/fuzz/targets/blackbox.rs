//! A black box: any bytes are refused, or are a record that replays. What the checksum keeps from a search is sealed again:
//! a record of a short motion in which the input changes bytes.
//!
//! The input is a kind, and then a file, or a content, or changes (where, as a u24, and what to xor there).

#![no_main]

use std::cell::RefCell;
use std::path::Path;

use libfuzzer_sys::fuzz_target;
use sha2::{Digest, Sha256};
use telemime_endpoint::Mono;
use telemime_robot::blackbox::{BlackBox, Due, Header, Recorder, replay, taps};
use telemime_robot::rig::{Rig, RigOptions};
use telemime_robot::servo::{self, Order};

const TICKS: i64 = 60;
/// Ticks that are worth replaying here.
const MOST_TICKS: u64 = 2000;

thread_local! {
    static RECORD: RefCell<Vec<u8>> = const { RefCell::new(Vec::new()) };
}

/// A record of an arm that holds, with an operator that comes, and a stop.
fn record() -> Vec<u8> {
    let rig = Rig::load(&RigOptions::default()).expect("our own arm");
    let (rings, mut handle) = servo::rings();
    let station = rig.servo(rings);
    let (tap, feed) = taps(&station.room());
    let mut station = station.recorded(tap);
    let mut recorder = Recorder::new(Header::new(&rig, None), feed, 10.0);
    for tick in 1..=TICKS {
        let order = match tick {
            10 => Some(Order::Operator(true)),
            40 => Some(Order::Operator(false)),
            _ => None,
        };
        if let Some(order) = order {
            handle.orders.push(order).expect("room");
        }
        if tick == 50 {
            handle.brake.stop_here();
        }
        station.tick(Mono(1_000_000_000 + tick * 1_000_000));
        while handle.reports.pop().is_ok() {}
        recorder.drain();
    }
    let draft = recorder.draft(Due::Request).expect("ticks were recorded");
    draft.sealed()
}

/// A file that says of itself what it should.
fn sealed(content: &[u8]) -> Vec<u8> {
    let line = format!(
        "telemime black box, format 1; request; {} bytes and sha256 follow\n",
        content.len()
    );
    let mut file = [line.as_bytes(), content].concat();
    let hash = Sha256::digest(&file);
    file.extend(hash);
    file
}

/// Where the content of a file begins.
fn content(file: &[u8]) -> usize {
    1 + file
        .iter()
        .position(|b| *b == b'\n')
        .expect("a readable line")
}

fuzz_target!(|data: &[u8]| {
    let Some((&kind, data)) = data.split_first() else {
        return;
    };
    let genuine = RECORD.with_borrow_mut(|known| {
        if known.is_empty() {
            *known = record();
        }
        known.clone()
    });
    let file = match kind % 3 {
        0 => data.to_vec(),
        1 => sealed(data),
        _ => {
            let begin = content(&genuine);
            let mut content = genuine[begin..genuine.len() - 32].to_vec();
            for change in data.chunks_exact(4) {
                let at = u32::from_le_bytes([change[0], change[1], change[2], 0]) as usize;
                let at = at % content.len();
                content[at] ^= change[3];
            }
            sealed(&content)
        }
    };
    let Ok(record) = BlackBox::parse(Path::new("fuzz"), &file) else {
        assert!(file != genuine, "a record is one");
        return;
    };
    if record.ticks() > MOST_TICKS {
        return;
    }
    let mut rows = 0;
    let done = replay(&record, |_| {
        rows += 1;
        Ok(())
    });
    if let Ok(done) = done {
        assert_eq!((done.ticks, rows), (record.ticks(), record.ticks()));
        if file == genuine {
            assert_eq!(done.difference, None);
        }
    }
});
