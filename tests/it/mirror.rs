//! Mirror over a shaped link, both daemons on the virtual clock.

use nalgebra::Vector3;
use telemime::ground::{Pair, run_virtual};
use telemime::measure::{Hand, Track, follow, rmse_m, sample_and_hold};
use telemime_operator::daemon::{Notice, Summary};
use telemime_operator::task::Outcome;
use telemime_protocol::spline::HermiteSpan;
use telemime_robot::daemon::{Notice as RobotNotice, PathPoint};
use telemime_robot::rig::Rig;
use telemime_robot::servo::Report;
use telemime_sim::link::Link;

use crate::scene::{finish, mirroring, rig, shaped, unseen};

/// Time (s), position, velocity of a knot.
type Knot = (f64, Vector3<f64>, Vector3<f64>);

/// A run, its times those of the recording.
struct Run {
    reports: Vec<Report>,
    /// The robot's clock when the recording began, ns.
    zero: i64,
    summary: Summary,
    path: Vec<Knot>,
    path_bound_m: f64,
}

fn run(rig: &Rig, seed: u64) -> Run {
    run_virtual(async {
        let mut pair = Pair::start(rig).unwrap();
        let operator = mirroring(&mut pair, &shaped(), seed);
        let (summary, task, notices) = finish(operator).await;
        let session_zero = task.zero().unwrap();
        let mapping = |n: &Notice| match n {
            Notice::Mapping { path_bound_m, .. } => Some(*path_bound_m),
            _ => None,
        };
        pair.run_for(0.5).await;
        let path = pair.robot.notices().iter().find_map(|n| match n {
            RobotNotice::Path(path) => Some(path.clone()),
            _ => None,
        });
        let from_zero =
            |(t_s, x, v, ..): PathPoint| (t_s - session_zero.as_secs_f64(), x.into(), v.into());
        Run {
            reports: pair.robot.reports().clone(),
            zero: pair.to_mono(session_zero).0,
            summary: summary.unwrap(),
            path: path.unwrap().into_iter().map(from_zero).collect(),
            path_bound_m: notices.iter().find_map(mapping).unwrap(),
        }
    })
    .unwrap()
}

impl Run {
    /// What the arm did, as hand positions.
    fn tip(&self) -> Track {
        let engaged = self.reports.iter().filter(|r| r.engagement.number != 0);
        let point = |r: &Report| {
            let t_s = (r.at.0 - self.zero) as f64 * 1e-9;
            (t_s, r.mapping.unplace(r.tip_m))
        };
        Track::new(engaged.map(point).collect()).unwrap()
    }
}

#[test]
fn the_tip_moves_with_the_hand() {
    let rig = rig();
    let run = run(&rig, 7);
    assert_eq!(run.summary.outcome, Outcome::Completed);
    let hand = Track::new(unseen()).unwrap();
    let end_s = hand.span_s().1;
    let grid: Vec<f64> = (0..(end_s * 1e3) as i32)
        .map(|i| f64::from(i) * 1e-3)
        .collect();
    let tip = run.tip();
    let mapping = run.reports.last().unwrap().mapping;

    // The same arm, told every raw sample over a link of the same kind.
    let mut link = Link::new(shaped(), 7);
    let arrivals: Vec<_> = hand
        .points()
        .iter()
        .filter_map(|(t_s, x)| {
            let at_ns = link.send((t_s * 1e9) as i64, 44).arrival_ns()?;
            Some((at_ns as f64 * 1e-9, *t_s, *x))
        })
        .collect();
    let from_s = tip.span_s().0;
    let same_arm = follow(&rig, &mapping, from_s, end_s, |t| {
        sample_and_hold(&arrivals, t).map(Hand::from)
    })
    .tip;
    let ahead = follow(&rig, &mapping, from_s, end_s, |t| {
        Some(hand.at(t + rig.lag_s()).into())
    });

    let error = |track: &Track| rmse_m(track, &hand, &grid);
    let (predicted, delayed, floor) = (error(&tip), error(&same_arm), error(&ahead.tip));
    let lag = |track: &Track| track.lag_behind(&hand, &grid).0;
    println!(
        "tip {predicted:.4} m ({:.0} ms), delayed {delayed:.4} m ({:.0} ms), floor {floor:.4} m",
        lag(&tip) * 1e3,
        lag(&same_arm) * 1e3,
    );
    assert!(predicted < 0.6 * delayed, "{predicted} m of {delayed} m");
    assert!(floor < predicted, "nobody knows better than the truth");
    assert!(lag(&tip).abs() < 0.03 && lag(&same_arm) > 0.12);
    let (sent, raw) = (
        run.summary.engaged.motion.bytes,
        44 * u64::from(run.summary.counters.samples),
    );
    let counters = run.summary.counters;
    let (messages, samples) = (counters.messages, counters.samples);
    println!("{messages} messages, {sent} B of motion for {samples} samples, {raw} B raw");
    assert!(sent > 0 && sent < raw, "{sent} B of motion, {raw} B raw");
    assert_eq!(
        counters.samples as usize,
        unseen().len(),
        "no sample at rest"
    );
    assert!(
        counters.rest_samples > 0,
        "it engaged before the recording began"
    );
    let packets = run.summary.engaged.motion.packets;
    assert_eq!(
        packets,
        u64::from(counters.messages),
        "every motion, from the request to the release"
    );
}

#[test]
fn the_robot_holds_the_path_within_its_bound() {
    let run = run(&rig(), 11);
    let samples = unseen();
    let end_s = samples[samples.len() - 1].0;
    let (first_s, last_s) = (run.path[0].0, run.path[run.path.len() - 1].0);
    // Knots lie on a grid of 10 µs.
    assert!(
        first_s < 0.0 && (last_s - end_s).abs() < 1e-5,
        "{first_s} to {last_s}, the recording ends at {end_s} s"
    );
    for (t_s, x) in &samples {
        let after = run.path.partition_point(|k| k.0 <= *t_s);
        let [a, b] = &run.path[after.min(run.path.len() - 1) - 1..][..2] else {
            panic!("{t_s} s lies outside");
        };
        let span = HermiteSpan::<3>::new(b.0 - a.0, [a.1, a.2], [b.1, b.2]).unwrap();
        let into_s = (t_s - a.0).min(b.0 - a.0);
        let error_m = (span.eval(into_s).unwrap().x - x).norm();
        // Stamps are rounded to 10 µs: at 10 m/s that is another 0.1 mm.
        assert!(
            error_m <= run.path_bound_m + 1e-4,
            "{error_m} m off at {t_s} s, the bound is {} m",
            run.path_bound_m
        );
    }
}

#[test]
fn the_same_seed_gives_the_same_run() {
    let rig = rig();
    let (a, b, other) = (run(&rig, 5), run(&rig, 5), run(&rig, 6));
    assert_eq!(a.reports.len(), b.reports.len());
    let differs = a.reports.iter().zip(&b.reports).position(|(a, b)| a != b);
    assert_eq!(differs, None, "the first tick that differs");
    assert_eq!(a.path, b.path);
    assert_eq!(a.summary.total, b.summary.total);
    assert_eq!(a.summary.counters, b.summary.counters);
    assert!(a.reports != other.reports, "the seed matters");
}
