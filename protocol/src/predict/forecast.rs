//! The predicted path of the hand, and the parameters that travel.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::ahead::{Ahead, Motion};
use super::{HandState, MEMORY_TAU_S, Model};
use crate::time::Stamp;

/// A hand at rest may start at any moment, about this fast, m/s.
const ONSET_M_S: f64 = 0.5;

/// What the operator adapts, as plain numbers that travel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Params {
    /// Gain κ on every predicted displacement, in [0, 1]; 0 holds the newest position.
    pub gain: f64,
    /// Weight of the mixture against constant velocity before novelty is considered, in [0, 1].
    pub trust: f64,
    /// Factor on the velocity of the constant-velocity expert, in [0, 1]; 1 is undamped.
    pub cv_damping: f64,
}

/// A parameter is outside [0, 1], or NaN.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("predictor parameter {field} is {value}, not in [0, 1]")]
pub struct ParamsError {
    /// The parameter.
    pub field: &'static str,
    /// Its value.
    pub value: f64,
}

impl Default for Params {
    /// [`Params::DEFAULT`].
    fn default() -> Self {
        Self::DEFAULT
    }
}

impl Params {
    /// Full prediction, full trust in the mixture, and off the model half of the present velocity:
    /// over fast gestures undamped extrapolation is worse than standing still beyond 0.15 s.
    pub const DEFAULT: Self = Self {
        gain: 1.0,
        trust: 1.0,
        cv_damping: 0.5,
    };

    /// These parameters, if each is in [0, 1].
    ///
    /// # Errors
    /// [`ParamsError`] names the first that is not.
    pub fn checked(self) -> Result<Self, ParamsError> {
        for (field, value) in [
            ("gain", self.gain),
            ("trust", self.trust),
            ("cv_damping", self.cv_damping),
        ] {
            if !(0.0..=1.0).contains(&value) {
                return Err(ParamsError { field, value });
            }
        }
        Ok(self)
    }
}

/// The predicted path of the hand from one state: plain numbers, no reference to the model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Forecast {
    /// When the state it starts from was valid.
    pub t: Stamp,
    /// The newest position, m.
    pub x: Vector3<f64>,
    /// Where it goes from there, m.
    pub ahead: Ahead,
}

/// The hand at one moment of a [`Forecast`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prediction {
    /// Position, m.
    pub position: Vector3<f64>,
    /// Standard deviation along any one axis, m.
    pub sigma_m: f64,
    /// The moment lies after the last knot: position and deviation are those of the last knot.
    pub beyond: bool,
}

impl Forecast {
    /// Damped constant velocity alone, to the farthest knot: the prediction where no model is there.
    ///
    /// Its deviation is a wide guess: as if the hand might as well stop, turn or, from rest, start.
    pub fn constant_velocity(state: &HandState, params: &Params) -> Self {
        Self {
            t: state.t,
            x: state.x,
            ahead: Ahead::straight(&Motion::of(state), params),
        }
    }

    pub(super) fn blended(model: &Model, state: &HandState, params: &Params) -> Self {
        Self {
            t: state.t,
            x: state.x,
            ahead: Ahead::blended(model, &model.posterior(state), &Motion::of(state), params),
        }
    }

    /// The hand `h_s` seconds after `t`: linear between knots, held beyond the last one and said so;
    /// a negative (or NaN) horizon is the present.
    pub fn at(&self, h_s: f64) -> Prediction {
        let way = self.ahead.at(h_s);
        Prediction {
            position: self.x + way.displacement,
            sigma_m: way.sigma,
            beyond: way.beyond,
        }
    }

    /// The horizon of the last knot, s.
    pub fn reach_s(&self) -> f64 {
        self.ahead.reach_s()
    }
}

impl Motion {
    fn of(state: &HandState) -> Self {
        let (velocity, acceleration) = state.motion();
        Self {
            velocity,
            acceleration,
            onset: ONSET_M_S,
        }
    }
}

impl HandState {
    /// Velocity (m/s) and acceleration (m/s²) that the two quickest memories imply.
    ///
    /// In motion of constant acceleration `(x − mᵢ)/τᵢ = v − a·τᵢ`; two of them give v and a. Against
    /// `(x − m₁)/τ₁` alone this predicts smooth tasks better by a third (pouring at 100 ms .070 of hold
    /// for .099) and Kinect gestures worse by 2 to 7 %, where constant velocity has little weight.
    pub fn motion(&self) -> (Vector3<f64>, Vector3<f64>) {
        motion(self.x - self.memory[0], self.x - self.memory[1])
    }
}

/// See [`HandState::motion`], from the ways that the present is ahead of the two quickest memories.
pub(super) fn motion(ahead_1: Vector3<f64>, ahead_2: Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
    let [tau_1, tau_2, ..] = MEMORY_TAU_S;
    let slope_1 = ahead_1 / tau_1;
    let slope_2 = ahead_2 / tau_2;
    let acceleration = (slope_1 - slope_2) / (tau_2 - tau_1);
    (slope_1 + acceleration * tau_1, acceleration)
}
