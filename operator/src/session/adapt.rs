//! All that adapts adapts here, at the operator, which sees every sample, and travels as numbers
//! (driving.md §5): how far to trust the mixture, and how much of the velocity lasts. The same for
//! positions and orientations.

use std::collections::VecDeque;

use nalgebra::{UnitQuaternion, Vector3};
use telemime_protocol::pose;
use telemime_protocol::predict::{
    Forecast, HandState, Model, Params, TurnForecast, TurnModel, TurnState, Way,
};
use telemime_protocol::time::Stamp;

/// What an error made a sample ago still counts.
const MEMORY: f64 = 0.9;

/// The priors weigh as much as this many samples.
const PRIOR: f64 = 10.0;

/// Bounds of the mixture's trust before anything was seen: whatever was calibrated can still be outvoted.
const PRIOR_TRUST: std::ops::RangeInclusive<f64> = 0.05..=0.98;

/// Horizons judged at, s: below, everything is right; above, too few verdicts come in.
const HORIZON_S: std::ops::RangeInclusive<f64> = 0.05..=0.5;

/// A hand that has moved less than this share of the skill's reach lately is at rest.
const REST: f64 = 0.02;

/// A hand that turns less than this lately is at rest, rad.
const REST_RAD: f64 = 0.02;

/// Without a mixture an error of this size is one: what a depth sensor is good for, m and rad.
const SENSOR: f64 = 0.01;

const UNDAMPED: Params = Params {
    gain: 1.0,
    trust: 0.0,
    cv_damping: 1.0,
};
const MIXTURE: Params = Params {
    gain: 1.0,
    trust: 1.0,
    cv_damping: 0.0,
};

/// What is predicted: a state with memories, in a space where differences are vectors (m, rad).
pub(super) trait Course: Copy {
    /// Where it is.
    type Point: Copy;
    /// What was learned of it.
    type Model;

    fn t(&self) -> Stamp;
    fn point(&self) -> Self::Point;
    /// From each memory to the present.
    fn ways(&self) -> [Vector3<f64>; 4];
    /// `u` of the way from one point to the other.
    fn between(from: &Self::Point, to: &Self::Point, u: f64) -> Self::Point;
    fn way(from: &Self::Point, to: &Self::Point) -> Vector3<f64>;
    fn learned(&self, model: &Self::Model, h_s: f64) -> Way;
    fn straight(&self, h_s: f64) -> Vector3<f64>;
}

impl Course for HandState {
    type Point = Vector3<f64>;
    type Model = Model;

    fn t(&self) -> Stamp {
        self.t
    }

    fn point(&self) -> Vector3<f64> {
        self.x
    }

    fn ways(&self) -> [Vector3<f64>; 4] {
        self.memory.map(|m| self.x - m)
    }

    fn between(from: &Vector3<f64>, to: &Vector3<f64>, u: f64) -> Vector3<f64> {
        from.lerp(to, u)
    }

    fn way(from: &Vector3<f64>, to: &Vector3<f64>) -> Vector3<f64> {
        to - from
    }

    fn learned(&self, model: &Model, h_s: f64) -> Way {
        model.forecast(self, &MIXTURE).ahead.at(h_s)
    }

    fn straight(&self, h_s: f64) -> Vector3<f64> {
        let forecast = Forecast::constant_velocity(self, &UNDAMPED);
        forecast.ahead.at(h_s).displacement
    }
}

impl Course for TurnState {
    type Point = UnitQuaternion<f64>;
    type Model = TurnModel;

    fn t(&self) -> Stamp {
        self.t
    }

    fn point(&self) -> UnitQuaternion<f64> {
        self.q
    }

    fn ways(&self) -> [Vector3<f64>; 4] {
        self.memory.map(|m| pose::between(&m, &self.q))
    }

    fn between(
        from: &UnitQuaternion<f64>,
        to: &UnitQuaternion<f64>,
        u: f64,
    ) -> UnitQuaternion<f64> {
        pose::moved(from, &(pose::between(from, to) * u))
    }

    fn way(from: &UnitQuaternion<f64>, to: &UnitQuaternion<f64>) -> Vector3<f64> {
        pose::between(from, to)
    }

    fn learned(&self, model: &TurnModel, h_s: f64) -> Way {
        model.forecast(self, &MIXTURE).ahead.at(h_s)
    }

    fn straight(&self, h_s: f64) -> Vector3<f64> {
        let forecast = TurnForecast::constant_velocity(self, &UNDAMPED);
        forecast.ahead.at(h_s).displacement
    }
}

/// A prediction that waits for its truth: displacements from `origin`.
struct Pending<P> {
    due: Stamp,
    weight: f64,
    origin: P,
    mixture: Option<Vector3<f64>>,
    straight: Vector3<f64>,
}

