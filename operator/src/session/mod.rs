//! The operator's side of a session, sans-IO: samples and bytes in, bytes and events out.
//!
//! Call order: any `handle_*` or command, then [`Session::poll_output`] and [`Session::poll_event`] until
//! both are empty, then [`Session::poll_timeout`] for when to call [`Session::handle_timeout`].

mod adapt;
mod mirror;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};
use telemime_protocol::checkpoint::Plan;
use telemime_protocol::predict::HandState;
use telemime_protocol::skill::{Skill, Stats};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::frame::Frame;
use telemime_protocol::wire::v1::{
    Cause, Drive, Engage, Info, Message, OperatorControl, OperatorDatagram, PathTail, Refusal,
    RobotControl, RobotDatagram, RobotState, Telemetry,
};
use telemime_protocol::wire::{DecodeError, codec};

use mirror::Mirror;

/// While an emergency stop is not confirmed, it is repeated at this interval, s.
const STOP_REPEAT_S: f64 = 0.01;

/// In play the operator speaks at least this often, s: a lost go must not make the arm coast, and it costs little.
pub const GO_S: f64 = 0.1;

/// How far the robot's prediction may be off before the operator speaks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FutureBound {
    /// A distance, m.
    Absolute(f64),
    /// A multiple of the predicted standard deviation.
    Relative(f64),
}

/// What a session is set to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SessionConfig {
    /// The operator speaks at least this often, s.
    pub max_silence_s: f64,
    /// Two motions are at least this far apart, s, however fast the samples come.
    pub min_interval_s: f64,
    /// For how long each message authorises motion, s.
    pub lease_s: f64,
    /// ε_future.
    pub future_bound: FutureBound,
    /// ε_path, m; `None` is 2 % of the skill's reach.
    pub path_bound_m: Option<f64>,
    /// Prediction gain κ in [0, 1].
    pub gain: f64,
    /// Tip metres per hand metre; `None` derives it from the demonstrations and the arm's limits.
    pub scale: Option<f64>,
    /// Hand axes to the robot's base axes.
    pub rotation: UnitQuaternion<f64>,
}

impl Default for SessionConfig {
    fn default() -> Self {
        Self {
            max_silence_s: 0.2,
            min_interval_s: 0.01,
            lease_s: 0.65,
            future_bound: FutureBound::Relative(0.6),
            path_bound_m: None,
            gain: 1.0,
            scale: None,
            rotation: UnitQuaternion::identity(),
        }
    }
}

/// The hand at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HandSample {
    /// When it is valid.
    pub t: Stamp,
    /// Position, m.
    pub x: Vector3<f64>,
    /// Made up, so that a recording begins at rest: followed like any other, and counted apart.
    pub resting: bool,
}

/// What a session wants sent.
#[derive(Debug, Clone, PartialEq)]
pub enum Output {
    /// A message for the control stream, not yet framed.
    Control(Vec<u8>),
    /// A datagram.
    Datagram {
        /// Its bytes.
        bytes: Vec<u8>,
        /// Whether it carries motion (the others keep time).
        motion: bool,
    },
}

/// What has happened.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// The robot has introduced itself, and holds the model.
    Ready,
    /// The arm follows.
    Engaged {
        /// Which engagement.
        engagement: u32,
        /// When, µs on the session clock as the robot estimates it.
        t_us: i64,
        /// The hand position that corresponds to `tip_m`, m.
        hand_m: [f32; 3],
        /// The tip at that instant, m.
        tip_m: [f32; 3],
    },
    /// A request was declined.
    Refused(Refusal),
    /// The robot's state changed.
    State(RobotState, Cause),
    /// News of the robot.
    Telemetry(Box<Telemetry>),
}

/// What the session counts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counters {
    /// Samples taken from the request that was granted to the release, those made up at rest left out.
    pub samples: u32,
    /// Those at rest.
    pub rest_samples: u32,
    /// Motions and goes sent, from that request on.
    pub messages: u32,
    /// Path knots made.
    pub knots: u32,
    /// Datagrams dropped.
    pub dropped: u32,
}

