//! Fewest checkpoints within a given error.

use nalgebra::SVector;

use super::super::{Checkpoint, CheckpointError, Grid, MAX_POINTS, Plan, check_series};

/// Sample evaluations spent on making a sufficient choice smaller: a few tenths of a second.
const REFINING_EFFORT: usize = 1 << 22;

/// The choice starts with a curve within this many bounds of the samples. Which start ends with fewer
/// points depends on the motion, so both are tried.
const STARTS: [f64; 2] = [1.0, 8.0];

/// Checkpoints of the motion `y` (m) at times `t` (s from its start, not negative, increasing) whose
/// decoded curve passes within `bound_m` of *every* sample.
///
/// Starts from equal shares of √|Laplacian| (the curvature), inserts the worst sample until the bound
/// holds on the decoded, quantised curve, then drops points, and moves the others, as long as it
/// holds. How it chooses is free; what [`Plan`] decodes to is not.
///
/// # Errors
/// [`CheckpointError`]: an unusable bound or series, more than [`MAX_POINTS`] needed, samples less
/// than a microsecond apart that differ by more than the bound.
pub fn bounded<const D: usize>(
    t: &[f64],
    y: &[SVector<f64, D>],
    bound_m: f64,
) -> Result<Plan<D>, CheckpointError> {
    let coarse = Grid::for_bound(bound_m)?;
    check_series(t, y)?;
    let slopes = slopes(t, y);
    let attempt = |grid, near| {
        let mut chooser = Chooser {
            t,
            y,
            slopes: &slopes,
            bound_m,
            grid,
            effort: 0,
        };
        chooser.choose(near)
    };
    let fewest = |grid| {
        let [sure, bold] = STARTS.map(|near| attempt(grid, near));
        match (sure, bold) {
            (Ok(sure), Ok(bold)) if bold.len() < sure.len() => Ok(bold),
            (Ok(plan), _) | (Err(_), Ok(plan)) => Ok(plan),
            (Err(e), Err(_)) => Err(e),
        }
    };
    match fewest(coarse) {
        // Sample times off the millisecond grid, and a bound tighter than that rounding.
        Err(CheckpointError::Unreachable { .. } | CheckpointError::Unordered { .. }) => {
            fewest(coarse.with_fine_ticks())
        }
        other => other,
    }
}

struct Chooser<'a, const D: usize> {
    t: &'a [f64],
    y: &'a [SVector<f64, D>],
    slopes: &'a [SVector<f64, D>],
    bound_m: f64,
    grid: Grid,
    effort: usize,
}

