//! What is asked of the robot: to follow, to play, to let go, to stop, to leave.

use telemime_protocol::checkpoint::PosePlan;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::codec;
use telemime_protocol::wire::v1::{Drive, Engage, OperatorControl, Refusal};

use super::correct::{Correction, Leeway};
use super::mirror::Mirror;
use super::{Activity, Event, Session};

impl Session {
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
    pub(super) fn complete_path(&mut self) {
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
        // What was granted and is not known of yet has a path, too.
        self.complete_path();
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

    pub(super) fn request(&mut self, now: Stamp, drive: Drive) {
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
            lease_ms: self.config.lease_ms(),
        };
        self.control(&OperatorControl::Engage(engage));
    }

    pub(super) fn refuses(&mut self) -> bool {
        let stopping = self.stop_is_unconfirmed();
        if stopping {
            self.events.push_back(Event::Refused(Refusal::Stopped));
        }
        stopping
    }
}
