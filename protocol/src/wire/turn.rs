//! Orientation and gripper as they travel: quantised, so that both ends predict from the same numbers.

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use super::codec::DecodeError;
use super::memory::WireMemory;
use super::v1::WireParams;
use crate::checkpoint::bits::{BitReader, BitWriter};
use crate::pose;
use crate::predict::{TurnForecast, TurnState};
use crate::skill::Skill;
use crate::time::Stamp;

/// Step of rotation vectors on the wire, rad.
pub const ROTATION_STEP_RAD: f64 = 1e-4;

/// π in steps, rounded up.
const HALF_TURN: i16 = 31_416;

/// Finest step of a memory, rad.
const MEMORY_STEP_RAD: f64 = 2.5e-5;

/// 127 steps of it are more than π.
const MAX_EXPONENT: u8 = 10;

/// An orientation as its rotation vector, in steps of 0.1 mrad; of length at most π.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct WireRotation(pub [i16; 3]);

impl WireRotation {
    /// The nearest that can travel.
    pub fn quantise(q: &UnitQuaternion<f64>) -> Self {
        Self(
            pose::log(q)
                .map(|v| (v / ROTATION_STEP_RAD).round() as i16)
                .into(),
        )
    }

    /// The orientation both ends use.
    pub fn dequantise(self) -> UnitQuaternion<f64> {
        pose::exp(&Vector3::from(
            self.0.map(|v| f64::from(v) * ROTATION_STEP_RAD),
        ))
    }

    pub(super) fn check(self, field: &'static str) -> Result<(), DecodeError> {
        if self.0.iter().all(|v| (-HALF_TURN..=HALF_TURN).contains(v)) {
            Ok(())
        } else {
            Err(DecodeError::Invalid {
                field,
                why: "an angle beyond half a turn",
            })
        }
    }
}

/// [`TurnState`] in integers, valid when the hand state it travels with is. The memories travel as the
/// rotation vectors `log(mᵢ⁻¹q)` in 8 bits each, every one with a power-of-two step of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct WireTurn {
    /// Orientation, from the hand's own axes to the tracker's.
    pub q: WireRotation,
    /// `log(mᵢ⁻¹q)` for each memory, its unit 25 µrad.
    pub memory: WireMemory,
    /// Parameters to predict with.
    pub params: WireParams,
}

impl WireTurn {
    /// Quantises a state with the parameters it is to be predicted by.
    pub fn quantise(state: &TurnState, params: WireParams) -> Self {
        Self {
            q: WireRotation::quantise(&state.q),
            memory: WireMemory::quantise(&state.ways(), MEMORY_STEP_RAD)
                .expect("no angle between two orientations is above π"),
            params,
        }
    }

    /// As bits.
    pub(super) fn write(&self, w: &mut BitWriter) {
        for n in self.q.0 {
            w.put(u64::from(n.cast_unsigned()), 16);
        }
        self.memory.write(w);
        self.params.write(w);
    }

    /// What [`WireTurn::write`] wrote.
    pub(super) fn read(r: &mut BitReader<'_>) -> Option<Self> {
        let mut q = WireRotation::default();
        for n in &mut q.0 {
            *n = (r.take(16)? as u16).cast_signed();
        }
        Some(Self {
            q,
            memory: WireMemory::read(r)?,
            params: WireParams::read(r)?,
        })
    }

    /// The state both ends predict from; `t` is that of the hand state it came with.
    pub fn dequantise(&self, t: Stamp) -> TurnState {
        let q = self.q.dequantise();
        let ways = self.memory.dequantise(MEMORY_STEP_RAD);
        let memory = ways.map(|way| pose::moved(&q, &-way));
        TurnState { t, q, memory }
    }

    /// The prediction both ends make of it: by the skill's orientation, or by constant angular velocity where
    /// there is none.
    pub fn forecast(&self, t: Stamp, skill: Option<&Skill>) -> TurnForecast {
        let (state, params) = (self.dequantise(t), self.params.dequantise());
        match skill.and_then(Skill::turn) {
            Some(turn) => turn.predictor.forecast(&state, &params),
            None => TurnForecast::constant_velocity(&state, &params),
        }
    }
}

