//! One skill, prepared for being recognised.

use nalgebra::{SMatrix, SVector};
use telemime_protocol::predict::{FEATURES, Regression};
use telemime_protocol::skill::Skill;

use super::RecogniseError;
use super::phase::Phases;

type Features = SVector<f64, FEATURES>;
type Square = SMatrix<f64, FEATURES, FEATURES>;

/// "Anywhere" in numbers, m: so far beyond any hand that the position says nothing, and still well
/// conditioned.
const ANYWHERE_M: f64 = 1e3;

/// One Gaussian over the standardised features.
#[derive(Debug, Clone)]
struct Part {
    mean: Features,
    /// L⁻¹ of its covariance's Cholesky factor: a product has no divisions to wait for.
    whiten: Square,
    /// ln π − Σ ln Lᵢᵢ − Σ ln scaleᵢ, so that densities of different skills compare.
    log_scale: f64,
}

/// A skill as a density over the hand's states, with its phases.
#[derive(Debug, Clone)]
pub(super) struct Known {
    mean: Features,
    per_scale: Features,
    parts: Vec<Part>,
    /// The d² that one sample in ten of a held-out performance exceeds.
    edge: f64,
    phases: Phases,
}

impl Known {
    /// The predictor's mixture with the place blurred: `C ← C + diag(σ²/scale², 0, …)`.
    ///
    /// Blurring lowers every d², so the edge has to follow. Of samples of component k the mean of d² is
    /// `tr((C + P)⁻¹C)` where it was [`FEATURES`]; the edge is lowered by the weighted mean of that ratio.
    pub(super) fn new(skill: &Skill, place_sd_m: f64) -> Result<Self, RecogniseError> {
        let model = skill.predictor();
        let units = model.standardisation();
        let sd_m = place_sd_m.min(ANYWHERE_M);
        let mut place = Features::zeros();
        for i in 0..3 {
            place[i] = (sd_m / units.scale[i]).powi(2);
        }
        let log_units: f64 = units.scale.iter().map(|s| s.ln()).sum();
        let mut parts = Vec::with_capacity(model.components().len());
        let (mut share, mut total) = (0.0, 0.0);
        for (component, c) in model.components().iter().enumerate() {
            let (part, expected) =
                part(c, &place, log_units).ok_or_else(|| RecogniseError::Singular {
                    name: skill.name().to_owned(),
                    component,
                })?;
            parts.push(part);
            share += c.weight * expected / FEATURES as f64;
            total += c.weight;
        }
        let phases =
            Phases::new(skill, units, sd_m).map_err(|source| RecogniseError::Motion {
                name: skill.name().to_owned(),
                source,
            })?;
        Ok(Self {
            mean: units.mean,
            per_scale: units.scale.map(|s| 1.0 / s),
            parts,
            edge: model.calibration().novelty90 * share / total,
            phases,
        })
    }

    /// ln p(f) up to a constant that all skills share, and d² to the nearest component over the edge.
    pub(super) fn judge(&self, f: &Features) -> (f64, f64) {
        let z = (f - self.mean).component_mul(&self.per_scale);
        let mut nearest = f64::INFINITY;
        // Log-sum-exp in one pass, the largest term so far kept at 1.
        let (mut most, mut sum) = (f64::NEG_INFINITY, 0.0);
        for p in &self.parts {
            let d2 = p.distance2(&z);
            nearest = nearest.min(d2);
            let l = p.log_scale - 0.5 * d2;
            if l > most {
                sum = sum * (most - l).exp() + 1.0;
                most = l;
            } else if l > f64::NEG_INFINITY {
                sum += (l - most).exp();
            }
        }
        let log_density = if sum > 0.0 { most + sum.ln() } else { most };
        (log_density, nearest / self.edge)
    }

    /// Moves on the belief about the phase by `dt_s` and weighs it with the features.
    pub(super) fn progress(&mut self, f: &Features, dt_s: f64, weight: f64) {
        self.phases.take(f, dt_s, weight);
    }

    /// Mean and standard deviation of the phase, in [0, 1].
    pub(super) fn phase(&self) -> (f64, f64) {
        self.phases.estimate()
    }

    pub(super) fn reset(&mut self) {
        self.phases.reset();
    }
}

impl Part {
    fn distance2(&self, z: &Features) -> f64 {
        let d = z - self.mean;
        let mut e = [0.0; FEATURES];
        // Down the columns of the lower triangle: contiguous, and half of the full product.
        for (j, (column, d)) in self.whiten.column_iter().zip(d.iter()).enumerate() {
            for (e, w) in e[j..].iter_mut().zip(&column.as_slice()[j..]) {
                *e += w * d;
            }
        }
        e.iter().map(|e| e * e).sum()
    }
}

/// The part for one component, and the mean of d² over samples of the component as it was.
fn part(c: &Regression, place: &Features, log_units: f64) -> Option<(Part, f64)> {
    let covariance = c.factor * c.factor.transpose();
    let blurred = covariance + Square::from_diagonal(place);
    let cholesky = blurred.cholesky()?;
    let factor = cholesky.l();
    let whiten = factor.solve_lower_triangular(&Square::identity())?;
    let log_det: f64 = factor.diagonal().iter().map(|l| l.ln()).sum();
    let expected = cholesky.solve(&covariance).trace();
    let log_scale = c.weight.ln() - log_det - log_units;
    let usable = log_scale.is_finite() && expected > 0.0 && whiten.iter().all(|v| v.is_finite());
    usable.then_some((
        Part {
            mean: c.mean,
            whiten,
            log_scale,
        },
        expected,
    ))
}
