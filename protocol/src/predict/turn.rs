//! The same predictor for orientations: memories, features and displacements are rotation vectors.
//!
//! No single chart holds every orientation, so the absolute feature is taken at each component's own
//! mean: the logarithm's cut then lies where that component has nothing to say.

use nalgebra::{SVector, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use super::ahead::{Ahead, CHECK_HORIZONS_S, FOLD_SEED, Motion, fold};
use super::forecast::{Forecast, motion};
use super::state::blend;
use super::{Experts, FEATURES, MEMORY_TAU_S, Model, ModelError, Params, Posterior};
use crate::pose;
use crate::time::Stamp;

/// A hand that does not turn may begin to at any moment, about this fast, rad/s.
const ONSET_RAD_S: f64 = 1.0;

/// No hand turns straight on for longer than about this, rad.
const REACH_RAD: f64 = 1.0;

/// The newest orientation of the hand with exponential memories of how it was turned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TurnState {
    /// When the newest sample is valid.
    pub t: Stamp,
    /// The newest orientation, from the hand's own axes to the tracker's.
    pub q: UnitQuaternion<f64>,
    /// Exponential memories of it, one for each of [`MEMORY_TAU_S`].
    pub memory: [UnitQuaternion<f64>; 4],
}

impl TurnState {
    /// The state after the first sample: the hand has always been turned so.
    pub fn first(t: Stamp, q: UnitQuaternion<f64>) -> Self {
        Self {
            t,
            q,
            memory: [q; 4],
        }
    }

    /// Takes the sample `q`, valid at `t`; says whether it was taken.
    ///
    /// A sample that is not later than the newest, or not finite, changes nothing. The memories move as
    /// those of [`HandState`](super::HandState), in the tangent space at `q`:
    /// `m ← q·exp(e·log(q⁻¹m) + (r−e)·log(q⁻¹q_prev))`, `e = exp(−dt/τ)`, `r = (1−e)·τ/dt`.
    pub fn advance(&mut self, t: Stamp, q: UnitQuaternion<f64>) -> bool {
        if t <= self.t || !q.coords.iter().all(|v| v.is_finite()) {
            return false;
        }
        let before = pose::between(&q, &self.q);
        for (m, tau_s) in self.memory.iter_mut().zip(MEMORY_TAU_S) {
            let (e, r) = blend(t.secs_since(self.t), tau_s);
            *m = pose::moved(&q, &(pose::between(&q, m) * e + before * (r - e)));
        }
        self.t = t;
        self.q = q;
        true
    }

    /// `[log(c⁻¹q), log(m₁⁻¹q), …, log(m₄⁻¹q)]` about the chart `c`, rad.
    pub fn features(&self, chart: &UnitQuaternion<f64>) -> SVector<f64, FEATURES> {
        let mut f = SVector::<f64, FEATURES>::zeros();
        f.fixed_rows_mut::<3>(0)
            .copy_from(&pose::between(chart, &self.q));
        for (i, m) in self.memory.iter().enumerate() {
            f.fixed_rows_mut::<3>(3 * (i + 1))
                .copy_from(&pose::between(m, &self.q));
        }
        f
    }

    /// From each memory to the present, rad, in the present's own axes.
    pub fn ways(&self) -> [Vector3<f64>; 4] {
        self.memory.map(|m| pose::between(&m, &self.q))
    }

    /// Angular velocity (rad/s, in the hand's own axes) that the two quickest memories imply.
    pub fn angular_velocity(&self) -> Vector3<f64> {
        Motion::turning(&self.ways()).velocity
    }
}

impl Motion {
    fn turning(ways: &[Vector3<f64>; 4]) -> Self {
        let (velocity, acceleration) = motion(ways[0], ways[1]);
        Self {
            velocity,
            acceleration,
            onset: ONSET_RAD_S,
            reach: REACH_RAD,
        }
    }
}

/// A learned predictor of orientation: a [`Model`] in radians whose absolute feature is taken about a
/// chart of each component's own.
#[derive(Debug, Clone, PartialEq)]
pub struct TurnModel {
    model: Model,
    charts: Vec<UnitQuaternion<f64>>,
}

impl TurnModel {
    /// `charts`, one a component of `model`.
    ///
    /// # Errors
    /// [`ModelError::Charts`], [`ModelError::NotFinite`].
    pub fn new(model: Model, charts: Vec<UnitQuaternion<f64>>) -> Result<Self, ModelError> {
        if charts.len() != model.components().len() {
            return Err(ModelError::Charts {
                found: charts.len(),
                expected: model.components().len(),
            });
        }
        let unit = |q: &UnitQuaternion<f64>| (q.coords.norm_squared() - 1.0).abs() < 1e-6;
        if !charts.iter().all(unit) {
            return Err(ModelError::NotFinite { field: "a chart" });
        }
        Ok(Self { model, charts })
    }

    /// The mixture, in radians.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// The orientation about which each component's absolute feature is taken.
    pub fn charts(&self) -> &[UnitQuaternion<f64>] {
        &self.charts
    }

    /// Conditions the mixture on the state's features.
    pub fn posterior(&self, state: &TurnState) -> Posterior {
        let units = self.model.standardisation();
        let mut f = units.bent(state.features(&state.q));
        self.model.posterior_of(|k| {
            let absolute = pose::between(&self.charts[k], &state.q);
            f.fixed_rows_mut::<3>(0).copy_from(&absolute);
            f
        })
    }

