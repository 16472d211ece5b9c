//! What a state remembers, as it travels: four vectors in 8 bits a component.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use crate::checkpoint::bits::{BitReader, BitWriter};

/// The largest exponent that half a byte holds.
const MAX_EXPONENT: u8 = 15;

/// Order of the codes of a component's difference to what is expected of it.
const OFFSET_ORDER: u32 = 4;

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

    /// As bits: a longer memory lies about half as far again in the same direction.
    pub(super) fn write(&self, w: &mut BitWriter) {
        let exponents = self.exponents();
        w.put(u64::from(exponents[0]), 4);
        for pair in exponents.windows(2) {
            w.signed(i64::from(pair[1]) - i64::from(pair[0]), 0);
        }
        for (i, offsets) in self.offsets.iter().enumerate() {
            for (axis, n) in offsets.iter().enumerate() {
                let expected = expected(&self.offsets, exponents, i, axis);
                w.signed(i64::from(*n) - expected, OFFSET_ORDER);
            }
        }
    }

    /// What [`WireMemory::write`] wrote.
    pub(super) fn read(r: &mut BitReader<'_>) -> Option<Self> {
        let mut exponents = [r.take(4)? as u8; 4];
        for i in 1..exponents.len() {
            let exponent = i64::from(exponents[i - 1]) + r.signed(0)?;
            exponents[i] = u8::try_from(exponent).ok().filter(|e| *e <= MAX_EXPONENT)?;
        }
        let mut offsets = [[0; 3]; 4];
        for i in 0..offsets.len() {
            for axis in 0..3 {
                let n = expected(&offsets, exponents, i, axis) + r.signed(OFFSET_ORDER)?;
                offsets[i][axis] = i8::try_from(n).ok()?;
            }
        }
        let [a, b, c, d] = exponents;
        Some(Self {
            exponents: [a << 4 | b, c << 4 | d],
            offsets,
        })
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

/// What the memory before leads to expect of a component, in steps: half as much again, rounded down.
fn expected(offsets: &[[i8; 3]; 4], exponents: [u8; 4], i: usize, axis: usize) -> i64 {
    let Some(before) = i.checked_sub(1) else {
        return 0;
    };
    let thrice = (3 * i64::from(offsets[before][axis])) << exponents[before];
    (thrice >> (exponents[i] + 1)).clamp(-127, 127)
}
