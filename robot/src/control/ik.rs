//! Differential inverse kinematics: from the tip's reference to the joints'.

use std::sync::Arc;

use nalgebra::{Matrix3, Rotation3, SMatrix, SymmetricEigen, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use telemime_sim::arm::{ArmModel, Jacobian, Joints, Kinematics, MAX_JOINTS};

use super::barrier::Barrier;
use super::filter::limited;
use super::turn::{TurnState, rotation_between};

/// How many times a step is resolved again without the joints that are at the end of their range.
const MAX_DROPPED: usize = 3;

/// What the tip may accelerate by beyond the filter's limit, as a share of it: without it a lag that arises under full acceleration would stay.
const RESERVE: f64 = 0.04;

/// Below this the freedom to turn about an axis without moving the tip counts as near-singular, rad/rad.
const TURN_SINGULAR_BELOW: f64 = 0.2;

type Rows = SMatrix<f64, 3, MAX_JOINTS>;

/// Gains of the inverse kinematics.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct IkConfig {
    /// How fast a small position error of the joint reference is closed, 1/s; a larger one as a 25th of `a_max` can brake.
    pub position_gain: f64,
    /// Largest speed of the reference's tip, m/s.
    pub v_max: f64,
    /// Largest acceleration of the reference's tip, m/s², but for a 25th that is kept to close position errors.
    pub a_max: f64,
    /// Largest angular speed of the reference's tip while an orientation is followed, rad/s.
    pub turn_v_max: f64,
    /// Largest angular acceleration likewise, rad/s², but for a 25th that is kept to close errors.
    pub turn_a_max: f64,
    /// How fast an orientation error is closed where the arm has joints to spare for it, 1/s.
    pub orientation_gain: f64,
    /// How fast the remaining freedom returns to the rest posture, 1/s.
    pub posture_gain: f64,
    /// Tick, s.
    pub dt_s: f64,
}

/// Joint positions, velocities and accelerations that the torque control follows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct JointReference {
    /// Position, rad or m.
    pub q: Joints,
    /// Velocity, rad/s or m/s.
    pub qd: Joints,
    /// Acceleration until the next tick, rad/s² or m/s².
    pub qdd: Joints,
}

/// All of a [`DifferentialIk`] that a later step depends on.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub(super) struct IkState {
    orientation: Matrix3<f64>,
    secondary_share: f64,
    reference: JointReference,
    turn_share: f64,
    tip_velocity: Vector3<f64>,
    angular_velocity: Vector3<f64>,
    /// A posture, and the room that the barrier found there.
    barrier: (Joints, f64),
}

/// What a step ran into; bit `i` stands for joint `i`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct JointStep {
    /// The step was slowed along its path to keep the joints or the tip within their limits of speed and acceleration.
    pub slowed: bool,
    /// The motions that do not move the tip were slowed likewise while an orientation was followed.
    pub turn_slowed: bool,
    /// The tip is near a singular posture: motion is damped.
    pub singular: bool,
    /// The step was slowed, or led aside, to keep the links apart.
    pub near_itself: bool,
    /// The same to keep what a plane guards inside.
    pub near_plane: bool,
    /// Joints held back by their end of range.
    pub at_limit: u16,
    /// Where the reference is to be, less where it is, m.
    pub error_m: Vector3<f64>,
    /// Velocity of the reference's tip when the step ends, m/s.
    pub tip_velocity: Vector3<f64>,
    /// The rotation that takes the reference's orientation to where it is to be, base axes, rad.
    pub turn_error_rad: Vector3<f64>,
    /// Angular velocity of the reference's tip when the step ends, rad/s.
    pub angular_velocity: Vector3<f64>,
}

/// Velocity resolution by task priority: position first, orientation in its null space, posture in both.
pub(super) struct Resolved {
    pub(super) primary: Joints,
    pub(super) secondary: Joints,
    /// What of `secondary` is the posture's, the rest being the orientation's.
    pub(super) idle: Joints,
    /// Smallest singular value of the position Jacobian, m/rad.
    pub(super) sigma_min: f64,
}

