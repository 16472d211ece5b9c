//! One search for checkpoints on one grid: where they stand, and what they hold.

use nalgebra::SVector;

use super::super::{Checkpoint, CheckpointError, Grid, MAX_POINTS, Plan};
use super::fit::{Curve, LeastSquares};

/// Rounds of reweighting (Lawson 1961) before a least-squares curve counts as beyond the bound.
const ROUNDS: usize = 10;

/// Samples of a motion, and the slope at each.
pub(super) struct Motion<'a, const D: usize> {
    pub(super) t: &'a [f64],
    pub(super) y: &'a [SVector<f64, D>],
    slopes: Vec<SVector<f64, D>>,
    /// ∫√|x''| dt up to each sample.
    bends: Vec<f64>,
}

impl<'a, const D: usize> Motion<'a, D> {
    /// Of a checked series.
    pub(super) fn new(t: &'a [f64], y: &'a [SVector<f64, D>]) -> Self {
        let slopes = slopes(t, y);
        let mut bends = vec![0.0; t.len()];
        for i in 1..t.len() {
            let step_s = t[i] - t[i - 1];
            let bend = (slopes[i] - slopes[i - 1]).norm() / step_s;
            bends[i] = bends[i - 1] + bend.sqrt() * step_s;
        }
        Self {
            t,
            y,
            slopes,
            bends,
        }
    }
}

/// The search's state: buffers that every trial reuses.
pub(super) struct Search<'a, const D: usize> {
    motion: &'a Motion<'a, D>,
    grid: Grid,
    /// The times of the samples as checkpoints, in ticks.
    ticks: Vec<f64>,
    curve: Curve<D>,
    squares: LeastSquares<D>,
    knots: Vec<f64>,
    weights: Vec<f64>,
    errors: Vec<f64>,
    /// The values of the best fit of the last trial.
    values: Vec<SVector<f64, D>>,
    /// Those of the best round so far.
    best: Vec<SVector<f64, D>>,
    /// Sample evaluations so far.
    pub(super) effort: usize,
}

impl<'a, const D: usize> Search<'a, D> {
    pub(super) fn new(motion: &'a Motion<'a, D>, grid: Grid) -> Self {
        let last = motion.t.len() - 1;
        let tick_s = grid.tick_s();
        // The ends go outwards, so that the decoded curve covers every sample.
        let tick = |(i, t): (usize, &f64)| {
            let ticks = t / tick_s;
            if (ticks - ticks.round()).abs() < 1e-6 {
                ticks.round()
            } else if i == 0 {
                ticks.floor()
            } else if i == last {
                ticks.ceil()
            } else {
                ticks.round()
            }
        };
        Self {
            motion,
            grid,
            ticks: motion.t.iter().enumerate().map(tick).collect(),
            curve: Curve::default(),
            squares: LeastSquares::default(),
            knots: Vec::new(),
            weights: Vec::new(),
            errors: Vec::new(),
            values: Vec::new(),
            best: Vec::new(),
            effort: 0,
        }
    }

