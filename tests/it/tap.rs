//! An input's latency from taps: known latencies are found, and what says nothing is refused.

use std::io::{BufRead, BufReader, Read, Write};
use std::process::{Command, Stdio};

use nalgebra::Vector3;
use telemime_operator::demonstration::{Demonstration, Sample};
use telemime_operator::tap::{TapError, latency, stops};
use telemime_sim::hand::{swing, taps};

use crate::data::skipped;
use crate::processes::alone;

type Samples = Vec<(f64, Vector3<f64>)>;

/// What a sensor `late_s` behind delivers of twelve taps, and when a finger pressed, `jitter_s` off (RMS).
fn tapped(seed: u64, late_s: f64, jitter_s: f64) -> (Samples, Vec<f64>) {
    // A deterministic spread of mean 0 and deviation 1.
    const OFF: [f64; 12] = [
        -0.4, 1.3, 0.2, -1.1, 0.7, -0.2, 1.6, -1.5, 0.4, -0.9, -1.2, 1.1,
    ];
    let (samples, touched) = taps(seed, OFF.len());
    let shift = |(t_s, x): (f64, [f64; 3])| (t_s + late_s, x.into());
    let pressed = touched.iter().enumerate();
    (
        samples.into_iter().map(shift).collect(),
        pressed
            .map(|(i, t)| t + jitter_s * OFF[(i + seed as usize) % OFF.len()])
            .collect(),
    )
}

#[test]
fn every_tap_is_found_and_when_it_was() {
    let mut errors = Vec::new();
    for seed in 0..20 {
        let (samples, touched) = tapped(seed, 0.0, 0.0);
        let found = stops(&samples);
        // What merely looks like one does not matter: it has no tap.
        assert!(found.len() < 2 * touched.len(), "seed {seed}");
        for tap in &touched {
            let off = found.iter().map(|stop| (stop - tap).abs());
            errors.push(off.fold(f64::INFINITY, f64::min));
        }
    }
    errors.sort_by(f64::total_cmp);
    let at = |share: f64| errors[(share * (errors.len() - 1) as f64) as usize];
    println!(
        "single stops at 30 Hz: half within {:.1} ms, 90 % within {:.1} ms, all within {:.1} ms",
        at(0.5) * 1e3,
        at(0.9) * 1e3,
        at(1.0) * 1e3
    );
    assert!(at(0.5) < 0.006 && at(0.9) < 0.02, "{} {}", at(0.5), at(0.9));
}

#[test]
fn a_known_latency_is_found_within_its_own_bound() {
    let (mut within, mut all, mut worst) = (0, 0, 0.0_f64);
    for seed in 0..20 {
        for (late_s, jitter_s) in [(0.0, 0.005), (0.033, 0.0), (0.062, 0.012), (0.25, 0.015)] {
            let (samples, pressed) = tapped(seed, late_s, jitter_s);
            let found = latency(&samples, &pressed).unwrap();
            let off_s = (found.latency_s - late_s).abs();
            all += 1;
            within += u32::from(off_s <= found.bound_s);
            worst = worst.max(off_s);
            assert!(found.used >= 8 && found.taps == 12, "{found:?}");
            assert!(
                off_s < 0.006 + jitter_s,
                "{late_s} s, {jitter_s} s: {found:?}"
            );
        }
    }
    println!(
        "{within} of {all} within their bound; worst {:.1} ms off",
        worst * 1e3
    );
    assert!(10 * within >= 8 * all, "{within} of {all}");
}

#[test]
fn taps_missed_and_presses_forgotten_do_not_count() {
    let (samples, mut pressed) = tapped(3, 0.08, 0.008);
    pressed.remove(7);
    pressed.remove(2);
    // Somebody pressed for nothing.
    pressed.insert(4, pressed[3] + 0.7);
    let found = latency(&samples, &pressed).unwrap();
    assert!((found.latency_s - 0.08).abs() < 0.01, "{found:?}");
    assert!(found.used >= 8 && found.used < found.taps);
}

#[test]
fn what_says_nothing_is_refused_and_says_why() {
    let (samples, pressed) = tapped(5, 0.05, 0.0);
    let refused = |samples: &Samples, pressed: &[f64]| latency(samples, pressed).unwrap_err();
    assert_eq!(
        refused(&samples, &pressed[..4]),
        TapError::FewTaps { taps: 4 }
    );
    let mut backwards = pressed.clone();
    backwards.swap(3, 4);
    assert!(matches!(
        refused(&samples, &backwards),
        TapError::Unordered { number: 5, .. }
    ));
    backwards[0] = f64::NAN;
    assert!(matches!(
        refused(&samples, &backwards),
        TapError::Unordered { number: 1, .. }
    ));
    // A hand that waves does not stop abruptly.
    let waves = swing(3, 0)
        .into_iter()
        .map(|(t, x)| (t, x.into()))
        .collect();
    assert!(matches!(
        refused(&waves, &pressed),
        TapError::FewStops { .. }
    ));
    assert!(matches!(
        refused(&Vec::new(), &pressed),
        TapError::FewStops { stops: 0 }
    ));
    // Another clock.
    let elsewhere: Vec<f64> = pressed.iter().map(|t| t + 1000.0).collect();
    let error = refused(&samples, &elsewhere);
    assert!(
        matches!(error, TapError::Unmatched { matched: 0, .. }),
        "{error}"
    );
    // Pressed at random.
    let random: Vec<f64> = (0..12).map(|i| 0.31 + 1.37 * f64::from(i)).collect();
    let error = refused(&samples, &random);
    assert!(
        matches!(
            error,
            TapError::Unmatched { .. } | TapError::Scattered { .. } | TapError::Ambiguous { .. }
        ),
        "{error}"
    );
    // The presses come 40 ms after the recording has the taps.
    let early: Vec<f64> = pressed.iter().map(|t| t + 0.09).collect();
    assert!(matches!(refused(&samples, &early), TapError::Early { .. }));
}

