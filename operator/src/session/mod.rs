//! The operator's side of a session, sans-IO: samples and bytes in, bytes and events out.
//!
//! Call order: any `handle_*` or command, then [`Session::poll_output`] and [`Session::poll_event`] until
//! both are empty, then [`Session::poll_timeout`] for when to call [`Session::handle_timeout`].

pub mod adapt;
mod ask;
mod beside;
mod config;
mod correct;
mod gate;
mod hand;
mod hear;
mod mirror;
mod pace;
mod path;
mod said;
mod speak;
#[cfg(test)]
pub(crate) mod tests;
mod usual;
mod view;

use std::collections::VecDeque;
use std::sync::Arc;

use telemime_endpoint::reception::Reception;
use telemime_endpoint::tally::Tally;
use telemime_protocol::checkpoint::path::PathBounds;
use telemime_protocol::predict::Params;
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::Version;
use telemime_protocol::wire::arm::WireArm;
use telemime_protocol::wire::v1::{
    ExternalClock, Info, OperatorControl, Reception as Told, RobotState, ServoTimes,
};

use crate::recognise::{Recogniser, Recognition, Verdict};

pub use config::{
    FutureBound, HandSample, MAX_LEASE_S, MAX_SILENCE_S, SessionConfig, default_scale,
};
pub use correct::{Bent, Change, LOST_S, Leeway};
pub use path::ShownKnot;
pub use said::{Counters, Event, Output, Seen};

use correct::Correction;
use gate::{Gate, Taken};
use hand::{Hand, Interval};
use mirror::Mirror;
use pace::Pace;

/// What is recognised is said again when its probability, or how far it has got, has changed by this much.
const RECOGNISED_STEP: f64 = 0.05;

/// In play the operator speaks at least this often, s: a lost go must not make the arm coast, and it costs little.
pub const GO_S: f64 = 0.1;

enum Activity {
    Nothing,
    Mirror(Box<Mirror>),
    /// A plan on its way, or playing.
    Play {
        plan: u32,
        engaged: bool,
        /// What the hand makes of it, if it may.
        correction: Option<Box<Correction>>,
    },
}

/// One session with a robot.
pub struct Session {
    config: SessionConfig,
    version: Version,
    epoch: u32,
    skill: Option<Arc<Skill>>,
    info: Option<Info>,
    arm: Option<WireArm>,
    model_stored: bool,
    /// Takes the skill's place as soon as nothing is driven.
    next_skill: Option<Arc<Skill>>,
    /// What was driven last.
    driven: Vec<HandSample>,
    state: RobotState,
    changes: u32,
    hand: Option<Hand>,
    gate: Gate,
    interval: Interval,
    heard: Option<VecDeque<(Option<u32>, HandSample)>>,
    recogniser: Option<Recogniser>,
    external: Option<ExternalClock>,
    /// What was last said of what the hand does.
    recognised: Option<Recognition>,
    activity: Activity,
    engagement: u32,
    seq: u32,
    plans: u32,
    delay_s: f64,
    pace: Pace,
    /// How far the next message has to be from the last one.
    interval_s: f64,
    /// What is being said is new.
    news: bool,
    /// When to say it again, if that is worth it.
    repeat: Option<Stamp>,
    down: Reception,
    up: Option<Told>,
    /// How the robot's servo keeps its time, as it said last.
    servo: Option<ServoTimes>,
    clock_uncertainty_us: Option<u32>,
    last_sent: Stamp,
    /// There was something to say before the shortest interval was over.
    urgent: bool,
    next_stop: Option<Stamp>,
    counters: Counters,
    tally: Tally,
    /// As they were at the request that is not answered yet.
    before: Option<Counters>,
    outputs: VecDeque<Output>,
    events: VecDeque<Event>,
}

impl Session {
    /// A session the robot has just granted under `epoch`.
    pub fn new(config: SessionConfig, skill: Option<Arc<Skill>>, epoch: u32) -> Self {
        Self {
            config,
            version: Version::V1,
            epoch,
            skill,
            info: None,
            arm: None,
            model_stored: false,
            next_skill: None,
            driven: Vec::new(),
            state: RobotState::Idle,
            changes: 0,
            hand: None,
            gate: Gate::default(),
            interval: Interval::default(),
            heard: None,
            recogniser: None,
            external: None,
            recognised: None,
            activity: Activity::Nothing,
            engagement: 0,
            seq: 0,
            plans: 0,
            delay_s: 0.0,
            pace: Pace::new(config.min_interval_s, config.max_silence_s),
            interval_s: config.min_interval_s,
            news: false,
            repeat: None,
            down: Reception::default(),
            up: None,
            servo: None,
            clock_uncertainty_us: None,
            last_sent: Stamp::ZERO,
            urgent: false,
            next_stop: None,
            counters: Counters::default(),
            tally: Tally::default(),
            before: None,
            outputs: VecDeque::new(),
            events: VecDeque::new(),
        }
    }

