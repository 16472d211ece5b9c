//! An arm behind a driver: real processes, Python on the other side. And what a robot's process does for signals.

use std::process::Command;

use rustix::process::Signal;
use telemime_robot::rig::{Rig, RigOptions};

use crate::processes::{Process, Stage, alone};

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

/// The example's or another driver's command, with the built-in arm's start posture; nothing without Python.
fn command(script: &str, first: &str) -> Option<String> {
    if !Command::new("python3")
        .arg("-V")
        .output()
        .is_ok_and(|out| out.status.success())
    {
        crate::data::skipped("no python3 here; no driver has run");
        return None;
    }
    let rig = Rig::load(&RigOptions::default()).unwrap();
    let posture: Vec<_> = rig
        .home
        .iter()
        .take(rig.arm.dof())
        .map(f64::to_string)
        .collect();
    Some(format!(
        "exec python3 '{ROOT}/{script}' {first} {}",
        posture.join(",")
    ))
}

/// Other work on this computer is not what is tried here: the driver has time.
fn flags<'a>(driver: &'a str, boxes: &'a str) -> [&'a str; 6] {
    [
        "--driver",
        driver,
        "--driver-patience",
        "2s",
        "--black-box",
        boxes,
    ]
}

#[test]
fn the_documented_driver_is_driven_and_its_record_replays() {
    let _alone = alone();
    let Some(driver) = command("docs/driver_example.py", "") else {
        return;
    };
    let (stage, boxes) = (Stage::new(), tempfile::tempdir().unwrap());
    let folder = boxes.path().to_str().unwrap();
    let (robot, addr) = stage.robot_with(&flags(&driver, folder));
    let greeted = robot.event("driver");
    assert_eq!(greeted["rate_hz"], 250.0);
    let operator = stage.operator(&addr, "operator");
    let done = operator.event("done");
    assert_eq!(done["completed"], true, "{done}");
    assert!(operator.end().0.success());
    robot.event_where("state", |e| e["state"] == "Ready");
    robot.signal(Signal::USR2);
    let written = robot.event("black_box");
    assert_eq!(written["why"], "request", "{written}");
    let file = written["file"].as_str().unwrap().to_owned();
    robot.signal(Signal::TERM);
    robot.event_where("black_box", |e| e["why"] == "stop LocalStop");
    let servo = robot.event("servo");
    for tail in ["p50_ns", "p99_ns", "p999_ns", "wake_p50_ns", "wake_max_ns"] {
        assert!(servo[tail].as_u64().unwrap() > 0, "{servo}");
    }
    assert!(robot.end().0.success());

    let csv = boxes.path().join("ticks.csv");
    let out = Command::new(env!("CARGO_BIN_EXE_telemime"))
        .args(["replay", &file, "--json", "--csv"])
        .arg(&csv)
        .output()
        .unwrap();
    let said = String::from_utf8(out.stdout).unwrap();
    assert!(out.status.success(), "{said}");
    let told: serde_json::Value = serde_json::from_str(&said).unwrap();
    assert_eq!(
        (&told["identical"], &told["gaps"]),
        (&true.into(), &0.into()),
        "{said}"
    );
    assert!(told["driver"].as_str().unwrap().contains("driver_example"));
    let moments = told["moments"].to_string();
    assert!(moments.contains("Engaged (Requested)"), "{moments}");
    let rows = std::fs::read_to_string(csv).unwrap();
    assert_eq!(
        rows.lines().count() as u64,
        told["ticks"].as_u64().unwrap() + 1
    );
    // It moved, from where the driver said it was.
    let rig = Rig::load(&RigOptions::default()).unwrap();
    let head: Vec<_> = rows.lines().next().unwrap().split(',').collect();
    let column = head.iter().position(|name| *name == "set_q0").unwrap();
    let set = |line: &str| line.split(',').nth(column).unwrap().parse::<f64>().unwrap();
    let values: Vec<_> = rows.lines().skip(1).map(set).collect();
    assert!(
        (values[0] - rig.home[0]).abs() < 1e-9,
        "no jump at the start"
    );
    let fastest = rig.arm.joints()[0].velocity * rig.tick_s();
    let (mut far, mut last) = (0.0_f64, values[0]);
    for q in values {
        assert!((q - last).abs() <= fastest * 1.001);
        far = far.max((q - rig.home[0]).abs());
        last = q;
    }
    assert!(far > 0.01, "{far}");
}