/// Damped least squares: q̇ = Jᵀ(JJᵀ + λ²1)⁻¹v with λ² = (ε/2)²(1 − (σ/ε)²) where the smallest singular value σ is below ε
/// (Nakamura & Hanafusa 1986 with the damping of Chiaverini 1997), the second task in the first one's null space
/// (Nakamura 1987, eq. 4.12).
pub(super) fn resolve(
    jacobian: &Jacobian,
    tip_velocity: &Vector3<f64>,
    angular_velocity: &Vector3<f64>,
    posture_velocity: &Joints,
    epsilon: f64,
) -> Resolved {
    // 0.2 rad/rad: an arm of five axes never has a free rotation about every axis, and what it lacks must not be bought dearly.
    let calm = |gram: &Matrix3<f64>| damped_inverse(gram, 0.2 * 0.2);
    resolve_by(
        jacobian,
        tip_velocity,
        angular_velocity,
        posture_velocity,
        epsilon,
        calm,
    )
}

/// As [`resolve`], with the orientation followed as exactly as the arm's freedom allows.
fn resolve_turning(
    jacobian: &Jacobian,
    tip_velocity: &Vector3<f64>,
    angular_velocity: &Vector3<f64>,
    posture_velocity: &Joints,
    epsilon: f64,
) -> Resolved {
    resolve_by(
        jacobian,
        tip_velocity,
        angular_velocity,
        posture_velocity,
        epsilon,
        selective_inverse,
    )
}

fn resolve_by(
    jacobian: &Jacobian,
    tip_velocity: &Vector3<f64>,
    angular_velocity: &Vector3<f64>,
    posture_velocity: &Joints,
    epsilon: f64,
    invert_freed: impl Fn(&Matrix3<f64>) -> Matrix3<f64>,
) -> Resolved {
    let linear: Rows = jacobian.fixed_rows::<3>(0).into();
    let angular: Rows = jacobian.fixed_rows::<3>(3).into();
    let gram = linear * linear.transpose();
    let sigma_min = min_eigenvalue(&gram).max(0.0).sqrt();
    let damping = if sigma_min < epsilon {
        0.25 * (epsilon * epsilon - sigma_min * sigma_min)
    } else {
        0.0
    };
    let inverse = damped_inverse(&gram, damping);
    let primary = linear.transpose() * (inverse * tip_velocity);
    let freed = angular - (angular * linear.transpose()) * inverse * linear;
    let inverse_freed = invert_freed(&(freed * freed.transpose()));
    let left_over = angular_velocity - angular * primary;
    let idle = posture_velocity - linear.transpose() * (inverse * (linear * posture_velocity));
    let secondary = idle + freed.transpose() * (inverse_freed * (left_over - freed * idle));
    Resolved {
        primary,
        secondary,
        idle: idle - freed.transpose() * (inverse_freed * (freed * idle)),
        sigma_min,
    }
}

fn damped_inverse(gram: &Matrix3<f64>, damping: f64) -> Matrix3<f64> {
    (gram + Matrix3::from_diagonal_element(damping))
        .try_inverse()
        .unwrap_or_else(Matrix3::zeros)
}

/// The inverse of `gram` axis by axis, damped only about those that the arm can hardly turn about (Maciejewski & Klein 1988): an arm of five axes
/// lacks one, and follows the others no worse for it.
fn selective_inverse(gram: &Matrix3<f64>) -> Matrix3<f64> {
    let Some(eigen) = SymmetricEigen::try_new(*gram, f64::EPSILON, 60) else {
        return damped_inverse(gram, TURN_SINGULAR_BELOW * TURN_SINGULAR_BELOW);
    };
    let most = TURN_SINGULAR_BELOW * TURN_SINGULAR_BELOW;
    let inverse = eigen.eigenvalues.map(|square| {
        let square = square.max(0.0);
        1.0 / (square + 0.25 * (most - square).max(0.0))
    });
    eigen.eigenvectors * Matrix3::from_diagonal(&inverse) * eigen.eigenvectors.transpose()
}

