//! The newest hand state as it travels: quantised, so that both ends predict from the same numbers.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::codec::DecodeError;
use super::memory::WireMemory;
use crate::checkpoint::bits::{BitReader, BitWriter, unzigzag, zigzag};
use crate::checkpoint::path::tick_of;
use crate::predict::HandState;
use crate::time::Stamp;

/// Step of positions on the wire, m.
pub const POSITION_STEP_M: f64 = 1e-4;

/// A hand's position may lie this far from the tracker's origin, m.
pub const MAX_POSITION_M: f64 = 100.0;

/// Times of states are multiples of a path's tick.
const TICK_US: i64 = 10;

/// Bits of a time, in ticks and zigzag, are these and 8, 16 or 24 more.
const LEAST_TIME_BITS: u32 = 30;

/// Order of a coordinate's code: a hand is within a metre or two.
const POSITION_ORDER: u32 = 14;

/// Finest step of a memory, m.
const MEMORY_STEP_M: f64 = 2.5e-5;

/// [`HandState`] in integers. The memories travel as offsets from the position in 8 bits each, every one with a
/// power-of-two step of its own: fast motion is carried coarsely, slow motion finely.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct WireState {
    /// When the sample is valid, µs on the session clock, to 10 µs.
    pub t_us: i64,
    /// Position in steps of 0.1 mm.
    pub x: [i32; 3],
    /// `x − mᵢ` for each memory, its unit 25 µm.
    pub memory: WireMemory,
}

impl WireState {
    /// Quantises a state; `None` if a coordinate lies beyond [`MAX_POSITION_M`] or is not finite, or a memory is farther
    /// than 104 m from the position.
    pub fn quantise(state: &HandState) -> Option<Self> {
        let x = state.x.map(|v| v / POSITION_STEP_M);
        if !state.x.iter().all(|v| v.abs() <= MAX_POSITION_M) {
            return None;
        }
        let x: [i32; 3] = x.map(|v| v.round() as i32).into();
        Some(Self {
            t_us: tick_of(state.t).saturating_mul(TICK_US),
            x,
            memory: WireMemory::quantise(&state.ways(), MEMORY_STEP_M)?,
        })
    }

    /// The state both ends predict from.
    pub fn dequantise(&self) -> HandState {
        let x = Vector3::from(self.x.map(|v| f64::from(v) * POSITION_STEP_M));
        HandState {
            t: Stamp(self.t_us.saturating_mul(1000)),
            x,
            memory: self.memory.dequantise(MEMORY_STEP_M).map(|way| x - way),
        }
    }

    /// As bits, a time between two ticks as the nearest.
    pub(super) fn write(&self, w: &mut BitWriter) {
        let ticks = self.t_us.saturating_add(TICK_US / 2).div_euclid(TICK_US);
        // What is beyond every clock stays so.
        let ticks = zigzag(ticks).min((1 << time_bits(3)) - 1);
        let size = (0..3).find(|size| ticks >> time_bits(*size) == 0);
        let size = size.unwrap_or(3);
        w.put(u64::from(size), 2);
        w.put(ticks, time_bits(size));
        for n in self.x {
            w.signed(i64::from(n), POSITION_ORDER);
        }
        self.memory.write(w);
    }

    /// What [`WireState::write`] wrote.
    pub(super) fn read(r: &mut BitReader<'_>) -> Option<Self> {
        let size = r.take(2)? as u32;
        // Below 2⁵³, so ten times as much is still a time.
        let t_us = unzigzag(r.take(time_bits(size))?) * TICK_US;
        let mut x = [0; 3];
        for x in &mut x {
            *x = i32::try_from(r.signed(POSITION_ORDER)?).ok()?;
        }
        let memory = WireMemory::read(r)?;
        Some(Self { t_us, x, memory })
    }

    pub(super) fn check(&self) -> Result<(), DecodeError> {
        let limit = (MAX_POSITION_M / POSITION_STEP_M) as i32;
        if !self.x.iter().all(|v| (-limit..=limit).contains(v)) {
            return Err(DecodeError::Invalid {
                field: "state.x",
                why: "beyond 100 m",
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

fn time_bits(size: u32) -> u32 {
    LEAST_TIME_BITS + 8 * size
}
