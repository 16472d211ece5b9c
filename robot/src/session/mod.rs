//! The robot's side of a session, sans-IO: bytes and reports in, bytes and orders out.
//!
//! Call order: any `handle_*`, then [`Session::poll_output`] until it is empty, then [`Session::poll_timeout`]
//! for when to call [`Session::handle_timeout`].

mod grant;
mod motion;
mod tell;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::sync::Arc;

use telemime_endpoint::reception::{Quantiles, Received, Reception, Spread};
use telemime_endpoint::tally::Tally;
use telemime_endpoint::{Mono, Pacer};
use telemime_protocol::checkpoint::PosePlan;
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::arm::WireArm;
use telemime_protocol::wire::codec;
use telemime_protocol::wire::frame::Frame;
use telemime_protocol::wire::v1::{
    Cause, ExternalClock, Info, MAX_PLAN_LEN, Message, OperatorControl, OperatorDatagram, Refusal,
    RobotControl, RobotDatagram, RobotState,
};
use telemime_protocol::wire::{DecodeError, Version, Versions};

use crate::clock::{SessionClock, Slew};
use crate::safety::SafetyConfig;
use crate::servo::thread::Times;
use crate::servo::{Order, Report};
use motion::Mirror;

/// Pings in quick succession at the start, so that the clock is known before the first engage.
const QUICK_PINGS: u32 = 8;
const QUICK_PING_S: f64 = 0.02;
const PING_S: f64 = 0.25;

/// Every so many pings the operator is told what has become of its motions, in the same packet.
const RECEPTION_PINGS: u32 = 4;

/// On a link that is too thin for it, telemetry is this far apart, s: the operator gives the link up after a second.
const RAREST_TELEMETRY_S: f64 = 0.4;

/// What a session is set to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SessionConfig {
    /// Interval of telemetry, s, unless the link is too thin for it.
    pub telemetry_s: f64,
    /// A sample that took longer than this to arrive authorises nothing beyond, s.
    pub max_delay_s: f64,
    /// The longest time that a message authorises motion for, s; what is late is taken off this.
    pub max_lease_s: f64,
    /// The protocol versions this robot speaks.
    pub versions: Versions,
}

impl Default for SessionConfig {
    fn default() -> Self {
        Self {
            telemetry_s: 0.05,
            max_delay_s: 0.5,
            max_lease_s: SafetyConfig::default().max_lease_s,
            versions: Versions::default(),
        }
    }
}

/// What a session wants done.
#[derive(Debug)]
#[expect(
    clippy::large_enum_variant,
    reason = "moved once, into the servo's ring"
)]
pub enum Output {
    /// A message for the control stream, not yet framed.
    Control(Vec<u8>),
    /// A datagram.
    Datagram(Vec<u8>),
    /// An order for the servo.
    Order(Order),
    /// A stop or hold, past every queue.
    Brake(Cause),
    /// The operator said goodbye.
    Goodbye,
}

/// What the session counts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counters {
    /// Motions and goes of the session that arrived, each counted once.
    pub received: u32,
    /// Datagrams dropped: malformed, foreign, late or impossible.
    pub dropped: u32,
}

/// What has become of the datagrams of a session.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Seen {
    /// The operator's motions and goes.
    pub up: Received,
    /// One-way delay of the pings to the operator, by the exchanges.
    pub down: Option<Quantiles>,
    /// Age of the hand state that was followed, over the servo's ticks.
    pub age: Option<Quantiles>,
}

/// One operator's session.
#[derive(Debug)]
pub struct Session {
    config: SessionConfig,
    info: Info,
    epoch: u32,
    version: Version,
    clock: SessionClock,
    external: Option<ExternalClock>,
    skill: Option<Arc<Skill>>,
    /// Takes its place at the next engage.
    next_skill: Option<Arc<Skill>>,
    plan: Option<(u32, PosePlan)>,
    mirror: Option<Mirror>,
    engagement: u32,
    acknowledged: u32,
    newest_seq: u32,
    delay_s: Option<f64>,
    dropped: u32,
    tally: Tally,
    reception: Reception,
    ages: Spread,
    down: Spread,
    pacer: Pacer,
    report: Option<Report>,
    transitions: Option<u32>,
    timing: Times,
    telemetry_seq: u32,
    pings: u32,
    next_ping: Mono,
    next_telemetry: Mono,
    outputs: VecDeque<Output>,
    /// The servo has not been told of this operator: the order was lost.
    owed: bool,
}

