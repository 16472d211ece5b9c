//! The codecs on real recordings.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use crate::data::needs;
use nalgebra::Vector3;
use telemime_protocol::checkpoint::path::{PathDecoder, PathEncoder, TICK_NS};
use telemime_protocol::checkpoint::select;
use telemime_protocol::time::Stamp;

type Recording = (Vec<f64>, Vec<Vector3<f64>>);

fn folder(set: &str) -> Option<PathBuf> {
    needs(&format!("data/demos/{set}"))
}

fn recordings(dir: &Path) -> Vec<Recording> {
    let entries = std::fs::read_dir(dir).expect("the folder");
    let mut files: Vec<_> = entries.map(|e| e.expect("an entry").path()).collect();
    files.sort();
    files
        .iter()
        .map(|file| {
            let mut reader = csv::Reader::from_path(file).expect("a CSV file");
            let rows = reader.records().map(|r| {
                let r = r.expect("a row");
                let n = |i: usize| r[i].parse::<f64>().expect("a number");
                (n(0), Vector3::new(n(1), n(2), n(3)))
            });
            rows.unzip()
        })
        .collect()
}

/// Knots a second, and the largest error at any sample, m.
fn live(recordings: &[Recording], bound_m: f64) -> (f64, f64) {
    let (mut knots, mut duration_s, mut worst_m) = (0, 0.0, 0.0f64);
    for (t, x) in recordings {
        let mut encoder = PathEncoder::new(bound_m).expect("a bound");
        let mut decoder = PathDecoder::new(encoder.grid(), 4096);
        let stamps: Vec<_> = t.iter().map(|t| Stamp::from_secs_f64(*t)).collect();
        for (stamp, x) in stamps.iter().zip(x) {
            if let Some(knot) = encoder.push(*stamp, *x).expect("an ordered sample") {
                decoder.append(&knot).expect("a knot that fits");
            }
        }
        if let Some(knot) = encoder.flush() {
            decoder.append(&knot).expect("a knot that fits");
        }
        knots += decoder.knots().len();
        duration_s += t[t.len() - 1] - t[0];
        for (stamp, x) in stamps.iter().zip(x) {
            let tick = (stamp.0 as f64 / TICK_NS as f64).round() as i64;
            let decoded = decoder
                .eval(Stamp(tick * TICK_NS))
                .expect("a covered sample");
            worst_m = worst_m.max((decoded.x - x).norm());
        }
    }
    (
        f64::from(u32::try_from(knots).expect("few")) / duration_s,
        worst_m,
    )
}

/// The study's figures (knots a second) are 18, 12.6 and 6.9 for the wave at 10, 20 and 40 mm, 1.4 for
/// pouring at 1 mm and 6 for the free arm at 10 mm; coarser steps take more of them there, and fewer bytes.
#[test]
fn the_live_path_holds_its_bound_with_few_knots() {
    for (set, cases) in [
        (
            "utd_mhad/a03_wave",
            &[(0.010, 19.0), (0.020, 13.5), (0.040, 8.0)][..],
        ),
        ("robottasks/pouring", &[(0.001, 1.8)][..]),
        ("vr_hvr_ik/free_arm", &[(0.010, 7.5)][..]),
    ] {
        let Some(dir) = folder(set) else { continue };
        let recordings = recordings(&dir);
        for &(bound_m, most) in cases {
            let (knots_per_s, worst_m) = live(&recordings, bound_m);
            println!("{set} at {bound_m} m: {knots_per_s:.2} knots/s, worst {worst_m:.6} m");
            assert!(worst_m <= bound_m, "{set}: {worst_m} m at {bound_m} m");
            assert!(knots_per_s <= most, "{set} at {bound_m} m: {knots_per_s}/s");
        }
    }
}

#[test]
fn a_plan_holds_its_bound_on_real_motions() {
    // The wave is 30 Hz with centimetres of tracking noise: below that, points encode noise.
    for (set, bound_m, most) in [
        ("utd_mhad/a03_wave", 0.02, 0.65),
        ("utd_mhad/a03_wave", 0.04, 0.45),
        ("robottasks/pouring", 0.001, 0.05),
        ("vr_hvr_ik/free_arm", 0.01, 0.15),
    ] {
        let Some(dir) = folder(set) else { continue };
        let (mut points, mut samples) = (0, 0);
        for (t, x) in recordings(&dir).iter().take(6) {
            let plan = select::bounded(t, x, bound_m).expect("a plan");
            let spline = plan.spline().expect("a curve");
            let (start_s, end_s) = spline.span_s();
            for (t, x) in t.iter().zip(x) {
                let decoded = spline.eval(t.clamp(start_s, end_s)).expect("inside");
                assert!((decoded.x - x).norm() <= bound_m);
            }
            points += plan.len();
            samples += t.len();
        }
        println!("{set} at {bound_m} m: {points} checkpoints of {samples} samples");
        assert!((points as f64) < most * samples as f64);
    }
}

