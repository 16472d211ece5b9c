//! Samples that the tracker made up: far off the path that their neighbours agree on.
//!
//! Speed is no sign of them: real swings are as fast. A glitch goes out and comes back within one or two samples, so that without it the path is
//! smooth; a fast hand is hard to interpolate *everywhere*, and its neighbours show that.

use std::ops::Range;

use nalgebra::Vector3;

use super::Pose;

/// The longest run of samples that is taken for a glitch. Longer ones may be motion.
const LONGEST: usize = 2;

/// Allowed innovation: so many times the neighbours' own, and the recording's median, and this many metres.
const OF_NEIGHBOURS: f64 = 2.5;
const OF_MEDIAN: f64 = 5.0;
const LEAST_M: f64 = 0.02;

/// A run is judged only where the samples around it are no further apart than this many usual steps for each step.
const WIDEST_STEPS: f64 = 2.5;

/// Indices of the glitches in one stretch, ascending. The first and last sample are never among them: nobody can tell there.
pub(super) fn find(poses: &[Pose]) -> Vec<usize> {
    let mut out = Vec::new();
    let alone = (0..poses.len()).filter_map(|i| innovation(poses, i, &(i..i + 1)));
    let steps = poses.windows(2).map(|w| w[1].t_s - w[0].t_s);
    let (Some(usual_m), Some(step_s)) = (median(alone), median(steps)) else {
        return out;
    };
    let floor_m = LEAST_M + OF_MEDIAN * usual_m;
    let mut live: Vec<usize> = (0..poses.len()).collect();
    loop {
        let kept: Vec<Pose> = live.iter().map(|&i| poses[i].clone()).collect();
        let mut suspects: Vec<(f64, Range<usize>)> = Vec::new();
        for length in 1..=LONGEST {
            for at in 1..kept.len().saturating_sub(length) {
                let run = at..at + length;
                let span_s = kept[run.end].t_s - kept[at - 1].t_s;
                if span_s <= WIDEST_STEPS * step_s * (length + 1) as f64
                    && let Some(excess) = excess(&kept, &run, floor_m)
                {
                    suspects.push((excess, run));
                }
            }
        }
        suspects.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.start.cmp(&b.1.start)));
        // Where one goes, its surroundings are judged afresh in the next round.
        let mut judged = vec![false; kept.len()];
        let mut gone = vec![false; kept.len()];
        for (_, run) in suspects {
            let around = run.start.saturating_sub(4)..(run.end + 4).min(kept.len());
            if !judged[around.clone()].contains(&true) {
                judged[around].fill(true);
                gone[run].fill(true);
            }
        }
        if !gone.contains(&true) {
            out.sort_unstable();
            return out;
        }
        out.extend(live.iter().zip(&gone).filter(|(_, g)| **g).map(|(i, _)| *i));
        let mut gone = gone.iter();
        live.retain(|_| gone.next() != Some(&true));
    }
}

/// How many times what is allowed the nearest sample of the run is off, if more than once.
fn excess(poses: &[Pose], run: &Range<usize>, floor_m: f64) -> Option<f64> {
    let mut off_m = f64::INFINITY;
    for i in run.clone() {
        off_m = off_m.min(innovation(poses, i, run)?);
    }
    if off_m <= floor_m {
        return None;
    }
    let around = run.start.saturating_sub(2)..(run.end + 2).min(poses.len());
    let neighbours = around.filter(|i| !run.contains(i));
    let neighbours_m = neighbours
        .filter_map(|i| innovation(poses, i, run))
        .fold(0.0, f64::max);
    let excess = off_m / (floor_m + OF_NEIGHBOURS * neighbours_m);
    (excess > 1.0).then_some(excess)
}

/// How far (m) sample `at` is from the cubic through its two neighbours on either side, none of `without` among
/// them; near an end more of the other side's. None at the ends.
fn innovation(poses: &[Pose], at: usize, without: &Range<usize>) -> Option<f64> {
    let used = |i: &usize| *i != at && !without.contains(i);
    let mut before = (0..at).rev().filter(used);
    let mut after = (at + 1..poses.len()).filter(used);
    let mut nodes = Vec::with_capacity(4);
    nodes.extend(before.by_ref().take(2));
    let left = nodes.len();
    nodes.extend(after.by_ref().take(4 - left));
    let right = nodes.len() - left;
    nodes.extend(before.take(4 - nodes.len()));
    if left == 0 || right == 0 || nodes.len() < 3 {
        return None;
    }
    let t = poses[at].t_s;
    let mut place = Vector3::zeros();
    for &i in &nodes {
        let others = nodes.iter().filter(|j| **j != i);
        let weight: f64 = others
            .map(|&j| (t - poses[j].t_s) / (poses[i].t_s - poses[j].t_s))
            .product();
        place += poses[i].position * weight;
    }
    Some((poses[at].position - place).norm())
}

fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}
