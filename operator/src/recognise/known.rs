//! One skill, prepared for being recognised.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};
use telemime_protocol::predict::{
    BENT, FEATURES, KNOT_SPACING_S, Regression, Standardisation, TEMPER,
};
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;

use super::RecogniseError;
use super::foretold::Foretold;
use super::phase::Phases;
use crate::learn::trial::CHI2_3_90;

type Features = SVector<f64, FEATURES>;
type Square = SMatrix<f64, FEATURES, FEATURES>;

/// "Anywhere" in numbers, m: so far beyond any hand that the position says nothing, and still well
/// conditioned.
const ANYWHERE_M: f64 = 1e3;

/// The knot (from 1) whose prediction is held against what came: 200 ms. Nearer ones foretell any motion
/// well, farther ones come too late.
const KNOT: usize = 6;

/// A component with less of the responsibility than this predicts nothing.
const NEGLIGIBLE: f64 = 1e-9;

/// What the features and what the prediction's error contribute to the novelty. The first alone refuses 91 % of gestures
/// left out of learning, the second alone 90 %, together 95 %, where 5 % of known ones are refused.
const SHARES: [f64; 2] = [0.7, 0.3];

/// Beyond this a sample is strange enough; more would only be remembered longer.
const STRANGEST: f64 = 4.0;

/// One Gaussian over the standardised features, and the displacements to [`KNOT`] that follow from them.
#[derive(Debug, Clone)]
struct Part {
    mean: Features,
    /// L⁻¹ of its covariance's Cholesky factor: a product has no divisions to wait for.
    whiten: Square,
    /// ln π − Σ ln Lᵢᵢ − Σ ln scaleᵢ, so that densities of different skills compare.
    log_scale: f64,
    target: Vector3<f64>,
    gain: SMatrix<f64, 3, FEATURES>,
    residual: Matrix3<f64>,
}

/// A skill as a density over the hand's states, with its phases.
#[derive(Debug, Clone)]
pub(super) struct Known {
    units: Standardisation,
    per_scale: Features,
    parts: Vec<Part>,
    /// The d² that one sample in ten of a held-out performance exceeds.
    edge: f64,
    ahead_s: f64,
    /// The NEES of the prediction that one in ten on held-out performances exceeds.
    error_edge: f64,
    foretold: Foretold,
    phases: Phases,
    /// ln(π_k·N_k) of every component at the sample in hand.
    logs: Vec<f64>,
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
        let knot = KNOT.min(model.knots()) - 1;
        for (component, c) in model.components().iter().enumerate() {
            let (part, expected) =
                part(c, knot, &place, log_units).ok_or_else(|| RecogniseError::Singular {
                    name: skill.name().to_owned(),
                    component,
                })?;
            parts.push(part);
            share += c.weight * expected / FEATURES as f64;
            total += c.weight;
        }
        let phases = Phases::new(skill, units, sd_m).map_err(|source| RecogniseError::Motion {
            name: skill.name().to_owned(),
            source,
        })?;
        Ok(Self {
            units: units.clone(),
            per_scale: units.scale.map(|s| 1.0 / s),
            logs: vec![0.0; parts.len()],
            parts,
            edge: model.calibration().novelty90 * share / total,
            ahead_s: (knot + 1) as f64 * KNOT_SPACING_S,
            error_edge: model.calibration().covariance[knot] * CHI2_3_90,
            foretold: Foretold::default(),
            phases,
        })
    }

    /// ln p(f) up to a constant that all skills share, and how strange the sample is.
    ///
    /// Strange is a state far from every component, and a position far from where the states of 200 ms ago
    /// would have had the hand by now.
    pub(super) fn judge(&mut self, t: Stamp, f: &Features) -> (f64, f64) {
        let bent = self.units.bent(*f);
        let z = (bent - self.units.mean).component_mul(&self.per_scale);
        let mut nearest = f64::INFINITY;
        let mut most = f64::NEG_INFINITY;
        for (l, p) in self.logs.iter_mut().zip(&self.parts) {
            let d2 = p.distance2(&z);
            nearest = nearest.min(d2);
            *l = p.log_scale - 0.5 * d2;
            most = most.max(*l);
        }
        let here = (nearest / self.edge).min(STRANGEST);
        if !most.is_finite() {
            return (most, here);
        }
        let x = f.fixed_rows::<3>(0).into_owned();
        let missed = self.foretold.error(t, &x);
        let missed = missed.map_or(here, |nees| (nees / self.error_edge).min(STRANGEST));
        let mut sum = 0.0;
        for l in &self.logs {
            sum += (l - most).exp();
        }
        let (displacement, covariance) = self.displacement(&z, most);
        self.foretold
            .remember(t, self.ahead_s, x + displacement, covariance);
        let density = most + sum.ln() + log_jacobian(f, &self.units.bend);
        (density, SHARES[0] * here + SHARES[1] * missed)
    }

    /// The displacement to the knot and its covariance, responsibilities tempered as the predictor's are.
    fn displacement(&self, z: &Features, most: f64) -> (Vector3<f64>, Matrix3<f64>) {
        let (mut mean, mut spread, mut total) = (Vector3::zeros(), Matrix3::zeros(), 0.0);
        for (l, p) in self.logs.iter().zip(&self.parts) {
            let r = (TEMPER * (l - most)).exp();
            if r < NEGLIGIBLE {
                continue;
            }
            total += r;
            let share = r / total;
            let delta = p.target + p.gain * (z - p.mean) - mean;
            mean += delta * share;
            spread += p.residual * r + delta * delta.transpose() * (r * (1.0 - share));
        }
        (mean, spread / total)
    }

    /// Moves on the belief about the phase by `dt_s` and weighs it with the features.
    pub(super) fn progress(&mut self, f: &Features, dt_s: f64, weight: f64) {
        self.phases.take(&self.units.bent(*f), dt_s, weight);
    }

    /// Mean and standard deviation of the phase, in [0, 1].
    pub(super) fn phase(&self) -> (f64, f64) {
        self.phases.estimate()
    }

    pub(super) fn reset(&mut self) {
        self.foretold = Foretold::default();
        self.phases.reset();
    }
}

