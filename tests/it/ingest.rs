//! Raw recordings to demonstrations: by the library on generated and real recordings, and by the command.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use serde_json::Value;
use telemime_operator::demonstration::Demonstration;
use telemime_operator::ingest::segment::Method;
use telemime_operator::ingest::{Cut, Imported, Options, import};
use telemime_sim::hand;

use crate::data::needs;

/// Times (s) and places (m).
type Hand = Vec<(f64, [f64; 3])>;

/// A cut this near, s, to where it belongs is right.
const NEAR_S: f64 = 0.15;

fn table(hand: &Hand) -> String {
    let rows = hand
        .iter()
        .map(|(t, [x, y, z])| format!("{t},{x},{y},{z}\n"));
    "t,x,y,z\n".to_owned() + &rows.collect::<String>()
}

fn imported(hand: &Hand, cut: Cut) -> Imported {
    let options = Options {
        cut,
        ..Options::default()
    };
    let imported = import(table(hand).as_bytes(), &options).unwrap();
    assert_eq!(imported.report.accounted(), imported.report.frames);
    imported
}

/// The recordings of a shared folder, by name.
fn recordings(folder: &str) -> Option<Vec<Hand>> {
    let mut paths: Vec<PathBuf> = std::fs::read_dir(needs(&format!("data/demos/{folder}"))?)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    paths.sort();
    let read = |path: &PathBuf| {
        let demonstration = Demonstration::read_csv(path).unwrap();
        let samples = demonstration.samples().iter();
        samples.map(|s| (s.t_s, s.position.into())).collect()
    };
    Some(paths.iter().map(read).collect())
}

const UTD: [&str; 4] = [
    "utd_mhad/a01_swipe_left",
    "utd_mhad/a03_wave",
    "utd_mhad/a09_circle_cw",
    "utd_mhad/a15_tennis_swing",
];

#[test]
fn raw_kard_skeletons_give_the_shared_demonstrations() {
    let (Some(raw), Some(demos)) = (
        needs("data/kinect_raw/kard"),
        needs("data/demos/kard/a01_horizontal_arm_wave"),
    ) else {
        return;
    };
    let options = Options {
        keep_glitches: true,
        ..Options::default()
    };
    let mut compared = 0;
    for entry in std::fs::read_dir(raw).unwrap() {
        let path = entry.unwrap().path();
        let stem = path.file_stem().unwrap().to_str().unwrap();
        let stem = stem.strip_suffix("_realworld").unwrap();
        let theirs = Demonstration::read_csv(demos.join(format!("{stem}.csv"))).unwrap();
        let ours = import(&std::fs::read(&path).unwrap(), &options).unwrap();
        let [take] = ours.takes.as_slice() else {
            panic!("{stem}: {} takes", ours.takes.len());
        };
        assert_eq!(take.samples.len(), theirs.samples().len(), "{stem}");
        for (a, b) in take.samples.iter().zip(theirs.samples()) {
            assert!((a.t_s - b.t_s).abs() < 1e-6, "{stem} at {} s", b.t_s);
            let off_m = (a.position - b.position).norm();
            assert!(off_m <= 1e-4, "{stem} at {} s: {off_m} m", b.t_s);
        }
        compared += 1;
    }
    assert_eq!(compared, 6);
}

/// A person's fast swing is no glitch (notes on driving a Kinect live: a speed threshold destroys data).
#[test]
fn real_motion_is_left_alone_however_fast() {
    for (set, fastest_m_s) in UTD.into_iter().zip([24.0, 19.0, 13.0, 30.0]) {
        let Some(hands) = recordings(set) else { return };
        let reports = hands.iter().map(|h| imported(h, Cut::Whole).report);
        let (mut removed, mut kept_m_s) = (0, 0.0_f64);
        for report in reports {
            removed += report.glitches_s.len();
            kept_m_s = kept_m_s.max(report.fastest_kept_m_s);
        }
        assert_eq!(removed, 0, "{set}");
        assert!(kept_m_s > fastest_m_s, "{set}: {kept_m_s} m/s");
    }
}

