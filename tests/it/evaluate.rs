//! `telemime evaluate` as a user meets it, on generated and on recorded hands.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;
use telemime_sim::hand::{swing, swing_with_wrist};

use crate::data::needs;

const UTD: [&str; 4] = [
    "a01_swipe_left",
    "a03_wave",
    "a09_circle_cw",
    "a15_tennis_swing",
];

fn evaluate(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_telemime"))
        .arg("evaluate")
        .args(args)
        .output()
        .unwrap()
}

fn json(args: &[&str]) -> Value {
    let out = evaluate(&[args, &["--json"]].concat());
    let error = String::from_utf8_lossy(&out.stderr).into_owned();
    assert!(out.status.success(), "{error}");
    serde_json::from_slice(&out.stdout).unwrap()
}

/// What a refusal says, in its one line.
fn refusal(args: &[&str]) -> String {
    let out = evaluate(args);
    assert!(!out.status.success(), "{args:?}");
    assert!(out.stdout.is_empty(), "{args:?}");
    String::from_utf8(out.stderr).unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn csv(samples: &[(f64, [f64; 3])]) -> String {
    let rows = samples
        .iter()
        .map(|(t, [x, y, z])| format!("{t},{x},{y},{z}\n"));
    "t,x,y,z\n".to_owned() + &rows.collect::<String>()
}

/// `people` who swing `times` each, as `swing_PERSON_TRIAL.csv`.
fn swings(dir: &Path, people: u64, times: u32) -> PathBuf {
    let dir = dir.join("swing");
    std::fs::create_dir_all(&dir).unwrap();
    for person in 0..people {
        for index in 0..times {
            let file = dir.join(format!("swing_p{person}_t{index}.csv"));
            std::fs::write(file, csv(&swing(person, index))).unwrap();
        }
    }
    dir
}

/// The cell of an expert at a horizon.
fn cell<'a>(section: &'a Value, name: &str, ms: f64, report: &Value) -> &'a Value {
    let horizons = report["horizons_ms"].as_array().unwrap();
    let at = horizons
        .iter()
        .position(|h| h.as_f64() == Some(ms))
        .unwrap();
    let experts = section["experts"].as_array().unwrap();
    let row = experts.iter().find(|row| row["name"] == name);
    &row.unwrap_or_else(|| panic!("no expert {name}"))["horizons"][at]
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value}"))
}

fn ratio(report: &Value, name: &str, ms: f64) -> f64 {
    number(&cell(&report["position"], name, ms, report)["ratio"])
}

/// The rows of a scheme with a largest silence.
fn rows<'a>(report: &'a Value, name: &str, silence_ms: Option<f64>) -> Vec<&'a Value> {
    let rows = report["dual"]["rows"].as_array().unwrap().iter();
    rows.filter(|row| row["name"] == name && row["silence_ms"].as_f64() == silence_ms)
        .collect()
}

#[test]
fn generated_swings_are_predicted_and_the_report_says_so() {
    let dir = tempfile::tempdir().unwrap();
    let swings = swings(dir.path(), 2, 3);
    let (figure, failures) = (dir.path().join("all.svg"), dir.path().join("bad.png"));
    let args = [
        text(&swings),
        "--horizons",
        "50,100,200",
        "--figure",
        text(&figure),
        "--failures",
        text(&failures),
    ];
    let report = json(&args);
    assert_eq!(report["protocol"], "same-person");
    assert_eq!(
        report["position"]["performances"].as_array().unwrap().len(),
        6
    );
    assert_eq!(report["not_predicted"], 0);
    assert!(report["orientation"].is_null());
    assert!((ratio(&report, "hold", 100.0) - 1.0).abs() < 1e-12);
    let own = cell(&report["position"], "guarded", 100.0, &report);
    assert!(number(&own["ratio"]) < 0.6, "{own}");
    assert!(number(&own["lag_ms"]).abs() < 40.0, "{own}");
    let held = number(&cell(&report["position"], "hold", 200.0, &report)["lag_ms"]);
    assert!(
        (held - 200.0).abs() < 5.0,
        "holding is late by the horizon: {held} ms"
    );
    let coverage: Vec<f64> = own["coverage"]
        .as_array()
        .unwrap()
        .iter()
        .map(number)
        .collect();
    assert!(coverage.is_sorted() && coverage[1] > 0.75, "{coverage:?}");
    // Everything is thirty a second, and a bound saves messages.
    let everything = number(&report["dual"]["rows"][0]["messages_per_s"]);
    assert!((29.0..33.0).contains(&everything), "{everything}");
    let sessions = rows(&report, "guarded", Some(200.0));
    let rates: Vec<f64> = sessions
        .iter()
        .map(|row| number(&row["messages_per_s"]))
        .collect();
    assert!(
        rates
            .iter()
            .all(|rate| (4.0..everything + 1.0).contains(rate)),
        "{rates:?}"
    );
    assert!(number(&sessions[1]["ratio"]) < 0.6, "{}", sessions[1]);
    assert!(std::fs::read(&figure).unwrap().starts_with(b"<svg"));
    assert!(std::fs::read(&failures).unwrap().starts_with(b"\x89PNG"));
}

