//! Computed torque: the arm as a set of decoupled, critically damped joints.

use telemime_sim::arm::{ArmModel, Dynamics, Joints};

use super::JointReference;
use super::ik::largest_share;

/// A joint left behind by a cut torque returns to its reference faster than that by at most this share of its speed limit.
const CATCH_UP: f64 = 0.1;

/// τ = M(q)(q̈_ref + k_p e + k_d ė) + c(q, q̇) + g(q) + friction(q̇_ref), by recursive Newton-Euler. Where a joint's torque would exceed its
/// effort limit, the acceleration of all joints is reduced, so that the arm slows on its path.
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
    /// and the joints (bits) that lack torque for it.
    pub fn torque(
        &mut self,
        arm: &ArmModel,
        reference: &JointReference,
        q: &Joints,
        qd: &Joints,
    ) -> (Joints, u16) {
        self.dynamics.update(arm, q);
        let reach = arm.per_joint(|j| CATCH_UP * j.velocity * self.damping / self.stiffness);
        let error = clamped(&(reference.q - q), &reach);
        let qdd = reference.qdd + error * self.stiffness + (reference.qd - qd) * self.damping;
        let friction = arm.friction(&reference.qd);
        let most = arm.per_joint(|j| j.effort);
        let carried = self.dynamics.rnea(qd, &Joints::zeros()) + friction;
        let wanted = self.dynamics.rnea(qd, &qdd) + friction;
        // Cutting one joint alone would throw the others: all accelerate less.
        let base = clamped(&carried, &most);
        let asked = wanted - carried;
        let tau = base + asked * largest_share(&base, &asked, &-most, &most);
        let mut cut = 0;
        for i in 0..arm.dof() {
            cut |= u16::from(wanted[i].abs() > most[i]) << i;
        }
        (clamped(&tau, &most), cut)
    }

    /// The dynamics workspace at the last measured posture.
    pub(super) fn dynamics(&self) -> &Dynamics {
        &self.dynamics
    }
}

fn clamped(tau: &Joints, most: &Joints) -> Joints {
    tau.zip_map(most, |tau, most| tau.clamp(-most, most))
}
