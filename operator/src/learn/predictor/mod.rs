//! Training the memory-feature predictor, and finding on held-out demonstrations how far to trust it.

mod blocks;
mod course;
mod generic;
mod others;
mod refine;
mod rows;

use std::borrow::Cow;

use nalgebra::{SVector, Vector3};
use rand::SeedableRng;
use rand_xoshiro::Xoshiro256PlusPlus;
use telemime_protocol::predict::{
    Calibration, FEATURES, HandState, MAX_KNOTS, Model, ModelError, Regression, TEMPER, TurnModel,
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
pub(super) use rows::{Row, row_count};
use rows::{Scaling, rows};

/// Dimension of the joint that EM sees: the features and three displacements.
const JOINT: usize = FEATURES + 9;

/// The knots (from 1) EM sees: 100, 200 and 300 ms.
const EM_KNOTS: [usize; 3] = [3, 6, 9];

/// A character replaces one before it in the list if it leaves less than this of its squared error: that of a few
/// demonstrations is no more certain.
const CLEARLY: f64 = 0.8;

const LLOYD_STEPS: usize = 15;

/// What kind of motion a predictor is fitted to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Character {
    /// Where the differences to the quickest memories turn logarithmic, in standard deviations of theirs; 0: nowhere.
    pub bend: f64,
    /// Pseudo-samples ν of the pooled covariance.
    pub shrinkage: f64,
    /// Variance added to each standardised coordinate.
    pub ridge: f64,
}

impl Character {
    /// Gestures before a camera: abrupt starts out of rest, much noise, few samples.
    pub const ABRUPT: Self = Self {
        bend: 0.2,
        shrinkage: 8.0,
        ridge: 0.03,
    };

    /// Tasks shown with care, measured well: nearly one linear law all along.
    pub const SMOOTH: Self = Self {
        bend: 0.0,
        shrinkage: 100.0,
        ridge: 0.001,
    };
}

/// How to train the predictor.
#[derive(Debug, Clone, PartialEq)]
pub struct PredictorOptions {
    /// Most components; fewer where there are less than four samples for each, half as many again where other
    /// people's demonstrations join.
    pub components: usize,
    /// Knots J of 1/30 s.
    pub knots: usize,
    /// What the motion may be like: the first, unless a later one foretells the demonstrations held out clearly better.
    /// None is [`LearnError::NoCharacter`].
    pub characters: Vec<Character>,
    /// Weight of a demonstration's copies at other paces; 0: none.
    pub copies: f64,
    /// Whether the last M step takes the responsibilities that a query will find, which does not know what follows.
    pub as_queried: bool,
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
            characters: vec![Character::ABRUPT, Character::SMOOTH],
            copies: 0.3,
            as_queried: true,
            max_iterations: 15,
            folds: 6,
        }
    }
}

/// Trains a predictor and calibrates it by leaving out one demonstration at a time.
///
/// `others` are the same motion by other people: they stand in where the own `demonstrations` have nothing to say.
/// With a single demonstration there is none to leave out, and the guesses of
/// [`Calibration::UNTRIED`] stay for what only that could show.
///
/// # Errors
/// [`LearnError`]: no demonstration, too few samples, or numbers that make no model.
pub fn train(
    demonstrations: &[Demonstration],
    others: &[Demonstration],
    options: &PredictorOptions,
    seed: u64,
    progress: &mut impl FnMut(Progress),
) -> Result<Model, LearnError> {
    let others = others::brought(demonstrations, others, options.knots);
    train_course::<Places>(demonstrations, &others, options, seed, progress)
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
    train_course::<Turns>(demonstrations, &[], options, seed, progress)
}

fn train_course<C: Course>(
    demonstrations: &[Demonstration],
    others: &[Row],
    options: &PredictorOptions,
    seed: u64,
    progress: &mut impl FnMut(Progress),
) -> Result<C::Model, LearnError> {
    let rows = rows::<C>(demonstrations, options.knots, options.copies);
    let folds = match options.folds.min(demonstrations.len()) {
        0 | 1 => 0,
        folds => folds,
    };
    let mut best: Option<(f64, Character, Trial<C>)> = None;
    let of = folds * options.characters.len();
    for (n, character) in options.characters.iter().enumerate() {
        let mut trial = Trial::<C>::straight(demonstrations, options.knots);
        for fold in 0..folds {
            let held = fold * demonstrations.len() / folds;
            let own: Vec<&Row> = rows
                .iter()
                .enumerate()
                .filter(|(i, _)| *i != held)
                .flat_map(|(_, r)| r)
                .collect();
            let fitted = fit_with_others::<C>(&own, others, character, options, seed)?;
            let without = C::model(&fitted, Calibration::UNTRIED)?;
            trial.hold_out(&without, &demonstrations[held]);
            let done = n * folds + fold + 1;
            progress(Progress::Held { done, of });
        }
        let ratio = trial.ratio();
        let better = |least: &f64| ratio < CLEARLY * least;
        if best.as_ref().is_none_or(|(least, ..)| better(least)) {
            best = Some((ratio, *character, trial));
        }
    }
    let (_, character, trial) = best.ok_or(LearnError::NoCharacter)?;
    let own: Vec<&Row> = rows.iter().flatten().collect();
    let fitted = fit_with_others::<C>(&own, others, &character, options, seed)?;
    progress(Progress::Predictor {
        components: fitted.components.len(),
        samples: own.iter().filter(|r| r.weight >= 1.0).count(),
        smooth: character.bend == 0.0,
    });
    Ok(C::model(&fitted, trial.calibration())?)
}

