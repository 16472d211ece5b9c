//! A motion that repeats without rest: when it is back where it was, going the same way.

use std::f64::consts::PI;
use std::ops::Range;

use nalgebra::{Vector3, Vector6};

use super::motion::{Motion, STEP_S, steps};

/// Repetitions take at least and at most this long, s.
const PERIOD_S: (f64, f64) = (0.3, 20.0);

/// Mean squared difference between velocities a period apart, as a share of that between unrelated moments.
const ALIKE: f64 = 0.7;

/// A period is looked for where the motion has become unlike itself first.
const UNLIKE: f64 = 0.8;

/// Of periods about as good the shortest: a multiple is a period as well.
const AS_GOOD: f64 = 0.3;

/// Squared distance of states at a return, as a share of that between unrelated ones.
const BACK: f64 = 0.25;

/// Two returns are at least this share of a period apart.
const APART: f64 = 0.6;

/// What takes this share of the usual time from return to return is a repetition.
const REPETITION: (f64, f64) = (0.5, 1.6);

/// The way to the first return, or from the last, is a repetition if it lasts about as long and goes along the others, to this share of
/// the motion's variance.
const SAME_TIME: (f64, f64) = (0.7, 1.4);
const SAME_WAY: f64 = 0.25;

/// Repetitions go along their mean to this share of their variance, or they are none.
const REPEATS: f64 = 0.3;

/// At most so many states are tried as the one to return to.
const ANCHORS: usize = 150;

pub(super) struct Returns {
    /// Steps at which the hand is back, ascending; at least three.
    pub(super) marks: Vec<usize>,
    /// Steps of each repetition.
    pub(super) pieces: Vec<Range<usize>>,
    /// The median time from one to the next, s.
    pub(super) period_s: f64,
}

pub(super) fn find(motion: &Motion, within: Range<usize>) -> Option<Returns> {
    let x = &motion.x[within.clone()];
    let mean = x.iter().sum::<Vector3<f64>>() / x.len().max(1) as f64;
    let variance = x.iter().map(|x| (x - mean).norm_squared()).sum::<f64>() / x.len().max(1) as f64;
    let period = period(&motion.v[within.clone()])?;
    let rate = 2.0 * PI / (period as f64 * STEP_S);
    let states: Vec<Vector6<f64>> = within
        .clone()
        .map(|i| {
            let (x, v) = (motion.x[i] - mean, motion.v[i] / rate);
            Vector6::new(x.x, x.y, x.z, v.x, v.y, v.z)
        })
        .collect();
    let slow = |i: usize| 1.0 - 0.5 * (motion.speed[within.start + i] / motion.fast_m_s).min(1.0);
    let marks = best_marks(&states, period, slow)?;

    let mut gaps: Vec<usize> = marks.windows(2).map(|w| w[1] - w[0]).collect();
    gaps.sort_unstable();
    let usual = gaps[gaps.len() / 2] as f64;
    let takes = |range: &Range<usize>, (low, high): (f64, f64)| {
        (low * usual..=high * usual).contains(&(range.len() as f64))
    };
    let mut pieces: Vec<Range<usize>> = marks
        .windows(2)
        .map(|w| w[0]..w[1])
        .filter(|r| takes(r, REPETITION))
        .collect();
    let (first, last) = marks.first().zip(marks.last())?;
    let alike = |piece: &Range<usize>| {
        takes(piece, SAME_TIME) && off_mean(x, piece, &pieces) < SAME_WAY * variance
    };
    let (lead, tail) = (0..*first, *last..x.len());
    let (lead_in, tail_in) = (alike(&lead), alike(&tail));
    if lead_in {
        pieces.insert(0, lead);
    }
    if tail_in {
        pieces.push(tail);
    }
    let n = pieces.len();
    if n < 2 {
        return None;
    }
    // Each piece draws the mean towards itself by one nth.
    let apart = pieces.iter().map(|p| off_mean(x, p, &pieces)).sum::<f64>() / (n - 1) as f64;
    let repeated = &x[pieces[0].start..pieces[n - 1].end];
    let centre = repeated.iter().sum::<Vector3<f64>>() / repeated.len() as f64;
    let spread = repeated
        .iter()
        .map(|x| (x - centre).norm_squared())
        .sum::<f64>();
    if apart > REPEATS * spread / repeated.len() as f64 {
        return None;
    }
    let shift = within.start;
    Some(Returns {
        marks: marks.iter().map(|m| m + shift).collect(),
        pieces: pieces
            .into_iter()
            .map(|r| r.start + shift..r.end + shift)
            .collect(),
        period_s: usual * STEP_S,
    })
}

