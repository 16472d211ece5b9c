//! A bent plan as it travels: quantised, so that both ends compute it from the same numbers.

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use super::codec::DecodeError;
use super::state::{MAX_POSITION_M, POSITION_STEP_M, WireState};
use crate::predict::{Bend, Forecast, HandState, Held, MAX_RATE, Params};

/// Steps of a rate of 1.
const RATE_STEPS: f64 = 128.0;

/// The largest rate, in steps.
const MAX_RATE_STEPS: u8 = (MAX_RATE * RATE_STEPS) as u8;

/// Steps of a weight of 1.
const WEIGHT_STEPS: f64 = 127.0;

/// A weight between 0 and 1 has no entry beside the diagonal above ½.
const MAX_CROSS: i8 = 64;

/// [`Bend`] in integers, stated for the moment its message was sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct WireBend {
    /// The plan's time, µs; before its beginning and after its end the plan rests.
    pub plan_us: i64,
    /// Plan seconds per second, in 1/128, at most 192.
    pub rate: u8,
    /// What is left of displacements that were let go, in steps of 0.1 mm.
    pub left: [i32; 3],
    /// The hand, while it holds on.
    pub held: Option<WireHeld>,
}

/// [`Held`] in integers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct WireHeld {
    /// The hand's displacement since it took hold, in the place of a position.
    pub state: WireState,
    /// Prediction gain κ, in 1/255.
    pub gain: u8,
    /// Weight of the straight line against holding, in 1/255.
    pub straight: u8,
    /// The weight's lower triangle, row by row, in 1/127.
    pub weight: [i8; 6],
}

impl WireBend {
    /// The nearest that can travel; `None` if something lies beyond [`MAX_POSITION_M`] or is not finite.
    ///
    /// The plan's time is that which gives `at_s` (plan seconds) `ahead_s` after the moment it is stated for, at the
    /// rate as it travels: where the robot will read it, rounding the rate costs nothing.
    pub fn quantise(
        at_s: f64,
        ahead_s: f64,
        rate: f64,
        left: &Vector3<f64>,
        held: Option<WireHeld>,
    ) -> Option<Self> {
        let within = |v: &f64| v.abs() <= MAX_POSITION_M;
        if !(left.iter().all(within) && at_s.is_finite() && ahead_s.is_finite()) {
            return None;
        }
        let rate = (rate.clamp(0.0, MAX_RATE) * RATE_STEPS).round() as u8;
        let plan_s = at_s - f64::from(rate) / RATE_STEPS * ahead_s;
        Some(Self {
            plan_us: (plan_s * 1e6).round() as i64,
            rate,
            left: left.map(|v| (v / POSITION_STEP_M).round() as i32).into(),
            held,
        })
    }

    /// What both ends compute with.
    pub fn dequantise(&self) -> Bend {
        Bend {
            plan_s: self.plan_us as f64 * 1e-6,
            rate: f64::from(self.rate) / RATE_STEPS,
            left: Vector3::from(self.left.map(|n| f64::from(n) * POSITION_STEP_M)),
            held: self.held.as_ref().map(WireHeld::dequantise),
        }
    }

    pub(super) fn check(&self) -> Result<(), DecodeError> {
        let invalid = |field, why| Err(DecodeError::Invalid { field, why });
        if self.plan_us.unsigned_abs() > i64::MAX as u64 / 1000 {
            return invalid("bend.plan_us", "beyond the session clock");
        }
        if self.rate > MAX_RATE_STEPS {
            return invalid("bend.rate", "above 1.5");
        }
        let limit = (MAX_POSITION_M / POSITION_STEP_M) as i32;
        if !self.left.iter().all(|n| (-limit..=limit).contains(n)) {
            return invalid("bend.left", "beyond 100 m");
        }
        self.held.as_ref().map_or(Ok(()), WireHeld::check)
    }
}

