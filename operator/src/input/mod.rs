//! A hand that is tracked while it drives: lines of JSON on standard input or by UDP, depth frames, or a gamepad.
//!
//! `docs/input.md` is the format for people who write a sender. A thread reads and decodes ([`read`]); the [`Driver`] holds
//! the clutch and feeds the session, sans-IO. What is wrong is dropped and counted ([`Tally`]); a source that falls silent is a
//! clutch that was let go.

#[cfg(feature = "gamepad")]
pub mod device;
mod driver;
pub mod frame;
pub mod read;
mod source;
pub mod stick;
mod tally;
#[cfg(test)]
mod tests;
mod watch;

use telemime_protocol::time::Stamp;

pub use driver::{Driver, Habits};
pub use frame::{Frame, Place, Units};
pub use source::Source;
pub use tally::{Fault, Kind, Tally};

/// Something from the source.
#[derive(Debug, Clone, PartialEq)]
pub struct Arrived {
    /// When, on the session clock.
    pub at: Stamp,
    /// What.
    pub what: What,
}

/// What a source says.
#[derive(Debug, Clone, PartialEq)]
pub enum What {
    /// A frame.
    Frame(Frame),
    /// One that was dropped, and why.
    Dropped(Fault),
    /// There will be no more, and why.
    End(String),
}
