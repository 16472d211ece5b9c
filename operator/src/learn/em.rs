//! Expectation–maximisation for Gaussian mixtures with full covariances.
//! Bishop 2006, §9.2.2; log domain throughout, Cholesky factors, centred sums.

use nalgebra::{SMatrix, SVector};
use rand::SeedableRng;
use rand_xoshiro::Xoshiro256PlusPlus;
use telemime_protocol::skill::{Gmm, MAX_COMPONENTS};

use super::LearnError;
use super::kmeans::kmeans;

/// Beyond this magnitude squares and sums could overflow.
const LARGEST: f64 = 1e12;

/// A component that explains less than this many samples is empty.
const EMPTY: f64 = 1e-3;

/// Responsibilities below this add nothing to a sum of doubles.
const NEGLIGIBLE: f64 = 1e-18;

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

/// How to fit a mixture.
#[derive(Debug, Clone, PartialEq)]
pub struct EmOptions {
    /// Number of components K.
    pub components: usize,
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
            max_iterations: 100,
            convergence: Convergence::Absolute(1e-4),
            standardise: true,
            ridge: 1e-6,
            shrinkage: 0.0,
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

/// A component that became empty or singular.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Degenerate {
    /// The M step in which it was found; 0 forms the start.
    pub iteration: usize,
    /// Its index at that time.
    pub component: usize,
    /// What was done.
    pub remedy: Remedy,
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
    /// Components that died on the way.
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
    let k = options.components;
    // A start from which no mixture can be formed is passed over as long as another one works.
    let mut best: Result<Fit<D>, _> = Err(LearnError::Singular);
    let mut consider = |labels: &[usize], start| {
        let fit = Em::from_labels(&rows, labels, k, options).and_then(|mut em| {
            em.run(options);
            em.finish(&units, start)
        });
        best = match (std::mem::replace(&mut best, Err(LearnError::Singular)), fit) {
            (Ok(a), Ok(b)) => Ok(if b.score > a.score { b } else { a }),
            (Err(_), fit) => fit,
            (Ok(a), Err(_)) => Ok(a),
        };
    };
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(options.seed);
    let restarts = options.restarts.max(usize::from(!options.time_bins));
    for n in 0..restarts {
        let clusters = kmeans(&rows, k, LLOYD_STEPS, &mut rng);
        consider(&clusters.labels, Start::KMeans(n));
    }
    if options.time_bins {
        consider(&time_bins(&rows, k), Start::TimeBins);
    }
    best
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
    let mut em = Em::new(data, start.clone());
    em.run(options);
    em.finish(&units, Start::Given)
}

/// EM as the predictor uses it: from labels, in the units of the rows; returns the mixture and the
/// responsibilities (row by row) of the last E step.
pub(super) fn responsibilities<const D: usize>(
    data: &[SVector<f64, D>],
    labels: &[usize],
    options: &EmOptions,
) -> Result<(Vec<f64>, usize), LearnError> {
    check(data, options.components)?;
    let mut em = Em::from_labels(data, labels, options.components, options)?;
    em.run(options);
    let k = em.stride;
    Ok((em.shares, k))
}

fn check<const D: usize>(data: &[SVector<f64, D>], k: usize) -> Result<(), LearnError> {
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

/// The affine map between the data's units and those of the fit.
struct Units<const D: usize> {
    mean: SVector<f64, D>,
    scale: SVector<f64, D>,
}

impl<const D: usize> Units<D> {
    /// A coordinate that does not vary keeps its unit, so that the ridge is its variance.
    fn of(data: &[SVector<f64, D>], standardise: bool) -> Self {
        let mut units = Self {
            mean: SVector::zeros(),
            scale: SVector::repeat(1.0),
        };
        if standardise {
            let n = data.len() as f64;
            units.mean = data.iter().sum::<SVector<f64, D>>() / n;
            for i in 0..D {
                let mean = units.mean[i];
                let variance = data
                    .iter()
                    .map(|x| (x[i] - mean) * (x[i] - mean))
                    .sum::<f64>()
                    / n;
                let deviation = variance.sqrt();
                if deviation > 1e-9 * mean.abs().max(1e-3) {
                    units.scale[i] = deviation;
                }
            }
        }
        units
    }

    fn apply(&self, data: &[SVector<f64, D>]) -> Vec<SVector<f64, D>> {
        data.iter()
            .map(|x| (x - self.mean).component_div(&self.scale))
            .collect()
    }
}

/// The state of one EM run.
struct Em<'a, const D: usize> {
    data: &'a [SVector<f64, D>],
    gmm: Gmm<D>,
    /// Responsibilities of the last E step, `stride` a row.
    shares: Vec<f64>,
    stride: usize,
    /// Log density of each row in the last E step.
    densities: Vec<f64>,
    trace: Vec<f64>,
    iterations: usize,
    converged: bool,
    degenerate: Vec<Degenerate>,
    /// Components (by present index) that have been started again.
    reseeded: Vec<bool>,
}

/// The weighted moments of one component.
struct Moments<const D: usize> {
    n: f64,
    mean: SVector<f64, D>,
    scatter: SMatrix<f64, D, D>,
}

impl<'a, const D: usize> Em<'a, D> {
    fn new(data: &'a [SVector<f64, D>], gmm: Gmm<D>) -> Self {
        let stride = gmm.components().len();
        Self {
            data,
            gmm,
            shares: vec![0.0; data.len() * stride],
            stride,
            densities: vec![0.0; data.len()],
            trace: Vec::new(),
            iterations: 0,
            converged: false,
            degenerate: Vec::new(),
            reseeded: vec![false; stride],
        }
    }