impl WireHeld {
    /// The nearest that can travel; `None` as [`WireState::quantise`].
    ///
    /// Of `weight` only the lower triangle counts; it is symmetric, between 0 and 1.
    pub fn quantise(
        state: &HandState,
        gain: f64,
        straight: f64,
        weight: &Matrix3<f64>,
    ) -> Option<Self> {
        let byte = |v: f64| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
        let on = |i: usize| (weight[(i, i)].clamp(0.0, 1.0) * WEIGHT_STEPS).round() as i8;
        let beside =
            |i: usize, j: usize| (weight[(i, j)].clamp(-0.5, 0.5) * WEIGHT_STEPS).round() as i8;
        Some(Self {
            state: WireState::quantise(state)?,
            gain: byte(gain),
            straight: byte(straight),
            weight: [
                on(0),
                beside(1, 0),
                on(1),
                beside(2, 0),
                beside(2, 1),
                on(2),
            ],
        })
    }

    fn dequantise(&self) -> Held {
        let params = Params {
            gain: f64::from(self.gain) / 255.0,
            ..Params::only([0.0, 0.0, f64::from(self.straight) / 255.0])
        };
        let [xx, yx, yy, zx, zy, zz] = self.weight.map(|n| f64::from(n) / WEIGHT_STEPS);
        Held {
            push: Forecast::constant_velocity(&self.state.dequantise(), &params),
            weight: Matrix3::new(xx, yx, zx, yx, yy, zy, zx, zy, zz),
        }
    }

    fn check(&self) -> Result<(), DecodeError> {
        self.state.check()?;
        let [xx, yx, yy, zx, zy, zz] = self.weight;
        let crossed = |n: &i8| (-MAX_CROSS..=MAX_CROSS).contains(n);
        if [xx, yy, zz].iter().all(|n| *n >= 0) && [yx, zx, zy].iter().all(crossed) {
            return Ok(());
        }
        Err(DecodeError::Invalid {
            field: "bend.weight",
            why: "not between 0 and 1",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::Stamp;

    #[test]
    fn rounding_the_rate_costs_nothing_where_it_is_read() {
        for (rate, ahead_s) in [(0.0, 0.3), (0.3333, 0.17), (1.4567, 0.9), (7.0, 0.1)] {
            let wire = WireBend::quantise(2.0, ahead_s, rate, &Vector3::zeros(), None).unwrap();
            let bend = wire.dequantise();
            assert!((bend.plan_at(ahead_s) - 2.0).abs() < 1e-6, "{rate}");
            assert!((bend.rate - rate.min(MAX_RATE)).abs() <= 0.5 / RATE_STEPS);
            assert_eq!(wire.check(), Ok(()));
        }
        let far = Vector3::new(0.0, 101.0, f64::NAN);
        for left in [Vector3::y() * far[1], Vector3::x() * far[2]] {
            assert_eq!(WireBend::quantise(0.0, 0.0, 1.0, &left, None), None);
        }
    }

    #[test]
    fn weights_between_nothing_and_all_travel_to_a_step_and_others_are_refused() {
        let turn = nalgebra::Rotation3::from_euler_angles(0.4, -0.8, 1.1);
        let weight = turn * Matrix3::from_diagonal(&Vector3::new(1.0, 0.0, 0.4)) * turn.transpose();
        let mut state = HandState::first(Stamp(0), Vector3::zeros());
        state.advance(Stamp(33_000_000), Vector3::new(0.01, -0.02, 0.03));
        let held = WireHeld::quantise(&state, 1.0, 0.5, &weight).unwrap();
        assert_eq!(held.check(), Ok(()));
        assert!((held.dequantise().weight - weight).amax() <= 0.5 / WEIGHT_STEPS + 1e-12);
        for i in 0..6 {
            let mut bad = held;
            bad.weight[i] = if [0, 2, 5].contains(&i) { -1 } else { 65 };
            assert!(bad.check().is_err(), "{:?}", bad.weight);
        }
        let bend = WireBend::quantise(0.0, 0.0, 1.0, &Vector3::zeros(), Some(held)).unwrap();
        let refused = [
            WireBend { rate: 193, ..bend },
            WireBend {
                left: [0, 0, 1_000_001],
                ..bend
            },
            WireBend {
                plan_us: i64::MIN,
                ..bend
            },
        ];
        for bad in refused {
            assert!(bad.check().is_err(), "{bad:?}");
        }
    }
}
