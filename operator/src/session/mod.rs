//! The operator's side of a session, sans-IO: samples and bytes in, bytes and events out.
//!
//! Call order: any `handle_*` or command, then [`Session::poll_output`] and [`Session::poll_event`] until
//! both are empty, then [`Session::poll_timeout`] for when to call [`Session::handle_timeout`].

pub mod adapt;
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
#[cfg(test)]
mod tests;
mod usual;
mod view;

use std::collections::VecDeque;
use std::sync::Arc;

use telemime_endpoint::reception::Reception;
use telemime_endpoint::tally::Tally;
use telemime_protocol::checkpoint::PosePlan;
use telemime_protocol::checkpoint::path::PathBounds;
use telemime_protocol::predict::Params;
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::Version;
use telemime_protocol::wire::arm::WireArm;
use telemime_protocol::wire::codec;
use telemime_protocol::wire::v1::{
    Drive, Engage, ExternalClock, Info, Message, OperatorControl, OperatorDatagram, PathTail,
    Reception as Told, Refusal, RobotState, ServoTimes,
};

use crate::recognise::{Recogniser, Verdict};

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
use pace::{Pace, REPEAT_S};

/// While an emergency stop is not confirmed, it is repeated at this interval, s.
const STOP_REPEAT_S: f64 = 0.01;

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
    verdict: Option<Verdict>,
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
            verdict: None,
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

    /// Reports with [`Event::Recognised`] which of these skills the hand performs, whenever that changes. It
    /// changes nothing else.
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
        // Until the next message, on average: half a silence longer.
        mirror.used_at(self.delay_s + lag_s + 0.5 * self.config.max_silence_s);
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

    /// Within the shortest interval the news waits, and what is then said is the newest.
    fn speak_soon(&mut self, now: Stamp) {
        self.news = true;
        self.urgent = now.secs_since(self.last_sent) < self.interval_s;
        if !self.urgent {
            self.speak(now);
        }
    }

    fn recognise(&mut self, hand: &Hand) {
        let Some(recogniser) = &mut self.recogniser else {
            return;
        };
        let Some(seen) = recogniser.take(&hand.place) else {
            return;
        };
        if self.verdict == Some(seen.verdict) {
            return;
        }
        self.verdict = Some(seen.verdict);
        let skill = match seen.verdict {
            Verdict::Skill(index) => recogniser.names().get(index).cloned(),
            Verdict::Resting | Verdict::Unknown | Verdict::Undecided => None,
        };
        self.events.push_back(Event::Recognised {
            verdict: seen.verdict,
            skill,
            probability: seen.probability,
            phase: seen.phase,
        });
    }

    /// Asks the robot to follow the hand; refused here if no sample has been taken yet, or a stop is under way.
    pub fn engage(&mut self, now: Stamp) {
        if self.refuses() {
            return;
        }
        let Some(hand) = self.hand else {
            self.events
                .push_back(Event::Refused(Refusal::StaleReference));
            return;
        };
        let skill = self.skill.as_deref().filter(|_| self.model_stored);
        let bounds = self.path_bounds(hand.turn.is_some());
        let path = (bounds, self.interval.us());
        let Ok(mirror) = Mirror::new(hand, path, self.config.gain, skill) else {
            self.events.push_back(Event::Refused(Refusal::BadMapping));
            return;
        };
        let Some(drive) = mirror.reference(skill) else {
            self.events
                .push_back(Event::Refused(Refusal::StaleReference));
            return;
        };
        self.activity = Activity::Mirror(Box::new(mirror));
        self.request(now, drive);
        self.last_sent = now;
    }

    /// Sends a motion and plays it as soon as the robot has it. With the skill's `leeway` the hand may correct it:
    /// [`Session::handle_sample`], [`Session::let_go`].
    pub fn play(&mut self, plan: &PosePlan, leeway: Option<&Leeway>) {
        if self.refuses() {
            return;
        }
        let correction = match leeway.map(|leeway| (plan.curve(), leeway)) {
            Some((Ok(curve), leeway)) => Some(Box::new(Correction::new(
                curve,
                leeway.clone(),
                &self.config,
            ))),
            Some((Err(_), _)) => {
                self.events.push_back(Event::Refused(Refusal::BadPlan));
                return;
            }
            None => None,
        };
        self.plans += 1;
        self.activity = Activity::Play {
            plan: self.plans,
            engaged: false,
            correction,
        };
        self.control(&OperatorControl::Plan {
            id: self.plans,
            bytes: codec::encode(plan),
        });
    }

    /// Lets go of the clutch, and sees to it that the robot holds the path up to the newest sample.
    pub fn release(&mut self) {
        self.complete_path();
        if !matches!(self.activity, Activity::Nothing) {
            self.control(&OperatorControl::Release {
                engagement: self.engagement,
            });
            self.end_activity();
        }
    }

    /// Closes the path at the newest sample and hands the stream what the robot does not hold of it.
    fn complete_path(&mut self) {
        if let Activity::Mirror(mirror) = &mut self.activity {
            self.counters.knots += mirror.close();
        }
        while let Activity::Mirror(mirror) = &mut self.activity
            && let Some(tail) = mirror.tail()
        {
            self.path(tail);
        }
    }

    /// Whether anything is driven, or asked for and not declined yet.
    pub fn is_driving(&self) -> bool {
        !matches!(self.activity, Activity::Nothing)
    }

    /// Emergency stop: on the stream, and by datagram until the robot says it has stopped.
    pub fn stop(&mut self, now: Stamp) {
        // Before a model that has waited for the end of what was driven: it may take seconds.
        self.control(&OperatorControl::EmergencyStop);
        self.end_activity();
        self.next_stop = Some(now);
    }

    /// Whether a stop was demanded that the robot has not confirmed.
    pub fn stop_is_unconfirmed(&self) -> bool {
        self.next_stop.is_some()
    }

    /// Leaves the latched stop; false if there is one that the robot has not confirmed: nobody knows yet what
    /// would be left.
    pub fn reset(&mut self) -> bool {
        if self.stop_is_unconfirmed() {
            return false;
        }
        let changes = self.changes;
        self.control(&OperatorControl::Reset { changes });
        true
    }

    /// Ends the session.
    pub fn goodbye(&mut self) {
        self.release();
        self.control(&OperatorControl::Goodbye);
    }

    /// Something is due.
    pub fn handle_timeout(&mut self, now: Stamp) {
        if self.next_stop.is_some_and(|due| now >= due) {
            self.next_stop = Some(now.offset_by_secs(STOP_REPEAT_S));
            self.datagram(&OperatorDatagram::Stop { epoch: self.epoch });
        }
        if self.next_word().is_some_and(|due| now >= due) {
            self.news = true;
            self.speak(now);
        } else if self.repeat.is_some_and(|due| now >= due) {
            self.speak(now);
        }
        if self.next_look().is_some_and(|due| now >= due) {
            self.look_after(now);
        }
    }

    /// What to send next.
    pub fn poll_output(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// What has happened since the last call.
    pub fn poll_event(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    /// When to call [`Session::handle_timeout`], and for what.
    pub fn poll_timeout(&self) -> Option<(Stamp, &'static str)> {
        let stop = self.next_stop.map(|due| (due, "repeat the emergency stop"));
        let word = self
            .next_word()
            .map(|due| (due, "confirm before the silence grows too long"));
        let look = self
            .next_look()
            .map(|due| (due, "see what the hand makes of the plan"));
        let repeat = self.repeat.map(|due| (due, "say again what may be lost"));
        [stop, word, look, repeat]
            .into_iter()
            .flatten()
            .min_by_key(|w| w.0)
    }

    fn next_look(&self) -> Option<Stamp> {
        match &self.activity {
            Activity::Play { correction, .. } => correction.as_ref()?.due(),
            _ => None,
        }
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

    fn next_word(&self) -> Option<Stamp> {
        match self.activity {
            Activity::Nothing | Activity::Play { engaged: false, .. } => None,
            Activity::Mirror(_) => Some(self.last_sent.offset_by_secs(if self.urgent {
                self.interval_s
            } else {
                self.config.max_silence_s
            })),
            Activity::Play { engaged: true, .. } => Some(self.last_sent.offset_by_secs(
                self.config.max_silence_s.min(if self.urgent {
                    self.interval_s
                } else {
                    self.interval_s.max(GO_S)
                }),
            )),
        }
    }

    /// Sends the newest there is, whatever drives.
    fn speak(&mut self, now: Stamp) {
        self.last_sent = now;
        self.urgent = false;
        self.interval_s = self.pace.interval_s(now);
        let again = std::mem::take(&mut self.news) && self.pace.repeats();
        self.repeat = again.then(|| now.offset_by_secs(REPEAT_S));
        self.seq += 1;
        let lease_ms = (self.config.lease_s * 1e3) as u16;
        let network_s = self.network_delay_s();
        let ahead = self.ahead(now);
        let datagram = match &mut self.activity {
            Activity::Nothing => return,
            Activity::Play { correction, .. } => {
                let told = correction.as_mut().and_then(|c| c.tell(now, ahead));
                if let Some((_, bent)) = told {
                    self.events.push_back(Event::Bent(bent));
                }
                OperatorDatagram::Go {
                    epoch: self.epoch,
                    engagement: self.engagement,
                    seq: self.seq,
                    t_us: now.0 / 1000,
                    lease_ms,
                    bend: told.map(|(wire, _)| wire),
                }
            }
            Activity::Mirror(mirror) => {
                let skill = self.skill.as_deref().filter(|_| self.model_stored);
                let Some(mut motion) = mirror.motion(skill, (now, network_s), self.pace.copies())
                else {
                    return;
                };
                motion.epoch = self.epoch;
                motion.engagement = self.engagement;
                motion.seq = self.seq;
                motion.lease_ms = lease_ms;
                OperatorDatagram::Motion(motion)
            }
        };
        self.counters.messages += 1;
        self.say(&datagram, true);
    }

    fn request(&mut self, now: Stamp, drive: Drive) {
        self.engagement += 1;
        self.before = Some(self.counters);
        let rotation = self.config.rotation.as_ref();
        let turns = matches!(&drive, Drive::Mirror { pose, .. } if pose.turn.is_some());
        let bounds = self.path_bounds(turns);
        let engage = Engage {
            engagement: self.engagement,
            t_us: now.0 / 1000,
            drive,
            scale: self.scale().unwrap_or(0.1) as f32,
            rotation: [
                rotation.w as f32,
                rotation.i as f32,
                rotation.j as f32,
                rotation.k as f32,
            ],
            path_bound_um: bounds.place_um(),
            path_turn_bound_urad: bounds.turn_urad(),
            sample_us: self.interval.us(),
            lease_ms: (self.config.lease_s * 1e3) as u16,
        };
        self.control(&OperatorControl::Engage(engage));
    }

    fn refuses(&mut self) -> bool {
        let stopping = self.stop_is_unconfirmed();
        if stopping {
            self.events.push_back(Event::Refused(Refusal::Stopped));
        }
        stopping
    }

    fn path(&mut self, tail: PathTail) {
        let engagement = self.engagement;
        self.control(&OperatorControl::Path(PathTail { engagement, ..tail }));
    }

    fn control(&mut self, message: &OperatorControl) {
        let bytes = message.encode();
        self.tally.operator_control(Some(message), bytes.len());
        self.outputs.push_back(Output::Control(bytes));
    }

    fn datagram(&mut self, message: &OperatorDatagram) {
        self.say(message, false);
    }

    fn say(&mut self, message: &OperatorDatagram, motion: bool) {
        let bytes = self.version.encode_operator_datagram(message);
        self.tally.operator_datagram(Some(message), bytes.len());
        self.outputs.push_back(Output::Datagram { bytes, motion });
    }
}
