//! One mixture over everything, or one for each dimension: what a row of the table fits.

use nalgebra::{Matrix3, SMatrix, SVector, Vector1, Vector2, Vector3, Vector4};
use telemime_protocol::skill::{Gmm, Gmr};

use super::{Family, Kind, Method};
use crate::learn::LearnError;
use crate::learn::em::{self, Covariance, Degenerate, EmOptions};
use crate::learn::motion::normal_log_density;
use crate::learn::variational::{self, VariationalOptions, WeightPrior};

enum Density {
    Joint(Gmm<4>),
    Each([(Gmm<2>, Gmm<1>); 3]),
}

/// A fitted row.
pub(super) struct Model {
    density: Density,
    /// Components in use, of each mixture.
    used: Vec<usize>,
    pub(super) degenerate: Vec<Degenerate>,
}

/// The regression of position on time.
pub(super) enum Regression {
    Joint(Gmr<1, 3>),
    Each([Gmr<1, 1>; 3]),
}

struct Fitted<const D: usize> {
    gmm: Gmm<D>,
    used: usize,
    degenerate: Vec<Degenerate>,
}

fn fit<const D: usize>(
    rows: &[SVector<f64, D>],
    kind: Kind,
    components: usize,
    seed: u64,
) -> Result<Fitted<D>, LearnError> {
    let weights = match kind.method {
        Method::Em => {
            let options = EmOptions {
                components,
                covariance: kind.covariance,
                max_iterations: 200,
                standardise: false,
                restarts: 2,
                seed,
                ..EmOptions::default()
            };
            let fit = em::fit(rows, &options)?;
            return Ok(Fitted {
                used: fit.gmm.components().len(),
                gmm: fit.gmm,
                degenerate: fit.degenerate,
            });
        }
        Method::Dirichlet => WeightPrior::Distribution,
        Method::Process => WeightPrior::Process,
    };
    let options = VariationalOptions {
        components,
        weights,
        max_iterations: 200,
        restarts: 2,
        seed,
        ..VariationalOptions::default()
    };
    let fit = variational::fit(rows, &options)?;
    Ok(Fitted {
        used: fit.effective_components(),
        gmm: fit.gmm,
        degenerate: fit.degenerate,
    })
}

impl Model {
    pub(super) fn fit(
        rows: &[Vector4<f64>],
        kind: Kind,
        components: usize,
        seed: u64,
    ) -> Result<Self, LearnError> {
        match kind.family {
            Family::Joint => {
                let fit = fit(rows, kind, components, seed)?;
                Ok(Self {
                    density: Density::Joint(fit.gmm),
                    used: vec![fit.used],
                    degenerate: fit.degenerate,
                })
            }
            Family::PerDimension => {
                let each = |d: usize| {
                    let rows: Vec<_> = rows
                        .iter()
                        .map(|row| Vector2::new(row[0], row[d + 1]))
                        .collect();
                    fit(&rows, kind, components, seed)
                };
                let [x, y, z] = [each(0)?, each(1)?, each(2)?];
                let used = vec![x.used, y.used, z.used];
                let degenerate = [&x, &y, &z]
                    .into_iter()
                    .flat_map(|f| f.degenerate.iter().copied())
                    .collect();
                let marginal = |f: Fitted<2>| {
                    let of_time = time(&f.gmm)?;
                    Ok::<_, LearnError>((f.gmm, of_time))
                };
                Ok(Self {
                    density: Density::Each([marginal(x)?, marginal(y)?, marginal(z)?]),
                    used,
                    degenerate,
                })
            }
        }
    }

    /// Mean log density of rows.
    pub(super) fn score(&self, rows: &[Vector4<f64>]) -> f64 {
        let density = |row: &Vector4<f64>| match &self.density {
            Density::Joint(gmm) => gmm.log_density(row),
            Density::Each(each) => each
                .iter()
                .enumerate()
                .map(|(d, (gmm, of_time))| {
                    gmm.log_density(&Vector2::new(row[0], row[d + 1]))
                        - 2.0 / 3.0 * of_time.log_density(&Vector1::new(row[0]))
                })
                .sum(),
        };
        rows.iter().map(density).sum::<f64>() / rows.len() as f64
    }

    pub(super) fn effective(&self) -> usize {
        self.used.iter().sum()
    }

    fn dimensions(&self) -> usize {
        match self.density {
            Density::Joint(_) => 4,
            Density::Each(_) => 2,
        }
    }

    pub(super) fn parameters(&self, covariance: Covariance) -> usize {
        let d = self.dimensions();
        self.used
            .iter()
            .map(|k| covariance.parameters((*k).max(1), d))
            .sum()
    }

    /// Free numbers of weights and means.
    pub(super) fn means(&self) -> usize {
        let d = self.dimensions();
        self.used
            .iter()
            .map(|k| (k + k * d).saturating_sub(1))
            .sum()
    }

    pub(super) fn regression(&self) -> Result<Regression, LearnError> {
        let singular = |_| LearnError::Singular;
        Ok(match &self.density {
            Density::Joint(gmm) => Regression::Joint(Gmr::new(gmm).map_err(singular)?),
            Density::Each([x, y, z]) => {
                let gmr = |each: &(Gmm<2>, Gmm<1>)| Gmr::new(&each.0).map_err(singular);
                Regression::Each([gmr(x)?, gmr(y)?, gmr(z)?])
            }
        })
    }
}

/// The marginal of time.
fn time(gmm: &Gmm<2>) -> Result<Gmm<1>, LearnError> {
    Gmm::new(gmm.components().iter().map(|c| {
        (
            c.weight(),
            Vector1::new(c.mean().x),
            SMatrix::from([[c.covariance().m11]]),
        )
    }))
    .map_err(|_| LearnError::Singular)
}

impl Regression {
    fn at(&self, t: f64) -> (Vector3<f64>, Matrix3<f64>) {
        let t = Vector1::new(t);
        match self {
            Self::Joint(gmr) => {
                let at = gmr.query(&t);
                (at.mean, at.covariance)
            }
            Self::Each(each) => {
                let [x, y, z] = each.each_ref().map(|gmr| gmr.query(&t));
                let variances = Vector3::new(x.covariance.x, y.covariance.x, z.covariance.x);
                (
                    Vector3::new(x.mean.x, y.mean.x, z.mean.x),
                    Matrix3::from_diagonal(&variances),
                )
            }
        }
    }

    pub(super) fn mean(&self, t: f64) -> Vector3<f64> {
        self.at(t).0
    }

    /// Mean log density of the rows' positions, each a normal position at its time.
    pub(super) fn score(&self, rows: &[Vector4<f64>]) -> Result<f64, LearnError> {
        let mut sum = 0.0;
        for row in rows {
            let (mean, covariance) = self.at(row[0]);
            let error = row.fixed_rows::<3>(1) - mean;
            sum += normal_log_density(&error, &covariance).ok_or(LearnError::Singular)?;
        }
        Ok(sum / rows.len() as f64)
    }
}