#[test]
fn the_command_reads_files_of_any_clock() {
    let folder = tempfile::tempdir().unwrap();
    let (samples, pressed) = tapped(8, 0.062, 0.005);
    // Seconds since 1970: only differences mean something, but they must be kept.
    let zero = 1.7e9;
    let mut csv = String::from("t,x,y,z\n");
    for (t, x) in &samples {
        csv.push_str(&format!("{:.6},{},{},{}\n", zero + t, x.x, x.y, x.z));
    }
    let mut list = String::from("# by hand\n");
    for t in &pressed {
        list.push_str(&format!("{:.6}\n", zero + t));
    }
    let (recording, at) = (folder.path().join("taps.csv"), folder.path().join("at.txt"));
    std::fs::write(&recording, csv).unwrap();
    std::fs::write(&at, &list).unwrap();
    let run = |at: &std::path::Path| {
        Command::new(env!("CARGO_BIN_EXE_telemime"))
            .args(["tap", "--json", "--at"])
            .args([at, &recording])
            .output()
            .unwrap()
    };
    let output = run(&at);
    assert!(output.status.success(), "{output:?}");
    let found: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let latency_ms = found["latency_ms"].as_f64().unwrap();
    assert!((latency_ms - 62.0).abs() < 6.0, "{found}");
    std::fs::write(&at, list + "soon\n").unwrap();
    let output = run(&at);
    assert_eq!(output.status.code(), Some(1));
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("line 14") && said.contains("soon"), "{said}");
    let output = run(&folder.path().join("none"));
    assert_eq!(output.status.code(), Some(1));
}

/// A synthetic tracker that sends at true speed, and a person who presses Enter on a terminal when the finger touches: both as a user has them, but
/// that the person is never late, and sees the hand 0.1 s before the tracker tells it.
#[test]
fn live_from_what_a_tracker_sends_and_enter_on_a_terminal() {
    const EARLY_S: f64 = 0.1;
    let there_is = |program: &str| {
        let found = Command::new(program).arg("--version").output();
        found.is_ok_and(|out| out.status.success())
    };
    if !there_is("script") || !there_is("mkfifo") {
        skipped("there is no `script` to make a terminal");
        return;
    }
    let _alone = alone();
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let (samples, touched) = taps(2, 6);
    let recording: Vec<_> = samples
        .into_iter()
        .map(|(t_s, x)| Sample::at(t_s, x.into()))
        .collect();
    let csv = Demonstration::from_samples(path("taps.csv"), &recording).unwrap();
    std::fs::write(path("taps.csv"), csv.to_csv()).unwrap();
    let made = Command::new("mkfifo")
        .arg(path("samples"))
        .status()
        .unwrap();
    assert!(made.success());

    // `script` gives its command a terminal, and types there what comes on its own standard input.
    let command = "exec \"$PROGRAM\" tap - --live --count 6 --json < samples > found.json";
    let mut terminal = Command::new("script")
        .args(["--quiet", "--return", "--command", command, "/dev/null"])
        .current_dir(folder.path())
        .env("PROGRAM", env!("CARGO_BIN_EXE_telemime"))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut sender = Command::new(env!("CARGO_BIN_EXE_telemime"))
        .args(["send", "taps.csv", "--rest", "0"])
        .current_dir(folder.path())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut tracker = std::fs::File::create(path("samples")).unwrap();
    let mut keys = terminal.stdin.take().unwrap();
    let mut presses = touched.iter().peekable();
    let mut said = String::new();
    for line in BufReader::new(sender.stdout.take().unwrap()).lines() {
        let line = line.unwrap();
        let frame: serde_json::Value = serde_json::from_str(&line).unwrap();
        while presses
            .next_if(|at| frame["t"].as_f64().unwrap() + EARLY_S >= **at)
            .is_some()
        {
            keys.write_all(b"\n").unwrap();
        }
        // It ends by itself a second after the last press.
        if writeln!(tracker, "{line}").is_err() {
            break;
        }
    }
    drop(tracker);
    let mut screen = terminal.stdout.take().unwrap();
    screen.read_to_string(&mut said).unwrap();
    drop(keys);
    let status = terminal.wait().unwrap();
    let _ = sender.kill();
    sender.wait().unwrap();
    assert!(status.success(), "{status}: {said}");
    assert!(said.contains("6 of 6"), "{said}");
    let text = std::fs::read_to_string(path("found.json")).unwrap();
    let found: serde_json::Value = serde_json::from_str(&text).unwrap();
    // The press comes with a sample, half of their distance late on average.
    let expected_ms = 1e3 * (EARLY_S - 0.5 / 30.0);
    let off_ms = found["latency_ms"].as_f64().unwrap() - expected_ms;
    println!("{found}");
    assert!(off_ms.abs() < 40.0, "{found}");
}
