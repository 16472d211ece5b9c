//! What passes between the ends, by kind: messages and their bytes, without the transport's own.

use std::collections::BTreeMap;

use telemime_protocol::wire::v1::{
    Cause, OperatorControl, OperatorDatagram, Refusal, RobotControl, RobotDatagram, RobotState,
};

use crate::metrics::Page;

/// Messages of one kind.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Passed {
    /// How many.
    pub messages: u64,
    /// Their bytes.
    pub bytes: u64,
}

/// What an operator says.
const OPERATOR: [&str; 14] = [
    "clock",
    "emergency_stop",
    "engage",
    "go",
    "goodbye",
    "malformed",
    "model",
    "motion",
    "path",
    "plan",
    "pong",
    "release",
    "reset",
    "stop",
];

/// What a robot says.
const ROBOT: [&str; 12] = [
    "arm",
    "engaged",
    "info",
    "malformed",
    "model_stored",
    "ping",
    "plan_stored",
    "reception",
    "refused",
    "servo",
    "state",
    "telemetry",
];

/// Why a robot declines what it is asked.
const REFUSALS: [Refusal; 11] = [
    Refusal::Stopped,
    Refusal::AlreadyEngaged,
    Refusal::OldEngagement,
    Refusal::StaleReference,
    Refusal::ClockUnknown,
    Refusal::BadModel,
    Refusal::BadPlan,
    Refusal::BadMapping,
    Refusal::Moving,
    Refusal::Diverged,
    Refusal::NotYours,
];

/// A robot's states, with a word for machines each.
pub const STATES: [(RobotState, &str); 6] = [
    (RobotState::Idle, "idle"),
    (RobotState::Ready, "ready"),
    (RobotState::Engaged, "engaged"),
    (RobotState::Coasting, "coasting"),
    (RobotState::Holding, "holding"),
    (RobotState::Stopped, "stopped"),
];

/// Why a state changed, likewise.
pub const CAUSES: [(Cause, &str); 11] = [
    (Cause::Requested, "requested"),
    (Cause::NewsArrived, "news_arrived"),
    (Cause::NewsLate, "news_late"),
    (Cause::LeaseExpired, "lease_expired"),
    (Cause::PlanFinished, "plan_finished"),
    (Cause::ConnectionLost, "connection_lost"),
    (Cause::OperatorStop, "operator_stop"),
    (Cause::LocalStop, "local_stop"),
    (Cause::ClockStep, "clock_step"),
    (Cause::Fault, "fault"),
    (Cause::ArmFault, "arm_fault"),
];

/// Whether an arm that was in `before` and is in `now`, each with its cause, has been stopped: it followed and does so
/// no longer, or the emergency stop was pulled; one that takes over from another is one more.
pub fn is_stop(before: Option<(RobotState, Cause)>, now: (RobotState, Cause)) -> bool {
    let follows = |state| matches!(state, RobotState::Engaged | RobotState::Coasting);
    let stopped = now.0 == RobotState::Stopped && before != Some(now);
    stopped || (before.is_some_and(|(state, _)| follows(state)) && !follows(now.0))
}

fn refusal(reason: Refusal) -> &'static str {
    match reason {
        Refusal::Stopped => "stopped",
        Refusal::AlreadyEngaged => "already_engaged",
        Refusal::OldEngagement => "old_engagement",
        Refusal::StaleReference => "stale_reference",
        Refusal::ClockUnknown => "clock_unknown",
        Refusal::BadModel => "bad_model",
        Refusal::BadPlan => "bad_plan",
        Refusal::BadMapping => "bad_mapping",
        Refusal::Moving => "moving",
        Refusal::Diverged => "diverged",
        Refusal::NotYours => "not_yours",
    }
}

/// Everything that passed in a session, or in several.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tally {
    operator: BTreeMap<&'static str, Passed>,
    robot: BTreeMap<&'static str, Passed>,
    refused: BTreeMap<&'static str, u64>,
}

impl Default for Tally {
    fn default() -> Self {
        Self {
            operator: OPERATOR.map(|kind| (kind, Passed::default())).into(),
            robot: ROBOT.map(|kind| (kind, Passed::default())).into(),
            refused: REFUSALS.map(|reason| (refusal(reason), 0)).into(),
        }
    }
}

fn add(to: &mut BTreeMap<&'static str, Passed>, kind: &'static str, bytes: usize) {
    let passed = to.entry(kind).or_default();
    passed.messages += 1;
    passed.bytes += bytes as u64;
}

impl Tally {
    /// A control message from the operator; `None` if it could not be read.
    pub fn operator_control(&mut self, message: Option<&OperatorControl>, bytes: usize) {
        let kind = match message {
            Some(OperatorControl::Model { .. }) => "model",
            Some(OperatorControl::Plan { .. }) => "plan",
            Some(OperatorControl::Engage(_)) => "engage",
            Some(OperatorControl::Path(_)) => "path",
            Some(OperatorControl::Release { .. }) => "release",
            Some(OperatorControl::EmergencyStop) => "emergency_stop",
            Some(OperatorControl::Reset { .. }) => "reset",
            Some(OperatorControl::Goodbye) => "goodbye",
            None => "malformed",
        };
        add(&mut self.operator, kind, bytes);
    }

    /// A datagram from the operator; `None` if it could not be read.
    pub fn operator_datagram(&mut self, message: Option<&OperatorDatagram>, bytes: usize) {
        let kind = match message {
            Some(OperatorDatagram::Motion(_)) => "motion",
            Some(OperatorDatagram::Go { .. }) => "go",
            Some(OperatorDatagram::Pong { .. }) => "pong",
            Some(OperatorDatagram::Stop { .. }) => "stop",
            Some(OperatorDatagram::Clock { .. }) => "clock",
            None => "malformed",
        };
        add(&mut self.operator, kind, bytes);
    }

