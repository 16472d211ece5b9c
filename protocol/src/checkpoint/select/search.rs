//! One search for checkpoints on one grid: where they stand, and what they hold.

use nalgebra::SVector;

use super::super::{Checkpoint, CheckpointError, Grid, MAX_POINTS, Plan};
use super::fit::{Curve, LeastSquares};

/// Rounds of reweighting (Lawson 1961) before a least-squares curve counts as beyond the bound.
const ROUNDS: usize = 10;

/// Samples of a motion, a checked series.
#[derive(Clone, Copy)]
pub(super) struct Motion<'a, const D: usize> {
    pub(super) t: &'a [f64],
    pub(super) y: &'a [SVector<f64, D>],
}

/// What searches reuse.
#[derive(Clone, Debug, Default)]
pub(super) struct Buffers<const D: usize> {
    /// The slope at each sample.
    slopes: Vec<SVector<f64, D>>,
    /// ∫√|x''| dt up to each sample.
    bends: Vec<f64>,
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
    /// Indices, while some are inserted.
    more: Vec<usize>,
}

impl<const D: usize> Buffers<D> {
    /// Before the first search of a motion.
    pub(super) fn begin(&mut self, motion: Motion<'_, D>) {
        let Motion { t, y } = motion;
        slopes(t, y, &mut self.slopes);
        self.bends.clear();
        self.bends.push(0.0);
        for i in 1..t.len() {
            let step_s = t[i] - t[i - 1];
            let bend = (self.slopes[i] - self.slopes[i - 1]).norm() / step_s;
            self.bends.push(self.bends[i - 1] + bend.sqrt() * step_s);
        }
        // These change places with others: whichever it is, it is large enough.
        let most = most_points(t.len());
        for swapped in [&mut self.values, &mut self.best] {
            swapped.clear();
            swapped.reserve(most);
        }
        self.more.clear();
        self.more.reserve(2 * most);
    }
}

/// More checkpoints than so many nobody keeps of a motion.
pub(super) fn most_points(samples: usize) -> usize {
    samples.min(MAX_POINTS)
}

/// One search.
pub(super) struct Search<'a, const D: usize> {
    motion: Motion<'a, D>,
    grid: Grid,
    buffers: &'a mut Buffers<D>,
    /// Sample evaluations so far.
    pub(super) effort: usize,
}

impl<'a, const D: usize> Search<'a, D> {
    /// On a grid, with buffers that have begun with this motion.
    pub(super) fn new(motion: Motion<'a, D>, grid: Grid, buffers: &'a mut Buffers<D>) -> Self {
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
        buffers.ticks.clear();
        buffers.ticks.extend(motion.t.iter().enumerate().map(tick));
        Self {
            motion,
            grid,
            buffers,
            effort: 0,
        }
    }

    /// Both ends, and equal shares of ∫√|x''| dt between them, `count` points where they fit.
    pub(super) fn shares(&self, count: usize, kept: &mut Vec<usize>) {
        let bends = &self.buffers.bends;
        let last = bends.len() - 1;
        let spans = count.max(2) - 1;
        kept.clear();
        kept.push(0);
        for s in 1..spans {
            let goal = bends[last] * s as f64 / spans as f64;
            let i = bends.partition_point(|&v| v < goal).min(last);
            if i < last && self.may_insert(kept, i) {
                kept.push(i);
            }
        }
        if kept.len() > 1 && !self.apart(kept[kept.len() - 1], last) {
            kept.pop();
        }
        kept.push(last);
    }