/// Precision and recall of finding `run` displaced samples in a row, put into about 3 % of places.
fn found(hands: &[Hand], run: usize, size_m: f64) -> (f64, f64) {
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(5);
    let (mut put, mut found, mut right) = (0, 0, 0);
    for hand in hands {
        let mut hand = hand.clone();
        let mut bad = Vec::new();
        let mut i = 2;
        while i + run + 2 < hand.len() {
            if rng.random_range(0.0..1.0) < 0.03 {
                let d: [f64; 3] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
                let norm = d.iter().map(|x| x * x).sum::<f64>().sqrt();
                for (t, x) in &mut hand[i..i + run] {
                    x.iter_mut()
                        .zip(d)
                        .for_each(|(x, d)| *x += size_m * d / norm);
                    bad.push(*t);
                }
                i += 8;
            }
            i += 1;
        }
        let glitches = imported(&hand, Cut::Whole).report.glitches_s;
        put += bad.len();
        found += glitches.len();
        let is_bad = |g: &&f64| bad.iter().any(|b| (*g - b).abs() < 1e-6);
        right += glitches.iter().filter(is_bad).count();
    }
    (
        f64::from(right as u32) / f64::from(found as u32),
        f64::from(right as u32) / f64::from(put as u32),
    )
}

#[test]
fn single_and_double_glitches_are_found_in_fast_swings() {
    let swings: Vec<Hand> = (0..30).map(|seed| hand::swing(seed, 1)).collect();
    for (run, size_m, least) in [
        (1, 0.2, 0.75),
        (1, 0.5, 0.99),
        (2, 0.2, 0.7),
        (2, 0.5, 0.99),
    ] {
        let (precision, recall) = found(&swings, run, size_m);
        assert_eq!(precision, 1.0, "{run} of {size_m} m");
        assert!(recall >= least, "{run} of {size_m} m: {recall}");
    }
    for (set, least) in UTD.into_iter().zip([0.99, 0.92, 0.97, 0.9]) {
        let Some(hands) = recordings(set) else { return };
        for run in [1, 2] {
            let (precision, recall) = found(&hands, run, 0.5);
            assert_eq!(precision, 1.0, "{set}, {run}");
            assert!(recall >= least, "{set}, {run}: {recall}");
        }
    }
}

/// Cuts wanted, met, and made, over the persons 0 to 19 who wave without rest; the side at which a repetition begins is the cutter's choice.
fn waves_cut(record: impl Fn(Hand) -> Hand) -> (usize, usize, usize) {
    let (mut wanted, mut met, mut made) = (0, 0, 0);
    for seed in 0..20 {
        let wave = record(hand::swing(seed, 0));
        let report = imported(&wave, Cut::Repetitions).report;
        let [cuts] = report.cuts.as_slice() else {
            panic!("{:?}", report.cuts);
        };
        let near = |turn: &&f64| cuts.at_s.iter().any(|t| (t - **turn).abs() < NEAR_S);
        let turns = hand::turns(seed, 0);
        let sides = [0, 1].map(|side| {
            let side = turns.iter().skip(side).step_by(2);
            (side.clone().filter(near).count(), side.count())
        });
        let [(hit, of)] = [sides[0].max(sides[1])];
        (wanted, met, made) = (wanted + of, met + hit, made + cuts.at_s.len());
    }
    (wanted, met, made)
}

#[test]
fn waving_without_rest_is_cut_where_it_turns() {
    let (wanted, met, made) = waves_cut(|wave| wave);
    assert!(
        wanted > 200 && met == wanted && made == wanted,
        "{met} of {wanted}, {made} made"
    );

    // A tenth of the frames lost, times off by up to 10 ms, and so much noise (standard deviation) in each coordinate.
    for (noise_m, share) in [(0.0, 1.0), (0.01, 0.92), (0.02, 0.97)] {
        let (wanted, met, made) = waves_cut(|wave| {
            let mut rng = Xoshiro256PlusPlus::seed_from_u64(9);
            let kept = |i: usize, rng: &mut Xoshiro256PlusPlus| {
                i == 0 || rng.random_range(0.0..1.0) >= 0.1
            };
            let half = noise_m * 3.0_f64.sqrt();
            let rows = wave.into_iter().enumerate().filter_map(|(i, (t, x))| {
                if !kept(i, &mut rng) {
                    return None;
                }
                let late = if i == 0 {
                    0.0
                } else {
                    rng.random_range(-0.01..0.01)
                };
                let x = x.map(|x| x + half * rng.random_range(-1.0..1.0));
                Some((t + late, x))
            });
            rows.collect()
        });
        let (wanted, met, made) = (wanted as f64, met as f64, made as f64);
        assert!(met >= share * wanted, "{noise_m} m: {met} of {wanted}");
        assert!(met >= 0.97 * made, "{noise_m} m: {met} of {made}");
    }
}

