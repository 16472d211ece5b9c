//! A tracked hand that drives, as users start it: real processes, real sockets, and the sender of docs/input.md.

use std::path::Path;
use std::process::{Command, Stdio};

use rustix::process::Signal;

use crate::processes::{Process, Stage, alone};

/// An operator that follows `input`.
pub(crate) fn operator(stage: &Stage, addr: &str, input: &[&str]) -> Process {
    let config = format!(
        "connect = {addr:?}\nidentity = {:?}\npeer = {:?}\nlearn = [{:?}]\npatience_s = 5.0\n",
        stage.text("operator.key"),
        stage.fingerprint("robot"),
        stage.text("swing"),
    );
    std::fs::write(stage.path("operator.toml"), config).unwrap();
    let config = stage.text("operator.toml");
    let first = ["operator", "--config", &config, "--json"];
    Process::start(&[&first, input].concat())
}

/// The Python of docs/input.md.
fn documented_sender() -> String {
    let doc = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/input.md");
    let text = std::fs::read_to_string(doc).unwrap();
    let code = text.split("```python\n").nth(1).unwrap();
    let code = code.split("```").next().unwrap().to_owned();
    assert!(code.lines().count() <= 12, "it has grown");
    code
}

#[test]
fn the_documented_sender_drives_the_arm_by_udp_and_its_end_lets_go() {
    if !Command::new("python3")
        .arg("--version")
        .stdout(Stdio::null())
        .status()
        .is_ok_and(|s| s.success())
    {
        crate::data::skipped("no python3 here; no sender has run");
        return;
    }
    let _alone = alone();
    let stage = Stage::new();
    let (robot, addr) = stage.robot();
    let operator = operator(&stage, &addr, &["--input", "udp:0"]);
    let at = operator.event("input")["source"]
        .as_str()
        .unwrap()
        .to_owned();
    let port = at.rsplit_once(':').unwrap().1;
    operator.event("mapping");
    let code = documented_sender().replace("5005", port);
    assert!(code.contains(port));
    let sender = Command::new("python3").args(["-c", &code]).spawn().unwrap();
    operator.event("engaged");
    let told = |text: &'static str| {
        move |event: &serde_json::Value| event["text"].as_str().unwrap().contains(text)
    };
    let ended = sender.wait_with_output().unwrap();
    assert!(ended.status.success());
    operator.event_where("note", told("the input is lost"));
    robot.event_where("state", |e| e["state"] == "Ready");
    // The daemon stays, and the next sender may drive again.
    let again = Command::new("python3").args(["-c", &code]).spawn().unwrap();
    operator.event_where("note", told("the input is back"));
    operator.event("engaged");
    assert!(again.wait_with_output().unwrap().status.success());
    operator.signal(Signal::INT);
    let done = operator.event("done");
    assert_eq!(done["completed"], true, "{done}");
    assert!(done["input"]["samples"].as_u64().unwrap() > 100, "{done}");
    assert!(done["messages"].as_u64().unwrap() > 10, "{done}");
    assert!(operator.end().0.success());
    robot.signal(Signal::TERM);
    assert!(robot.end().0.success());
}

#[test]
fn a_sent_recording_drives_from_standard_input_and_rubbish_in_it_is_counted() {
    let _alone = alone();
    let stage = Stage::new();
    let (robot, addr) = stage.robot();
    let mut operator = operator(&stage, &addr, &["--input", "-", "--until-end"]);
    operator.event("mapping");
    let sender = Process::start(&[
        "send",
        &stage.text("unseen.csv"),
        "--engage",
        "--rest",
        "0.5",
    ]);
    operator.types("rubbish");
    let mut lines = 0;
    while let Some(line) = sender.line() {
        operator.types(&line);
        lines += 1;
        if lines == 20 {
            operator.types(r#"{"x":NaN,"y":0,"z":0}"#);
        }
    }
    operator.closes();
    let done = operator.event("done");
    let count = |what: &str| done["input"]["dropped"][what].as_u64();
    assert_eq!(
        (count("malformed"), count("not_finite")),
        (Some(1), Some(1)),
        "{done}"
    );
    assert_eq!(done["input"]["samples"].as_u64().unwrap(), lines, "{done}");
    assert!(done["samples"].as_u64().unwrap() > lines / 2, "{done}");
    assert_eq!(done["completed"], true, "{done}");
    assert!(operator.end().0.success());
    robot.signal(Signal::TERM);
    assert!(robot.end().0.success());
}

#[test]
fn an_input_that_anybody_could_reach_or_nobody_can_is_refused_in_a_line() {
    let stage = Stage::new();
    let said = |input: &[&str]| {
        let (status, said) = operator(&stage, "127.0.0.1:1", input).end();
        assert!(!status.success());
        assert_eq!(said.lines().count(), 1, "{said}");
        said
    };
    assert!(said(&["--input", "udp:0.0.0.0:0"]).contains("--input-from"));
    let taken = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port();
    assert!(said(&["--input", &format!("udp:{port}")]).contains("another port"));
}

#[test]
fn a_gamepad_is_taken_where_it_is_built_in_and_else_the_refusal_says_how_to_build_it() {
    let input = |source: &str| {
        let out = Command::new(env!("CARGO_BIN_EXE_telemime"))
            .args(["operator", "--input", source])
            .output()
            .unwrap();
        assert!(out.stdout.is_empty() || out.status.success());
        (out.status.code(), String::from_utf8(out.stderr).unwrap())
    };
    for source in ["evdev:", "evdev:/dev/input/event0"] {
        let (code, told) = input(source);
        if cfg!(feature = "gamepad") {
            assert!(!told.contains("--features"), "{told}");
        } else {
            assert_eq!((code, told.lines().count()), (Some(2), 1), "{told}");
            let how = "cargo build --release --features gamepad";
            assert!(told.contains(how), "{told}");
        }
    }
}
