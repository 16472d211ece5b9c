//! From a demanded tip position, and an orientation if there is one, to joint torques: limited filters, differential inverse kinematics, computed torque.
//!
//! Nothing here allocates after construction: every vector has a fixed size and every workspace is a field. Nothing here
//! reads a clock: a tick is `dt_s` long.

mod barrier;
mod clamps;
mod controller;
mod filter;
mod ik;
mod posture;
mod resolve;
mod torque;
mod turn;

#[cfg(test)]
mod tests;

pub use barrier::{BarrierConfig, BarrierError, CloseAtStart, MAX_PLANES, Plane};
pub use clamps::{ClampCounts, Clamps};
pub use controller::{
    ControlConfig, ControlError, Controller, ControllerState, Demand, ForeignState, Output,
};
pub use filter::{FilterConfig, FilterError, FilterState, LimitedFilter};
pub use ik::{IkConfig, JointReference, JointStep};
pub use posture::{CartesianLimits, home_posture, joint_accelerations, workspace_radius};
pub use torque::{Law, TorqueControl};
pub use turn::{TurnFilter, TurnLimits, TurnState};
