//! Expectation–maximisation for Gaussian mixtures.
//! Bishop 2006, §9.2.2; log domain throughout, Cholesky factors, centred sums.
//!
//! The same seed gives the same mixture, bit for bit, on any number of threads.

pub(super) mod pass;
pub(super) mod run;
pub(super) mod units;
pub mod update;

use std::fmt;

use nalgebra::{SMatrix, SVector};
use rand::SeedableRng;
use rand_xoshiro::Xoshiro256PlusPlus;
use rayon::prelude::*;
use telemime_protocol::skill::{Gmm, MAX_COMPONENTS};

use super::LearnError;
use super::kmeans::kmeans;
use pass::Tiles;
use run::Em;
use units::Units;

pub use update::update;

/// Beyond this magnitude squares and sums could overflow.
const LARGEST: f64 = 1e12;

/// Lloyd steps before EM.
const LLOYD_STEPS: usize = 15;

/// When the mean log likelihood has converged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Convergence {
    /// Its change, nats a sample, is less than this.
    Absolute(f64),
    /// Its change is less than this share of its magnitude.
    Relative(f64),
}

/// What the covariances of a mixture may differ in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Covariance {
    /// Each component has its own.
    Full,
    /// All components have the same.
    Tied,
    /// Each component has its own, and no coordinate varies with another.
    Diagonal,
}

impl Covariance {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Full, Self::Tied, Self::Diagonal];

    /// Free numbers of a mixture of `components` over `dimensions`: weights, means and covariances.
    pub fn parameters(self, components: usize, dimensions: usize) -> usize {
        let (k, d) = (components, dimensions);
        let covariances = match self {
            Self::Full => k * d * (d + 1) / 2,
            Self::Tied => d * (d + 1) / 2,
            Self::Diagonal => k * d,
        };
        k - 1 + k * d + covariances
    }
}

impl fmt::Display for Covariance {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Full => "full",
            Self::Tied => "tied",
            Self::Diagonal => "diagonal",
        })
    }
}

/// How to fit a mixture.
#[derive(Debug, Clone, PartialEq)]
pub struct EmOptions {
    /// Number of components K.
    pub components: usize,
    /// What the covariances may differ in.
    pub covariance: Covariance,
    /// Most iterations of one start.
    pub max_iterations: usize,
    /// When to stop.
    pub convergence: Convergence,
    /// Fit in units of each coordinate's own standard deviation; the answer is in the data's units.
    pub standardise: bool,
    /// Added to the diagonal of every covariance: a variance, in the units of the fit.
    pub ridge: f64,
    /// Pseudo-samples ν of the pooled covariance in each: `(S_k + ν·T)/(N_k + ν)`.
    pub shrinkage: f64,
    /// Where a component holds fewer samples than D + 1, which cannot span its covariance, shrink that
    /// towards the pooled one by the share of oracle-approximating shrinkage (Chen et al. 2010, eq. 23).
    /// Such a step may lower the likelihood; it is reported.
    pub shrink_small: bool,
    /// Samples added to every N_k when weights are formed.
    pub weight_prior: f64,
    /// Independent k-means++ starts.
    pub restarts: usize,
    /// One more start: rows sorted by the first coordinate, cut into K bins of equal count.
    pub time_bins: bool,
    /// Seed of the k-means++ draws.
    pub seed: u64,
}

impl Default for EmOptions {
    fn default() -> Self {
        Self {
            components: 5,
            covariance: Covariance::Full,
            max_iterations: 100,
            convergence: Convergence::Absolute(1e-4),
            standardise: true,
            ridge: 1e-6,
            shrinkage: 0.0,
            shrink_small: true,
            weight_prior: 0.0,
            restarts: 3,
            time_bins: true,
            seed: 0,
        }
    }
}

/// Where a fit started.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Start {
    /// k-means++, the n-th restart.
    KMeans(usize),
    /// Equal bins of the first coordinate.
    TimeBins,
    /// Given by the caller.
    Given,
}

/// What was done about a component that died.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Remedy {
    /// Started again at the row the mixture explains worst, with the pooled covariance.
    Reseeded,
    /// Removed: it had been started again before.
    Pruned,
}

/// What the data could not say, and what stands in its place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Degenerate {
    /// A component became empty or singular.
    Died {
        /// The M step in which it was found; 0 forms the start.
        iteration: usize,
        /// Its index at that time.
        component: usize,
        /// What was done.
        remedy: Remedy,
    },
    /// A coordinate does not vary: its variance is the ridge, in the coordinate's own unit.
    Constant {
        /// The coordinate.
        axis: usize,
    },
    /// Given the coordinates before it, a coordinate varies less than the ridge: data in a line or plane.
    Floored {
        /// The coordinate.
        axis: usize,
        /// In how many components.
        components: usize,
    },
    /// A component holds too few samples for a covariance of its own.
    Shrunk {
        /// Its index.
        component: usize,
        /// The samples it explains.
        samples: f64,
        /// The pooled covariance's share of its own.
        share: f64,
    },
}

impl fmt::Display for Degenerate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Died {
                iteration,
                component,
                remedy: Remedy::Reseeded,
            } => write!(
                f,
                "component {component} was empty in iteration {iteration} and was started again"
            ),
            Self::Died {
                iteration,
                component,
                remedy: Remedy::Pruned,
            } => write!(
                f,
                "component {component} was empty again in iteration {iteration} and was removed"
            ),
            Self::Constant { axis } => {
                write!(
                    f,
                    "coordinate {axis} does not vary; its variance is the floor"
                )
            }
            Self::Floored { axis, components } => write!(
                f,
                "coordinate {axis} follows from those before it in {components} component{}; its \
                 variance is held at the floor",
                if components == 1 { "" } else { "s" }
            ),
            Self::Shrunk {
                component,
                samples,
                share,
            } => write!(
                f,
                "component {component} explains {samples:.1} samples; {:.0} % of its covariance are \
                 the pooled one",
                share * 100.0
            ),
        }
    }
}

