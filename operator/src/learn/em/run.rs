//! One run of EM from one start.

use nalgebra::{SMatrix, SVector};
use telemime_protocol::skill::Gmm;

use super::pass::{Kernel, Sums, Tiles, pass};
use super::units::Units;
use super::{
    Convergence, Covariance, Degenerate, EmOptions, Fit, Remedy, Start, add_outer, mirror,
};
use crate::learn::LearnError;

/// A component that explains less than this many samples is empty.
const EMPTY: f64 = 1e-3;

/// A mean that has moved by more than the root of this many variances has cost the centred sums so much
/// precision that they are taken again about the new one.
const MOVED: f64 = 1e6;

/// The state of one EM run.
pub(super) struct Em<'a, const D: usize> {
    data: &'a [SVector<f64, D>],
    tiles: &'a Tiles<D>,
    gmm: Gmm<D>,
    /// The mixture of the last E step.
    seen: Option<Gmm<D>>,
    trace: Vec<f64>,
    iterations: usize,
    converged: bool,
    degenerate: Vec<Degenerate>,
    /// Shrunk in the last M step.
    shrunk: Vec<Degenerate>,
    /// Components (by present index) that have been started again.
    reseeded: Vec<bool>,
}

/// The weighted moments of one component.
#[derive(Clone)]
pub(in crate::learn) struct Moments<const D: usize> {
    pub(in crate::learn) n: f64,
    pub(in crate::learn) mean: SVector<f64, D>,
    pub(in crate::learn) scatter: SMatrix<f64, D, D>,
}

impl<const D: usize> Moments<D> {
    /// From sums about `reference`.
    pub(in crate::learn) fn of(sums: &Sums<D>, reference: &SVector<f64, D>) -> Self {
        let shift = sums.first / sums.n.max(f64::MIN_POSITIVE);
        let mut scatter = sums.second;
        add_outer(&mut scatter, &shift, -sums.n);
        mirror(&mut scatter);
        Self {
            n: sums.n,
            mean: reference + shift,
            scatter,
        }
    }

    fn has_moved(&self, reference: &SVector<f64, D>, ridge: f64) -> bool {
        self.n >= EMPTY
            && (0..D).any(|i| {
                let moved = self.mean[i] - reference[i];
                moved * moved > MOVED * (self.scatter[(i, i)] / self.n + ridge)
            })
    }
}

/// The moments of every component under the mixture's own responsibilities, and Σ ln p(x).
pub(super) fn moments<const D: usize>(
    tiles: &Tiles<D>,
    gmm: &Gmm<D>,
    ridge: f64,
) -> (f64, Vec<Moments<D>>) {
    let kernels = Kernel::of(gmm);
    let found = pass(tiles, &kernels, None);
    let references: Vec<_> = gmm.components().iter().map(|c| *c.mean()).collect();
    let about = |sums: &[Sums<D>], references: &[SVector<f64, D>]| -> Vec<Moments<D>> {
        sums.iter()
            .zip(references)
            .map(|(s, r)| Moments::of(s, r))
            .collect()
    };
    let moments = about(&found.sums, &references);
    let moved = moments
        .iter()
        .zip(&references)
        .any(|(m, r)| m.has_moved(r, ridge));
    if !moved {
        return (found.log_likelihood, moments);
    }
    let means: Vec<_> = moments.iter().map(|m| m.mean).collect();
    let again = pass(tiles, &kernels, Some(&means));
    (found.log_likelihood, about(&again.sums, &means))
}

/// Σ r(x−μ)(x−μ)ᵀ of all components over all samples.
pub(super) fn pooled<const D: usize>(moments: &[Moments<D>]) -> SMatrix<f64, D, D> {
    let total: f64 = moments.iter().map(|m| m.n).sum();
    let sum = moments
        .iter()
        .fold(SMatrix::<f64, D, D>::zeros(), |t, m| t + m.scatter);
    sum / total
}

