//! From responsibilities to regressions.

use std::borrow::Cow;

use nalgebra::{SMatrix, SVector};
use telemime_protocol::predict::{BLOCK, FEATURES, MAX_KNOTS, Regression, TARGETS};

use super::{Row, Scaling};
use crate::learn::LearnError;
use crate::learn::em::{EmOptions, add_outer, mirror};

/// The blocks of one component's scatter that the regression needs.
struct Blocks {
    n: f64,
    feature_mean: SVector<f64, FEATURES>,
    target_mean: [f64; TARGETS],
    ff: SMatrix<f64, FEATURES, FEATURES>,
    fy: [[f64; TARGETS]; FEATURES],
    yy: [[f64; BLOCK]; MAX_KNOTS],
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

    fn of<'a>(rows: &[Row], shares: impl Iterator<Item = &'a f64> + Clone) -> Self {
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
///
/// `C_k = (S_k + ν·T)/(N_k + ν)`; `B = (C_ff + ridge·I)⁻¹ C_fy`;
/// `V = C_yy − BᵀC_fy − C_yf B + BᵀC_ff B` with the covariances before the ridge.
pub(super) fn regressions<'a>(
    seen: impl Fn(usize) -> Cow<'a, [Row]>,
    shares: &[f64],
    stride: usize,
    scaling: &Scaling,
    options: &EmOptions,
) -> Result<Vec<Regression>, LearnError> {
    let mut blocks: Vec<Blocks> = (0..stride)
        .map(|k| Blocks::of(&seen(k), shares.iter().skip(k).step_by(stride)))
        .collect();
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
