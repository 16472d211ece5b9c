//! Viewers that are connected: what a recording says, as it is said, over Foxglove's WebSocket protocol. docs/recordings.md.
//!
//! Built with the feature `live` only; without it nothing is served, and whoever asks is told how to build it.

#[cfg(not(feature = "live"))]
mod absent;
#[cfg(feature = "live")]
mod front;
#[cfg(feature = "live")]
mod server;

use std::net::SocketAddr;

#[cfg(not(feature = "live"))]
pub(super) use absent::Live;
#[cfg(feature = "live")]
pub(super) use server::Live;

/// Why viewers cannot connect.
#[derive(Debug, thiserror::Error)]
pub enum LiveError {
    /// The program is built without.
    #[error(
        "--foxglove: this program is built without it; `cargo build --release --features live` builds it with it, and \
         --record NAME.mcap shows viewers the same afterwards"
    )]
    Absent,
    /// The address is not to be had.
    #[error("--foxglove {addr}: {source}; give another address, or end what listens there")]
    Bind {
        /// It.
        addr: SocketAddr,
        /// What the system said.
        source: std::io::Error,
    },
    /// The system gives no thread, or nothing to wait with.
    #[error("--foxglove: nothing to serve viewers with: {0}")]
    System(#[from] std::io::Error),
    /// The server does not begin.
    #[cfg(feature = "live")]
    #[error("--foxglove: {0}")]
    Server(#[from] foxglove::FoxgloveError),
}

/// Whether viewers can be served, as far as the build goes.
///
/// # Errors
/// [`LiveError::Absent`].
pub fn is_built() -> Result<(), LiveError> {
    if cfg!(feature = "live") {
        Ok(())
    } else {
        Err(LiveError::Absent)
    }
}
