//! The simulated arm: torque in, motion out.

use std::sync::Arc;

use super::{ArmModel, Dynamics, Joints};

/// A plant's step is integrated in this many parts: at 1 kHz the semi-implicit rule's half-step offset is then 0.1 ms.
const SUBSTEPS: u32 = 4;

/// Joint speed (rad/s or m/s) below which Coulomb friction fades to zero, so that it can hold without chattering.
const STICTION_SPEED: f64 = 1e-3;

/// Why a plant cannot start.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PlantError {
    /// A start value outside the joint's stops, or not finite.
    #[error("joint `{joint}` cannot start at {value}: its range is [{lower}, {upper}]")]
    StartOutside {
        /// The joint.
        joint: String,
        /// Start value, rad or m.
        value: f64,
        /// Lower stop.
        lower: f64,
        /// Upper stop.
        upper: f64,
    },
}

/// Whether an arm can start at `q` (rad, m).
///
/// # Errors
/// [`PlantError::StartOutside`] names the first joint whose value is not within its stops, or not finite.
pub fn check_start(arm: &ArmModel, q: &Joints) -> Result<(), PlantError> {
    for (joint, &value) in arm.joints().iter().zip(q.iter()) {
        if !(value.is_finite() && value >= joint.lower && value <= joint.upper) {
            return Err(PlantError::StartOutside {
                joint: joint.name.clone(),
                value,
                lower: joint.lower,
                upper: joint.upper,
            });
        }
    }
    Ok(())
}

/// What a step ran into: bit `i` stands for joint `i`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PlantReport {
    /// Torque was cut to the effort limit.
    pub clamped: u16,
    /// The joint was stopped by its end of range.
    pub stopped: u16,
    /// Torque was not finite and taken as zero.
    pub invalid: u16,
}

/// A simulated arm: rigid bodies with viscous and Coulomb joint friction, effort limits and hard stops.
///
/// Semi-implicit Euler with friction implicit, so that it is stable however large friction is against inertia:
/// (M + h·D) q̈ = τ − c − D q̇,  q̇ ← q̇ + h q̈,  q ← q + h q̇, with D = damping + friction ⁄ |q̇|.
/// A stop is inelastic and acts on its own joint alone.
#[derive(Clone, Debug)]
pub struct Plant {
    arm: Arc<ArmModel>,
    dynamics: Dynamics,
    q: Joints,
    qd: Joints,
}

impl Plant {
    /// An arm at rest at `q` (rad, m).
    ///
    /// # Errors
    /// [`PlantError::StartOutside`] names the first joint whose value is not within its stops.
    pub fn new(arm: Arc<ArmModel>, q: &Joints) -> Result<Self, PlantError> {
        check_start(&arm, q)?;
        let mut start = Joints::zeros();
        start.as_mut_slice()[..arm.dof()].copy_from_slice(&q.as_slice()[..arm.dof()]);
        Ok(Self {
            arm,
            dynamics: Dynamics::new(),
            q: start,
            qd: Joints::zeros(),
        })
    }

    /// The arm's model.
    pub fn arm(&self) -> &Arc<ArmModel> {
        &self.arm
    }

    /// Joint positions, rad or m.
    pub fn q(&self) -> &Joints {
        &self.q
    }

    /// Joint velocities, rad/s or m/s.
    pub fn qd(&self) -> &Joints {
        &self.qd
    }

    /// Holds the torques `tau` (N·m, N) for `dt_s` seconds. A `dt_s` that is not a positive number moves nothing.
    pub fn step(&mut self, tau: &Joints, dt_s: f64) -> PlantReport {
        let mut report = PlantReport::default();
        if !(dt_s.is_finite() && dt_s > 0.0) {
            return report;
        }
        let mut applied = Joints::zeros();
        for (i, joint) in self.arm.joints().iter().enumerate() {
            if tau[i].is_finite() {
                applied[i] = tau[i].clamp(-joint.effort, joint.effort);
                report.clamped |= u16::from(applied[i] != tau[i]) << i;
            } else {
                report.invalid |= 1 << i;
            }
        }
        let h = dt_s / f64::from(SUBSTEPS);
        for _ in 0..SUBSTEPS {
            report.stopped |= self.substep(&applied, h);
        }
        report
    }

    fn substep(&mut self, tau: &Joints, h: f64) -> u16 {
        let mut resistance = Joints::zeros();
        for (i, joint) in self.arm.joints().iter().enumerate() {
            resistance[i] = joint.damping + joint.friction / self.qd[i].abs().max(STICTION_SPEED);
        }
        self.dynamics.update(&self.arm, &self.q);
        let driving = tau - resistance.component_mul(&self.qd);
        let qdd = self.dynamics.aba(&self.qd, &driving, &(resistance * h));
        let qd = self.qd + qdd * h;
        let q = self.q + qd * h;
        // An unlimited joint under an absurd torque overflows: it is left where it was.
        if !q.iter().all(|v| v.is_finite()) {
            self.qd = Joints::zeros();
            return 0;
        }
        (self.q, self.qd) = (q, qd);
        let mut stopped = 0;
        for (i, joint) in self.arm.joints().iter().enumerate() {
            let inside = self.q[i].clamp(joint.lower, joint.upper);
            if inside != self.q[i] {
                self.q[i] = inside;
                self.qd[i] = 0.0;
                stopped |= 1 << i;
            }
        }
        stopped
    }
}
