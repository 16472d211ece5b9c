//! One plan on every ground: the figures must be the same but for what real time does to them.
//!
//! What differs: on the virtual ground everybody is on time to the nanosecond. Two processes and a relay are each woken some
//! milliseconds late now and then, more so on a busy host; the servo makes up for its own lateness, a message that is late
//! is a message on a longer link. So ten milliseconds are allowed to whatever is a time (twice, for lag: the shift is an
//! extremum and flat), a sixth to errors (a hand at 1 m/s goes 10 mm in that time, the error is 100 mm) and to counts
//! (a message more or less changes when the next is due). What is computed must be equal.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Output};

use crate::processes::alone;

const PLAN: &str = "\
title = \"One recording, one link\"
[motion]
people = 1
performances = 2
[factors]
motion = \"on-model\"
method = [\"ours\", \"hold\"]
link = \"delay 60ms\"
";

type Row = BTreeMap<String, String>;

fn experiment(dir: &Path, ground: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_telemime"));
    let command = command.current_dir(dir).args(["experiment", "plan.toml"]);
    command
        .args(["--ground", ground, "-o", ground])
        .output()
        .unwrap()
}

fn rows(dir: &Path, ground: &str) -> Vec<Row> {
    let done = experiment(dir, ground);
    assert!(
        done.status.success(),
        "{}",
        String::from_utf8_lossy(&done.stderr)
    );
    let mut reader = csv::Reader::from_path(dir.join(ground).join("results.csv")).unwrap();
    reader.deserialize().map(|row| row.unwrap()).collect()
}

fn number(row: &Row, column: &str) -> f64 {
    let text = &row[column];
    text.parse()
        .unwrap_or_else(|_| panic!("{column}: {text:?}"))
}

/// `seen` says whether the ground's link is ours, so that every packet is known.
fn agree(there: &[Row], here: &[Row], ground: &str, seen: bool) {
    let [(ours, real), (hold, computed)] = [(&there[0], &here[0]), (&there[1], &here[1])];
    assert_eq!(
        (ours["ground"].as_str(), real["ground"].as_str()),
        ("virtual", ground)
    );
    assert_eq!(
        (&real["outcome"], &ours["outcome"]),
        (&ours["outcome"], &"followed".into())
    );
    assert_eq!(hold, computed, "a baseline is computed wherever ours runs");
    let close = |column: &str, most: f64| {
        let (a, b) = (number(ours, column), number(real, column));
        println!("{column}: virtual {a:.4}, {ground} {b:.4}");
        assert!((a - b).abs() <= most, "{column}: virtual {a}, {ground} {b}");
    };
    let share = |column: &str, most: f64| close(column, most * number(ours, column));
    for column in ["rmse_m", "value_rmse_m", "spatial_mean_m", "amplitude_gain"] {
        share(column, 1.0 / 6.0);
    }
    close("lag_s", 0.02);
    close("judged_s", 2e-3);
    close("followed", 0.0);
    close("age_p50_s", 0.01);
    share("messages_per_s", 1.0 / 6.0);
    share("knots_per_s", 1.0 / 6.0);
    let wire = [
        "up_bytes_per_s",
        "up_packets_per_s",
        "down_bytes_per_s",
        "down_packets_per_s",
    ];
    if seen {
        wire.iter().for_each(|column| share(column, 1.0 / 6.0));
        close("delay_p50_s", 0.01);
        close("loss", 0.0);
        close("reordered", 0.0);
    } else {
        assert!(wire.iter().all(|column| real[*column].is_empty()));
    }
    // Without a process that says when it heard, nobody knows.
    assert!(real["reconnect_s"].is_empty());
    for process in ["operator_cpu", "robot_cpu"] {
        let cores = number(real, process);
        println!("{process}: {cores}");
        // The robot steps an arm a thousand times a second; both have a few threads.
        assert!(cores > 0.0 && cores < 4.0, "{process}: {cores}");
        assert!(ours[process].is_empty() && hold[process].is_empty());
    }
    // What is predicted from the recording alone is no matter of the ground.
    assert_eq!(ours["predicted_200ms_m"], real["predicted_200ms_m"]);
}

#[test]
fn the_grounds_agree() {
    let _alone = alone();
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    std::fs::write(dir.join("plan.toml"), PLAN).unwrap();
    let there = rows(dir, "virtual");
    agree(&there, &rows(dir, "loopback"), "loopback", true);

    // Another ground's results are not gone on with.
    let mixed = Command::new(env!("CARGO_BIN_EXE_telemime"))
        .current_dir(dir)
        .args(["experiment", "plan.toml", "-o", "loopback"])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&mixed.stderr);
    assert!(
        !mixed.status.success() && said.contains("nothing is overwritten"),
        "{said}"
    );

    let kernel = experiment(dir, "netns");
    if kernel.status.code() == Some(3) {
        crate::data::skipped(format_args!("netem was not compared: {}", lacks(&kernel)));
        return;
    }
    agree(&there, &rows(dir, "netns"), "netns", false);
}

/// What the host lacks, in one line.
fn lacks(done: &Output) -> String {
    let said = String::from_utf8_lossy(&done.stderr);
    assert_eq!(said.lines().count(), 1, "{said}");
    assert!(said.contains("the ground netns needs"), "{said}");
    said.trim().to_owned()
}

/// Where the kernel has no netem there may still be namespaces, and a wire between them.
#[test]
fn two_namespaces_and_a_wire_agree_with_the_virtual_ground() {
    let _alone = alone();
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    std::fs::write(dir.join("plan.toml"), PLAN.replace("delay 60ms", "perfect")).unwrap();
    let there = rows(dir, "virtual");
    let tried = experiment(dir, "netns");
    if tried.status.code() == Some(3) {
        crate::data::skipped(format_args!("namespaces were not tried: {}", lacks(&tried)));
        return;
    }
    agree(&there, &rows(dir, "netns"), "netns", false);
    let left = Command::new("ip").args(["netns", "list"]).output().unwrap();
    let left = String::from_utf8_lossy(&left.stdout).into_owned();
    assert!(!left.contains("telemime-"), "left behind: {left}");

    let traced = PLAN.replace("delay 60ms", "delay 60ms outage 1s..2s");
    std::fs::write(dir.join("plan.toml"), traced).unwrap();
    let refused = experiment(dir, "netns");
    assert_eq!(refused.status.code(), Some(1));
}
