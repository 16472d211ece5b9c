//! New rows refine a mixture without the rows it was learned from.

use nalgebra::SVector;
use telemime_protocol::skill::Gmm;

use super::pass::Tiles;
use super::run::{Moments, covariance, moments, pooled};
use super::{Convergence, EmOptions, add_outer, check};
use crate::learn::LearnError;

/// A refined mixture.
#[derive(Debug, Clone, PartialEq)]
pub struct Updated<const D: usize> {
    /// The mixture.
    pub gmm: Gmm<D>,
    /// The samples it now stands for: those before and the new ones.
    pub effective_samples: f64,
    /// After each iteration's E step: Σ ln p over the new rows, and of the old mixture's groups (nats).
    pub trace: Vec<f64>,
}

/// Continues EM from `gmm`, which stands for `effective_samples` samples no longer at hand, with new rows.
///
/// Each old component is a *group* of `n_j` samples with its mean m_j and covariance S_j, all of the same
/// origin (Vasconcelos & Lippman 1998, eq. 8–13): its responsibilities are
/// `h_jk ∝ [π_k·N(m_j; μ_k, Σ_k)·exp(−½·tr(Σ_k⁻¹S_j))]^{n_j}`, those of a row the usual ones. The M step
/// takes the moments of both together, so the likelihood of rows and groups never falls. To forget what
/// is old, say fewer effective samples than there were.
///
/// `max_iterations`, `convergence` (of the change a sample), `ridge`, `covariance` and `shrink_small` of the
/// options apply, in the data's units. The ridge is added once in a mixture's life: what the old
/// covariances hold of it is not added again.
///
/// # Errors
/// [`LearnError`]: rows beyond ±10¹² or not finite, `effective_samples` not positive and finite, or a
/// covariance that is singular.
pub fn update<const D: usize>(
    gmm: &Gmm<D>,
    effective_samples: f64,
    new_rows: &[SVector<f64, D>],
    options: &EmOptions,
) -> Result<Updated<D>, LearnError> {
    if !(effective_samples > 0.0 && effective_samples.is_finite()) {
        return Err(LearnError::EffectiveSamples {
            found: effective_samples,
        });
    }
    let total = effective_samples + new_rows.len() as f64;
    if new_rows.is_empty() {
        return Ok(Updated {
            gmm: gmm.clone(),
            effective_samples,
            trace: Vec::new(),
        });
    }
    check_rows(new_rows)?;
    let tiles = Tiles::new(new_rows);
    let groups: Vec<Moments<D>> = gmm
        .components()
        .iter()
        .map(|c| {
            let n = c.weight() * effective_samples;
            Moments {
                n,
                mean: *c.mean(),
                scatter: (c.covariance() - ridge_of(c.covariance(), options.ridge)) * n,
            }
        })
        .collect();
    let mut now = gmm.clone();
    let mut trace = Vec::new();
    let mut previous = f64::NEG_INFINITY;
    while trace.len() < options.max_iterations {
        let (rows, mut parts) = moments(&tiles, &now, options.ridge);
        let likelihood = rows + join(&groups, &now, &mut parts);
        trace.push(likelihood);
        now = maximise(&parts, options)?;
        let change = (likelihood - previous).abs() / total;
        let enough = match options.convergence {
            Convergence::Absolute(limit) => limit,
            Convergence::Relative(share) => share * likelihood.abs() / total,
        };
        if change < enough {
            break;
        }
        previous = likelihood;
    }
    Ok(Updated {
        gmm: now,
        effective_samples: total,
        trace,
    })
}

fn check_rows<const D: usize>(rows: &[SVector<f64, D>]) -> Result<(), LearnError> {
    match check(rows, 1) {
        // A single new row is enough: the mixture is there already.
        Err(LearnError::TooFewRows { .. }) => check(&[rows[0], rows[0]], 1),
        other => other,
    }
}

/// As much of the ridge as every direction of a covariance holds.
fn ridge_of<const D: usize>(
    covariance: &nalgebra::SMatrix<f64, D, D>,
    ridge: f64,
) -> nalgebra::SMatrix<f64, D, D> {
    let identity = nalgebra::SMatrix::<f64, D, D>::identity();
    let holds = |share: &f64| {
        (covariance - identity * (ridge * share))
            .cholesky()
            .is_some()
    };
    let share = [0.999, 0.5, 0.25, 0.1].into_iter().find(holds);
    identity * (ridge * share.unwrap_or(0.0))
}

/// Adds each group to the components that are responsible for it; returns the groups' log likelihood.
fn join<const D: usize>(groups: &[Moments<D>], gmm: &Gmm<D>, to: &mut [Moments<D>]) -> f64 {
    let mut sum = 0.0;
    for group in groups {
        // ln of the bracket, one a component, times the size of the group.
        let mut l: Vec<f64> = gmm
            .components()
            .iter()
            .map(|c| {
                let spread = group.scatter / group.n;
                let inverse = nalgebra::Cholesky::pack_dirty(*c.factor());
                let apart = c.weighted_log_density(&group.mean);
                group.n * (apart - 0.5 * inverse.solve(&spread).trace())
            })
            .collect();
        let max = l.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        l.iter_mut().for_each(|v| *v = (*v - max).exp());
        let all: f64 = l.iter().sum();
        sum += max + all.ln();
        for (m, share) in to.iter_mut().zip(&l) {
            let n = group.n * share / all;
            if n > 0.0 {
                add(m, n, group);
            }
        }
    }
    sum
}

/// Moments of both together (the parallel-axis rule).
fn add<const D: usize>(to: &mut Moments<D>, n: f64, group: &Moments<D>) {
    let total = to.n + n;
    let apart = group.mean - to.mean;
    to.scatter += group.scatter * (n / group.n);
    let mut outer = nalgebra::SMatrix::zeros();
    add_outer(&mut outer, &apart, to.n * n / total);
    super::mirror(&mut outer);
    to.scatter += outer;
    to.mean += apart * (n / total);
    to.n = total;
}

fn maximise<const D: usize>(
    parts: &[Moments<D>],
    options: &EmOptions,
) -> Result<Gmm<D>, LearnError> {
    let tied = pooled(parts);
    let ridge = nalgebra::SMatrix::<f64, D, D>::identity() * options.ridge;
    // A component for which nobody is responsible any more goes.
    let alive: Vec<_> = parts.iter().filter(|m| m.n >= 1e-9).collect();
    let sum: f64 = alive.iter().map(|m| m.n).sum();
    Gmm::new(alive.into_iter().map(|m| {
        let (covariance, _) = covariance(m, &tied, options);
        (m.n / sum, m.mean, covariance + ridge)
    }))
    .map_err(|_| LearnError::Singular)
}
