//! The wire: one codec, a frozen greeting, framing, and one set of messages per version.
//! `docs/protocol.md` is the normative text.

pub mod arm;
pub mod bend;
pub mod codec;
pub mod frame;
pub mod hello;
pub mod knots;
pub mod memory;
pub mod pair;
mod params;
pub mod state;
pub mod turn;
pub mod v1;
pub mod v2;
pub mod version;

pub use codec::DecodeError;
pub use version::{Version, Versions};
