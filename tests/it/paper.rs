//! `telemime paper` as a user runs it.

use std::process::{Command, Output};

use crate::data::needs;
use serde_json::Value;

fn paper(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_telemime"))
        .arg("paper")
        .args(args)
        .output()
        .expect("the built binary runs")
}

/// The one JSON object on stdout.
fn tasks(output: &Output) -> Vec<Value> {
    assert!(output.status.success(), "{output:?}");
    let object: Value = serde_json::from_slice(&output.stdout).expect("exactly one JSON object");
    object["tasks"].as_array().expect("tasks").clone()
}

fn r2(block: &Value) -> [f64; 2] {
    serde_json::from_value(block["r2"].clone()).expect("two numbers")
}

#[test]
fn its_series_give_its_tables_to_three_decimals() {
    let Some(dir) = needs("data/paper") else {
        return;
    };
    let tasks = tasks(&paper(&[
        "--json",
        "--series",
        dir.to_str().expect("UTF-8"),
    ]));
    let [task] = tasks.as_slice() else {
        panic!("one task, not {}", tasks.len())
    };
    assert_eq!(task["name"], "series");
    let reproduced = &task["reproduced"];
    assert_eq!(reproduced["checkpoints"], 14);
    for (table, printed) in [("encoder", [0.625, 0.736]), ("overall", [0.625, 0.722])] {
        let r2 = r2(&reproduced[table]);
        for d in 0..2 {
            assert!(
                (r2[d] - printed[d]).abs() < 0.0005,
                "{table}: {r2:?} for {printed:?}"
            );
        }
    }
    // Ours: fewer points and a bound in time, and better than as many at even distances.
    let ours = &task["ours"];
    assert!(ours["checkpoints"].as_u64() < Some(14));
    assert!(r2(&ours["encoder"])[1] > 0.9995);
    let uniform = &task["baselines"]["uniform_in_time"];
    assert_eq!(uniform["checkpoints"], ours["checkpoints"]);
    assert!(r2(&uniform["encoder"])[1] < r2(&ours["encoder"])[1]);
}

#[test]
fn from_the_formulas_with_a_figure() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let figure = dir.path().join("paper.svg");
    let output = paper(&["--json", "--figure", figure.to_str().expect("UTF-8")]);
    let tasks = tasks(&output);
    let names: Vec<_> = tasks.iter().map(|t| t["name"].clone()).collect();
    assert_eq!(names, ["task1", "task2"]);
    assert!(tasks[0]["published"].is_object() && tasks[1]["published"].is_null());
    for task in &tasks {
        for pipeline in ["reproduced", "ours"] {
            for block in ["learning", "encoder", "overall"] {
                for measure in ["mae", "mse", "r2"] {
                    let values = task[pipeline][block][measure].as_array();
                    assert_eq!(
                        values.map(Vec::len),
                        Some(2),
                        "{pipeline} {block} {measure}"
                    );
                }
            }
        }
        assert!(r2(&task["ours"]["encoder"]).iter().all(|r2| *r2 > 0.9995));
    }
    // Task 1 from nothing but formulas: the printed digits, and no seed farther than 0.001 from them.
    let task = &tasks[0];
    assert_eq!(task["reproduced"]["checkpoints"], 14);
    let published = [
        ("learning", [1.0, 0.98060]),
        ("encoder", [0.62514, 0.73572]),
        ("overall", [0.62514, 0.72158]),
    ];
    for (table, printed) in published {
        let ends: [[f64; 2]; 2] =
            serde_json::from_value(task["spread"][table].clone()).expect("ends");
        let nearest = r2(&task["reproduced"][table]);
        for d in 0..2 {
            assert!(
                (nearest[d] - printed[d]).abs() < 0.0005,
                "{table}: {nearest:?}"
            );
            for end in ends {
                assert!((end[d] - printed[d]).abs() < 0.001, "{table}: {ends:?}");
            }
        }
    }
    assert_eq!(task["spread"]["seeds"], 20);
    // Plain EM: 0.9906 with three components, 0.9971 with the seven that BIC chooses; the ceiling 0.9973.
    for (learning, want) in [
        (&task["plain_em"]["learning"], 0.9906),
        (&task["ours"]["learning"], 0.9971),
        (&task["ceiling"]["learning"], 0.9973),
    ] {
        let got = r2(learning)[1];
        assert!((got - want).abs() < 1e-4, "{got} for {want}");
    }
    let told = String::from_utf8(output.stderr).expect("UTF-8");
    assert!(told.contains("highest of 20 seeds"), "{told}");
    let svg = std::fs::read_to_string(figure).expect("the figure");
    assert!(svg.contains("task 2: x\u{2082} over time"));
}

#[test]
fn bad_input_is_one_line_and_no_figure() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().to_str().expect("UTF-8");
    let figure = dir.path().join("never.png");
    let output = paper(&[
        "--series",
        path,
        "--figure",
        figure.to_str().expect("UTF-8"),
    ]);
    assert!(!output.status.success() && output.stdout.is_empty());
    let told = String::from_utf8(output.stderr).expect("UTF-8");
    assert_eq!(told.lines().count(), 1, "{told}");
    assert!(told.contains("ground_truth.csv"), "{told}");
    assert!(!figure.exists());
}
