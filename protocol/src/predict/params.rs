//! What the operator adapts, and sends as plain numbers.

use serde::{Deserialize, Serialize};

/// The experts a prediction is fused of that have a weight: mixture, generic extrapolator, straight line, in this order.
/// What is left of their weights to 1 holds the present.
pub const WEIGHTED: usize = 3;

/// The knots (from 1) at which weights are stated: 0.1, 0.2 and 0.4 s. Between them they are interpolated, outside the nearest holds.
pub const BAND_KNOTS: [usize; 3] = [3, 6, 12];

/// How far a covariance factor may be from 1, either way.
const LARGEST_INFLATION: f64 = 65_536.0;

/// What the operator adapts, as plain numbers that travel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Params {
    /// Gain κ on every predicted displacement, in [0, 1]; 0 holds the newest position.
    pub gain: f64,
    /// Factor φ on every predicted covariance, 2⁻¹⁶ to 2¹⁶.
    pub inflation: f64,
    /// At each of [`BAND_KNOTS`] the weights of the [`WEIGHTED`] experts before novelty is considered: each in [0, 1],
    /// their sum at most 1.
    pub weights: [[f64; WEIGHTED]; BAND_KNOTS.len()],
}

/// A parameter is outside its range, or NaN.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("predictor parameter {field} is {value}, not in [{least}, {most}]")]
pub struct ParamsError {
    /// The parameter.
    pub field: &'static str,
    /// Its value.
    pub value: f64,
    /// Its least value.
    pub least: f64,
    /// Its largest value.
    pub most: f64,
}

impl Default for Params {
    /// [`Params::DEFAULT`].
    fn default() -> Self {
        Self::DEFAULT
    }
}

impl Params {
    /// Full prediction by the mixture, as calibrated.
    pub const DEFAULT: Self = Self::only([1.0, 0.0, 0.0]);

    /// Full prediction by fixed weights of mixture, generic extrapolator and straight line at every horizon.
    pub const fn only(weights: [f64; WEIGHTED]) -> Self {
        Self {
            gain: 1.0,
            inflation: 1.0,
            weights: [weights; BAND_KNOTS.len()],
        }
    }

    /// These parameters, if each is in its range.
    ///
    /// # Errors
    /// [`ParamsError`] names the first that is not.
    pub fn checked(self) -> Result<Self, ParamsError> {
        let within = |field, value: f64, least: f64, most: f64| {
            if (least..=most).contains(&value) {
                Ok(())
            } else {
                Err(ParamsError {
                    field,
                    value,
                    least,
                    most,
                })
            }
        };
        within("gain", self.gain, 0.0, 1.0)?;
        let most = LARGEST_INFLATION;
        within("inflation", self.inflation, 1.0 / most, most)?;
        for band in &self.weights {
            for weight in band {
                within("weight", *weight, 0.0, 1.0)?;
            }
            // A sum of rounded shares may miss 1 by rounding.
            within("sum of weights", band.iter().sum(), 0.0, 1.0 + 1e-9)?;
        }
        Ok(self)
    }

    /// The weights at knot `j`, from 1.
    pub(super) fn at(&self, j: usize) -> [f64; WEIGHTED] {
        let [near, middle, far] = BAND_KNOTS;
        let between = |from: usize, to: usize, a: usize| {
            let u = (j - from) as f64 / (to - from) as f64;
            let (a, b) = (&self.weights[a], &self.weights[a + 1]);
            core::array::from_fn(|e| a[e] * (1.0 - u) + b[e] * u)
        };
        if j <= near {
            self.weights[0]
        } else if j <= middle {
            between(near, middle, 0)
        } else if j <= far {
            between(middle, far, 1)
        } else {
            self.weights[2]
        }
    }
}
