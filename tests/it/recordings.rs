//! What the daemons record, read back: from drive to record to import to learn; killed, and on a disk that is full.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Output};

use foxglove::Decode;
use foxglove::messages::PoseInFrame;
use nalgebra::Vector3;
use rustix::process::Signal;
use telemime_endpoint::recording::read::{Contents, read};
use telemime_endpoint::recording::{Hand, OperatorState, RobotState};
use telemime_operator::demonstration::Demonstration;

use crate::processes::{Process, Stage, alone};

fn telemime(args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_telemime"));
    command.args(args).output().unwrap()
}

/// Messages of each topic, with its schema.
fn topics(path: &Path) -> (BTreeMap<String, (String, u64)>, Contents) {
    let mut topics = BTreeMap::new();
    let contents = read(path, |message| {
        let count = topics
            .entry(message.topic.to_owned())
            .or_insert_with(|| (message.schema.to_owned(), 0));
        count.1 += 1;
    });
    (topics, contents.unwrap())
}

fn json<T: serde::de::DeserializeOwned>(path: &Path, topic: &str) -> Vec<T> {
    let mut all = Vec::new();
    read(path, |message| {
        if message.topic == topic {
            all.push(serde_json::from_slice(message.data).unwrap());
        }
    })
    .unwrap();
    all
}

/// Places by publish time, s.
fn places(path: &Path, topic: &str) -> Vec<(f64, Vector3<f64>)> {
    let mut all = Vec::new();
    read(path, |message| {
        if message.topic == topic {
            let pose = PoseInFrame::decode(message.data).unwrap();
            assert_eq!(pose.frame_id, "base");
            let at = pose.pose.unwrap().position.unwrap();
            let t_s = message.at.publish.as_secs_f64();
            all.push((t_s, Vector3::new(at.x, at.y, at.z)));
        }
    })
    .unwrap();
    all
}

fn ends_well(process: Process) {
    let (status, said) = process.end();
    assert!(status.success(), "{said}");
}

#[test]
fn what_was_driven_is_recorded_imported_and_learned() {
    let _alone = alone();
    let stage = Stage::new();
    let (of_robot, of_operator) = (stage.text("robot.mcap"), stage.text("screw.mcap"));
    let (robot, addr) = stage.robot_with(&["--record", &of_robot]);
    let operator = stage.operator_with(&addr, "operator", &["--record", &of_operator]);
    let done = operator.event("done");
    assert_eq!(done["completed"], true, "{done}");
    let recorded = operator.event("recording");
    assert!(recorded["error"].is_null(), "{recorded}");
    assert_eq!(recorded["dropped"], 0);
    ends_well(operator);
    robot.signal(Signal::TERM);
    let recorded = robot.event("recording");
    assert!(recorded["error"].is_null(), "{recorded}");
    ends_well(robot);

    let (there, contents) = topics(Path::new(&of_robot));
    assert_eq!(contents.messages, recorded["messages"].as_u64().unwrap());
    assert!(contents.complete);
    assert_eq!(contents.metadata["telemime"]["role"], "robot");
    let schemas: Vec<_> = there
        .iter()
        .map(|(topic, (schema, _))| (topic.as_str(), schema.as_str()))
        .collect();
    assert_eq!(
        schemas,
        [
            ("/robot/arm", "foxglove.SceneUpdate"),
            ("/robot/joints", "foxglove.JointStates"),
            ("/robot/log", "foxglove.Log"),
            ("/robot/state", "telemime.RobotState"),
            ("/robot/target", "foxglove.PoseInFrame"),
            ("/robot/tip", "foxglove.PoseInFrame"),
            ("/robot/transforms", "foxglove.FrameTransforms"),
        ]
    );
    let (there, contents) = topics(Path::new(&of_operator));
    assert!(contents.complete);
    let schemas: Vec<_> = there
        .iter()
        .map(|(topic, (schema, _))| (topic.as_str(), schema.as_str()))
        .collect();
    assert_eq!(
        schemas,
        [
            ("/operator/arm", "foxglove.SceneUpdate"),
            ("/operator/forecast", "foxglove.PosesInFrame"),
            ("/operator/hand", "telemime.Hand"),
            ("/operator/hand/pose", "foxglove.PoseInFrame"),
            ("/operator/joints", "foxglove.JointStates"),
            ("/operator/knots", "foxglove.PosesInFrame"),
            ("/operator/log", "foxglove.Log"),
            ("/operator/state", "telemime.OperatorState"),
            ("/operator/tip", "foxglove.PoseInFrame"),
            ("/operator/transforms", "foxglove.FrameTransforms"),
        ]
    );

    // What was sampled is there, every sample of it.
    let driven = Demonstration::read_csv(stage.path("unseen.csv")).unwrap();
    let hands: Vec<Hand> = json(Path::new(&of_operator), "/operator/hand");
    let hands: Vec<_> = hands.iter().filter(|hand| !hand.resting).collect();
    assert_eq!(hands.len(), driven.samples().len());
    for (hand, sample) in hands.iter().zip(driven.samples()) {
        // Written exactly; the JSON reader here rounds in the last digit.
        assert!((Vector3::from(hand.x) - sample.position).norm() < 1e-14);
    }
    let states: Vec<OperatorState> = json(Path::new(&of_operator), "/operator/state");
    assert!(
        states
            .iter()
            .any(|state| state.engagement > 0 && state.knots > 20)
    );
    let states: Vec<RobotState> = json(Path::new(&of_robot), "/robot/state");
    assert!(
        states
            .iter()
            .any(|s| s.state == "Engaged" && s.knots > 10 && s.received > 10)
    );

    // Two files, one clock: where the hand was asked to be followed to, and where the tip was, at the same time.
    let hand = places(Path::new(&of_operator), "/operator/hand/pose");
    let tip = places(Path::new(&of_robot), "/robot/tip");
    let (mut apart, mut moved, mut count) = (0.0, 0.0, 0.0);
    for (t_s, hand_m) in &hand {
        let after = tip.partition_point(|(t, _)| t < t_s);
        if after > 0 && after < tip.len() {
            apart += (tip[after].1 - hand_m).norm();
            moved += (hand[0].1 - hand_m).norm();
            count += 1.0;
        }
    }
    println!(
        "hand to tip {:.4} m, hand from its start {:.4} m",
        apart / count,
        moved / count
    );
    assert!(count > 50.0 && apart < 0.35 * moved);

    let folder = stage.text("monday");
    let imported = telemime(&["import", &of_operator, "-o", &folder, "--keep-glitches"]);
    let said = String::from_utf8_lossy(&imported.stderr).into_owned();
    assert!(imported.status.success(), "{said}");
    let again = Demonstration::read_csv(stage.path("monday/screw.csv")).unwrap();
    assert!(
        again.samples().len() + 2 >= driven.samples().len(),
        "{}",
        again.samples().len()
    );
    let learned = telemime(&["learn", &folder, "-o", &stage.text("monday.skill")]);
    let said = String::from_utf8_lossy(&learned.stderr).into_owned();
    assert!(learned.status.success(), "{said}");
    assert!(stage.path("monday.skill").exists());

    let refused = telemime(&["import", &of_robot, "-o", &folder]);
    let said = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(
        !refused.status.success() && said.contains("telemime operator --record"),
        "{said}"
    );
    // Nothing is overwritten.
    let before = std::fs::read(&of_robot).unwrap();
    let refused = telemime(&[
        "robot",
        "--listen",
        "127.0.0.1:0",
        "--identity",
        &stage.text("robot.key"),
        "--record",
        &of_robot,
    ]);
    let said = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(
        !refused.status.success() && said.contains("overwrites nothing"),
        "{said}"
    );
    assert_eq!(std::fs::read(&of_robot).unwrap(), before);
}

