//! The black box: all that the servo was told and decided in the last minutes, and the same again from a file.
//!
//! A [`Tap`] on the tick copies its inputs and outcome into rings; a [`Recorder`] elsewhere keeps them, a second to a chunk that begins with the
//! core's whole state, and lets go of the oldest. [`mod@file`] writes them; [`mod@replay`] runs the same core on them again.

pub mod file;
mod ration;
mod recorder;
pub mod replay;
mod tap;
mod thread;
mod ticks;

#[cfg(test)]
mod tests;

pub use self::replay::{Difference, Moment, Replay, ReplayError, Row, replay};
pub use file::{BlackBox, Draft, Header, ReadError, WriteError};
pub use recorder::{Due, Feed, Recorder};
pub use tap::{Tap, Ticked, taps};
pub use thread::{Asker, Keeper, News, Saved};

/// What is kept, s: two minutes.
pub const SPAN_S: f64 = 120.0;
