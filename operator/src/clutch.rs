//! A clutch that is pressed: the robot is asked to engage, and again where it declines for a reason that passes.

use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::Refusal;

use crate::session::Session;

/// Pause before a declined request is made again, s, and how often.
const RETRY_S: f64 = 0.05;

const RETRIES: u32 = 40;

/// What is asked of the robot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Phase {
    /// To be asked again then.
    Again(Stamp),
    Asked,
    Following,
    /// Nothing is asked of the robot.
    Apart,
}

/// One press of the clutch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Clutch {
    pub(crate) phase: Phase,
    tries: u32,
}

impl Clutch {
    /// Pressed, and nothing asked yet.
    pub(crate) fn pressed() -> Self {
        Self {
            phase: Phase::Apart,
            tries: 0,
        }
    }

    /// Asks the robot to follow the hand.
    pub(crate) fn ask(&mut self, now: Stamp, session: &mut Session) {
        self.tries += 1;
        // A skill that was just learned is still on its way.
        if !session.is_ready() && self.tries < RETRIES {
            self.phase = Phase::Again(now.offset_by_secs(RETRY_S));
            return;
        }
        self.phase = Phase::Asked;
        session.engage(now);
    }

    /// The robot declined; whether it will be asked again.
    pub(crate) fn declined(&mut self, now: Stamp, reason: Refusal) -> bool {
        let passes = matches!(
            reason,
            Refusal::ClockUnknown | Refusal::Moving | Refusal::StaleReference
        );
        let again = passes && self.tries < RETRIES;
        if again {
            self.phase = Phase::Again(now.offset_by_secs(RETRY_S));
        }
        again
    }

    /// When to ask again.
    pub(crate) fn again(&self) -> Option<Stamp> {
        match self.phase {
            Phase::Again(at) => Some(at),
            Phase::Asked | Phase::Following | Phase::Apart => None,
        }
    }
}