impl Counters {
    /// Adds another session's counts.
    pub fn add(&mut self, other: Self) {
        self.samples += other.samples;
        self.rest_samples += other.rest_samples;
        self.messages += other.messages;
        self.knots += other.knots;
        self.dropped += other.dropped;
    }
}

enum Activity {
    Nothing,
    Mirror(Box<Mirror>),
    /// A plan on its way, or playing.
    Play {
        plan: u32,
        engaged: bool,
    },
}

/// One session with a robot.
pub struct Session {
    config: SessionConfig,
    epoch: u32,
    skill: Option<Arc<Skill>>,
    info: Option<Info>,
    model_stored: bool,
    state: RobotState,
    changes: u32,
    hand: Option<HandState>,
    activity: Activity,
    engagement: u32,
    seq: u32,
    plans: u32,
    delay_s: f64,
    last_sent: Stamp,
    /// There was something to say before the shortest interval was over.
    urgent: bool,
    next_stop: Option<Stamp>,
    counters: Counters,
    /// As they were at the request that is not answered yet.
    before: Option<Counters>,
    outputs: VecDeque<Output>,
    events: VecDeque<Event>,
}

/// The largest scale at which the demonstrated motion stays within 0.8 of the arm's speed and
/// acceleration, and within its reach; never above 1 (driving.md §2).
pub fn default_scale(stats: &Stats, info: &Info) -> f64 {
    let within = |limit: f32, demonstrated: f64| f64::from(limit) / demonstrated.max(1e-6);
    let speed = 0.8 * within(info.speed_m_s, stats.speed95_m_s);
    let acceleration = 0.8 * within(info.accel_m_s2, stats.acceleration95_m_s2);
    let reach = within(info.radius_m, stats.reach_m);
    speed.min(acceleration).min(reach).clamp(1e-3, 1.0)
}

