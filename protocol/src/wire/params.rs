//! What the operator adapts, as it travels.

use serde::{Deserialize, Serialize};

use super::codec::DecodeError;
use crate::predict::{BAND_KNOTS, Params, WEIGHTED};

/// [`Params`] in a byte each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct WireParams {
    /// Prediction gain κ, in 1/255.
    pub gain: u8,
    /// Covariance factor: φ = 2^((n − 128)/8).
    pub inflation: u8,
    /// At each horizon the weights of mixture, generic extrapolator and straight line, in 1/255; together at most 255.
    pub weights: [[u8; WEIGHTED]; BAND_KNOTS.len()],
}

impl WireParams {
    /// The nearest parameters that can travel.
    pub fn quantise(params: &Params) -> Self {
        let step = |v: f64| (v * 255.0).round() as u8;
        let octaves = libm::log2(params.inflation) * 8.0 + 128.0;
        Self {
            gain: step(params.gain),
            inflation: octaves.round() as u8,
            weights: params.weights.map(|band| {
                let mut steps = band.map(step);
                // Rounded up together they may say more than all.
                let over = steps
                    .iter()
                    .map(|&n| u16::from(n))
                    .sum::<u16>()
                    .saturating_sub(255);
                if let Some(largest) = steps.iter_mut().max() {
                    *largest = largest.saturating_sub(u8::try_from(over).unwrap_or(u8::MAX));
                }
                steps
            }),
        }
    }

    /// The parameters both ends use.
    pub fn dequantise(self) -> Params {
        let value = |v: u8| f64::from(v) / 255.0;
        Params {
            gain: value(self.gain),
            inflation: libm::exp2((f64::from(self.inflation) - 128.0) / 8.0),
            weights: self.weights.map(|band| band.map(value)),
        }
    }

    pub(super) fn check(self, field: &'static str) -> Result<(), DecodeError> {
        let sum = |band: &[u8; WEIGHTED]| band.iter().map(|&n| u16::from(n)).sum::<u16>();
        if self.weights.iter().all(|band| sum(band) <= 255) {
            Ok(())
        } else {
            Err(DecodeError::Invalid {
                field,
                why: "weights above 255 in all",
            })
        }
    }
}
