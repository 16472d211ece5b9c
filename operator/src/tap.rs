//! An input's latency, from taps: a hand that stops abruptly on a table does so at a moment that something else tells exactly (driving.md §6).

use nalgebra::{Matrix2, Vector2, Vector3};

/// Fewer taps than this say nothing.
pub const LEAST_TAPS: usize = 5;

/// A stop is looked for this long before and after a tap's own time, s.
pub const SEARCHED_S: (f64, f64) = (-0.05, 0.5);

/// Slower than this (m/s) a hand does not tap.
const FAST_M_S: f64 = 0.3;

/// After a stop, two samples on, no more than this share of the speed is left.
const LEFT: f64 = 0.3;

/// Nor has the hand slowed before: it comes with this share of its speed of the last tenth of a second.
const UNBRAKED: f64 = 0.7;

/// A hand that has stopped stays within this, m, for this long, s.
const STILL_M: f64 = 0.02;
const STILL_S: f64 = 0.1;

/// Stops that belong to one latency lie this close about it, s.
const TOGETHER_S: f64 = 0.04;

/// A larger deviation of single taps is no measurement, s.
const WIDEST_S: f64 = 0.04;

/// From the median absolute deviation of a normal distribution to its standard deviation.
const MAD: f64 = 1.4826;

/// The median's standard error, in standard errors of the mean, for normal deviations.
const MEDIAN: f64 = 1.2533;

/// What taps say of an input's latency.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Latency {
    /// How much later than they were the recording has the taps, s.
    pub latency_s: f64,
    /// The latency is known to this, at 95 %, s.
    pub bound_s: f64,
    /// Standard deviation of a single tap, s.
    pub deviation_s: f64,
    /// Taps that say so.
    pub used: usize,
    /// Taps that were named.
    pub taps: usize,
    /// Abrupt stops in the recording.
    pub stops: usize,
}

/// Why taps say nothing.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum TapError {
    /// The list is too short.
    #[error(
        "{taps} tap times: at least {LEAST_TAPS} are needed; tap about ten times, a second or more apart"
    )]
    FewTaps {
        /// How many there are.
        taps: usize,
    },
    /// A time that is none, or not in order.
    #[error("tap {number}: {t_s} s does not follow the one before; write the times in order, in s")]
    Unordered {
        /// Which one, from 1 on.
        number: usize,
        /// Its time, s.
        t_s: f64,
    },
    /// The hand never stops abruptly.
    #[error(
        "the recording has {stops} abrupt stops, and {LEAST_TAPS} are needed: come down on the table at {FAST_M_S} m/s or faster, and stay there for a moment"
    )]
    FewStops {
        /// How many there are.
        stops: usize,
    },
    /// Taps and stops do not belong together.
    #[error(
        "only {matched} of {taps} taps are followed by a stop at a common distance, from {} s before to {} s after: are the times those of the recording's clock?",
        -SEARCHED_S.0,
        SEARCHED_S.1
    )]
    Unmatched {
        /// Taps that are.
        matched: usize,
        /// Taps that were named.
        taps: usize,
    },
    /// More than one latency would do.
    #[error(
        "{first_s:.3} s and {second_s:.3} s would do as well: tap slower, and not in an even rhythm"
    )]
    Ambiguous {
        /// One, s.
        first_s: f64,
        /// Another, s.
        second_s: f64,
    },
    /// Single taps differ too much.
    #[error(
        "single taps differ by {deviation_s:.3} s (standard deviation), and {WIDEST_S} s is the most that is believed: press in the moment the hand touches"
    )]
    Scattered {
        /// By how much, s.
        deviation_s: f64,
    },
    /// The hand seems to stop before it does.
    #[error(
        "the recording has the taps {early_s:.3} s before they were: the times are not those of its clock"
    )]
    Early {
        /// By how much, s.
        early_s: f64,
    },
}

