//! A predictor in few bytes: integers, in steps that follow from what the predictor leaves unexplained.
//!
//! The displacements that follow a feature are smooth over the knots, so each row of integers is sent as
//! its second differences, nearly all of which fit a byte. A step is a power of two of at most 2 % of the
//! standard deviation that remains at its knot: rounding a prediction adds less than a thousandth to its
//! variance. Both ends run what these integers say.

use nalgebra::{SMatrix, SVector};
use serde::{Deserialize, Serialize};

use super::SkillError;
use super::bytes::triangle;
use crate::predict::{
    BENT, BLOCK, Calibration, FEATURES, Generic, MAX_KNOTS, Model, ModelError, Regression,
    Standardisation, TARGETS,
};
use crate::wire::codec::DecodeError;

/// Entries of a packed lower triangle of the features' covariance.
const TRIANGLE: usize = FEATURES * (FEATURES + 1) / 2;

/// Step of means and factors, which are in standard deviations.
const UNIT: f64 = 1.0 / 512.0;

/// A step is at most this share of the deviation that remains.
const SHARE: f64 = 0.02;

/// A residual covariance is in this many squared steps: about a hundredth of the variance.
const RESIDUAL_STEPS: f64 = 32.0;

/// Integers stay within ± this, so that second differences fit an `i32`.
const LARGEST: f64 = (1 << 28) as f64;

/// Exponents of steps: 2⁻⁴⁰ (a picometre) to 2²⁰.
const EXPONENTS: core::ops::RangeInclusive<i8> = -40..=20;

#[derive(Serialize, Deserialize)]
pub(super) struct RawModel {
    mean: [f32; FEATURES],
    scale: [f32; FEATURES],
    bend: [f32; BENT],
    /// Ridge and shrinkage.
    training: [f32; 2],
    /// One factor a knot: its length is the number of knots.
    covariance: Vec<f32>,
    /// Of each expert, mixture first.
    errors: Vec<[f32; 4]>,
    novelty90: f32,
    /// Factors of the generic extrapolator, one a memory.
    lead: Vec<[f32; 4]>,
    products: [f32; 10],
    /// log₂ of the step of displacements at each knot.
    exponents: Vec<i8>,
    components: Vec<RawRegression>,
}

/// Everything per knot stops at the model's last knot.
#[derive(Serialize, Deserialize)]
struct RawRegression {
    weight: f32,
    mean: [i32; FEATURES],
    /// Lower triangle, row by row.
    factor: Vec<i32>,
    /// Second differences over the knots, axis by axis.
    target: Vec<i32>,
    /// The same for each feature in turn.
    gain: Vec<i32>,
    /// First differences over the knots, entry by entry of the block.
    residual: Vec<i32>,
}

impl RawModel {
    pub(super) fn pack(model: &Model) -> Self {
        let knots = model.knots();
        let calibration = model.calibration();
        let exponents = model
            .exponents()
            .map_or_else(|| exponents(model), |known| known[..knots].to_vec());
        let regression = |c: &Regression| {
            let row = |row: &[f64; TARGETS]| {
                let mut out = Vec::with_capacity(3 * knots);
                for axis in 0..3 {
                    let steps = (0..knots).map(|j| row[3 * j + axis] / step(exponents[j]));
                    second_differences(steps, &mut out);
                }
                out
            };
            let mut residual = Vec::with_capacity(BLOCK * knots);
            for entry in 0..BLOCK {
                let mut before = 0;
                for (block, exponent) in c.residual.iter().zip(&exponents) {
                    let now = whole(block[entry] / residual_step(*exponent));
                    residual.push(now - before);
                    before = now;
                }
            }
            RawRegression {
                weight: c.weight as f32,
                mean: c.mean.map(|v| whole(v / UNIT)).into(),
                factor: triangle(FEATURES)
                    .map(|(i, j)| {
                        let steps = whole(c.factor[(i, j)] / UNIT);
                        // A diagonal entry must stay above zero.
                        if i == j { steps.max(1) } else { steps }
                    })
                    .collect(),
                target: row(&c.target),
                gain: c.gain.iter().flat_map(row).collect(),
                residual,
            }
        };
        Self {
            mean: model.standardisation().mean.map(|v| v as f32).into(),
            scale: model.standardisation().scale.map(|v| v as f32).into(),
            bend: model.standardisation().bend.map(|v| v as f32),
            training: [
                model.standardisation().ridge as f32,
                model.standardisation().shrinkage as f32,
            ],
            covariance: calibration.covariance[..knots]
                .iter()
                .map(|&v| v as f32)
                .collect(),
            errors: calibration.errors[..knots]
                .iter()
                .map(|e| e.map(|v| v as f32))
                .collect(),
            novelty90: calibration.novelty90 as f32,
            lead: (0..knots)
                .map(|j| model.generic().lead.map(|g| g[j] as f32))
                .collect(),
            products: model.generic().products.map(|v| v as f32),
            components: model.components().iter().map(regression).collect(),
            exponents,
        }
    }