/// The covariance of one component, before the ridge, and the pooled one's share if it is shrunk.
pub(super) fn covariance<const D: usize>(
    m: &Moments<D>,
    tied: &SMatrix<f64, D, D>,
    options: &EmOptions,
) -> (SMatrix<f64, D, D>, Option<f64>) {
    if options.covariance == Covariance::Tied {
        return (*tied, None);
    }
    let pooled = options.shrinkage;
    let mut c = (m.scatter + tied * pooled) / (m.n + pooled);
    let mut share = None;
    if options.shrink_small && pooled == 0.0 && m.n < (D + 1) as f64 {
        let rho = oas_share(&c, m.n);
        c = c * (1.0 - rho) + tied * rho;
        share = Some(rho);
    }
    if options.covariance == Covariance::Diagonal {
        c = SMatrix::from_diagonal(&c.diagonal());
    }
    (c, share)
}

/// Chen, Wiesel, Eldar & Hero 2010, eq. (23).
fn oas_share<const D: usize>(s: &SMatrix<f64, D, D>, n: f64) -> f64 {
    let d = D as f64;
    let square = s.norm_squared();
    let trace = s.trace() * s.trace();
    let spread = (n + 1.0 - 2.0 / d) * (square - trace / d);
    if spread > 0.0 {
        (((1.0 - 2.0 / d) * square + trace) / spread).clamp(0.0, 1.0)
    } else {
        1.0
    }
}

impl<'a, const D: usize> Em<'a, D> {
    pub(super) fn new(data: &'a [SVector<f64, D>], tiles: &'a Tiles<D>, gmm: Gmm<D>) -> Self {
        let reseeded = vec![false; gmm.components().len()];
        Self {
            data,
            tiles,
            gmm,
            seen: None,
            trace: Vec::new(),
            iterations: 0,
            converged: false,
            degenerate: Vec::new(),
            shrunk: Vec::new(),
            reseeded,
        }
    }

    pub(super) fn from_labels(
        data: &'a [SVector<f64, D>],
        tiles: &'a Tiles<D>,
        labels: &[usize],
        options: &EmOptions,
    ) -> Result<Self, LearnError> {
        let k = options.components;
        let one = Gmm::new([(1.0, SVector::zeros(), SMatrix::identity())])
            .expect("the standard normal is a mixture");
        let mut em = Self::new(data, tiles, one);
        em.reseeded = vec![false; k];
        let moments = of_labels(data, |row| tiles.weight(row), labels, k);
        // Distance from the common mean stands in for the density that no E step has found yet.
        let mean = data.iter().sum::<SVector<f64, D>>() / data.len() as f64;
        let densities = || data.iter().map(|x| -(x - mean).norm_squared()).collect();
        if em.maximise(&moments, densities, options) {
            Ok(em)
        } else {
            Err(LearnError::Singular)
        }
    }

    /// The mixture of the last E step; the present one if there was none.
    pub(super) fn seen(&self) -> &Gmm<D> {
        self.seen.as_ref().unwrap_or(&self.gmm)
    }

