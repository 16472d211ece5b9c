//! Stops that need no queue: set from any thread, seen by the next tick, whatever else waits.

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};

use telemime_protocol::wire::v1::Cause;

const LOCAL_STOP: u8 = 1;
const OPERATOR_STOP: u8 = 2;
const FAULT: u8 = 4;
const CLOCK_STEP: u8 = 8;
const CONNECTION_LOST: u8 = 16;

/// A brake that any thread may pull and only a tick releases.
#[derive(Debug, Clone, Default)]
pub struct Brake(Arc<AtomicU8>);

/// What has been pulled since the last tick.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Pulled(u8);

impl Brake {
    /// Emergency stop at the robot.
    pub fn stop_here(&self) {
        self.0.fetch_or(LOCAL_STOP, Ordering::SeqCst);
    }

    /// Stops for `cause`: latched for the two emergency stops, a hold for everything else.
    pub fn pull(&self, cause: Cause) {
        let bit = match cause {
            Cause::LocalStop => LOCAL_STOP,
            Cause::OperatorStop => OPERATOR_STOP,
            Cause::ClockStep => CLOCK_STEP,
            Cause::ConnectionLost => CONNECTION_LOST,
            _ => FAULT,
        };
        self.0.fetch_or(bit, Ordering::SeqCst);
    }

    pub(super) fn take(&self) -> Pulled {
        Pulled(self.0.swap(0, Ordering::SeqCst))
    }
}

impl Pulled {
    /// As a number, for a record.
    pub(crate) fn bits(self) -> u8 {
        self.0
    }

    /// From such a number.
    pub(crate) fn from_bits(bits: u8) -> Self {
        Self(bits)
    }

    /// The emergency stop, if one was pulled; the local one counts for more.
    pub fn stop(self) -> Option<Cause> {
        match self.0 {
            bits if bits & LOCAL_STOP != 0 => Some(Cause::LocalStop),
            bits if bits & OPERATOR_STOP != 0 => Some(Cause::OperatorStop),
            _ => None,
        }
    }

    /// The reason to hold, if there is one.
    pub fn hold(self) -> Option<Cause> {
        match self.0 {
            bits if bits & FAULT != 0 => Some(Cause::Fault),
            bits if bits & CLOCK_STEP != 0 => Some(Cause::ClockStep),
            bits if bits & CONNECTION_LOST != 0 => Some(Cause::ConnectionLost),
            _ => None,
        }
    }
}
