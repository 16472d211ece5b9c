//! Where to start, how far the tip can go from there, and how fast.

use nalgebra::{Matrix6, SMatrix, Vector2, Vector3};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};
use telemime_sim::arm::{ArmModel, Dynamics, Joint, JointKind, Joints, Kinematics, MAX_JOINTS};

use super::ControlError;
use super::resolve::{largest_share, min_eigenvalue, orientation_error, resolve};

/// No joint reference accelerates faster, rad/s² (m/s²), whatever its motor could do with it alone: joints load each other.
pub(super) const ACCELERATION_CAP: f64 = 30.0;

/// Speed, acceleration and jerk of the tip that every direction allows at a posture.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct CartesianLimits {
    /// m/s.
    pub v_max: f64,
    /// m/s².
    pub a_max: f64,
    /// m/s³.
    pub j_max: f64,
}

impl CartesianLimits {
    /// These limits, lowered to what the joints allow at `q` in the worst direction, moving by the pseudo-inverse J⁺ of the position Jacobian:
    /// speed to min q̇ᵢ ⁄ ‖row i of J⁺‖; acceleration to the same of the URDF's acceleration limits (at most 30 rad/s²) and to
    /// min (0.8·τᵢ − |gᵢ|) ⁄ ‖row i of M J⁺‖, and to what the jerk can turn around, in ticks of `dt_s`, within 0.8 of the speed. Away from `q` the joints may allow less: there the inverse kinematics slows.
    ///
    /// # Errors
    /// [`ControlError::TooWeak`] if a joint cannot carry the arm at `q`, [`ControlError::Singular`] if the tip cannot move in every
    /// direction there.
    pub fn lowered(self, arm: &ArmModel, q: &Joints, dt_s: f64) -> Result<Self, ControlError> {
        let mut dynamics = Dynamics::new();
        dynamics.update(arm, q);
        let jacobian = dynamics.kinematics().jacobian();
        let linear = jacobian.fixed_rows::<3>(0);
        let gram = linear * linear.transpose();
        let singular = min_eigenvalue(&gram).max(0.0).sqrt() < 1e-3 * arm.chain_length_m();
        let inverse = gram
            .try_inverse()
            .filter(|_| !singular)
            .ok_or(ControlError::Singular)?;
        let rates: SMatrix<f64, MAX_JOINTS, 3> = linear.transpose() * inverse;
        let torques = dynamics.mass_matrix() * rates;
        let headroom = headroom(arm, &mut dynamics)?;
        let mut limits = self;
        for (i, joint) in arm.joints().iter().enumerate() {
            let rate = rates.row(i).norm();
            limits.v_max = limits.v_max.min(joint.velocity / rate);
            limits.a_max = limits
                .a_max
                .min(joint.acceleration.min(ACCELERATION_CAP) / rate)
                .min(headroom[i] / torques.row(i).norm());
        }
        limits.a_max = limits
            .a_max
            .min(turned_around(limits.v_max, limits.j_max, dt_s));
        Ok(limits)
    }
}

/// The acceleration that the jerk `j` can turn around, in ticks of `dt_s`, within 0.8 of the speed `v`: a²/j + a·dt = 0.8·v, solved for a.
pub(super) fn turned_around(v: f64, j: f64, dt_s: f64) -> f64 {
    0.5 * j * ((dt_s * dt_s + 3.2 * v / j).sqrt() - dt_s)
}

/// What 0.8 of each effort limit leaves beside gravity and friction.
pub(super) fn headroom(arm: &ArmModel, dynamics: &mut Dynamics) -> Result<Joints, ControlError> {
    let zero = Joints::zeros();
    let gravity = dynamics.rnea(&zero, &zero);
    let mut out = Joints::zeros();
    for (i, joint) in arm.joints().iter().enumerate() {
        out[i] = 0.8 * joint.effort - gravity[i].abs() - joint.friction;
        if !(out[i] > 0.0) {
            return Err(ControlError::TooWeak {
                joint: joint.name.clone(),
                needed: gravity[i].abs() + joint.friction,
                effort: joint.effort,
            });
        }
    }
    Ok(out)
}

/// Largest acceleration of each joint moving alone at `q`: the URDF's limit if it states one, at most what 0.8 of its effort limit gives beside gravity,
/// at most 30 rad/s² (m/s²): what published arms state is less.
///
/// # Errors
/// [`ControlError::TooWeak`] if a joint cannot carry the arm at `q`.
pub fn joint_accelerations(arm: &ArmModel, q: &Joints) -> Result<Joints, ControlError> {
    let mut dynamics = Dynamics::new();
    dynamics.update(arm, q);
    let headroom = headroom(arm, &mut dynamics)?;
    let mass = dynamics.mass_matrix();
    let mut out = Joints::zeros();
    for (i, joint) in arm.joints().iter().enumerate() {
        out[i] = (headroom[i] / mass[(i, i)])
            .min(joint.acceleration)
            .min(ACCELERATION_CAP);
    }
    Ok(out)
}