    /// Predicts from `state`, by the other experts where the motion is new.
    ///
    /// A pure function; allocates nothing.
    pub fn forecast(&self, state: &TurnState, params: &Params) -> TurnForecast {
        TurnForecast::fused(state, &TurnForecast::experts(state, Some(self)), params)
    }
}

/// The predicted course of the orientation from one state.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TurnForecast {
    /// When the state it starts from was valid.
    pub t: Stamp,
    /// The newest orientation.
    pub q: UnitQuaternion<f64>,
    /// How it turns from there: rotation vectors in its own axes, rad.
    pub ahead: Ahead,
}

/// The orientation at one moment of a [`TurnForecast`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TurnPrediction {
    /// Orientation.
    pub orientation: UnitQuaternion<f64>,
    /// Standard deviation about any one axis, rad.
    pub sigma_rad: f64,
    /// The moment lies after the last knot: the values are those of the last knot.
    pub beyond: bool,
}

impl TurnForecast {
    /// What each expert says: without a model only turning straight on (and holding).
    pub fn experts(state: &TurnState, model: Option<&TurnModel>) -> Experts {
        let ways = state.ways();
        let motion = Motion::turning(&ways);
        match model {
            Some(turn) => Experts::all(&turn.model, &turn.posterior(state), &ways, &motion),
            None => Experts::straight(&motion),
        }
    }

    /// Their answers, fused: what both ends predict. A pure function; allocates nothing.
    pub fn fused(state: &TurnState, experts: &Experts, params: &Params) -> Self {
        Self {
            t: state.t,
            q: state.q,
            ahead: Ahead::fused(experts, params),
        }
    }

    /// Turning straight on or holding: the prediction where no model is there.
    pub fn constant_velocity(state: &TurnState, params: &Params) -> Self {
        Self::fused(state, &Self::experts(state, None), params)
    }

    /// The orientation `h_s` seconds after `t`; outside the knots as [`Ahead::at`].
    pub fn at(&self, h_s: f64) -> TurnPrediction {
        let way = self.ahead.at(h_s);
        TurnPrediction {
            orientation: pose::moved(&self.q, &way.displacement),
            sigma_rad: way.sigma,
            beyond: way.beyond,
        }
    }
}

/// The predictions at three fixed horizons, positions in µm and rotation vectors in µrad, folded (FNV-1a):
/// two ends that differ in it have diverged.
pub fn checksum(place: &Forecast, turn: Option<&TurnForecast>) -> u32 {
    let positions = CHECK_HORIZONS_S.map(|h_s| place.at(h_s).position);
    let hash = fold(FOLD_SEED, positions.iter().flatten());
    let Some(turn) = turn else {
        return hash;
    };
    let ways = CHECK_HORIZONS_S.map(|h_s| turn.ahead.at(h_s).displacement);
    fold(hash, ways.iter().flatten())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn turning(rate: Vector3<f64>, stamps_ms: impl Iterator<Item = i64>) -> TurnState {
        let start = pose::exp(&Vector3::new(0.4, -2.0, 1.5));
        let mut state = TurnState::first(Stamp(0), start);
        for ms in stamps_ms {
            let t = Stamp(ms * 1_000_000);
            let q = pose::moved(&start, &(rate * t.as_secs_f64()));
            // Whatever sign the tracker gives it.
            let q = if ms % 2 == 0 {
                UnitQuaternion::new_unchecked(-q.into_inner())
            } else {
                q
            };
            assert!(state.advance(t, q));
        }
        state
    }

    #[test]
    fn in_steady_turning_a_memory_lags_by_its_time_constant() {
        let rate = Vector3::new(0.6, -1.0, 0.3);
        let state = turning(rate, (1..=500).map(|i| i * 33));
        for (m, tau_s) in state.memory.iter().zip(MEMORY_TAU_S) {
            assert!((pose::between(m, &state.q) - rate * tau_s).norm() < 1e-6);
        }
        assert!((state.angular_velocity() - rate).norm() < 1e-6);
        let straight = Params::only([0.0, 0.0, 1.0]);
        let ahead = TurnForecast::constant_velocity(&state, &straight).at(0.2);
        let way = rate * 0.2;
        let wanted = pose::moved(&state.q, &(way / (1.0 + way.norm_squared()).sqrt()));
        assert!(ahead.orientation.angle_to(&wanted) < 1e-6);
    }

    #[test]
    fn memories_do_not_depend_on_how_a_steady_turn_is_sampled() {
        let rate = Vector3::new(0.2, 0.9, -0.5);
        let dense = turning(rate, 1..=300);
        let sparse = turning(rate, [17, 40, 41, 170, 300].into_iter());
        for (a, b) in dense.memory.iter().zip(&sparse.memory) {
            assert!(a.angle_to(b) < 1e-7);
        }
    }

    #[test]
    fn late_repeated_and_non_finite_samples_change_nothing() {
        let mut state = turning(Vector3::x(), [10].into_iter());
        let before = state;
        let nan = UnitQuaternion::new_unchecked(nalgebra::Quaternion::new(f64::NAN, 0.0, 0.0, 0.0));
        assert!(!state.advance(before.t, UnitQuaternion::identity()));
        assert!(!state.advance(Stamp(0), UnitQuaternion::identity()));
        assert!(!state.advance(Stamp(1 << 40), nan));
        assert_eq!(state, before);
    }
}