/// The joint speeds (columns) that turn the tip about each base axis at 1 rad/s without moving it, as far as the arm can.
pub(super) fn turning_rates(jacobian: &Jacobian) -> SMatrix<f64, MAX_JOINTS, 3> {
    let (zero, none) = (Vector3::zeros(), Joints::zeros());
    let column = |axis: Vector3<f64>| resolve_turning(jacobian, &zero, &axis, &none, 0.0).secondary;
    SMatrix::from_columns(&[
        column(Vector3::x()),
        column(Vector3::y()),
        column(Vector3::z()),
    ])
}

/// The rotation `axes` (columns: tip axes in base axes) as a quaternion.
pub(super) fn quaternion(axes: &Matrix3<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(*axes))
}

/// Smallest eigenvalue of a symmetric matrix (Smith 1961).
pub(super) fn min_eigenvalue(m: &Matrix3<f64>) -> f64 {
    let mean = m.trace() / 3.0;
    let off = m - Matrix3::from_diagonal_element(mean);
    let spread = (off.norm_squared() / 6.0).sqrt();
    if spread <= f64::EPSILON * mean.abs() {
        return mean;
    }
    let r = ((off / spread).determinant() / 2.0).clamp(-1.0, 1.0);
    mean + 2.0 * spread * (r.acos() / 3.0 + 2.0 * core::f64::consts::FRAC_PI_3).cos()
}

/// The rotation that takes `from` to `to`, as an axis times an angle in the base frame, rad.
pub(super) fn orientation_error(from: &Matrix3<f64>, to: &Matrix3<f64>) -> Vector3<f64> {
    UnitQuaternion::from_matrix_eps(
        &(to * from.transpose()),
        1e-12,
        50,
        UnitQuaternion::identity(),
    )
    .scaled_axis()
}

/// The smallest singular value below which a posture counts as near-singular, for an arm of this length.
pub(super) fn singular_below(arm: &ArmModel) -> f64 {
    0.08 * arm.chain_length_m()
}

/// The joints' reference, led by the tip's.
#[derive(Clone, Debug)]
pub(super) struct DifferentialIk {
    arm: Arc<ArmModel>,
    config: IkConfig,
    /// Largest joint accelerations, rad/s² or m/s², finite.
    accelerations: Joints,
    rest: Joints,
    orientation: Matrix3<f64>,
    /// Share of the secondary tasks, faded so that stopping and starting them is no jolt.
    secondary_share: f64,
    reference: JointReference,
    /// Share of an orientation that is followed: whole at once, since its filter begins at rest, and faded when all stops.
    turn_share: f64,
    /// Of the reference's tip, m/s.
    tip_velocity: Vector3<f64>,
    /// The same, rad/s.
    angular_velocity: Vector3<f64>,
    kinematics: Kinematics,
    barrier: Barrier,
}

impl DifferentialIk {
    /// At rest at `q`, which is also the posture to return to.
    pub(super) fn new(
        arm: Arc<ArmModel>,
        config: IkConfig,
        accelerations: Joints,
        barrier: Barrier,
        q: &Joints,
    ) -> Self {
        let mut ik = Self {
            arm,
            config,
            accelerations,
            rest: *q,
            orientation: Matrix3::identity(),
            secondary_share: 0.0,
            turn_share: 0.0,
            reference: JointReference {
                q: *q,
                qd: Joints::zeros(),
                qdd: Joints::zeros(),
            },
            tip_velocity: Vector3::zeros(),
            angular_velocity: Vector3::zeros(),
            kinematics: Kinematics::new(),
            barrier,
        };
        ik.reset(q);
        ik
    }

    /// Rest at `q`; the tip's orientation there is the one to keep. Returns where the tip is, m.
    pub(super) fn reset(&mut self, q: &Joints) -> Vector3<f64> {
        self.reference = JointReference {
            q: *q,
            qd: Joints::zeros(),
            qdd: Joints::zeros(),
        };
        self.secondary_share = 0.0;
        self.turn_share = 0.0;
        self.tip_velocity = Vector3::zeros();
        self.angular_velocity = Vector3::zeros();
        self.kinematics.update(&self.arm, q);
        self.orientation = *self.kinematics.tip_rotation();
        self.kinematics.tip()
    }

