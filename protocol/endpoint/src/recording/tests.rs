use std::path::Path;

use foxglove::Decode;
use foxglove::messages::{FrameTransforms, PoseInFrame, SceneUpdate};
use nalgebra::{UnitQuaternion, Vector3};
use telemime_protocol::wire::arm::{WireArm, WireCapsule, WireJoint, WireJointKind, WirePlace};

use super::read::{Contents, ReadError, read};
use super::*;

fn about() -> BTreeMap<String, String> {
    BTreeMap::from([("role".to_owned(), "test".to_owned())])
}

fn t(ms: i64) -> Stamp {
    Stamp(ms * 1_000_000)
}

fn hand(ms: i64) -> Hand {
    Hand {
        t_ns: t(ms).0,
        x: [0.1, 1.0 / 3.0, -2.0e-7],
        orientation: None,
        grip: Some(0.5),
        resting: false,
        session: 1,
        engagement: 2,
    }
}

fn into(path: &Path) -> To<'_> {
    To {
        file: Some(path),
        live: None,
    }
}

/// Entries are times, ms; each becomes a hand and a pose.
fn write(tape: &mut Tape, ms: i64) -> Result<(), RecordError> {
    tape.message("/hand", At::once(t(ms)), &Json(hand(ms)))?;
    let at = At {
        log: t(ms),
        publish: t(ms - 20),
    };
    let turn = UnitQuaternion::identity();
    tape.message("/pose", at, &in_base(at.publish, &Vector3::x(), &turn))
}

fn record(path: &Path, entries: impl IntoIterator<Item = i64>) -> Outcome {
    let (tx, rx) = std::sync::mpsc::channel();
    let say = move |outcome| drop(tx.send(outcome));
    let recording = Recording::start(into(path), about(), write, say).unwrap();
    entries.into_iter().for_each(|ms| recording.push(ms));
    drop(recording);
    rx.recv().unwrap()
}

fn hands(path: &Path) -> (Vec<Hand>, Contents) {
    let mut hands = Vec::new();
    let contents = read(path, |message| {
        if message.topic == "/hand" {
            assert_eq!(
                (message.schema, message.encoding),
                ("telemime.Hand", "json")
            );
            hands.push(serde_json::from_slice(message.data).unwrap());
        }
    });
    (hands, contents.unwrap())
}

#[test]
fn what_is_written_is_read_back_with_both_times() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    let outcome = record(&path, (0..300).map(|i| 1000 + 10 * i));
    assert_eq!((outcome.messages, outcome.dropped), (600, 0));
    assert!(outcome.error.is_none(), "{outcome:?}");
    let (all, contents) = hands(&path);
    assert_eq!(
        all,
        (0..300).map(|i| hand(1000 + 10 * i)).collect::<Vec<_>>()
    );
    assert!(contents.complete);
    assert_eq!(contents.metadata[reel::ABOUT]["role"], "test");
    assert_eq!(contents.metadata[reel::END]["dropped"], "0");
    assert_eq!(contents.metadata[reel::END]["messages"], "600");
    let mut poses = 0;
    read(&path, |message| {
        if message.topic == "/pose" {
            let pose = PoseInFrame::decode(message.data).unwrap();
            assert_eq!(message.schema, "foxglove.PoseInFrame");
            assert_eq!(message.at.log.secs_since(message.at.publish), 0.02);
            assert_eq!(pose.timestamp, Some(shapes::timestamp(message.at.publish)));
            poses += 1;
        }
    })
    .unwrap();
    assert_eq!(poses, 300);
}

#[test]
fn nothing_is_overwritten_and_a_place_that_is_not_there_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    std::fs::write(&path, "precious").unwrap();
    let refused = Recording::start(into(&path), about(), write, |_| ()).unwrap_err();
    assert!(matches!(refused, RecordError::Exists { .. }), "{refused}");
    assert_eq!(std::fs::read(&path).unwrap(), b"precious");
    let wrong = dir.path().join("a.bag");
    let refused = Recording::start(into(&wrong), about(), write, |_| ()).unwrap_err();
    assert!(refused.to_string().contains("NAME.mcap"), "{refused}");
    assert!(!wrong.exists());
    let nowhere = dir.path().join("no/a.mcap");
    let refused = Recording::start(into(&nowhere), about(), write, |_| ()).unwrap_err();
    assert!(matches!(refused, RecordError::Create { .. }), "{refused}");
}