#[test]
fn a_killed_process_leaves_a_recording_that_can_be_read_and_learned_from() {
    let _alone = alone();
    let stage = Stage::new();
    let (of_robot, of_operator) = (stage.text("robot.mcap"), stage.text("screw.mcap"));
    let (robot, addr) = stage.robot_with(&["--record", &of_robot]);
    let operator = stage.operator_with(&addr, "operator", &["--record", &of_operator]);
    operator.event_where("progress", |e| e["done"].as_f64().unwrap() > 0.8);
    operator.signal(Signal::KILL);
    robot.event("disconnected");
    robot.signal(Signal::KILL);
    let (_, contents) = topics(Path::new(&of_operator));
    assert!(!contents.complete && contents.messages > 50, "{contents:?}");
    let (_, contents) = topics(Path::new(&of_robot));
    assert!(
        !contents.complete && contents.messages > 500,
        "{contents:?}"
    );
    let folder = stage.text("monday");
    let imported = telemime(&["import", &of_operator, "-o", &folder]);
    let said = String::from_utf8_lossy(&imported.stderr).into_owned();
    assert!(
        imported.status.success() && said.contains("cut off"),
        "{said}"
    );
    let driven = Demonstration::read_csv(stage.path("unseen.csv")).unwrap();
    let saved = Demonstration::read_csv(stage.path("monday/screw.csv")).unwrap();
    println!(
        "{:.2} s of {:.2} s",
        saved.duration_s(),
        driven.duration_s()
    );
    assert!(saved.samples().len() >= 8 && saved.duration_s() < driven.duration_s());
}

#[test]
fn a_full_disk_ends_the_recording_and_not_the_robot() {
    let _alone = alone();
    let stage = Stage::new();
    let of_robot = stage.text("robot.mcap");
    let args = stage.robot_args(&["--record", &of_robot]);
    // A file may not grow beyond a megabyte or two, and the signal that would tell is ignored: writing fails.
    let script = "trap '' XFSZ; ulimit -f 2048; exec \"$@\"";
    let mut command = Command::new("sh");
    command.args(["-c", script, "sh", env!("CARGO_BIN_EXE_telemime")]);
    let (robot, addr) = stage.robot_by(command.args(args));
    let operator = stage.operator(&addr, "operator");
    let ended = robot.event("recording");
    let error = ended["error"].as_str().unwrap();
    assert!(
        error.contains("robot.mcap: File too large") && error.contains("ends here"),
        "{error}"
    );
    let done = operator.event("done");
    assert_eq!(done["completed"], true, "{done}");
    ends_well(operator);
    robot.signal(Signal::TERM);
    ends_well(robot);
    // What was written is a whole file: its torn end was cut off.
    let (there, contents) = topics(Path::new(&of_robot));
    assert!(
        contents.complete
            && contents.messages == ended["messages"]
            && there["/robot/state"].1 > 100,
        "{there:?}"
    );
}
