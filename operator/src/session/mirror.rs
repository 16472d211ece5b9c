//! Mirror: dual prediction for the future, the live path coder for the past.

use std::collections::VecDeque;

use nalgebra::Vector3;
use telemime_protocol::checkpoint::CheckpointError;
use telemime_protocol::checkpoint::path::{CONTEXT, PathEncoder, PathKnot};
use telemime_protocol::predict::{Forecast, HandState, MAX_KNOTS, Params, TurnState, checksum};
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::knots::{KnotBlock, PathCode};
use telemime_protocol::wire::state::WireState;
use telemime_protocol::wire::v1::{Drive, MAX_TAIL_KNOTS, Motion, PathTail, model_tag};

use super::adapt::Adaptation;
use super::gate::Taken;
use super::hand::{Hand, Known, Travelling};
use super::usual::Usual;
use super::{FutureBound, HandSample};

/// Knots in one message; the oldest unacknowledged first.
const KNOTS_PER_MESSAGE: usize = 24;

/// More unacknowledged knots than this go by the stream at once: nothing of the path is ever given up.
const BACKLOG: usize = 256;

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

/// A knot that is still not acknowledged after the round trip and this long goes again, s.
const PATIENCE_S: f64 = 0.15;

/// What is kept of an engagement, in samples: half an hour of a tracker of 60 Hz. What comes later is not.
const MOST_DRIVEN: usize = 108_000;

/// Knots that are shown.
const SHOWN_KNOTS: usize = 48;

/// A sample that its prediction stands for, for the time being.
struct Suspect {
    seen: HandSample,
    instead: Vector3<f64>,
}

/// A knot the robot may not have yet.
struct Unacknowledged {
    knot: PathKnot,
    copies: u8,
    sent: Stamp,
}

/// A live engagement.
pub(super) struct Mirror {
    hand: Hand,
    /// The hand at the last sample that was what the hand did.
    judged: Hand,
    suspects: Vec<Suspect>,
    driven: Vec<HandSample>,
    path: PathEncoder,
    code: PathCode,
    /// The last knots the robot holds: those to come are written with them in mind.
    held: VecDeque<PathKnot>,
    unacknowledged: VecDeque<Unacknowledged>,
    first_unacknowledged: u32,
    /// The newest knots, for display.
    shown: VecDeque<Vector3<f64>>,
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
    /// `path` is its bound, m, and the interval of the samples, µs.
    pub(super) fn new(
        hand: Hand,
        (path_bound_m, sample_us): (f64, u32),
        gain: f64,
        skill: Option<&Skill>,
    ) -> Result<Self, CheckpointError> {
        // The bound both ends derive their grid from is a whole number of µm.
        let path_bound_m = (path_bound_m * 1e6).round() * 1e-6;
        let path = PathEncoder::new(path_bound_m)?;
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
            code: PathCode {
                grid: path.grid(),
                sample_us,
            },
            path,
            held: VecDeque::with_capacity(CONTEXT + 1),
            unacknowledged: VecDeque::new(),
            first_unacknowledged: 0,
            shown: VecDeque::with_capacity(SHOWN_KNOTS),
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
        let known = frontier.saturating_sub(self.first_unacknowledged) as usize;
        let known = known.min(self.unacknowledged.len());
        for gone in self.unacknowledged.drain(..known) {
            self.held.push_back(gone.knot);
            if self.held.len() > CONTEXT {
                self.held.pop_front();
            }
        }
        self.first_unacknowledged += known as u32;
    }

    /// What the robot predicts from.
    pub(super) fn told(&self) -> Option<Forecast> {
        self.sent.map(|sent| sent.place)
    }

    /// The newest knots, and whether the robot holds them.
    pub(super) fn recent_knots(&self) -> impl Iterator<Item = (Vector3<f64>, bool)> {
        let held = self.shown.len().saturating_sub(self.unacknowledged.len());
        let numbered = self.shown.iter().enumerate();
        numbered.map(move |(i, x)| (*x, i < held))
    }

    /// From now on.
    pub(super) fn set_gain(&mut self, gain: f64) {
        self.places.set_gain(gain);
        self.turns.set_gain(gain);
    }

