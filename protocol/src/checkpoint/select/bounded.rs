//! Fewest checkpoints, and bytes, within a given error.

use nalgebra::SVector;

use super::super::{CheckpointError, Grid, Plan, check_series};
use super::cheapen::cheapen;
use super::search::{Motion, Search};
use super::{Effort, Lists, Selector};

/// Sample evaluations spent on making a sufficient choice smaller, on each grid.
const REFINING_EFFORT: usize = 1 << 22;

/// The same for [`Effort::Brisk`].
const BRISK_EFFORT: usize = 6_000;

/// Its grid, in quarters of the bound.
const BRISK_STEP: f64 = 2.0;

/// Steps tried, in quarters of the bound: coarser ones take fewer bits, and may take more points.
const COARSER: [f64; 4] = [1.0, 2.0, 3.0, 4.0];

/// Checkpoints of the motion `y` (m) at times `t` (s from its start, not negative, increasing) whose
/// decoded curve passes within `bound_m` of *every* sample.
///
/// As [`Selector::bounded`] with [`Effort::Thorough`].
///
/// # Errors
/// As [`Selector::bounded`].
pub fn bounded<const D: usize>(
    t: &[f64],
    y: &[SVector<f64, D>],
    bound_m: f64,
) -> Result<Plan<D>, CheckpointError> {
    let mut selector = Selector::new();
    selector.bounded(t, y, bound_m, Effort::Thorough).cloned()
}

impl<const D: usize> Selector<D> {
    /// Checkpoints of the motion `y` (m) at times `t` (s from its start, not negative, increasing) whose
    /// decoded curve passes within `bound_m` of *every* sample.
    ///
    /// Starts from equal shares of √|Laplacian| (the curvature), inserts the worst samples until the bound
    /// holds on the quantised curve, then drops points, moves others, and fits the values, as long as it
    /// holds; last, it is checked on what the plan decodes to. How it chooses is free; what [`Plan`] decodes to
    /// is not.
    ///
    /// # Errors
    /// [`CheckpointError`]: an unusable bound or series, more than [`MAX_POINTS`](super::super::MAX_POINTS)
    /// needed, samples less than a microsecond apart that differ by more than the bound.
    pub fn bounded(
        &mut self,
        t: &[f64],
        y: &[SVector<f64, D>],
        bound_m: f64,
        effort: Effort,
    ) -> Result<&Plan<D>, CheckpointError> {
        let fine = Grid::for_bound(bound_m)?;
        check_series(t, y)?;
        let motion = Motion { t, y };
        self.begin(motion);
        match effort {
            Effort::Quick => self.quick(motion, fine, bound_m)?,
            Effort::Brisk => {
                let grid = fine.coarser(BRISK_STEP).with_ticks_of(t);
                self.first_that_holds(grid, |s, grid| s.brisk(motion, grid, bound_m))
                    .or_else(|_| self.quick(motion, fine, bound_m))?;
            }
            Effort::Thorough => return self.cheapest(motion, fine, bound_m),
        }
        Ok(&self.plan)
    }

    /// Thoroughly, on coarser grids too: the one in the fewest bytes.
    fn cheapest(
        &mut self,
        motion: Motion<'_, D>,
        fine: Grid,
        bound_m: f64,
    ) -> Result<&Plan<D>, CheckpointError> {
        let mut least: Option<usize> = None;
        let mut refusal = None;
        for coarser in COARSER {
            let grid = fine.coarser(coarser).with_ticks_of(motion.t);
            match self.first_that_holds(grid, |s, grid| s.thorough(motion, grid, bound_m)) {
                Ok(()) => {
                    let bytes = self.plan.byte_len_by(&mut self.packer);
                    if least.is_none_or(|least| bytes < least) {
                        least = Some(bytes);
                        self.best.copy(&self.plan);
                    }
                }
                Err(e) => refusal = refusal.or(Some(e)),
            }
        }
        match (least, refusal) {
            (Some(_), _) => Ok(&self.best),
            (None, Some(e)) => Err(e),
            (None, None) => unreachable!("there is a grid to try"),
        }
    }

