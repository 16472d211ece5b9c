//! What predicts: baselines, the mixture alone, and what a session sends.

use std::sync::Arc;

use nalgebra::{Matrix3, Vector1, Vector3};
use telemime_operator::demonstration::{Demonstration, Sample};
use telemime_operator::session::SessionConfig;
use telemime_operator::session::adapt::Adaptation;
use telemime_protocol::pose;
use telemime_protocol::predict::{
    Ahead, Calibration, HandState, KNOT_SPACING_S, MAX_KNOTS, Posterior, TurnState,
};
use telemime_protocol::skill::{Gmr, Skill};
use telemime_protocol::time::Stamp;

use super::kalman::Kalman;
use super::live::{Live, Said, on_session_clock};

/// What of the hand is predicted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Side {
    /// Where it is; ways are displacements, m.
    Place,
    /// How it is turned; ways are rotation vectors in the present's own axes, rad.
    Turn,
}

impl Side {
    /// The true way from sample `i` to the hand at `t_s`.
    pub(super) fn way(self, d: &Demonstration, i: usize, t_s: f64) -> Vector3<f64> {
        let now = &d.samples()[i];
        match self {
            Self::Place => d.position_at(t_s) - now.position,
            Self::Turn => match (now.orientation, d.orientation_at(t_s)) {
                (Some(q), Some(later)) => pose::between(&q, &later),
                _ => Vector3::zeros(),
            },
        }
    }
}

/// Variances below this are a sensor at rest, not precision, m² or rad².
const LEAST_2: f64 = 1e-8;

/// A predicted way from the newest sample.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Guess {
    pub(crate) way: Vector3<f64>,
    /// Its covariance, where the predictor states one.
    pub(crate) spread: Option<Matrix3<f64>>,
}

impl Guess {
    /// The squared Mahalanobis distance of what came; `None` without a covariance.
    pub(crate) fn distance2(&self, truth: &Vector3<f64>) -> Option<f64> {
        let covariance = self.spread? + Matrix3::identity() * LEAST_2;
        let error = self.way - truth;
        Some(error.dot(&covariance.cholesky()?.solve(&error)))
    }
}

impl Guess {
    /// What `ahead` says of `h_s` seconds after the state it starts from.
    pub(crate) fn of(ahead: &Ahead, h_s: f64) -> Self {
        Self {
            way: ahead.at(h_s).displacement,
            spread: Some(covariance(ahead, h_s)),
        }
    }
}

impl From<Vector3<f64>> for Guess {
    fn from(way: Vector3<f64>) -> Self {
        Self { way, spread: None }
    }
}

/// A predictor at work on one performance.
pub(super) trait Expert {
    /// Takes the next sample.
    fn take(&mut self, sample: &Sample);

    /// The way from the newest sample to `h_s` later.
    fn ahead(&self, h_s: f64) -> Guess;

    /// Squared Mahalanobis distance of the newest state to what was learned, in multiples of the calibrated
    /// 90 % quantile; `None` of predictors that have learned nothing.
    fn novelty(&self) -> Option<f64> {
        None
    }
}

/// Names, in the order of [`experts`].
pub(super) const PLACE_NAMES: [&str; 9] = [
    "hold",
    "constant velocity",
    "damped velocity ×0.5",
    "generic",
    "Kalman",
    "clock-indexed GMR",
    "mixture alone",
    "guard alone",
    GUARDED,
];

/// The same of orientations.
pub(super) const TURN_NAMES: [&str; 8] = [
    "hold",
    "constant velocity",
    "damped velocity ×0.5",
    "generic",
    "clock-indexed GMR",
    "mixture alone",
    "guard alone",
    GUARDED,
];

/// What a session sends: the predictor as it is used.
pub(super) const GUARDED: &str = "guarded";

/// All of them, for one performance. `kalman` was tuned on what `skill` was learned from; what a session sends is set
/// to `session`.
pub(super) fn experts(
    side: Side,
    skill: &Arc<Skill>,
    kalman: &Kalman,
    session: &SessionConfig,
) -> Vec<Box<dyn Expert>> {
    let damped = |factor: f64| -> Box<dyn Expert> { Box::new(Straight::new(side, factor)) };
    let mut all = vec![damped(0.0), damped(1.0), damped(0.5)];
    all.push(Box::new(Generic {
        side,
        skill: Arc::clone(skill),
        hand: None,
    }));
    if side == Side::Place {
        all.push(Box::new(kalman.clone()));
    }
    all.push(Box::new(Clock::new(side, skill)));
    all.push(Box::new(Mixture {
        side,
        skill: Arc::clone(skill),
        hand: None,
        posterior: None,
    }));
    all.push(Box::new(Guard::new(side, skill)));
    all.push(Box::new(Guarded::new(side, skill, session)));
    all
}

/// Hand and orientation with their memories.
#[derive(Clone, Copy)]
struct Hand {
    place: HandState,
    turn: Option<TurnState>,
}

