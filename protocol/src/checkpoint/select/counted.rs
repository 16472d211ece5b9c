//! The least error with a given number of checkpoints.

use nalgebra::SVector;

use super::super::plan::MAX_STEPS;
use super::super::{CheckpointError, Grid, MAX_POINTS, Plan, check_series};
use super::Effort;
use super::search::{Motion, Search};

/// Sample evaluations spent on moving points, by [`Effort::Thorough`] and by the others.
const EFFORT: usize = 1 << 23;
const BRISK_EFFORT: usize = 12_000;

/// Steps of the plan are this share of the error of the curve that is not quantised.
const STEP: f64 = 0.5;

/// `count` checkpoints (at most as many as there are samples) of the motion `y` (m) at times `t` (s from its
/// start, not negative, increasing) whose decoded curve has a small sum of squared errors at the samples.
///
/// Inserts the worst sample, or takes equal shares of √|Laplacian|, then moves and swaps points while that
/// helps; their values are those of least squares. Quantised to a fraction of the error that is left.
///
/// # Errors
/// [`CheckpointError`]: an unusable series, fewer than two or more than [`MAX_POINTS`] points asked for,
/// values beyond the grid.
pub fn counted<const D: usize>(
    t: &[f64],
    y: &[SVector<f64, D>],
    count: usize,
) -> Result<Plan<D>, CheckpointError> {
    counted_with(t, y, count, Effort::Thorough)
}

/// As [`counted`], with so much effort; all but [`Effort::Thorough`] are one here.
///
/// # Errors
/// As [`counted`].
pub fn counted_with<const D: usize>(
    t: &[f64],
    y: &[SVector<f64, D>],
    count: usize,
    effort: Effort,
) -> Result<Plan<D>, CheckpointError> {
    check_series(t, y)?;
    if count < 2 {
        return Err(CheckpointError::TooFew { count, least: 2 });
    }
    if count > MAX_POINTS {
        return Err(CheckpointError::TooMany);
    }
    let motion = Motion::new(t, y);
    let any = Grid::for_bound(1.0)?.with_fine_ticks().with_ticks_of(t);
    let mut search = Search::new(&motion, any);
    let thorough = effort == Effort::Thorough;
    let effort = if thorough { EFFORT } else { BRISK_EFFORT };
    let mut starts = vec![search.shares(count)];
    // One fit a point: more than all there is to spend, for many.
    if thorough || 2 * count * t.len() < BRISK_EFFORT / 2 {
        starts.insert(0, inserted(&mut search, count));
    }
    let mut best = (f64::INFINITY, Vec::new());
    for mut kept in starts {
        search.effort = 0;
        let sum = improve(&mut search, &mut kept, effort);
        if kept.len() <= count && sum < best.0 {
            best = (sum, kept);
        }
    }
    let (sum, kept) = best;
    if kept.is_empty() {
        // Samples within one tick of each other.
        return Err(CheckpointError::Unordered { index: 1 });
    }
    let rms_m = (sum / (t.len() * D) as f64).sqrt();
    let largest = y.iter().map(|y| y.amax()).fold(0.0, f64::max);
    // Not so fine that the values do not fit, twice over for those off the curve.
    let step_m = (STEP * rms_m).max(largest * 2.0 / f64::from(MAX_STEPS));
    let grid = Grid::for_bound((4.0 * step_m).clamp(4e-9, 16.0))?;
    search.squares(&kept);
    search.plan_on(&kept, Grid::new(grid.step_nm(), any.tick_us())?)
}

/// The ends, then the worst sample, again and again.
fn inserted<const D: usize>(search: &mut Search<'_, D>, count: usize) -> Vec<usize> {
    let mut kept = vec![0, search.samples() - 1];
    while kept.len() < count {
        search.squares(&kept);
        let errors = search.errors();
        let worst = (1..search.samples() - 1)
            .filter(|&i| search.may_insert(&kept, i))
            .max_by(|&a, &b| errors[a].total_cmp(&errors[b]));
        let Some(i) = worst else { break };
        kept.insert(kept.partition_point(|&k| k < i), i);
    }
    kept
}

/// Moves and swaps points while that lowers the sum of squares, which it returns.
fn improve<const D: usize>(
    search: &mut Search<'_, D>,
    kept: &mut Vec<usize>,
    effort: usize,
) -> f64 {
    let mut sum = search.squares(kept);
    loop {
        let before = sum;
        for j in 1..kept.len() - 1 {
            if search.effort > effort {
                return sum;
            }
            for step in [-8, -4, -2, -1, 1, 2, 4, 8] {
                let old = kept[j];
                let Some(new) = old.checked_add_signed(step) else {
                    continue;
                };
                if new <= kept[j - 1]
                    || new >= kept[j + 1]
                    || !search.apart(kept[j - 1], new)
                    || !search.apart(new, kept[j + 1])
                {
                    continue;
                }
                kept[j] = new;
                let lower = search.squares(kept);
                if lower < sum {
                    sum = lower;
                } else {
                    kept[j] = old;
                }
            }
        }
        if !(sum < 0.999 * before) && !swap(search, kept, &mut sum, effort) {
            return sum;
        }
    }
}

/// Takes one point out and puts one in elsewhere, if some such pair lowers the sum of squares.
fn swap<const D: usize>(
    search: &mut Search<'_, D>,
    kept: &mut Vec<usize>,
    sum: &mut f64,
    effort: usize,
) -> bool {
    for j in 1..kept.len() - 1 {
        let mut without = kept.clone();
        without.remove(j);
        search.squares(&without);
        // The sample in the middle of the span with the largest share of the error.
        let errors = search.errors();
        let share = |w: &[usize]| errors[w[0]..w[1]].iter().sum::<f64>();
        let candidates = without.windows(2).map(|w| (share(w), (w[0] + w[1]) / 2));
        let mut candidates: Vec<_> = candidates
            .filter(|(_, i)| search.may_insert(&without, *i))
            .collect();
        candidates.sort_by(|a, b| b.0.total_cmp(&a.0));
        for (_, i) in candidates.into_iter().take(3) {
            let mut with = without.clone();
            with.insert(with.partition_point(|&k| k < i), i);
            let lower = search.squares(&with);
            if lower < 0.999 * *sum {
                *sum = lower;
                *kept = with;
                return true;
            }
        }
        if search.effort > effort {
            return false;
        }
    }
    false
}

#[cfg(test)]
mod tests;