    /// Inserts the worst sample of every span beyond the bound until there is none, checkpoints on the curve.
    pub(super) fn insert(
        &mut self,
        kept: &mut Vec<usize>,
        bound: f64,
    ) -> Result<(), CheckpointError> {
        loop {
            let error_m = self.on_curve(kept);
            if error_m <= bound {
                return Ok(());
            }
            if kept.len() >= MAX_POINTS {
                return Err(CheckpointError::TooMany);
            }
            let mut more = std::mem::take(&mut self.buffers.more);
            more.clear();
            let errors = &self.buffers.errors;
            for span in kept.windows(2) {
                more.push(span[0]);
                let worst = (span[0] + 1..span[1])
                    .filter(|&i| errors[i] > bound)
                    .filter(|&i| self.apart(span[0], i) && self.apart(i, span[1]))
                    .max_by(|&a, &b| errors[a].total_cmp(&errors[b]));
                // One a span, and not where a neighbour's removal of error is about to help.
                if let Some(i) = worst.filter(|&i| errors[i] > 0.25 * error_m) {
                    more.push(i);
                }
            }
            more.push(kept[kept.len() - 1]);
            let stuck = more.len() == kept.len();
            more.truncate(MAX_POINTS);
            kept.clone_from(&more);
            self.buffers.more = more;
            if stuck {
                let errors = &self.buffers.errors;
                let index = (0..errors.len())
                    .max_by(|&a, &b| errors[a].total_cmp(&errors[b]))
                    .unwrap_or(0);
                return Err(CheckpointError::Unreachable { index, error_m });
            }
        }
    }

    /// The largest error with the checkpoints on the samples; fills `errors` and `values`.
    pub(super) fn on_curve(&mut self, kept: &[usize]) -> f64 {
        self.place(kept);
        self.buffers.values.clear();
        for &i in kept {
            let t_s = self.buffers.ticks[i] * self.grid.tick_s();
            let x = self.motion.y[i] + self.buffers.slopes[i] * (t_s - self.motion.t[i]);
            self.buffers.values.push(x);
        }
        self.decode(f64::INFINITY)
    }

    /// The largest error of the best least-squares checkpoints found, first by squares, then reweighted
    /// towards the largest errors until it is at most `goal`; infinity where that is certain to stay
    /// beyond `limit`. `values` holds the best.
    pub(super) fn fit(&mut self, kept: &[usize], goal: f64, limit: f64) -> f64 {
        self.place(kept);
        self.buffers
            .squares
            .prepare(&self.buffers.knots, self.motion.t);
        let n = self.motion.t.len();
        self.buffers.weights.clear();
        self.buffers.weights.resize(n, 1.0);
        let mut least = f64::INFINITY;
        self.buffers.best.clear();
        for round in 0..ROUNDS {
            self.effort += 2 * n;
            if !self
                .buffers
                .squares
                .solve(self.motion.y, &self.buffers.weights)
            {
                break;
            }
            let (mut sum, mut all, mut largest) = (0.0, 0.0, 0.0f64);
            self.buffers.errors.clear();
            for ((x, y), w) in self
                .buffers
                .squares
                .at_samples()
                .zip(self.motion.y)
                .zip(&self.buffers.weights)
            {
                let e2 = (x - y).norm_squared();
                self.buffers.errors.push(e2.sqrt());
                sum += w * e2;
                all += w;
                largest = largest.max(e2);
            }
            // No curve with these knots has a smaller largest error than this one's weighted mean.
            if sum > limit * limit * all {
                break;
            }
            for (w, e) in self.buffers.weights.iter_mut().zip(&self.buffers.errors) {
                *w = (*w * (0.05 + e / largest.sqrt().max(f64::MIN_POSITIVE))).max(1e-9);
            }
            let mean = self.buffers.weights.iter().sum::<f64>() / n as f64;
            self.buffers.weights.iter_mut().for_each(|w| *w /= mean);
            // Far off: spare the decoding.
            if largest.sqrt() > 1.5 * limit && round + 1 < ROUNDS {
                continue;
            }
            self.buffers.values.clear();
            self.buffers.values.extend(self.buffers.squares.at_knots());
            let error_m = self.decode(least);
            if error_m < least {
                least = error_m;
                std::mem::swap(&mut self.buffers.best, &mut self.buffers.values);
            }
            if least <= goal {
                break;
            }
        }
        std::mem::swap(&mut self.buffers.best, &mut self.buffers.values);
        least
    }