impl Hand {
    fn take(hand: &mut Option<Self>, sample: &Sample) -> Self {
        let t = Stamp::from_secs_f64(sample.t_s);
        let hand = hand.get_or_insert_with(|| Self {
            place: HandState::first(t, sample.position),
            turn: sample.orientation.map(|q| TurnState::first(t, q)),
        });
        hand.place.advance(t, sample.position);
        if let (Some(turn), Some(q)) = (&mut hand.turn, sample.orientation) {
            turn.advance(t, q);
        }
        *hand
    }
}

/// On at a share of the present velocity; none of it is holding the newest sample.
struct Straight {
    side: Side,
    factor: f64,
    hand: Option<Hand>,
    velocity: Vector3<f64>,
}

impl Straight {
    fn new(side: Side, factor: f64) -> Self {
        Self {
            side,
            factor,
            hand: None,
            velocity: Vector3::zeros(),
        }
    }
}

impl Expert for Straight {
    fn take(&mut self, sample: &Sample) {
        let hand = Hand::take(&mut self.hand, sample);
        self.velocity = match (self.side, hand.turn) {
            (Side::Place, _) => hand.place.motion().0,
            (Side::Turn, Some(turn)) => turn.angular_velocity(),
            (Side::Turn, None) => Vector3::zeros(),
        };
    }

    fn ahead(&self, h_s: f64) -> Guess {
        (self.velocity * (self.factor * h_s)).into()
    }
}

/// A fixed linear rule on the memories, for any motion of this speed.
struct Generic {
    side: Side,
    skill: Arc<Skill>,
    hand: Option<Hand>,
}

impl Expert for Generic {
    fn take(&mut self, sample: &Sample) {
        Hand::take(&mut self.hand, sample);
    }

    fn ahead(&self, h_s: f64) -> Guess {
        let turn = self.skill.turn().map(|turn| turn.predictor.model());
        let (model, ways) = match (self.side, &self.hand, turn) {
            (Side::Place, Some(hand), _) => (self.skill.predictor(), hand.place.ways()),
            (Side::Turn, Some(Hand { turn: Some(q), .. }), Some(model)) => (model, q.ways()),
            _ => return Vector3::zeros().into(),
        };
        let lead = &model.generic().lead;
        let knot = |j: usize| match j.checked_sub(1) {
            None => Vector3::zeros(),
            Some(i) => ways.iter().zip(lead).map(|(way, lead)| way * lead[i]).sum(),
        };
        let (j, s) = between(h_s);
        Vector3::lerp(&knot(j), &knot(j + 1), s).into()
    }
}

/// The knot before a horizon, and how far it is to the next, from 0 to 1.
fn between(h_s: f64) -> (usize, f64) {
    let u = h_s / KNOT_SPACING_S;
    let j = (u as usize).min(MAX_KNOTS - 1);
    (j, u - j as f64)
}

/// The publication's regression over time: where the skill is that long after the recording's beginning.
struct Clock {
    side: Side,
    gmr: Option<Gmr<1, 3>>,
    skill: Arc<Skill>,
    newest: Option<Sample>,
}

impl Clock {
    fn new(side: Side, skill: &Arc<Skill>) -> Self {
        let gmr = match side {
            Side::Place => Gmr::new(skill.motion()).ok(),
            Side::Turn => None,
        };
        Self {
            side,
            gmr,
            skill: Arc::clone(skill),
            newest: None,
        }
    }
}

impl Expert for Clock {
    fn take(&mut self, sample: &Sample) {
        self.newest = Some(*sample);
    }

    fn ahead(&self, h_s: f64) -> Guess {
        let Some(now) = &self.newest else {
            return Vector3::zeros().into();
        };
        let t_s = (now.t_s + h_s).min(self.skill.duration_s());
        let turn = self.skill.turn().map(|turn| &turn.motion);
        let (way, covariance) = match (self.side, &self.gmr, turn, now.orientation) {
            (Side::Place, Some(gmr), ..) => {
                let at = gmr.query(&Vector1::new(t_s));
                (at.mean - now.position, at.covariance)
            }
            (Side::Turn, _, Some(turn), Some(q)) => {
                let at = turn.query(t_s);
                (pose::between(&q, &at.mean), at.covariance)
            }
            _ => return Vector3::zeros().into(),
        };
        Guess {
            way,
            spread: Some(covariance),
        }
    }
}

/// The state-indexed mixture, fully trusted.
struct Mixture {
    side: Side,
    skill: Arc<Skill>,
    hand: Option<Hand>,
    posterior: Option<Posterior>,
}

impl Mixture {
    fn calibration(&self) -> Option<&Calibration> {
        match self.side {
            Side::Place => Some(self.skill.predictor().calibration()),
            Side::Turn => Some(self.skill.turn()?.predictor.model().calibration()),
        }
    }
}

impl Expert for Mixture {
    fn take(&mut self, sample: &Sample) {
        let hand = Hand::take(&mut self.hand, sample);
        self.posterior = match self.side {
            Side::Place => Some(self.skill.predictor().posterior(&hand.place)),
            Side::Turn => self
                .skill
                .turn()
                .zip(hand.turn)
                .map(|(turn, state)| turn.predictor.posterior(&state)),
        };
    }

