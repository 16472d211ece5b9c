//! What a chapter's reader has at hand before the first command: recordings of a hand, raw ones too, an arm, and a few of the public recordings.

use std::fmt::Write as _;
use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

use nalgebra::Vector3;
use telemime_operator::demonstration::{Demonstration, Sample};
use telemime_sim::hand::{reach, swing, taps};

use super::text::root;
use crate::data::data;

/// Of each folder of public recordings: commands are run as they stand, on few files.
const FILES: usize = 2;

/// Of each set of folders.
const FOLDERS: usize = 2;

fn recording(path: &Path, samples: Vec<(f64, [f64; 3])>) {
    let samples: Vec<_> = samples
        .into_iter()
        .map(|(t_s, x)| Sample::at(t_s, Vector3::from(x)))
        .collect();
    let text = Demonstration::from_samples(path, &samples)
        .unwrap()
        .to_csv();
    fs::write(path, text).unwrap();
}

/// OpenNI's skeletons: fifteen joints a frame, mm; the fifth is the right hand, the others rest.
fn skeletons(samples: &[(f64, [f64; 3])]) -> String {
    let mut text = String::new();
    for (_, x) in samples {
        for joint in 0..15 {
            let rest = [100.0 * f64::from(joint), 0.0, 2500.0];
            let [x, y, z] = if joint == 4 { x.map(|x| 1e3 * x) } else { rest };
            writeln!(text, "{x} {y} {z}").unwrap();
        }
    }
    text
}

pub(super) fn program() -> &'static Path {
    Path::new(env!("CARGO_BIN_EXE_telemime"))
}

/// Fills the reader's folder.
pub(super) fn give(dir: &Path) {
    for name in ["wave", "pour", "raw"] {
        fs::create_dir(dir.join(name)).unwrap();
    }
    for index in 0..3 {
        recording(&dir.join(format!("wave/{index}.csv")), swing(3, index));
        let goal = [0.3, 0.05 * f64::from(index), 1.9];
        recording(
            &dir.join(format!("pour/{index}.csv")),
            reach(1, index, goal),
        );
    }
    recording(&dir.join("unseen.csv"), swing(3, 5));
    recording(&dir.join("new.csv"), swing(3, 6));
    for index in 7..9 {
        let raw = dir.join(format!("raw/a01_s01_e0{index}.txt"));
        fs::write(raw, skeletons(&swing(3, index))).unwrap();
    }
    let arm = fs::read_to_string(root().join("sim/urdf/mime7.urdf")).unwrap();
    fs::write(dir.join("my_arm.urdf"), arm.replace("\"tcp\"", "\"tool0\"")).unwrap();
    let (samples, pressed) = taps(1, 12);
    recording(&dir.join("taps.csv"), samples);
    let pressed: Vec<_> = pressed.iter().map(|t| format!("{:.4}", t - 0.08)).collect();
    fs::write(dir.join("presses.txt"), pressed.join("\n")).unwrap();
    symlink(root().join("docs"), dir.join("docs")).unwrap();
    let learned = Command::new(program())
        .args(["learn", "wave"])
        .current_dir(dir)
        .output()
        .unwrap();
    assert!(learned.status.success(), "{learned:?}");
    recorded(dir);
}

fn children(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).unwrap();
    let mut all: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    all.sort();
    all
}

/// `data/`: links to a few of the public recordings, and to the publication's series, where they are at hand.
fn recorded(dir: &Path) {
    let all = data().join("data");
    if !all.join("demos").is_dir() {
        return;
    }
    let here = dir.join("data");
    for set in children(&all.join("demos")) {
        let folders = children(&set);
        for folder in folders.iter().filter(|path| path.is_dir()).take(FOLDERS) {
            let into = here.join(folder.strip_prefix(&all).unwrap());
            fs::create_dir_all(&into).unwrap();
            for file in children(folder).iter().take(FILES) {
                symlink(file, into.join(file.file_name().unwrap())).unwrap();
            }
        }
    }
    symlink(all.join("paper"), here.join("paper")).unwrap();
}
