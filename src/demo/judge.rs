//! Hand against tip at the same wall time; `docs/experiments.md` has the definitions.

use std::path::Path;

use anyhow::{Context, bail};
use nalgebra::Vector3;
use telemime_operator::cli::Event as Operator;
use telemime_protocol::checkpoint::path::DecodedKnot;
use telemime_protocol::spline::HermiteSpan;
use telemime_protocol::time::Stamp;
use telemime_robot::cli::Event as Robot;
use telemime_robot::daemon::PathPoint as HeldKnot;
use telemime_robot::rig::{Rig, RigOptions};
use telemime_robot::servo::{Mapping, RAMP_S};

use super::processes::Run;
use super::{Args, Material};
use crate::measure::{
    Hand, Track, Turns, follow, is_edge, rms, rmse_m, sample_and_hold, smooth_jerk_m_s3,
};
use crate::relay::Fate;
use crate::ticks::{self, Tick};

/// One way of following the hand.
pub(super) struct Way {
    pub(super) track: Track,
    pub(super) rmse_m: f64,
    pub(super) lag_s: f64,
}

/// How far the orientation was off, each way of following it, rad RMS.
pub(super) struct TurnVerdict {
    pub(super) delayed_rad: f64,
    pub(super) delayed_arm_rad: f64,
    pub(super) floor_rad: f64,
    pub(super) predicted_rad: f64,
}

/// The figures of a run.
pub(super) struct Verdict {
    pub(super) mapping: Mapping,
    /// The judged times, s from the recording's beginning, every millisecond.
    pub(super) grid_s: Vec<f64>,
    pub(super) truth: Track,
    /// Raw samples, delayed: an ideal tip.
    pub(super) delayed: Way,
    /// The same, through the same arm and filter.
    pub(super) delayed_arm: Way,
    /// Perfect knowledge through the same arm and filter.
    pub(super) floor: Way,
    /// What the robot did.
    pub(super) predicted: Way,
    /// The same for the orientation, where the recording has it and the arm followed it.
    pub(super) turn: Option<TurnVerdict>,
    /// RMS jerk of the tip's reference, m/s³, and over that of the scaled hand; `None` of a hand that rests.
    pub(super) jerk_m_s3: f64,
    pub(super) jerk_ratio: Option<f64>,
    pub(super) clamps: u32,
    pub(super) coasted: u32,
    /// Ticks between the first and the last recorded that the record does not hold.
    pub(super) ticks_lost: u64,
    pub(super) path: Vec<PathPoint>,
    /// Largest distance of the recorded path from the samples it covers, m, and how many it covers.
    pub(super) path_error_m: f64,
    pub(super) path_samples: usize,
}

/// A delay that costs less than this hides nothing worth a ratio, m.
const LEAST_COST_M: f64 = 1e-3;

/// A knot of the received path, and whether it starts afresh there.
pub(super) type PathPoint = (DecodedKnot, bool);

impl Verdict {
    /// Share of the delay's cost that is gone; the arm's own limits are not the delay's fault. `None` if the delay
    /// costs (almost) nothing.
    pub(super) fn fraction_hidden(&self) -> Option<f64> {
        let (delayed, floor) = (self.delayed_arm.rmse_m, self.floor.rmse_m);
        share(delayed, self.predicted.rmse_m, floor)
    }

    /// The ways whose lag is only the edge of what was searched.
    pub(super) fn lags_at_edge(&self) -> Vec<&'static str> {
        let ways = [
            ("delayed", &self.delayed),
            ("delayed_same_arm", &self.delayed_arm),
            ("predicted", &self.predicted),
            ("floor", &self.floor),
        ];
        let at_edge = ways.into_iter().filter(|(_, way)| is_edge(way.lag_s));
        at_edge.map(|(name, _)| name).collect()
    }
}

fn share(delayed_m: f64, predicted_m: f64, floor_m: f64) -> Option<f64> {
    let cost_m = delayed_m - floor_m;
    (cost_m > LEAST_COST_M).then(|| (delayed_m - predicted_m) / cost_m)
}