impl Session {
    /// A session that begins at `now` with authority. `skill` is the model still held from before.
    pub fn new(
        config: SessionConfig,
        mut info: Info,
        epoch: u32,
        skill: Option<Arc<Skill>>,
        now: Mono,
    ) -> Self {
        info.model = skill.as_ref().map(|s| s.id().0);
        let mut session = Self {
            config,
            epoch,
            version: Version::V1,
            clock: SessionClock::default(),
            external: None,
            skill,
            next_skill: None,
            plan: None,
            mirror: None,
            engagement: 0,
            acknowledged: 0,
            newest_seq: 0,
            delay_s: None,
            dropped: 0,
            tally: Tally::default(),
            reception: Reception::default(),
            ages: Spread::default(),
            down: Spread::default(),
            pacer: Pacer::new(config.telemetry_s, RAREST_TELEMETRY_S),
            report: None,
            transitions: None,
            timing: Times::default(),
            telemetry_seq: 0,
            pings: 0,
            next_ping: now,
            next_telemetry: now,
            outputs: VecDeque::new(),
            owed: false,
            info,
        };
        session.send(&RobotControl::Info(session.info.clone()));
        session.order(Order::Operator(true));
        session
    }

    /// Speaks `version` instead of version 1.
    #[must_use]
    pub fn speaking(mut self, version: Version) -> Self {
        self.version = version;
        self
    }

    /// Says how the arm is built, after what it said of itself.
    #[must_use]
    pub fn showing(mut self, arm: Option<WireArm>) -> Self {
        if let Some(arm) = arm {
            self.send(&RobotControl::Arm(arm));
        }
        self
    }

    /// The model held, for the next session.
    pub fn skill(&self) -> Option<Arc<Skill>> {
        self.next_skill.as_ref().or(self.skill.as_ref()).cloned()
    }

    /// What the robot's own disciplined clock says now, relative to its monotonic one, if it has one.
    pub fn set_external(&mut self, external: Option<ExternalClock>) {
        self.external = external;
    }

    /// The clock estimate.
    pub fn clock(&self) -> &SessionClock {
        &self.clock
    }

    /// The counters.
    pub fn counters(&self) -> Counters {
        Counters {
            received: self.reception.received(),
            dropped: self.dropped,
        }
    }

    /// What passed, by kind.
    pub fn tally(&self) -> &Tally {
        &self.tally
    }

    /// What has become of the session's datagrams on their way.
    pub fn seen(&self) -> Seen {
        Seen {
            up: self.reception.summary(),
            down: self.down.quantiles(),
            age: self.ages.quantiles(),
        }
    }

    /// The path received in mirror, if one is being followed.
    pub fn mirror(&self) -> Option<&Mirror> {
        self.mirror.as_ref()
    }

    /// A frame from the control stream.
    ///
    /// # Errors
    /// [`DecodeError`] for a frame that may not be ignored; the session is then over.
    pub fn handle_control(&mut self, now: Mono, frame: &Frame) -> Result<(), DecodeError> {
        let message = match OperatorControl::decode(&frame.payload) {
            Ok(message) => message,
            Err(_) if frame.ignorable => return Ok(()),
            Err(e) => {
                self.tally.operator_control(None, frame.payload.len());
                return Err(e);
            }
        };
        self.tally
            .operator_control(Some(&message), frame.payload.len());
        match message {
            OperatorControl::Model { id, bytes } => self.store_model(now, id, &bytes),
            OperatorControl::Plan { id, bytes } => {
                match codec::decode::<PosePlan, MAX_PLAN_LEN>(&bytes) {
                    Ok(plan) => {
                        self.plan = Some((id, plan));
                        self.send(&RobotControl::PlanStored { id });
                    }
                    Err(_) => self.refuse(Refusal::BadPlan),
                }
            }
            OperatorControl::Engage(engage) => {
                if let Err(reason) = self.engage(now, &engage) {
                    self.refuse(reason);
                }
            }
            OperatorControl::Release { engagement } => {
                if engagement == self.engagement {
                    self.order(Order::Release(self.ticket()));
                }
            }
            OperatorControl::Path(tail) => self.on_path(&tail),
            OperatorControl::EmergencyStop => {
                self.brake(Cause::OperatorStop);
                // A stop on top of a stop changes no state: without this the operator would wait for news.
                if let Some(report) = self.report.filter(|r| r.state == RobotState::Stopped) {
                    self.send_state(&report);
                }
            }
            OperatorControl::Reset { changes } => self.reset(changes),
            OperatorControl::Goodbye => self.outputs.push_back(Output::Goodbye),
        }
        Ok(())
    }

