//! Orientation and gripper from demonstrations to the tip: mirrored and played, both daemons on the virtual clock.

use std::sync::{Arc, OnceLock};

use nalgebra::{Quaternion, UnitQuaternion, Vector3, Vector4};
use telemime::ground::{Pair, run_virtual};
use telemime::measure::{Hand, Track, Turns, follow, sample_and_hold};
use telemime_operator::cli::{Bounds, infer};
use telemime_operator::demonstration::{Demonstration, Sample};
use telemime_operator::learn::{LearnOptions, learn_skill};
use telemime_operator::session::SessionConfig;
use telemime_operator::task::{Outcome, Recording, Task};
use telemime_protocol::pose;
use telemime_protocol::skill::Skill;
use telemime_protocol::spline::HermiteSpan;
use telemime_protocol::wire::v1::RobotState;
use telemime_robot::daemon::Notice;
use telemime_robot::servo::{RAMP_S, Report};
use telemime_sim::hand::swing_with_wrist;
use telemime_sim::link::{Link, LinkConfig, Loss};

use crate::scene::{REST_S, finish, rig, shaped};

const PERSON: u64 = 3;

/// A performance with orientation, and a gripper that is shut while the hand is up.
fn performance(index: u32) -> Vec<Sample> {
    let poses = swing_with_wrist(PERSON, index);
    let end_s = poses.last().map_or(0.0, |p| p.t_s);
    poses
        .into_iter()
        .map(|p| {
            let [w, x, y, z] = p.q;
            let up = (0.2..0.8).contains(&(p.t_s / end_s));
            Sample {
                orientation: Some(UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z))),
                grip: Some(if up { 0.1 } else { 0.9 }),
                ..Sample::at(p.t_s, Vector3::from(p.x))
            }
        })
        .collect()
}

fn skill() -> Arc<Skill> {
    static SKILL: OnceLock<Arc<Skill>> = OnceLock::new();
    let learn = || {
        let demonstrations: Vec<_> = (0..4)
            .map(|i| Demonstration::from_samples(format!("wrist {i}"), &performance(i)).unwrap())
            .collect();
        let options = LearnOptions {
            motion_components: 4..=8,
            ..LearnOptions::default()
        };
        Arc::new(learn_skill("wrist", &demonstrations, &options, |_| {}).unwrap())
    };
    SKILL.get_or_init(learn).clone()
}

fn following(r: &Report) -> bool {
    matches!(r.state, RobotState::Engaged | RobotState::Coasting)
}