    fn ahead(&self, h_s: f64) -> Guess {
        let (Some(p), Some(c)) = (&self.posterior, self.calibration()) else {
            return Vector3::zeros().into();
        };
        let knot = |j: usize| match j.checked_sub(1) {
            None => (Vector3::zeros(), Matrix3::zeros()),
            Some(i) => (p.displacement[i], p.covariance[i] * c.covariance[i]),
        };
        let (j, s) = between(h_s);
        let ((a, a_2), (b, b_2)) = (knot(j), knot(j + 1));
        Guess {
            way: a.lerp(&b, s),
            spread: Some(a_2 * (1.0 - s) + b_2 * s),
        }
    }

    fn novelty(&self) -> Option<f64> {
        Some(self.posterior.as_ref()?.novelty / self.calibration()?.novelty90)
    }
}

/// The session's guard and nothing else of the session: what rounding and the glitch gate cost is the difference.
struct Guard {
    side: Side,
    skill: Arc<Skill>,
    hand: Option<Hand>,
    places: Adaptation<HandState>,
    turns: Adaptation<TurnState>,
    ahead: Option<Ahead>,
}

impl Guard {
    fn new(side: Side, skill: &Arc<Skill>) -> Self {
        let turns = skill
            .turn()
            .map(|turn| turn.predictor.model().calibration());
        let places = skill.predictor().calibration();
        Self {
            side,
            skill: Arc::clone(skill),
            hand: None,
            places: Adaptation::of_places(1.0, Some(places), skill.stats().reach_m),
            turns: Adaptation::of_turns(1.0, turns),
            ahead: None,
        }
    }
}

impl Expert for Guard {
    fn take(&mut self, sample: &Sample) {
        let before = self.hand;
        let hand = Hand::take(&mut self.hand, sample);
        let turn = self.skill.turn().map(|turn| &turn.predictor);
        self.ahead = match (self.side, turn, hand.turn) {
            (Side::Place, ..) => {
                let model = self.skill.predictor();
                if let Some(before) = before {
                    self.places.observe(&before.place, &hand.place, Some(model));
                }
                let params = self.places.params(&hand.place);
                Some(model.forecast(&hand.place, &params).ahead)
            }
            (Side::Turn, Some(model), Some(state)) => {
                if let Some(before) = before.and_then(|hand| hand.turn) {
                    self.turns.observe(&before, &state, Some(model));
                }
                Some(model.forecast(&state, &self.turns.params(&state)).ahead)
            }
            _ => None,
        };
    }

    fn ahead(&self, h_s: f64) -> Guess {
        match &self.ahead {
            Some(ahead) => Guess::of(ahead, h_s),
            None => Vector3::zeros().into(),
        }
    }
}

/// What the robot predicts from a session that sends every sample, as the wire carries it.
struct Guarded {
    side: Side,
    session: Live,
    said: Option<Said>,
    newest: Option<Sample>,
}

/// The delay of the guarded predictor's link, s. Nothing that it sends depends on it.
const DELAY_S: f64 = 0.1;

impl Guarded {
    fn new(side: Side, skill: &Arc<Skill>, session: &SessionConfig) -> Self {
        Self {
            side,
            session: Live::of_every_sample(skill, *session, DELAY_S),
            said: None,
            newest: None,
        }
    }
}

/// The covariance of a forecast `h_s` after the state it starts from.
fn covariance(ahead: &Ahead, h_s: f64) -> Matrix3<f64> {
    let knot = |j: usize| {
        let [xx, xy, xz, yy, yz, zz] = ahead.knots[j.min(ahead.count)].covariance;
        Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz)
    };
    let (j, s) = between(h_s);
    knot(j) * (1.0 - s) + knot(j + 1) * s
}

impl Expert for Guarded {
    fn take(&mut self, sample: &Sample) {
        self.newest = Some(*sample);
        if let Some(said) = self.session.take(sample).pop() {
            self.said = Some(said);
        }
    }

    fn ahead(&self, h_s: f64) -> Guess {
        let (Some(now), Some(said)) = (&self.newest, &self.said) else {
            return Vector3::zeros().into();
        };
        let at = on_session_clock(now.t_s + h_s);
        let (way, covariance) = match (self.side, &said.turn, now.orientation) {
            (Side::Place, ..) => {
                let ahead_s = at.secs_since(said.place.t);
                let way = said.place.at(ahead_s).position - now.position;
                (way, covariance(&said.place.ahead, ahead_s))
            }
            (Side::Turn, Some(turn), Some(q)) => {
                let ahead_s = at.secs_since(turn.t);
                let way = pose::between(&q, &turn.at(ahead_s).orientation);
                (way, covariance(&turn.ahead, ahead_s))
            }
            _ => return Vector3::zeros().into(),
        };
        Guess {
            way,
            spread: Some(covariance),
        }
    }
}