    pub(super) fn run(&mut self, options: &EmOptions) {
        let mut previous = f64::NEG_INFINITY;
        while self.iterations < options.max_iterations {
            let (sum, moments) = moments(self.tiles, &self.gmm, options.ridge);
            let likelihood = sum / self.tiles.rows() as f64;
            self.trace.push(likelihood);
            self.iterations += 1;
            let before = self.gmm.clone();
            let data = self.data;
            let densities = || data.iter().map(|x| before.log_density(x)).collect();
            let formed = self.maximise(&moments, densities, options);
            self.seen = Some(before);
            if !formed {
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

    /// The M step; false if no valid mixture can be formed, and then the last one stays. `densities`
    /// tells how well each row is explained, for components that start again.
    fn maximise(
        &mut self,
        moments: &[Moments<D>],
        densities: impl Fn() -> Vec<f64>,
        options: &EmOptions,
    ) -> bool {
        let tied = pooled(moments);
        let ridge = SMatrix::<f64, D, D>::identity() * options.ridge;
        let mut parts = Vec::with_capacity(moments.len());
        let mut reseeded = Vec::with_capacity(moments.len());
        let mut known: Option<Vec<f64>> = None;
        self.shrunk.clear();
        for (k, m) in moments.iter().enumerate() {
            let (covariance, share) = covariance(m, &tied, options);
            let covariance = covariance + ridge;
            if m.n >= EMPTY && Gmm::new([(1.0, m.mean, covariance)]).is_ok() {
                if let Some(share) = share {
                    self.shrunk.push(Degenerate::Shrunk {
                        component: parts.len(),
                        samples: m.n,
                        share,
                    });
                }
                parts.push((m.n + options.weight_prior, m.mean, covariance));
                reseeded.push(self.reseeded[k]);
                continue;
            }
            let remedy = if self.reseeded[k] {
                Remedy::Pruned
            } else {
                Remedy::Reseeded
            };
            self.degenerate.push(Degenerate::Died {
                iteration: self.iterations,
                component: k,
                remedy,
            });
            if remedy == Remedy::Reseeded {
                let worst = take_worst(known.get_or_insert_with(&densities));
                let mut wide = tied;
                if options.covariance == Covariance::Diagonal {
                    wide = SMatrix::from_diagonal(&wide.diagonal());
                }
                parts.push((1.0, self.data[worst], wide + ridge));
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

    pub(super) fn finish(
        mut self,
        units: &Units<D>,
        start: Start,
        options: &EmOptions,
    ) -> Result<Fit<D>, LearnError> {
        let kernels = Kernel::of(&self.gmm);
        let score = pass(self.tiles, &kernels, None).log_likelihood / self.tiles.rows() as f64;
        let jacobian = units.log_jacobian();
        self.trace.iter_mut().for_each(|l| *l -= jacobian);
        let constant = units.constant.iter();
        self.degenerate
            .extend(constant.map(|&axis| Degenerate::Constant { axis }));
        for axis in (0..D).filter(|axis| !units.constant.contains(axis)) {
            let floored = |f: &SMatrix<f64, D, D>| f[(axis, axis)].powi(2) < 2.0 * options.ridge;
            let components = self.gmm.components().iter();
            let components = components.filter(|c| floored(c.factor())).count();
            if components > 0 {
                self.degenerate
                    .push(Degenerate::Floored { axis, components });
            }
        }
        self.degenerate.append(&mut self.shrunk);
        Ok(Fit {
            gmm: units.restore(&self.gmm)?,
            trace: self.trace,
            score: score - jacobian,
            iterations: self.iterations,
            converged: self.converged,
            start,
            degenerate: self.degenerate,
        })
    }
}

/// The row of lowest density, which is not offered a second time.
fn take_worst(densities: &mut [f64]) -> usize {
    let mut worst = 0;
    for (i, d) in densities.iter().enumerate() {
        if *d < densities[worst] {
            worst = i;
        }
    }
    densities[worst] = f64::INFINITY;
    worst
}

/// Moments of groups of rows, each counted as its weight says, centred on the groups' own means. A label of K or
/// more means K − 1.
pub(in crate::learn) fn of_labels<const D: usize>(
    data: &[SVector<f64, D>],
    weight: impl Fn(usize) -> f64,
    labels: &[usize],
    k: usize,
) -> Vec<Moments<D>> {
    let zero = Moments {
        n: 0.0,
        mean: SVector::zeros(),
        scatter: SMatrix::zeros(),
    };
    let mut groups = vec![zero; k];
    let group = |&label: &usize| label.min(k - 1);
    for (row, (x, label)) in data.iter().zip(labels).enumerate() {
        let g = &mut groups[group(label)];
        let w = weight(row);
        g.n += w;
        g.mean += x * w;
    }
    for g in &mut groups {
        g.mean /= g.n.max(f64::MIN_POSITIVE);
    }
    for (row, (x, label)) in data.iter().zip(labels).enumerate() {
        let g = &mut groups[group(label)];
        let e = x - g.mean;
        add_outer(&mut g.scatter, &e, weight(row));
    }
    for g in &mut groups {
        mirror(&mut g.scatter);
    }
    groups
}