/// A fitted mixture and how it came about.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit<const D: usize> {
    /// The mixture, in the data's units.
    pub gmm: Gmm<D>,
    /// Mean log likelihood (nats a sample, the data's units) found by each E step.
    pub trace: Vec<f64>,
    /// Mean log likelihood of the mixture returned.
    pub score: f64,
    /// Iterations done.
    pub iterations: usize,
    /// Whether the likelihood converged before the iterations ran out.
    pub converged: bool,
    /// The start that gave the best score.
    pub start: Start,
    /// Components that died on the way, and what the mixture owes to floor and shrinkage.
    pub degenerate: Vec<Degenerate>,
}

/// Fits a mixture from several starts and keeps the best by its own final likelihood.
///
/// # Errors
/// [`LearnError`]: no or too few rows, rows beyond ±10¹² or not finite, K out of range, or data whose
/// pooled covariance is singular while `ridge` is zero.
pub fn fit<const D: usize>(
    data: &[SVector<f64, D>],
    options: &EmOptions,
) -> Result<Fit<D>, LearnError> {
    check(data, options.components)?;
    let units = Units::of(data, options.standardise);
    let rows = units.apply(data);
    let tiles = Tiles::new(&rows);
    let k = options.components;
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(options.seed);
    let restarts = options.restarts.max(usize::from(!options.time_bins));
    // The draws follow each other; the fits do not.
    let mut starts: Vec<_> = (0..restarts)
        .map(|n| {
            let labels = kmeans(&rows, k, LLOYD_STEPS, &mut rng).labels;
            (Start::KMeans(n), labels)
        })
        .collect();
    if options.time_bins {
        starts.push((Start::TimeBins, time_bins(&rows, k)));
    }
    let fits: Vec<Result<Fit<D>, LearnError>> = starts
        .into_par_iter()
        .map(|(start, labels)| {
            let mut em = Em::from_labels(&rows, &tiles, &labels, options)?;
            em.run(options);
            em.finish(&units, start, options)
        })
        .collect();
    // A start from which no mixture can be formed is passed over as long as another one works.
    fits.into_iter()
        .reduce(|a, b| match (a, b) {
            (Ok(a), Ok(b)) => Ok(if b.score > a.score { b } else { a }),
            (Err(_), b) => b,
            (a, Err(_)) => a,
        })
        .unwrap_or(Err(LearnError::Singular))
}

/// Continues EM from a given mixture, in the data's own units; `components`, starts and
/// `standardise` of the options do not apply.
///
/// # Errors
/// As [`fit`].
pub fn from_start<const D: usize>(
    data: &[SVector<f64, D>],
    start: &Gmm<D>,
    options: &EmOptions,
) -> Result<Fit<D>, LearnError> {
    check(data, start.components().len())?;
    let units = Units::of(data, false);
    let tiles = Tiles::new(data);
    let mut em = Em::new(data, &tiles, start.clone());
    em.run(options);
    em.finish(&units, Start::Given, options)
}

/// EM as the predictor uses it: from labels, in the units of the rows, each of which counts `weights` times;
/// returns the responsibilities of the last E step, row by row, and the number of components.
pub(super) fn responsibilities<const D: usize>(
    data: &[SVector<f64, D>],
    weights: &[f64],
    labels: &[usize],
    options: &EmOptions,
) -> Result<(Vec<f64>, usize), LearnError> {
    check(data, options.components)?;
    let tiles = Tiles::weighted(data, weights);
    let mut em = Em::from_labels(data, &tiles, labels, options)?;
    em.run(options);
    let seen = em.seen();
    let k = seen.components().len();
    let mut shares = vec![0.0; data.len() * k];
    for (x, shares) in data.iter().zip(shares.chunks_exact_mut(k)) {
        seen.responsibilities(x, shares);
    }
    Ok((shares, k))
}

pub(super) fn check<const D: usize>(data: &[SVector<f64, D>], k: usize) -> Result<(), LearnError> {
    if !(1..=MAX_COMPONENTS).contains(&k) {
        return Err(LearnError::Components { asked: k });
    }
    if data.len() < k.max(2) {
        return Err(LearnError::TooFewRows {
            found: data.len(),
            needed: k.max(2),
        });
    }
    match data
        .iter()
        .position(|x| !x.iter().all(|v| v.abs() <= LARGEST))
    {
        Some(row) => Err(LearnError::OutOfRange { row }),
        None => Ok(()),
    }
}

fn time_bins<const D: usize>(rows: &[SVector<f64, D>], k: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..rows.len()).collect();
    order.sort_by(|&a, &b| rows[a][0].total_cmp(&rows[b][0]));
    let mut labels = vec![0; rows.len()];
    for (rank, row) in order.into_iter().enumerate() {
        labels[row] = rank * k / rows.len();
    }
    labels
}

/// Adds r·d·dᵀ to the lower triangle.
pub(super) fn add_outer<const D: usize>(sum: &mut SMatrix<f64, D, D>, d: &SVector<f64, D>, r: f64) {
    for j in 0..D {
        let s = r * d[j];
        for i in j..D {
            sum[(i, j)] += s * d[i];
        }
    }
}

/// Copies the lower triangle to the upper.
pub(super) fn mirror<const D: usize>(a: &mut SMatrix<f64, D, D>) {
    a.fill_upper_triangle_with_lower_triangle();
}
