//! What a servo drives: the simulated arm, or one behind a driver ([`DriverArm`](crate::driver::DriverArm)).

use serde::{Deserialize, Serialize};
use telemime_endpoint::Mono;
use telemime_sim::arm::{Gripper, Joints, Plant, PlantReport};

use crate::control::JointReference;

/// What is known of the arm.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ArmState {
    /// Joint positions, rad or m.
    pub q: Joints,
    /// Joint velocities, rad/s or m/s.
    pub qd: Joints,
    /// How far the gripper is open, 0 closed to 1 open; `None` while nobody knows.
    pub opening: Option<f64>,
}

/// What a tick asks of the arm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Setpoint {
    /// Position, velocity and acceleration of the joints, within their limits.
    pub reference: JointReference,
    /// Torques that close the loop at the measured joints, N·m or N: for an arm that is driven by torque.
    pub tau: Joints,
    /// How far the gripper is to be open, 0 to 1, and beyond that as if it were the end; `None` asks nothing of it.
    pub opening: Option<f64>,
}

/// Why an arm is not to be driven any more. Joints are counted from 0.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, thiserror::Error)]
pub enum ArmFault {
    /// The driver ended, or closed its output.
    #[error("the driver has ended")]
    Ended,
    /// The driver itself reports a fault.
    #[error("the driver reports a fault")]
    Reported,
    /// A line that is no joint state.
    #[error("line {line} of the driver is no joint state")]
    Garbage {
        /// Counted from 1.
        line: u64,
    },
    /// No joint state for too long.
    #[error("the driver has not told the joints' state for {silent_ms} ms")]
    Stalled {
        /// For how long, ms.
        silent_ms: u32,
    },
    /// A joint is where it cannot be.
    #[error("the driver puts joint {joint} at {at:.4}, outside its range")]
    Outside {
        /// The joint.
        joint: u8,
        /// rad or m.
        at: f64,
    },
    /// A joint has moved farther than it can.
    #[error("the driver says that joint {joint} has leapt by {by:.4}")]
    Leapt {
        /// The joint.
        joint: u8,
        /// rad or m.
        by: f64,
    },
    /// A joint is faster than it can be.
    #[error("the driver says that joint {joint} moves at {speed:.3}, beyond its limit")]
    TooFast {
        /// The joint.
        joint: u8,
        /// rad/s or m/s.
        speed: f64,
    },
    /// The setpoints that the driver obeys are too old.
    #[error("the driver is {behind_ms} ms behind its setpoints")]
    Lagging {
        /// By how much, ms.
        behind_ms: u32,
    },
    /// The driver obeys a setpoint that it was never given.
    #[error(
        "the driver says that it obeys setpoint {seq}, and the newest is {newest}: `seq` is that of the setpoint it obeys"
    )]
    Unmade {
        /// Its number.
        seq: u64,
        /// The newest there is.
        newest: u64,
    },
    /// A joint is not where its setpoints are.
    #[error("joint {joint} does not follow: it is {by:.4} from its setpoint")]
    Astray {
        /// The joint.
        joint: u8,
        /// rad or m.
        by: f64,
    },
}

/// An arm that takes setpoints and tells where it is. Nothing here may block, allocate, lock or log: it is called on every tick.
pub trait Manipulator: Send {
    /// What is known of the arm at `now`, and what is wrong with it: once anything is, for ever.
    fn sense(&mut self, now: Mono) -> (ArmState, Option<ArmFault>);

    /// Takes a setpoint, for `dt_s` seconds from `now` on; says what it ran into, and where the arm is known to be then.
    fn act(&mut self, now: Mono, setpoint: &Setpoint, dt_s: f64) -> (PlantReport, ArmState);
}

/// The simulated arm and gripper: obeys at once, and knows its state exactly.
#[derive(Debug, Clone)]
pub struct SimulatedArm {
    plant: Plant,
    gripper: Gripper,
}

impl SimulatedArm {
    /// An arm of `plant` and `gripper`.
    pub fn new(plant: Plant, gripper: Gripper) -> Self {
        Self { plant, gripper }
    }

    fn state(&self) -> ArmState {
        ArmState {
            q: *self.plant.q(),
            qd: *self.plant.qd(),
            opening: Some(self.gripper.opening()),
        }
    }
}

impl Manipulator for SimulatedArm {
    fn sense(&mut self, _now: Mono) -> (ArmState, Option<ArmFault>) {
        (self.state(), None)
    }

    fn act(&mut self, _now: Mono, setpoint: &Setpoint, dt_s: f64) -> (PlantReport, ArmState) {
        let strain = self.plant.step(&setpoint.tau, dt_s);
        if let Some(opening) = setpoint.opening {
            self.gripper.step(opening, dt_s);
        }
        (strain, self.state())
    }
}