/// Ticks missing among those numbered so, in order.
fn missing(ticks: &[Tick]) -> u64 {
    let gap = |w: &[Tick]| w[1].tick.saturating_sub(w[0].tick + 1);
    ticks.windows(2).map(gap).sum()
}

/// The ticks of the first engagement, in order.
pub(super) fn read_ticks(path: &Path, from_ns: i64) -> anyhow::Result<Vec<Tick>> {
    let mut ticks = ticks::read(path)?;
    ticks.retain(|t| t.mono_ns >= from_ns);
    let Some(first) = ticks.first().map(|t| t.engagement) else {
        bail!("{}: no tick after the engage", path.display());
    };
    ticks.retain(|t| t.engagement == first);
    Ok(ticks)
}

/// The mapping and the instant of the first engagement.
pub(super) fn engagement(run: &Run) -> anyhow::Result<(Mapping, i64)> {
    ticks::engagement(&run.robot).context("the robot never engaged")
}

/// The same arm as the robot's, for baselines.
pub(super) fn rig(args: &Args) -> anyhow::Result<Rig> {
    let mut options = RigOptions {
        urdf: args.urdf.clone(),
        ..RigOptions::default()
    };
    options.load.tip = args.tip.clone();
    options.control.dead_time_s = args.dead_time;
    Ok(Rig::load(&options)?)
}

pub(super) fn judge(args: &Args, material: &Material, run: &Run) -> anyhow::Result<Verdict> {
    let rig = rig(args)?;
    let (mapping, engaged_ns) = engagement(run)?;
    let zero_ns = run
        .operator
        .iter()
        .find_map(|e| {
            if let Operator::Done { zero_mono_ns, .. } = e {
                *zero_mono_ns
            } else {
                None
            }
        })
        .context("the operator never started its recording")?;
    let time_s = |mono_ns: i64| (mono_ns - zero_ns) as f64 * 1e-9;

    let samples = material.recording.samples();
    let t0_s = samples[0].t_s;
    let truth = Track::new(samples.iter().map(|s| (s.t_s - t0_s, s.position)).collect())?;
    let end_s = truth.span_s().1;
    let engaged_s = time_s(engaged_ns);
    let from_s = (engaged_s + RAMP_S).max(0.0);
    if from_s >= end_s {
        bail!("the robot engaged only {engaged_s:.1} s into a recording of {end_s:.1} s");
    }
    let grid_s: Vec<f64> = (0..((end_s - from_s) * 1e3) as u32)
        .map(|i| from_s + f64::from(i) * 1e-3)
        .collect();

    let ticks = read_ticks(&run.ticks, engaged_ns)?;
    let tip = ticks
        .iter()
        .map(|t| (time_s(t.mono_ns), mapping.unplace(t.tip_m)));
    let tip = Track::new(tip.collect())?;
    let clamps = ticks
        .iter()
        .take_while(|t| time_s(t.mono_ns) <= end_s)
        .last()
        .map_or(0, |t| t.clamps);

    let turned = samples
        .iter()
        .map(|s| Some((s.t_s - t0_s, s.orientation?)))
        .collect::<Option<Vec<_>>>();
    let true_turn = turned.and_then(Turns::new);
    let tip_turn = ticks
        .iter()
        .map(|t| Some((time_s(t.mono_ns), mapping.unorient(&t.tip_q)?)))
        .collect::<Option<Vec<_>>>();
    let tip_turn = tip_turn.and_then(Turns::new);

    let arrivals = raw_arrivals(run, &truth, zero_ns);
    let newest = |t_s: f64| sample_and_hold(&arrivals, t_s).unwrap_or(0.0);
    let held = |t_s: f64| truth.at(newest(t_s));
    let seen = |t_s: f64| Hand {
        place: truth.at(t_s),
        turn: true_turn.as_ref().map(|turn| turn.at(t_s)),
    };
    let delayed = Track::new(grid_s.iter().map(|&t| (t, held(t))).collect())?;
    let way = |track: Track| Way {
        rmse_m: rmse_m(&track, &truth, &grid_s),
        lag_s: track.lag_behind(&truth, &grid_s).0,
        track,
    };
    let lag_s = rig.lag_s();
    let start_s = engaged_s.min(0.0);
    let delayed_arm = follow(&rig, &mapping, start_s, end_s, |t| Some(seen(newest(t))));
    let floor = follow(&rig, &mapping, start_s, end_s, |t| Some(seen(t + lag_s)));
    let turn = match (&true_turn, &tip_turn, &delayed_arm.turn, &floor.turn) {
        (Some(truth), Some(tip), Some(delayed_arm), Some(floor)) => {
            let held = grid_s.iter().map(|&t| (t, truth.at(newest(t)))).collect();
            Turns::new(held).map(|held| TurnVerdict {
                delayed_rad: held.rmse_rad(truth, &grid_s),
                delayed_arm_rad: delayed_arm.rmse_rad(truth, &grid_s),
                floor_rad: floor.rmse_rad(truth, &grid_s),
                predicted_rad: tip.rmse_rad(truth, &grid_s),
            })
        }
        _ => None,
    };

    let judged = ticks
        .iter()
        .filter(|t| (from_s..end_s).contains(&time_s(t.mono_ns)));
    let jerk_m_s3 = rms(judged.map(|t| t.jerk_m_s3));
    let hand_jerk = mapping.scale * smooth_jerk_m_s3(&truth, from_s, end_s);
    let jerk_ratio = (hand_jerk > 0.0).then(|| jerk_m_s3 / hand_jerk);

    let path = received_path(run);
    let (path_error_m, path_samples) = path_error(&path, &truth, zero_ns, run);
    Ok(Verdict {
        mapping,
        delayed: way(delayed),
        delayed_arm: way(delayed_arm.tip),
        floor: way(floor.tip),
        turn,
        predicted: way(tip),
        jerk_m_s3,
        jerk_ratio,
        clamps,
        ticks_lost: missing(&ticks),
        coasted: count_state(run, "Coasting"),
        path,
        path_error_m,
        path_samples,
        grid_s,
        truth,
    })
}