impl Session {
    /// A session the robot has just granted under `epoch`.
    pub fn new(config: SessionConfig, skill: Option<Arc<Skill>>, epoch: u32) -> Self {
        Self {
            config,
            epoch,
            skill,
            info: None,
            model_stored: false,
            state: RobotState::Idle,
            changes: 0,
            hand: None,
            activity: Activity::Nothing,
            engagement: 0,
            seq: 0,
            plans: 0,
            delay_s: 0.0,
            last_sent: Stamp::ZERO,
            urgent: false,
            next_stop: None,
            counters: Counters::default(),
            before: None,
            outputs: VecDeque::new(),
            events: VecDeque::new(),
        }
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

    /// The counters.
    pub fn counters(&self) -> Counters {
        self.counters
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

    /// A frame from the control stream.
    ///
    /// # Errors
    /// [`DecodeError`] for a frame that may not be ignored; the session is then over.
    pub fn handle_control(&mut self, now: Stamp, frame: &Frame) -> Result<(), DecodeError> {
        let message = match RobotControl::decode(&frame.payload) {
            Ok(message) => message,
            Err(_) if frame.ignorable => return Ok(()),
            Err(e) => return Err(e),
        };
        match message {
            RobotControl::Info(info) => self.on_info(info),
            RobotControl::ModelStored { id } => {
                if self.skill.as_ref().is_some_and(|skill| skill.id().0 == id) && !self.model_stored
                {
                    self.model_stored = true;
                    self.events.push_back(Event::Ready);
                }
            }
            RobotControl::PlanStored { id } => {
                if let Activity::Play {
                    plan,
                    engaged: engaged @ false,
                } = &mut self.activity
                    && *plan == id
                {
                    *engaged = true;
                    self.request(now, Drive::Play { plan: id });
                    self.last_sent = now;
                }
            }
            RobotControl::Engaged {
                engagement,
                t_us,
                hand_m,
                tip_m,
            } => {
                self.before = None;
                self.events.push_back(Event::Engaged {
                    engagement,
                    t_us,
                    hand_m,
                    tip_m,
                });
            }
            RobotControl::Refused { reason } => {
                if let (Refusal::Diverged, Activity::Mirror(mirror)) = (reason, &mut self.activity)
                {
                    mirror.go_without_model();
                } else {
                    self.activity = Activity::Nothing;
                    // What was sent for nothing is not what following took.
                    if let Some(before) = self.before.take() {
                        let dropped = self.counters.dropped;
                        self.counters = Counters { dropped, ..before };
                    }
                }
                self.events.push_back(Event::Refused(reason));
            }
            RobotControl::State {
                state,
                cause,
                changes,
            } => {
                self.changes = changes;
                self.on_state(state, cause);
            }
        }
        Ok(())
    }

    /// A datagram. Nothing in it can end the session: what is wrong is dropped and counted.
    pub fn handle_datagram(&mut self, now: Stamp, bytes: &[u8]) {
        match RobotDatagram::decode(bytes) {
            Ok(RobotDatagram::Ping { epoch, t1_us }) if epoch == self.epoch => {
                let t_us = now.0 / 1000;
                self.datagram(&OperatorDatagram::Pong {
                    epoch,
                    t1_us,
                    t2_us: t_us,
                    t3_us: t_us,
                });
            }
            Ok(RobotDatagram::Telemetry(telemetry)) if telemetry.epoch == self.epoch => {
                if let Activity::Mirror(mirror) = &mut self.activity
                    && telemetry.engagement == self.engagement
                {
                    mirror.acknowledge(telemetry.path_frontier);
                }
                if telemetry.delay_ms > 0 {
                    let delay_s = f64::from(telemetry.delay_ms) * 1e-3;
                    self.delay_s += if self.delay_s == 0.0 {
                        delay_s
                    } else {
                        0.1 * (delay_s - self.delay_s)
                    };
                }
                self.events.push_back(Event::Telemetry(Box::new(telemetry)));
            }
            _ => self.counters.dropped += 1,
        }
    }

    /// The hand, live. Samples out of order or not finite are dropped and counted.
    pub fn handle_sample(&mut self, now: Stamp, sample: HandSample) {
        let Some(hand) = &mut self.hand else {
            self.hand = sample
                .x
                .iter()
                .all(|v| v.is_finite())
                .then(|| HandState::first(sample.t, sample.x));
            return;
        };
        let previous = *hand;
        if !hand.advance(sample.t, sample.x) {
            self.counters.dropped += 1;
            return;
        }
        let Activity::Mirror(mirror) = &mut self.activity else {
            return;
        };
        let skill = self.skill.as_deref().filter(|_| self.model_stored);
        let lag_s = self.info.as_ref().map_or(0.0, |info| f64::from(info.lag_s));
        if sample.resting {
            self.counters.rest_samples += 1;
        } else {
            self.counters.samples += 1;
        }
        self.counters.knots +=
            u32::from(mirror.take(&previous, *hand, skill, self.delay_s + lag_s));
        let backlog = mirror.backlog();
        let arrival = now.offset_by_secs(self.delay_s + lag_s);
        let silent_s = now.secs_since(self.last_sent);
        if mirror.future_changed(arrival, self.config.future_bound)
            || silent_s >= self.config.max_silence_s
        {
            // Within the shortest interval the news waits, and what is then said is the newest.
            self.urgent = silent_s < self.config.min_interval_s;
            if !self.urgent {
                self.speak(now);
            }
        }
        if let Some(tail) = backlog {
            self.path(tail);
        }
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
        let Ok(mirror) = Mirror::new(hand, self.path_bound_m(), self.config.gain, skill) else {
            self.events.push_back(Event::Refused(Refusal::BadMapping));
            return;
        };
        let Some((state, model, params)) = mirror.reference(skill) else {
            self.events
                .push_back(Event::Refused(Refusal::StaleReference));
            return;
        };
        self.activity = Activity::Mirror(Box::new(mirror));
        self.request(
            now,
            Drive::Mirror {
                state,
                model,
                params,
            },
        );
        self.last_sent = now;
    }

    /// Sends a motion and plays it as soon as the robot has it.
    pub fn play(&mut self, plan: &Plan<3>) {
        if self.refuses() {
            return;
        }
        self.plans += 1;
        self.activity = Activity::Play {
            plan: self.plans,
            engaged: false,
        };
        self.control(&OperatorControl::Plan {
            id: self.plans,
            bytes: codec::encode(plan),
        });
    }

    /// Lets go of the clutch, and sees to it that the robot holds the path up to the newest sample.
    pub fn release(&mut self) {
        if let Activity::Mirror(mirror) = &mut self.activity {
            self.counters.knots += u32::from(mirror.close());
            while let Activity::Mirror(mirror) = &mut self.activity
                && let Some(tail) = mirror.tail()
            {
                self.path(tail);
            }
        }
        if !matches!(self.activity, Activity::Nothing) {
            self.control(&OperatorControl::Release {
                engagement: self.engagement,
            });
            self.activity = Activity::Nothing;
        }
    }

    /// Emergency stop: on the stream, and by datagram until the robot says it has stopped.
    pub fn stop(&mut self, now: Stamp) {
        self.activity = Activity::Nothing;
        self.control(&OperatorControl::EmergencyStop);
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
            self.speak(now);
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
        match (stop, word) {
            (Some(a), Some(b)) => Some(if b.0 < a.0 { b } else { a }),
            (a, b) => a.or(b),
        }
    }

    fn next_word(&self) -> Option<Stamp> {
        match self.activity {
            Activity::Nothing | Activity::Play { engaged: false, .. } => None,
            Activity::Mirror(_) => Some(self.last_sent.offset_by_secs(if self.urgent {
                self.config.min_interval_s
            } else {
                self.config.max_silence_s
            })),
            Activity::Play { engaged: true, .. } => Some(
                self.last_sent
                    .offset_by_secs(self.config.max_silence_s.min(GO_S)),
            ),
        }
    }

    /// Sends the newest there is, whatever drives.
    fn speak(&mut self, now: Stamp) {
        self.last_sent = now;
        self.urgent = false;
        self.seq += 1;
        let lease_ms = (self.config.lease_s * 1e3) as u16;
        let datagram = match &mut self.activity {
            Activity::Nothing => return,
            Activity::Play { .. } => OperatorDatagram::Go {
                epoch: self.epoch,
                engagement: self.engagement,
                seq: self.seq,
                t_us: now.0 / 1000,
                lease_ms,
            },
            Activity::Mirror(mirror) => {
                let skill = self.skill.as_deref().filter(|_| self.model_stored);
                let Some(mut motion) = mirror.motion(skill, now, self.delay_s) else {
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
        self.outputs.push_back(Output::Datagram {
            bytes: datagram.encode(),
            motion: true,
        });
    }

    fn on_info(&mut self, info: Info) {
        self.state = info.state;
        let held = info.model;
        self.info = Some(info);
        match &self.skill {
            Some(skill) if held != Some(skill.id().0) => {
                let (id, bytes) = (skill.id().0, skill.to_bytes().to_vec());
                self.control(&OperatorControl::Model { id, bytes });
            }
            _ => {
                self.model_stored = self.skill.is_some();
                self.events.push_back(Event::Ready);
            }
        }
    }

    fn on_state(&mut self, state: RobotState, cause: Cause) {
        self.state = state;
        match state {
            RobotState::Stopped => {
                self.next_stop = None;
                self.activity = Activity::Nothing;
            }
            // The robot let go by itself: the clutch must be pressed again.
            RobotState::Holding => self.activity = Activity::Nothing,
            RobotState::Ready if cause == Cause::PlanFinished => self.activity = Activity::Nothing,
            _ => {}
        }
        self.events.push_back(Event::State(state, cause));
    }

    fn request(&mut self, now: Stamp, drive: Drive) {
        self.engagement += 1;
        self.before = Some(self.counters);
        let rotation = self.config.rotation.as_ref();
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
            path_bound_um: (self.path_bound_m() * 1e6).round() as u32,
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
        self.outputs.push_back(Output::Control(message.encode()));
    }

    fn datagram(&mut self, message: &OperatorDatagram) {
        self.outputs.push_back(Output::Datagram {
            bytes: message.encode(),
            motion: false,
        });
    }
}