    /// The sum of squares of the least-squares curve, not quantised.
    pub(super) fn squares(&mut self, kept: &[usize]) -> f64 {
        self.place(kept);
        self.buffers
            .squares
            .prepare(&self.buffers.knots, self.motion.t);
        let n = self.motion.t.len();
        self.effort += 2 * n;
        self.buffers.weights.clear();
        self.buffers.weights.resize(n, 1.0);
        if !self
            .buffers
            .squares
            .solve(self.motion.y, &self.buffers.weights)
        {
            return f64::INFINITY;
        }
        self.buffers.values.clear();
        self.buffers.values.extend(self.buffers.squares.at_knots());
        self.buffers.errors.clear();
        let y = self.motion.y.iter();
        let e2 = self
            .buffers
            .squares
            .at_samples()
            .zip(y)
            .map(|(x, y)| (x - y).norm_squared());
        self.buffers.errors.extend(e2);
        self.buffers.errors.iter().sum()
    }

    /// The errors of the last trial, one a sample.
    pub(super) fn errors(&self) -> &[f64] {
        &self.buffers.errors
    }

    /// `plan` becomes that of the last trial's values.
    pub(super) fn plan(&self, kept: &[usize], plan: &mut Plan<D>) -> Result<(), CheckpointError> {
        self.plan_on(kept, self.grid, plan)
    }

    /// As [`Search::plan`], on a grid with the same ticks.
    pub(super) fn plan_on(
        &self,
        kept: &[usize],
        grid: Grid,
        plan: &mut Plan<D>,
    ) -> Result<(), CheckpointError> {
        let tick_s = self.grid.tick_s();
        let values = kept.iter().zip(&self.buffers.values);
        let points = values.map(|(&i, &x)| Checkpoint {
            t_s: self.buffers.ticks[i] * tick_s,
            x,
        });
        plan.requantise(grid, points)
    }

    fn place(&mut self, kept: &[usize]) {
        let tick_s = self.grid.tick_s();
        self.buffers.knots.clear();
        self.buffers
            .knots
            .extend(kept.iter().map(|&i| self.buffers.ticks[i] * tick_s));
    }

    /// The largest distance of a sample from the curve through the quantised values; infinity once it is
    /// `limit` or more.
    fn decode(&mut self, limit: f64) -> f64 {
        let step_m = self.grid.step_m();
        let quantised = self
            .buffers
            .values
            .iter()
            .map(|x| (x / step_m).map(f64::round) * step_m);
        self.buffers.curve.x.clear();
        self.buffers.curve.x.extend(quantised);
        self.buffers.curve.t.clone_from(&self.buffers.knots);
        self.buffers.curve.solve();
        self.buffers.errors.clear();
        let mut worst = 0.0f64;
        self.effort += self.motion.t.len();
        self.buffers.curve.visit(self.motion.t, |i, x| {
            let e = (x - self.motion.y[i]).norm();
            self.buffers.errors.push(e);
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
        self.buffers.ticks[j] - self.buffers.ticks[i] > 0.5
    }

    /// Samples of the motion.
    pub(super) fn samples(&self) -> usize {
        self.motion.t.len()
    }
}

/// The slope at each sample of the parabola through it and its neighbours (of the line at the ends).
fn slopes<const D: usize>(t: &[f64], y: &[SVector<f64, D>], slopes: &mut Vec<SVector<f64, D>>) {
    let secant = |i: usize| (y[i + 1] - y[i]) / (t[i + 1] - t[i]);
    let n = t.len();
    slopes.clear();
    slopes.extend((0..n).map(|i| match i {
        0 => secant(0),
        _ if i == n - 1 => secant(n - 2),
        _ => {
            let (before, after) = (t[i] - t[i - 1], t[i + 1] - t[i]);
            (secant(i - 1) * after + secant(i) * before) / (before + after)
        }
    }));
}