/// ln of what a volume of features is multiplied by where they are bent: without it, densities of skills that
/// bend differently would not compare.
///
/// A length r becomes g = b·ln(1 + r/b), so it is stretched by 1/(1 + r/b) along itself and by g/r across.
fn log_jacobian(f: &Features, bend: &[f64; BENT]) -> f64 {
    let of = |(i, &b): (usize, &f64)| {
        let r = f.fixed_rows::<3>(3 * (i + 1)).norm() / b;
        if r > 0.0 && r.is_finite() {
            2.0 * (r.ln_1p() / r).ln() - r.ln_1p()
        } else {
            0.0
        }
    };
    bend.iter().enumerate().map(of).sum()
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

/// The part for one component with the place blurred by `P = diag(place)`, and the mean of d² over samples of
/// the component as it was.
///
/// The regression is conditioned on the blurred features: `B′ = (C+P)⁻¹CB; V′ = V + BᵀCB − B′ᵀCB`.
fn part(c: &Regression, knot: usize, place: &Features, log_units: f64) -> Option<(Part, f64)> {
    let covariance = c.factor * c.factor.transpose();
    let blurred = covariance + Square::from_diagonal(place);
    let cholesky = blurred.cholesky()?;
    let factor = cholesky.l();
    let whiten = factor.solve_lower_triangular(&Square::identity())?;
    let log_det: f64 = factor.diagonal().iter().map(|l| l.ln()).sum();
    let expected = cholesky.solve(&covariance).trace();
    let log_scale = c.weight.ln() - log_det - log_units;

    let b = SMatrix::<f64, FEATURES, 3>::from_fn(|i, j| c.gain[i][3 * knot + j]);
    let both = covariance * b;
    let gain = cholesky.solve(&both).transpose();
    let [xx, xy, xz, yy, yz, zz] = c.residual[knot];
    let lost = b.transpose() * both - gain * both;
    let residual =
        Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz) + (lost + lost.transpose()) * 0.5;
    let usable = log_scale.is_finite()
        && expected > 0.0
        && whiten
            .iter()
            .chain(gain.iter())
            .chain(residual.iter())
            .all(|v| v.is_finite());
    usable.then_some((
        Part {
            mean: c.mean,
            whiten,
            log_scale,
            target: Vector3::from_column_slice(&c.target[3 * knot..3 * knot + 3]),
            gain,
            residual,
        },
        expected,
    ))
}
