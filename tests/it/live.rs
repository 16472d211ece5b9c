//! Viewers that are connected while something is driven; without the feature `live`, what the flag then says.

#[cfg(feature = "live")]
mod viewer;

#[cfg(not(feature = "live"))]
#[test]
fn a_build_without_viewers_says_how_to_build_one_with_them() {
    use std::process::Command;

    let dir = tempfile::tempdir().unwrap();
    let key = dir.path().join("daemon.key");
    let key = key.to_str().unwrap();
    let robot = ["robot", "--listen", "127.0.0.1:0", "--identity", key];
    let peer = "ab".repeat(32);
    let operator = [
        "operator",
        "--connect",
        "127.0.0.1:1",
        "--peer",
        &peer,
        "--identity",
        key,
        "--console",
        "127.0.0.1:0",
    ];
    for daemon in [&robot[..], &operator[..]] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_telemime"));
        let out = command.args(daemon).arg("--foxglove").output().unwrap();
        let said = String::from_utf8(out.stderr).unwrap();
        let lines: Vec<_> = said.lines().filter(|l| l.contains("--foxglove")).collect();
        assert!(!out.status.success(), "{said}");
        assert!(
            lines.len() == 1 && lines[0].contains("cargo build --release --features live"),
            "{said}"
        );
    }
    for daemon in ["robot", "operator"] {
        let file = dir.path().join(format!("{daemon}.toml"));
        std::fs::write(&file, "foxglove = \"127.0.0.1:0\"\n").unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_telemime"));
        command.args(["check-config", daemon]).arg(&file);
        let out = command.output().unwrap();
        let said = String::from_utf8([out.stdout, out.stderr].concat()).unwrap();
        assert_eq!(out.status.code(), Some(2), "{said}");
        assert!(said.contains("--features live"), "{said}");
    }
}

#[cfg(feature = "live")]
mod shown {
    use std::collections::{BTreeMap, BTreeSet};
    use std::sync::mpsc::channel;
    use std::thread;

    use foxglove::Decode;
    use foxglove::messages::{JointStates, Log};
    use rustix::process::Signal;
    use telemime_endpoint::recording::{At, Hand, Recording, RobotState, Tape, To, info};
    use telemime_protocol::time::Stamp;

    use super::viewer::{Said, Viewer};
    use crate::processes::{Process, Stage, alone};

    fn url(daemon: &Process) -> String {
        daemon.event("foxglove")["url"].as_str().unwrap().to_owned()
    }

    /// Topics, and what was said on them.
    type Messages = Vec<(String, Vec<u8>)>;

    /// All that is shown until the daemon ends: the schemas of the topics, and the messages.
    fn everything(mut viewer: Viewer) -> (BTreeMap<String, String>, Messages) {
        let (mut schemas, mut messages) = (BTreeMap::new(), Vec::new());
        while let Some(said) = viewer.next() {
            match said {
                Said::Advertised(channels) => {
                    for channel in channels {
                        viewer.subscribe(&channel);
                        schemas.insert(channel.topic, channel.schema);
                    }
                }
                Said::Message { topic, data, .. } => messages.push((topic, data)),
                Said::Info(_) | Said::Unadvertised | Said::Status(_) => {}
            }
        }
        (schemas, messages)
    }

    fn topics_of(schemas: &BTreeMap<String, String>) -> Vec<(&str, &str)> {
        let pairs = schemas.iter();
        pairs.map(|(t, s)| (t.as_str(), s.as_str())).collect()
    }

