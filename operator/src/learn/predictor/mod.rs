//! Training the memory-feature predictor, and finding on held-out demonstrations how far to trust it.

mod blocks;
mod course;
mod generic;
mod refine;

use nalgebra::{SVector, UnitQuaternion, Vector3};
use rand::SeedableRng;
use rand_xoshiro::Xoshiro256PlusPlus;
use telemime_protocol::pose;
use telemime_protocol::predict::{
    Calibration, FEATURES, HandState, MAX_KNOTS, Model, ModelError, Standardisation, TARGETS,
    TurnModel,
};
use telemime_protocol::time::Stamp;

use super::em::{self, Convergence, EmOptions};
use super::kmeans::kmeans;
use super::trial::Trial;
use super::{LearnError, Progress};
use crate::demonstration::Demonstration;
use course::Fitted;
pub(super) use course::{Course, Places, Turns};
use generic::Products;
pub(super) use refine::refine;

/// Dimension of the joint that EM sees: the features and three displacements.
const JOINT: usize = FEATURES + 9;

/// The knots (from 1) EM sees: 100, 200 and 300 ms.
const EM_KNOTS: [usize; 3] = [3, 6, 9];

/// Rows nearer in time than this are thinned: a sensor of 200 Hz says nothing more about a hand than
/// one of 30, all of whose samples are kept unless they jitter by 8 ms.
const LEAST_SPACING_S: f64 = 1.0 / 40.0;

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
#[derive(Clone)]
pub(super) struct Row {
    features: SVector<f64, FEATURES>,
    targets: [f64; TARGETS],
    /// Of the hand, where it is what is predicted.
    orientation: UnitQuaternion<f64>,
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
    train_course::<Places>(demonstrations, options, seed, progress)
}

/// The same for orientation.
///
/// # Errors
/// As [`train`].
pub fn train_turns(
    demonstrations: &[Demonstration],
    options: &PredictorOptions,
    seed: u64,
    progress: &mut impl FnMut(Progress),
) -> Result<TurnModel, LearnError> {
    train_course::<Turns>(demonstrations, options, seed, progress)
}

fn train_course<C: Course>(
    demonstrations: &[Demonstration],
    options: &PredictorOptions,
    seed: u64,
    progress: &mut impl FnMut(Progress),
) -> Result<C::Model, LearnError> {
    let rows = rows::<C>(demonstrations, options.knots);
    let all: Vec<&Row> = rows.iter().flatten().collect();
    let model = fit::<C>(&all, None, options, seed)?;
    let mut trial = Trial::<C>::straight(demonstrations, options.knots);

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
            let without = C::model(
                &fit::<C>(&others, None, options, seed)?,
                Calibration::UNTRIED,
            )?;
            trial.hold_out(&without, &demonstrations[held]);
            progress(Progress::Held {
                done: fold + 1,
                of: folds,
            });
        }
    }
    progress(Progress::Predictor {
        components: model.components.len(),
        samples: all.len(),
    });
    Ok(C::model(&model, trial.calibration())?)
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
    let rows = rows::<Places>(demonstrations, options.knots);
    let rows: Vec<&Row> = rows.iter().flatten().collect();
    if labels.len() != rows.len() {
        return Err(LearnError::TooFewRows {
            found: labels.len(),
            needed: rows.len(),
        });
    }
    let fitted = fit::<Places>(&rows, Some(labels), options, 0)?;
    Ok(Places::model(&fitted, Calibration::UNTRIED)?)
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

/// The rows of each demonstration.
fn rows<C: Course>(demonstrations: &[Demonstration], knots: usize) -> Vec<Vec<Row>> {
    // Where orientation is not what is predicted, this is the mean of nothing.
    let orientations = demonstrations
        .iter()
        .flat_map(|d| d.samples().iter().filter_map(|s| s.orientation))
        .map(|q| (1.0, q));
    let chart = pose::mean(orientations).unwrap_or_default();
    demonstrations
        .iter()
        .map(|d| rows_of::<C>(d, knots, &chart))
        .collect()
}

/// How many of a demonstration's samples become rows.
pub(super) fn row_count(d: &Demonstration) -> usize {
    let mut last_s = f64::NEG_INFINITY;
    d.samples()
        .iter()
        .filter(|s| kept(s.t_s, &mut last_s))
        .count()
}

/// Whether a sample at `t_s` is far enough from the last one kept.
fn kept(t_s: f64, last_s: &mut f64) -> bool {
    let far = t_s - *last_s >= LEAST_SPACING_S;
    if far {
        *last_s = t_s;
    }
    far
}

fn rows_of<C: Course>(d: &Demonstration, knots: usize, chart: &UnitQuaternion<f64>) -> Vec<Row> {
    let mut last_s = f64::NEG_INFINITY;
    let mut rows = Vec::with_capacity(d.samples().len());
    for (i, state) in C::states(d).iter().enumerate() {
        let t_s = d.samples()[i].t_s;
        if !kept(t_s, &mut last_s) {
            continue;
        }
        let mut targets = [0.0; TARGETS];
        for (j, y) in targets.chunks_exact_mut(3).take(knots).enumerate() {
            y.copy_from_slice(C::displacement(d, i, j + 1).as_slice());
        }
        let (features, orientation) = C::row(state, chart);
        rows.push(Row {
            features,
            targets,
            orientation,
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

fn fit<C: Course>(
    rows: &[&Row],
    labels: Option<&[usize]>,
    options: &PredictorOptions,
    seed: u64,
) -> Result<Fitted, LearnError> {
    if !(1..=MAX_KNOTS).contains(&options.knots) {
        return Err(ModelError::Knots {
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
        ..em_options(options)
    };
    let (shares, stride) = match labels {
        Some(labels) => em::responsibilities(&joint, labels, &em_options)?,
        None => {
            let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
            let clusters = kmeans(&joint, em_options.components, LLOYD_STEPS, &mut rng);
            em::responsibilities(&joint, &clusters.labels, &em_options)?
        }
    };
    let charts = C::charts(&scaled, &shares, stride);
    let mut features = scaling.features.clone();
    if !charts.is_empty() {
        features.mean.fixed_rows_mut::<3>(0).fill(0.0);
    }
    let generic = Products::of(rows.iter().copied()).solve()?;
    let seen = |k: usize| C::seen(&scaled, charts.get(k), features.scale[0]);
    let components = blocks::regressions(seen, &shares, stride, &scaling, &em_options)?;
    Ok(Fitted {
        knots: options.knots,
        standardisation: features,
        components,
        charts,
        generic,
    })
}

fn em_options(options: &PredictorOptions) -> EmOptions {
    EmOptions {
        components: options.components,
        max_iterations: options.max_iterations,
        convergence: Convergence::Relative(1e-4),
        standardise: false,
        ridge: options.ridge,
        shrinkage: options.shrinkage,
        weight_prior: 1e-3,
        ..EmOptions::default()
    }
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
        orientation: r.orientation,
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