#[test]
fn a_turning_hand_is_mirrored_ahead_of_its_link() {
    let skill = skill();
    assert!(skill.turn().is_some() && skill.grip().is_some());
    let samples = performance(5);
    let rig = rig();
    let recording = Recording {
        samples: samples.clone(),
        rest_s: REST_S,
    };
    let (reports, zero) = run_virtual(async {
        let mut pair = Pair::start(&rig).unwrap();
        let task = Task::replay(recording);
        let config = SessionConfig::default();
        let operator = pair
            .operator(task, Some(skill), config, &shaped(), 11)
            .unwrap();
        let (summary, task, _) = finish(operator).await;
        assert_eq!(summary.unwrap().outcome, Outcome::Completed);
        let zero = pair.to_mono(task.zero().unwrap()).0;
        (pair.robot.reports().clone(), zero)
    })
    .unwrap();
    let reports: Vec<_> = reports.into_iter().filter(following).collect();
    let time_s = |r: &Report| (r.at.0 - zero) as f64 * 1e-9;
    let mapping = reports[0].mapping;

    let hand = Track::new(samples.iter().map(|s| (s.t_s, s.position)).collect()).unwrap();
    let turned: Vec<_> = samples
        .iter()
        .map(|s| (s.t_s, s.orientation.unwrap()))
        .collect();
    let truth = Turns::new(turned).unwrap();
    let tip = reports
        .iter()
        .map(|r| (time_s(r), mapping.unorient(&r.orientation).unwrap()));
    let tip = Turns::new(tip.collect()).unwrap();

    // The same arm, told every raw sample over a link of the same kind; and told the truth ahead of time.
    let mut link = Link::new(shaped(), 11);
    let arrivals: Vec<_> = samples
        .iter()
        .filter_map(|s| {
            let at_ns = link.send((s.t_s * 1e9) as i64, 60).arrival_ns()?;
            Some((at_ns as f64 * 1e-9, s.t_s, s.t_s))
        })
        .collect();
    let seen = |t_s: f64| Hand {
        place: hand.at(t_s),
        turn: Some(truth.at(t_s)),
    };
    let (from_s, end_s) = (time_s(&reports[0]), hand.span_s().1);
    let grid: Vec<f64> = (0..(end_s * 1e3) as i32)
        .map(|i| f64::from(i) * 1e-3)
        .collect();
    let error = |turns: &Turns| turns.rmse_rad(&truth, &grid);
    let same_arm = follow(&rig, &mapping, from_s, end_s, |t| {
        Some(seen(sample_and_hold(&arrivals, t).unwrap_or(0.0)))
    });
    let lag_s = rig.lag_s();
    let floor = follow(&rig, &mapping, from_s, end_s, |t| Some(seen(t + lag_s)));
    let (predicted, delayed) = (error(&tip), error(&same_arm.turn.unwrap()));
    let floor = error(&floor.turn.unwrap());
    println!("orientation: predicted {predicted:.4} rad, delayed {delayed:.4}, floor {floor:.4}");
    assert!(predicted < 0.7 * delayed, "{predicted} of {delayed} rad");
    // The truth has the tracker's noise in it, which costs the arm more than what a prediction leaves out.
    assert!(predicted < 1.2 * floor, "{predicted} rad, {floor} rad");

    // The gripper follows what the hand does, the link's delay and its own speed later.
    let opening = |t_s: f64| {
        let at = reports.partition_point(|r| time_s(r) < t_s);
        reports[at.min(reports.len() - 1)].opening.unwrap()
    };
    assert!((opening(0.5 * end_s) - 0.1).abs() < 0.01);
    assert!((opening(end_s) - 0.9).abs() < 0.01);
}

/// Over a link that loses a fifth of all messages and delays the rest unevenly.
#[test]
fn the_robot_holds_the_path_within_both_bounds() {
    let (samples, skill) = (performance(5), skill());
    let link = LinkConfig {
        loss: Loss::random(0.2),
        ..shaped()
    };
    let (bound_m, bound_rad) = (0.01, 0.02);
    let config = SessionConfig {
        path_bound_m: Some(bound_m),
        path_turn_bound_rad: bound_rad,
        ..SessionConfig::default()
    };
    let recording = Recording {
        samples: samples.clone(),
        rest_s: REST_S,
    };
    let (path, zero_s) = run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let task = Task::replay(recording);
        let operator = pair.operator(task, Some(skill), config, &link, 7).unwrap();
        let (summary, task, _) = finish(operator).await;
        assert_eq!(summary.unwrap().outcome, Outcome::Completed);
        pair.run_for(0.5).await;
        let path = pair.robot.notices().iter().find_map(|n| match n {
            Notice::Path(path) => Some(path.clone()),
            _ => None,
        });
        (path.unwrap(), task.zero().unwrap().as_secs_f64())
    })
    .unwrap();
    let (mut worst_m, mut worst_rad) = (0.0f64, 0.0f64);
    // Knots lie on ticks of 10 µs.
    let frontier_s = path[path.len() - 1].0 + 1e-5;
    for sample in &samples {
        let t_s = sample.t_s + zero_s;
        assert!(t_s <= frontier_s, "{t_s} s is beyond {frontier_s} s");
        let after = path.partition_point(|k| k.0 <= t_s).min(path.len() - 1);
        let [a, b] = &path[after - 1..][..2] else {
            panic!("{t_s} s lies outside");
        };
        assert!(!b.3, "no hole");
        let (h, into_s) = (b.0 - a.0, (t_s - a.0).min(b.0 - a.0));
        let ends = [a, b].map(|k| [k.1, k.2].map(Vector3::from));
        let place = HermiteSpan::<3>::new(h, ends[0], ends[1]).unwrap();
        worst_m = worst_m.max((place.position(into_s).unwrap() - sample.position).norm());
        let ends = [a, b].map(|k| k.4.expect("an orientation").map(Vector4::from));
        let turn = HermiteSpan::<4>::new(h, ends[0], ends[1]).unwrap();
        let turn = pose::nearest(&turn.position(into_s).unwrap()).unwrap();
        worst_rad = worst_rad.max(turn.angle_to(&sample.orientation.unwrap()));
    }
    println!(
        "{} samples, {} knots, worst {worst_m} m, {worst_rad} rad",
        samples.len(),
        path.len()
    );
    // Stamps are rounded to 10 µs: at 10 m/s and 10 rad/s that is another 0.1 mm and mrad.
    assert!(worst_m <= bound_m + 1e-4, "{worst_m} m");
    assert!(worst_rad <= bound_rad + 1e-4, "{worst_rad} rad");
    assert!(
        worst_rad > 0.1 * bound_rad,
        "it is a curve: {worst_rad} rad"
    );
}

