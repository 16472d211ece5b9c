//! `telemime select` as a user runs it.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

fn select(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_telemime"))
        .arg("select")
        .args(args)
        .output()
        .expect("the built binary runs")
}

fn object(output: &Output) -> Value {
    assert!(output.status.success(), "{output:?}");
    serde_json::from_slice(&output.stdout).expect("exactly one JSON object")
}

/// One line on stderr.
fn refused(output: &Output) -> String {
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let told = String::from_utf8(output.stderr.clone()).expect("UTF-8");
    assert!(
        output.stdout.is_empty() && told.lines().count() == 1,
        "{told}"
    );
    told
}

/// `count` performances of an arc over the table.
fn write_demos(dir: &Path, count: u32) {
    for n in 0..count {
        let mut text = "t,x,y,z\n".to_owned();
        for i in 0..40 {
            let t = f64::from(i) / 30.0;
            let size = 0.3 + 0.01 * f64::from(n);
            text += &format!("{t},{},{},{}\n", size * t, size * (3.0 * t).sin(), 0.2);
        }
        std::fs::write(dir.join(format!("take{n}.csv")), text).expect("written");
    }
}

#[test]
fn the_table_compares_every_kind_and_is_the_same_twice() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    write_demos(dir.path(), 3);
    let path = dir.path().to_str().expect("UTF-8");
    let args = [path, "--components", "1..3", "--json"];
    let output = select(&args);
    let table = object(&output);
    assert_eq!(table["demonstrations"], 3);
    assert_eq!(table["rows"].as_array().map(Vec::len), Some(30));
    let chosen = table["chosen"].as_array().expect("chosen");
    assert_eq!(chosen.len(), 10);
    for kind in chosen {
        for criterion in ["bic", "aic", "held_out", "regression"] {
            assert!(kind[criterion]["components"].is_u64(), "{kind}");
        }
    }
    // z does not vary, which is said.
    let told = String::from_utf8(output.stderr.clone()).expect("UTF-8");
    assert!(told.contains("could not say all"), "{told}");
    assert!(told.contains("telemime learn takes"), "{told}");
    assert_eq!(output.stdout, select(&args).stdout);
}

#[test]
fn one_demonstration_has_nothing_to_hold_out() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    write_demos(dir.path(), 1);
    let table = object(&select(&[
        dir.path().to_str().expect("UTF-8"),
        "--components",
        "2",
        "--json",
    ]));
    assert!(table["rows"][0]["held_out"].is_null());
    assert!(table["chosen"][0]["held_out"].is_null());
}

#[test]
fn bad_input_is_one_line_and_wrong_usage_is_two() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().to_str().expect("UTF-8");
    assert!(refused(&select(&[path])).contains(path));
    assert!(refused(&select(&["/no/such/folder"])).contains("/no/such/folder"));
    for wrong in [
        &["--components", "0..3", path][..],
        &[],
        &[path, "--function"],
    ] {
        assert_eq!(select(wrong).status.code(), Some(2), "{wrong:?}");
    }
}
