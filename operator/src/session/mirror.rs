//! Mirror: dual prediction for the future, the live path coder for the past.

use nalgebra::{UnitQuaternion, Vector3};
use telemime_protocol::checkpoint::CheckpointError;
use telemime_protocol::checkpoint::path::PathBounds;
use telemime_protocol::predict::{Forecast, HandState, MAX_KNOTS, Params, TurnState, checksum};
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::{Drive, Motion, PathTail, model_tag};

use super::adapt::Adaptation;
use super::gate::Taken;
use super::hand::{Hand, Known, Travelling, rotation};
use super::path::{Path, ShownKnot};
use super::usual::Usual;
use super::{FutureBound, HandSample};

/// Every so many messages the robot's prediction is checked against ours.
const KEYFRAME: u32 = 8;

/// A future bound below this makes no sense: the state itself is quantised, m.
const LEAST_FUTURE_BOUND_M: f64 = 1e-3;

/// The same for orientations, rad.
const LEAST_FUTURE_BOUND_RAD: f64 = 5e-3;

/// Where the future's bound says nothing of orientations, they may be off by this multiple of their deviation.
const TURN_SIGMAS: f64 = 0.6;

/// A share of the way is never more than this multiple of the predicted deviation: where much better can be foretold, the robot is
/// to have it.
const EXACT_SIGMAS: f64 = 2.0;

/// Most of how a hand that is led with care turns is the tracker's tremble: a share of that way is no finer than this multiple
/// of what a prediction errs by anyway, or every sample would be news.
const TREMBLE_SIGMAS: f64 = 1.5;

/// A gripper is told of changes above this, in steps of 1/255.
const GRIP_STEPS: u8 = 4;

/// What is kept of an engagement, in samples: half an hour of a tracker of 60 Hz. What comes later is not.
const MOST_DRIVEN: usize = 108_000;

/// A sample that its prediction stands for, for the time being.
struct Suspect {
    seen: HandSample,
    instead: (Vector3<f64>, Option<UnitQuaternion<f64>>),
}

/// A live engagement.
pub(super) struct Mirror {
    hand: Hand,
    /// The hand at the last sample that was what the hand did.
    judged: Hand,
    suspects: Vec<Suspect>,
    driven: Vec<HandSample>,
    path: Path,
    places: Adaptation<HandState>,
    turns: Adaptation<TurnState>,
    /// How far the hand usually goes and, where that was learned, turns.
    usual: (Usual, Option<Usual>),
    without_model: bool,
    newest: Option<Known>,
    sent: Option<Known>,
    messages: u32,
}

impl Mirror {
    /// `path` is its bounds and the interval of the samples, µs.
    pub(super) fn new(
        hand: Hand,
        (bounds, sample_us): (PathBounds, u32),
        gain: f64,
        skill: Option<&Skill>,
    ) -> Result<Self, CheckpointError> {
        let path = Path::new(bounds, sample_us, hand.turn.map(|turn| turn.q))?;
        // A hand that was seen to rest has not begun anything, and the arm must not begin it either.
        let seen_s = hand.place.t.secs_since(hand.since);
        let places = Adaptation::of_places(
            gain,
            skill.map(|skill| skill.predictor().calibration()),
            skill.map_or(0.0, |skill| skill.stats().reach_m),
        )
        .seen(&hand.place, seen_s);
        let turning = skill.and_then(Skill::turn);
        let usual = (
            match skill.map(Skill::predictor) {
                Some(model) => Usual::of(model.calibration(), model.knots()),
                None => Usual::of(Usual::UNKNOWN, MAX_KNOTS),
            },
            turning
                .map(|turn| turn.predictor.model())
                .map(|model| Usual::of(model.calibration(), model.knots())),
        );
        let turns = turning.map(|turn| turn.predictor.model().calibration());
        let turns = Adaptation::of_turns(gain, turns);
        let turns = match &hand.turn {
            Some(turn) => turns.seen(turn, seen_s),
            None => turns,
        };
        Ok(Self {
            hand,
            judged: hand,
            suspects: Vec::new(),
            driven: Vec::new(),
            path,
            places,
            turns,
            usual,
            // The robot ends with the model it began with, so a model that arrives now is for the next engagement.
            without_model: skill.is_none(),
            newest: None,
            sent: None,
            messages: 0,
        })
    }

