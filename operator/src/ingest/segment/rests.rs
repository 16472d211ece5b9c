//! Where the hand rests, and what it does in between.

use std::ops::Range;

use nalgebra::Vector3;

use super::motion::{Motion, steps};

/// A rest is slower than this share of the fast motion.
const SLOW: f64 = 0.12;

/// At rest, noise gives speeds up to so many times the noise, per s.
const NOISE_PER_S: f64 = 25.0;

/// Noise never makes more than this share of the fast motion a rest.
const SLOWEST: f64 = 0.25;

/// A rest lasts at least this long, s.
const LEAST_S: f64 = 0.3;

/// For this share of a rest the hand is slower than half the limit; where it only turns, for half of it.
const STILL: f64 = 0.7;

/// Rests further apart than this share of the motion's extent are different places.
const ELSEWHERE: f64 = 0.35;

/// A bout whose way is shorter than this share of the median one is a fidget.
const FIDGET: f64 = 0.2;

/// So much of the rest before and after stays with a bout, s.
const KEPT_S: f64 = 0.3;

/// Motion between two rests.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Bout {
    pub(super) moving: Range<usize>,
    /// With the part of the rests that belongs to it.
    pub(super) kept: Range<usize>,
}

/// All rests, in order.
pub(super) fn find(motion: &Motion) -> Vec<Range<usize>> {
    let noise = (NOISE_PER_S * motion.noise_m).min(SLOWEST * motion.fast_m_s);
    let limit = noise.max(SLOW * motion.fast_m_s);
    let mut rests = Vec::new();
    let mut start = 0;
    for i in 0..=motion.len() {
        if motion.speed.get(i).is_some_and(|v| *v < limit) {
            continue;
        }
        let slow = &motion.speed[start..i];
        let still = slow.iter().filter(|v| **v < 0.5 * limit).count();
        if slow.len() >= steps(LEAST_S) && still as f64 >= STILL * slow.len() as f64 {
            rests.push(start..i);
        }
        start = i + 1;
    }
    rests
}

/// What is done between rests in the place where the hand rests most often. A rest elsewhere is a part of what is done: a reach
/// out, a pause and the way back are one repetition.
pub(super) fn bouts(motion: &Motion, rests: &[Range<usize>]) -> Vec<Bout> {
    let places: Vec<Vector3<f64>> = rests
        .iter()
        .map(|r| motion.x[r.clone()].iter().sum::<Vector3<f64>>() / r.len() as f64)
        .collect();
    let extent = (0..3)
        .map(|d| {
            let all = motion.x.iter().map(|x| x[d]);
            let (low, high) = all.fold((f64::MAX, f64::MIN), |(l, h), x| (l.min(x), h.max(x)));
            (high - low).powi(2)
        })
        .sum::<f64>()
        .sqrt();
    let near = |a: &Vector3<f64>, b: &Vector3<f64>| (a - b).norm() <= ELSEWHERE * extent;
    let company = |p: &Vector3<f64>| places.iter().filter(|q| near(p, q)).count();
    // The first of the most visited places.
    let home = places
        .iter()
        .rev()
        .max_by_key(|p| company(p))
        .copied()
        .unwrap_or_default();
    let at_home: Vec<Range<usize>> = rests
        .iter()
        .zip(&places)
        .filter(|(_, p)| near(p, &home))
        .map(|(r, _)| r.clone())
        .collect();
    let mut moving = Vec::new();
    let mut start = 0;
    for rest in at_home.iter().chain([&(motion.len()..motion.len())]) {
        if rest.start > start {
            moving.push(start..rest.start);
        }
        start = rest.end;
    }
    let way = |r: &Range<usize>| motion.speed[r.clone()].iter().sum::<f64>();
    let mut ways: Vec<f64> = moving.iter().map(way).collect();
    ways.sort_by(f64::total_cmp);
    let usual = ways.get(ways.len() / 2).copied().unwrap_or(0.0);
    moving.retain(|r| way(r) >= FIDGET * usual);
    let half = |gap: usize| (gap / 2).min(steps(KEPT_S));
    let ends: Vec<(usize, usize)> = (0..moving.len())
        .map(|i| {
            let before = match i.checked_sub(1) {
                Some(j) => half(moving[i].start - moving[j].end),
                None => moving[i].start.min(steps(KEPT_S)),
            };
            let after = match moving.get(i + 1) {
                Some(next) => half(next.start - moving[i].end),
                None => (motion.len() - moving[i].end).min(steps(KEPT_S)),
            };
            (moving[i].start - before, moving[i].end + after)
        })
        .collect();
    moving
        .into_iter()
        .zip(ends)
        .map(|(moving, (from, to))| Bout {
            moving,
            kept: from..to,
        })
        .collect()
}