    pub(super) fn unpack(&self) -> Result<Model, SkillError> {
        let knots = self.covariance.len();
        if !(1..=MAX_KNOTS).contains(&knots) {
            return Err(ModelError::Knots { found: knots }.into());
        }
        if self.errors.len() != knots {
            return Err(wrong_length("errors").into());
        }
        if self.lead.len() != knots {
            return Err(wrong_length("lead").into());
        }
        if self.exponents.len() != knots {
            return Err(wrong_length("exponents").into());
        }
        if !self.exponents.iter().all(|e| EXPONENTS.contains(e)) {
            return Err(DecodeError::Invalid {
                field: "exponents",
                why: "a step below 2⁻⁴⁰ or above 2²⁰",
            }
            .into());
        }
        let mut calibration = Calibration {
            covariance: [1.0; MAX_KNOTS],
            errors: [[1.0; 4]; MAX_KNOTS],
            novelty90: f64::from(self.novelty90),
        };
        let mut generic = Generic {
            lead: [[0.0; MAX_KNOTS]; 4],
            products: self.products.map(f64::from),
        };
        for j in 0..knots {
            calibration.covariance[j] = f64::from(self.covariance[j]);
            calibration.errors[j] = self.errors[j].map(f64::from);
            for (row, &v) in generic.lead.iter_mut().zip(&self.lead[j]) {
                row[j] = f64::from(v);
            }
        }
        let components = self
            .components
            .iter()
            .map(|c| c.unpack(&self.exponents))
            .collect::<Result<_, _>>()?;
        let mut exponents = [0; MAX_KNOTS];
        exponents[..knots].copy_from_slice(&self.exponents);
        let model = Model::new(
            knots,
            Standardisation {
                mean: SVector::from(self.mean.map(f64::from)),
                scale: SVector::from(self.scale.map(f64::from)),
                bend: self.bend.map(f64::from),
                ridge: f64::from(self.training[0]),
                shrinkage: f64::from(self.training[1]),
            },
            components,
            generic,
            calibration,
        )?;
        Ok(model.in_steps(exponents))
    }
}

impl RawRegression {
    fn unpack(&self, exponents: &[i8]) -> Result<Regression, DecodeError> {
        let knots = exponents.len();
        let row = 3 * knots;
        for (field, found, expected) in [
            ("factor", self.factor.len(), TRIANGLE),
            ("target", self.target.len(), row),
            ("gain", self.gain.len(), FEATURES * row),
            ("residual", self.residual.len(), BLOCK * knots),
        ] {
            if found != expected {
                return Err(wrong_length(field));
            }
        }
        let mut out = Regression {
            weight: f64::from(self.weight),
            mean: SVector::from(self.mean.map(|n| f64::from(n) * UNIT)),
            factor: SMatrix::zeros(),
            target: [0.0; TARGETS],
            gain: [[0.0; TARGETS]; FEATURES],
            residual: [[0.0; BLOCK]; MAX_KNOTS],
        };
        for (&n, at) in self.factor.iter().zip(triangle(FEATURES)) {
            out.factor[at] = f64::from(n) * UNIT;
        }
        let rows = core::iter::once((&mut out.target, &self.target[..]))
            .chain(out.gain.iter_mut().zip(self.gain.chunks_exact(row)));
        for (to, from) in rows {
            for (axis, from) in from.chunks_exact(knots).enumerate() {
                let (mut before, mut slope) = (0_i64, 0_i64);
                for (j, (&n, &exponent)) in from.iter().zip(exponents).enumerate() {
                    slope += i64::from(n);
                    before += slope;
                    to[3 * j + axis] = before as f64 * step(exponent);
                }
            }
        }
        for (entry, from) in self.residual.chunks_exact(knots).enumerate() {
            let mut now = 0_i64;
            for ((block, &n), &exponent) in out.residual.iter_mut().zip(from).zip(exponents) {
                now += i64::from(n);
                block[entry] = now as f64 * residual_step(exponent);
            }
        }
        Ok(out)
    }
}

/// The steps for a model that has none yet.
fn exponents(model: &Model) -> Vec<i8> {
    let components = model.components();
    let total: f64 = components.iter().map(|c| c.weight).sum();
    (0..model.knots())
        .map(|j| {
            let variance = components
                .iter()
                .map(|c| c.weight * (c.residual[j][0] + c.residual[j][3] + c.residual[j][5]))
                .sum::<f64>()
                / (3.0 * total);
            let values = components.iter().flat_map(|c| {
                let gains = c.gain.iter().flat_map(|g| &g[3 * j..3 * j + 3]);
                c.target[3 * j..3 * j + 3].iter().chain(gains)
            });
            let largest = values.fold(0.0, |m: f64, v| m.max(v.abs()));
            let spread = components.iter().flat_map(|c| &c.residual[j]);
            let spread = spread.fold(0.0, |m: f64, v| m.max(v.abs()));
            let least = (largest / LARGEST).max((spread / (RESIDUAL_STEPS * LARGEST)).sqrt());
            let wanted = (SHARE * variance.sqrt()).max(least);
            let exponent = libm::floor(libm::log2(wanted));
            // A power of two below would overflow what `least` allows.
            let exponent = if libm::exp2(exponent) < least {
                exponent + 1.0
            } else {
                exponent
            };
            exponent.clamp(f64::from(*EXPONENTS.start()), f64::from(*EXPONENTS.end())) as i8
        })
        .collect()
}

fn step(exponent: i8) -> f64 {
    libm::exp2(f64::from(exponent))
}

fn residual_step(exponent: i8) -> f64 {
    RESIDUAL_STEPS * step(exponent) * step(exponent)
}

fn whole(v: f64) -> i32 {
    v.round().clamp(-LARGEST, LARGEST) as i32
}

fn second_differences(values: impl Iterator<Item = f64>, out: &mut Vec<i32>) {
    let (mut before, mut slope) = (0, 0);
    for value in values {
        let now = whole(value);
        out.push(now - before - slope);
        (before, slope) = (now, now - before);
    }
}

fn wrong_length(field: &'static str) -> DecodeError {
    DecodeError::Invalid {
        field,
        why: "its length does not fit the number of knots",
    }
}