    /// What an engage request carries.
    pub(super) fn reference(&self, skill: Option<&Skill>) -> Option<Drive> {
        let Travelling {
            state,
            params,
            pose,
        } = self.travelling()?;
        Some(Drive::Mirror {
            state,
            model: self.model(skill),
            params,
            pose,
        })
    }

    pub(super) fn go_without_model(&mut self) {
        self.without_model = true;
    }

    /// The robot holds every knot before `frontier`.
    pub(super) fn acknowledge(&mut self, frontier: u32) {
        self.path.acknowledge(frontier);
    }

    /// The newest knots.
    pub(super) fn recent_knots(&self) -> impl Iterator<Item = ShownKnot> {
        self.path.shown()
    }

    /// What the robot predicts from.
    pub(super) fn told(&self) -> Option<Forecast> {
        self.sent.map(|sent| sent.place)
    }

    /// From now on.
    pub(super) fn set_gain(&mut self, gain: f64) {
        self.places.set_gain(gain);
        self.turns.set_gain(gain);
    }

    /// By what the hand is predicted now, place and orientation.
    pub(super) fn params(&self) -> (Params, Params) {
        let turn = self.hand.turn.as_ref();
        (
            self.places.params(&self.hand.place),
            turn.map_or(Params::DEFAULT, |turn| self.turns.params(turn)),
        )
    }

    /// What the hand did.
    pub(super) fn into_driven(mut self: Box<Self>) -> Vec<HandSample> {
        std::mem::take(&mut self.driven)
    }

    /// Takes the newest hand state, which `sample` led to as `taken` says. Returns how many knots were made.
    ///
    /// The future is urgent and believes the gate at once. The path is complete, and adaptation wants the truth:
    /// both wait until it is known what a replaced sample was.
    pub(super) fn take(
        &mut self,
        sample: &HandSample,
        taken: Taken,
        hand: Hand,
        skill: Option<&Skill>,
    ) -> u32 {
        self.hand = hand;
        if taken == Taken::Replaced {
            self.suspects.push(Suspect {
                seen: *sample,
                instead: (hand.place.x, hand.turn.map(|turn| turn.q)),
            });
            let skill = skill.filter(|_| !self.without_model);
            self.newest = self.travelling().map(|t| t.known(skill));
            return 0;
        }
        let previous = std::mem::replace(&mut self.judged, hand);
        let skill = skill.filter(|_| !self.without_model);
        let model = skill.map(Skill::predictor);
        self.places.observe(&previous.place, &hand.place, model);
        if let (Some(previous), Some(turn)) = (&previous.turn, &hand.turn) {
            let model = skill.and_then(Skill::turn).map(|turn| &turn.predictor);
            self.turns.observe(previous, turn, model);
        }
        self.newest = self.travelling().map(|t| t.known(skill));
        let knots = self.settle(taken == Taken::Rewritten);
        self.record(sample);
        let q = hand.turn.map(|turn| turn.q);
        knots + self.path.push(hand.place.t, &hand.place.x, q)
    }

    /// What the suspects were is known: the hand's doing, or glitches. Returns how many knots that made.
    fn settle(&mut self, real: bool) -> u32 {
        let mut knots = 0;
        for Suspect { seen, instead } in std::mem::take(&mut self.suspects) {
            let (x, q) = if real {
                (seen.x, rotation(&seen))
            } else {
                instead
            };
            knots += self.path.push(seen.t, &x, q);
            if real {
                self.record(&seen);
            }
        }
        knots
    }

    fn record(&mut self, sample: &HandSample) {
        if !sample.resting && self.driven.len() < MOST_DRIVEN {
            self.driven.push(*sample);
        }
    }

    /// What goes by the stream because datagrams have not delivered it for too long.
    pub(super) fn backlog(&mut self) -> Option<PathTail> {
        self.path.backlog(self.hand.place.t)
    }

