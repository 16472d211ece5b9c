//! Fewest checkpoints, and bytes, within a given error.

use nalgebra::SVector;

use super::super::{CheckpointError, Grid, Plan, check_series};
use super::cheapen::cheapen;
use super::search::{Motion, Search};

/// How long to look.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effort {
    /// Checkpoints on the curve, inserted until the bound holds: some passes over the samples.
    Quick,
    /// Then fewer equal shares of the curvature, off the curve, and those left out that are not needed: less than a
    /// millisecond for 300 samples.
    Brisk,
    /// Then fewer, moved, off the curve where that helps, on coarser grids, at values that are cheap to write: tenths of
    /// a second.
    Thorough,
}

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
/// As [`bounded_with`] [`Effort::Thorough`].
///
/// # Errors
/// As [`bounded_with`].
pub fn bounded<const D: usize>(
    t: &[f64],
    y: &[SVector<f64, D>],
    bound_m: f64,
) -> Result<Plan<D>, CheckpointError> {
    bounded_with(t, y, bound_m, Effort::Thorough)
}

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
pub fn bounded_with<const D: usize>(
    t: &[f64],
    y: &[SVector<f64, D>],
    bound_m: f64,
    effort: Effort,
) -> Result<Plan<D>, CheckpointError> {
    let fine = Grid::for_bound(bound_m)?;
    check_series(t, y)?;
    let motion = Motion::new(t, y);
    if effort == Effort::Quick {
        return first_that_holds(fine, |grid| quick(&motion, grid, bound_m));
    }
    if effort == Effort::Brisk {
        let grid = fine.coarser(BRISK_STEP).with_ticks_of(t);
        return first_that_holds(grid, |grid| brisk(&motion, grid, bound_m))
            .or_else(|_| first_that_holds(fine, |grid| quick(&motion, grid, bound_m)));
    }
    let mut best: Option<(usize, Plan<D>)> = None;
    let mut refusal = None;
    for coarser in COARSER {
        let grid = fine.coarser(coarser).with_ticks_of(t);
        match first_that_holds(grid, |grid| thorough(&motion, grid, bound_m)) {
            Ok(plan) => {
                let bytes = plan.byte_len();
                if best.as_ref().is_none_or(|b| bytes < b.0) {
                    best = Some((bytes, plan));
                }
            }
            Err(e) => refusal = refusal.or(Some(e)),
        }
    }
    match (best, refusal) {
        (Some((_, plan)), _) => Ok(plan),
        (None, Some(e)) => Err(e),
        (None, None) => unreachable!("there is a grid to try"),
    }
}

/// On a grid, or with finer ticks where the samples' times do not suit it.
fn first_that_holds<const D: usize>(
    grid: Grid,
    mut attempt: impl FnMut(Grid) -> Result<Plan<D>, CheckpointError>,
) -> Result<Plan<D>, CheckpointError> {
    match attempt(grid) {
        Err(CheckpointError::Unreachable { .. } | CheckpointError::Unordered { .. }) => {
            attempt(grid.with_fine_ticks())
        }
        other => other,
    }
}

fn quick<const D: usize>(
    motion: &Motion<'_, D>,
    grid: Grid,
    bound_m: f64,
) -> Result<Plan<D>, CheckpointError> {
    let mut search = Search::new(motion, grid);
    let start = search.shares(2);
    let kept = search.insert(start, search_bound(bound_m))?;
    verified(search.plan(&kept)?, motion, bound_m)
}

fn brisk<const D: usize>(
    motion: &Motion<'_, D>,
    grid: Grid,
    bound_m: f64,
) -> Result<Plan<D>, CheckpointError> {
    let mut search = Search::new(motion, grid);
    let bound = search_bound(bound_m);
    let start = search.shares(2);
    let mut kept = search.insert(start, bound)?;
    let mut plan = search.plan(&kept)?;
    let (mut few, mut enough) = (kept.len() / 2, kept.len());
    while few < enough {
        let count = (few + enough) / 2;
        let shares = search.shares(count);
        if search.fit(&shares, bound, bound) <= bound {
            plan = search.plan(&shares)?;
            enough = count;
            kept = shares;
        } else {
            few = count + 1;
        }
    }
    search.effort = 0;
    leave_out(
        &mut search,
        &mut kept,
        bound,
        BRISK_EFFORT,
        |search, kept| {
            plan = search.plan(kept)?;
            Ok(())
        },
    )?;
    verified(plan, motion, bound_m)
}