fn count_state(run: &Run, name: &str) -> u32 {
    run.robot
        .iter()
        .filter(|e| matches!(e, Robot::State { state, .. } if state == name))
        .count() as u32
}

/// When each raw sample would have arrived, and its own time twice: with the fate that the relay recorded for the packet
/// that passed it next to the sample's time.
fn raw_arrivals(run: &Run, truth: &Track, zero_ns: i64) -> Vec<(f64, f64, f64)> {
    let mut up: Vec<_> = run
        .passages
        .iter()
        .filter(|p| p.up && !p.copy)
        .map(|p| {
            (
                (p.at.0 - zero_ns) as f64 * 1e-9,
                // What arrives with a bit flipped is as good as lost.
                p.out
                    .filter(|_| p.fate != Fate::Corrupted)
                    .map(|out| out.secs_since(p.at)),
            )
        })
        .collect();
    up.sort_by(|a, b| a.0.total_cmp(&b.0));
    // Our packets are fewer than raw samples would be: a packet lost once loses one sample, not all near it.
    let mut spent = vec![false; up.len()];
    let mut fate = |t_s: f64| {
        let after = up.partition_point(|p| p.0 < t_s);
        let mut near: Vec<usize> = (after.saturating_sub(8)..(after + 8).min(up.len())).collect();
        near.sort_by(|&a, &b| (up[a].0 - t_s).abs().total_cmp(&(up[b].0 - t_s).abs()));
        let first = near.into_iter().find(|&i| up[i].1.is_some() || !spent[i])?;
        spent[first] |= up[first].1.is_none();
        up[first].1
    };
    truth
        .points()
        .iter()
        .filter_map(|&(t_s, _)| fate(t_s).map(|delay_s| (t_s + delay_s, t_s, t_s)))
        .collect()
}

