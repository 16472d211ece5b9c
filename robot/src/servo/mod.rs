//! The servo: everything that happens at the fixed rate, and the thread it happens on.
//!
//! [`Core`] is sans-IO: time comes in as an argument, commands and reports go through wait-free rings.
//! A tick never allocates, locks, logs or waits.

mod brake;
mod core;
mod mapping;
mod orders;
mod stats;
pub mod thread;

pub use self::core::{Core, CoreConfig, RAMP_S, ramp};
pub use brake::Brake;
pub use mapping::{Mapping, Workspace};
pub use orders::{
    Bent, Engagement, Handle, Lease, Order, Report, Rings, Source, Ticket, Trajectory, rings,
};
pub use stats::TickStats;
