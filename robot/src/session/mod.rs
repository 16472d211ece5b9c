//! The robot's side of a session, sans-IO: bytes and reports in, bytes and orders out.
//!
//! Call order: any `handle_*`, then [`Session::poll_output`] until it is empty, then [`Session::poll_timeout`]
//! for when to call [`Session::handle_timeout`].

mod motion;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::sync::Arc;

use nalgebra::{Quaternion, UnitQuaternion};
use telemime_endpoint::reception::{Quantiles, Received, Reception, Spread};
use telemime_endpoint::tally::Tally;
use telemime_endpoint::{Mono, Pacer};
use telemime_protocol::checkpoint::PosePlan;
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::arm::WireArm;
use telemime_protocol::wire::codec;
use telemime_protocol::wire::frame::Frame;
use telemime_protocol::wire::turn::{WireRotation, dequantise_grip, quantise_grip};
use telemime_protocol::wire::v1::{
    self, Cause, Drive, Engage, ExternalClock, Info, MAX_PLAN_LEN, Message, ModelId,
    OperatorControl, OperatorDatagram, Refusal, RobotControl, RobotDatagram, RobotState,
    ServoTimes, Telemetry,
};
use telemime_protocol::wire::{DecodeError, Version, Versions};

use crate::clock::{SessionClock, Slew};
use crate::safety::SafetyConfig;
use crate::servo::thread::Times;
use crate::servo::{self, Engagement, Order, Report, Source, Ticket, Trajectory};
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

    /// The servo's report of a tick.
    pub fn handle_report(&mut self, report: &Report, timing: Times) {
        self.timing = timing;
        let changed = self.transitions != Some(report.transitions);
        self.transitions = Some(report.transitions);
        self.report = Some(*report);
        if std::mem::take(&mut self.owed) {
            self.order(Order::Operator(true));
        }
        let follows = matches!(report.state, RobotState::Engaged | RobotState::Coasting);
        if follows && self.mirror.is_some() {
            self.ages.add(report.age_s);
        }
        let pending = self.acknowledged != self.engagement;
        if pending && report.engagement == self.ticket() {
            self.acknowledged = self.engagement;
            let t_us = self
                .clock
                .to_session(report.engaged_at)
                .map_or(0, |t| t.0 / 1000);
            self.send(&RobotControl::Engaged {
                engagement: self.engagement,
                t_us,
                hand_m: report.mapping.hand_m.cast::<f32>().into(),
                tip_m: report.mapping.tip_m.cast::<f32>().into(),
                hand_q: report
                    .mapping
                    .hand_orientation
                    .map(|q| WireRotation::quantise(&q)),
                tip_q: WireRotation::quantise(&report.mapping.tip_orientation),
            });
        } else if pending && report.declined == self.ticket() {
            self.acknowledged = self.engagement;
            self.mirror = None;
            self.refuse(match report.state {
                RobotState::Stopped => Refusal::Stopped,
                _ => Refusal::Moving,
            });
        }
        if changed {
            self.send_state(report);
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

    /// An order that [`poll_output`](Self::poll_output) gave found no place on its way to the servo, and the brake was pulled for it.
    pub fn handle_lost(&mut self, order: &Order) {
        match order {
            // It is nowhere: no report will ever acknowledge or decline it.
            Order::Engage(engagement) if engagement.ticket == self.ticket() => {
                self.acknowledged = self.engagement;
                self.mirror = None;
                self.refuse(Refusal::Moving);
            }
            Order::Operator(true) => self.owed = true,
            _ => {}
        }
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

    fn store_model(&mut self, now: Mono, id: ModelId, bytes: &[u8]) {
        match Skill::from_bytes(bytes) {
            Ok(skill) if skill.id().0 == id => {
                // What is being followed goes on with the model it began with: another one would be a jump.
                let skill = Some(Arc::new(skill));
                if self.is_following() {
                    self.next_skill = skill;
                } else {
                    (self.skill, self.next_skill) = (skill, None);
                }
                self.send(&RobotControl::ModelStored { id });
                // What was asked meanwhile waited behind the model: ask again before anybody engages by the answers.
                (self.pings, self.next_ping) = (0, now);
            }
            _ => self.refuse(Refusal::BadModel),
        }
    }

    /// Something is followed, or was granted a moment ago.
    fn is_following(&self) -> bool {
        let state = self.report.map(|r| r.state);
        self.acknowledged != self.engagement
            || matches!(state, Some(RobotState::Engaged | RobotState::Coasting))
    }

    fn engage(&mut self, now: Mono, engage: &Engage) -> Result<(), Refusal> {
        let report = self.report.as_ref().ok_or(Refusal::Moving)?;
        match report.state {
            RobotState::Stopped => return Err(Refusal::Stopped),
            RobotState::Engaged | RobotState::Coasting => return Err(Refusal::AlreadyEngaged),
            RobotState::Idle | RobotState::Ready | RobotState::Holding => {}
        }
        if report.moving {
            return Err(Refusal::Moving);
        }
        if engage.engagement <= self.engagement {
            return Err(Refusal::OldEngagement);
        }
        // What was granted a moment ago is not in a report yet.
        if self.acknowledged != self.engagement {
            return Err(Refusal::AlreadyEngaged);
        }
        if let Some(next) = self.next_skill.take() {
            self.skill = Some(next);
        }
        let [w, x, y, z] = engage.rotation.map(f64::from);
        let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        // From here on an estimate may be applied at once: nothing is being followed.
        self.clock.slew(now, false);
        let asked = Stamp(engage.t_us.saturating_mul(1000));
        let asked_at = self.clock.to_mono(asked).ok_or(Refusal::ClockUnknown)?;
        let age_s = now.secs_since(asked_at);
        if age_s.abs() > self.config.max_delay_s {
            return Err(Refusal::StaleReference);
        }
        let late_s = age_s.max(0.0);
        let (source, mirror) = match &engage.drive {
            Drive::Mirror {
                state,
                model,
                params,
                pose,
            } => {
                let mirror = Mirror::new(engage).ok_or(Refusal::BadMapping)?;
                let state = state.dequantise();
                let valid_at = self.clock.to_mono(state.t).ok_or(Refusal::ClockUnknown)?;
                let age_s = now.secs_since(valid_at);
                if !(-self.config.max_delay_s..=self.config.max_delay_s).contains(&age_s) {
                    return Err(Refusal::StaleReference);
                }
                let forecast = self.forecast(&state, *model, &params.dequantise());
                let source = Source::Mirror {
                    forecast,
                    valid_at,
                    turn: self.turn_forecast(state.t, *model, pose.turn.as_ref()),
                    grip: pose.grip.map(dequantise_grip),
                };
                (source, Some(mirror))
            }
            Drive::Play { plan } => {
                let (_, held) = self
                    .plan
                    .as_ref()
                    .filter(|(id, _)| id == plan)
                    .ok_or(Refusal::BadPlan)?;
                let curve = held.curve().map_err(|_| Refusal::BadPlan)?;
                let (start_s, duration_s) = curve.position.span_s();
                if start_s != 0.0 {
                    return Err(Refusal::BadPlan);
                }
                (
                    Source::Play(Arc::new(Trajectory { curve, duration_s })),
                    None,
                )
            }
        };
        self.engagement = engage.engagement;
        self.mirror = mirror;
        self.order(Order::Engage(Engagement {
            ticket: self.ticket(),
            model: self.skill.as_ref().map(|skill| skill.id().0),
            source,
            scale: f64::from(engage.scale),
            rotation,
            lease: self.lease(now, engage.lease_ms, late_s),
        }));
        Ok(())
    }

    fn follow_clock(&mut self, now: Mono) {
        let following = self
            .report
            .is_some_and(|r| matches!(r.state, RobotState::Engaged | RobotState::Coasting));
        if self.clock.slew(now, following) == Slew::Step {
            self.brake(Cause::ClockStep);
        }
    }

    /// What the operator is told of its motions.
    fn told(&self) -> v1::Reception {
        let us = |s: f64| (s * 1e6).round().clamp(0.0, f64::from(u32::MAX)) as u32;
        let four = |times: Option<Quantiles>| {
            let t = times.unwrap_or_default();
            [t.mean_s, t.p50_s, t.p95_s, t.max_s].map(us)
        };
        let Seen { up, age, .. } = self.seen();
        v1::Reception {
            epoch: self.epoch,
            newest_seq: self.reception.newest(),
            received: up.received,
            duplicates: up.duplicates,
            reordered: up.reordered,
            loss_runs: up.loss_runs,
            longest_loss_run: up.longest_loss_run,
            jitter_us: us(up.jitter_s),
            delay_us: four(up.delay),
            age_us: four(age),
        }
    }

    fn servo_times(&self) -> ServoTimes {
        let four = |q: servo::Quantiles| [q.p50_ns, q.p99_ns, q.p999_ns, q.max_ns];
        let Times {
            ticks,
            mean_ns,
            work,
            wake,
            overruns,
        } = self.timing;
        ServoTimes {
            epoch: self.epoch,
            ticks,
            overruns,
            mean_ns,
            work_ns: four(work),
            wake_ns: four(wake),
        }
    }

    fn telemetry(&mut self, now: Mono) -> Option<Telemetry> {
        let report = self.report?;
        self.telemetry_seq += 1;
        let milliseconds = |s: f64| (s * 1e3).round().clamp(0.0, f64::from(u16::MAX)) as u16;
        let uncertainty_us = self
            .clock
            .uncertainty_s(now)
            .map_or(f64::from(u32::MAX), |s| s * 1e6);
        Some(Telemetry {
            epoch: self.epoch,
            seq: self.telemetry_seq,
            state: report.state,
            engagement: if report.engagement.epoch == self.epoch {
                report.engagement.number
            } else {
                0
            },
            t_us: self.clock.to_session(report.at).map_or(0, |t| t.0 / 1000),
            clock_uncertainty_us: uncertainty_us as u32,
            age_ms: milliseconds(report.age_s),
            // 0 is for what is not known: a delay that cannot be told from none is the least there is.
            delay_ms: self.delay_s.map_or(0, |s| milliseconds(s).max(1)),
            path_frontier: self.mirror.as_ref().map_or(0, Mirror::frontier),
            received: self.reception.received(),
            newest_seq: self.reception.newest(),
            dropped: self.dropped,
            clamps: report.clamps,
            tip_m: report.tip_m.cast::<f32>().into(),
            tip_q: WireRotation::quantise(&report.orientation),
            grip: report.opening.map(quantise_grip),
            q: report
                .q
                .iter()
                .take(usize::from(self.info.joints))
                .map(|&v| v as f32)
                .collect(),
        })
    }

    /// Only those who know of a stop may leave it, and one made at the robot is left at the robot.
    fn reset(&mut self, changes: u32) {
        let Some(report) = self.report.filter(|r| r.state == RobotState::Stopped) else {
            return;
        };
        if report.cause != Cause::OperatorStop || report.transitions != changes {
            return self.refuse(Refusal::NotYours);
        }
        self.order(Order::Reset {
            operator: true,
            stop: Some(changes),
        });
    }

    fn ticket(&self) -> Ticket {
        Ticket {
            epoch: self.epoch,
            number: self.engagement,
        }
    }

    fn send_state(&mut self, report: &Report) {
        self.send(&RobotControl::State {
            state: report.state,
            cause: report.cause,
            changes: report.transitions,
        });
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
