//! Where the arm is and how its tip moves.

use nalgebra::{Matrix3, Point3, Vector3, Vector6};

use super::{ArmModel, Jacobian, JointKind, Joints, MAX_JOINTS};

/// Workspace for kinematics at one posture: frames and motion axes, all in the base frame.
///
/// Spatial vectors are (angular, linear) with the linear part taken at the base's origin (Featherstone 2008, §2.2): links
/// then share one frame and need no transforms between them.
#[derive(Clone, Debug)]
pub struct Kinematics {
    pub(super) dof: usize,
    pub(super) rotations: [Matrix3<f64>; MAX_JOINTS],
    pub(super) origins: [Vector3<f64>; MAX_JOINTS],
    pub(super) axes: [Vector6<f64>; MAX_JOINTS],
    tip_rotation: Matrix3<f64>,
    tip: Vector3<f64>,
}

impl Default for Kinematics {
    fn default() -> Self {
        Self::new()
    }
}

impl Kinematics {
    /// An empty workspace.
    pub fn new() -> Self {
        Self {
            dof: 0,
            rotations: [Matrix3::identity(); MAX_JOINTS],
            origins: [Vector3::zeros(); MAX_JOINTS],
            axes: [Vector6::zeros(); MAX_JOINTS],
            tip_rotation: Matrix3::identity(),
            tip: Vector3::zeros(),
        }
    }

    /// Places every frame for the joint values `q` (rad, m).
    pub fn update(&mut self, arm: &ArmModel, q: &Joints) {
        self.dof = arm.dof();
        let mut rotation = Matrix3::identity();
        let mut origin = Vector3::zeros();
        for (i, (joint, [at_zero, sine, versine])) in arm.joints.iter().zip(&arm.turns).enumerate()
        {
            origin += rotation * joint.placement.translation.vector;
            let mut axis = Vector6::zeros();
            match joint.kind {
                JointKind::Revolute => {
                    let (sin, cos) = q[i].sin_cos();
                    rotation *= at_zero + sine * sin + versine * (1.0 - cos);
                    let direction = rotation * joint.axis;
                    axis.fixed_rows_mut::<3>(0).copy_from(&direction);
                    axis.fixed_rows_mut::<3>(3)
                        .copy_from(&origin.cross(&direction));
                }
                JointKind::Prismatic => {
                    rotation *= at_zero;
                    let direction = rotation * joint.axis;
                    origin += direction * q[i];
                    axis.fixed_rows_mut::<3>(3).copy_from(&direction);
                }
            }
            self.rotations[i] = rotation;
            self.origins[i] = origin;
            self.axes[i] = axis;
        }
        self.tip = origin + rotation * arm.tip_offset.translation.vector;
        self.tip_rotation = rotation * arm.tip_offset.rotation.to_rotation_matrix().matrix();
    }

    /// The tip's origin in the base frame, m.
    pub fn tip(&self) -> Vector3<f64> {
        self.tip
    }

    /// The tip's axes in the base frame.
    pub fn tip_rotation(&self) -> &Matrix3<f64> {
        &self.tip_rotation
    }

    /// Origin and axes of joint `i`'s frame in the base frame; `None` past the last joint.
    pub fn joint_frame(&self, i: usize) -> Option<(Point3<f64>, &Matrix3<f64>)> {
        (i < self.dof).then(|| (self.origins[i].into(), &self.rotations[i]))
    }

    /// The geometric Jacobian at the tip's origin.
    pub fn jacobian(&self) -> Jacobian {
        let mut j = Jacobian::zeros();
        for (i, axis) in self.axes[..self.dof].iter().enumerate() {
            let (angular, linear) = halves(axis);
            let at_tip = linear + angular.cross(&self.tip);
            j.fixed_view_mut::<3, 1>(0, i).copy_from(&at_tip);
            j.fixed_view_mut::<3, 1>(3, i).copy_from(&angular);
        }
        j
    }

    /// The time derivative of [`jacobian`](Self::jacobian) at joint velocity `qd`: with it the tip accelerates by J q̈ + J̇ q̇, the columns' linear part
    /// being that of the tip's origin in base axes. Column i is that of the axis, v × sᵢ with v the spatial velocity of the body before it
    /// (Featherstone 2008, eq. 2.30), moved to the tip, which moves itself.
    pub fn jacobian_derivative(&self, qd: &Joints) -> Jacobian {
        let (mut rates, mut velocity) = ([Vector6::zeros(); MAX_JOINTS], Vector6::zeros());
        for (i, axis) in self.axes[..self.dof].iter().enumerate() {
            rates[i] = cross_motion(&velocity, axis);
            velocity += axis * qd[i];
        }
        let (w, v) = halves(&velocity);
        let tip_velocity = v + w.cross(&self.tip);
        let mut j = Jacobian::zeros();
        for (i, rate) in rates[..self.dof].iter().enumerate() {
            let (angular, linear) = halves(rate);
            let (axis, _) = halves(&self.axes[i]);
            let at_tip = linear + angular.cross(&self.tip) + axis.cross(&tip_velocity);
            j.fixed_view_mut::<3, 1>(0, i).copy_from(&at_tip);
            j.fixed_view_mut::<3, 1>(3, i).copy_from(&angular);
        }
        j
    }

    /// The velocity (m/s) of a point at `p` (base axes, m) that moves with joint `i`, per unit speed of joint `j` ≤ `i`.
    pub fn point_rate(&self, j: usize, p: &Vector3<f64>) -> Vector3<f64> {
        let (angular, linear) = halves(&self.axes[j]);
        linear + angular.cross(p)
    }
}

pub(super) fn halves(v: &Vector6<f64>) -> (Vector3<f64>, Vector3<f64>) {
    (v.fixed_rows::<3>(0).into(), v.fixed_rows::<3>(3).into())
}

pub(super) fn spatial(angular: Vector3<f64>, linear: Vector3<f64>) -> Vector6<f64> {
    Vector6::new(
        angular.x, angular.y, angular.z, linear.x, linear.y, linear.z,
    )
}

/// v × m (Featherstone 2008, eq. 2.31).
pub(super) fn cross_motion(v: &Vector6<f64>, m: &Vector6<f64>) -> Vector6<f64> {
    let ((w, v), (mw, mv)) = (halves(v), halves(m));
    spatial(w.cross(&mw), w.cross(&mv) + v.cross(&mw))
}

/// v ×* f (Featherstone 2008, eq. 2.32).
pub(super) fn cross_force(v: &Vector6<f64>, f: &Vector6<f64>) -> Vector6<f64> {
    let ((w, v), (n, f)) = (halves(v), halves(f));
    spatial(w.cross(&n) + v.cross(&f), w.cross(&f))
}
