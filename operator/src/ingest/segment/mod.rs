//! One long recording of a repeated motion, cut into its repetitions.
//!
//! Rests first: a person who does something five times usually stops in between. Where nobody stops, the motion is its own template: it is
//! cut each time that the hand comes back to one state of it, place and velocity. Neither found, nothing is cut.

mod motion;
mod rests;
mod returns;

#[cfg(test)]
mod tests;

use std::ops::Range;

use serde::Serialize;

use super::Pose;
use crate::demonstration::LEAST_SAMPLES;
use motion::Motion;

/// What cuts follow.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// Nothing: the stretch is one demonstration.
    Whole,
    /// The times that were given.
    ByHand,
    /// The hand rests between repetitions.
    Rests,
    /// The hand returns, again and again, to one state of its motion.
    Returns,
}

/// How a stretch is cut.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    /// What the cuts follow.
    pub method: Method,
    /// When it is cut, s, ascending: amid a rest, or at the returns (the first and last of them end the repetitions).
    pub at_s: Vec<f64>,
    /// Usual time of one repetition where it returns, s.
    pub period_s: Option<f64>,
    /// Samples of each piece; in order, none in two.
    pub ranges: Vec<Range<usize>>,
}

/// All of it in one piece.
pub fn whole(poses: &[Pose]) -> Found {
    by_hand(poses, &[])
}

/// Pieces between the given times, s; a sample at a cut begins a piece.
pub fn by_hand(poses: &[Pose], at_s: &[f64]) -> Found {
    let (Some(first), Some(last)) = (poses.first(), poses.last()) else {
        return Found {
            method: Method::Whole,
            at_s: Vec::new(),
            period_s: None,
            ranges: Vec::new(),
        };
    };
    let mut at_s: Vec<f64> = at_s
        .iter()
        .copied()
        .filter(|t| first.t_s < *t && *t <= last.t_s)
        .collect();
    at_s.sort_by(f64::total_cmp);
    at_s.dedup();
    let cuts = at_s.iter().map(|t| poses.partition_point(|p| p.t_s < *t));
    let ends: Vec<usize> = cuts.chain([poses.len()]).collect();
    let starts = std::iter::once(0).chain(ends.iter().copied());
    Found {
        method: if at_s.is_empty() {
            Method::Whole
        } else {
            Method::ByHand
        },
        period_s: None,
        ranges: starts.zip(&ends).map(|(a, b)| a..*b).collect(),
        at_s,
    }
}

/// The repetitions in one stretch without holes.
pub fn repetitions(poses: &[Pose]) -> Found {
    let motion = match Motion::new(poses) {
        Some(motion) if poses.len() >= 2 * LEAST_SAMPLES => motion,
        _ => return whole(poses),
    };
    let index = |t_s: f64| poses.partition_point(|p| p.t_s < t_s);
    let rests = rests::find(&motion);
    let bouts = rests::bouts(&motion, &rests);
    if bouts.len() > 1 {
        let pairs = bouts.iter().zip(&bouts[1..]);
        return Found {
            method: Method::Rests,
            at_s: pairs
                .map(|(a, b)| motion.time((a.moving.end + b.moving.start) / 2))
                .collect(),
            period_s: None,
            ranges: bouts
                .iter()
                .map(|b| index(motion.time(b.kept.start))..index(motion.time(b.kept.end)))
                .collect(),
        };
    }
    let moving = bouts.first().map_or(0..motion.len(), |b| b.moving.clone());
    match returns::find(&motion, moving) {
        None => whole(poses),
        Some(found) => Found {
            method: Method::Returns,
            at_s: found.marks.iter().map(|m| motion.time(*m)).collect(),
            period_s: Some(found.period_s),
            ranges: found
                .pieces
                .iter()
                .map(|p| index(motion.time(p.start))..index(motion.time(p.end)))
                .collect(),
        },
    }
}
