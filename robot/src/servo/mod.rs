//! The servo: everything that happens at the fixed rate, and the thread it happens on.
//!
//! [`Core`] is sans-IO: time comes in as an argument, commands and reports go through wait-free rings.
//! A tick never allocates, locks, logs or waits.

mod brake;
mod core;
mod mapping;
mod stats;
pub mod thread;

pub use self::core::{
    Core, CoreConfig, Engagement, Handle, Lease, Order, RAMP_S, Report, Rings, Source, Ticket,
    Trajectory, ramp, rings,
};
pub use brake::Brake;
pub use mapping::{Mapping, Workspace};
pub use stats::TickStats;
