//! Training the memory-feature predictor, and finding on held-out demonstrations how far to trust it.

use nalgebra::{SMatrix, SVector, Vector3};
use rand::SeedableRng;
use rand_xoshiro::Xoshiro256PlusPlus;
use telemime_protocol::predict::{
    BLOCK, Calibration, FEATURES, HandState, KNOT_SPACING_S, MAX_KNOTS, Model, Regression,
    Standardisation, TARGETS,
};
use telemime_protocol::time::Stamp;

use super::em::{self, Convergence, EmOptions, add_outer, mirror};
use super::kmeans::kmeans;
use super::trial::Trial;
use super::{LearnError, Progress};
use crate::demonstration::Demonstration;

/// Dimension of the joint that EM sees: the features and three displacements.
const JOINT: usize = FEATURES + 9;

/// The knots (from 1) EM sees: 100, 200 and 300 ms.
const EM_KNOTS: [usize; 3] = [3, 6, 9];

/// Rows nearer in time than this are thinned: a sensor of 200 Hz says nothing more about a hand.
const LEAST_SPACING_S: f64 = 1.0 / 60.0;

const LLOYD_STEPS: usize = 15;

/// How to train the predictor.
#[derive(Debug, Clone, PartialEq)]
pub struct PredictorOptions {
    /// Most components; fewer where there are less than four samples for each.
    pub components: usize,
    /// Knots J of 1/30 s.
    pub knots: usize,
    /// Pseudo-samples ν of the pooled covariance.
    pub shrinkage: f64,
    /// Variance added to each standardised coordinate.
    pub ridge: f64,
    /// Most EM iterations: to convergence would over-fit.
    pub max_iterations: usize,
    /// Most demonstrations that are held out in turn for the calibration.
    pub folds: usize,
}

impl Default for PredictorOptions {
    fn default() -> Self {
        Self {
            components: 14,
            knots: MAX_KNOTS,
            shrinkage: 8.0,
            ridge: 0.03,
            max_iterations: 15,
            folds: 6,
        }
    }
}

/// Features and displacements of one moment.
struct Row {
    features: SVector<f64, FEATURES>,
    targets: [f64; TARGETS],
}

/// Trains a predictor and calibrates it by leaving out one demonstration at a time.
///
/// With a single demonstration there is none to leave out, and the guesses of
/// [`Calibration::UNTRIED`] stay for what only that could show.
///
/// # Errors
/// [`LearnError`]: no demonstration, too few samples, or numbers that make no model.
pub fn train(
    demonstrations: &[Demonstration],
    options: &PredictorOptions,
    seed: u64,
    progress: &mut impl FnMut(Progress),
) -> Result<Model, LearnError> {
    let rows: Vec<Vec<Row>> = demonstrations
        .iter()
        .map(|d| rows(d, options.knots))
        .collect();
    let all: Vec<&Row> = rows.iter().flatten().collect();
    let model = fit(&all, None, options, seed)?;
    let mut trial = Trial::straight(demonstrations, options.knots);

    let folds = options.folds.min(demonstrations.len());
    if folds > 1 {
        for fold in 0..folds {
            let held = fold * demonstrations.len() / folds;
            let others: Vec<&Row> = rows
                .iter()
                .enumerate()
                .filter(|(i, _)| *i != held)
                .flat_map(|(_, r)| r)
                .collect();
            trial.hold_out(&fit(&others, None, options, seed)?, &demonstrations[held]);
            progress(Progress::Held {
                done: fold + 1,
                of: folds,
            });
        }
    }
    progress(Progress::Predictor {
        components: model.components().len(),
        samples: all.len(),
    });
    Ok(Model::new(
        model.knots(),
        model.standardisation().clone(),
        model.components().to_vec(),
        trial.calibration(),
    )?)
}

/// Trains without calibration from given hard labels, one a training row in order: for comparison
/// with another implementation.
///
/// # Errors
/// As [`train`].
pub fn train_from_labels(
    demonstrations: &[Demonstration],
    labels: &[usize],
    options: &PredictorOptions,
) -> Result<Model, LearnError> {
    let rows: Vec<Row> = demonstrations
        .iter()
        .flat_map(|d| rows(d, options.knots))
        .collect();
    let rows: Vec<&Row> = rows.iter().collect();
    if labels.len() != rows.len() {
        return Err(LearnError::TooFewRows {
            found: labels.len(),
            needed: rows.len(),
        });
    }
    fit(&rows, Some(labels), options, 0)
}

/// The states of a demonstration, sample by sample.
pub fn states(d: &Demonstration) -> impl Iterator<Item = HandState> + '_ {
    let mut state: Option<HandState> = None;
    d.samples().iter().map(move |s| {
        let t = Stamp::from_secs_f64(s.t_s);
        match &mut state {
            Some(state) => {
                state.advance(t, s.position);
                *state
            }
            None => *state.insert(HandState::first(t, s.position)),
        }
    })
}

/// The displacement (m) at knot `j`, from 1; past the end of the recording the hand stays.
pub(super) fn displacement(d: &Demonstration, i: usize, j: usize) -> Vector3<f64> {
    let s = &d.samples()[i];
    d.position_at(s.t_s + j as f64 * KNOT_SPACING_S) - s.position
}

