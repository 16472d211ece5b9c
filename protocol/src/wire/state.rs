//! The newest hand state as it travels: quantised, so that both ends predict from the same numbers.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::codec::DecodeError;
use crate::predict::HandState;
use crate::time::Stamp;

/// Step of positions on the wire, m.
pub const POSITION_STEP_M: f64 = 1e-4;

/// A hand's position may lie this far from the tracker's origin, m.
pub const MAX_POSITION_M: f64 = 100.0;

/// Step of `memory_exponent` 0, m; each further one doubles it.
const MEMORY_STEP_M: f64 = 2.5e-5;
const MAX_EXPONENT: u8 = 20;

/// [`HandState`] in integers. The memories travel as offsets from the position in 8 bits each, with
/// one common power-of-two step: fast motion is carried coarsely, slow motion finely.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct WireState {
    /// When the sample is valid, µs on the session clock.
    pub t_us: i64,
    /// Position in steps of 0.1 mm.
    pub x: [i32; 3],
    /// log₂ of the memories' step in units of 25 µm.
    pub memory_exponent: u8,
    /// `(x − mᵢ)` per memory and axis, in that step.
    pub memory: [[i8; 3]; 4],
}

impl WireState {
    /// Quantises a state; `None` if a coordinate lies beyond [`MAX_POSITION_M`] or is not finite.
    pub fn quantise(state: &HandState) -> Option<Self> {
        let x = state.x.map(|v| v / POSITION_STEP_M);
        if !state.x.iter().all(|v| v.abs() <= MAX_POSITION_M) {
            return None;
        }
        let x: [i32; 3] = x.map(|v| v.round() as i32).into();
        let offsets = state.memory.map(|m| state.x - m);
        let largest = offsets.iter().map(|o| o.amax()).fold(0.0, f64::max);
        let (mut exponent, mut step) = (0, MEMORY_STEP_M);
        while largest > 127.0 * step {
            // A hand that jumped in from far away drags memories that no exponent can carry.
            if exponent == MAX_EXPONENT {
                return None;
            }
            exponent += 1;
            step *= 2.0;
        }
        let memory = offsets.map(|o| o.map(|v| (v / step).round() as i8).into());
        Some(Self {
            t_us: (state.t.0 as f64 / 1e3).round() as i64,
            x,
            memory_exponent: exponent,
            memory,
        })
    }

    /// The state both ends predict from.
    pub fn dequantise(&self) -> HandState {
        let x = Vector3::from(self.x.map(|v| f64::from(v) * POSITION_STEP_M));
        let step = MEMORY_STEP_M * (1u64 << self.memory_exponent.min(MAX_EXPONENT)) as f64;
        let memory = self
            .memory
            .map(|m| x - Vector3::from(m.map(|v| f64::from(v) * step)));
        HandState {
            t: Stamp(self.t_us.saturating_mul(1000)),
            x,
            memory,
        }
    }

    pub(super) fn check(&self) -> Result<(), DecodeError> {
        let limit = (MAX_POSITION_M / POSITION_STEP_M) as i32;
        if !self.x.iter().all(|v| (-limit..=limit).contains(v)) {
            return Err(DecodeError::Invalid {
                field: "state.x",
                why: "beyond 100 m",
            });
        }
        if self.memory_exponent > MAX_EXPONENT {
            return Err(DecodeError::Invalid {
                field: "state.memory_exponent",
                why: "above 20",
            });
        }
        if self.t_us.unsigned_abs() > i64::MAX as u64 / 1000 {
            return Err(DecodeError::Invalid {
                field: "state.t_us",
                why: "beyond the session clock",
            });
        }
        Ok(())
    }
}