    pub(super) fn save(&self) -> IkState {
        IkState {
            orientation: self.orientation,
            secondary_share: self.secondary_share,
            reference: self.reference,
            turn_share: self.turn_share,
            tip_velocity: self.tip_velocity,
            angular_velocity: self.angular_velocity,
            barrier: *self.barrier.known(),
        }
    }

    pub(super) fn restore(&mut self, state: &IkState) {
        let IkState {
            orientation,
            secondary_share,
            reference,
            turn_share,
            tip_velocity,
            angular_velocity,
            barrier,
        } = *state;
        self.orientation = orientation;
        self.secondary_share = secondary_share;
        self.reference = reference;
        self.turn_share = turn_share;
        self.tip_velocity = tip_velocity;
        self.angular_velocity = angular_velocity;
        self.barrier.restore(barrier);
    }

    /// The nearest place that no plane excludes, and whether that is another one.
    pub(super) fn clip(&self, target: Vector3<f64>) -> (Vector3<f64>, bool) {
        self.barrier.clip(target)
    }

    pub(super) fn reference(&self) -> &JointReference {
        &self.reference
    }

    /// The orientation at the last reset.
    pub(super) fn orientation(&self) -> UnitQuaternion<f64> {
        quaternion(&self.orientation)
    }

    /// One tick: the reference moves so that the tip is at `p` with velocity `v` when the tick ends, and as far as that leaves it free, oriented and
    /// turning as `turn` says; without it, towards the orientation at the last reset. `secondary` allows the motions that do not move the tip.
    pub(super) fn step(
        &mut self,
        p: &Vector3<f64>,
        v: &Vector3<f64>,
        turn: Option<&TurnState>,
        secondary: bool,
    ) -> JointStep {
        let h = self.config.dt_s;
        let JointReference { q, qd, .. } = self.reference;
        let ahead = q + qd * h;
        self.kinematics.update(&self.arm, &ahead);
        let error_m = p - self.kinematics.tip();
        let at = self.kinematics.tip_rotation();
        let turn_error_rad = match turn {
            None => orientation_error(at, &self.orientation),
            Some(turn) => rotation_between(&quaternion(at), &turn.orientation),
        };
        let mut jacobian = self.kinematics.jacobian();
        let linear: Rows = jacobian.fixed_rows::<3>(0).into();
        let angular: Rows = jacobian.fixed_rows::<3>(3).into();
        let (tip_velocity, held) = self.tip_command(v, &error_m);
        let (angular_velocity, by_priority): (_, fn(&_, &_, &_, &_, f64) -> Resolved) = match turn {
            None => (turn_error_rad * self.config.orientation_gain, resolve),
            Some(turn) => (self.turn_command(turn, &turn_error_rad), resolve_turning),
        };
        let idle = (self.rest - ahead) * self.config.posture_gain;
        let epsilon = singular_below(&self.arm);
        let (lower, upper) = self.speed_window(&ahead);
        let mut resolved = by_priority(&jacobian, &tip_velocity, &angular_velocity, &idle, epsilon);
        let sigma_min = resolved.sigma_min;
        let mut at_limit = 0;
        // A joint at its end does not hold up the others: they take the motion over as far as they can (as in Flacco et al. 2015).
        for _ in 0..MAX_DROPPED {
            let blocked = self.blocked(&resolved.primary, &lower, &upper) & !at_limit;
            if blocked == 0 {
                break;
            }
            at_limit |= blocked;
            for i in (0..self.arm.dof()).filter(|i| blocked >> i & 1 == 1) {
                jacobian.column_mut(i).fill(0.0);
            }
            resolved = by_priority(&jacobian, &tip_velocity, &angular_velocity, &idle, epsilon);
        }
        let towards = if secondary { 1.0 } else { 0.0 };
        let fade = 10.0 * h;
        self.secondary_share += (towards - self.secondary_share).clamp(-fade, fade);
        self.turn_share = (self.turn_share - fade).max(towards);

        let none = Joints::zeros();
        let primary_share = largest_share(&none, &resolved.primary, &lower, &upper);
        let primary = resolved.primary * primary_share;
        // An orientation that is followed comes before the posture; one that is merely kept shares with it.
        let (secondary, last) = match turn {
            None => (resolved.secondary * self.secondary_share, none),
            Some(_) => (
                (resolved.secondary - resolved.idle) * self.turn_share,
                resolved.idle * self.secondary_share,
            ),
        };
        let secondary_fits = largest_share(&primary, &secondary, &lower, &upper);
        let mut wanted = primary + secondary * secondary_fits;
        wanted += last * largest_share(&wanted, &last, &lower, &upper);
        let most = self.accelerations * h;
        let change = wanted - qd;
        // What moves the tip comes first: turning about it must not take the joint acceleration that braking needs.
        let moved = jacobian.fixed_rows::<3>(0) * qd;
        let still = Vector3::zeros();
        let asked = tip_velocity * primary_share - moved;
        let first = resolve(&jacobian, &asked, &still, &none, epsilon).primary;
        let coasting = linear * qd - self.tip_velocity;
        let most_tip = (1.0 + RESERVE) * self.config.a_max * h * (1.0 + 1e-9);
        let change_share = largest_share(&none, &first, &-most, &most).min(share_within(
            &coasting,
            &(linear * first),
            most_tip,
        ));
        let first = first * change_share;
        let rest = change - first;
        let mut rest_share = largest_share(&first, &rest, &-most, &most).min(share_within(
            &(coasting + linear * first),
            &(linear * rest),
            most_tip,
        ));
        if turn.is_some() {
            let coasting = angular * (qd + first) - self.angular_velocity;
            let most_turn = (1.0 + RESERVE) * self.config.turn_a_max * h * (1.0 + 1e-9);
            // Where the tip's way alone turns it harder, the rest must be free to brake.
            if coasting.norm() < most_turn {
                let share = share_within(&coasting, &(angular * rest), most_turn);
                rest_share = rest_share.min(share);
            }
        }
        let mut next = qd + first + rest * rest_share;
        for i in 0..self.arm.dof() {
            // Slowing all joints alike for one joint's acceleration must not keep another from braking before its stop.
            next[i] = next[i].clamp(lower[i].max(-f64::MAX), upper[i].min(f64::MAX));
            next[i] = next[i].clamp(qd[i] - most[i], qd[i] + most[i]);
        }
        let (next_apart, hindered) = self.barrier.guard((&q, &qd), next, (&lower, &upper), &most);
        next = next_apart;
        let mut q_next = q + (qd + next) * (0.5 * h);
        for (i, joint) in self.arm.joints().iter().enumerate() {
            let inside = q_next[i].clamp(joint.lower, joint.upper);
            if inside != q_next[i] {
                q_next[i] = inside;
                next[i] = 0.0;
                at_limit |= 1 << i;
            }
        }
        self.tip_velocity = linear * next;
        self.angular_velocity = angular * next;
        self.reference = JointReference {
            q: q_next,
            qd: next,
            qdd: (next - qd) / h,
        };
        JointStep {
            slowed: held || primary_share < 1.0 || change_share < 1.0,
            singular: sigma_min < epsilon,
            near_itself: hindered.by_itself,
            near_plane: hindered.by_plane,
            at_limit,
            error_m,
            tip_velocity: self.tip_velocity,
            turn_slowed: turn.is_some() && (secondary_fits < 1.0 || rest_share < 1.0),
            turn_error_rad,
            angular_velocity: self.angular_velocity,
        }
    }