#[test]
fn the_report_does_not_depend_on_the_number_of_threads() {
    let dir = tempfile::tempdir().unwrap();
    let swings = swings(dir.path(), 2, 2);
    let run = |threads: &str| {
        let out = Command::new(env!("CARGO_BIN_EXE_telemime"))
            .args([
                "evaluate",
                text(&swings),
                "--horizons",
                "100",
                "--json",
                "--seed",
                "3",
            ])
            .args(["--protocol", "leave-one-out", "--arm"])
            .env("RAYON_NUM_THREADS", threads)
            .output()
            .unwrap();
        assert!(out.status.success());
        out.stdout
    };
    let one = run("1");
    assert_eq!(one, run("3"));
    let report: Value = serde_json::from_slice(&one).unwrap();
    assert_eq!(report["arm"]["driven"], 4);
}

#[test]
fn other_people_and_other_motion_are_told_apart() {
    let dir = tempfile::tempdir().unwrap();
    let swings = swings(dir.path(), 2, 2);
    let strange = dir.path().join("still");
    std::fs::create_dir(&strange).unwrap();
    // To and fro along another axis, eight times as fast.
    let other = |i: u32| {
        (
            f64::from(i) / 30.0,
            [0.0, 0.0, 0.3 * (f64::from(i) * 0.6).sin()],
        )
    };
    let other: Vec<_> = (0..60).map(other).collect();
    std::fs::write(strange.join("other_x_1.csv"), csv(&other)).unwrap();
    let report = json(&[
        text(&swings),
        "--protocol",
        "cross",
        "--horizons",
        "100",
        "--off-model",
        text(&strange),
        text(&swings),
    ]);
    assert_eq!(
        report["skills"], 3,
        "one for each person left out, and one before strange motion"
    );
    let off = &report["off_model"];
    // The swings themselves are what was learned.
    assert_eq!(off["groups"].as_array().unwrap().len(), 1);
    assert_eq!(off["groups"][0], "swing learned, still performed");
    let (on, off) = (&report["position"]["novelty"], &off["novelty"]);
    assert!(
        number(&off[0]) > 3.0 * number(&on[0]),
        "{on} on the model, {off} off it"
    );
}

#[test]
fn orientations_are_predicted_where_recordings_have_them() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("turning");
    std::fs::create_dir(&folder).unwrap();
    for index in 0..3 {
        let rows = swing_with_wrist(5, index).into_iter().map(|p| {
            let ([x, y, z], [w, i, j, k]) = (p.x, p.q);
            format!("{},{x},{y},{z},{w},{i},{j},{k}\n", p.t_s)
        });
        let text = "t,x,y,z,qw,qx,qy,qz\n".to_owned() + &rows.collect::<String>();
        std::fs::write(folder.join(format!("{index}.csv")), text).unwrap();
    }
    let report = json(&[text(&folder), "--horizons", "100"]);
    let turns = &report["orientation"];
    assert_eq!(turns["unit"], "deg");
    let own = number(&cell(turns, "guarded", 100.0, &report)["ratio"]);
    assert!(own < 0.7, "{own}");
    assert!(cell(turns, "guarded", 100.0, &report)["jerk"].is_null());
}

