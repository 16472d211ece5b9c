//! Differential inverse kinematics: from the tip's reference to the joints'.

use std::sync::Arc;

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use telemime_sim::arm::{ArmModel, Joints, Kinematics};

use super::barrier::Barrier;
use super::filter::limited;
use super::resolve::{
    Resolved, Rows, largest_share, orientation_error, quaternion, resolve, resolve_turning,
    share_within, singular_below,
};
use super::turn::{TurnState, rotation_between};

/// How many times a step is resolved again without the joints that are at the end of their range.
const MAX_DROPPED: usize = 3;

/// What the tip may accelerate by beyond the filter's limit, as a share of it: without it a lag that arises under full acceleration would stay.
const RESERVE: f64 = 0.04;

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

    pub(super) fn barrier(&self) -> &Barrier {
        &self.barrier
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
