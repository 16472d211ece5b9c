//! What the operator adapts, as it travels.

use serde::{Deserialize, Serialize};

use super::codec::DecodeError;
use crate::checkpoint::bits::{BitReader, BitWriter};
use crate::predict::{BAND_KNOTS, Params, WEIGHTED};

/// Bits of a weight, and what it counts in: a fifteenth.
const WEIGHT_BITS: u32 = 4;
const WHOLE: u8 = (1 << WEIGHT_BITS) - 1;

/// [`Params`] in integers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct WireParams {
    /// Prediction gain κ, in 1/255.
    pub gain: u8,
    /// Covariance factor: φ = 2^((n − 128)/8).
    pub inflation: u8,
    /// At each horizon the weights of mixture, generic extrapolator and straight line, in 1/15; together at most 15.
    pub weights: [[u8; WEIGHTED]; BAND_KNOTS.len()],
}

impl WireParams {
    /// The nearest parameters that can travel.
    pub fn quantise(params: &Params) -> Self {
        let octaves = libm::log2(params.inflation) * 8.0 + 128.0;
        Self {
            gain: (params.gain * 255.0).round() as u8,
            inflation: octaves.round() as u8,
            weights: params.weights.map(steps),
        }
    }

    /// The parameters both ends use.
    pub fn dequantise(self) -> Params {
        let value = |v: u8| f64::from(v) / f64::from(WHOLE);
        Params {
            gain: f64::from(self.gain) / 255.0,
            inflation: libm::exp2((f64::from(self.inflation) - 128.0) / 8.0),
            weights: self.weights.map(|band| band.map(value)),
        }
    }

    /// As bits; a whole gain is one.
    pub(super) fn write(self, w: &mut BitWriter) {
        w.put(u64::from(self.gain == u8::MAX), 1);
        if self.gain != u8::MAX {
            w.put(self.gain.into(), 8);
        }
        w.put(self.inflation.into(), 8);
        for weight in self.weights.as_flattened() {
            w.put((*weight).min(WHOLE).into(), WEIGHT_BITS);
        }
    }

    /// What [`WireParams::write`] wrote.
    pub(super) fn read(r: &mut BitReader<'_>) -> Option<Self> {
        let gain = match r.take(1)? {
            1 => u8::MAX,
            _ => r.take(8)? as u8,
        };
        let inflation = r.take(8)? as u8;
        let mut weights = [[0; WEIGHTED]; BAND_KNOTS.len()];
        for weight in weights.as_flattened_mut() {
            *weight = r.take(WEIGHT_BITS)? as u8;
        }
        Some(Self {
            gain,
            inflation,
            weights,
        })
    }

    pub(super) fn check(self, field: &'static str) -> Result<(), DecodeError> {
        let sum = |band: &[u8; WEIGHTED]| band.iter().map(|&n| u16::from(n)).sum::<u16>();
        if self.weights.iter().all(|band| sum(band) <= WHOLE.into()) {
            Ok(())
        } else {
            Err(DecodeError::Invalid {
                field,
                why: "weights above 1 in all",
            })
        }
    }
}

/// Weights in steps. What is left to holding is rounded first, and the rest goes to the others: they say much the same of a hand
/// that moves on, and holding something else.
fn steps(band: [f64; WEIGHTED]) -> [u8; WEIGHTED] {
    let (whole, sum) = (f64::from(WHOLE), band.iter().sum::<f64>());
    let all = whole - (whole * (1.0 - sum).max(0.0)).round();
    if !(all > 0.0) {
        return [0; WEIGHTED];
    }
    let wanted = band.map(|weight| weight * all / sum);
    let mut steps = wanted.map(|n| n as u8);
    for _ in 0..WEIGHTED {
        let short = (0..WEIGHTED).map(|i| (wanted[i] - f64::from(steps[i]), i));
        let given: f64 = steps.iter().map(|n| f64::from(*n)).sum();
        if given < all
            && let Some((_, i)) = short.max_by(|a, b| a.0.total_cmp(&b.0))
        {
            steps[i] += 1;
        }
    }
    steps
}
