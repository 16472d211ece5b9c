//! A serial manipulator from its URDF: kinematics, rigid-body dynamics, a plant that integrates them, capsules around its links, and a gripper.
//!
//! Everything on the real-time path works on fixed arrays of [`MAX_JOINTS`] in workspaces that the caller
//! owns ([`Kinematics`], [`Dynamics`]): nothing allocates after [`ArmModel::from_urdf`].
//! The base frame is the URDF's root link; gravity is [`GRAVITY`] in it.

mod capsule;
mod contact;
mod dead_time;
mod dynamics;
mod error;
mod gripper;
mod hull;
mod inertia;
mod kinematics;
mod model;
mod payload;
mod plant;
mod tree;
mod urdf;

#[cfg(test)]
mod tests;

use nalgebra::{SMatrix, SVector, Vector3};

pub use capsule::{
    Capsule, CapsuleSource, MAX_CAPSULES, Nearest, Proximity, SelfCollision, Unguarded,
};
pub use contact::{ContactError, ContactPlane, MAX_STIFFNESS_N_M};
pub use dead_time::{DeadTime, DeadTimeError, MAX_DEAD_TIME_S};
pub use dynamics::Dynamics;
pub use error::{ArmError, Notice};
pub use gripper::{Gripper, GripperError};
pub use inertia::Body;
pub use kinematics::Kinematics;
pub use model::{ArmModel, Joint, JointKind, LoadOptions};
pub use payload::{Payload, PayloadError};
pub use plant::{Integrator, Plant, PlantError, PlantReport, check_start};

/// The largest number of moving joints between base and tip.
pub const MAX_JOINTS: usize = 10;

/// Gravity in the base frame, m/s².
pub const GRAVITY: Vector3<f64> = Vector3::new(0.0, 0.0, -9.81);

/// One number per joint (rad, rad/s, N·m, … or m, m/s, N for a prismatic joint); entries past the arm's
/// degrees of freedom are zero.
pub type Joints = SVector<f64, MAX_JOINTS>;

/// Geometric Jacobian at the tip's origin in base axes: rows vx vy vz wx wy wz, one column per joint, columns past
/// the arm's degrees of freedom zero.
pub type Jacobian = SMatrix<f64, 6, MAX_JOINTS>;

/// The joint-space inertia matrix; rows and columns past the arm's degrees of freedom are zero.
pub type MassMatrix = SMatrix<f64, MAX_JOINTS, MAX_JOINTS>;

/// The URDF of `mime7`, the default arm: seven axes, 0.85 m reach, 18 kg, limits like those of a published
/// collaborative arm, tip link `tcp`.
pub fn default_urdf() -> &'static str {
    include_str!("../../urdf/mime7.urdf")
}
