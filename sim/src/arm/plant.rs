//! The simulated arm: torque in, motion out.

use std::sync::Arc;

use nalgebra::Vector3;

use super::{ArmModel, ContactPlane, Dynamics, Joint, Joints};

/// A plant's step is integrated in this many parts: at 1 kHz the semi-implicit rule's half-step offset is then 0.1 ms.
const SUBSTEPS: u32 = 4;

/// Joint speed (rad/s or m/s) below which Coulomb friction fades to zero, so that it can hold without chattering.
const STICTION_SPEED: f64 = 1e-3;

/// A drive has its full torque up to the joint's speed limit, and none left to go faster at this much more.
const SPEED_MARGIN: f64 = 0.1;

/// How motion is computed from acceleration.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Integrator {
    /// Semi-implicit Euler with implicit friction: first order, stable however large friction is against inertia.
    #[default]
    SemiImplicit,
    /// The classical Runge-Kutta rule: fourth order, friction explicit. Damping far above the inertia it acts on, which published descriptions
    /// state, needs smaller steps than the other.
    Rk4,
}

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
    /// The joint was faster than its limit, and its drive did not push it on.
    pub fast: u16,
    /// Torque was not finite and taken as zero.
    pub invalid: u16,
}

/// A simulated arm: rigid bodies with viscous and Coulomb joint friction, limits of effort and speed, hard stops, and what the tip touches.
///
/// By default semi-implicit Euler with friction implicit:
/// (M + h·D) q̈ = τ + Jᵀf − c − D q̇,  q̇ ← q̇ + h q̈,  q ← q + h q̇, with D = damping + friction ⁄ |q̇| and f the contact's force at the tip.
/// A stop is inelastic and acts on its own joint alone. Beyond a joint's speed limit its drive's torque in the direction of motion falls to nothing
/// within a tenth: gravity or the other joints may still make it faster.
#[derive(Clone, Debug)]
pub struct Plant {
    arm: Arc<ArmModel>,
    dynamics: Dynamics,
    integrator: Integrator,
    contact: Option<ContactPlane>,
    contact_force: Vector3<f64>,
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
            integrator: Integrator::default(),
            contact: None,
            contact_force: Vector3::zeros(),
            q: start,
            qd: Joints::zeros(),
        })
    }

    /// The same arm, integrated by another rule.
    #[must_use]
    pub fn integrated_by(mut self, integrator: Integrator) -> Self {
        self.integrator = integrator;
        self
    }

    /// The same arm beside a surface that its tip may touch.
    #[must_use]
    pub fn beside(mut self, contact: Option<ContactPlane>) -> Self {
        self.contact = contact;
        self
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

    /// What the surface does to the tip, N in base axes: at the beginning of the last substep.
    pub fn contact_force(&self) -> Vector3<f64> {
        self.contact_force
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
            let (q, qd) = match self.integrator {
                Integrator::SemiImplicit => self.euler(&applied, h),
                Integrator::Rk4 => self.rk4(&applied, h),
            };
            report.stopped |= self.arrive(q, qd);
            for (i, joint) in self.arm.joints().iter().enumerate() {
                let fast = slope(joint, self.qd[i], applied[i]) > 0.0;
                report.fast |= u16::from(fast) << i;
            }
        }
        report
    }

    /// Jᵀf of what the tip touches at the posture of the last update.
    fn touched(&mut self, qd: &Joints) -> Joints {
        let Some(contact) = &self.contact else {
            return Joints::zeros();
        };
        let kinematics = self.dynamics.kinematics();
        let tip = kinematics.tip();
        self.contact_force = Vector3::zeros();
        if contact.height_m(&tip) > 0.0 {
            return Joints::zeros();
        }
        let jacobian = kinematics.jacobian();
        let linear = jacobian.fixed_rows::<3>(0);
        self.contact_force = contact.force(&tip, &(linear * qd));
        linear.tr_mul(&self.contact_force)
    }

    /// What resists motion per unit of speed (viscous and Coulomb friction, and drives beyond their speed limits), and what drives it.
    fn resistance(&self, tau: &Joints, qd: &Joints) -> (Joints, Joints) {
        let (mut resistance, mut driving) = (Joints::zeros(), *tau);
        for (i, joint) in self.arm.joints().iter().enumerate() {
            let slope = slope(joint, qd[i], tau[i]);
            resistance[i] =
                joint.damping + joint.friction / qd[i].abs().max(STICTION_SPEED) + slope;
            if slope > 0.0 {
                driving[i] += slope * joint.velocity.copysign(qd[i]);
            }
        }
        (resistance, driving)
    }

    fn euler(&mut self, tau: &Joints, h: f64) -> (Joints, Joints) {
        self.dynamics.update(&self.arm, &self.q);
        let qd = self.qd;
        let (resistance, driving) = self.resistance(tau, &qd);
        let driving = driving + self.touched(&qd) - resistance.component_mul(&qd);
        let qdd = self.dynamics.aba(&qd, &driving, &(resistance * h));
        let qd = qd + qdd * h;
        (self.q + qd * h, qd)
    }

    fn acceleration(&mut self, tau: &Joints, q: &Joints, qd: &Joints) -> Joints {
        self.dynamics.update(&self.arm, q);
        let (resistance, driving) = self.resistance(tau, qd);
        let driving = driving + self.touched(qd) - resistance.component_mul(qd);
        self.dynamics.aba(qd, &driving, &Joints::zeros())
    }

    fn rk4(&mut self, tau: &Joints, h: f64) -> (Joints, Joints) {
        let (q, v1) = (self.q, self.qd);
        let a1 = self.acceleration(tau, &q, &v1);
        let v2 = v1 + a1 * (h / 2.0);
        let a2 = self.acceleration(tau, &(q + v1 * (h / 2.0)), &v2);
        let v3 = v1 + a2 * (h / 2.0);
        let a3 = self.acceleration(tau, &(q + v2 * (h / 2.0)), &v3);
        let v4 = v1 + a3 * h;
        let a4 = self.acceleration(tau, &(q + v3 * h), &v4);
        (
            q + (v1 + (v2 + v3) * 2.0 + v4) * (h / 6.0),
            v1 + (a1 + (a2 + a3) * 2.0 + a4) * (h / 6.0),
        )
    }

    /// Takes the state over, held by the stops; returns which of them held.
    fn arrive(&mut self, q: Joints, qd: Joints) -> u16 {
        // What overflows (an unlimited joint under an absurd torque, an explicit rule under stiff friction) is left where it was.
        if !q.iter().chain(qd.iter()).all(|v| v.is_finite()) {
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

/// By how much a drive that pushes with `tau` loses torque per unit of speed: nothing until the joint is faster than its limit.
fn slope(joint: &Joint, qd: f64, tau: f64) -> f64 {
    if qd.abs() > joint.velocity && tau * qd > 0.0 {
        tau.abs() / (SPEED_MARGIN * joint.velocity)
    } else {
        0.0
    }
}
