//! What a state remembers, as it travels: four vectors in 8 bits a component.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// The largest exponent that half a byte holds.
const MAX_EXPONENT: u8 = 15;

/// Four vectors in bytes, each with a power-of-two step of its own: what happened in the last moments is small and says how fast
/// the hand is now, what happened before is large, and neither is to be rounded as coarsely as the other needs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct WireMemory {
    /// log₂ of each memory's step, in half a byte, the first in the high half of the first byte. The unit is that of what is remembered.
    pub exponents: [u8; 2],
    /// The vectors, each in its step.
    pub offsets: [[i8; 3]; 4],
}

impl WireMemory {
    /// The finest steps of `unit`·2ᵉ in which `vectors` fit; `None` if that takes an `e` above 15.
    pub(super) fn quantise(vectors: &[Vector3<f64>; 4], unit: f64) -> Option<Self> {
        let mut wire = Self::default();
        for (i, vector) in vectors.iter().enumerate() {
            let (mut exponent, mut step) = (0_u8, unit);
            while vector.amax() > 127.0 * step {
                if exponent == MAX_EXPONENT {
                    return None;
                }
                exponent += 1;
                step *= 2.0;
            }
            wire.exponents[i / 2] |= if i % 2 == 0 { exponent << 4 } else { exponent };
            wire.offsets[i] = vector.map(|v| (v / step).round() as i8).into();
        }
        Some(wire)
    }

    /// The exponents, one for each memory.
    pub(super) fn exponents(&self) -> [u8; 4] {
        let [a, b] = self.exponents;
        [a >> 4, a & 15, b >> 4, b & 15]
    }

    /// The vectors both ends compute with.
    pub(super) fn dequantise(&self, unit: f64) -> [Vector3<f64>; 4] {
        let exponents = self.exponents();
        std::array::from_fn(|i| {
            let step = unit * f64::from(1_u32 << exponents[i]);
            Vector3::from(self.offsets[i].map(|n| f64::from(n) * step))
        })
    }
}