    /// Closes the path at the newest sample; returns how many knots that took.
    pub(super) fn close(&mut self) -> u32 {
        self.settle(false) + self.path.close(self.hand.place.t)
    }

    /// What is left for the stream: [`Path::tail`].
    pub(super) fn tail(&mut self) -> Option<PathTail> {
        self.path.tail(self.hand.place.t)
    }

    /// Whether the robot's prediction for `arrival` would differ by more than the bound.
    pub(super) fn future_changed(&self, arrival: Stamp, bound: FutureBound) -> bool {
        let (Some(sent), Some(newest)) = (&self.sent, &self.newest) else {
            return true;
        };
        let ahead_s = |t: Stamp| arrival.secs_since(t);
        let (held, known) = (
            sent.place.at(ahead_s(sent.place.t)),
            newest.place.at(ahead_s(newest.place.t)),
        );
        let bound_m = match bound {
            FutureBound::Absolute(bound_m) => bound_m,
            FutureBound::Relative(sigmas) => sigmas * known.sigma_m,
            FutureBound::Share(share) => {
                let way_m = self.usual.0.in_s(ahead_s(newest.place.t));
                (share * way_m).min(EXACT_SIGMAS * known.sigma_m)
            }
        };
        if (held.position - known.position).norm() > bound_m.max(LEAST_FUTURE_BOUND_M) {
            return true;
        }
        let turned = match (&sent.turn, &newest.turn) {
            (Some(sent), Some(newest)) => {
                let (held, known) = (sent.at(ahead_s(sent.t)), newest.at(ahead_s(newest.t)));
                let bound_rad = match (bound, &self.usual.1) {
                    (FutureBound::Relative(sigmas), _) => sigmas * known.sigma_rad,
                    (FutureBound::Share(share), Some(usual)) => {
                        let way = share * usual.in_s(ahead_s(newest.t));
                        way.max(TREMBLE_SIGMAS * known.sigma_rad)
                    }
                    (FutureBound::Absolute(_) | FutureBound::Share(_), _) => {
                        TURN_SIGMAS * known.sigma_rad
                    }
                };
                held.orientation.angle_to(&known.orientation)
                    > bound_rad.max(LEAST_FUTURE_BOUND_RAD)
            }
            (sent, newest) => sent.is_some() != newest.is_some(),
        };
        let gripped = match (sent.grip, newest.grip) {
            (Some(sent), Some(newest)) => sent.abs_diff(newest) > GRIP_STEPS,
            (sent, newest) => sent.is_some() != newest.is_some(),
        };
        turned || gripped
    }

    /// The next message but for its envelope, said `now` over a link of this delay, s, its knots in so many copies;
    /// `None` if the hand is nowhere that can be sent.
    pub(super) fn motion(
        &mut self,
        skill: Option<&Skill>,
        (now, delay_s): (Stamp, f64),
        copies: u8,
    ) -> Option<Motion> {
        let skill = skill.filter(|_| !self.without_model);
        let travelling = self.travelling()?;
        self.messages += 1;
        let known = travelling.known(skill);
        self.sent = Some(known);
        let Travelling {
            state,
            params,
            pose,
        } = travelling;
        let (first_knot, knots) = self.path.due(&state, (now, delay_s), copies);
        Some(Motion {
            epoch: 0,
            engagement: 0,
            seq: 0,
            lease_ms: 0,
            model: self.model(skill),
            params,
            checksum: (self.messages % KEYFRAME == 1)
                .then(|| checksum(&known.place, known.turn.as_ref())),
            state,
            pose,
            first_knot,
            knots,
        })
    }

    fn model(&self, skill: Option<&Skill>) -> u16 {
        skill
            .filter(|_| !self.without_model)
            .map_or(0, |skill| model_tag(&skill.id().0))
    }

    /// The newest of the hand as it would travel now.
    fn travelling(&self) -> Option<Travelling> {
        let (place, turn) = self.params();
        Travelling::new(&self.hand, &place, &turn)
    }
}
