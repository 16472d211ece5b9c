//! The publication's learning block: a mixture over (t, x1, x2), regressed on time.

use nalgebra::{Vector1, Vector3};
use telemime_operator::learn::em::{self, EmOptions};
use telemime_operator::learn::select;
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

/// Plain EM with the publication's three components. (It used a variational mixture.)
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
