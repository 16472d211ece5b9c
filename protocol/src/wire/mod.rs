//! The wire: one codec, a frozen greeting, framing, and one set of messages per version.
//! `docs/protocol.md` is the normative text.

pub mod bend;
pub mod codec;
pub mod frame;
pub mod hello;
pub mod knots;
mod params;
pub mod state;
pub mod turn;
pub mod v1;

pub use codec::DecodeError;
