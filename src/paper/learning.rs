//! The publication's learning block: a mixture over (t, x1, x2), regressed on time.

use nalgebra::{Vector1, Vector2, Vector3};
use telemime_operator::learn::em::{self, EmOptions};
use telemime_operator::learn::select;
use telemime_operator::learn::variational::{self, VariationalOptions};
use telemime_protocol::skill::{Gmm, Gmr};

use super::Series;
use super::task::times;

/// Components in the publication.
pub(super) const PUBLISHED_K: usize = 3;

/// A motion inferred from demonstrations, one value for each instant of theirs.
#[derive(Clone, Debug)]
pub(super) struct Inferred {
    /// Components of the mixture.
    pub(super) components: usize,
    /// The regression's mean.
    pub(super) motion: Series,
}

/// Seeds of the publication's method that are tried: its own is not known.
pub(super) const SEEDS: u64 = 20;

/// The publication's learning block: a variational mixture of three components at scikit-learn's
/// defaults (Dirichlet process of concentration 1/K, tolerance 10⁻³), k-means start; one for each seed.
///
/// In a Dirichlet process the order of the components matters, and the start decides it: each of the six
/// orders has an optimum of its own.
pub(super) fn published(demonstrations: &[Series]) -> anyhow::Result<Vec<Inferred>> {
    let rows = rows(demonstrations);
    (0..SEEDS)
        .map(|seed| {
            let options = VariationalOptions {
                components: PUBLISHED_K,
                seed,
                ..VariationalOptions::default()
            };
            regressed(&variational::fit(&rows, &options)?.gmm, demonstrations)
        })
        .collect()
}

/// The mean of the demonstrations: what a model of all of them tends to.
pub(super) fn ceiling(demonstrations: &[Series]) -> Series {
    let count = demonstrations.len() as f64;
    let instants = demonstrations.first().map_or(0, Vec::len);
    (0..instants)
        .map(|i| demonstrations.iter().map(|d| d[i]).sum::<Vector2<f64>>() / count)
        .collect()
}

/// Plain EM with the publication's three components.
pub(super) fn three_components(demonstrations: &[Series]) -> anyhow::Result<Inferred> {
    let options = EmOptions {
        components: PUBLISHED_K,
        ..options()
    };
    let fit = em::fit(&rows(demonstrations), &options)?;
    regressed(&fit.gmm, demonstrations)
}

/// Plain EM with as many components as the Bayesian information criterion asks for.
pub(super) fn chosen_components(demonstrations: &[Series]) -> anyhow::Result<Inferred> {
    let selection = select::select(&rows(demonstrations), 2..=12, 3, &options(), |_| {})?;
    regressed(&selection.best.gmm, demonstrations)
}

/// The publication's ridge, 10⁻⁶ in the data's own units: x1 *is* t, so the data span no volume.
fn options() -> EmOptions {
    EmOptions {
        standardise: false,
        ridge: 1e-6,
        max_iterations: 500,
        restarts: 24,
        ..EmOptions::default()
    }
}

fn rows(demonstrations: &[Series]) -> Vec<Vector3<f64>> {
    let each = |demonstration: &Series| {
        let t = times(demonstration.len());
        let rows = t.into_iter().zip(demonstration);
        rows.map(|(t, x)| Vector3::new(t, x.x, x.y))
            .collect::<Vec<_>>()
    };
    demonstrations.iter().flat_map(each).collect()
}

fn regressed(gmm: &Gmm<3>, demonstrations: &[Series]) -> anyhow::Result<Inferred> {
    let gmr = Gmr::<1, 2>::new(gmm)?;
    let instants = demonstrations.first().map_or(2, Vec::len);
    Ok(Inferred {
        components: gmm.components().len(),
        motion: times(instants)
            .into_iter()
            .map(|t| gmr.query(&Vector1::new(t)).mean)
            .collect(),
    })
}
