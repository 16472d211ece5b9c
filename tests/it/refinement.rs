//! A skill refined by one demonstration more, beside one learned from all of them at once.

use nalgebra::{UnitQuaternion, Vector3};
use telemime_operator::demonstration::{Demonstration, Demonstrations, Sample};
use telemime_operator::learn::frames::{GOAL, START};
use telemime_operator::learn::predictor::states;
use telemime_operator::learn::{LearnError, LearnOptions, learn_skill, refine};
use telemime_protocol::skill::{Gmr, Skill};
use telemime_sim::hand::{reach, swing};

use crate::data::needs;

fn of(name: &str, samples: Vec<(f64, [f64; 3])>) -> Demonstration {
    let samples: Vec<_> = samples
        .into_iter()
        .map(|(t_s, x)| Sample::at(t_s, Vector3::from(x)))
        .collect();
    Demonstration::from_samples(name, &samples).unwrap()
}

fn swung(seed: u64, index: u32) -> Demonstration {
    of(&format!("swing {index}"), swing(seed, index))
}

fn learned(demonstrations: &[Demonstration], options: &LearnOptions) -> Skill {
    learn_skill("it", demonstrations, options, |_| ()).unwrap()
}

/// Quick where only the predictor is judged.
fn coarse() -> LearnOptions {
    LearnOptions {
        motion_components: 12..=12,
        ..LearnOptions::default()
    }
}

/// Root mean square error of the mixture 100 to 300 ms ahead, m.
fn error_m(skill: &Skill, d: &Demonstration) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for (s, state) in d.samples().iter().zip(states(d)) {
        let p = skill.predictor().posterior(&state);
        for j in 3..=9_usize {
            let h_s = j as f64 / 30.0;
            if s.t_s + h_s <= d.last().t_s {
                let truth = d.position_at(s.t_s + h_s) - s.position;
                sum += (p.displacement[j - 1] - truth).norm_squared();
                count += 1.0;
            }
        }
    }
    (sum / count).sqrt()
}

#[test]
fn a_fourth_demonstration_is_worth_nearly_what_it_is_from_the_start() {
    let (mut three, mut refined, mut four) = (0.0, 0.0, 0.0);
    for seed in 0..8 {
        let all: Vec<_> = (0..4).map(|i| swung(seed, i)).collect();
        let test = swung(seed, 5);
        let old = learned(&all[..3], &coarse());
        let (new, what) = refine(&old, &all[3]).unwrap();
        assert!(!what.is_unlike(), "{what:?}");
        let batch = learned(&all, &coarse());
        three += error_m(&old, &test).ln() / 8.0;
        refined += error_m(&new, &test).ln() / 8.0;
        four += error_m(&batch, &test).ln() / 8.0;

        assert!((new.duration_s() - batch.duration_s()).abs() < 1e-9);
        // Copies at other paces count by their weight, rounded.
        let rows = |s: &Skill| s.parts().samples.predictor;
        assert!(rows(&new).abs_diff(rows(&batch)) <= 1);
        assert_eq!(new.provenance().sources, batch.provenance().sources);
        assert_eq!(
            (new.stats().min, new.stats().max),
            (batch.stats().min, batch.stats().max)
        );
        assert!((new.pace().mean_ln_s - batch.pace().mean_ln_s).abs() < 1e-12);
        assert!((new.pace().deviation_ln - batch.pace().deviation_ln).abs() < 0.02);
        let (a, b) = (
            new.predictor().calibration(),
            batch.predictor().calibration(),
        );
        let ratio = a.novelty90 / b.novelty90;
        assert!(
            (0.5..2.0).contains(&ratio),
            "{} {}",
            a.novelty90,
            b.novelty90
        );
    }
    let (refined, four) = ((refined - three).exp(), (four - three).exp());
    println!(
        "error against three demonstrations: refined {refined:.3}, learned from four {four:.3}"
    );
    assert!(refined < 1.0 && refined < 1.03 * four, "{refined} {four}");
}