/// A fit to the own rows; if there are others' then one to both, those weighed by the first.
fn fit_with_others<C: Course>(
    own: &[&Row],
    others: &[Row],
    character: &Character,
    options: &PredictorOptions,
    seed: u64,
) -> Result<Fitted, LearnError> {
    let fitted = fit::<C>(own, None, character, options, seed)?;
    if others.is_empty() {
        return Ok(fitted);
    }
    let model = C::model(&fitted, Calibration::UNTRIED)?;
    let weighed = others::weigh(C::parts(&model).0, own, others);
    let both: Vec<&Row> = own.iter().copied().chain(&weighed).collect();
    let more = PredictorOptions {
        components: options.components + options.components / 2,
        ..options.clone()
    };
    fit::<C>(&both, None, character, &more, seed)
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
    let character = options.characters.first().ok_or(LearnError::NoCharacter)?;
    let rows = rows::<Places>(demonstrations, options.knots, options.copies);
    let rows: Vec<&Row> = rows.iter().flatten().collect();
    if labels.len() != rows.len() {
        return Err(LearnError::TooFewRows {
            found: labels.len(),
            needed: rows.len(),
        });
    }
    let fitted = fit::<Places>(&rows, Some(labels), character, options, 0)?;
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

fn fit<C: Course>(
    rows: &[&Row],
    labels: Option<&[usize]>,
    character: &Character,
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
    let scaling = Scaling::of(rows, character);
    let scaled: Vec<Row> = rows.iter().map(|r| scaling.row(r)).collect();
    let weights: Vec<f64> = rows.iter().map(|r| r.weight).collect();
    let joint: Vec<SVector<f64, JOINT>> = scaled.iter().map(|r| joint(r, options.knots)).collect();
    let enough = (weights.iter().sum::<f64>() / 4.0) as usize;
    let em_options = EmOptions {
        components: options.components.min(enough.max(1)),
        max_iterations: options.max_iterations,
        ..em_options(character)
    };
    let (mut shares, stride) = match labels {
        Some(labels) => em::responsibilities(&joint, &weights, labels, &em_options)?,
        None => {
            let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
            let clusters = kmeans(&joint, em_options.components, LLOYD_STEPS, &mut rng);
            em::responsibilities(&joint, &weights, &clusters.labels, &em_options)?
        }
    };
    let charts = C::charts(&scaled, &shares, stride);
    let mut features = scaling.features.clone();
    if !charts.is_empty() {
        features.mean.fixed_rows_mut::<3>(0).fill(0.0);
    }
    let generic = Products::of(rows.iter().copied()).solve()?;
    let seen = |k: usize| C::seen(&scaled, charts.get(k), features.scale[0]);
    let weigh = |shares: &mut [f64]| {
        let rows = shares.chunks_exact_mut(stride).zip(&weights);
        rows.for_each(|(row, w)| row.iter_mut().for_each(|r| *r *= w));
    };
    weigh(&mut shares);
    let mut components = blocks::regressions(seen, &shares, stride, &scaling, &em_options)?;
    if options.as_queried {
        assign(&components, &seen, &mut shares, queried);
        weigh(&mut shares);
        components = blocks::regressions(seen, &shares, stride, &scaling, &em_options)?;
    }
    Ok(Fitted {
        knots: options.knots,
        standardisation: features,
        components,
        charts,
        generic,
    })
}

fn em_options(character: &Character) -> EmOptions {
    EmOptions {
        convergence: Convergence::Relative(1e-4),
        standardise: false,
        ridge: character.ridge,
        shrinkage: character.shrinkage,
        weight_prior: 1e-3,
        ..EmOptions::default()
    }
}

/// Responsibilities of `components` for rows as each of them sees them, from the logarithm `of` one's density.
fn assign<'a>(
    components: &[Regression],
    seen: &impl Fn(usize) -> Cow<'a, [Row]>,
    shares: &mut [f64],
    of: impl Fn(&Regression, &Row) -> f64,
) {
    let stride = components.len();
    for (k, c) in components.iter().enumerate() {
        let to = shares.iter_mut().skip(k).step_by(stride);
        for (share, row) in to.zip(seen(k).iter()) {
            let l = of(c, row);
            *share = if l.is_nan() { f64::NEG_INFINITY } else { l };
        }
    }
    shares.chunks_exact_mut(stride).for_each(normalise);
}

/// Of logarithms of densities responsibilities; all alike where every density is 0.
fn normalise(l: &mut [f64]) {
    let max = l.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if max == f64::NEG_INFINITY {
        l.fill(1.0 / l.len() as f64);
        return;
    }
    l.iter_mut().for_each(|v| *v = (*v - max).exp());
    let sum: f64 = l.iter().sum();
    l.iter_mut().for_each(|v| *v /= sum);
}

/// ln of a component's weight and density at the features.
fn log_density(c: &Regression, row: &Row) -> f64 {
    let log_det: f64 = c.factor.diagonal().iter().map(|d| d.ln()).sum();
    match c.factor.solve_lower_triangular(&(row.features - c.mean)) {
        Some(z) => c.weight.ln() - log_det - 0.5 * z.norm_squared(),
        None => f64::NEG_INFINITY,
    }
}

/// What [`Model::posterior`] weighs a component by.
fn queried(c: &Regression, row: &Row) -> f64 {
    TEMPER * log_density(c, row)
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
