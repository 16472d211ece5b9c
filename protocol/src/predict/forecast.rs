//! From the mixture's answer to a predicted path: the off-model guard, and what travels with it.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::{HandState, KNOT_SPACING_S, MAX_KNOTS, MEMORY_TAU_S, Model};
use crate::time::Stamp;

/// Novelty is counted in multiples of this many 90 % quantiles before trust halves.
const NOVELTY_MARGIN: f64 = 8.0;

/// A hand at rest may start at any moment, about this fast, m/s.
const ONSET_M_S: f64 = 0.5;

/// Horizons at which two ends compare their predictions, s.
const CHECK_HORIZONS_S: [f64; 3] = [0.1, 0.2, 0.4];

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

/// A predicted displacement and how far to trust it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Knot {
    /// Displacement from the newest position, m.
    pub displacement: Vector3<f64>,
    /// Standard deviation of the position along any one axis (root mean over the three), m.
    pub sigma_m: f64,
}

const STILL: Knot = Knot {
    displacement: Vector3::new(0.0, 0.0, 0.0),
    sigma_m: 0.0,
};

/// The predicted path of the hand from one state: plain numbers, no reference to the model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Forecast {
    /// When the state it starts from was valid.
    pub t: Stamp,
    /// The newest position, m.
    pub x: Vector3<f64>,
    /// Knot j is j·[`KNOT_SPACING_S`] after `t`; knot 0 is the present and entries beyond `count` are unused.
    pub knots: [Knot; MAX_KNOTS + 1],
    /// The last knot in use, at least 1.
    pub count: usize,
    /// Squared Mahalanobis distance of the state to the nearest component; infinite without a model.
    pub novelty: f64,
    /// The weight the mixture got against constant velocity, in [0, 1]; 0 without a model.
    pub weight: f64,
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
        let (velocity_m_s, acceleration) = state.motion();
        let speed2 = velocity_m_s.norm_squared() + ONSET_M_S * ONSET_M_S;
        let mut knots = [STILL; MAX_KNOTS + 1];
        for (j, knot) in knots.iter_mut().enumerate().skip(1) {
            let h_s = j as f64 * KNOT_SPACING_S;
            let bend2 = 0.25 * acceleration.norm_squared() * h_s * h_s;
            *knot = Knot {
                displacement: velocity_m_s * (params.cv_damping * h_s * params.gain),
                sigma_m: h_s * ((speed2 + bend2) / 3.0).sqrt(),
            };
        }
        Self {
            t: state.t,
            x: state.x,
            knots,
            count: MAX_KNOTS,
            novelty: f64::INFINITY,
            weight: 0.0,
        }
    }

    /// `w = trust/(1+(d²/(8·nov₉₀))²)`, `x̂ = x + κ·(w·gmr + (1−w)·cv)`; the deviation is that of the
    /// mixture of the two experts, the distance between them included.
    pub(super) fn blended(model: &Model, state: &HandState, params: &Params) -> Self {
        let posterior = model.posterior(state);
        let calibration = model.calibration();
        let excess = posterior.novelty / (NOVELTY_MARGIN * calibration.novelty90);
        let weight = params.trust / (1.0 + excess * excess);
        // Where the mixture's density underflows it has no answer that could be weighted with zero.
        let silent = weight.is_nan() || weight <= 0.0;
        let weight = if silent { 0.0 } else { weight };
        let velocity_m_s = state.motion().0 * params.cv_damping;
        let mut knots = [STILL; MAX_KNOTS + 1];
        for j in 1..=model.knots() {
            let i = j - 1;
            let straight = velocity_m_s * (j as f64 * KNOT_SPACING_S);
            let (learned, learned_m2) = if silent {
                (straight, 0.0)
            } else {
                let trace = posterior.covariance[i].trace();
                (
                    posterior.displacement[i],
                    calibration.covariance[i] * trace / 3.0,
                )
            };
            let between = (learned - straight).norm_squared() / 3.0;
            let displacement = learned * weight + straight * (1.0 - weight);
            let variance = weight * learned_m2
                + (1.0 - weight) * (calibration.straight_m2[i] + weight * between);
            knots[j] = Knot {
                displacement: displacement * params.gain,
                sigma_m: variance.sqrt(),
            };
        }
        Self {
            t: state.t,
            x: state.x,
            knots,
            count: model.knots(),
            novelty: posterior.novelty,
            weight,
        }
    }

    /// The hand `h_s` seconds after `t`: linear between knots, held beyond the last one and said so;
    /// a negative (or NaN) horizon is the present.
    pub fn at(&self, h_s: f64) -> Prediction {
        let u = h_s.max(0.0) / KNOT_SPACING_S;
        let last = self.count as f64;
        let beyond = u > last;
        let u = u.min(last);
        let i = (u as usize).min(self.count - 1);
        let s = u - i as f64;
        let (a, b) = (&self.knots[i], &self.knots[i + 1]);
        Prediction {
            position: self.x + a.displacement * (1.0 - s) + b.displacement * s,
            sigma_m: a.sigma_m * (1.0 - s) + b.sigma_m * s,
            beyond,
        }
    }

    /// The horizon of the last knot, s.
    pub fn reach_s(&self) -> f64 {
        self.count as f64 * KNOT_SPACING_S
    }

    /// The predictions at three fixed horizons, rounded to 1 µm and folded (FNV-1a): two ends that
    /// differ in it have diverged.
    pub fn checksum(&self) -> u32 {
        let mut hash = 0x811c_9dc5_u32;
        for h_s in CHECK_HORIZONS_S {
            for v in &self.at(h_s).position {
                for byte in ((v * 1e6).round() as i64).to_le_bytes() {
                    hash = (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193);
                }
            }
        }
        hash
    }
}

impl HandState {
    /// Velocity (m/s) and acceleration (m/s²) that the two quickest memories imply.
    ///
    /// In motion of constant acceleration `(x − mᵢ)/τᵢ = v − a·τᵢ`; two of them give v and a. Against
    /// `(x − m₁)/τ₁` alone this predicts smooth tasks better by a third (pouring at 100 ms .070 of hold
    /// for .099) and Kinect gestures worse by 2 to 7 %, where constant velocity has little weight.
    pub fn motion(&self) -> (Vector3<f64>, Vector3<f64>) {
        let [tau_1, tau_2, ..] = MEMORY_TAU_S;
        let slope_1 = (self.x - self.memory[0]) / tau_1;
        let slope_2 = (self.x - self.memory[1]) / tau_2;
        let acceleration = (slope_1 - slope_2) / (tau_2 - tau_1);
        (slope_1 + acceleration * tau_1, acceleration)
    }
}