    fn from_labels(
        data: &'a [SVector<f64, D>],
        labels: &[usize],
        k: usize,
        options: &EmOptions,
    ) -> Result<Self, LearnError> {
        let one = Gmm::new([(1.0, SVector::zeros(), SMatrix::identity())])
            .expect("the standard normal is a mixture");
        let mut em = Self::new(data, one);
        em.stride = k;
        em.reseeded = vec![false; k];
        em.shares = vec![0.0; data.len() * k];
        for (row, &label) in em.shares.chunks_exact_mut(k).zip(labels) {
            row[label.min(k - 1)] = 1.0;
        }
        // Distance from the common mean stands in for the density that no E step has found yet.
        let mean = data.iter().sum::<SVector<f64, D>>() / data.len() as f64;
        for (d, x) in em.densities.iter_mut().zip(data) {
            *d = -(x - mean).norm_squared();
        }
        if em.maximise(options) {
            Ok(em)
        } else {
            Err(LearnError::Singular)
        }
    }

    fn run(&mut self, options: &EmOptions) {
        let mut previous = f64::NEG_INFINITY;
        while self.iterations < options.max_iterations {
            let likelihood = self.expect();
            self.trace.push(likelihood);
            self.iterations += 1;
            if !self.maximise(options) {
                break;
            }
            let change = (likelihood - previous).abs();
            let enough = match options.convergence {
                Convergence::Absolute(limit) => limit,
                Convergence::Relative(share) => share * likelihood.abs(),
            };
            if change < enough {
                self.converged = true;
                break;
            }
            previous = likelihood;
        }
    }

    /// The E step; returns the mean log likelihood.
    fn expect(&mut self) -> f64 {
        self.stride = self.gmm.components().len();
        self.shares.resize(self.data.len() * self.stride, 0.0);
        let rows = self.shares.chunks_exact_mut(self.stride);
        let mut sum = 0.0;
        for ((x, shares), density) in self.data.iter().zip(rows).zip(&mut self.densities) {
            *density = self.gmm.responsibilities(x, shares);
            sum += *density;
        }
        sum / self.data.len() as f64
    }

    /// The M step; false if no valid mixture can be formed, and then the last one stays.
    fn maximise(&mut self, options: &EmOptions) -> bool {
        let moments: Vec<_> = (0..self.stride).map(|k| self.moments(k)).collect();
        let total: f64 = moments.iter().map(|m| m.n).sum();
        let tied = moments
            .iter()
            .fold(SMatrix::<f64, D, D>::zeros(), |t, m| t + m.scatter)
            / total;
        let ridge = SMatrix::<f64, D, D>::identity() * options.ridge;
        let mut parts = Vec::with_capacity(self.stride);
        let mut reseeded = Vec::with_capacity(self.stride);
        for (k, m) in moments.iter().enumerate() {
            let covariance =
                (m.scatter + tied * options.shrinkage) / (m.n + options.shrinkage) + ridge;
            let sound = m.n >= EMPTY && Gmm::new([(1.0, m.mean, covariance)]).is_ok();
            if sound {
                parts.push((m.n + options.weight_prior, m.mean, covariance));
                reseeded.push(self.reseeded[k]);
                continue;
            }
            let remedy = if self.reseeded[k] {
                Remedy::Pruned
            } else {
                Remedy::Reseeded
            };
            self.degenerate.push(Degenerate {
                iteration: self.iterations,
                component: k,
                remedy,
            });
            if remedy == Remedy::Reseeded {
                let worst = self.worst_explained();
                parts.push((1.0, self.data[worst], tied + ridge));
                reseeded.push(true);
            }
        }
        let sum: f64 = parts.iter().map(|p| p.0).sum();
        let Ok(gmm) = Gmm::new(parts.into_iter().map(|(w, m, c)| (w / sum, m, c))) else {
            return false;
        };
        self.gmm = gmm;
        self.reseeded = reseeded;
        true
    }

    fn moments(&self, k: usize) -> Moments<D> {
        let shares = || self.shares.iter().skip(k).step_by(self.stride);
        let mut n = 0.0;
        let mut mean = SVector::<f64, D>::zeros();
        for (x, &r) in self.data.iter().zip(shares()) {
            n += r;
            mean += x * r;
        }
        mean /= n.max(f64::MIN_POSITIVE);
        let mut scatter = SMatrix::<f64, D, D>::zeros();
        for (x, &r) in self.data.iter().zip(shares()) {
            if r > NEGLIGIBLE {
                add_outer(&mut scatter, &(x - mean), r);
            }
        }
        mirror(&mut scatter);
        Moments { n, mean, scatter }
    }

    /// The row of lowest density, which is not offered a second time.
    fn worst_explained(&mut self) -> usize {
        let mut worst = 0;
        for (i, d) in self.densities.iter().enumerate() {
            if *d < self.densities[worst] {
                worst = i;
            }
        }
        self.densities[worst] = f64::INFINITY;
        worst
    }

    fn finish(mut self, units: &Units<D>, start: Start) -> Result<Fit<D>, LearnError> {
        let score = self.expect();
        let jacobian: f64 = units.scale.iter().map(|s| s.ln()).sum();
        let scale = SMatrix::<f64, D, D>::from_diagonal(&units.scale);
        let original = Gmm::new(self.gmm.components().iter().map(|c| {
            (
                c.weight(),
                c.mean().component_mul(&units.scale) + units.mean,
                scale * c.covariance() * scale,
            )
        }));
        self.trace.iter_mut().for_each(|l| *l -= jacobian);
        Ok(Fit {
            gmm: original.map_err(|_| LearnError::Singular)?,
            trace: self.trace,
            score: score - jacobian,
            iterations: self.iterations,
            converged: self.converged,
            start,
            degenerate: self.degenerate,
        })
    }
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