    /// The tip's next velocity: the filter's and what closes the position error, within the tip's own limits. Also whether those changed it.
    fn tip_command(&self, v: &Vector3<f64>, error_m: &Vector3<f64>) -> (Vector3<f64>, bool) {
        let IkConfig {
            position_gain,
            v_max,
            a_max,
            dt_s,
            ..
        } = self.config;
        // Faster than this it could not be braked on top of a filter that brakes as hard as it may.
        let closing = (2.0 * RESERVE * a_max * error_m.norm()).sqrt();
        let (correction, _) = limited(error_m * position_gain, closing);
        let (wanted, fast) = limited(v + correction, v_max);
        let most = (1.0 + RESERVE) * a_max * dt_s;
        let (change, hard) = limited(wanted - self.tip_velocity, most);
        (self.tip_velocity + change, fast || hard)
    }

    /// The tip's next angular velocity: the filter's and what closes the orientation error, within the limit of speed.
    fn turn_command(&self, turn: &TurnState, error_rad: &Vector3<f64>) -> Vector3<f64> {
        let IkConfig {
            orientation_gain,
            turn_v_max,
            turn_a_max,
            ..
        } = self.config;
        let closing = (2.0 * RESERVE * turn_a_max * error_rad.norm()).sqrt();
        let (correction, _) = limited(error_rad * orientation_gain, closing);
        limited(turn.angular_velocity + correction, turn_v_max).0
    }

