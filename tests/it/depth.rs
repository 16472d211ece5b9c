//! The hand in depth frames: real ones beside the tracker's own joint, rendered ones beside the truth, and both as users have them.

use std::fs::File;
use std::io::BufWriter;
use std::ops::{Range, RangeInclusive};
use std::path::Path;

use nalgebra::Vector3;
use rustix::process::Signal;
use telemime_operator::demonstration::Demonstration;
use telemime_operator::depth::{Camera, Finder, Folder, Found, Size};
use telemime_sim::hand::{Scene, swing};

use crate::data::needs;
use crate::processes::{Process, Stage, alone};

/// The recordings, and where their joints are.
const REAL: [(&str, &str); 3] = [
    ("a1_s1_t1", "a01_swipe_left"),
    ("a3_s2_t1", "a03_wave"),
    ("a9_s3_t2", "a09_circle_cw"),
];

/// The tracker's joints of these recordings run ahead of the depth frames of the same number by two frames: its hand leaves the
/// picture's on every swing, in all three, and is on it again two frames later.
const AHEAD: usize = 2;

/// The leads that are tried.
const LEADS: RangeInclusive<isize> = -2..=7;

/// So much nearer than at rest, the hand is away from the body, m.
const AWAY_M: f64 = 0.2;

const FPS: f64 = 30.0;

fn finder(size: Size) -> Finder {
    Finder::new(Camera::new(size, None, 1e-3, false).unwrap())
}

fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values[((values.len() - 1) as f64 * share).round() as usize]
}

/// A recording: the tracker's joint and what was found, frame by frame as numbered.
struct Recorded {
    name: &'static str,
    joints: Vec<Vector3<f64>>,
    found: Vec<Option<Found>>,
}

impl Recorded {
    /// All of them, where they are at hand.
    fn all() -> Option<Vec<Self>> {
        let read = |(name, task): (&'static str, &str)| {
            let frames = needs(&format!("data/kinect_depth/{name}"))?;
            let joints = needs(&format!("data/demos/utd_mhad/{task}/{name}.csv"))?;
            let folder = Folder::open(&frames).unwrap();
            let joints = Demonstration::read_csv(&joints).unwrap();
            let joints: Vec<_> = joints.samples().iter().map(|s| s.position).collect();
            assert_eq!(joints.len(), folder.len());
            let mut finder = finder(folder.size());
            let found = (0..folder.len())
                .map(|i| finder.find(i as f64 / FPS, &folder.frame(i).unwrap()))
                .collect();
            Some(Self {
                name,
                joints,
                found,
            })
        };
        REAL.into_iter().map(read).collect()
    }

    /// The joint that is `ahead` frames before frame `i`.
    fn joint(&self, i: usize, ahead: isize) -> Option<Vector3<f64>> {
        let at = i.checked_add_signed(-ahead)?;
        self.joints.get(at).copied()
    }

    /// How far the centroids of these frames are from the joints of `ahead` frames before.
    fn off(&self, frames: Range<usize>, ahead: isize) -> Vec<f64> {
        let off = |i: usize| {
            let found = self.found[i].as_ref()?;
            Some((found.position - self.joint(i, ahead)?).norm())
        };
        frames.filter_map(off).collect()
    }

    fn whole(&self) -> Range<usize> {
        0..self.found.len()
    }

    fn halves(&self) -> [Range<usize>; 2] {
        let middle = self.found.len() / 2;
        [0..middle, middle..self.found.len()]
    }

    /// Correlation of the centroid's velocity with that of the joint `ahead` frames before, over these frames: no place enters, so neither does
    /// where in the hand a tracker has its joint.
    fn velocities(&self, frames: Range<usize>, ahead: isize) -> f64 {
        let pairs: Vec<_> = frames
            .filter_map(|i| {
                let (from, to) = (
                    self.found.get(i)?.as_ref()?,
                    self.found.get(i + 1)?.as_ref()?,
                );
                let joint = self.joint(i + 1, ahead)? - self.joint(i, ahead)?;
                Some((to.position - from.position, joint))
            })
            .collect();
        let n = pairs.len() as f64;
        let a = pairs.iter().map(|p| p.0).sum::<Vector3<f64>>() / n;
        let b = pairs.iter().map(|p| p.1).sum::<Vector3<f64>>() / n;
        let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
        for (x, y) in &pairs {
            ab += (x - a).dot(&(y - b));
            aa += (x - a).norm_squared();
            bb += (y - b).norm_squared();
        }
        ab / (aa * bb).sqrt()
    }
}

