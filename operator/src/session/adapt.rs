//! All that adapts adapts here, at the operator, which sees every sample, and travels as numbers
//! (driving.md §5): how far to trust the mixture, and how much of the velocity lasts.

use std::collections::VecDeque;

use nalgebra::Vector3;
use telemime_protocol::predict::{Forecast, HandState, Model, Params};
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;

/// What an error made a sample ago still counts.
const MEMORY: f64 = 0.9;

/// The priors weigh as much as this many samples.
const PRIOR: f64 = 10.0;

/// Bounds of the mixture's trust before anything was seen: whatever was calibrated can still be outvoted.
const PRIOR_TRUST: std::ops::RangeInclusive<f64> = 0.05..=0.98;

/// Without a mixture an error of this size is one, m: what a depth sensor is good for.
const SENSOR_M: f64 = 0.01;

/// A hand that has moved less than this share of the skill's reach lately is at rest.
const REST: f64 = 0.02;

/// Horizons judged at, s: below, everything is right; above, too few verdicts come in.
const HORIZON_S: std::ops::RangeInclusive<f64> = 0.05..=0.5;

/// A prediction that waits for its truth.
struct Pending {
    due: Stamp,
    weight: f64,
    origin: Vector3<f64>,
    mixture: Option<Vector3<f64>>,
    straight: Vector3<f64>,
}

pub(super) struct Adaptation {
    gain: f64,
    /// A priori the straight line errs this many times as much (in squares) as the mixture.
    ratio: f64,
    damping: f64,
    rest_m: f64,
    pending: VecDeque<Pending>,
    mixture_error: f64,
    straight_error: f64,
    prior: Option<f64>,
    along: f64,
    square: f64,
}

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

impl Adaptation {
    /// Starts from what was calibrated with the skill, or from the defaults.
    pub(super) fn new(gain: f64, skill: Option<&Skill>) -> Self {
        let start = skill.map_or(Params::DEFAULT, |skill| {
            skill.predictor().calibration().params
        });
        let trust = start.trust.clamp(*PRIOR_TRUST.start(), *PRIOR_TRUST.end());
        Self {
            gain: gain.clamp(0.0, 1.0),
            ratio: (trust / (1.0 - trust)).sqrt(),
            damping: start.cv_damping,
            rest_m: skill
                .map_or(0.0, |skill| REST * skill.stats().reach_m)
                .max(1e-3),
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
    pub(super) fn params(&self, hand: &HandState) -> Params {
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
    fn moving(&self, hand: &HandState) -> f64 {
        let moved = hand
            .memory
            .iter()
            .map(|m| (hand.x - m).norm_squared())
            .fold(0.0, f64::max);
        moved / (moved + self.rest_m * self.rest_m)
    }

    /// Judges what was predicted for the time up to `newest`, and predicts `horizon_s` ahead of it.
    pub(super) fn observe(
        &mut self,
        previous: &HandState,
        newest: &HandState,
        model: Option<&Model>,
        horizon_s: f64,
    ) {
        let span_s = newest.t.secs_since(previous.t);
        while self.pending.front().is_some_and(|p| p.due <= newest.t) {
            let Some(pending) = self.pending.pop_front() else {
                break;
            };
            let u = (pending.due.secs_since(previous.t) / span_s).clamp(0.0, 1.0);
            self.judge(&pending, previous.x.lerp(&newest.x, u));
        }
        let horizon_s = horizon_s.clamp(*HORIZON_S.start(), *HORIZON_S.end());
        let mixture = model.map(|model| model.forecast(newest, &MIXTURE).at(horizon_s));
        let straight = Forecast::constant_velocity(newest, &UNDAMPED)
            .at(horizon_s)
            .position;
        if self.prior.is_none() {
            let sigma_m = mixture.map_or(SENSOR_M, |p| p.sigma_m);
            self.prior = Some(PRIOR * (3.0 * sigma_m * sigma_m).max(1e-8));
        }
        self.pending.push_back(Pending {
            due: newest.t.offset_by_secs(horizon_s),
            weight: self.moving(newest),
            origin: newest.x,
            mixture: mixture.map(|p| p.position),
            straight,
        });
    }

    fn judge(&mut self, pending: &Pending, truth: Vector3<f64>) {
        let (run, moved) = (pending.straight - pending.origin, truth - pending.origin);
        let straight = pending.origin + run * self.cv_damping();
        self.straight_error =
            MEMORY * self.straight_error + pending.weight * (straight - truth).norm_squared();
        if let Some(mixture) = pending.mixture {
            self.mixture_error =
                MEMORY * self.mixture_error + pending.weight * (mixture - truth).norm_squared();
        }
        self.along = MEMORY * self.along + run.dot(&moved);
        self.square = MEMORY * self.square + run.norm_squared();
    }
}
