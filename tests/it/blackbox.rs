//! The robot's black box on the virtual ground: both daemons, a link that is cut, and the same again from the record.

use std::path::Path;
use std::process::Command;

use telemime::ground::{Pair, run_virtual};
use telemime_protocol::wire::v1::{Cause, RobotState};
use telemime_robot::blackbox::{BlackBox, Due, replay};

use crate::scene::{mirroring, rig, shaped};

/// Drives, cuts the link, and returns what the black box wrote and every report of the run.
fn cut() -> (Vec<u8>, Vec<telemime_robot::servo::Report>) {
    let rig = rig();
    run_virtual(async {
        let mut pair = Pair::start_recorded(&rig).unwrap();
        let operator = mirroring(&mut pair, &shaped(), 21);
        assert!(pair.wait_for(6.0, |r| r.state == RobotState::Engaged).await);
        pair.run_for(1.5).await;
        pair.network.set_down(true);
        pair.run_for(2.5).await;
        drop(operator);
        let records = pair.robot.records();
        let [(due, bytes)] = &records[..] else {
            panic!("{} records", records.len());
        };
        let Due::Stop(cause) = due else {
            panic!("{due:?}");
        };
        assert!(matches!(cause, Cause::LeaseExpired | Cause::ConnectionLost));
        (bytes.clone(), pair.robot.reports().clone())
    })
    .unwrap()
}

#[test]
fn a_cut_link_is_recorded_replays_to_the_bit_and_is_told() {
    let (bytes, reports) = cut();
    let record = BlackBox::parse(Path::new("cut"), &bytes).unwrap();
    let mut replayed = Vec::new();
    let shown = replay(&record, |row| {
        replayed.push(row.report);
        Ok(())
    })
    .unwrap();
    assert_eq!((shown.difference.as_ref(), shown.gaps), (None, 0));
    assert!(shown.ticks > 2000 && shown.orders > 10, "{shown:?}");
    assert_eq!(replayed[..], reports[..replayed.len()]);
    let story: Vec<_> = shown.moments.iter().map(|m| m.what.as_str()).collect();
    println!("{story:#?}");
    for words in [
        "asked to engage #1: mirror",
        "Engaged",
        "Coasting (NewsLate)",
        "Holding (",
    ] {
        assert!(
            story.iter().any(|told| told.contains(words)),
            "{words}: {story:#?}"
        );
    }

    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("cut.blackbox");
    let told = |path: &Path| {
        Command::new(env!("CARGO_BIN_EXE_telemime"))
            .arg("replay")
            .arg(path)
            .output()
            .unwrap()
    };
    std::fs::write(&path, &bytes).unwrap();
    let out = told(&path);
    let said = String::from_utf8_lossy(&out.stdout);
    assert!(
        out.status.success() && said.contains("identical to the bit"),
        "{said}"
    );
    std::fs::write(&path, &bytes[..bytes.len() - 100]).unwrap();
    let out = told(&path);
    assert_eq!(out.status.code(), Some(1));
    let said = String::from_utf8_lossy(&out.stderr);
    assert!(
        said.contains("is cut off") && said.trim().lines().count() == 1,
        "{said}"
    );
}

#[test]
fn the_same_run_is_the_same_record_to_the_byte() {
    // Keys differ from run to run, and with them nothing that is recorded.
    assert_eq!(cut().0, cut().0);
}
