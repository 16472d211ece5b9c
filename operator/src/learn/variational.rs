//! Variational Bayesian Gaussian mixtures.
//! Bishop 2006, §10.2; the Dirichlet process by stick-breaking after Blei & Jordan 2006.
//!
//! A distribution over mixtures instead of one: weights a Dirichlet distribution or a truncated Dirichlet
//! process, mean and precision of each component Gaussian–Wishart. Components that nothing speaks for
//! return to their prior, and no covariance collapses. Works in the data's own units.

mod bound;

use nalgebra::{SMatrix, SVector};
use rand::SeedableRng;
use rand_xoshiro::Xoshiro256PlusPlus;
use rayon::prelude::*;
use telemime_protocol::skill::Gmm;

use super::LearnError;
use super::em::pass::{Tiles, pass};
use super::em::run::{Moments, of_labels};
use super::em::{Degenerate, add_outer, check, mirror};
use super::kmeans::kmeans;

pub use bound::{digamma, ln_gamma};

/// Lloyd steps before the first M step; k-means has nearly always converged by then.
const LLOYD_STEPS: usize = 100;

/// Where the ridge is below the rounding of a singular covariance: this share of its largest variance.
const LEAST_SHARE: f64 = 1e-9;

/// What is believed of the weights before any data.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum WeightPrior {
    /// A symmetric Dirichlet distribution over K components.
    Distribution,
    /// A Dirichlet process, truncated at K: each component takes a share of what those before it left,
    /// so that their order matters.
    Process,
}

/// How to fit a variational mixture. The defaults are those of scikit-learn's `BayesianGaussianMixture`.
#[derive(Debug, Clone, PartialEq)]
pub struct VariationalOptions {
    /// Most components K.
    pub components: usize,
    /// The prior of the weights.
    pub weights: WeightPrior,
    /// α₀ of each component, or γ of the process; `None` means 1/K.
    pub concentration: Option<f64>,
    /// β₀: how many samples the prior mean (that of the data) counts as.
    pub mean_precision: f64,
    /// Added to the diagonal of each component's scatter per sample: a variance.
    pub ridge: f64,
    /// Most iterations of one start.
    pub max_iterations: usize,
    /// Converged when the bound (nats, all samples together) changes by less.
    pub tolerance: f64,
    /// Independent k-means++ starts; the one of the highest bound is kept.
    pub restarts: usize,
    /// Seed of the draws.
    pub seed: u64,
}

impl Default for VariationalOptions {
    fn default() -> Self {
        Self {
            components: 5,
            weights: WeightPrior::Process,
            concentration: None,
            mean_precision: 1.0,
            ridge: 1e-6,
            max_iterations: 100,
            tolerance: 1e-3,
            restarts: 1,
            seed: 0,
        }
    }
}

/// A fitted variational mixture.
#[derive(Debug, Clone, PartialEq)]
pub struct Variational<const D: usize> {
    /// The mixture at the expected weights and means, and the inverses of the expected precisions.
    pub gmm: Gmm<D>,
    /// The evidence lower bound (nats, all samples together) after each E step. It never falls if the
    /// ridge is zero: the ridge, as in scikit-learn, enters the M step only.
    pub trace: Vec<f64>,
    /// Iterations done.
    pub iterations: usize,
    /// Whether the bound converged before the iterations ran out.
    pub converged: bool,
    /// Samples each component explains.
    pub samples: Vec<f64>,
    /// What the data could not say.
    pub degenerate: Vec<Degenerate>,
}

impl<const D: usize> Variational<D> {
    /// Components that explain at least one sample.
    pub fn effective_components(&self) -> usize {
        self.samples.iter().filter(|n| **n >= 1.0).count()
    }
}

/// Fits from k-means++ starts and keeps the one whose bound is highest.
///
/// # Errors
/// [`LearnError`]: no or too few rows, rows beyond ±10¹² or not finite, K out of range, a prior that is
/// not positive and finite, or a covariance that is singular even with the ridge.
pub fn fit<const D: usize>(
    data: &[SVector<f64, D>],
    options: &VariationalOptions,
) -> Result<Variational<D>, LearnError> {
    let k = options.components;
    let prior = Prior::of(data, options)?;
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(options.seed);
    let starts: Vec<_> = (0..options.restarts.max(1))
        .map(|_| kmeans(data, k, LLOYD_STEPS, &mut rng).labels)
        .collect();
    let tiles = Tiles::new(data);
    let fits: Vec<_> = starts
        .into_par_iter()
        .map(|labels| run(data, &tiles, &labels, &prior, options))
        .collect();
    let bound = |v: &Variational<D>| v.trace.last().copied().unwrap_or(f64::NEG_INFINITY);
    fits.into_iter()
        .reduce(|a, b| match (a, b) {
            (Ok(a), Ok(b)) => Ok(if bound(&b) > bound(&a) { b } else { a }),
            (Err(_), b) => b,
            (a, Err(_)) => a,
        })
        .unwrap_or(Err(LearnError::Singular))
}

/// Fits from hard labels, one a row; a label of K or more means K − 1.
///
/// # Errors
/// As [`fit`]; also if there are not as many labels as rows.
pub fn from_labels<const D: usize>(
    data: &[SVector<f64, D>],
    labels: &[usize],
    options: &VariationalOptions,
) -> Result<Variational<D>, LearnError> {
    if labels.len() != data.len() {
        return Err(LearnError::TooFewRows {
            found: labels.len(),
            needed: data.len(),
        });
    }
    let prior = Prior::of(data, options)?;
    run(data, &Tiles::new(data), labels, &prior, options)
}

