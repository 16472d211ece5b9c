//! A played motion bent by the operator's hand: when of the plan it is, and how far beside it.
//!
//! A pure function of the newest message: the robot adds up nothing, so a loss delays a correction and cannot
//! leave one behind.

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use super::Forecast;

/// What is left of a displacement that was let go decays with this time constant, s (driving.md §9).
pub const LET_GO_TAU_S: f64 = 0.3;

/// Largest plan seconds per second.
pub const MAX_RATE: f64 = 1.5;

/// A displacement is predicted no farther than this, s: a hand that is not heard of is not taken to push on.
pub const PUSH_REACH_S: f64 = 0.3;

/// Less than this of a displacement is none, m.
const NOTHING_M: f64 = 1e-3;

/// What the operator makes of a plan, from one moment on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Bend {
    /// The plan's time at that moment, s; before its beginning and after its end the plan rests.
    pub plan_s: f64,
    /// Plan seconds per second from then on, in [0, [`MAX_RATE`]].
    pub rate: f64,
    /// What is left at that moment of displacements that were let go, m.
    pub left: Vector3<f64>,
    /// The hand, while it holds on.
    pub held: Option<Held>,
}

/// A hand that holds on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Held {
    /// Its displacement since it took hold, m, and where that goes.
    pub push: Forecast,
    /// How much of it bends the plan: W = Λ⁻¹·g·Σ_o⁻¹, the hand's share in the product of two Gaussians.
    pub weight: Matrix3<f64>,
}

impl Bend {
    /// The plan's time `since_s` after the moment it is stated for, s.
    pub fn plan_at(&self, since_s: f64) -> f64 {
        self.plan_s + self.rate * since_s
    }

    /// How far beside the plan the hand belongs, m: `since_s` after the moment it is stated for, `since_sample_s` after
    /// the hand's newest sample.
    pub fn offset_at(&self, since_s: f64, since_sample_s: f64) -> Vector3<f64> {
        let left = self.left * libm::exp(-since_s.max(0.0) / LET_GO_TAU_S);
        match &self.held {
            Some(held) => left + held.weight * held.displacement_at(since_sample_s),
            None => left,
        }
    }

    /// Whether nothing bends the plan any more, `since_s` after the moment it is stated for.
    pub fn is_over(&self, since_s: f64) -> bool {
        self.held.is_none() && self.offset_at(since_s, 0.0).norm() < NOTHING_M
    }
}

impl Held {
    /// The hand's displacement `since_sample_s` after its newest sample, m.
    pub fn displacement_at(&self, since_sample_s: f64) -> Vector3<f64> {
        self.push.at(since_sample_s.min(PUSH_REACH_S)).position
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::predict::{HandState, Params};
    use crate::time::Stamp;

    fn pushing() -> Held {
        let v = Vector3::new(0.0, 0.3, 0.0);
        let mut state = HandState::first(Stamp(0), Vector3::zeros());
        for i in 1..=60 {
            let t = Stamp(i * 33_333_333);
            state.advance(t, v * t.as_secs_f64());
        }
        Held {
            push: Forecast::constant_velocity(&state, &Params::only([0.0, 0.0, 0.5])),
            weight: Matrix3::from_diagonal(&Vector3::new(1.0, 0.5, 1.0)),
        }
    }

    #[test]
    fn what_was_let_go_decays_and_what_is_held_is_predicted_so_far_and_no_farther() {
        let mut bend = Bend {
            plan_s: 1.0,
            rate: 0.5,
            left: Vector3::new(0.08, 0.0, 0.0),
            held: None,
        };
        assert_eq!((bend.plan_at(0.0), bend.plan_at(2.0)), (1.0, 2.0));
        assert_eq!(bend.offset_at(-0.2, 0.0), bend.left, "not before its time");
        let third = bend.offset_at(LET_GO_TAU_S, 0.0).norm() / 0.08;
        assert!((third - libm::exp(-1.0)).abs() < 1e-12);
        assert!(!bend.is_over(1.2) && bend.is_over(1.4));

        let held = pushing();
        bend.held = Some(held);
        assert!(!bend.is_over(99.0), "a hand that holds on is never nothing");
        let offset = |h: f64| bend.offset_at(f64::INFINITY, h)[1];
        // Half of the way, and of what is predicted of it.
        let x = held.push.x[1];
        assert!((offset(0.0) - 0.5 * x).abs() < 1e-12);
        let ahead = 0.5 * held.push.at(0.1).position[1];
        assert!((offset(0.1) - ahead).abs() < 1e-12 && ahead > 0.5 * x + 5e-3);
        assert!(offset(PUSH_REACH_S) > offset(0.2));
        assert_eq!(offset(PUSH_REACH_S), offset(0.6));
    }
}