    /// Both ends, and equal shares of ∫√|x''| dt between them, `count` points where they fit.
    pub(super) fn shares(&self, count: usize) -> Vec<usize> {
        let bends = &self.motion.bends;
        let last = bends.len() - 1;
        let spans = count.max(2) - 1;
        let mut kept = vec![0];
        for s in 1..spans {
            let goal = bends[last] * s as f64 / spans as f64;
            let i = bends.partition_point(|&v| v < goal).min(last);
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

    /// Inserts the worst sample of every span beyond the bound until there is none, checkpoints on the curve.
    pub(super) fn insert(
        &mut self,
        mut kept: Vec<usize>,
        bound: f64,
    ) -> Result<Vec<usize>, CheckpointError> {
        loop {
            let error_m = self.on_curve(&kept);
            if error_m <= bound {
                return Ok(kept);
            }
            if kept.len() >= MAX_POINTS {
                return Err(CheckpointError::TooMany);
            }
            let mut more = Vec::with_capacity(kept.len() + 8);
            for span in kept.windows(2) {
                more.push(span[0]);
                let worst = (span[0] + 1..span[1])
                    .filter(|&i| self.errors[i] > bound)
                    .filter(|&i| self.apart(span[0], i) && self.apart(i, span[1]))
                    .max_by(|&a, &b| self.errors[a].total_cmp(&self.errors[b]));
                // One a span, and not where a neighbour's removal of error is about to help.
                if let Some(i) = worst.filter(|&i| self.errors[i] > 0.25 * error_m) {
                    more.push(i);
                }
            }
            more.push(kept[kept.len() - 1]);
            if more.len() == kept.len() {
                let index = (0..self.errors.len())
                    .max_by(|&a, &b| self.errors[a].total_cmp(&self.errors[b]))
                    .unwrap_or(0);
                return Err(CheckpointError::Unreachable { index, error_m });
            }
            more.truncate(MAX_POINTS);
            kept = more;
        }
    }

    /// The largest error with the checkpoints on the samples; fills `errors` and `values`.
    pub(super) fn on_curve(&mut self, kept: &[usize]) -> f64 {
        self.place(kept);
        self.values.clear();
        for &i in kept {
            let t_s = self.ticks[i] * self.grid.tick_s();
            let x = self.motion.y[i] + self.motion.slopes[i] * (t_s - self.motion.t[i]);
            self.values.push(x);
        }
        self.decode(f64::INFINITY)
    }

    /// The largest error of the best least-squares checkpoints found, first by squares, then reweighted
    /// towards the largest errors until it is at most `goal`; infinity where that is certain to stay
    /// beyond `limit`. `values` holds the best.
    pub(super) fn fit(&mut self, kept: &[usize], goal: f64, limit: f64) -> f64 {
        self.place(kept);
        self.squares.prepare(&self.knots, self.motion.t);
        let n = self.motion.t.len();
        self.weights.clear();
        self.weights.resize(n, 1.0);
        let mut least = f64::INFINITY;
        self.best.clear();
        for round in 0..ROUNDS {
            self.effort += 2 * n;
            if !self.squares.solve(self.motion.y, &self.weights) {
                break;
            }
            let (mut sum, mut all, mut largest) = (0.0, 0.0, 0.0f64);
            self.errors.clear();
            for ((x, y), w) in self
                .squares
                .at_samples()
                .zip(self.motion.y)
                .zip(&self.weights)
            {
                let e2 = (x - y).norm_squared();
                self.errors.push(e2.sqrt());
                sum += w * e2;
                all += w;
                largest = largest.max(e2);
            }
            // No curve with these knots has a smaller largest error than this one's weighted mean.
            if sum > limit * limit * all {
                break;
            }
            for (w, e) in self.weights.iter_mut().zip(&self.errors) {
                *w = (*w * (0.05 + e / largest.sqrt().max(f64::MIN_POSITIVE))).max(1e-9);
            }
            let mean = self.weights.iter().sum::<f64>() / n as f64;
            self.weights.iter_mut().for_each(|w| *w /= mean);
            // Far off: spare the decoding.
            if largest.sqrt() > 1.5 * limit && round + 1 < ROUNDS {
                continue;
            }
            self.values.clear();
            self.values.extend(self.squares.at_knots());
            let error_m = self.decode(least);
            if error_m < least {
                least = error_m;
                std::mem::swap(&mut self.best, &mut self.values);
            }
            if least <= goal {
                break;
            }
        }
        std::mem::swap(&mut self.best, &mut self.values);
        least
    }

    /// The sum of squares of the least-squares curve, not quantised.
    pub(super) fn squares(&mut self, kept: &[usize]) -> f64 {
        self.place(kept);
        self.squares.prepare(&self.knots, self.motion.t);
        let n = self.motion.t.len();
        self.effort += 2 * n;
        self.weights.clear();
        self.weights.resize(n, 1.0);
        if !self.squares.solve(self.motion.y, &self.weights) {
            return f64::INFINITY;
        }
        self.values.clear();
        self.values.extend(self.squares.at_knots());
        self.errors.clear();
        let y = self.motion.y.iter();
        let e2 = self
            .squares
            .at_samples()
            .zip(y)
            .map(|(x, y)| (x - y).norm_squared());
        self.errors.extend(e2);
        self.errors.iter().sum()
    }

    /// The errors of the last trial, one a sample.
    pub(super) fn errors(&self) -> &[f64] {
        &self.errors
    }

    /// The plan of the last trial's values.
    pub(super) fn plan(&self, kept: &[usize]) -> Result<Plan<D>, CheckpointError> {
        self.plan_on(kept, self.grid)
    }

    /// As [`Search::plan`], on a grid with the same ticks.
    pub(super) fn plan_on(&self, kept: &[usize], grid: Grid) -> Result<Plan<D>, CheckpointError> {
        let tick_s = self.grid.tick_s();
        let points: Vec<_> = kept
            .iter()
            .zip(&self.values)
            .map(|(&i, &x)| Checkpoint {
                t_s: self.ticks[i] * tick_s,
                x,
            })
            .collect();
        Plan::quantise(grid, &points)
    }

    fn place(&mut self, kept: &[usize]) {
        let tick_s = self.grid.tick_s();
        self.knots.clear();
        self.knots
            .extend(kept.iter().map(|&i| self.ticks[i] * tick_s));
    }

    /// The largest distance of a sample from the curve through the quantised values; infinity once it is
    /// `limit` or more.
    fn decode(&mut self, limit: f64) -> f64 {
        let step_m = self.grid.step_m();
        let quantised = self
            .values
            .iter()
            .map(|x| (x / step_m).map(f64::round) * step_m);
        self.curve.x.clear();
        self.curve.x.extend(quantised);
        self.curve.t.clone_from(&self.knots);
        self.curve.solve();
        self.errors.clear();
        let mut worst = 0.0f64;
        self.effort += self.motion.t.len();
        self.curve.visit(self.motion.t, |i, x| {
            let e = (x - self.motion.y[i]).norm();
            self.errors.push(e);
            worst = worst.max(e);
            worst < limit
        });
        if worst < limit { worst } else { f64::INFINITY }
    }

    pub(super) fn may_insert(&self, kept: &[usize], i: usize) -> bool {
        let at = kept.partition_point(|&k| k < i);
        kept.get(at).is_none_or(|&k| k != i && self.apart(i, k))
            && (at == 0 || self.apart(kept[at - 1], i))
    }

    pub(super) fn apart(&self, i: usize, j: usize) -> bool {
        self.ticks[j] - self.ticks[i] > 0.5
    }

    /// Samples of the motion.
    pub(super) fn samples(&self) -> usize {
        self.motion.t.len()
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