/// The latency of a recording (s, m; in order of time) in which the hand touched a table at the times `taps` (s, on the same clock).
///
/// The stops are found to a fraction of a sample: before one the hand comes down along a parabola, after it it rests. Each tap then has its
/// own latency; theirs is the median, known to twice its standard error (from the median absolute deviation), and never better than a millisecond.
///
/// # Errors
/// [`TapError`]: too little, or too contradictory, to say.
pub fn latency(recording: &[(f64, Vector3<f64>)], taps: &[f64]) -> Result<Latency, TapError> {
    if taps.len() < LEAST_TAPS {
        return Err(TapError::FewTaps { taps: taps.len() });
    }
    let follows = |i: usize| taps[i].is_finite() && (i == 0 || taps[i] > taps[i - 1]);
    if let Some(i) = (0..taps.len()).find(|&i| !follows(i)) {
        return Err(TapError::Unordered {
            number: i + 1,
            t_s: taps[i],
        });
    }
    let stops = stops(recording);
    if stops.len() < LEAST_TAPS {
        return Err(TapError::FewStops { stops: stops.len() });
    }
    let near = |offset_s: f64| -> Vec<f64> {
        let nearest = taps.iter().filter_map(|tap| {
            let from = stops.iter().map(|stop| stop - tap);
            from.min_by(|a, b| (a - offset_s).abs().total_cmp(&(b - offset_s).abs()))
        });
        nearest
            .filter(|own| (own - offset_s).abs() <= TOGETHER_S)
            .collect()
    };
    let mut candidates: Vec<f64> = taps
        .iter()
        .flat_map(|tap| stops.iter().map(move |stop| stop - tap))
        .filter(|offset| (SEARCHED_S.0..=SEARCHED_S.1).contains(offset))
        .collect();
    candidates.sort_by(f64::total_cmp);
    let votes: Vec<(f64, usize)> = candidates.iter().map(|&c| (c, near(c).len())).collect();
    let best = votes.iter().map(|v| v.1).max().unwrap_or(0);
    if best < LEAST_TAPS || 2 * best < taps.len() {
        return Err(TapError::Unmatched {
            matched: best,
            taps: taps.len(),
        });
    }
    let with_most = |v: &&(f64, usize)| v.1 == best;
    let common = median(votes.iter().filter(with_most).map(|v| v.0));
    let rival = votes
        .iter()
        .find(|(c, n)| (c - common).abs() > 2.0 * TOGETHER_S && 10 * n >= 7 * best);
    if let Some((second_s, _)) = rival {
        return Err(TapError::Ambiguous {
            first_s: common,
            second_s: *second_s,
        });
    }
    let own = near(common);
    let latency_s = median(own.iter().copied());
    let deviation_s = MAD * median(own.iter().map(|l| (l - latency_s).abs()));
    if deviation_s > WIDEST_S {
        return Err(TapError::Scattered { deviation_s });
    }
    let bound_s = (2.0 * MEDIAN * deviation_s / (own.len() as f64).sqrt()).max(1e-3);
    if latency_s < -bound_s {
        return Err(TapError::Early {
            early_s: -latency_s,
        });
    }
    Ok(Latency {
        latency_s: latency_s.max(0.0),
        bound_s,
        deviation_s,
        used: own.len(),
        taps: taps.len(),
        stops: stops.len(),
    })
}

/// The moments at which the hand stops abruptly, s.
pub fn stops(recording: &[(f64, Vector3<f64>)]) -> Vec<f64> {
    let speed = |i: usize| {
        let ((t0, a), (t1, b)) = (recording[i - 1], recording[i]);
        (b - a).norm() / (t1 - t0).max(1e-6)
    };
    let mut found: Vec<f64> = Vec::new();
    for k in 3..recording.len().saturating_sub(3) {
        // `k` is the last sample before the stop: between it and the next the hand may have touched.
        let coming = speed(k);
        let fastest = (k - 2..=k).map(speed).fold(0.0, f64::max);
        let braked = coming < UNBRAKED * fastest || speed(k + 1) > coming / UNBRAKED;
        if coming < FAST_M_S || speed(k + 2) > LEFT * coming || braked {
            continue;
        }
        let Some(rest) = rest_after(recording, k + 2) else {
            continue;
        };
        let touched = touch(recording, k, &rest);
        if found.last().is_none_or(|last| touched - last > STILL_S) {
            found.push(touched);
        }
    }
    found
}

/// Where the hand rests from sample `from` on; `None` if it does not.
fn rest_after(recording: &[(f64, Vector3<f64>)], from: usize) -> Option<Vector3<f64>> {
    let begins = recording[from].0;
    let still: Vec<_> = recording[from..]
        .iter()
        .take_while(|(t, _)| t - begins <= STILL_S)
        .map(|(_, x)| *x)
        .collect();
    let rest = still.iter().sum::<Vector3<f64>>() / still.len() as f64;
    let stays = still.iter().all(|x| (x - rest).norm() <= STILL_M);
    // The recording may end before it is known.
    let ends = recording[recording.len() - 1].0 - begins >= 0.5 * STILL_S;
    (stays && ends && still.len() >= 3).then_some(rest)
}

/// When the hand that came down until sample `k`, and then was at `rest`, touched, s.
fn touch(recording: &[(f64, Vector3<f64>)], k: usize, rest: &Vector3<f64>) -> f64 {
    let around = &recording[k - 3..=k + 3];
    let way = rest - recording[k - 2].1;
    let way = way / way.norm().max(1e-9);
    let left: Vec<(f64, f64)> = around
        .iter()
        .map(|(t, x)| (*t, (rest - x).dot(&way)))
        .collect();
    // Before the touch at τ what is left is v(τ−t) + b(τ−t)²; v and b follow by least squares.
    let misfit = |touched: f64| -> f64 {
        let (mut normal, mut right) = (Matrix2::<f64>::zeros(), Vector2::<f64>::zeros());
        for (t, left) in &left {
            let before = (touched - t).max(0.0);
            let row = Vector2::new(before, before * before);
            normal += row * row.transpose();
            right += row * *left;
        }
        let fit = normal.try_inverse().map_or(Vector2::zeros(), |i| i * right);
        left.iter()
            .map(|(t, left)| {
                let before = (touched - t).max(0.0);
                (left - fit.x * before - fit.y * before * before).powi(2)
            })
            .sum()
    };
    let (from, to) = (recording[k - 1].0, recording[k + 2].0);
    let steps = ((to - from) / 0.25e-3) as u32;
    (0..=steps)
        .map(|i| from + f64::from(i) * 0.25e-3)
        .min_by(|a, b| misfit(*a).total_cmp(&misfit(*b)))
        .unwrap_or(recording[k].0)
}

/// 0 of nothing.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let n = values.len();
    match n {
        0 => 0.0,
        n if n % 2 == 1 => values[n / 2],
        _ => 0.5 * (values[n / 2 - 1] + values[n / 2]),
    }
}