    /// Speaks `version` instead of version 1.
    #[must_use]
    pub fn speaking(mut self, version: Version) -> Self {
        self.version = version;
        self
    }

    /// Reports with [`Event::Recognised`] which of these skills the hand performs, whenever that changes, and how far it
    /// has got in steps of a twentieth. It changes nothing else.
    #[must_use]
    pub fn watched_by(mut self, recogniser: Option<Recogniser>) -> Self {
        self.recogniser = recogniser;
        self
    }

    /// What our disciplined clock says now, relative to the session clock, if we have one.
    pub fn set_external(&mut self, external: Option<ExternalClock>) {
        self.external = external;
    }

    /// What the robot said of itself.
    pub fn info(&self) -> Option<&Info> {
        self.info.as_ref()
    }

    /// Whether the robot has introduced itself and holds the model, if there is one.
    pub fn is_ready(&self) -> bool {
        self.info.is_some() && (self.skill.is_none() || self.model_stored)
    }

    /// The robot's state, as last heard.
    pub fn state(&self) -> RobotState {
        self.state
    }

    /// Requests made so far.
    pub fn requests(&self) -> u32 {
        self.engagement
    }

    /// How often the robot's state has changed, by its newest report.
    pub fn changes(&self) -> u32 {
        self.changes
    }

    /// What passed, by kind.
    pub fn tally(&self) -> &Tally {
        &self.tally
    }

    /// The counters.
    pub fn counters(&self) -> Counters {
        self.counters
    }

    /// What has become of the session's datagrams on their way.
    pub fn seen(&self) -> Seen {
        Seen {
            servo: self.servo,
            ..Seen::new(self.up.as_ref(), &self.down, self.clock_uncertainty_us)
        }
    }

    /// Tip metres per hand metre of the next engagement; `None` before the robot has introduced itself.
    pub fn scale(&self) -> Option<f64> {
        let info = self.info.as_ref()?;
        let derived = self
            .skill
            .as_ref()
            .map_or(0.1, |skill| default_scale(skill.stats(), info));
        Some(self.config.scale.unwrap_or(derived))
    }

    /// ε_path of the next engagement, m.
    pub fn path_bound_m(&self) -> f64 {
        let derived = self
            .skill
            .as_ref()
            .map_or(0.02, |skill| 0.02 * skill.stats().reach_m);
        self.config.path_bound_m.unwrap_or(derived).max(1e-4)
    }

    /// What the robot's record of the path is promised to be, of a hand with an orientation or without.
    fn path_bounds(&self, turns: bool) -> PathBounds {
        let turn_rad = self.config.path_turn_bound_rad;
        PathBounds::new(
            self.path_bound_m(),
            (turns && turn_rad > 0.0).then_some(turn_rad),
        )
    }

    /// The hand, live: mirrored, or, where a skill is played that may be corrected, a hand that holds on to it until
    /// [`Session::let_go`]. Samples out of order or not finite are dropped and counted.
    pub fn handle_sample(&mut self, now: Stamp, mut sample: HandSample) {
        sample.t = sample.t.offset_by_secs(-self.config.input_latency_s);
        self.listen(&sample);
        if matches!(
            self.activity,
            Activity::Play {
                correction: Some(_),
                ..
            }
        ) {
            return self.correct(now, &sample);
        }
        let Some(hand) = &mut self.hand else {
            self.hand = Hand::first(&sample);
            return;
        };
        let previous = *hand;
        let suspects = self.gate.suspects() as u32;
        let taken = if self.config.glitch_gate {
            let skill = self.skill.as_deref();
            let params = match &self.activity {
                Activity::Mirror(mirror) => mirror.params(),
                Activity::Nothing | Activity::Play { .. } => (Params::DEFAULT, Params::DEFAULT),
            };
            self.gate.take(hand, &sample, skill, (&params.0, &params.1))
        } else {
            hand.advance(&sample).then_some(Taken::Real)
        };
        let Some(taken) = taken else {
            self.counters.dropped += 1;
            return;
        };
        let hand = *hand;
        self.interval
            .take(hand.place.t.secs_since(previous.place.t));
        self.recognise(&hand);
        let network_s = self.network_delay_s();
        let Activity::Mirror(mirror) = &mut self.activity else {
            return;
        };
        let skill = self.skill.as_deref().filter(|_| self.model_stored);
        let lag_s = self.info.as_ref().map_or(0.0, |info| f64::from(info.lag_s));
        if taken == Taken::Real {
            self.counters.glitches += suspects;
        }
        if sample.resting {
            self.counters.rest_samples += 1;
        } else {
            if self.counters.samples == 0 && self.counters.rest_samples > 0 {
                self.counters.rest_messages = self.counters.messages;
                self.counters.rest_knots = self.counters.knots;
            }
            self.counters.samples += 1;
        }
        self.counters.knots += mirror.take(&sample, taken, hand, skill);
        let backlog = mirror.backlog();
        let arrival = now.offset_by_secs(network_s + lag_s);
        let silent_s = now.secs_since(self.last_sent);
        let bound = self.pace.widen(self.config.future_bound);
        if mirror.future_changed(arrival, bound) {
            self.speak_soon(now);
        } else if silent_s >= self.config.max_silence_s {
            // It carries the lease: three of them lost in a row stop the arm.
            self.news = true;
            self.speak(now);
        }
        if let Some(tail) = backlog {
            self.path(tail);
        }
    }