#[test]
fn ten_more_are_learned_one_by_one_without_drift() {
    let all: Vec<_> = (0..13).map(|i| swung(2, i)).collect();
    let test = swung(2, 20);
    let mut skill = learned(&all[..3], &coarse());
    let first = error_m(&skill, &test);
    for d in &all[3..] {
        skill = refine(&skill, d).unwrap().0;
    }
    let batch = learned(&all, &coarse());
    assert_eq!(skill.provenance().sources.len(), 13);
    let (after, at_once) = (error_m(&skill, &test), error_m(&batch, &test));
    println!(
        "{first:.4} m after three, {after:.4} m after ten more, {at_once:.4} m from all thirteen"
    );
    assert!(after < first && after < 1.1 * at_once);

    let all: Vec<_> = (0..13)
        .map(|i| of(&format!("{i}"), reach(6, i, [0.2, -0.1, 2.0])))
        .collect();
    let mut skill = learned(&all[..3], &coarse());
    let first = apart_m(&skill, &learned(&all, &coarse()));
    for d in &all[3..] {
        skill = refine(&skill, d).unwrap().0;
    }
    let after = apart_m(&skill, &learned(&all, &coarse()));
    println!(
        "motion: {first:.4} m from that of all thirteen after three, {after:.4} m after ten more"
    );
    assert!(after < 0.012 && after < first);
}

/// Mean distance of two motions, m.
fn apart_m(a: &Skill, b: &Skill) -> f64 {
    let (a, b) = (motion_of(a), motion_of(b));
    a.iter().zip(&b).map(|(a, b)| (a - b).norm()).sum::<f64>() / a.len() as f64
}

fn motion_of(skill: &Skill) -> Vec<Vector3<f64>> {
    let gmr = Gmr::<1, 3>::new(skill.motion()).unwrap();
    (0..=40)
        .map(|i| {
            gmr.query(&[skill.duration_s() * f64::from(i) / 40.0].into())
                .mean
        })
        .collect()
}

/// A reach with a wrist that turns and a gripper that closes.
fn reached(index: u32) -> Demonstration {
    let goal = [
        0.25 + 0.04 * f64::from(index % 3),
        -0.15,
        2.05 - 0.05 * f64::from(index % 2),
    ];
    let path = reach(1, index, goal);
    let end_s = path[path.len() - 1].0;
    let samples: Vec<_> = path
        .into_iter()
        .map(|(t_s, x)| {
            let u = t_s / end_s;
            Sample {
                t_s,
                position: x.into(),
                orientation: Some(UnitQuaternion::from_euler_angles(
                    0.05 * f64::from(index),
                    1.2 * u,
                    0.3,
                )),
                grip: Some(if u < 0.6 { 1.0 } else { 0.2 }),
            }
        })
        .collect();
    Demonstration::from_samples(format!("reach {index}"), &samples).unwrap()
}

#[test]
fn a_pose_is_refined_whole() {
    let options = LearnOptions {
        motion_components: 6..=8,
        frames: vec![START.to_owned(), GOAL.to_owned()],
        ..LearnOptions::default()
    };
    let all: Vec<_> = (0..4).map(reached).collect();
    let (new, _) = refine(&learned(&all[..3], &options), &all[3]).unwrap();
    let batch = learned(&all, &options);
    for (a, b) in motion_of(&new).iter().zip(motion_of(&batch)) {
        assert!((a - b).norm() < 0.03, "{} m", (a - b).norm());
    }
    let (a, b) = (new.turn().unwrap(), batch.turn().unwrap());
    let grips = [&new, &batch].map(|s| Gmr::<1, 1>::new(s.grip().unwrap()).unwrap());
    for i in 0..=10 {
        let t_s = new.duration_s() * f64::from(i) / 10.0;
        let apart = a.motion.query(t_s).mean.angle_to(&b.motion.query(t_s).mean);
        assert!(apart < 0.05, "{apart} rad at {t_s}");
        let [a, b] = grips.each_ref().map(|g| g.query(&[t_s].into()).mean[0]);
        assert!((a - b).abs() < 0.15, "{a} {b} at {t_s}");
    }
    let (task, other) = (new.task().unwrap(), batch.task().unwrap());
    for (a, b) in task.frames().iter().zip(other.frames()) {
        assert!((a.usual.origin - b.usual.origin).norm() < 1e-9);
        // Where turns are an accident they do not move what is usual.
        assert!(a.usual.turn.angle_to(&b.usual.turn) < 0.05);
    }
    let mut at = [task.frames()[0].usual, task.frames()[1].usual];
    at[1].origin += Vector3::new(0.0, 0.1, 0.0);
    let end = task.at(new.duration_s(), &at).unwrap().mean;
    assert!(
        (end - at[1].origin).norm() < 0.015,
        "{}",
        (end - at[1].origin).norm()
    );
}