/// What is believed before any data.
struct Prior<const D: usize> {
    weights: WeightPrior,
    concentration: f64,
    mean_precision: f64,
    mean: SVector<f64, D>,
    /// ν₀
    freedom: f64,
    /// W₀⁻¹
    scatter: SMatrix<f64, D, D>,
}

impl<const D: usize> Prior<D> {
    fn of(data: &[SVector<f64, D>], options: &VariationalOptions) -> Result<Self, LearnError> {
        check(data, options.components)?;
        let concentration = options
            .concentration
            .unwrap_or(1.0 / options.components as f64);
        for value in [concentration, options.mean_precision] {
            if !(value > 0.0 && value.is_finite()) {
                return Err(LearnError::Prior { found: value });
            }
        }
        let all = of_labels(data, |_| 1.0, &vec![0; data.len()], 1).swap_remove(0);
        Ok(Self {
            weights: options.weights,
            concentration,
            mean_precision: options.mean_precision,
            mean: all.mean,
            freedom: D as f64,
            scatter: all.scatter / (all.n - 1.0),
        })
    }
}

/// Gaussian–Wishart of one component.
struct Posterior<const D: usize> {
    /// N_k
    samples: f64,
    /// β
    mean_precision: f64,
    mean: SVector<f64, D>,
    /// ν
    freedom: f64,
    /// (ν·W)⁻¹, the inverse of the expected precision.
    covariance: SMatrix<f64, D, D>,
    /// Its lower Cholesky factor.
    factor: SMatrix<f64, D, D>,
    /// The covariance was singular before the ridge was added to it.
    floored: bool,
}

impl<const D: usize> Posterior<D> {
    /// Bishop 2006, eq. (10.60)–(10.63); the ridge as scikit-learn adds it.
    fn of(m: &Moments<D>, prior: &Prior<D>, ridge: f64) -> Result<Self, LearnError> {
        // scikit-learn's guard of empty components.
        let n = m.n + 10.0 * f64::EPSILON;
        let beta = prior.mean_precision + n;
        let nu = prior.freedom + n;
        let mean = if m.n > 0.0 {
            (prior.mean * prior.mean_precision + m.mean * n) / beta
        } else {
            prior.mean
        };
        let mut apart = SMatrix::zeros();
        if m.n > 0.0 {
            add_outer(
                &mut apart,
                &(m.mean - prior.mean),
                n * prior.mean_precision / beta,
            );
            mirror(&mut apart);
        }
        let identity = SMatrix::<f64, D, D>::identity();
        let mut covariance = (prior.scatter + m.scatter + identity * (n * ridge) + apart) / nu;
        let checked = |c: &SMatrix<f64, D, D>| {
            Gmm::new([(1.0, mean, *c)])
                .ok()
                .map(|g| *g.components()[0].factor())
        };
        let mut floored = false;
        let factor = match checked(&covariance) {
            Some(factor) => factor,
            None => {
                floored = true;
                let floor = if ridge > 0.0 {
                    ridge.max(LEAST_SHARE * covariance.diagonal().max())
                } else {
                    0.0
                };
                covariance += identity * floor;
                checked(&covariance).ok_or(LearnError::Singular)?
            }
        };
        Ok(Self {
            samples: m.n,
            mean_precision: beta,
            mean,
            freedom: nu,
            covariance,
            factor,
            floored,
        })
    }
}

fn run<const D: usize>(
    data: &[SVector<f64, D>],
    tiles: &Tiles<D>,
    labels: &[usize],
    prior: &Prior<D>,
    options: &VariationalOptions,
) -> Result<Variational<D>, LearnError> {
    let mut moments = of_labels(data, |_| 1.0, labels, options.components);
    let mut trace: Vec<f64> = Vec::new();
    let mut previous = f64::NEG_INFINITY;
    let mut converged = false;
    let posterior = |moments: &[Moments<D>]| -> Result<Vec<Posterior<D>>, LearnError> {
        moments
            .iter()
            .map(|m| Posterior::of(m, prior, options.ridge))
            .collect()
    };
    let mut now = posterior(&moments)?;
    while trace.len() < options.max_iterations {
        let weights = bound::Weights::of(prior, &now);
        let kernels: Vec<_> = now
            .iter()
            .zip(weights.expected_log())
            .map(|(p, log_weight)| p.kernel(log_weight))
            .collect();
        let found = pass(tiles, &kernels, None);
        let value = found.log_likelihood - weights.divergence() - bound::divergence(prior, &now);
        trace.push(value);
        moments = found
            .sums
            .iter()
            .zip(&now)
            .map(|(sums, p)| Moments::of(sums, &p.mean))
            .collect();
        now = posterior(&moments)?;
        if (value - previous).abs() < options.tolerance {
            converged = true;
            break;
        }
        previous = value;
    }
    let weights = bound::Weights::of(prior, &now).expected();
    let gmm = Gmm::new(
        now.iter()
            .zip(weights)
            .map(|(p, weight)| (weight.max(f64::MIN_POSITIVE), p.mean, p.covariance)),
    );
    Ok(Variational {
        gmm: gmm.map_err(|_| LearnError::Singular)?,
        iterations: trace.len(),
        trace,
        converged,
        samples: now.iter().map(|p| p.samples).collect(),
        degenerate: degenerate(&now, options.ridge),
    })
}

fn degenerate<const D: usize>(now: &[Posterior<D>], ridge: f64) -> Vec<Degenerate> {
    (0..D)
        .filter_map(|axis| {
            let floored = |p: &&Posterior<D>| {
                p.samples >= 1.0 && (p.floored || p.factor[(axis, axis)].powi(2) < 2.0 * ridge)
            };
            let components = now.iter().filter(floored).count();
            (components > 0).then_some(Degenerate::Floored { axis, components })
        })
        .collect()
}
