//! The whole way from the sensor to the tip on the virtual ground: dead time, latency, smoothness, and what a session learns.

use std::sync::Arc;

use telemime::ground::{Pair, run_virtual};
use telemime::measure::{Track, rms, rmse_m, smooth_jerk_m_s3};
use telemime_operator::daemon::{Learning, Notice};
use telemime_operator::session::SessionConfig;
use telemime_operator::task::{Outcome, Task};
use telemime_protocol::skill::Skill;
use telemime_robot::rig::{Rig, RigOptions};
use telemime_robot::servo::{RAMP_S, Report};
use telemime_sim::hand::swing;

use crate::scene::{Samples, finish, replay, shaped, skill, unseen};

/// One engagement, its times those at which the hand was there.
struct Performed {
    tip: Track,
    jerk_m_s3: f64,
    scale: f64,
    from_s: f64,
}

struct Run {
    performed: Vec<Performed>,
    notices: Vec<Notice>,
}

/// `samples` one after another, across 100 ± 10 ms and 1 % loss.
fn drive(
    rig: &Rig,
    config: SessionConfig,
    learning: Learning,
    skill: Arc<Skill>,
    performances: &[Samples],
) -> Run {
    run_virtual(async {
        let mut pair = Pair::start(rig).unwrap();
        pair.learning = learning;
        let [first, then @ ..] = performances else {
            panic!("nothing to drive")
        };
        let mut task: Task = replay(first.clone());
        for samples in then {
            task = task.and_then(crate::scene::recording(samples.clone()));
        }
        let operator = pair
            .operator(task, Some(skill), config, &shaped(), 7)
            .unwrap();
        let (summary, _, notices) = finish(operator).await;
        assert_eq!(summary.unwrap().outcome, Outcome::Completed);
        let zeros = notices.iter().filter_map(|n| match n {
            Notice::Performed { zero, .. } => Some(pair.to_mono(*zero)),
            _ => None,
        });
        let reports = pair.robot.reports();
        let performed = zeros.zip(1..).map(|(zero, number)| {
            let own: Vec<&Report> = reports
                .iter()
                .filter(|r| r.engagement.number == number)
                .collect();
            let time_s = |r: &Report| r.at.secs_since(zero);
            let from_s = (own[0].engaged_at.secs_since(zero) + RAMP_S).max(0.0);
            let end_s = performances[number as usize - 1].last().unwrap().0;
            let judged = own.iter().filter(|r| (from_s..end_s).contains(&time_s(r)));
            let point = |r: &&Report| (time_s(r), r.mapping.unplace(r.tip_m));
            Performed {
                jerk_m_s3: rms(judged.map(|r| r.jerk_m_s3)),
                tip: Track::new(own.iter().map(point).collect()).unwrap(),
                scale: own[0].mapping.scale,
                from_s,
            }
        });
        let performed: Vec<_> = performed.collect();
        assert_eq!(performed.len(), performances.len());
        drop(reports);
        Run { performed, notices }
    })
    .unwrap()
}

fn once(rig: &Rig, config: SessionConfig, samples: &Samples) -> Performed {
    let samples = std::slice::from_ref(samples);
    let mut run = drive(rig, config, Learning::default(), skill(), samples);
    run.performed.remove(0)
}

fn grid(from_s: f64, hand: &Track) -> Vec<f64> {
    let span_s = hand.span_s().1 - from_s;
    (0..(span_s * 1e3) as u32)
        .map(|i| from_s + f64::from(i) * 1e-3)
        .collect()
}

/// RMS error, m, and lag, s, of a tip that is `late_s` later than it was.
fn judged(tip: &Track, late_s: f64, hand: &Track, from_s: f64) -> (f64, f64) {
    let shifted = tip.points().iter().map(|(t, x)| (t + late_s, *x));
    let tip = Track::new(shifted.collect()).unwrap();
    let grid = grid(from_s.max(0.0), hand);
    (rmse_m(&tip, hand, &grid), tip.lag_behind(hand, &grid).0)
}

fn rig(dead_time_s: f64, omega: f64) -> Rig {
    let mut options = RigOptions::default();
    options.control.dead_time_s = dead_time_s;
    options.control.omega = omega;
    Rig::load(&options).unwrap()
}

#[test]
fn an_actuators_dead_time_is_made_up_for() {
    let hand = Track::new(unseen()).unwrap();
    let prompt = once(&rig(0.0, 45.0), SessionConfig::default(), &unseen());
    let (ideal_m, ideal_s) = judged(&prompt.tip, 0.0, &hand, prompt.from_s);
    for ms in [20, 30, 50] {
        let dead_s = f64::from(ms) * 1e-3;
        let late = rig(dead_s, 45.0);
        assert!((f64::from(late.info().lag_s) - late.lag_s()).abs() < 1e-6);
        let run = once(&late, SessionConfig::default(), &unseen());
        let (with_m, with_s) = judged(&run.tip, 0.0, &hand, run.from_s);
        // An arm that obeys late and does not say so does what the prompt one did, that much later.
        let (without_m, without_s) = judged(&prompt.tip, dead_s, &hand, run.from_s);
        println!(
            "dead time {ms} ms: {with_m:.4} m at {:.0} ms, uncompensated {without_m:.4} m at {:.0} ms (none: {ideal_m:.4} m at {:.0} ms)",
            with_s * 1e3,
            without_s * 1e3,
            ideal_s * 1e3
        );
        assert!((with_s - ideal_s).abs() <= 0.01, "{with_s} s");
        assert!((without_s - ideal_s - dead_s).abs() <= 0.005);
    }
}