/// The lead at which `worth` is largest.
fn best(worth: impl Fn(isize) -> f64) -> isize {
    LEADS
        .max_by(|a, b| worth(*a).total_cmp(&worth(*b)))
        .unwrap()
}

fn median(off: Vec<f64>) -> f64 {
    quantile(off, 0.5)
}

#[test]
fn on_real_recordings_the_hand_is_where_the_tracker_has_it_and_never_lost_while_away() {
    let Some(all) = Recorded::all() else {
        return;
    };
    for of in &all {
        let name = of.name;
        let off = of.off(of.whole(), AHEAD as isize);
        let (median, p95) = (quantile(off.clone(), 0.5), quantile(off, 0.95));
        let as_numbered = quantile(of.off(of.whole(), 0), 0.5);
        // Away with certainty: before, at and after the moment, whatever the tracker's lead.
        let rest = of.joints[0].z;
        let away = |i: usize| {
            of.joints[i.saturating_sub(AHEAD)..=i]
                .iter()
                .all(|j| rest - j.z > AWAY_M)
        };
        let (mut frames, mut lost) = (0, 0);
        for (i, found) in of.found.iter().enumerate().filter(|(i, _)| away(*i)) {
            frames += 1;
            lost += usize::from(found.is_none());
            if found.is_none() {
                eprintln!("{name}: lost in frame {i}");
            }
        }
        println!(
            "{name}: median {:.1} cm, p95 {:.1} cm ({:.1} cm frame by frame as numbered); {lost} of {frames} frames away lost",
            median * 1e2,
            p95 * 1e2,
            as_numbered * 1e2
        );
        assert!(median <= 0.06, "{name}: {median}");
        assert!(frames >= 15 && lost == 0, "{name}: {lost} of {frames}");
    }
}

/// The lead is no fit to the figure it is used for: chosen on other recordings, on the other half, or without any place, it is about the same.
#[test]
fn on_real_recordings_the_trackers_lead_is_found_without_what_it_is_judged_on() {
    let Some(all) = Recorded::all() else {
        return;
    };
    for of in &all {
        let others = |ahead| {
            let others = all.iter().filter(|other| other.name != of.name);
            -others.map(|o| median(o.off(o.whole(), ahead))).sum::<f64>()
        };
        let ahead = best(others);
        let left_out = median(of.off(of.whole(), ahead));
        let by_velocity = best(|ahead| of.velocities(of.whole(), ahead));
        println!(
            "{}: lead {ahead} by the others: median {:.1} cm; by velocities {by_velocity} (correlation {:.2}, {:.2} as numbered): {:.1} cm",
            of.name,
            left_out * 1e2,
            of.velocities(of.whole(), by_velocity),
            of.velocities(of.whole(), 0),
            1e2 * median(of.off(of.whole(), by_velocity)),
        );
        let [first, second] = of.halves();
        for (chosen, judged) in [(&first, &second), (&second, &first)] {
            let by_place = best(|ahead| -median(of.off(chosen.clone(), ahead)));
            println!(
                "  half {chosen:?}: lead {by_place} by places, {} by velocities; the other half's median {:.1} cm",
                best(|ahead| of.velocities(chosen.clone(), ahead)),
                1e2 * median(of.off(judged.clone(), by_place)),
            );
        }
        assert!(left_out <= 0.06, "{}: {left_out}", of.name);
        assert!((1..=3).contains(&by_velocity), "{}: {by_velocity}", of.name);
    }
}

/// A person who swings an arm, rendered: frames, and where the hand was.
fn rendered(size: (usize, usize), wall_m: Option<f64>, seed: u64) -> (Scene, Vec<Vector3<f64>>) {
    let hand: Vec<_> = swing(seed, 0).into_iter().map(|(_, x)| x).collect();
    let [x, y, z] = hand[0];
    let scene = Scene {
        width: size.0,
        height: size.1,
        // The hand hangs beside the hip.
        chest_m: [x - 0.25, y + 0.35, z + 0.02],
        wall_m,
        errs: true,
    };
    (scene, hand.into_iter().map(Vector3::from).collect())
}