pub(super) struct Adaptation<C: Course> {
    gain: f64,
    /// A priori the straight line errs this many times as much (in squares) as the mixture.
    ratio: f64,
    damping: f64,
    rest: f64,
    pending: VecDeque<Pending<C::Point>>,
    mixture_error: f64,
    straight_error: f64,
    prior: Option<f64>,
    along: f64,
    square: f64,
}

impl Adaptation<HandState> {
    /// For positions; `start` is what was calibrated with the skill, `reach_m` how far it goes.
    pub(super) fn of_places(gain: f64, start: Option<Params>, reach_m: f64) -> Self {
        Self::new(gain, start, (REST * reach_m).max(1e-3))
    }
}

impl Adaptation<TurnState> {
    /// For orientations.
    pub(super) fn of_turns(gain: f64, start: Option<Params>) -> Self {
        Self::new(gain, start, REST_RAD)
    }
}

impl<C: Course> Adaptation<C> {
    /// Starts from what was calibrated, or from the defaults; less than `rest` is no motion.
    fn new(gain: f64, start: Option<Params>, rest: f64) -> Self {
        let start = start.unwrap_or(Params::DEFAULT);
        let trust = start.trust.clamp(*PRIOR_TRUST.start(), *PRIOR_TRUST.end());
        Self {
            gain: gain.clamp(0.0, 1.0),
            ratio: (trust / (1.0 - trust)).sqrt(),
            damping: start.cv_damping,
            rest,
            pending: VecDeque::new(),
            mixture_error: 0.0,
            straight_error: 0.0,
            prior: None,
            along: 0.0,
            square: 0.0,
        }
    }

    /// The numbers that travel, for a prediction from `hand`.
    ///
    /// Trust: weights ∝ (mean squared error)⁻² (prediction.md §3), and less while the hand rests: a skill
    /// knows that motion will begin, not when. Damping: the least-squares factor on the velocity, drawn to
    /// the calibrated one where nothing has moved yet.
    pub(super) fn params(&self, hand: &C) -> Params {
        let prior = self.prior.unwrap_or(1.0);
        let mixture = (self.mixture_error + prior).powi(2);
        let straight = (self.straight_error + self.ratio * prior).powi(2);
        let trust = self.moving(hand) * straight / (straight + mixture);
        Params {
            gain: self.gain,
            trust,
            cv_damping: self.cv_damping(),
        }
    }

    fn cv_damping(&self) -> f64 {
        let prior = self.prior.unwrap_or(1.0);
        ((self.along + self.damping * prior) / (self.square + prior)).clamp(0.0, 1.0)
    }

    /// From 0 for a hand at rest to 1 for one in motion.
    fn moving(&self, hand: &C) -> f64 {
        let moved = hand
            .ways()
            .iter()
            .map(Vector3::norm_squared)
            .fold(0.0, f64::max);
        moved / (moved + self.rest * self.rest)
    }

    /// Judges what was predicted for the time up to `newest`, and predicts `horizon_s` ahead of it.
    pub(super) fn observe(
        &mut self,
        previous: &C,
        newest: &C,
        model: Option<&C::Model>,
        horizon_s: f64,
    ) {
        let span_s = newest.t().secs_since(previous.t());
        while self.pending.front().is_some_and(|p| p.due <= newest.t()) {
            let Some(pending) = self.pending.pop_front() else {
                break;
            };
            let u = (pending.due.secs_since(previous.t()) / span_s).clamp(0.0, 1.0);
            let truth = C::between(&previous.point(), &newest.point(), u);
            self.judge(&pending, &C::way(&pending.origin, &truth));
        }
        let horizon_s = horizon_s.clamp(*HORIZON_S.start(), *HORIZON_S.end());
        let mixture = model.map(|model| newest.learned(model, horizon_s));
        if self.prior.is_none() {
            let sigma = mixture.map_or(SENSOR, |way| way.sigma);
            self.prior = Some(PRIOR * (3.0 * sigma * sigma).max(1e-8));
        }
        self.pending.push_back(Pending {
            due: newest.t().offset_by_secs(horizon_s),
            weight: self.moving(newest),
            origin: newest.point(),
            mixture: mixture.map(|way| way.displacement),
            straight: newest.straight(horizon_s),
        });
    }

    fn judge(&mut self, pending: &Pending<C::Point>, moved: &Vector3<f64>) {
        let run = pending.straight;
        let straight = run * self.cv_damping();
        self.straight_error =
            MEMORY * self.straight_error + pending.weight * (straight - moved).norm_squared();
        if let Some(mixture) = pending.mixture {
            self.mixture_error =
                MEMORY * self.mixture_error + pending.weight * (mixture - moved).norm_squared();
        }
        self.along = MEMORY * self.along + run.dot(moved);
        self.square = MEMORY * self.square + run.norm_squared();
    }
}