fn received_path(run: &Run) -> Vec<PathPoint> {
    let knots = run.robot.iter().find_map(|e| {
        if let Robot::Path { knots } = e {
            Some(knots)
        } else {
            None
        }
    });
    let decode = |(t_s, x, v, start, _): &HeldKnot| {
        let knot = DecodedKnot {
            t: Stamp::from_secs_f64(*t_s),
            x: Vector3::from(*x),
            v: Vector3::from(*v),
        };
        (knot, *start)
    };
    knots.map_or_else(Vec::new, |knots| knots.iter().map(decode).collect())
}

/// The motion between two neighbouring knots; `None` across a hole.
pub(super) fn joined(a: &PathPoint, b: &PathPoint) -> Option<HermiteSpan<3>> {
    let ((a, _), (b, start)) = (a, b);
    if *start {
        return None;
    }
    HermiteSpan::new(b.t.secs_since(a.t), [a.x, a.v], [b.x, b.v])
}

/// The path's largest distance from the recording's samples between its first and last knot, holes left out.
///
/// Knots are on the session clock, whose zero on the host's clock the operator states.
fn path_error(path: &[PathPoint], truth: &Track, zero_ns: i64, run: &Run) -> (f64, usize) {
    let epoch_ns = run.operator.iter().find_map(|e| {
        if let Operator::Done { epoch_mono_ns, .. } = e {
            Some(*epoch_mono_ns)
        } else {
            None
        }
    });
    let Some(epoch_ns) = epoch_ns else {
        return (0.0, 0);
    };
    let offset_s = (epoch_ns - zero_ns) as f64 * 1e-9;
    let (mut worst_m, mut covered) = (0.0_f64, 0);
    for &(t_s, x) in truth.points() {
        let session_s = t_s - offset_s;
        let after = path.partition_point(|(k, _)| k.t.as_secs_f64() < session_s);
        let (Some(a), Some(b)) = (
            after.checked_sub(1).and_then(|i| path.get(i)),
            path.get(after),
        ) else {
            continue;
        };
        if let Some(jet) = joined(a, b).and_then(|s| s.eval(session_s - a.0.t.as_secs_f64())) {
            worst_m = worst_m.max((jet.x - x).norm());
            covered += 1;
        }
    }
    (worst_m, covered)
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;

    use super::*;

    fn tick(tick: u64) -> Tick {
        Tick {
            tick,
            mono_ns: 0,
            engagement: 1,
            follows: true,
            age_s: 0.0,
            tip_m: Vector3::zeros(),
            tip_q: UnitQuaternion::identity(),
            clamps: 0,
            jerk_m_s3: 0.0,
        }
    }

    #[test]
    fn lost_ticks_are_counted() {
        assert_eq!(missing(&[7, 8, 9].map(tick)), 0);
        assert_eq!(missing(&[7, 8, 12, 13, 15].map(tick)), 4);
        assert_eq!(missing(&[tick(3)]), 0);
    }

    #[test]
    fn nothing_is_hidden_of_a_delay_that_costs_nothing() {
        assert!(share(0.05, 0.02, 0.01).is_some_and(|s| (s - 0.75).abs() < 1e-12));
        assert_eq!(share(0.0105, 0.0102, 0.01), None);
        assert_eq!(share(0.009, 0.0102, 0.01), None);
    }

    #[test]
    fn a_hole_is_not_bridged() {
        let knot = |s: i64, start| {
            let knot = DecodedKnot {
                t: Stamp(s * 1_000_000_000),
                x: Vector3::repeat(s as f64),
                v: Vector3::repeat(1.0),
            };
            (knot, start)
        };
        assert!(joined(&knot(1, true), &knot(2, false)).is_some());
        assert!(joined(&knot(1, false), &knot(2, true)).is_none());
    }
}