/// From one random place to the next, none twice, in changing times, none so long that turning there is a rest.
fn wandering(seed: u64) -> Hand {
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
    let mut hand: Hand = Vec::new();
    let mut from: [f64; 3] = [0.0; 3];
    for _ in 0..8 {
        let to: [f64; 3] = std::array::from_fn(|_| rng.random_range(-0.5..0.5));
        let frames = rng.random_range(12..30);
        for k in 0..frames {
            let u = f64::from(k) / f64::from(frames);
            let s = u * u * u * (10.0 - 15.0 * u + 6.0 * u * u);
            let place = std::array::from_fn(|d| from[d] + (to[d] - from[d]) * s);
            hand.push((hand.len() as f64 / 30.0, place));
        }
        from = to;
    }
    hand
}

#[test]
fn what_does_not_repeat_is_not_cut() {
    let method = |seed| {
        let imported = imported(&wandering(seed), Cut::Repetitions);
        imported.report.cuts[0].method
    };
    let methods: Vec<Method> = (0..40).map(method).collect();
    assert!(!methods.contains(&Method::Returns), "{methods:?}");
    // Two near places make a step so slow that it looks like a rest.
    let cut = methods.iter().filter(|m| **m == Method::Rests).count();
    assert!(cut <= 1, "{methods:?}");
}

/// Recordings one after the other with pauses in between, in which the hand moves to where the next begins; and when the pauses are.
fn joined(hands: &[Hand], pause_s: f64) -> (Hand, Vec<(f64, f64)>) {
    let mut all: Hand = Vec::new();
    let mut pauses = Vec::new();
    for hand in hands {
        let mut zero = 0.0;
        if let Some(&(t, a)) = all.last() {
            let b = hand[0].1;
            let frames = (pause_s * 30.0) as usize;
            for k in 1..frames {
                let u = k as f64 / frames as f64;
                let s = u * u * u * (10.0 - 15.0 * u + 6.0 * u * u);
                all.push((
                    t + pause_s * u,
                    std::array::from_fn(|d| a[d] + (b[d] - a[d]) * s),
                ));
            }
            pauses.push((t, t + pause_s));
            zero = t + pause_s;
        }
        all.extend(hand.iter().map(|(t, x)| (zero + t, *x)));
    }
    (all, pauses)
}

/// Pauses, those with a cut in or near them, and cuts, over groups of recordings joined into one.
fn pauses_cut(hands: &[Hand], group: usize, pause_s: f64) -> (usize, usize, usize) {
    let (mut wanted, mut met, mut made) = (0, 0, 0);
    for group in hands.chunks(group) {
        let (hand, pauses) = joined(group, pause_s);
        let report = imported(&hand, Cut::Repetitions).report;
        let cuts = &report.cuts[0].at_s;
        let near = |&&(from, to): &&(f64, f64)| {
            cuts.iter()
                .any(|t| (from - NEAR_S..to + NEAR_S).contains(t))
        };
        wanted += pauses.len();
        met += pauses.iter().filter(near).count();
        made += cuts.len();
    }
    (wanted, met, made)
}

#[test]
fn performances_with_rests_are_cut_apart() {
    let swings: Vec<Hand> = (0..20)
        .flat_map(|seed| (0..5).map(move |i| hand::swing(seed, i)))
        .collect();
    for pause_s in [0.1, 1.0] {
        assert_eq!(pauses_cut(&swings, 5, pause_s), (80, 80, 80), "{pause_s} s");
    }
    for set in UTD {
        let Some(hands) = recordings(set) else { return };
        assert_eq!(pauses_cut(&hands, 4, 1.0), (24, 24, 24), "{set}");
        let (wanted, met, made) = pauses_cut(&hands, 4, 0.5);
        assert!(
            met + 1 >= wanted && made == met,
            "{set}: {met} of {wanted}, {made} made"
        );
    }
}