/// What travels beside the hand's position: nothing, orientation, the gripper, or both.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct WirePose {
    /// Orientation, where the input has it.
    pub turn: Option<WireTurn>,
    /// How far the gripper is to be open, in steps of 1/255, where the input says so.
    pub grip: Option<u8>,
}

impl WirePose {
    pub(super) fn check(&self) -> Result<(), DecodeError> {
        let Some(turn) = &self.turn else {
            return Ok(());
        };
        if turn.memory.exponents().iter().any(|e| *e > MAX_EXPONENT) {
            return Err(DecodeError::Invalid {
                field: "pose.memory",
                why: "above 10",
            });
        }
        turn.params.check("pose.params")?;
        turn.q.check("pose.q")
    }
}

/// An opening in steps of 1/255.
pub fn quantise_grip(grip: f64) -> u8 {
    (grip.clamp(0.0, 1.0) * 255.0).round() as u8
}

/// An opening from 0 to 1.
pub fn dequantise_grip(grip: u8) -> f64 {
    f64::from(grip) / 255.0
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn rotation() -> impl Strategy<Value = UnitQuaternion<f64>> {
        prop::array::uniform4(-1.0..1.0_f64)
            .prop_filter("a direction", |v| {
                v.iter().map(|v| v * v).sum::<f64>() > 1e-3
            })
            .prop_map(|[w, i, j, k]| {
                UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(w, i, j, k))
            })
    }

    proptest! {
        #[test]
        fn what_travels_is_near_and_in_range(
            q in rotation(),
            memory in prop::array::uniform4(rotation()),
        ) {
            let state = TurnState { t: Stamp(7), q, memory };
            let params = WireParams { gain: 255, inflation: 128, weights: [[6, 0, 9]; 3] };
            let wire = WireTurn::quantise(&state, params);
            let pose = WirePose { turn: Some(wire), grip: None };
            prop_assert!(pose.check().is_ok());
            let again = wire.dequantise(Stamp(7));
            prop_assert!(again.q.angle_to(&q) < 0.9 * ROTATION_STEP_RAD);
            for ((a, b), e) in again.memory.iter().zip(&state.memory).zip(wire.memory.exponents()) {
                let step = MEMORY_STEP_RAD * f64::from(1 << e);
                // At half a turn the axis has two signs.
                prop_assert!(a.angle_to(b) < step + 2.0 * ROTATION_STEP_RAD, "{}", a.angle_to(b));
            }
            // What was rounded once is not rounded again, as long as the axis has one sign.
            if q.angle() < 3.1 {
                prop_assert_eq!(WireRotation::quantise(&again.q), wire.q);
            }
        }
    }

    #[test]
    fn openings_come_back() {
        for step in 0..=255 {
            assert_eq!(quantise_grip(dequantise_grip(step)), step);
        }
        assert_eq!((quantise_grip(-3.0), quantise_grip(9.0)), (0, 255));
        assert_eq!(quantise_grip(f64::NAN), 0);
    }

    #[test]
    fn what_no_encoder_writes_is_refused() {
        let turn = |q, exponent: u8| WirePose {
            turn: Some(WireTurn {
                q: WireRotation(q),
                memory: WireMemory {
                    exponents: [0, exponent],
                    ..WireMemory::default()
                },
                params: WireParams {
                    gain: 0,
                    inflation: 0,
                    weights: [[0; 3]; 3],
                },
            }),
            grip: None,
        };
        assert!(turn([31_416, -31_416, 0], 10).check().is_ok());
        assert!(turn([31_417, 0, 0], 0).check().is_err());
        assert!(turn([i16::MIN, 0, 0], 0).check().is_err());
        assert!(turn([0; 3], 0xaa).check().is_ok());
        assert!(turn([0; 3], 11).check().is_err());
        assert!(turn([0; 3], 0xb0).check().is_err());
    }
}