    /// On a grid, or with finer ticks where the samples' times do not suit it.
    fn first_that_holds(
        &mut self,
        grid: Grid,
        mut attempt: impl FnMut(&mut Self, Grid) -> Result<(), CheckpointError>,
    ) -> Result<(), CheckpointError> {
        match attempt(self, grid) {
            Err(CheckpointError::Unreachable { .. } | CheckpointError::Unordered { .. }) => {
                attempt(self, grid.with_fine_ticks())
            }
            other => other,
        }
    }

    fn quick(
        &mut self,
        motion: Motion<'_, D>,
        grid: Grid,
        bound_m: f64,
    ) -> Result<(), CheckpointError> {
        self.first_that_holds(grid, |s, grid| {
            let mut search = Search::new(motion, grid, &mut s.buffers);
            let kept = &mut s.lists.kept;
            search.shares(2, kept);
            search.insert(kept, search_bound(bound_m))?;
            search.plan(kept, &mut s.plan)?;
            s.verified(motion, bound_m)
        })
    }

    fn brisk(
        &mut self,
        motion: Motion<'_, D>,
        grid: Grid,
        bound_m: f64,
    ) -> Result<(), CheckpointError> {
        let mut search = Search::new(motion, grid, &mut self.buffers);
        let (lists, plan) = (&mut self.lists, &mut self.plan);
        let bound = search_bound(bound_m);
        search.shares(2, &mut lists.kept);
        search.insert(&mut lists.kept, bound)?;
        search.plan(&lists.kept, plan)?;
        let (mut few, mut enough) = (lists.kept.len() / 2, lists.kept.len());
        while few < enough {
            let count = (few + enough) / 2;
            search.shares(count, &mut lists.other);
            if search.fit(&lists.other, bound, bound) <= bound {
                search.plan(&lists.other, plan)?;
                enough = count;
                lists.kept.clone_from(&lists.other);
            } else {
                few = count + 1;
            }
        }
        search.effort = 0;
        leave_out(&mut search, &mut lists.kept, bound, BRISK_EFFORT, plan)?;
        self.verified(motion, bound_m)
    }

    fn thorough(
        &mut self,
        motion: Motion<'_, D>,
        grid: Grid,
        bound_m: f64,
    ) -> Result<(), CheckpointError> {
        let mut search = Search::new(motion, grid, &mut self.buffers);
        let (lists, plan) = (&mut self.lists, &mut self.plan);
        let bound = search_bound(bound_m);
        search.shares(2, &mut lists.kept);
        search.insert(&mut lists.kept, bound)?;
        search.shares(lists.kept.len() / 2, &mut lists.other);
        if search.insert(&mut lists.other, bound).is_ok() && lists.other.len() < lists.kept.len() {
            lists.kept.clone_from(&lists.other);
        }
        search.on_curve(&lists.kept);
        search.plan(&lists.kept, plan)?;
        refine(&mut search, lists, bound, plan)?;
        self.dear.copy(&self.plan);
        let memory = (&mut self.room, &mut self.packer);
        cheapen(&mut self.plan, motion, bound, memory);
        self.verified(motion, bound_m).or_else(|_| {
            self.plan.copy(&self.dear);
            self.verified(motion, bound_m)
        })
    }

    /// Whether what the plan decodes to passes every sample within the bound.
    fn verified(&mut self, motion: Motion<'_, D>, bound_m: f64) -> Result<(), CheckpointError> {
        let spline = self.plan.spline_by(&mut self.decoder)?;
        let (start_s, end_s) = spline.span_s();
        for (index, (&t, y)) in motion.t.iter().zip(motion.y).enumerate() {
            // A sample on the end's tick may lie a rounding error outside.
            let error_m = (spline.eval(t.clamp(start_s, end_s))?.x - y).norm();
            if error_m > bound_m {
                return Err(CheckpointError::Unreachable { index, error_m });
            }
        }
        Ok(())
    }
}