fn telemime(args: &[&str], paths: &[&Path]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_telemime"))
        .args(args)
        .args(paths)
        .output()
        .unwrap()
}

fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

/// A 15-joint recording in mm: the right hand moves, the other joints stand.
fn kard(hand: &Hand) -> String {
    let mut out = String::new();
    for (_, place) in hand {
        for joint in 0..15 {
            let at = if joint == 4 {
                *place
            } else {
                [0.1, 0.01 * f64::from(joint), 2.5]
            };
            let [x, y, z] = at.map(|v| v * 1e3);
            out += &format!("{x} {y} {z}\n");
        }
    }
    out
}

#[test]
fn the_command_makes_a_folder_that_can_be_learned_from() {
    let dir = tempfile::tempdir().unwrap();
    let (out, figure) = (dir.path().join("swing"), dir.path().join("cuts.svg"));
    let raw: Vec<PathBuf> = (0..3)
        .map(|i| {
            let path = dir.path().join(format!("take{i}.txt"));
            std::fs::write(&path, kard(&hand::swing(5, i))).unwrap();
            path
        })
        .collect();
    let raw: Vec<&Path> = raw.iter().map(PathBuf::as_path).collect();
    let (to, drawn) = (out.to_str().unwrap(), figure.to_str().unwrap());
    let args = [
        "import",
        "--joint",
        "HandRight",
        "-o",
        to,
        "--json",
        "--figure",
        drawn,
    ];
    let done = telemime(&args, &raw);
    assert!(done.status.success(), "{}", text(&done.stderr));
    let told: Value = serde_json::from_slice(&done.stdout).unwrap();
    assert_eq!(told["failed"], 0);
    assert_eq!(told["files"][1]["report"]["format"], "kard");
    assert_eq!(told["files"][1]["report"]["fps"], 30.0);
    let written = told["files"][2]["written"][0].as_str().unwrap();
    let read = Demonstration::read_csv(written).unwrap();
    for (sample, (_, place)) in read.samples().iter().zip(hand::swing(5, 2)) {
        assert!((sample.position - nalgebra::Vector3::from(place)).norm() < 1e-9);
    }
    assert!(
        std::fs::read_to_string(&figure)
            .unwrap()
            .contains("take1.txt")
    );

    // What is there stays, unless one insists.
    let again = telemime(&["import", "-o", to], &raw[..1]);
    assert_eq!(again.status.code(), Some(1));
    assert!(text(&again.stderr).contains("take0.csv exists; --force overwrites it"));
    let forced = telemime(&["import", "--force", "--segment", "-o", to], &raw[..1]);
    assert!(forced.status.success(), "{}", text(&forced.stderr));
    assert!(text(&forced.stdout).contains("cut where the motion returns"));
    assert!(text(&forced.stderr).contains("take0.csv is left from an earlier import"));

    let skill = dir.path().join("swing.skill");
    let learned = telemime(&["learn", to, "-o", skill.to_str().unwrap()], &[]);
    assert!(learned.status.success(), "{}", text(&learned.stderr));
}

