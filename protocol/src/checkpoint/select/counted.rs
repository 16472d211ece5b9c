//! The least error with a given number of checkpoints.

use nalgebra::SVector;

use super::super::plan::MAX_STEPS;
use super::super::{CheckpointError, Grid, MAX_POINTS, Plan, check_series};
use super::search::{Motion, Search};
use super::{Effort, Lists, Selector};

/// Sample evaluations spent on moving points, by [`Effort::Thorough`] and by the others.
const EFFORT: usize = 1 << 23;
const BRISK_EFFORT: usize = 12_000;

/// Steps of the plan are this share of the error of the curve that is not quantised.
const STEP: f64 = 0.5;

/// As [`Selector::counted`] with [`Effort::Thorough`].
///
/// # Errors
/// As [`Selector::counted`].
pub fn counted<const D: usize>(
    t: &[f64],
    y: &[SVector<f64, D>],
    count: usize,
) -> Result<Plan<D>, CheckpointError> {
    let mut selector = Selector::new();
    selector.counted(t, y, count, Effort::Thorough).cloned()
}

impl<const D: usize> Selector<D> {
    /// `count` checkpoints (at most as many as there are samples) of the motion `y` (m) at times `t` (s from its
    /// start, not negative, increasing) whose decoded curve has a small sum of squared errors at the samples.
    ///
    /// Inserts the worst sample, or takes equal shares of √|Laplacian|, then moves and swaps points while that
    /// helps; their values are those of least squares. Quantised to a fraction of the error that is left. All
    /// efforts but [`Effort::Thorough`] are one here.
    ///
    /// # Errors
    /// [`CheckpointError`]: an unusable series, fewer than two or more than [`MAX_POINTS`] points asked for,
    /// values beyond the grid.
    pub fn counted(
        &mut self,
        t: &[f64],
        y: &[SVector<f64, D>],
        count: usize,
        effort: Effort,
    ) -> Result<&Plan<D>, CheckpointError> {
        check_series(t, y)?;
        if count < 2 {
            return Err(CheckpointError::TooFew { count, least: 2 });
        }
        if count > MAX_POINTS {
            return Err(CheckpointError::TooMany);
        }
        let motion = Motion { t, y };
        self.begin(motion);
        let any = Grid::for_bound(1.0)?.with_fine_ticks().with_ticks_of(t);
        let mut search = Search::new(motion, any, &mut self.buffers);
        let lists = &mut self.lists;
        let thorough = effort == Effort::Thorough;
        let effort = if thorough { EFFORT } else { BRISK_EFFORT };
        let mut least = f64::INFINITY;
        for from_worst in [true, false] {
            // One fit a point: more than all there is to spend, for many.
            if !from_worst {
                search.shares(count, &mut lists.kept);
            } else if thorough || 2 * count * t.len() < BRISK_EFFORT / 2 {
                inserted(&mut search, count, &mut lists.kept);
            } else {
                continue;
            }
            search.effort = 0;
            let sum = improve(&mut search, lists, effort);
            if lists.kept.len() <= count && sum < least {
                least = sum;
                lists.best.clone_from(&lists.kept);
            }
        }
        if least == f64::INFINITY {
            // Samples within one tick of each other.
            return Err(CheckpointError::Unordered { index: 1 });
        }
        let rms_m = (least / (t.len() * D) as f64).sqrt();
        let largest = y.iter().map(|y| y.amax()).fold(0.0, f64::max);
        // Not so fine that the values do not fit, twice over for those off the curve.
        let step_m = (STEP * rms_m).max(largest * 2.0 / f64::from(MAX_STEPS));
        let grid = Grid::for_bound((4.0 * step_m).clamp(4e-9, 16.0))?;
        search.squares(&lists.best);
        let grid = Grid::new(grid.step_nm(), any.tick_us())?;
        search.plan_on(&lists.best, grid, &mut self.plan)?;
        Ok(&self.plan)
    }
}

/// The ends, then the worst sample, again and again.
fn inserted<const D: usize>(search: &mut Search<'_, D>, count: usize, kept: &mut Vec<usize>) {
    kept.clear();
    kept.extend([0, search.samples() - 1]);
    while kept.len() < count {
        search.squares(kept);
        let errors = search.errors();
        let worst = (1..search.samples() - 1)
            .filter(|&i| search.may_insert(kept, i))
            .max_by(|&a, &b| errors[a].total_cmp(&errors[b]));
        let Some(i) = worst else { break };
        kept.insert(kept.partition_point(|&k| k < i), i);
    }
}

/// Moves and swaps points while that lowers the sum of squares, which it returns.
fn improve<const D: usize>(search: &mut Search<'_, D>, lists: &mut Lists, effort: usize) -> f64 {
    let mut sum = search.squares(&lists.kept);
    loop {
        let before = sum;
        let kept = &mut lists.kept;
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
        if !(sum < 0.999 * before) && !swap(search, lists, &mut sum, effort) {
            return sum;
        }
    }
}

/// Takes one point out and puts one in elsewhere, if some such pair lowers the sum of squares.
fn swap<const D: usize>(
    search: &mut Search<'_, D>,
    lists: &mut Lists,
    sum: &mut f64,
    effort: usize,
) -> bool {
    let Lists {
        kept,
        other: without,
        order: with,
        costs: candidates,
        ..
    } = lists;
    for j in 1..kept.len() - 1 {
        without.clone_from(kept);
        without.remove(j);
        search.squares(without);
        // The sample in the middle of the span with the largest share of the error.
        let errors = search.errors();
        let share = |w: &[usize]| errors[w[0]..w[1]].iter().sum::<f64>();
        let middles = without.windows(2).map(|w| (share(w), (w[0] + w[1]) / 2));
        candidates.clear();
        candidates.extend(middles.filter(|(_, i)| search.may_insert(without, *i)));
        candidates.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        for &(_, i) in candidates.iter().take(3) {
            with.clone_from(without);
            with.insert(with.partition_point(|&k| k < i), i);
            let lower = search.squares(with);
            if lower < 0.999 * *sum {
                *sum = lower;
                kept.clone_from(with);
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