fn thorough<const D: usize>(
    motion: &Motion<'_, D>,
    grid: Grid,
    bound_m: f64,
) -> Result<Plan<D>, CheckpointError> {
    let mut search = Search::new(motion, grid);
    let bound = search_bound(bound_m);
    let start = search.shares(2);
    let mut kept = search.insert(start, bound)?;
    let start = search.shares(kept.len() / 2);
    if let Ok(other) = search.insert(start, bound)
        && other.len() < kept.len()
    {
        kept = other;
    }
    search.on_curve(&kept);
    let mut plan = search.plan(&kept)?;
    refine(&mut search, &mut kept, bound, |search, kept| {
        plan = search.plan(kept)?;
        Ok(())
    })?;
    let cheaper = cheapen(&plan, motion, bound)?;
    verified(cheaper, motion, bound_m).or_else(|_| verified(plan, motion, bound_m))
}

/// The search computes in another order than the decoder: it aims this much inside the bound.
fn search_bound(bound_m: f64) -> f64 {
    bound_m * (1.0 - 1e-7)
}

/// Drops as many points as go without moving any.
fn leave_out<const D: usize>(
    search: &mut Search<'_, D>,
    kept: &mut Vec<usize>,
    bound: f64,
    effort: usize,
    mut accept: impl FnMut(&Search<'_, D>, &[usize]) -> Result<(), CheckpointError>,
) -> Result<(), CheckpointError> {
    let mut j = 1;
    while j + 1 < kept.len() && search.effort < effort {
        let dropped = kept.remove(j);
        if search.fit(kept, bound, bound) <= bound {
            accept(search, kept)?;
        } else {
            kept.insert(j, dropped);
            j += 1;
        }
    }
    Ok(())
}

/// Drops points while some least-squares values, or others' places, keep the bound.
fn refine<const D: usize>(
    search: &mut Search<'_, D>,
    kept: &mut Vec<usize>,
    bound: f64,
    mut accept: impl FnMut(&Search<'_, D>, &[usize]) -> Result<(), CheckpointError>,
) -> Result<(), CheckpointError> {
    leave_out(search, kept, bound, REFINING_EFFORT, &mut accept)?;
    // Then the one whose loss costs least, the others moved to make up for it.
    let (mut costs, mut order): (Vec<(f64, usize)>, Vec<usize>) = (Vec::new(), Vec::new());
    let mut before = Vec::new();
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
        costs.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut dropped = false;
        for &(error_m, j) in costs.iter().take(6) {
            if !error_m.is_finite() {
                break;
            }
            before.clone_from(kept);
            kept.remove(j);
            if relocate(search, kept, &mut order, error_m, j, bound) {
                accept(search, kept)?;
                dropped = true;
                break;
            }
            kept.clone_from(&before);
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
    order.sort_by_key(|&j| (2 * j + 1).abs_diff(2 * gap));
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

/// `plan`, if what it decodes to passes every sample within the bound.
fn verified<const D: usize>(
    plan: Plan<D>,
    motion: &Motion<'_, D>,
    bound_m: f64,
) -> Result<Plan<D>, CheckpointError> {
    let spline = plan.spline()?;
    let (start_s, end_s) = spline.span_s();
    for (index, (&t, y)) in motion.t.iter().zip(motion.y).enumerate() {
        // A sample on the end's tick may lie a rounding error outside.
        let error_m = (spline.eval(t.clamp(start_s, end_s))?.x - y).norm();
        if error_m > bound_m {
            return Err(CheckpointError::Unreachable { index, error_m });
        }
    }
    Ok(plan)
}

#[cfg(test)]
mod tests;