#[test]
fn a_driver_that_fails_stops_the_arm_with_its_reason_and_an_exit_code() {
    let _alone = alone();
    for (how, kind, words) in [
        ("die", "Ended", "the driver has ended"),
        // The process outlives its output, and does not read any more.
        ("mute", "Ended", "the driver has ended"),
        ("ahead", "Unmade", "that it obeys setpoint"),
        ("stall", "Stalled", "has not told the joints' state"),
        ("garbage", "Garbage", "is no joint state"),
        ("leap", "Leapt", "joint 0 has leapt"),
        ("deaf", "Lagging", "behind its setpoints"),
        ("fault", "Reported", "joint 3 is too warm"),
    ] {
        let Some(driver) = command("tests/driver/faulty.py", how) else {
            return;
        };
        let (stage, boxes) = (Stage::new(), tempfile::tempdir().unwrap());
        let folder = boxes.path().to_str().unwrap();
        let (robot, _) = stage.robot_with(&flags(&driver, folder));
        let fault = robot.event("arm_fault");
        let found = &fault["fault"];
        assert!(found == kind || found[kind].is_object(), "{how}: {fault}");
        let stopped = robot.event_where("state", |e| e["state"] == "Stopped");
        assert_eq!(stopped["cause"], "ArmFault", "{how}");
        let (status, said) = robot.end();
        let written: Vec<_> = std::fs::read_dir(boxes.path()).unwrap().flatten().collect();
        let names: Vec<_> = written.iter().map(|file| file.file_name()).collect();
        assert_eq!(names, ["0001-stop-armfault.blackbox"], "{how}");
        assert_eq!(status.code(), Some(1), "{how}");
        assert!(
            said.contains(words) && said.contains("the arm was stopped"),
            "{how}: {said}"
        );
    }
}

#[test]
fn an_operator_hears_that_the_arm_failed() {
    let _alone = alone();
    let Some(driver) = command("docs/driver_example.py", "") else {
        return;
    };
    let stage = Stage::new();
    // The example writes its own process's number for whoever is to end it.
    let pid = stage.text("pid");
    let driver = format!("echo $$ > {pid}; {driver}");
    let flags = ["--driver", &driver, "--driver-patience", "2s"];
    let (robot, addr) = stage.robot_with(&flags);
    let operator = stage.operator(&addr, "operator");
    operator.event_where("progress", |e| e["done"].as_f64().unwrap() > 0.3);
    let number = std::fs::read_to_string(&pid)
        .unwrap()
        .trim()
        .parse()
        .unwrap();
    let process = rustix::process::Pid::from_raw(number).unwrap();
    rustix::process::kill_process(process, Signal::KILL).unwrap();
    let told = operator.event_where("state", |e| e["state"] == "Stopped");
    assert_eq!(told["cause"], "ArmFault", "{told}");
    let done = operator.event("done");
    assert_eq!(done["completed"], false, "{done}");
    assert!(!operator.end().0.success());
    assert_eq!(robot.end().0.code(), Some(1));
}

/// Somebody stops the arm, and cuts its power then.
#[test]
fn a_driver_that_fails_behind_a_stopped_arm_is_told_like_any_other() {
    let _alone = alone();
    let Some(driver) = command("docs/driver_example.py", "") else {
        return;
    };
    let (stage, boxes) = (Stage::new(), tempfile::tempdir().unwrap());
    let pid = stage.text("pid");
    let driver = format!("echo $$ > {pid}; {driver}");
    let folder = boxes.path().to_str().unwrap();
    let (robot, _) = stage.robot_with(&flags(&driver, folder));
    robot.event("driver");
    robot.signal(Signal::USR1);
    let stopped = robot.event_where("state", |e| e["state"] == "Stopped");
    assert_eq!(stopped["cause"], "LocalStop", "{stopped}");
    let number = std::fs::read_to_string(&pid).unwrap();
    let process = rustix::process::Pid::from_raw(number.trim().parse().unwrap()).unwrap();
    rustix::process::kill_process(process, Signal::KILL).unwrap();
    robot.event_where("state", |e| e["cause"] == "ArmFault");
    robot.event_where("black_box", |e| e["why"] == "stop ArmFault");
    let (status, said) = robot.end();
    assert_eq!(status.code(), Some(1), "{said}");
    assert!(said.contains("the driver has ended"), "{said}");
}

#[test]
fn a_robot_that_starts_too_near_itself_names_what_it_does_not_keep_apart() {
    let _alone = alone();
    let stage = Stage::new();
    for (start, says) in [
        ("0.4,0.5,0.2,-2.85,0.3,0.6,0", true),
        ("0,0.2,0,-1.6,0,1.4,0", false),
    ] {
        let (robot, _) = stage.robot_with(&["--start", start]);
        robot.signal(Signal::TERM);
        let (status, said) = robot.end();
        assert!(status.success(), "{said}");
        assert_eq!(
            said.contains("at the start already: not guarded"),
            says,
            "{said}"
        );
    }
}