fn codec(args: &[&str]) -> Output {
    let telemime = Command::new(env!("CARGO_BIN_EXE_telemime"))
        .arg("codec")
        .args(args)
        .output();
    telemime.expect("telemime runs")
}

fn refusal(args: &[&str]) -> String {
    let out = codec(args);
    assert_eq!(out.status.code(), Some(1), "{args:?}");
    let text = String::from_utf8(out.stderr).expect("text");
    assert_eq!(text.trim_end().lines().count(), 1, "{text}");
    text
}

fn csv(rows: impl IntoIterator<Item = [f64; 4]>) -> String {
    let rows = rows
        .into_iter()
        .map(|[t, x, y, z]| format!("{t},{x},{y},{z}\n"));
    "t,x,y,z\n".to_owned() + &rows.collect::<String>()
}

/// Bounds and recordings that make no sense are refused in one line; a hand at rest is a motion of two points.
#[test]
fn the_command_refuses_nonsense_and_takes_rest() {
    let dir = tempfile::tempdir().expect("a folder");
    let write = |name: &str, text: String| {
        let path = dir.path().join(name);
        std::fs::write(&path, text).expect("a file");
        path.to_str().expect("a name").to_owned()
    };
    let row = |i: u32| [f64::from(i) * 0.02, 0.1 * f64::from(i % 7), 0.0, 1.0];
    let good = write("good.csv", csv((0..50).map(row)));
    let rest = write(
        "rest.csv",
        csv((0..50).map(|i| [row(i)[0], 0.3, -0.2, 1.0])),
    );
    let one = write("one.csv", csv((0..1).map(row)));
    let back = write("back.csv", csv((0..50).rev().map(row)));
    let nan = write(
        "nan.csv",
        csv((0..50).map(|i| [row(i)[0], f64::NAN, 0.0, 0.0])),
    );
    assert!(refusal(&[&good, "--bound", "0"]).contains("--bound"));
    assert!(refusal(&[&good, "--bound", "NaN"]).contains("--bound"));
    assert!(refusal(&[&good, "--bound", "1e-9"]).contains("below the quantiser"));
    assert!(refusal(&[&good, "--turn-bound", "2"]).contains("--turn-bound"));
    assert!(refusal(&[&good, "--points", "1"]).contains("at least 2"));
    assert!(refusal(&[&one]).contains("one.csv"));
    assert!(refusal(&[&back]).contains("back.csv"));
    assert!(refusal(&[&nan]).contains("nan.csv"));
    assert!(refusal(&["nowhere.csv"]).contains("nowhere.csv"));

    let out = codec(&[&rest, "--json"]);
    assert!(out.status.success());
    let study: serde_json::Value = serde_json::from_slice(&out.stdout).expect("one JSON object");
    let ours = &study["same_error"][0];
    assert_eq!(
        (&ours["coder"], &ours["points"]),
        (&"batch".into(), &2.into())
    );
    assert_eq!(ours["r_squared"], serde_json::json!([null, null, null]));
    assert!(study["orientation"].is_null());
}

/// At equal largest error; the figures of all recordings are in docs/codec.md.
#[test]
fn ours_takes_fewer_bytes_than_the_deadbands() {
    for (set, bound, bits, whole) in [
        ("utd_mhad/a03_wave", "0.02", 1.15, 1.6),
        ("robottasks/pouring", "0.001", 1.9, 3.5),
        ("vr_hvr_ik/free_arm", "0.01", 1.5, 2.5),
    ] {
        let Some(dir) = folder(set) else { continue };
        let mut files: Vec<_> = std::fs::read_dir(dir)
            .expect("the folder")
            .map(|e| e.expect("an entry").path().display().to_string())
            .collect();
        files.sort();
        let mut args: Vec<&str> = files.iter().take(3).map(String::as_str).collect();
        args.extend(["--bound", bound, "--json"]);
        let out = codec(&args);
        assert!(out.status.success());
        let study: serde_json::Value = serde_json::from_slice(&out.stdout).expect("JSON");
        let rows = study["same_error"].as_array().expect("rows");
        let of = |coder: &str, what: &str| {
            let row = rows.iter().find(|r| r["coder"] == coder).expect(coder);
            assert!(
                row["largest_error_m"].as_f64() <= bound.parse().ok(),
                "{row}"
            );
            row[what].as_f64().expect(what)
        };
        let ratio = |what| of("deadband-linear", what) / of("batch", what);
        println!(
            "{set}: {:.2}, {:.2} in whole bytes",
            ratio("bytes"),
            ratio("whole_bytes")
        );
        assert!(
            ratio("bytes") > bits && ratio("whole_bytes") > whole,
            "{set}"
        );
        let raw = study["raw_bytes"].as_f64().expect("a number") / of("live", "bytes");
        assert!(raw > 3.5, "{set}: live {raw}");
    }
}
