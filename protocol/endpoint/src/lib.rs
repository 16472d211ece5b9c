//! What the two daemons' shells share and the protocol must not know: the host's clock, an identity,
//! TLS that trusts pinned keys only, and QUIC set up for teleoperation.

pub mod admin;
pub mod cli;
pub mod clock;
pub mod config;
pub mod control;
pub mod http;
pub mod identity;
pub mod logs;
pub mod meter;
pub mod metrics;
pub mod pacer;
pub mod pairing;
pub mod peers;
pub mod quic;
pub mod reception;
pub mod recording;
pub mod supervisor;
pub mod tally;
pub mod tls;
pub mod trust;

pub use clock::{External, HostClock, Mono};
pub use identity::{Fingerprint, Identity, IdentityError};
pub use meter::Meter;
pub use pacer::Pacer;
pub use trust::{Standing, Trust};