/// The time after which the motion is most like itself, in steps. Velocities tell: the way up to the first repetition and
/// down from the last moves the place more than they do, but not for long.
fn period(v: &[Vector3<f64>]) -> Option<usize> {
    let longest = (v.len() / 2).min(steps(PERIOD_S.1));
    let power = v.iter().map(Vector3::norm_squared).sum::<f64>() / v.len().max(1) as f64;
    let unlike: Vec<f64> = (0..=longest)
        .map(|lag| {
            let pairs = v.iter().zip(&v[lag..]);
            let n = (v.len() - lag) as f64;
            pairs.map(|(a, b)| (a - b).norm_squared()).sum::<f64>() / (2.0 * power * n)
        })
        .collect();
    let after = unlike
        .iter()
        .position(|d| *d > UNLIKE)?
        .max(steps(PERIOD_S.0));
    let lows: Vec<usize> = (after + 1..longest)
        .filter(|&i| unlike[i] <= unlike[i - 1] && unlike[i] <= unlike[i + 1])
        .collect();
    let best = lows.iter().map(|i| unlike[*i]).fold(f64::MAX, f64::min);
    lows.into_iter()
        .find(|i| unlike[*i] <= best + AS_GOOD)
        .filter(|i| unlike[*i] < ALIKE)
}

/// Returns to whichever state is returned to most often and most nearly; slow ones are preferred: a
/// repetition begins where the hand turns.
fn best_marks(
    states: &[Vector6<f64>],
    period: usize,
    slow: impl Fn(usize) -> f64,
) -> Option<Vec<usize>> {
    let spread = 2.0 * states.iter().map(Vector6::norm_squared).sum::<f64>() / states.len() as f64;
    let limit = BACK * spread;
    let middle = states.len() / 2;
    let reach = (3 * period / 2).min(middle);
    let candidates = middle - reach..(middle + reach).min(states.len());
    let stride = candidates.len().div_ceil(ANCHORS).max(1);
    let mut best: Option<(f64, Vec<usize>)> = None;
    for anchor in candidates.step_by(stride) {
        let off: Vec<f64> = states
            .iter()
            .map(|s| (s - states[anchor]).norm_squared())
            .collect();
        let low = |i: &usize| {
            off[*i] < limit
                && (*i == 0 || off[*i] <= off[i - 1])
                && (*i + 1 == off.len() || off[*i] <= off[i + 1])
        };
        let mut lows: Vec<usize> = (0..off.len()).filter(low).collect();
        lows.sort_by(|a, b| off[*a].total_cmp(&off[*b]).then(a.cmp(b)));
        let mut marks: Vec<usize> = Vec::new();
        for i in lows {
            let far = |m: &usize| m.abs_diff(i) as f64 > APART * period as f64;
            if marks.iter().all(far) {
                marks.push(i);
            }
        }
        let near: f64 = marks.iter().map(|i| 1.0 - off[*i] / limit).sum();
        let score = near * slow(anchor);
        if marks.len() > 2 && best.as_ref().is_none_or(|(s, _)| score > *s) {
            marks.sort_unstable();
            best = Some((score, marks));
        }
    }
    best.map(|(_, marks)| marks)
}

/// Mean squared distance of a piece from the mean of others, each stretched to one length.
fn off_mean(x: &[Vector3<f64>], piece: &Range<usize>, others: &[Range<usize>]) -> f64 {
    const POINTS: usize = 20;
    let at = |r: &Range<usize>, k: usize| x[r.start + (r.len() - 1) * k / (POINTS - 1)];
    (0..POINTS)
        .map(|k| {
            let sum: Vector3<f64> = others.iter().map(|r| at(r, k)).sum();
            (at(piece, k) - sum / others.len().max(1) as f64).norm_squared()
        })
        .sum::<f64>()
        / POINTS as f64
}