#[test]
fn another_clock_begins_another_file_beside() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    std::fs::write(dir.path().join("a-2.mcap"), "somebody's").unwrap();
    let (tx, rx) = std::sync::mpsc::channel();
    let roll = |tape: &mut Tape, ms: i64| {
        if ms == 0 {
            return tape.another();
        }
        write(tape, ms)
    };
    let recording =
        Recording::start(into(&path), about(), roll, move |o| drop(tx.send(o))).unwrap();
    [5000, 5010, 0, 1000]
        .into_iter()
        .for_each(|ms| recording.push(ms));
    drop(recording);
    let ended: Vec<_> = rx.iter().map(|o| (o.path, o.messages)).collect();
    let third = dir.path().join("a-3.mcap");
    assert_eq!(ended, [(path.clone(), 4), (third.clone(), 2)]);
    assert_eq!((hands(&path).0.len(), hands(&third).0.len()), (2, 1));
}

#[test]
fn a_file_that_is_cut_off_anywhere_gives_all_that_was_whole() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    let mut tape = Tape::create(Some(&path), None, about()).unwrap();
    for i in 0..300 {
        write(&mut tape, 1000 + 10 * i).unwrap();
        tape.flush(false).unwrap();
    }
    let flushed = std::fs::read(&path).unwrap();
    tape.end(None);
    let cut = dir.path().join("cut.mcap");
    // Killed: nothing is written after the last whole second.
    std::fs::write(&cut, &flushed).unwrap();
    let (all, contents) = hands(&cut);
    assert!(!contents.complete && all.len() >= 200, "{}", all.len());
    let mut last = all.len();
    for len in (0..flushed.len()).rev().step_by(997) {
        std::fs::write(&cut, &flushed[..len]).unwrap();
        match read(&cut, |_| ()) {
            Ok(contents) => {
                let (all, _) = hands(&cut);
                assert!(!contents.complete && all.len() <= last);
                assert!(
                    all.iter()
                        .enumerate()
                        .all(|(i, h)| *h == hand(1000 + 10 * i as i64))
                );
                last = all.len();
            }
            Err(ReadError::NotMcap { .. }) => assert!(len < 200, "{len}"),
            Err(e) => panic!("{len}: {e}"),
        }
    }
    std::fs::write(&cut, "t,x,y,z\n0,0,0,0\n").unwrap();
    let refused = read(&cut, |_| ()).unwrap_err();
    assert!(matches!(refused, ReadError::NotMcap { .. }), "{refused}");
}

/// Whoever hands over a file may have written anything into it.
#[test]
fn a_file_with_anything_changed_is_read_or_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    record(&path, (0..40).map(|i| 1000 + 10 * i));
    let whole = std::fs::read(&path).unwrap();
    let (mut refused, mut seed) = (0, 7_u64);
    for _ in 0..2000 {
        let mut bytes = whole.clone();
        for _ in 0..3 {
            // A linear congruence does for places and values.
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            let at = (seed >> 33) as usize % bytes.len();
            bytes[at] = (seed >> 25) as u8;
        }
        std::fs::write(&path, &bytes).unwrap();
        refused += u32::from(read(&path, |_| ()).is_err());
    }
    assert!((500..2000).contains(&refused), "{refused}");
}

#[test]
fn a_message_of_ours_is_what_its_schema_says() {
    fn check<T: Own>(message: &T) {
        let schema: serde_json::Value = serde_json::from_str(T::SCHEMA).unwrap();
        let json = serde_json::to_value(message).unwrap();
        let there: Vec<_> = json.as_object().unwrap().keys().collect();
        let stated = schema["properties"].as_object().unwrap();
        assert_eq!(there, stated.keys().collect::<Vec<_>>(), "{}", T::NAME);
        assert_eq!(schema["title"], T::NAME);
        for (key, value) in json.as_object().unwrap() {
            let kind = match value {
                serde_json::Value::Bool(_) => "boolean",
                serde_json::Value::String(_) => "string",
                serde_json::Value::Array(_) => "array",
                serde_json::Value::Number(n) if n.is_f64() => "number",
                _ => "integer",
            };
            assert_eq!(stated[key]["type"], kind, "{}.{key}", T::NAME);
            assert!(stated[key]["description"].is_string());
        }
    }
    check(&Hand {
        orientation: Some([1.0, 0.0, 0.0, 0.0]),
        ..hand(7)
    });
    check(&OperatorState {
        robot: "Engaged".into(),
        cause: "Requested".into(),
        session: 1,
        engagement: 1,
        scale: Some(0.5),
        messages: 1,
        knots: 1,
        samples: 1,
        glitches: 0,
        age_s: Some(0.1),
        delay_s: Some(0.1),
        clock_bound_s: Some(0.1),
        lag_s: Some(0.1),
        clamps: Some(0),
        lost: Some(0),
        knots_held: Some(1),
    });
    check(&RobotState {
        tick: 1,
        mono_ns: 1,
        state: "Idle".into(),
        cause: "Requested".into(),
        session: 0,
        engagement: 0,
        moving: false,
        age_s: 0.1,
        lag_s: 0.1,
        clamps: 0,
        knots: 0,
        received: 0,
        lost: 0,
        clock_bound_s: Some(0.1),
        plan_s: Some(0.1),
        jerk_m_s3: 0.1,
        orientation_error_rad: 0.1,
        opening: Some(0.5),
        fault: Some("none".into()),
    });
}