#[test]
fn a_pose_is_played_to_the_tip() {
    let skill = skill();
    let bounds = Bounds {
        place_m: 0.005,
        turn_rad: 0.01,
    };
    let (plan, report) = infer(&skill, bounds, &[]).unwrap();
    assert!(report.rebuilt_turn.unwrap().max_rad <= bounds.turn_rad + 1e-9);
    let curve = plan.curve().unwrap();
    let rig = rig();
    let reports = run_virtual(async {
        let mut pair = Pair::start(&rig).unwrap();
        let task = Task::play(plan.clone());
        let config = SessionConfig::default();
        let operator = pair
            .operator(task, Some(skill), config, &shaped(), 5)
            .unwrap();
        let (summary, ..) = finish(operator).await;
        assert_eq!(summary.unwrap().outcome, Outcome::Completed);
        pair.robot.reports().clone()
    })
    .unwrap();
    let played: Vec<_> = reports.into_iter().filter(following).collect();
    let mapping = played[0].mapping;
    let since_s = |r: &Report| r.at.secs_since(r.engaged_at);
    let tip = played
        .iter()
        .map(|r| (since_s(r), mapping.unorient(&r.orientation).unwrap()));
    let tip = Turns::new(tip.collect()).unwrap();
    let grid: Vec<f64> = (0..(curve.end_s() * 1e3) as i32)
        .map(|i| f64::from(i) * 1e-3)
        .filter(|t| *t > RAMP_S)
        .collect();
    let wanted = grid.iter().map(|&t| (t, curve.orientation_at(t).unwrap()));
    let wanted = Turns::new(wanted.collect()).unwrap();
    let lag_s = rig.lag_s();
    let ideal = follow(&rig, &mapping, 0.0, curve.end_s(), |t| {
        Some(Hand {
            place: curve.position_at(t + lag_s),
            turn: curve.orientation_at(t + lag_s),
        })
    });
    let (off, floor) = (
        tip.rmse_rad(&wanted, &grid),
        ideal.turn.unwrap().rmse_rad(&wanted, &grid),
    );
    println!("played: {off:.4} rad RMS, floor {floor:.4} rad");
    assert!(off < 1.1 * floor + 0.01 && off < 0.1, "{off} {floor}");
    let shut = played.iter().filter_map(|r| r.opening);
    assert!(shut.fold(1.0, f64::min) < 0.15);
    assert!(played.last().unwrap().opening.unwrap() > 0.8);
}