#[test]
fn settings_that_cannot_be_with_the_arm_are_told_as_such() {
    let _alone = alone();
    let stage = Stage::new();
    let urdf = telemime_sim::arm::default_urdf().replace(r#"effort="12""#, r#"effort="0""#);
    std::fs::write(stage.path("loose.urdf"), urdf).unwrap();
    std::fs::write(stage.path("empty.toml"), "").unwrap();
    let [key, urdf, file] = ["robot.key", "loose.urdf", "empty.toml"].map(|name| stage.text(name));
    for (flags, words) in [
        (["--bandwidth", "1.2"], "1.50 rad/s is the least"),
        (["--stiffness", "100"], "joint `joint5` states none"),
    ] {
        for first in [&["robot"][..], &["check-config", "robot", &file, "--"]] {
            let arm = ["--identity", &key, "--urdf", &urdf];
            let (status, said) = Process::start(&[first, &arm, &flags].concat()).end();
            assert_eq!(status.code(), Some(2), "{first:?}: {said}");
            assert!(said.contains(words), "{first:?}: {said}");
        }
    }
}

#[test]
fn a_driver_that_is_none_is_one_clear_line() {
    let _alone = alone();
    let stage = Stage::new();
    for (driver, words) in [
        ("exit 3", "it ended before"),
        ("echo hello", "line 1"),
        // A banner, from one that goes on and never ends by itself.
        ("echo connecting; exec sleep 3600", "line 1"),
        // The same from a child of it that has its input and does not read.
        ("echo connecting; sleep 3600 & exec sleep 3600", "line 1"),
        (
            r#"echo '{"telemime_driver":9,"joints":["a"],"rate_hz":100}'"#,
            "version 9",
        ),
        (
            r#"echo '{"telemime_driver":1,"joints":["a"],"rate_hz":100}'; echo '{"q":[1,2],"qd":[0]}'"#,
            "q has 2 values for 1 joints",
        ),
        (
            r#"echo '{"telemime_driver":1,"joints":["a"],"rate_hz":100}'; echo '{"q":[1],"qd":[0]}'; cat"#,
            "has the joints a, and the arm joint1",
        ),
    ] {
        let key = stage.text("robot.key");
        let robot = Process::start(&["robot", "--identity", &key, "--driver", driver]);
        let (status, said) = robot.end();
        assert_eq!(status.code(), Some(1), "{driver}");
        let line = said.lines().last().unwrap_or_default();
        assert!(line.contains(words), "{driver}: {said}");
    }
}

#[test]
fn an_arm_that_is_moved_while_the_robot_starts_is_not_driven() {
    let _alone = alone();
    let Some(driver) = command("tests/driver/faulty.py", "moved") else {
        return;
    };
    let stage = Stage::new();
    let key = stage.text("robot.key");
    let flags = ["robot", "--identity", &key, "--driver", &driver];
    let (status, said) = Process::start(&flags).end();
    assert_eq!(status.code(), Some(1), "{said}");
    assert!(said.contains("joint 0 has moved by 0.1000"), "{said}");
}

#[test]
fn a_patience_that_does_not_go_with_the_drivers_rate_is_refused() {
    let _alone = alone();
    let stage = Stage::new();
    let key = stage.text("robot.key");
    let slow = r#"echo '{"telemime_driver":1,"joints":["a"],"rate_hz":10}'; echo '{"q":[1],"qd":[0]}'; cat"#;
    // What only the driver's own words show is a failure, and no configuration that cannot be.
    for (patience, code, words) in [
        ("100ms", 1, "three of its periods, 0.300 s"),
        ("5s", 2, "from 10ms to 2s"),
    ] {
        let flags = [
            "robot",
            "--identity",
            &key,
            "--driver",
            slow,
            "--driver-patience",
            patience,
        ];
        let (status, said) = Process::start(&flags).end();
        assert_eq!(status.code(), Some(code), "{said}");
        assert!(said.contains(words), "{said}");
    }
}

#[test]
fn a_signal_is_an_emergency_stop_that_only_the_robot_leaves() {
    let _alone = alone();
    let stage = Stage::new();
    let (mut robot, addr) = stage.robot_with(&["--realtime", "10"]);
    let granted = robot.event("realtime");
    assert!(
        granted["priority"] == 10 || granted["why"].as_str().unwrap().contains("real-time"),
        "{granted}"
    );
    let operator = stage.operator(&addr, "operator");
    operator.event_where("progress", |e| e["done"].as_f64().unwrap() > 0.3);
    robot.signal(Signal::USR1);
    let stopped = robot.event_where("state", |e| e["state"] == "Stopped");
    assert_eq!(stopped["cause"], "LocalStop");
    operator.event_where("state", |e| e["cause"] == "LocalStop");
    operator.signal(Signal::INT);
    assert!(!operator.end().0.success());
    robot.types("reset");
    robot.event_where("state", |e| e["state"] != "Stopped");
    // There is no black box to be asked for: said, and no more.
    robot.signal(Signal::USR2);
    robot.types("quit");
    let (status, said) = robot.end();
    assert!(status.success(), "{said}");
}