    /// What is sent from now on is used up to about this far ahead, s.
    pub(super) fn used_at(&mut self, horizon_s: f64) {
        self.places.used_at(horizon_s);
        self.turns.used_at(horizon_s);
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
                instead: hand.place.x,
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
        knots + self.trace(hand.place.t, hand.place.x)
    }

    /// What the suspects were is known: the hand's doing, or glitches. Returns how many knots that made.
    fn settle(&mut self, real: bool) -> u32 {
        let mut knots = 0;
        for Suspect { seen, instead } in std::mem::take(&mut self.suspects) {
            knots += self.trace(seen.t, if real { seen.x } else { instead });
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

    fn trace(&mut self, t: Stamp, x: Vector3<f64>) -> u32 {
        // A sample the path cannot hold (out of the grid's range) is still good for the future.
        let Ok(Some(knot)) = self.path.push(t, x) else {
            return 0;
        };
        self.hold(knot);
        1
    }

    fn hold(&mut self, knot: PathKnot) {
        if self.shown.len() == SHOWN_KNOTS {
            self.shown.pop_front();
        }
        let step_m = self.code.grid.step_m();
        self.shown
            .push_back(Vector3::from(knot.x.map(|x| f64::from(x) * step_m)));
        self.unacknowledged.push_back(Unacknowledged {
            knot,
            copies: 0,
            sent: self.hand.place.t,
        });
    }

    /// What goes by the stream because datagrams have not delivered it for too long.
    pub(super) fn backlog(&mut self) -> Option<PathTail> {
        if self.unacknowledged.len() > BACKLOG {
            self.tail()
        } else {
            None
        }
    }

    /// Closes the path at the newest sample; returns how many knots that took.
    pub(super) fn close(&mut self) -> u32 {
        let settled = self.settle(false);
        let last = self.path.flush();
        settled + u32::from(last.map(|knot| self.hold(knot)).is_some())
    }

    /// The oldest unacknowledged knots for the stream but for the engagement, `None` if there are none. What is
    /// handed over is forgotten: the stream delivers it as long as the engagement can live at all.
    pub(super) fn tail(&mut self) -> Option<PathTail> {
        // Only an origin is wanted, and one that can travel wherever the hand is.
        let state = WireState::quantise(&HandState::first(self.hand.place.t, Vector3::zeros()))?;
        let count = self.unacknowledged.len().min(MAX_TAIL_KNOTS);
        let knots = self.packed(&state, 0, count).filter(|k| !k.is_empty())?;
        let first_knot = self.first_unacknowledged;
        self.acknowledge(first_knot + count as u32);
        Some(PathTail {
            engagement: 0,
            state,
            first_knot,
            knots,
        })
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
        let (first_knot, knots) = self.due_knots(&state, (now, delay_s), copies);
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

    /// The knots for a message sent now, without a gap, and the number of the first.
    fn due_knots(
        &mut self,
        state: &WireState,
        (now, delay_s): (Stamp, f64),
        copies: u8,
    ) -> (u32, KnotBlock) {
        let overdue = |u: &Unacknowledged| now.secs_since(u.sent) > 2.0 * delay_s + PATIENCE_S;
        let start = self
            .unacknowledged
            .iter()
            .position(|u| u.copies < copies || overdue(u));
        let start = start.unwrap_or(self.unacknowledged.len());
        let end = self.unacknowledged.len().min(start + KNOTS_PER_MESSAGE);
        let packed = self.packed(state, start, end);
        if packed.is_some() {
            for sent in self.unacknowledged.range_mut(start..end) {
                sent.copies = sent.copies.saturating_add(1);
                sent.sent = now;
            }
        }
        (
            self.first_unacknowledged + start as u32,
            packed.unwrap_or_default(),
        )
    }

    /// The unacknowledged knots `from..to` as they travel.
    fn packed(&self, state: &WireState, from: usize, to: usize) -> Option<KnotBlock> {
        let unacknowledged = self.unacknowledged.range(..to).map(|u| u.knot);
        let known: Vec<_> = self.held.iter().copied().chain(unacknowledged).collect();
        let (before, due) = known.split_at(self.held.len() + from);
        KnotBlock::pack(state, self.code, before, due)
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