#[test]
fn a_sensors_latency_is_made_up_for_once_it_is_known() {
    const LATENCY_S: f64 = 0.06;
    let hand = Track::new(unseen()).unwrap();
    let told = SessionConfig {
        input_latency_s: LATENCY_S,
        ..SessionConfig::default()
    };
    // The recording is handed over that late: what the session takes for now was then.
    let prompt = once(&rig(0.0, 45.0), SessionConfig::default(), &unseen());
    let known = once(&rig(0.0, 45.0), told, &unseen());
    let (ideal_m, ideal_s) = judged(&prompt.tip, 0.0, &hand, prompt.from_s);
    let (unknown_m, unknown_s) = judged(&prompt.tip, LATENCY_S, &hand, known.from_s);
    let (known_m, known_s) = judged(&known.tip, 0.0, &hand, known.from_s);
    println!(
        "latency 60 ms: told {known_m:.4} m at {:.0} ms, untold {unknown_m:.4} m at {:.0} ms (none: {ideal_m:.4} m at {:.0} ms)",
        known_s * 1e3,
        unknown_s * 1e3,
        ideal_s * 1e3
    );
    assert!((known_s - ideal_s).abs() <= 0.01, "{known_s}");
    assert!((unknown_s - ideal_s - LATENCY_S).abs() <= 0.005);
}

#[test]
fn what_moves_the_arm_is_as_smooth_as_the_hand() {
    let hand = Track::new(unseen()).unwrap();
    let mut found = Vec::new();
    for omega in [30.0, 36.0, 40.0, 45.0, 60.0] {
        let rig = rig(0.0, omega);
        let run = once(&rig, SessionConfig::default(), &unseen());
        let (error_m, lag_s) = judged(&run.tip, 0.0, &hand, run.from_s);
        let own = run.scale * smooth_jerk_m_s3(&hand, run.from_s, hand.span_s().1);
        println!(
            "omega {omega}: {error_m:.4} m at {:.0} ms, jerk {:.0} m/s³, {:.2} of the hand's, scale {:.3}",
            lag_s * 1e3,
            run.jerk_m_s3,
            run.jerk_m_s3 / own,
            run.scale
        );
        found.push((omega, run.jerk_m_s3 / own));
    }
    assert!(found.windows(2).all(|w| w[0].1 < w[1].1), "{found:?}");
}

#[test]
fn a_session_learns_from_what_it_drives() {
    let folder = tempfile::tempdir().unwrap();
    let (mut fixed, mut learned) = ([0.0; 3], [0.0; 3]);
    for person in [9, 12] {
        let others: Vec<Samples> = (0..3)
            .map(|i| {
                let point = |(t_s, x): (f64, [f64; 3])| (t_s, x.into());
                swing(person, i).into_iter().map(point).collect()
            })
            .collect();
        let learning = Learning {
            refine: true,
            save: Some(folder.path().to_owned()),
        };
        let rig = rig(0.0, 45.0);
        let config = SessionConfig::default();
        let as_is = drive(&rig, config, Learning::default(), skill(), &others);
        let refined = drive(&rig, config, learning, skill(), &others);
        for (sums, run) in [(&mut fixed, &as_is), (&mut learned, &refined)] {
            for (sum, (performed, samples)) in
                sums.iter_mut().zip(run.performed.iter().zip(&others))
            {
                let hand = Track::new(samples.clone()).unwrap();
                let error_m = judged(&performed.tip, 0.0, &hand, performed.from_s).0;
                println!("person {person}: {error_m:.4} m");
                *sum += 0.5 * error_m;
            }
        }
        let told = refined.notices.iter().filter_map(|n| match n {
            Notice::Refined { skill, learned } => Some((skill.clone(), learned.len())),
            _ => None,
        });
        let told: Vec<_> = told.collect();
        assert_eq!(told.len(), 3, "after every performance");
        let sources = |skill: &Skill| skill.parts().provenance.sources.len();
        assert!(
            told.iter()
                .zip(6..)
                .all(|((s, n), all)| *n == 1 && sources(s) == all)
        );
        let saved = telemime_operator::skill_file::load(folder.path().join("swing.skill")).unwrap();
        assert_eq!(saved.id(), told[2].0.id(), "the last one is what is saved");
        assert!(
            !as_is
                .notices
                .iter()
                .any(|n| matches!(n, Notice::Refined { .. }))
        );
    }
    println!("another person, m: skill as it was {fixed:.4?}, refined {learned:.4?}");
    assert!(
        (fixed[0] - learned[0]).abs() < 1e-9,
        "the first is the same"
    );
    assert!(learned[1] < fixed[1] && learned[2] < fixed[2]);
}
