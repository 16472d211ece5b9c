//! From responsibilities to regressions.

use std::borrow::Cow;

use nalgebra::{SMatrix, SVector};
use telemime_protocol::predict::{BLOCK, FEATURES, MAX_KNOTS, Regression, TARGETS};

use super::{Row, Scaling};
use crate::learn::LearnError;
use crate::learn::em::{EmOptions, add_outer, mirror};

/// The blocks of one component's scatter that the regression needs.
#[derive(Clone)]
pub(super) struct Blocks {
    pub(super) n: f64,
    feature_mean: SVector<f64, FEATURES>,
    pub(super) target_mean: [f64; TARGETS],
    ff: SMatrix<f64, FEATURES, FEATURES>,
    fy: [[f64; TARGETS]; FEATURES],
    pub(super) yy: [[f64; BLOCK]; MAX_KNOTS],
}

impl Blocks {
    fn zeros() -> Self {
        Self {
            n: 0.0,
            feature_mean: SVector::zeros(),
            target_mean: [0.0; TARGETS],
            ff: SMatrix::zeros(),
            fy: [[0.0; TARGETS]; FEATURES],
            yy: [[0.0; BLOCK]; MAX_KNOTS],
        }
    }

    pub(super) fn of<'a>(rows: &[Row], shares: impl Iterator<Item = &'a f64> + Clone) -> Self {
        let mut b = Self::zeros();
        for (row, &r) in rows.iter().zip(shares.clone()) {
            b.n += r;
            b.feature_mean += row.features * r;
            for (m, y) in b.target_mean.iter_mut().zip(&row.targets) {
                *m += r * y;
            }
        }
        let n = b.n.max(f64::MIN_POSITIVE);
        b.feature_mean /= n;
        b.target_mean.iter_mut().for_each(|m| *m /= n);
        for (row, &r) in rows.iter().zip(shares) {
            let f = row.features - b.feature_mean;
            let mut y = row.targets;
            y.iter_mut().zip(&b.target_mean).for_each(|(y, m)| *y -= m);
            add_outer(&mut b.ff, &f, r);
            for (fy, f) in b.fy.iter_mut().zip(f.iter()) {
                let s = r * f;
                fy.iter_mut().zip(&y).for_each(|(v, y)| *v += s * y);
            }
            for (yy, y) in b.yy.iter_mut().zip(y.chunks_exact(3)) {
                yy.iter_mut()
                    .zip(outer(y, y))
                    .for_each(|(v, o)| *v += r * o);
            }
        }
        mirror(&mut b.ff);
        b
    }

    /// The scatter of both together (the parallel-axis rule).
    pub(super) fn join(&mut self, other: &Self) {
        if other.n <= 0.0 {
            return;
        }
        let n = self.n + other.n;
        let between = self.n * other.n / n;
        let f = other.feature_mean - self.feature_mean;
        let mut y = other.target_mean;
        y.iter_mut()
            .zip(&self.target_mean)
            .for_each(|(y, m)| *y -= m);
        self.combine(1.0, other, 1.0);
        self.ff += f * f.transpose() * between;
        for (fy, f) in self.fy.iter_mut().zip(f.iter()) {
            fy.iter_mut()
                .zip(&y)
                .for_each(|(v, y)| *v += between * f * y);
        }
        for (yy, y) in self.yy.iter_mut().zip(y.chunks_exact(3)) {
            yy.iter_mut()
                .zip(outer(y, y))
                .for_each(|(v, o)| *v += between * o);
        }
        let share = other.n / n;
        self.feature_mean += f * share;
        self.target_mean
            .iter_mut()
            .zip(&y)
            .for_each(|(m, y)| *m += share * y);
        self.n = n;
    }

    /// self·a + other·c, moments only.
    fn combine(&mut self, a: f64, other: &Self, c: f64) {
        self.ff = self.ff * a + other.ff * c;
        let mix = |to: &mut [f64], from: &[f64]| {
            to.iter_mut()
                .zip(from)
                .for_each(|(t, f)| *t = *t * a + f * c);
        };
        mix(self.fy.as_flattened_mut(), other.fy.as_flattened());
        mix(self.yy.as_flattened_mut(), other.yy.as_flattened());
    }
}

/// The last M step, over all knots, and the regressions of it: component `k` sees the rows that `seen(k)` gives.
pub(super) fn regressions<'a>(
    seen: impl Fn(usize) -> Cow<'a, [Row]>,
    shares: &[f64],
    stride: usize,
    scaling: &Scaling,
    options: &EmOptions,
) -> Result<Vec<Regression>, LearnError> {
    let blocks = (0..stride)
        .map(|k| Blocks::of(&seen(k), shares.iter().skip(k).step_by(stride)))
        .collect();
    of_blocks(blocks, scaling, options)
}

/// The regressions of scatters.
///
/// `C_k = (S_k + ν·T)/(N_k + ν)`; `B = (C_ff + ridge·I)⁻¹ C_fy`;
/// `V = C_yy − BᵀC_fy − C_yf B + BᵀC_ff B` with the covariances before the ridge.
pub(super) fn of_blocks(
    mut blocks: Vec<Blocks>,
    scaling: &Scaling,
    options: &EmOptions,
) -> Result<Vec<Regression>, LearnError> {
    let total: f64 = blocks.iter().map(|b| b.n).sum();
    let mut tied = Blocks::zeros();
    for b in &blocks {
        tied.combine(1.0, b, 1.0 / total);
    }
    let weights: f64 = blocks.iter().map(|b| b.n + options.weight_prior).sum();
    blocks
        .iter_mut()
        .map(|b| {
            let n = b.n + options.shrinkage;
            b.combine(1.0 / n, &tied, options.shrinkage / n);
            let weight = (b.n + options.weight_prior) / weights;
            regression(b, weight, scaling, options.ridge)
        })
        .collect()
}

