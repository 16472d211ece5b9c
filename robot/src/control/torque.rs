//! Torques: the arm as a set of critically damped joints, decoupled or as springs.

use telemime_sim::arm::{ArmModel, Dynamics, Joints};

use super::JointReference;
use super::resolve::largest_share;

/// A joint left behind by a cut torque returns to its reference faster than that by at most this share of its speed limit.
const CATCH_UP: f64 = 0.1;

/// What pulls the joints to their reference.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Law {
    /// Computed torque: errors decay as e^(−`bandwidth`·t) and a term of t times that, rad/s, whatever the inertia.
    Computed {
        /// Both poles lie at −bandwidth, rad/s.
        bandwidth: f64,
    },
    /// Joint impedance (Hogan 1985): a spring of each joint's own stiffness, and critical damping for the inertia it moves at its
    /// posture. What pushes the arm moves it by τ/K, up to where the spring would throw it back faster than the joint may go, and from there on
    /// against no more than that; the arm's own motion needs no error, for its dynamics are fed forward.
    Impedance {
        /// N·m/rad, or N/m.
        stiffness: Joints,
    },
}

/// τ = M(q)·(q̈_ref + k_p e + k_d ė) + c(q, q̇) + g(q) + friction(q̇_ref) by recursive Newton-Euler, or with a [`Law::Impedance`]
/// M(q)·q̈_ref + c + g + friction + K e + D ė. Where a joint's torque would exceed its effort limit, all that is beyond carrying the arm is
/// reduced by one share, so that the arm slows on its path.
#[derive(Clone, Debug)]
pub struct TorqueControl {
    law: Law,
    dynamics: Dynamics,
}

impl TorqueControl {
    /// Torques by this law.
    pub fn new(law: Law) -> Self {
        Self {
            law,
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
        let (error, slip) = (reference.q - q, reference.qd - qd);
        let friction = arm.friction(&reference.qd);
        let most = arm.per_joint(|j| j.effort);
        let carried = self.dynamics.rnea(qd, &Joints::zeros()) + friction;
        let wanted = match self.law {
            Law::Computed { bandwidth } => {
                let (stiffness, damping) = (bandwidth * bandwidth, 2.0 * bandwidth);
                let reach = arm.per_joint(|j| CATCH_UP * j.velocity * damping / stiffness);
                let error = clamped(&error, &reach);
                let qdd = reference.qdd + error * stiffness + slip * damping;
                self.dynamics.rnea(qd, &qdd)
            }
            Law::Impedance { stiffness } => {
                let inertia = self.dynamics.mass_matrix().diagonal();
                let damping = stiffness.zip_map(&inertia, |k, m| 2.0 * (k * m.max(0.0)).sqrt());
                let mut reach = Joints::zeros();
                for (i, joint) in arm.joints().iter().enumerate() {
                    let thrown = joint.velocity * damping[i] / stiffness[i];
                    // A joint without a spring is thrown nowhere.
                    reach[i] = if thrown.is_nan() {
                        f64::INFINITY
                    } else {
                        thrown
                    };
                }
                let error = clamped(&error, &reach);
                self.dynamics.rnea(qd, &reference.qdd)
                    + error.component_mul(&stiffness)
                    + slip.component_mul(&damping)
            }
        } + friction;
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