#[test]
fn through_noise_holes_and_specks_and_before_a_wall_the_hand_is_found() {
    for (size, wall_m, seed) in [
        ((320, 240), None, 1),
        ((320, 240), Some(1.2), 2),
        ((640, 480), Some(1.2), 1),
    ] {
        let (scene, hand) = rendered(size, wall_m, seed);
        let mut finder = finder(Size {
            width: size.0,
            height: size.1,
        });
        let mut off = Vec::new();
        let (mut away, mut lost, mut invented) = (0, 0, 0);
        for (i, x) in hand.iter().enumerate().step_by(2) {
            let frame = scene.frame(seed, i as u32, (*x).into());
            let nearer_m = scene.chest_m[2] - x.z;
            let found = finder.find(i as f64 / FPS, &frame);
            if let Some(found) = found {
                off.push((found.position - x).norm());
            }
            away += usize::from(nearer_m > 0.3);
            lost += usize::from(nearer_m > 0.3 && found.is_none());
            invented += usize::from(nearer_m < 0.05 && found.is_some());
        }
        let [median, p90, p95] = [0.5, 0.9, 0.95].map(|share| quantile(off.clone(), share));
        println!(
            "{size:?}: median {median:.3} m, p90 {p90:.3} m, p95 {p95:.3} m; {lost} of {away} lost"
        );
        assert!(median < 0.02 && p90 < 0.05, "{size:?}: {median} {p90}");
        assert!(away > 20 && lost == 0, "{size:?}: {lost} of {away}");
        assert_eq!(invented, 0, "{size:?}: a hand at rest is none");
    }
}

#[test]
fn frames_without_a_hand_have_none() {
    let size = Size {
        width: 320,
        height: 240,
    };
    let mut finder = finder(size);
    let n = size.width * size.height;
    assert_eq!(finder.find(0.0, &vec![0; n]), None);
    assert_eq!(finder.find(0.1, &vec![2000; n]), None, "a wall");
    assert_eq!(finder.find(0.2, &vec![u16::MAX; n]), None);
    assert_eq!(finder.find(0.3, &[1000; 7]), None, "another camera");
    let mut specks = vec![2000; n];
    specks.iter_mut().step_by(97).for_each(|d| *d = 900);
    assert_eq!(finder.find(0.4, &specks), None, "specks are no hand");
}

fn write(path: &Path, scene: &Scene, frame: &[u16]) {
    let file = BufWriter::new(File::create(path).unwrap());
    let mut encoder = png::Encoder::new(file, scene.width as u32, scene.height as u32);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Sixteen);
    let bytes: Vec<u8> = frame.iter().flat_map(|d| d.to_be_bytes()).collect();
    let mut writer = encoder.write_header().unwrap();
    writer.write_image_data(&bytes).unwrap();
}

#[test]
fn a_folder_of_frames_is_imported_and_drives() {
    let _alone = alone();
    let stage = Stage::new();
    let (scene, hand) = rendered((160, 120), Some(1.2), 3);
    let folder = stage.path("frames");
    std::fs::create_dir(&folder).unwrap();
    for (i, x) in hand.iter().enumerate() {
        let frame = scene.frame(3, i as u32, (*x).into());
        write(&folder.join(format!("{i}.png")), &scene, &frame);
    }
    let frames = folder.to_str().unwrap();
    let out = stage.text("imported");
    let import = Process::start(&[
        "import",
        "--format",
        "depth",
        frames,
        "-o",
        &out,
        "--json",
        "--max-gap",
        "5",
    ]);
    let said: serde_json::Value = serde_json::from_str(&import.line().unwrap()).unwrap();
    assert!(import.end().0.success());
    assert_eq!(said["failed"], 0, "{said}");
    let report = &said["files"][0]["report"];
    assert_eq!(
        (&report["format"], &report["frames"]),
        (&"depth".into(), &hand.len().into())
    );
    let written = said["files"][0]["written"][0].as_str().unwrap();
    let imported = Demonstration::read_csv(Path::new(written)).unwrap();
    let near = |x: &Vector3<f64>| {
        let off = hand.iter().map(|h| (h - x).norm());
        off.fold(f64::INFINITY, f64::min)
    };
    let off: Vec<f64> = imported
        .samples()
        .iter()
        .map(|s| near(&s.position))
        .collect();
    let [median, p90] = [0.5, 0.9].map(|share| quantile(off.clone(), share));
    assert!(median < 0.04 && p90 < 0.12, "{median} {p90}");

    let (robot, addr) = stage.robot();
    let input = format!("depth:{frames}");
    let operator = crate::input::operator(
        &stage,
        &addr,
        &["--input", &input, "--engage", "--until-end"],
    );
    operator.event("engaged");
    let done = operator.event("done");
    assert_eq!(done["completed"], true, "{done}");
    let samples = done["input"]["samples"].as_u64().unwrap() as usize;
    let untracked = done["input"]["dropped"]["untracked"].as_u64().unwrap_or(0) as usize;
    assert_eq!(
        samples + untracked,
        hand.len(),
        "every frame is accounted for: {done}"
    );
    assert!(done["messages"].as_u64().unwrap() > 10, "{done}");
    assert!(operator.end().0.success());
    robot.signal(Signal::TERM);
    assert!(robot.end().0.success());
}
