//! `learn` and `inspect` as commands: the skill file, the picture of it, the JSON object.

use std::path::Path;
use std::process::{Command, Output};

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use telemime_operator::demonstration::{Demonstration, Sample};
use telemime_sim::hand::swing_with_wrist;

fn telemime(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_telemime"))
        .current_dir(folder)
        .args(args)
        .output()
        .unwrap()
}

fn recordings(folder: &Path) {
    std::fs::create_dir(folder).unwrap();
    for index in 0..3 {
        let samples: Vec<_> = swing_with_wrist(5, index)
            .into_iter()
            .map(|p| {
                let [w, x, y, z] = p.q;
                Sample {
                    orientation: Some(UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z))),
                    grip: Some(if p.t_s < 2.0 { 1.0 } else { 0.25 }),
                    ..Sample::at(p.t_s, Vector3::from(p.x))
                }
            })
            .collect();
        let text = Demonstration::from_samples(format!("{index}"), &samples)
            .unwrap()
            .to_csv();
        std::fs::write(folder.join(format!("{index}.csv")), text).unwrap();
    }
}

#[test]
fn a_skill_is_learned_drawn_and_told() {
    let dir = tempfile::tempdir().unwrap();
    recordings(&dir.path().join("swing"));
    let learned = telemime(
        dir.path(),
        &["learn", "swing", "--figure", "learned.svg", "--json"],
    );
    assert!(learned.status.success(), "{learned:?}");
    let told: serde_json::Value = serde_json::from_slice(&learned.stdout).unwrap();
    assert_eq!(told["name"], "swing");
    assert_eq!(told["orientation"], true);
    assert_eq!(told["gripper"], true);
    let svg = std::fs::read_to_string(dir.path().join("learned.svg")).unwrap();
    for text in [
        "Skill: swing",
        "x over time",
        "95 % region",
        "Gaussians",
        "demonstrations",
        "in proportional time",
        "aligned:",
        "orientation from where it begins",
        "gripper",
    ] {
        assert!(svg.contains(text), "{text}");
    }

    let inspected = telemime(
        dir.path(),
        &[
            "inspect",
            "swing.skill",
            "--figure",
            "inspected.svg",
            "--demos",
            "swing",
            "--json",
        ],
    );
    assert!(inspected.status.success(), "{inspected:?}");
    assert_eq!(inspected.stdout, learned.stdout);
    let again = std::fs::read_to_string(dir.path().join("inspected.svg")).unwrap();
    assert_eq!(again, svg, "the same picture, from the file");
    let motion = told["motion"].as_array().unwrap();
    assert_eq!(motion.len(), 101);
    let (first, last) = (&motion[0], &motion[100]);
    assert_eq!(first["t_s"], 0.0);
    assert_eq!(last["t_s"], told["duration_s"]);
    assert_eq!(last["q"].as_array().unwrap().len(), 4);

    let truth = telemime(
        dir.path(),
        &[
            "inspect",
            "swing.skill",
            "--figure",
            "truth.png",
            "--truth",
            "swing/1.csv",
            "--confidence",
            "0.5",
        ],
    );
    assert!(truth.status.success(), "{truth:?}");
    let png = std::fs::read(dir.path().join("truth.png")).unwrap();
    assert!(png.starts_with(b"\x89PNG"));
}

#[test]
fn what_cannot_be_drawn_is_said() {
    let dir = tempfile::tempdir().unwrap();
    recordings(&dir.path().join("swing"));
    assert!(telemime(dir.path(), &["learn", "swing"]).status.success());
    let early = telemime(
        dir.path(),
        &["learn", "swing", "-o", "b.skill", "--figure", "b.jpg"],
    );
    let text = String::from_utf8(early.stderr).unwrap();
    assert!(
        !early.status.success() && text.contains(".svg or .png"),
        "{text}"
    );
    assert!(
        !dir.path().join("b.skill").exists(),
        "refused before learning"
    );
    for (args, words) in [
        (&["--figure", "a.jpg"][..], ".svg or .png"),
        (&["--figure", "none/a.svg"], "make it first"),
        (&["--figure", "a.svg", "--demos", "nowhere"], "nowhere"),
        (&["--figure", "a.svg", "--confidence", "1"], "not a share"),
        (&["--frame", "goal=0,0,0"], "frame"),
    ] {
        let refused = telemime(dir.path(), &[&["inspect", "swing.skill"], args].concat());
        let text = String::from_utf8(refused.stderr).unwrap();
        assert!(!refused.status.success() && text.contains(words), "{text}");
    }
}