/// A posture to start from: joints well inside their ranges, the tip free to move and turn in every direction, in front of the base and clear of
/// the floor (z = 0). Front is the base axis (±x or ±y) nearest to where the tip points with all joints mid-range, +x if that is straight up.
/// The best of a fixed, seeded set of candidates, refined; the same for the same arm.
pub fn home_posture(arm: &ArmModel) -> Joints {
    let middle = arm.per_joint(Joint::mid);
    let mut kinematics = Kinematics::new();
    kinematics.update(arm, &middle);
    let mut search = Search {
        arm,
        front: front(&kinematics.tip(), 0.1 * arm.chain_length_m()),
        kinematics,
    };
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(0x7e1e_313e);
    let mut best = (search.score(&middle), middle);
    for _ in 0..4000 {
        let mut q = Joints::zeros();
        for (q, joint) in q.iter_mut().zip(arm.joints()) {
            let (lower, upper) = window(joint);
            *q = lower + (upper - lower) * unit(&mut rng);
        }
        search.consider(q, &mut best);
    }
    let mut span = 0.3;
    while span > 1e-3 {
        let before = best.0;
        for i in 0..arm.dof() {
            let (lower, upper) = window(&arm.joints()[i]);
            for sign in [-1.0, 1.0] {
                let mut q = best.1;
                q[i] = (q[i] + sign * span * 0.5 * (upper - lower)).clamp(lower, upper);
                search.consider(q, &mut best);
            }
            // The middle of one joint is often paid for by the others: offer it with each neighbour's step.
            for j in 0..arm.dof() {
                for sign in [-1.0, 1.0] {
                    let (lower, upper) = window(&arm.joints()[j]);
                    let mut q = best.1;
                    q[i] += 0.5 * (arm.joints()[i].mid() - q[i]);
                    q[j] = (q[j] + sign * span * 0.5 * (upper - lower)).clamp(lower, upper);
                    search.consider(q, &mut best);
                }
            }
        }
        if best.0 <= before {
            span *= 0.7;
        }
    }
    best.1
}

/// The horizontal base axis nearest to `tip`; +x if the tip is within `near` of the vertical.
fn front(tip: &Vector3<f64>, near: f64) -> Vector2<f64> {
    match tip.xy() {
        t if t.norm() < near => Vector2::x(),
        t if t.x.abs() >= t.y.abs() => Vector2::new(t.x.signum(), 0.0),
        t => Vector2::new(0.0, t.y.signum()),
    }
}

/// Uniform in [0, 1).
fn unit(rng: &mut Xoshiro256PlusPlus) -> f64 {
    (rng.next_u64() >> 11) as f64 * (1.0 / (1_u64 << 53) as f64)
}

/// The part of a joint's range that is searched: at most a turn around its middle; of a slide all, or half a metre either way if it is unlimited.
fn window(joint: &Joint) -> (f64, f64) {
    let mid = joint.mid();
    let reach = match joint.kind {
        JointKind::Revolute => core::f64::consts::PI,
        JointKind::Prismatic if joint.is_limited() => f64::INFINITY,
        JointKind::Prismatic => 0.5,
    };
    (joint.lower.max(mid - reach), joint.upper.min(mid + reach))
}

/// The farthest that is tried, m: the stretched chain, and every slide's travel.
fn most_travel_m(arm: &ArmModel) -> f64 {
    let slides = arm
        .joints()
        .iter()
        .filter(|j| j.kind == JointKind::Prismatic);
    let travel = slides.map(window).map(|(lower, upper)| upper - lower);
    arm.chain_length_m() + travel.sum::<f64>()
}

struct Search<'a> {
    arm: &'a ArmModel,
    front: Vector2<f64>,
    kinematics: Kinematics,
}

