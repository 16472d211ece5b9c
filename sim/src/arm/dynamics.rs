//! Rigid-body dynamics (Featherstone 2008): inverse (RNEA), forward (ABA), the inertia matrix (CRBA), energy.

use nalgebra::{Matrix6, Vector3, Vector6};

use super::kinematics::{cross_force, cross_motion, spatial};
use super::{ArmModel, GRAVITY, Joints, Kinematics, MAX_JOINTS, MassMatrix};

/// A joint that moves less than this, kg·m² (kg), has no acceleration of its own.
const LEAST_PIVOT: f64 = 1e-12;

/// Workspace for dynamics at one posture.
///
/// Call [`update`](Self::update) with the joint values first; every other method then refers to that posture.
#[derive(Clone, Debug)]
pub struct Dynamics {
    kinematics: Kinematics,
    inertias: [Matrix6<f64>; MAX_JOINTS],
    articulated: [Matrix6<f64>; MAX_JOINTS],
    forces: [Vector6<f64>; MAX_JOINTS],
    biases: [Vector6<f64>; MAX_JOINTS],
}

impl Default for Dynamics {
    fn default() -> Self {
        Self::new()
    }
}

impl Dynamics {
    /// An empty workspace.
    pub fn new() -> Self {
        Self {
            kinematics: Kinematics::new(),
            inertias: [Matrix6::zeros(); MAX_JOINTS],
            articulated: [Matrix6::zeros(); MAX_JOINTS],
            forces: [Vector6::zeros(); MAX_JOINTS],
            biases: [Vector6::zeros(); MAX_JOINTS],
        }
    }

    /// Places every frame and inertia for the joint values `q` (rad, m).
    pub fn update(&mut self, arm: &ArmModel, q: &Joints) {
        self.kinematics.update(arm, q);
        for (i, joint) in arm.joints.iter().enumerate() {
            let k = &self.kinematics;
            self.inertias[i] = joint.body.spatial(&k.rotations[i], &k.origins[i]);
        }
    }

    /// The kinematics at the posture of the last update.
    pub fn kinematics(&self) -> &Kinematics {
        &self.kinematics
    }

    /// Joint torques (N·m, N) for velocity `qd` and acceleration `qdd`, gravity included, friction not: recursive
    /// Newton-Euler (Featherstone 2008, table 5.1, in base coordinates).
    pub fn rnea(&mut self, qd: &Joints, qdd: &Joints) -> Joints {
        let n = self.kinematics.dof;
        let mut v = Vector6::zeros();
        let mut a = spatial(Vector3::zeros(), -GRAVITY);
        for i in 0..n {
            let axis = &self.kinematics.axes[i];
            let own = axis * qd[i];
            a += cross_motion(&v, &own) + axis * qdd[i];
            v += own;
            self.forces[i] = self.inertias[i] * a + cross_force(&v, &(self.inertias[i] * v));
        }
        let mut tau = Joints::zeros();
        let mut carried = Vector6::zeros();
        for i in (0..n).rev() {
            carried += self.forces[i];
            tau[i] = self.kinematics.axes[i].dot(&carried);
        }
        tau
    }

    /// Joint accelerations (rad/s², m/s²) under the torques `tau` at velocity `qd`: the articulated-body algorithm
    /// (Featherstone 2008, table 7.1, in base coordinates). `added_inertia` ≥ 0 is added to the diagonal of the inertia
    /// matrix: armature, or the step's implicit damping. A joint that moves no inertia at this posture is taken as one that does not accelerate.
    pub fn aba(&mut self, qd: &Joints, tau: &Joints, added_inertia: &Joints) -> Joints {
        let n = self.kinematics.dof;
        let mut v = Vector6::zeros();
        for i in 0..n {
            let own = self.kinematics.axes[i] * qd[i];
            self.biases[i] = cross_motion(&v, &own);
            v += own;
            self.forces[i] = cross_force(&v, &(self.inertias[i] * v));
            self.articulated[i] = self.inertias[i];
        }
        let mut pulls = [Vector6::zeros(); MAX_JOINTS];
        let (mut inverses, mut rest) = (Joints::zeros(), Joints::zeros());
        for i in (0..n).rev() {
            let axis = &self.kinematics.axes[i];
            pulls[i] = self.articulated[i] * axis;
            let pivot = axis.dot(&pulls[i]) + added_inertia[i];
            inverses[i] = if pivot > LEAST_PIVOT {
                1.0 / pivot
            } else {
                0.0
            };
            rest[i] = tau[i] - axis.dot(&self.forces[i]);
            if i > 0 {
                let carried = self.articulated[i] - pulls[i] * (pulls[i] * inverses[i]).transpose();
                let force =
                    self.forces[i] + carried * self.biases[i] + pulls[i] * (rest[i] * inverses[i]);
                self.articulated[i - 1] += carried;
                self.forces[i - 1] += force;
            }
        }
        let mut qdd = Joints::zeros();
        let mut a = spatial(Vector3::zeros(), -GRAVITY);
        for i in 0..n {
            a += self.biases[i];
            qdd[i] = (rest[i] - pulls[i].dot(&a)) * inverses[i];
            a += self.kinematics.axes[i] * qdd[i];
        }
        qdd
    }

    /// The inertia matrix (kg·m², kg·m, kg): composite rigid bodies (Featherstone 2008, table 6.2).
    pub fn mass_matrix(&mut self) -> MassMatrix {
        let n = self.kinematics.dof;
        let mut m = MassMatrix::zeros();
        let mut composite = Matrix6::zeros();
        for i in (0..n).rev() {
            composite += self.inertias[i];
            let force = composite * self.kinematics.axes[i];
            for j in 0..=i {
                m[(i, j)] = self.kinematics.axes[j].dot(&force);
                m[(j, i)] = m[(i, j)];
            }
        }
        m
    }

    /// Kinetic energy at velocity `qd`, J.
    pub fn kinetic_energy_j(&self, qd: &Joints) -> f64 {
        let mut v = Vector6::zeros();
        let mut energy = 0.0;
        for i in 0..self.kinematics.dof {
            v += self.kinematics.axes[i] * qd[i];
            energy += 0.5 * v.dot(&(self.inertias[i] * v));
        }
        energy
    }

    /// Potential energy of the moving bodies, zero at the base's origin, J.
    pub fn potential_energy_j(&self, arm: &ArmModel) -> f64 {
        let k = &self.kinematics;
        let weight = |(i, joint): (usize, &super::Joint)| {
            let com = k.rotations[i] * joint.body.com_m + k.origins[i];
            -joint.body.mass_kg * GRAVITY.dot(&com)
        };
        arm.joints.iter().enumerate().map(weight).sum()
    }

    /// The inertia each joint meets while those beyond it move freely: ABA's pivots.
    pub(super) fn pivots(&mut self, added_inertia: &Joints) -> Joints {
        let mut out = Joints::zeros();
        let mut articulated = Matrix6::zeros();
        for i in (0..self.kinematics.dof).rev() {
            articulated += self.inertias[i];
            let axis = &self.kinematics.axes[i];
            let pull = articulated * axis;
            out[i] = axis.dot(&pull) + added_inertia[i];
            if out[i] > 0.0 {
                articulated -= pull * (pull / out[i]).transpose();
            }
        }
        out
    }
}