    /// A datagram. Nothing in it can end the session: what is wrong is dropped and counted.
    pub fn handle_datagram(&mut self, now: Mono, bytes: &[u8]) {
        let datagram = self.version.decode_operator_datagram(bytes);
        self.tally
            .operator_datagram(datagram.as_ref().ok(), bytes.len());
        let taken = match datagram {
            Ok(OperatorDatagram::Motion(motion)) => {
                self.arrived(now, motion.epoch, motion.seq, motion.state.t_us);
                self.on_motion(now, &motion)
            }
            Ok(OperatorDatagram::Go {
                epoch,
                engagement,
                seq,
                t_us,
                lease_ms,
                bend,
            }) => {
                self.arrived(now, epoch, seq, t_us);
                let ours = epoch == self.epoch && engagement == self.engagement;
                ours && self.on_go(now, seq, t_us, lease_ms, bend.as_ref())
            }
            Ok(OperatorDatagram::Pong {
                epoch,
                t1_us,
                t2_us,
                t3_us,
            }) if epoch == self.epoch => {
                let stamp = |us: i64| Stamp(us.saturating_mul(1000));
                self.clock.observe(
                    Mono(t1_us.saturating_mul(1000)),
                    stamp(t2_us),
                    stamp(t3_us),
                    now,
                );
                self.follow_clock(now);
                self.pace(now, Mono(t1_us.saturating_mul(1000)), stamp(t2_us));
                true
            }
            Ok(OperatorDatagram::Clock {
                epoch,
                clock: theirs,
            }) if epoch == self.epoch => {
                if let Some(ours) = self.external {
                    let ahead_us = ours.ahead_us.saturating_sub(theirs.ahead_us);
                    let bound_us = f64::from(ours.dispersion_us) + f64::from(theirs.dispersion_us);
                    let offset_ns = ahead_us.saturating_mul(1000);
                    self.clock.observe_outside(now, offset_ns, bound_us * 1e-6);
                    self.follow_clock(now);
                }
                true
            }
            Ok(OperatorDatagram::Stop { epoch }) if epoch == self.epoch => {
                self.brake(Cause::OperatorStop);
                true
            }
            Ok(
                OperatorDatagram::Pong { .. }
                | OperatorDatagram::Stop { .. }
                | OperatorDatagram::Clock { .. },
            )
            | Err(_) => false,
        };
        if !taken {
            self.dropped += 1;
        }
    }

    /// A motion or go has come, whatever becomes of it.
    fn arrived(&mut self, now: Mono, epoch: u32, seq: u32, t_us: i64) {
        if epoch == self.epoch {
            let said_at = self.clock.to_mono(Stamp(t_us.saturating_mul(1000)));
            self.reception
                .arrive(seq, said_at.map(|at| now.secs_since(at)));
        }
    }

    /// A ping sent at `t1` was heard at `t2`: telemetry takes the same way.
    fn pace(&mut self, now: Mono, t1: Mono, t2: Stamp) {
        if let Some(sent) = self.clock.to_session(t1) {
            let down_s = t2.secs_since(sent);
            self.down.add(down_s);
            self.pacer.observe(now.0 as f64 * 1e-9, down_s, false);
        }
    }

    /// Something is due.
    pub fn handle_timeout(&mut self, now: Mono) {
        if now >= self.next_ping {
            self.pings += 1;
            let gap_s = if self.pings < QUICK_PINGS {
                QUICK_PING_S
            } else {
                PING_S
            };
            self.next_ping = now.offset_by_secs(gap_s);
            let ping = RobotDatagram::Ping {
                epoch: self.epoch,
                t1_us: now.0 / 1000,
            };
            self.say(&ping);
            if self.pings.is_multiple_of(RECEPTION_PINGS) && self.reception.newest() > 0 {
                self.say(&RobotDatagram::Reception(self.told()));
                self.say(&RobotDatagram::Servo(self.servo_times()));
            }
        }
        if now >= self.next_telemetry {
            self.next_telemetry = now.offset_by_secs(self.pacer.interval_s());
            if let Some(telemetry) = self.telemetry(now) {
                self.say(&RobotDatagram::Telemetry(telemetry));
            }
        }
    }

    /// The connection ended: the operator has no authority any more.
    pub fn handle_closed(&mut self) {
        self.order(Order::Operator(false));
    }

    /// What to do next.
    pub fn poll_output(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// When to call [`Session::handle_timeout`], and for what.
    pub fn poll_timeout(&self) -> (Mono, &'static str) {
        if self.next_ping < self.next_telemetry {
            (self.next_ping, "ask for the session clock")
        } else {
            (self.next_telemetry, "send telemetry")
        }
    }

    fn follow_clock(&mut self, now: Mono) {
        let following = self
            .report
            .is_some_and(|r| matches!(r.state, RobotState::Engaged | RobotState::Coasting));
        if self.clock.slew(now, following) == Slew::Step {
            self.brake(Cause::ClockStep);
        }
    }

    fn refuse(&mut self, reason: Refusal) {
        self.send(&RobotControl::Refused { reason });
    }

    fn send(&mut self, message: &RobotControl) {
        let bytes = message.encode();
        self.tally.robot_control(Some(message), bytes.len());
        self.outputs.push_back(Output::Control(bytes));
    }

    fn say(&mut self, message: &RobotDatagram) {
        let bytes = message.encode();
        self.tally.robot_datagram(Some(message), bytes.len());
        self.outputs.push_back(Output::Datagram(bytes));
    }

    fn order(&mut self, order: Order) {
        self.outputs.push_back(Output::Order(order));
    }

    fn brake(&mut self, cause: Cause) {
        self.outputs.push_back(Output::Brake(cause));
    }
}
