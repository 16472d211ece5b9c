//! What the robot says, and what it changes.

use telemime_protocol::time::Stamp;
use telemime_protocol::wire::DecodeError;
use telemime_protocol::wire::frame::Frame;
use telemime_protocol::wire::turn::WireRotation;
use telemime_protocol::wire::v1::{
    Cause, Drive, Info, Message, OperatorControl, OperatorDatagram, Refusal, RobotControl,
    RobotDatagram, RobotState,
};

use super::{Activity, Counters, Event, Session};

impl Session {
    /// A frame from the control stream.
    ///
    /// # Errors
    /// [`DecodeError`] for a frame that may not be ignored; the session is then over.
    pub fn handle_control(&mut self, now: Stamp, frame: &Frame) -> Result<(), DecodeError> {
        let message = match RobotControl::decode(&frame.payload) {
            Ok(message) => message,
            Err(_) if frame.ignorable => return Ok(()),
            Err(e) => {
                self.tally.robot_control(None, frame.payload.len());
                return Err(e);
            }
        };
        self.tally
            .robot_control(Some(&message), frame.payload.len());
        match message {
            RobotControl::Info(info) => self.on_info(info),
            RobotControl::Arm(arm) => self.arm = Some(arm),
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
                    ..
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
                hand_q,
                tip_q,
            } => {
                if engagement != self.engagement || !self.is_asking() {
                    // Granted what nobody wants any more: it would go on to the end of its lease.
                    self.control(&OperatorControl::Release { engagement });
                    return Ok(());
                }
                self.before = None;
                if let Some(correction) = self.correction() {
                    correction.begin(Stamp(t_us.saturating_mul(1000)));
                }
                self.events.push_back(Event::Engaged {
                    engagement,
                    t_us,
                    hand_m,
                    tip_m,
                    hand_q: hand_q.map(WireRotation::dequantise),
                    tip_q: tip_q.dequantise(),
                });
            }
            RobotControl::Refused { reason } => {
                if let (Refusal::Diverged, Activity::Mirror(mirror)) = (reason, &mut self.activity)
                {
                    mirror.go_without_model();
                } else if self.is_granted() {
                    // Something else was declined: what the robot follows is not left to its lease.
                    self.release();
                } else {
                    // It may be an earlier request that was declined; should this one be granted, nobody will be there for it.
                    if self.is_asking() {
                        let engagement = self.engagement;
                        self.control(&OperatorControl::Release { engagement });
                    }
                    self.end_activity();
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
        let datagram = RobotDatagram::decode(bytes);
        self.tally
            .robot_datagram(datagram.as_ref().ok(), bytes.len());
        match datagram {
            Ok(RobotDatagram::Ping { epoch, t1_us }) if epoch == self.epoch => {
                let t_us = now.0 / 1000;
                self.datagram(&OperatorDatagram::Pong {
                    epoch,
                    t1_us,
                    t2_us: t_us,
                    t3_us: t_us,
                });
                if let Some(clock) = self.external {
                    self.datagram(&OperatorDatagram::Clock { epoch, clock });
                }
            }
            Ok(RobotDatagram::Telemetry(telemetry)) if telemetry.epoch == self.epoch => {
                let said =
                    (telemetry.t_us != 0).then(|| Stamp(telemetry.t_us.saturating_mul(1000)));
                self.down
                    .arrive(telemetry.seq, said.map(|at| now.secs_since(at)));
                self.pace.on_telemetry(now, &telemetry);
                self.clock_uncertainty_us = Some(telemetry.clock_uncertainty_us);
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
            Ok(RobotDatagram::Reception(told)) if told.epoch == self.epoch => {
                // Reordered ones are no news.
                if self.up.is_none_or(|up| up.newest_seq <= told.newest_seq) {
                    self.pace.on_reception(&told);
                    self.up = Some(told);
                }
            }
            Ok(RobotDatagram::Servo(times)) if times.epoch == self.epoch => {
                if self.servo.is_none_or(|last| last.ticks <= times.ticks) {
                    self.servo = Some(times);
                }
            }
            _ => self.counters.dropped += 1,
        }
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

    /// Whether the newest request is for what is being done, granted or not.
    fn is_asking(&self) -> bool {
        match self.activity {
            Activity::Mirror(_) => true,
            Activity::Play { engaged, .. } => engaged,
            Activity::Nothing => false,
        }
    }

    /// Whether the activity is one the robot has begun with.
    fn is_granted(&self) -> bool {
        let planned = matches!(self.activity, Activity::Play { engaged: false, .. });
        !planned && self.before.is_none()
    }

    fn on_state(&mut self, state: RobotState, cause: Cause) {
        self.state = state;
        match state {
            RobotState::Stopped => {
                self.next_stop = None;
                self.end_activity();
            }
            // The robot let go by itself: the clutch must be pressed again. What has not been granted yet it cannot have
            // let go of: then it says how the last session left it.
            RobotState::Holding if self.is_granted() => self.end_activity(),
            RobotState::Ready if cause == Cause::PlanFinished && self.is_granted() => {
                self.end_activity();
            }
            _ => {}
        }
        self.events.push_back(Event::State(state, cause));
    }
}