/// The scatters that [`of_blocks`] made these regressions of, with targets in metres (rad), from `rows` rows: all
/// that a trained predictor still knows of its data.
///
/// `C_ff = LLᵀ − ridge·I`, `C_fy = LLᵀB`, `C_yy = V + BᵀC_fy + C_yf B − BᵀC_ff B`; with
/// `M_k = (N_k + ν)·C_k` the pooled covariance is `T = Σ M_k/(N + Kν)`, and `S_k = M_k − ν·T`.
pub(super) fn recovered(regressions: &[Regression], rows: f64, options: &EmOptions) -> Vec<Blocks> {
    let k = regressions.len() as f64;
    let weights = rows + k * options.weight_prior;
    let mut blocks: Vec<Blocks> = regressions
        .iter()
        .map(|r| {
            let n = (r.weight * weights - options.weight_prior).max(0.0);
            let mut c = covariance(r, options.ridge);
            c.n = n;
            let zeros = Blocks::zeros();
            c.combine(n + options.shrinkage, &zeros, 0.0);
            c
        })
        .collect();
    let mut tied = Blocks::zeros();
    for b in &blocks {
        tied.combine(1.0, b, 1.0 / (rows + k * options.shrinkage));
    }
    for b in &mut blocks {
        b.combine(1.0, &tied, -options.shrinkage);
        // What the rounding of an encoded skill left of a scatter that was nothing.
        for yy in &mut b.yy {
            for d in [0, 3, 5] {
                yy[d] = yy[d].max(0.0);
            }
        }
    }
    blocks
}

fn covariance(r: &Regression, ridge: f64) -> Blocks {
    let mut c = Blocks::zeros();
    c.feature_mean = r.mean;
    c.target_mean = r.target;
    let ridged = r.factor * r.factor.transpose();
    c.ff = ridged - SMatrix::<f64, FEATURES, FEATURES>::identity() * ridge;
    let b = SMatrix::<f64, FEATURES, TARGETS>::from_fn(|i, j| r.gain[i][j]);
    let fy = ridged * b;
    let ff_b = c.ff * b;
    for (i, row) in c.fy.iter_mut().enumerate() {
        for (j, v) in row.iter_mut().enumerate() {
            *v = fy[(i, j)];
        }
    }
    for (knot, yy) in c.yy.iter_mut().enumerate() {
        let at = 3 * knot;
        let (b, fy) = (b.fixed_columns::<3>(at), fy.fixed_columns::<3>(at));
        let cross = b.transpose() * fy;
        let explained = b.transpose() * ff_b.fixed_columns::<3>(at) - cross - cross.transpose();
        for ((yy, v), (i, j)) in yy.iter_mut().zip(&r.residual[knot]).zip(UPPER) {
            *yy = v - 0.5 * (explained[(i, j)] + explained[(j, i)]);
        }
    }
    c
}

fn regression(
    c: &Blocks,
    weight: f64,
    scaling: &Scaling,
    ridge: f64,
) -> Result<Regression, LearnError> {
    let ridged = c.ff + SMatrix::<f64, FEATURES, FEATURES>::identity() * ridge;
    let cholesky = ridged.cholesky().ok_or(LearnError::Singular)?;
    let fy = SMatrix::<f64, FEATURES, TARGETS>::from_fn(|i, j| c.fy[i][j]);
    let b = cholesky.solve(&fy);
    let ff_b = c.ff * b;
    let mut out = Regression {
        weight,
        mean: c.feature_mean,
        factor: cholesky.l(),
        target: [0.0; TARGETS],
        gain: [[0.0; TARGETS]; FEATURES],
        residual: [[0.0; BLOCK]; MAX_KNOTS],
    };
    for j in 0..TARGETS {
        out.target[j] = c.target_mean[j] * scaling.target_scale[j] + scaling.target_mean[j];
        for i in 0..FEATURES {
            out.gain[i][j] = b[(i, j)] * scaling.target_scale[j];
        }
    }
    for (knot, v) in out.residual.iter_mut().enumerate() {
        let at = 3 * knot;
        let (b, fy) = (b.fixed_columns::<3>(at), fy.fixed_columns::<3>(at));
        let cross = b.transpose() * fy;
        let explained = b.transpose() * ff_b.fixed_columns::<3>(at) - cross - cross.transpose();
        let square = scaling.target_scale[at] * scaling.target_scale[at];
        for ((v, yy), (i, j)) in v.iter_mut().zip(&c.yy[knot]).zip(UPPER) {
            *v = (yy + 0.5 * (explained[(i, j)] + explained[(j, i)])) * square;
            // A variance below rounding is none.
            if i == j {
                *v = v.max(0.0);
            }
        }
    }
    Ok(out)
}

/// The entries of a symmetric block in the order they are stored.
const UPPER: [(usize, usize); BLOCK] = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)];

fn outer(a: &[f64], b: &[f64]) -> [f64; BLOCK] {
    UPPER.map(|(i, j)| a[i] * b[j])
}
