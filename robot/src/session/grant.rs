//! What is granted: a model that is held, an engagement, the way out of a stop.

use std::sync::Arc;

use nalgebra::{Quaternion, UnitQuaternion};
use telemime_endpoint::Mono;
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::turn::dequantise_grip;
use telemime_protocol::wire::v1::{
    Cause, Drive, Engage, ModelId, Refusal, RobotControl, RobotState,
};

use super::Session;
use super::motion::Mirror;
use crate::servo::{Engagement, Order, Source, Ticket, Trajectory};

impl Session {
    pub(super) fn store_model(&mut self, now: Mono, id: ModelId, bytes: &[u8]) {
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
    pub(super) fn is_following(&self) -> bool {
        let state = self.report.map(|r| r.state);
        self.acknowledged != self.engagement
            || matches!(state, Some(RobotState::Engaged | RobotState::Coasting))
    }

    pub(super) fn engage(&mut self, now: Mono, engage: &Engage) -> Result<(), Refusal> {
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
        let lease = self.lease(now, engage.lease_ms, late_s);
        if lease.until <= now {
            return Err(Refusal::StaleReference);
        }
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
            lease,
        }));
        Ok(())
    }

    /// Only those who know of a stop may leave it, and one made at the robot is left at the robot.
    pub(super) fn reset(&mut self, changes: u32) {
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

    pub(super) fn ticket(&self) -> Ticket {
        Ticket {
            epoch: self.epoch,
            number: self.engagement,
        }
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
}
