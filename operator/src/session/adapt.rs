//! All that adapts adapts here, at the operator, which sees every sample, and travels as numbers
//! (driving.md §5): how far to trust the mixture, and how much of the velocity lasts.

use std::collections::VecDeque;

use nalgebra::Vector3;
use telemime_protocol::predict::{Forecast, HandState, Model, Params};
use telemime_protocol::time::Stamp;

/// What an error made a sample ago still counts.
const MEMORY: f64 = 0.9;

/// The priors weigh as much as this many samples.
const PRIOR: f64 = 10.0;

/// A priori the straight line errs this many times as much (in squares) as the mixture.
const PRIOR_RATIO: f64 = 4.0;

/// Horizons judged at, s: below, everything is right; above, too few verdicts come in.
const HORIZON_S: std::ops::RangeInclusive<f64> = 0.05..=0.5;

/// A prediction that waits for its truth.
struct Pending {
    due: Stamp,
    origin: Vector3<f64>,
    mixture: Option<Vector3<f64>>,
    straight: Vector3<f64>,
}

pub(super) struct Adaptation {
    gain: f64,
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
    pub(super) fn new(gain: f64) -> Self {
        Self {
            gain: gain.clamp(0.0, 1.0),
            pending: VecDeque::new(),
            mixture_error: 0.0,
            straight_error: 0.0,
            prior: None,
            along: 0.0,
            square: 0.0,
        }
    }

    /// The numbers that travel.
    ///
    /// Trust: weights ∝ (mean squared error)⁻² (prediction.md §3). Damping: the least-squares factor on
    /// the velocity, drawn to ½ where nothing has moved yet.
    pub(super) fn params(&self) -> Params {
        let defaults = Params::default();
        let Some(prior) = self.prior else {
            return Params {
                gain: self.gain,
                ..defaults
            };
        };
        let mixture = (self.mixture_error + prior).powi(2);
        let straight = (self.straight_error + PRIOR_RATIO * prior).powi(2);
        let cv_damping = (self.along + 0.5 * prior) / (self.square + prior);
        Params {
            gain: self.gain,
            trust: straight / (straight + mixture),
            cv_damping: cv_damping.clamp(0.0, 1.0),
        }
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
            self.prior = mixture.map(|p| PRIOR * (3.0 * p.sigma_m * p.sigma_m).max(1e-8));
        }
        self.pending.push_back(Pending {
            due: newest.t.offset_by_secs(horizon_s),
            origin: newest.x,
            mixture: mixture.map(|p| p.position),
            straight,
        });
    }

    fn judge(&mut self, pending: &Pending, truth: Vector3<f64>) {
        let (run, moved) = (pending.straight - pending.origin, truth - pending.origin);
        self.along = MEMORY * self.along + run.dot(&moved);
        self.square = MEMORY * self.square + run.norm_squared();
        let damping = self.params().cv_damping;
        let straight = pending.origin + run * damping;
        self.straight_error = MEMORY * self.straight_error + (straight - truth).norm_squared();
        if let Some(mixture) = pending.mixture {
            self.mixture_error = MEMORY * self.mixture_error + (mixture - truth).norm_squared();
        }
    }
}
