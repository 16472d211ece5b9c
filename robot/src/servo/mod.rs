//! The servo: everything that happens at the fixed rate, and the thread it happens on.
//!
//! [`Core`] decides and is a pure function of what it is told; [`Station`] puts it before a [`Manipulator`], with wait-free rings for orders and
//! reports. Time comes in as an argument. A tick never allocates, locks, logs or waits.

mod arm;
mod brake;
mod core;
mod mapping;
mod orders;
mod played;
mod realtime;
mod station;
mod stats;
pub mod thread;

pub use self::core::{Core, CoreConfig, CoreState, RAMP_S, ramp};
pub use arm::{ArmFault, ArmState, Manipulator, Setpoint, SimulatedArm};
pub use brake::{Brake, Pulled};
pub use mapping::{Mapping, Workspace};
pub use orders::{
    Bent, Engagement, Handle, Lease, Order, Report, Rings, Source, Ticket, Trajectory, rings,
};
pub use realtime::{Locked, NoPriority, Priority, Realtime};
pub use station::Station;
pub use stats::{Quantiles, TickStats};