    /// What the robot calls delay is the age of a sample: the input's latency and the network's.
    fn network_delay_s(&self) -> f64 {
        (self.delay_s - self.config.input_latency_s).max(0.0)
    }

    /// When what is said now takes effect at the arm.
    fn ahead(&self, now: Stamp) -> Stamp {
        let lag_s = self.info.as_ref().map_or(0.0, |info| f64::from(info.lag_s));
        now.offset_by_secs(self.delay_s + lag_s)
    }

    fn recognise(&mut self, hand: &Hand) {
        let Some(recogniser) = &mut self.recogniser else {
            return;
        };
        let Some(seen) = recogniser.take(&hand.place) else {
            return;
        };
        let last = self.recognised.as_ref();
        let again = last.is_some_and(|last| last.verdict == seen.verdict);
        // Where no skill is named, what fits best is nothing to show.
        let named = matches!(seen.verdict, Verdict::Skill(_));
        let news = |last: &Recognition| {
            let moved = |was: f64, is: f64| (was - is).abs() >= RECOGNISED_STEP;
            named && (moved(last.probability, seen.probability) || moved(last.phase, seen.phase))
        };
        if again && !last.is_some_and(news) {
            return;
        }
        let skill = match seen.verdict {
            Verdict::Skill(index) => recogniser.names().get(index).cloned(),
            Verdict::Resting | Verdict::Unknown | Verdict::Undecided => None,
        };
        self.events.push_back(Event::Recognised {
            verdict: seen.verdict,
            skill,
            probability: seen.probability,
            phase: seen.phase,
            again,
        });
        self.recognised = Some(seen);
    }

    /// What to send next.
    pub fn poll_output(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// What has happened since the last call.
    pub fn poll_event(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    /// What the hand did in the engagement that ended last, glitches left out; empty if there was none.
    pub fn driven(&self) -> &[HandSample] {
        &self.driven
    }

    /// Goes on with `skill`. Nobody's model changes while the arm follows: what is being driven ends with the
    /// one it began with, and only then does this one travel; until the robot holds it, [`Session::is_ready`]
    /// is false.
    pub fn replace_skill(&mut self, skill: Arc<Skill>) {
        self.next_skill = Some(skill);
        if matches!(self.activity, Activity::Nothing) {
            self.adopt();
        }
    }

    fn adopt(&mut self) {
        let Some(skill) = self.next_skill.take() else {
            return;
        };
        let (id, bytes) = (skill.id().0, skill.to_bytes().to_vec());
        if self
            .skill
            .as_ref()
            .is_none_or(|last| last.name() != skill.name())
        {
            // A performance of another skill is nothing for this one to learn from.
            self.driven.clear();
        }
        self.skill = Some(skill);
        self.model_stored = false;
        // Before the robot has introduced itself nobody knows what it holds; then it is told.
        if self.info.is_some() {
            self.control(&OperatorControl::Model { id, bytes });
        }
    }

    /// Nothing is driven any more. However that came about, the robot gets the whole path of what it followed.
    fn end_activity(&mut self) {
        self.repeat = None;
        if self.before.is_none() {
            self.complete_path();
        }
        if let Activity::Mirror(mirror) = std::mem::replace(&mut self.activity, Activity::Nothing)
            && self.before.is_none()
        {
            self.driven = mirror.into_driven();
        }
        self.adopt();
    }
}