#[test]
fn frames_joined_from_base_to_tip_are_the_arm_s_kinematics() {
    let place = |m, q| WirePlace { m, q };
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let arm = WireArm {
        joints: vec![
            WireJoint {
                place: place([0.0, 0.0, 0.5], [1.0, 0.0, 0.0, 0.0]),
                axis: [0.0, 0.0, 1.0],
                kind: WireJointKind::Revolute,
                limits: None,
            },
            WireJoint {
                place: place([1.0, 0.0, 0.0], [half, 0.0, half, 0.0]),
                axis: [0.0, 0.0, 1.0],
                kind: WireJointKind::Prismatic,
                limits: None,
            },
        ],
        tip: place([0.0, 0.0, 0.25], [1.0, 0.0, 0.0, 0.0]),
        capsules: vec![
            WireCapsule {
                link: 1,
                from: [0.0; 3],
                to: [1.0, 0.0, 0.0],
                radius_m: 0.1,
            },
            WireCapsule {
                link: 2,
                from: [0.0; 3],
                to: [0.0, 0.0, -0.2],
                radius_m: 0.1,
            },
        ],
    };
    let look = Look {
        prefix: "",
        colour: [1.0; 4],
    };
    let drawn = Drawn::new(arm, look, &["turn"]);
    // A quarter turn about z, then out along what was x: at y = 1 + 0.5 + 0.25.
    let q = [std::f64::consts::FRAC_PI_2, 0.5];
    let FrameTransforms { transforms } = drawn.transforms(t(1500), &q);
    let mut at = nalgebra::Isometry3::identity();
    let mut parent = BASE.to_owned();
    for link in &transforms {
        assert_eq!(link.parent_frame_id, parent);
        parent.clone_from(&link.child_frame_id);
        let (m, r) = (link.translation.unwrap(), link.rotation.unwrap());
        let turn = UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(r.w, r.x, r.y, r.z));
        at *= nalgebra::Isometry3::from_parts(Vector3::new(m.x, m.y, m.z).into(), turn);
    }
    assert_eq!(parent, "tip");
    let error = at.translation.vector - Vector3::new(0.0, 1.75, 0.5);
    assert!(error.norm() < 1e-6, "{at}");
    let names: Vec<_> = drawn
        .joints(t(0), &q)
        .joints
        .into_iter()
        .map(|j| j.name)
        .collect();
    assert_eq!(names, ["turn", "joint2"]);
    let SceneUpdate { entities, .. } = drawn.scene(t(0));
    let shapes: Vec<_> = entities
        .iter()
        .map(|e| (e.frame_id.as_str(), e.spheres.len(), e.cylinders.len()))
        .collect();
    assert_eq!(shapes, [("link1", 2, 1), ("link2", 2, 1)]);
    // A cylinder lies along its z: that of the first goes from 0 to 1 m along x, that of the second down.
    for (entity, centre, along) in [
        (&entities[0], Vector3::new(0.5, 0.0, 0.0), Vector3::x()),
        (&entities[1], Vector3::new(0.0, 0.0, -0.1), -Vector3::z()),
    ] {
        let pose = entity.cylinders[0].pose.unwrap();
        let (m, r) = (pose.position.unwrap(), pose.orientation.unwrap());
        let turn = UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(r.w, r.x, r.y, r.z));
        assert!((Vector3::new(m.x, m.y, m.z) - centre).norm() < 1e-6);
        assert!((turn * Vector3::z() - along).norm() < 1e-6);
    }
}
