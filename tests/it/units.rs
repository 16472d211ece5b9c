//! The systemd units, started by a systemd of their own where this host can begin one.

use std::path::Path;
use std::process::Command;

use crate::data::skipped;
use crate::processes::alone;

/// What `tests/systemd/run` ends with where something is missing.
const SKIPPED: i32 = 77;

#[test]
fn systemd_starts_watches_and_stops_both_units() {
    let _alone = alone();
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut trial = Command::new(root.join("tests/systemd/run"));
    let out = trial.arg(env!("CARGO_BIN_EXE_telemime")).output().unwrap();
    let said = String::from_utf8_lossy(&out.stdout);
    let why = String::from_utf8_lossy(&out.stderr);
    println!("{said}");
    let lines = why.lines().chain(said.lines());
    for reason in lines.filter_map(|line| line.strip_prefix("SKIPPED: ")) {
        skipped(reason);
    }
    if out.status.code() != Some(SKIPPED) {
        assert!(out.status.success(), "{}\n{said}\n{why}", out.status);
        assert!(said.contains("ended by the watchdog"), "{said}");
    }
}