    /// Joints (bits) that `motion` would press against the end of their range.
    fn blocked(&self, motion: &Joints, lower: &Joints, upper: &Joints) -> u16 {
        let mut blocked = 0;
        for (i, joint) in self.arm.joints().iter().enumerate() {
            let left = if motion[i] > 0.0 { upper[i] } else { -lower[i] };
            let slow = 0.1 * joint.velocity.min(3.0);
            blocked |= u16::from(left < slow && motion[i].abs() > left) << i;
        }
        blocked
    }

    /// Joint speeds that respect the speed limit and leave room to brake, at half the acceleration limit, before the end of range.
    fn speed_window(&self, q: &Joints) -> (Joints, Joints) {
        let (mut lower, mut upper) = (Joints::zeros(), Joints::zeros());
        for (i, joint) in self.arm.joints().iter().enumerate() {
            let brake = |room: f64| {
                let room = (room - 1e-3).max(0.0);
                joint.velocity.min((self.accelerations[i] * room).sqrt())
            };
            upper[i] = brake(joint.upper - q[i]);
            lower[i] = -brake(q[i] - joint.lower);
        }
        (lower, upper)
    }
}

/// The largest share in [0, 1] of `addend` that keeps `base + share·addend` within the bounds; `base` is within them.
pub(super) fn largest_share(base: &Joints, addend: &Joints, lower: &Joints, upper: &Joints) -> f64 {
    let mut share = 1.0_f64;
    for i in 0..MAX_JOINTS {
        let bound = if addend[i] > 0.0 { upper[i] } else { lower[i] };
        if addend[i] != 0.0 {
            share = share.min(((bound - base[i]) / addend[i]).max(0.0));
        }
    }
    share
}

/// The largest share in [0, 1] of `addend` that keeps |`base` + share·`addend`| within `radius`; 0 if there is none.
fn share_within(base: &Vector3<f64>, addend: &Vector3<f64>, radius: f64) -> f64 {
    let (a, b) = (addend.norm_squared(), base.dot(addend));
    let c = base.norm_squared() - radius * radius;
    if a + 2.0 * b + c <= 0.0 {
        return 1.0;
    }
    // a > 0 here unless `base` itself is outside.
    let root = (b * b - a * c).max(0.0).sqrt();
    if a > 0.0 {
        ((root - b) / a).clamp(0.0, 1.0)
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::SymmetricEigen;
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn smallest_eigenvalue_is_nalgebras(x in prop::array::uniform9(-2.0..2.0_f64)) {
            let a = Matrix3::from_row_slice(&x);
            let m = a * a.transpose();
            let theirs = SymmetricEigen::new(m).eigenvalues.min();
            prop_assert!((min_eigenvalue(&m) - theirs).abs() < 1e-7 * m.trace().max(1e-3));
        }

        #[test]
        fn share_is_the_largest(base in -1.0..1.0_f64, addend in -9.0..9.0_f64) {
            let one = |x: f64| { let mut j = Joints::zeros(); j[2] = x; j };
            let share = largest_share(&one(base), &one(addend), &one(-1.0), &one(1.0));
            prop_assert!((0.0..=1.0).contains(&share));
            let reached = base + share * addend;
            prop_assert!(reached.abs() <= 1.0 + 1e-12);
            prop_assert!(share == 1.0 || reached.abs() > 1.0 - 1e-9);
        }
    }
}