impl Search<'_> {
    fn consider(&mut self, q: Joints, best: &mut (f64, Joints)) {
        let score = self.score(&q);
        if score > best.0 {
            *best = (score, q);
        }
    }

    /// Product of conditioning, dexterity, distance from the joints' ends and placement of the tip; each at most about 1.
    fn score(&mut self, q: &Joints) -> f64 {
        self.kinematics.update(self.arm, q);
        let length = self.arm.chain_length_m().max(1e-6);
        let mut jacobian = self.kinematics.jacobian();
        for i in 0..3 {
            jacobian.row_mut(i).unscale_mut(length);
        }
        let linear = jacobian.fixed_rows::<3>(0);
        let conditioning = min_eigenvalue(&(linear * linear.transpose()))
            .max(0.0)
            .sqrt();
        let full: Matrix6<f64> = jacobian * jacobian.transpose();
        let dexterity = if self.arm.dof() >= 6 {
            full.determinant().max(0.0).powf(1.0 / 12.0)
        } else {
            1.0
        };
        let (mut margin, mut centred) = (1.0_f64, 1.0_f64);
        for (joint, q) in self.arm.joints().iter().zip(q.iter()) {
            let (lower, upper) = window(joint);
            let off = (q - 0.5 * (lower + upper)) / (0.5 * (upper - lower));
            margin = margin.min(1.0 - off * off);
            centred *= (1.0 - off * off).max(0.0);
        }
        conditioning * dexterity * (margin.max(0.0) * centred).powf(0.25) * self.placement(length)
    }

    fn placement(&self, length: f64) -> f64 {
        let tip = self.kinematics.tip();
        let out = tip.xy().norm();
        let in_front = if out > 0.0 {
            (tip.xy().dot(&self.front) / out).max(0.0)
        } else {
            0.0
        };
        // Folded onto the base or at full stretch leaves no room to move.
        let fit = |x: f64, low: f64, high: f64| {
            let slack = (low - x).max(x - high).max(0.0) / (high - low);
            (1.0 - slack).max(0.0)
        };
        let extension = self
            .kinematics
            .joint_frame(1)
            .map_or(out, |(shoulder, _)| (tip - shoulder.coords).norm());
        let mut clear = 1.0_f64;
        for i in 1..self.arm.dof() {
            if let Some((origin, _)) = self.kinematics.joint_frame(i) {
                clear = clear.min(1.0 + (origin.z - 0.05 * length).min(0.0) * 10.0 / length);
            }
        }
        in_front.powi(4)
            * fit(out / length, 0.3, 0.6)
            * fit(extension / length, 0.4, 0.6)
            * fit(tip.z / length, 0.35, 0.65)
            * clear.max(0.0)
    }
}

/// The largest distance, m, that the tip can go from its place at `home` in each of 26 directions (faces, edges and corners of a cube)
/// keeping its orientation as far as the arm can, its joints within limits, its position Jacobian's smallest singular value above 0.3 of that at
/// home, and the tip 2 cm above the floor (if it starts there). In steps of 5 mm.
pub fn workspace_radius(arm: &ArmModel, home: &Joints) -> f64 {
    let mut radius = most_travel_m(arm);
    for x in -1..=1 {
        for y in -1..=1 {
            for z in -1..=1 {
                let direction = Vector3::new(f64::from(x), f64::from(y), f64::from(z));
                if let Some(direction) = direction.try_normalize(0.5) {
                    radius = radius.min(reach(arm, home, &direction, radius));
                }
            }
        }
    }
    radius
}

fn reach(arm: &ArmModel, home: &Joints, direction: &Vector3<f64>, at_most: f64) -> f64 {
    const STEP_M: f64 = 0.005;
    let mut kinematics = Kinematics::new();
    kinematics.update(arm, home);
    let (start, orientation) = (kinematics.tip(), *kinematics.tip_rotation());
    let zero = Vector3::zeros();
    let at_home = resolve(&kinematics.jacobian(), &zero, &zero, &Joints::zeros(), 0.0);
    let mut q = *home;
    let mut reached = 0.0;
    while reached + STEP_M <= at_most {
        let target = start + direction * (reached + STEP_M);
        for iteration in 0..6 {
            kinematics.update(arm, &q);
            let turn = orientation_error(kinematics.tip_rotation(), &orientation);
            let step = resolve(
                &kinematics.jacobian(),
                &(target - kinematics.tip()),
                &(turn * 0.3),
                &((home - q) * 0.02),
                0.0,
            );
            let (lower, upper) = (
                arm.per_joint(|j| j.lower) - q,
                arm.per_joint(|j| j.upper) - q,
            );
            let primary =
                step.primary * largest_share(&Joints::zeros(), &step.primary, &lower, &upper);
            q += primary;
            // Last, only what the tip's place still needs: a large idle motion moves it to second order.
            if iteration < 4 {
                q += step.secondary * largest_share(&primary, &step.secondary, &lower, &upper);
            }
        }
        kinematics.update(arm, &q);
        let now = resolve(&kinematics.jacobian(), &zero, &zero, &Joints::zeros(), 0.0);
        let floor = start.z > 0.02 && kinematics.tip().z < 0.02;
        let missed = (kinematics.tip() - target).norm() > 5e-4;
        if missed || floor || now.sigma_min < 0.3 * at_home.sigma_min {
            break;
        }
        reached += STEP_M;
    }
    reached
}