    #[test]
    fn a_viewer_sees_a_drive_and_one_that_reads_nothing_does_not_stop_it() {
        let _alone = alone();
        let stage = Stage::new();
        let (robot, addr) = stage.robot_with(&["--foxglove", "127.0.0.1:0"]);
        let at = url(&robot);
        let of_robot = thread::spawn({
            let at = at.clone();
            move || everything(Viewer::connect(&at).unwrap())
        });
        // One that has not even greeted, and one that greets and reads nothing.
        let _mute = std::net::TcpStream::connect(at.trim_start_matches("ws://")).unwrap();
        let _deaf = Viewer::connect(&at).unwrap();
        let operator = stage.operator_with(&addr, "operator", &["--foxglove", "127.0.0.1:0"]);
        let at = url(&operator);
        let of_operator = thread::spawn(move || everything(Viewer::connect(&at).unwrap()));
        let done = operator.event("done");
        assert_eq!(done["completed"], true, "{done}");
        let (status, said) = operator.end();
        assert!(status.success(), "{said}");
        robot.signal(Signal::TERM);
        let (status, said) = robot.end();
        assert!(status.success(), "{said}");

        let (schemas, messages) = of_operator.join().unwrap();
        assert_eq!(
            topics_of(&schemas),
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
        let of = |topic: &str, all: &[(String, Vec<u8>)]| -> Vec<Vec<u8>> {
            let of = all.iter().filter(|(t, _)| t == topic);
            of.map(|(_, data)| data.clone()).collect()
        };
        let hands: Vec<Hand> = of("/operator/hand", &messages)
            .iter()
            .map(|data| serde_json::from_slice(data).unwrap())
            .collect();
        assert!(hands.iter().filter(|hand| hand.engagement > 0).count() > 20);
        let (schemas, messages) = of_robot.join().unwrap();
        assert_eq!(
            topics_of(&schemas),
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
        let joints = of("/robot/joints", &messages);
        let joints = JointStates::decode(joints.last().unwrap().as_slice()).unwrap();
        assert!(!joints.joints.is_empty());
        let states: BTreeSet<String> = of("/robot/state", &messages)
            .iter()
            .map(|data| serde_json::from_slice::<RobotState>(data).unwrap().state)
            .collect();
        assert!(states.contains("Engaged"), "{states:?}");
    }

    /// Entries are numbers, each shown as a log line of 16 kB; what was written comes back.
    fn recording() -> (Recording<u64>, std::sync::mpsc::Receiver<u64>, String) {
        let (tx, written) = channel();
        let write = move |tape: &mut Tape, i: u64| {
            if i == 0 {
                tape.another()?;
            }
            let t = Stamp(i64::try_from(i).unwrap());
            let text = format!("{i} {}", "x".repeat(16 * 1024));
            tape.message("/test/log", At::once(t), &info(t, &text))?;
            tx.send(i).unwrap();
            Ok(())
        };
        let to = To {
            file: None,
            live: Some("127.0.0.1:0".parse().unwrap()),
        };
        let about = BTreeMap::from([("role".to_owned(), "test".to_owned())]);
        let recording = Recording::start(to, about, write, |_| ()).unwrap();
        let at = format!("ws://{}", recording.live().unwrap());
        (recording, written, at)
    }

    fn number(data: &[u8]) -> u64 {
        let text = Log::decode(data).unwrap().message;
        text.split(' ').next().unwrap().parse().unwrap()
    }

    /// A viewer that has subscribed to the only topic there is.
    fn subscribed(at: &str) -> Viewer {
        let mut viewer = Viewer::connect(at).unwrap();
        loop {
            if let Some(Said::Advertised(channels)) = viewer.next() {
                viewer.subscribe(&channels[0]);
                return viewer;
            }
        }
    }

    /// Written one after another until this viewer has been shown one.
    fn until_shown(
        viewer: &mut Viewer,
        recording: &Recording<u64>,
        written: &std::sync::mpsc::Receiver<u64>,
    ) {
        let mut i = 1_000_000;
        viewer.no_longer_than(std::time::Duration::from_millis(20));
        loop {
            i += 1;
            recording.push(i);
            assert_eq!(written.recv().unwrap(), i);
            if let Some(Said::Message { .. }) = viewer.poll() {
                break;
            }
        }
        viewer.for_ever();
    }

    #[test]
    fn a_viewer_that_reads_nothing_holds_up_nobody_and_then_sees_the_newest() {
        let (recording, written, at) = recording();
        recording.push(1);
        written.recv().unwrap();
        let mut deaf = subscribed(&at);
        until_shown(&mut deaf, &recording, &written);
        // 64 MB of which it reads nothing: all are written, one by one.
        const ALL: u64 = 4000;
        for i in 10..ALL {
            recording.push(i);
            assert_eq!(written.recv().unwrap(), i);
        }
        let mut other = subscribed(&at);
        until_shown(&mut other, &recording, &written);
        let mut shown = Vec::new();
        while shown.last() != Some(&(ALL - 1)) {
            if let Some(Said::Message { topic, data, t }) = deaf.next() {
                assert_eq!(topic, "/test/log");
                assert_eq!(t, number(&data));
                shown.extend(Some(number(&data)).filter(|i| *i < ALL));
            }
        }
        assert!(shown.is_sorted());
        assert!(shown.len() < 3000, "{} of {ALL}", shown.len());
        drop(recording);
    }

    #[test]
    fn viewers_are_few_say_nothing_and_forget_another_clock() {
        let (recording, written, at) = recording();
        recording.push(1);
        written.recv().unwrap();
        let mut viewer = subscribed(&at);
        let rest: Vec<_> = (0..7).map(|_| subscribed(&at)).collect();
        let refused = Viewer::connect(&at);
        assert!(refused.is_err(), "a ninth is turned away");
        drop(rest);

        let nothing = viewer.info()["capabilities"].as_array().unwrap().clone();
        assert!(nothing.is_empty(), "{nothing:?}");
        for wish in [
            r#"{"op":"advertise","channels":[{"id":1,"topic":"/robot/joints","encoding":"json","schemaName":"x"}]}"#,
            r#"{"op":"setParameters","parameters":[{"name":"x","value":1}]}"#,
            r#"{"op":"fetchAsset","uri":"file:///etc/passwd","requestId":1}"#,
            "{\"op\":",
        ] {
            viewer.say(wish);
            loop {
                match viewer.next().expect("it may stay") {
                    Said::Status(refusal) => {
                        assert!(!refusal.contains("root:"), "{refusal}");
                        break;
                    }
                    Said::Advertised(_) | Said::Unadvertised | Said::Info(_) => {
                        panic!("an answer to {wish}")
                    }
                    Said::Message { .. } => {}
                }
            }
        }
        // Another clock: what was there is taken back, and there again.
        recording.push(0);
        let mut order = Vec::new();
        while order.last() != Some(&"advertised") {
            match viewer.next().unwrap() {
                Said::Unadvertised => order.push("taken back"),
                Said::Info(_) => order.push("info"),
                Said::Advertised(_) => order.push("advertised"),
                Said::Message { .. } | Said::Status(_) => {}
            }
        }
        assert_eq!(order, ["taken back", "info", "advertised"]);
    }
}