#[test]
fn another_gesture_is_noted_and_not_refused() {
    let all: Vec<_> = (0..3).map(|i| swung(1, i)).collect();
    let skill = learned(&all, &coarse());
    let (refined, what) = refine(&skill, &reached(0)).unwrap();
    assert!(what.is_unlike(), "{what:?}");
    assert_eq!(what.ignored, ["orientation", "grip"]);
    let before = error_m(&skill, &swung(1, 4));
    assert!(error_m(&refined, &swung(1, 4)) < 1.15 * before);
}

#[test]
fn what_cannot_refine_is_refused() {
    let options = LearnOptions {
        motion_components: 4..=4,
        frames: vec!["cup".to_owned()],
        ..LearnOptions::default()
    };
    let with_cup = |index: u32| {
        let text = format!("# frame cup 0.{index} 0 2\n{}", reached(index).to_csv());
        Demonstration::parse(format!("reach {index}.csv"), text.as_bytes()).unwrap()
    };
    let taught = [with_cup(0), with_cup(1)];
    let skill = learned(&taught, &options);
    assert!(matches!(
        refine(&skill, &taught[1]),
        Err(LearnError::AlreadyLearned { .. })
    ));
    let bare = of("bare", reach(1, 5, [0.2, 0.0, 2.0]));
    assert!(matches!(
        refine(&skill, &bare),
        Err(LearnError::Lacks { what, .. }) if what.starts_with("orientation")
    ));
    let error = refine(&skill, &reached(2)).unwrap_err();
    assert!(error.to_string().contains("# frame cup x y z"), "{error}");
    let learn = |d: &[Demonstration]| learn_skill("it", d, &options, |_| ()).unwrap_err();
    assert!(matches!(learn(&taught[..1]), LearnError::FrameAlone { .. }));
    assert!(matches!(
        learn(&[with_cup(0), reached(1)]),
        LearnError::Frame { .. }
    ));
}

/// Real recordings: some performances, one more, and what both together foretell of those never learned.
#[test]
fn real_hands_are_refined_as_well() {
    let Some(waves) = needs("data/demos/utd_mhad/a03_wave") else {
        return;
    };
    let mut waved = Vec::new();
    for person in 1..=8 {
        let pattern = format!("*_s{person}_*");
        let takes = Demonstrations::read_dir(&waves, Some(&pattern)).unwrap();
        waved.push((takes.demonstrations, 2));
    }
    let poured = needs("data/demos/robottasks/pouring").unwrap();
    let poured = Demonstrations::read_dir(poured, None).unwrap();
    for (set, groups) in [
        ("waving", waved),
        ("pouring", vec![(poured.demonstrations, 3)]),
    ] {
        // Mean ln error of each: old, refined, from the start.
        let mut ln = [0.0; 3];
        let mut tests = 0.0;
        for (all, known) in groups {
            let (taught, unseen) = all.split_at(known + 1);
            let old = learned(&taught[..known], &coarse());
            let (new, _) = refine(&old, &taught[known]).unwrap();
            let batch = learned(taught, &coarse());
            for test in unseen {
                for (ln, skill) in ln.iter_mut().zip([&old, &new, &batch]) {
                    *ln += error_m(skill, test).ln();
                }
                tests += 1.0;
            }
        }
        let [old, new, batch] = ln.map(|ln| (ln / tests).exp());
        println!(
            "{set}: {:.1} mm before, {:.1} mm refined, {:.1} mm learned from the start ({tests} performances)",
            old * 1e3,
            new * 1e3,
            batch * 1e3
        );
        assert!(new < old && new < 1.1 * batch, "{set}: {old} {new} {batch}");
    }
}