impl<const D: usize> Chooser<'_, D> {
    fn choose(&mut self, near: f64) -> Result<Plan<D>, CheckpointError> {
        let mut kept = self.start(near);
        loop {
            let errors = self.errors(&kept)?;
            let (worst, &error_m) = errors
                .iter()
                .enumerate()
                .max_by(|a, b| a.1.total_cmp(b.1))
                .expect("a series has samples");
            if error_m <= self.bound_m {
                break;
            }
            if kept.len() == MAX_POINTS {
                return Err(CheckpointError::TooMany);
            }
            let candidate = (1..self.t.len() - 1)
                .filter(|&i| errors[i] > self.bound_m && self.may_insert(&kept, i))
                .max_by(|&a, &b| errors[a].total_cmp(&errors[b]));
            let Some(i) = candidate else {
                return Err(CheckpointError::Unreachable {
                    index: worst,
                    error_m,
                });
            };
            kept.insert(kept.partition_point(|&k| k < i), i);
        }
        self.refine(&mut kept);
        self.plan(&kept)
    }

    /// Both ends, and equal shares of ∫√|x''| dt between them: half as many again until the curve
    /// is within `near` bounds. Greedy insertion goes on from there.
    fn start(&mut self, near: f64) -> Vec<usize> {
        let n = self.t.len();
        let mut share = vec![0.0; n];
        for i in 1..n {
            let step_s = self.t[i] - self.t[i - 1];
            let bend = (self.slopes[i] - self.slopes[i - 1]).norm() / step_s;
            share[i] = share[i - 1] + bend.sqrt() * step_s;
        }
        let mut spans = 1;
        loop {
            let kept = self.equal_shares(&share, spans);
            let close = self.worst(&kept, near * self.bound_m).is_some();
            if close || 2 * spans >= (MAX_POINTS / 2).min(n - 1) {
                return kept;
            }
            spans += spans.div_ceil(2);
        }
    }

    fn equal_shares(&self, share: &[f64], spans: usize) -> Vec<usize> {
        let last = share.len() - 1;
        let mut kept = vec![0];
        for s in 1..spans {
            let goal = share[last] * s as f64 / spans as f64;
            let i = share.partition_point(|&v| v < goal).min(last);
            if i < last && self.may_insert(&kept, i) {
                kept.push(i);
            }
        }
        if kept.len() > 1 && !self.apart(kept[kept.len() - 1], last) {
            kept.pop();
        }
        kept.push(last);
        kept
    }

    fn refine(&mut self, kept: &mut Vec<usize>) {
        // Looking for the best point to drop costs a pass for each point dropped; where that is too
        // much, drop what can be dropped in one pass.
        if kept.len() * kept.len() * self.t.len() > REFINING_EFFORT {
            self.thin(kept);
        }
        while self.effort < REFINING_EFFORT && kept.len() > 2 {
            let mut best: Option<(f64, usize)> = None;
            for j in 1..kept.len() - 1 {
                let mut without = kept.clone();
                without.remove(j);
                let limit = best.map_or(f64::INFINITY, |b| b.0);
                if let Some(error_m) = self.worst(&without, limit) {
                    best = Some((error_m, j));
                }
            }
            let Some((error_m, j)) = best else { break };
            let mut without = kept.clone();
            without.remove(j);
            if error_m > self.bound_m && !self.relocate(&mut without, error_m) {
                break;
            }
            *kept = without;
        }
    }

    fn thin(&mut self, kept: &mut Vec<usize>) {
        let mut j = 1;
        while j + 1 < kept.len() && self.effort < REFINING_EFFORT {
            let dropped = kept.remove(j);
            // `worst` is below its limit; the bound itself is allowed.
            if self.worst(kept, self.bound_m.next_up()).is_none() {
                kept.insert(j, dropped);
                j += 1;
            }
        }
    }

    /// Moves single points while that lowers the largest error; true once the bound holds.
    fn relocate(&mut self, kept: &mut [usize], mut error_m: f64) -> bool {
        let mut moved = true;
        while moved && self.effort < REFINING_EFFORT {
            moved = false;
            for j in 1..kept.len() - 1 {
                for step in [-4, -2, -1, 1, 2, 4] {
                    let before = kept[j];
                    let Some(after) = before.checked_add_signed(step) else {
                        continue;
                    };
                    if after <= kept[j - 1] || after >= kept[j + 1] {
                        continue;
                    }
                    kept[j] = after;
                    match self.worst(kept, error_m) {
                        Some(lower_m) => {
                            error_m = lower_m;
                            moved = true;
                            if error_m <= self.bound_m {
                                return true;
                            }
                        }
                        None => kept[j] = before,
                    }
                }
            }
        }
        false
    }

    fn may_insert(&self, kept: &[usize], i: usize) -> bool {
        let at = kept.partition_point(|&k| k < i);
        kept.get(at).is_none_or(|&k| k != i && self.apart(i, k))
            && (at == 0 || self.apart(kept[at - 1], i))
    }

    fn apart(&self, i: usize, j: usize) -> bool {
        let tick_s = self.grid.tick_s();
        (self.point(j).t_s - self.point(i).t_s) / tick_s > 0.5
    }

    /// Sample `i` moved along its slope to the grid's nearest tick (outwards at the ends, so that the
    /// decoded curve covers every sample).
    fn point(&self, i: usize) -> Checkpoint<D> {
        let tick_s = self.grid.tick_s();
        let ticks = self.t[i] / tick_s;
        let whole = if (ticks - ticks.round()).abs() < 1e-6 {
            ticks.round()
        } else if i == 0 {
            ticks.floor()
        } else if i == self.t.len() - 1 {
            ticks.ceil()
        } else {
            ticks.round()
        };
        let t_s = whole * tick_s;
        Checkpoint {
            t_s,
            x: self.y[i] + self.slopes[i] * (t_s - self.t[i]),
        }
    }

    fn plan(&self, kept: &[usize]) -> Result<Plan<D>, CheckpointError> {
        let points: Vec<_> = kept.iter().map(|&i| self.point(i)).collect();
        Plan::quantise(self.grid, &points)
    }

    /// The distance of every sample from the decoded curve, m.
    fn errors(&mut self, kept: &[usize]) -> Result<Vec<f64>, CheckpointError> {
        let mut errors = Vec::with_capacity(self.t.len());
        self.visit(kept, |e| {
            errors.push(e);
            true
        })?;
        Ok(errors)
    }

    /// The largest distance, m, if it is below `limit_m`.
    fn worst(&mut self, kept: &[usize], limit_m: f64) -> Option<f64> {
        let mut worst = 0.0;
        self.visit(kept, |e: f64| {
            worst = e.max(worst);
            worst < limit_m
        })
        .ok()?;
        (worst < limit_m).then_some(worst)
    }

    fn visit(
        &mut self,
        kept: &[usize],
        mut go_on: impl FnMut(f64) -> bool,
    ) -> Result<(), CheckpointError> {
        let spline = self.plan(kept)?.spline()?;
        self.effort += 2 * kept.len();
        let (start_s, end_s) = spline.span_s();
        for (&t, y) in self.t.iter().zip(self.y) {
            self.effort += 1;
            // A sample on the end's tick may lie a rounding error outside.
            let decoded = spline.eval(t.clamp(start_s, end_s))?;
            if !go_on((decoded.x - y).norm()) {
                break;
            }
        }
        Ok(())
    }
}

/// The slope at each sample of the parabola through it and its neighbours (of the line at the ends).
fn slopes<const D: usize>(t: &[f64], y: &[SVector<f64, D>]) -> Vec<SVector<f64, D>> {
    let secant = |i: usize| (y[i + 1] - y[i]) / (t[i + 1] - t[i]);
    let n = t.len();
    (0..n)
        .map(|i| match i {
            0 => secant(0),
            _ if i == n - 1 => secant(n - 2),
            _ => {
                let (before, after) = (t[i] - t[i - 1], t[i + 1] - t[i]);
                (secant(i - 1) * after + secant(i) * before) / (before + after)
            }
        })
        .collect()
}

#[cfg(test)]
mod tests;