/// The search computes in another order than the decoder: it aims this much inside the bound.
fn search_bound(bound_m: f64) -> f64 {
    bound_m * (1.0 - 1e-7)
}

/// Drops as many points as go without moving any; `plan` becomes that of what is left, if any went.
fn leave_out<const D: usize>(
    search: &mut Search<'_, D>,
    kept: &mut Vec<usize>,
    bound: f64,
    effort: usize,
    plan: &mut Plan<D>,
) -> Result<(), CheckpointError> {
    let mut j = 1;
    while j + 1 < kept.len() && search.effort < effort {
        let dropped = kept.remove(j);
        if search.fit(kept, bound, bound) <= bound {
            search.plan(kept, plan)?;
        } else {
            kept.insert(j, dropped);
            j += 1;
        }
    }
    Ok(())
}

/// Drops points while some least-squares values, or others' places, keep the bound; `plan` as with [`leave_out`].
fn refine<const D: usize>(
    search: &mut Search<'_, D>,
    lists: &mut Lists,
    bound: f64,
    plan: &mut Plan<D>,
) -> Result<(), CheckpointError> {
    let Lists {
        kept,
        other: before,
        costs,
        order,
        ..
    } = lists;
    leave_out(search, kept, bound, REFINING_EFFORT, plan)?;
    // Then the one whose loss costs least, the others moved to make up for it.
    while kept.len() > 2 && search.effort < REFINING_EFFORT {
        costs.clear();
        for j in 1..kept.len() - 1 {
            if search.effort >= REFINING_EFFORT {
                return Ok(());
            }
            let left_out = kept.remove(j);
            costs.push((search.fit(kept, bound, 4.0 * bound), j));
            kept.insert(j, left_out);
        }
        costs.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut dropped = false;
        for &(error_m, j) in costs.iter().take(6) {
            if !error_m.is_finite() {
                break;
            }
            before.clone_from(kept);
            kept.remove(j);
            if relocate(search, kept, order, error_m, j, bound) {
                search.plan(kept, plan)?;
                dropped = true;
                break;
            }
            kept.clone_from(before);
        }
        if !dropped {
            break;
        }
    }
    Ok(())
}

/// Moves single points while that lowers the largest error, from the gap at `j` outwards; true once the
/// bound holds (with its values in `search`).
fn relocate<const D: usize>(
    search: &mut Search<'_, D>,
    kept: &mut [usize],
    order: &mut Vec<usize>,
    mut error_m: f64,
    gap: usize,
    bound: f64,
) -> bool {
    if error_m <= bound {
        return search.fit(kept, bound, bound) <= bound;
    }
    order.clear();
    order.extend(1..kept.len() - 1);
    order.sort_unstable_by_key(|&j| ((2 * j + 1).abs_diff(2 * gap), j));
    let mut moved = true;
    while moved && search.effort < REFINING_EFFORT {
        moved = false;
        for &j in order.iter() {
            if search.effort >= REFINING_EFFORT {
                return false;
            }
            for step in [-4, -2, -1, 1, 2, 4] {
                let before = kept[j];
                let Some(after) = before.checked_add_signed(step) else {
                    continue;
                };
                if after <= kept[j - 1] || after >= kept[j + 1] {
                    continue;
                }
                if !search.apart(kept[j - 1], after) || !search.apart(after, kept[j + 1]) {
                    continue;
                }
                kept[j] = after;
                let lower_m = search.fit(kept, bound, error_m);
                if lower_m < error_m {
                    error_m = lower_m;
                    moved = true;
                    if error_m <= bound {
                        return true;
                    }
                } else {
                    kept[j] = before;
                }
            }
        }
    }
    false
}

#[cfg(test)]
mod tests;
