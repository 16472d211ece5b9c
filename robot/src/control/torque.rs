//! Computed torque: the arm as a set of decoupled, critically damped joints.

use telemime_sim::arm::{ArmModel, Dynamics, Joints};

use super::JointReference;

/// τ = M(q)(q̈_ref + k_p e + k_d ė) + c(q, q̇) + g(q) + friction(q̇_ref), by recursive Newton-Euler, cut to the effort limits.
#[derive(Clone, Debug)]
pub struct ComputedTorque {
    stiffness: f64,
    damping: f64,
    dynamics: Dynamics,
}

impl ComputedTorque {
    /// Joint errors decay with both poles at −`bandwidth`, rad/s.
    pub fn new(bandwidth: f64) -> Self {
        Self {
            stiffness: bandwidth * bandwidth,
            damping: 2.0 * bandwidth,
            dynamics: Dynamics::new(),
        }
    }

    /// Torques (N·m, N) at the measured `q`, `qd` that lead to `reference`, whose q and qd are for now and whose qdd lasts until the next tick,
    /// and the joints (bits) whose torque was cut.
    pub fn torque(
        &mut self,
        arm: &ArmModel,
        reference: &JointReference,
        q: &Joints,
        qd: &Joints,
    ) -> (Joints, u16) {
        self.dynamics.update(arm, q);
        let qdd =
            reference.qdd + (reference.q - q) * self.stiffness + (reference.qd - qd) * self.damping;
        let wanted = self.dynamics.rnea(qd, &qdd) + arm.friction(&reference.qd);
        let (mut tau, mut cut) = (Joints::zeros(), 0);
        for (i, joint) in arm.joints().iter().enumerate() {
            tau[i] = wanted[i].clamp(-joint.effort, joint.effort);
            cut |= u16::from(tau[i] != wanted[i]) << i;
        }
        (tau, cut)
    }

    /// The dynamics workspace at the last measured posture.
    pub(super) fn dynamics(&self) -> &Dynamics {
        &self.dynamics
    }
}