fn rows(d: &Demonstration, knots: usize) -> Vec<Row> {
    let mut last_s = f64::NEG_INFINITY;
    let mut rows = Vec::with_capacity(d.samples().len());
    for (i, state) in states(d).enumerate() {
        let t_s = d.samples()[i].t_s;
        if t_s - last_s < LEAST_SPACING_S {
            continue;
        }
        last_s = t_s;
        let mut targets = [0.0; TARGETS];
        for (j, y) in targets.chunks_exact_mut(3).take(knots).enumerate() {
            y.copy_from_slice(displacement(d, i, j + 1).as_slice());
        }
        rows.push(Row {
            features: state.features(),
            targets,
        });
    }
    rows
}

/// Means, and one scale for each 3-vector.
struct Scaling {
    features: Standardisation,
    target_mean: [f64; TARGETS],
    target_scale: [f64; TARGETS],
}

impl Scaling {
    fn of(rows: &[&Row]) -> Self {
        let n = rows.len() as f64;
        let mut mean = SVector::<f64, FEATURES>::zeros();
        let mut target_mean = [0.0; TARGETS];
        for r in rows {
            mean += r.features / n;
            for (m, y) in target_mean.iter_mut().zip(&r.targets) {
                *m += y / n;
            }
        }
        let mut variance = SVector::<f64, FEATURES>::zeros();
        let mut target_variance = [0.0; TARGETS];
        for r in rows {
            let d = r.features - mean;
            variance += d.component_mul(&d) / n;
            for ((v, y), m) in target_variance.iter_mut().zip(&r.targets).zip(&target_mean) {
                *v += (y - m) * (y - m) / n;
            }
        }
        let mut scale = SVector::<f64, FEATURES>::zeros();
        isotropic(variance.as_slice(), scale.as_mut_slice());
        let mut target_scale = [0.0; TARGETS];
        isotropic(&target_variance, &mut target_scale);
        Self {
            features: Standardisation { mean, scale },
            target_mean,
            target_scale,
        }
    }
}

fn isotropic(variance: &[f64], scale: &mut [f64]) {
    for (s, v) in scale.chunks_exact_mut(3).zip(variance.chunks_exact(3)) {
        s.fill((v.iter().sum::<f64>() / 3.0).sqrt() + 1e-9);
    }
}

fn fit(
    rows: &[&Row],
    labels: Option<&[usize]>,
    options: &PredictorOptions,
    seed: u64,
) -> Result<Model, LearnError> {
    if !(1..=MAX_KNOTS).contains(&options.knots) {
        return Err(telemime_protocol::predict::ModelError::Knots {
            found: options.knots,
        }
        .into());
    }
    if rows.is_empty() {
        return Err(LearnError::NoDemonstrations);
    }
    let scaling = Scaling::of(rows);
    let scaled: Vec<Row> = rows.iter().map(|r| scale_row(r, &scaling)).collect();
    let joint: Vec<SVector<f64, JOINT>> = scaled.iter().map(|r| joint(r, options.knots)).collect();
    let em_options = EmOptions {
        components: options.components.min((rows.len() / 4).max(1)),
        max_iterations: options.max_iterations,
        convergence: Convergence::Relative(1e-4),
        standardise: false,
        ridge: options.ridge,
        shrinkage: options.shrinkage,
        weight_prior: 1e-3,
        ..EmOptions::default()
    };
    let (shares, stride) = match labels {
        Some(labels) => em::responsibilities(&joint, labels, &em_options)?,
        None => {
            let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
            let clusters = kmeans(&joint, em_options.components, LLOYD_STEPS, &mut rng);
            em::responsibilities(&joint, &clusters.labels, &em_options)?
        }
    };
    let components = regressions(&scaled, &shares, stride, &scaling, &em_options)?;
    Ok(Model::new(
        options.knots,
        scaling.features,
        components,
        Calibration::UNTRIED,
    )?)
}

fn scale_row(r: &Row, scaling: &Scaling) -> Row {
    let mut targets = r.targets;
    for ((y, m), s) in targets
        .iter_mut()
        .zip(&scaling.target_mean)
        .zip(&scaling.target_scale)
    {
        *y = (*y - m) / s;
    }
    Row {
        features: (r.features - scaling.features.mean).component_div(&scaling.features.scale),
        targets,
    }
}

/// `[f, y₃, y₆, y₉]`; a model with fewer knots shows its last one in their place.
fn joint(r: &Row, knots: usize) -> SVector<f64, JOINT> {
    let mut z = SVector::<f64, JOINT>::zeros();
    z.fixed_rows_mut::<FEATURES>(0).copy_from(&r.features);
    for (n, knot) in EM_KNOTS.into_iter().enumerate() {
        let at = 3 * (knot.min(knots) - 1);
        let block = Vector3::from_column_slice(&r.targets[at..at + 3]);
        z.fixed_rows_mut::<3>(FEATURES + 3 * n).copy_from(&block);
    }
    z
}

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

/// The last M step, over all knots, and the regressions of it.
///
/// `C_k = (S_k + ν·T)/(N_k + ν)`; `B = (C_ff + ridge·I)⁻¹ C_fy`;
/// `V = C_yy − BᵀC_fy − C_yf B + BᵀC_ff B` with the covariances before the ridge.
fn regressions(
    rows: &[Row],
    shares: &[f64],
    stride: usize,
    scaling: &Scaling,
    options: &EmOptions,
) -> Result<Vec<Regression>, LearnError> {
    let mut blocks: Vec<Blocks> = (0..stride)
        .map(|k| Blocks::of(rows, shares.iter().skip(k).step_by(stride)))
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
