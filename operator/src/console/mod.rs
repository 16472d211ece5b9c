//! The console page: a person watches and drives in a browser.
//!
//! Three parts that know nothing of each other's business: the page itself (`page/`, embedded), a server on a thread of
//! its own ([`server`]), and what the page's person does ([`live`], sans-IO). Between server and daemon there are
//! two channels: commands, bounded, and snapshots, of which only the newest is kept. A page that stalls loses snapshots.

pub mod command;
mod files;
pub mod guard;
pub mod live;
pub mod server;
mod snapshot;
#[cfg(test)]
mod tests;

pub use command::{BadCommand, Command, Holding, Shape};
pub use live::{Act, Known, Live, Port, Said, seat};
pub use server::{ServeError, serve};
pub use snapshot::Snapshot;