    /// A control message from the robot; `None` if it could not be read.
    pub fn robot_control(&mut self, message: Option<&RobotControl>, bytes: usize) {
        let kind = match message {
            Some(RobotControl::Info(_)) => "info",
            Some(RobotControl::ModelStored { .. }) => "model_stored",
            Some(RobotControl::PlanStored { .. }) => "plan_stored",
            Some(RobotControl::Engaged { .. }) => "engaged",
            Some(RobotControl::Refused { reason }) => {
                *self.refused.entry(refusal(*reason)).or_default() += 1;
                "refused"
            }
            Some(RobotControl::State { .. }) => "state",
            Some(RobotControl::Arm(_)) => "arm",
            None => "malformed",
        };
        add(&mut self.robot, kind, bytes);
    }

    /// A datagram from the robot; `None` if it could not be read.
    pub fn robot_datagram(&mut self, message: Option<&RobotDatagram>, bytes: usize) {
        let kind = match message {
            Some(RobotDatagram::Ping { .. }) => "ping",
            Some(RobotDatagram::Telemetry(_)) => "telemetry",
            Some(RobotDatagram::Reception(_)) => "reception",
            Some(RobotDatagram::Servo(_)) => "servo",
            None => "malformed",
        };
        add(&mut self.robot, kind, bytes);
    }

    /// The sum with another session's.
    #[must_use]
    pub fn plus(mut self, other: &Self) -> Self {
        type Kinds = BTreeMap<&'static str, Passed>;
        let sum = |to: &mut Kinds, from: &Kinds| {
            for (kind, passed) in from {
                let to = to.entry(*kind).or_default();
                to.messages += passed.messages;
                to.bytes += passed.bytes;
            }
        };
        sum(&mut self.operator, &other.operator);
        sum(&mut self.robot, &other.robot);
        for (reason, times) in &other.refused {
            *self.refused.entry(*reason).or_default() += times;
        }
        self
    }

    /// Models that the robot took.
    pub fn models_stored(&self) -> u64 {
        self.robot["model_stored"].messages
    }

    /// Writes it down, as the operator's daemon sees it or the robot's.
    pub fn show(&self, page: &mut Page, at_robot: bool) {
        let (sent, received) = if at_robot {
            (&self.robot, &self.operator)
        } else {
            (&self.operator, &self.robot)
        };
        for (what, way) in [("sent", sent), ("received", received)] {
            let help =
                format!("Messages {what}, by kind: those of the protocol, by stream and datagram.");
            let name = format!("messages_{what}_total");
            let each = way.iter().map(|(kind, passed)| (kind, passed.messages));
            page.each((&name, "counter"), &help, "kind", each);
            let help =
                format!("Bytes of the messages {what}, by kind; QUIC's own are not among them.");
            let name = format!("message_bytes_{what}_total");
            let each = way.iter().map(|(kind, passed)| (kind, passed.bytes));
            page.each((&name, "counter"), &help, "kind", each);
        }
        page.counter(
            "models_stored_total",
            "Skill models that travelled, and that the robot took.",
            self.models_stored(),
        );
        page.each(
            ("requests_refused_total", "counter"),
            "Requests to engage, reset or take something that the robot declined, by reason.",
            "reason",
            self.refused.iter(),
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stop_is_the_end_of_following_or_the_emergency_stop() {
        use RobotState::{Coasting, Engaged, Holding, Idle, Ready, Stopped};
        let stops =
            |before, now| is_stop(Some((before, Cause::Requested)), (now, Cause::Requested));
        for (before, now) in [
            (Engaged, Ready),
            (Engaged, Holding),
            (Coasting, Holding),
            (Engaged, Stopped),
            (Idle, Stopped),
        ] {
            assert!(stops(before, now), "{before:?} {now:?}");
        }
        for (before, now) in [
            (Engaged, Coasting),
            (Coasting, Engaged),
            (Ready, Engaged),
            (Holding, Ready),
            (Stopped, Stopped),
            (Stopped, Ready),
        ] {
            assert!(!stops(before, now), "{before:?} {now:?}");
        }
        assert!(!is_stop(None, (Idle, Cause::Requested)));
        let [local, arm] = [Cause::LocalStop, Cause::ArmFault].map(|cause| (Stopped, cause));
        assert!(is_stop(Some(local), arm), "one that takes over");
    }

    #[test]
    fn sums_keep_every_kind_and_say_those_that_never_came() {
        let mut one = Tally::default();
        one.operator_control(Some(&OperatorControl::Goodbye), 1);
        one.robot_control(
            Some(&RobotControl::Refused {
                reason: Refusal::Moving,
            }),
            2,
        );
        one.operator_datagram(None, 9);
        let both = one.clone().plus(&one);
        let mut page = Page::new("x_");
        both.show(&mut page, true);
        let text = page.text();
        for line in [
            "x_messages_received_total{kind=\"goodbye\"} 2",
            "x_message_bytes_received_total{kind=\"malformed\"} 18",
            "x_messages_received_total{kind=\"motion\"} 0",
            "x_message_bytes_sent_total{kind=\"refused\"} 4",
            "x_requests_refused_total{reason=\"moving\"} 2",
        ] {
            assert!(text.lines().any(|l| l == line), "{line} in {text}");
        }
    }
}