#[test]
fn what_cannot_be_evaluated_is_refused_with_a_remedy() {
    let dir = tempfile::tempdir().unwrap();
    let swings = swings(dir.path(), 1, 2);
    let folder = |name: &str, files: &[(&str, String)]| {
        let folder = dir.path().join(name);
        std::fs::create_dir(&folder).unwrap();
        for (file, text) in files {
            std::fs::write(folder.join(file), text).unwrap();
        }
        folder
    };
    let good = csv(&swing(1, 0));
    let short = "t,x,y,z\n0,0,0,0\n".to_owned();
    let flat = "t,x,y\n0,0,0\n".to_owned();
    let hole = good.clone() + "60,0,0,0\n";
    for (folder, wanted) in [
        (folder("none", &[]), "none"),
        (
            folder("alone", &[("a_b_1.csv", good.clone())]),
            "one recording",
        ),
        (
            folder(
                "short",
                &[("a_b_1.csv", good.clone()), ("a_b_2.csv", short)],
            ),
            "a_b_2.csv",
        ),
        (
            folder("flat", &[("a_b_1.csv", good.clone()), ("a_b_2.csv", flat)]),
            "column",
        ),
        (
            folder("hole", &[("a_b_1.csv", good.clone()), ("a_b_2.csv", hole)]),
            "a_b_2.csv",
        ),
        (
            folder(
                "once",
                &[("w_ann_1.csv", good.clone()), ("w_bob_1.csv", good.clone())],
            ),
            "--group-by",
        ),
    ] {
        let said = refusal(&[text(&folder)]);
        assert!(said.contains(wanted), "{}: {said}", folder.display());
    }
    assert!(refusal(&[text(&swings), "--protocol", "cross"]).contains("one person"));
    for (horizons, wanted) in [("900", "800 ms"), ("0", "800 ms"), ("soon", "milliseconds")] {
        let said = refusal(&[text(&swings), "--horizons", horizons]);
        assert!(said.contains(wanted), "{said}");
    }
    assert!(refusal(&[text(&swings), "--group-by", "*"]).contains("{}"));
    assert!(refusal(&[text(&swings), "--figure", "all.gif"]).contains(".svg"));
    assert!(refusal(&["no such folder"]).contains("no such folder"));
    assert!(refusal(&[text(&swings), "--rate", "64kbit"]).contains("--rate"));
}

/// The study's figures on recorded hands; the bounds leave room for other machines' seeds, not for another
/// algorithm.
#[test]
fn recorded_gestures_meet_the_aims() {
    let Some(data) = needs("data/demos/utd_mhad") else {
        return;
    };
    let dirs: Vec<String> = UTD
        .iter()
        .map(|d| data.join(d).to_str().unwrap().to_owned())
        .collect();
    let mut args: Vec<&str> = dirs.iter().map(String::as_str).collect();
    args.extend([
        "--horizons",
        "100,200,300",
        "--jitter",
        "0ms",
        "--loss",
        "0",
    ]);
    let report = json(&args);
    for (ms, bounds) in [
        (100.0, [0.40, 0.40, 0.40]),
        (200.0, [0.36, 0.38, 0.38]),
        (300.0, [0.34, 0.36, 0.36]),
    ] {
        let names = ["mixture alone", "guard alone", "guarded"];
        for (name, bound) in names.into_iter().zip(bounds) {
            let ratio = ratio(&report, name, ms);
            println!("{name}, {ms} ms: {ratio:.3}");
            assert!(ratio < bound, "{name}, {ms} ms: {ratio}");
        }
    }
    assert_eq!(report["position"]["above"].as_array().unwrap().len(), 0);
    // Messages a second and error, as issue 5 wants them.
    for (silence, rate, error) in [(Some(200.0), 9.0, 0.48), (Some(300.0), 5.0, 0.53)] {
        let rows = rows(&report, "guarded", silence);
        let good = rows
            .iter()
            .filter(|row| number(&row["messages_per_s"]) <= rate);
        let best = good
            .map(|row| number(&row["ratio"]))
            .fold(f64::INFINITY, f64::min);
        println!("silence {silence:?}: {best:.3} at {rate} messages/s or fewer");
        assert!(best < error, "{silence:?}: {best}");
    }
}