#[test]
fn a_bad_file_is_named_and_the_others_are_converted() {
    let dir = tempfile::tempdir().unwrap();
    let good = kard(&hand::swing(1, 0));
    let lines: Vec<&str> = good.lines().collect();
    let nothing = "nan nan nan\n".repeat(150);
    let broken = lines[..40].join("\n") + "\n1 2 x\n" + &lines[41..45].join("\n");
    let mixed = lines[..30].join("\n") + "\n1 2 3 4\n" + &lines[30..60].join("\n");
    let cases: [(&str, String, &[&str]); 8] = [
        (
            "cut_off.txt",
            lines[..97].join("\n"),
            &["line 91", "7 of 15 joints"],
        ),
        ("empty.txt", "\n\n".into(), &["no frames"]),
        ("unseen.txt", nothing, &["10 of them without the hand"]),
        (
            "broken.txt",
            broken,
            &["line 41: z of right_knee", "\"x\", not a number"],
        ),
        ("mixed.txt", mixed, &["line 31: 4 fields where kard has 3"]),
        (
            "column.csv",
            "t,x,y,height\n0,1,2,3\n".into(),
            &["no column \"z\"", "t,x,y,height"],
        ),
        (
            "bare.csv",
            "0,1,2,3,4\n".repeat(9),
            &["no header and 5 columns", "--columns"],
        ),
        (
            "far.csv",
            table(
                &(0..20)
                    .map(|i| (0.03 * f64::from(i), [40.0 * f64::from(i), 0.0, 9.0]))
                    .collect(),
            ),
            &["--unit"],
        ),
    ];
    let mut raw: Vec<PathBuf> = Vec::new();
    for (name, content, _) in &cases {
        raw.push(dir.path().join(name));
        std::fs::write(dir.path().join(name), content).unwrap();
    }
    raw.push(dir.path().join("missing.txt"));
    raw.push(dir.path().join("good.txt"));
    std::fs::write(dir.path().join("good.txt"), &good).unwrap();
    let raw: Vec<&Path> = raw.iter().map(PathBuf::as_path).collect();
    let out = dir.path().join("out");
    let done = telemime(&["import", "-o", out.to_str().unwrap()], &raw);
    assert_eq!(done.status.code(), Some(1));
    let errors = text(&done.stderr);
    for (name, _, words) in &cases {
        let line = errors
            .lines()
            .find(|l| l.contains(name))
            .unwrap_or_else(|| panic!("{errors}"));
        for word in *words {
            assert!(line.contains(word), "{word:?} in {line}");
        }
    }
    assert!(
        errors.contains("missing.txt") && errors.contains("9 of 10 recordings"),
        "{errors}"
    );
    let written: Vec<_> = std::fs::read_dir(&out).unwrap().collect();
    assert_eq!(written.len(), 1);
    assert!(out.join("good.csv").is_file());

    let wrong = telemime(
        &[
            "import",
            "--joint",
            "right_toe",
            "-o",
            out.to_str().unwrap(),
            "--force",
        ],
        &raw[9..],
    );
    assert_eq!(wrong.status.code(), Some(1));
    assert!(
        text(&wrong.stderr).contains("one of head, neck, right_shoulder"),
        "{}",
        text(&wrong.stderr)
    );
}

#[test]
fn one_recording_is_never_its_own_output_and_one_folder_is_one_shape() {
    let dir = tempfile::tempdir().unwrap();
    let raw = dir.path().join("a.csv");
    let content = table(&hand::swing(2, 0));
    std::fs::write(&raw, &content).unwrap();
    let here = dir.path().to_str().unwrap();
    let own = telemime(&["import", "--force", "-o", here], &[&raw]);
    assert_eq!(own.status.code(), Some(1));
    assert!(text(&own.stderr).contains("is itself one of the recordings"));
    assert_eq!(std::fs::read_to_string(&raw).unwrap(), content);

    let posed = dir.path().join("posed.csv");
    let rows: String = (0..20)
        .map(|i| format!("{},0,0,{i}e-3,1,0,0,0\n", f64::from(i) * 0.03))
        .collect();
    std::fs::write(&posed, "t,x,y,z,qw,qx,qy,qz\n".to_owned() + &rows).unwrap();
    let out = dir.path().join("out");
    let both = telemime(&["import", "-o", out.to_str().unwrap()], &[&raw, &posed]);
    assert_eq!(both.status.code(), Some(1));
    assert!(
        text(&both.stderr).contains("one folder is one skill"),
        "{}",
        text(&both.stderr)
    );
    assert!(out.join("a.csv").is_file() && !out.join("posed.csv").exists());
}

#[test]
fn by_hand_and_by_rest_are_told_apart_in_the_report() {
    let wave = hand::swing(3, 0);
    let by_hand = imported(&wave, Cut::At(vec![4.0, 2.0]));
    assert_eq!(by_hand.report.cuts[0].method, Method::ByHand);
    assert_eq!(by_hand.report.cuts[0].at_s, [2.0, 4.0]);
    let starts: Vec<f64> = by_hand.report.takes.iter().map(|t| t.from_s).collect();
    assert!(starts[0] == 0.0 && starts[1] >= 2.0 && starts[2] >= 4.0 && starts[2] < 4.05);
    assert_eq!(by_hand.report.outside, 0);
}
