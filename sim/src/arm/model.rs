//! What is known of an arm, independent of its state.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Matrix3, Vector3};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::SeedableRng;

use super::capsule::{Capsule, random_posture};
use super::{ArmError, Body, Joints, Kinematics, Notice, Payload};

/// How a joint moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JointKind {
    /// Turns about its axis: rad, rad/s, N·m. A `continuous` joint has infinite limits.
    Revolute,
    /// Slides along its axis: m, m/s, N.
    Prismatic,
}

/// A moving joint of the chain and the body it moves.
#[derive(Clone, Debug, PartialEq)]
pub struct Joint {
    /// Name in the URDF.
    pub name: String,
    /// How it moves.
    pub kind: JointKind,
    /// Pose of this joint's frame at zero in the previous joint's frame (the base for the first), m.
    pub placement: Isometry3<f64>,
    /// Unit axis in the joint's frame.
    pub axis: Vector3<f64>,
    /// Lower stop, rad or m; −∞ if unlimited.
    pub lower: f64,
    /// Upper stop, rad or m; ∞ if unlimited.
    pub upper: f64,
    /// Speed limit, rad/s or m/s; ∞ if not stated.
    pub velocity: f64,
    /// Torque or force limit, N·m or N; ∞ if not stated.
    pub effort: f64,
    /// Acceleration limit (URDF 1.2), rad/s² or m/s²; ∞ if not stated.
    pub acceleration: f64,
    /// Viscous damping, N·m·s/rad or N·s/m.
    pub damping: f64,
    /// Coulomb friction, N·m or N.
    pub friction: f64,
    /// All that moves rigidly with this joint.
    pub body: Body,
}

impl Joint {
    /// Whether both stops are finite.
    pub fn is_limited(&self) -> bool {
        self.lower.is_finite() && self.upper.is_finite()
    }

    /// The middle of the range; 0, moved into the range, where a stop is missing.
    pub fn mid(&self) -> f64 {
        if self.is_limited() {
            0.5 * (self.lower + self.upper)
        } else {
            0.0_f64.max(self.lower).min(self.upper)
        }
    }
}

/// How to read a URDF.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LoadOptions {
    /// Link whose origin is the tip. By default `tool0` or `tcp` (also as `…_tool0`, `…_tcp`), else the deepest link
    /// that is not behind a gripper's joint.
    pub tip: Option<String>,
    /// Values for joints off the chain, rad or m. By default 0, or mid-range if 0 is outside the limits.
    pub fixed: BTreeMap<String, f64>,
    /// What the tip carries.
    pub payload: Option<Payload>,
}

/// A serial arm: the chain of moving joints from a URDF's root to its tip.
#[derive(Clone, Debug, PartialEq)]
pub struct ArmModel {
    pub(super) name: String,
    pub(super) tip: String,
    pub(super) joints: Vec<Joint>,
    pub(super) tip_offset: Isometry3<f64>,
    pub(super) notices: Vec<Notice>,
    pub(super) capsules: Vec<Capsule>,
    /// `placement`'s rotation times (1, [axis]×, [axis]×²): Rodrigues' formula without its products.
    pub(super) turns: Vec<[Matrix3<f64>; 3]>,
}

impl ArmModel {
    /// Reads the chain from root to tip out of a URDF's text.
    ///
    /// Meshes are ignored. Joints that do not move the tip, and mimic joints, are fixed and what hangs on them is lumped into
    /// the body that carries it; every such assumption is one of [`notices`](Self::notices).
    ///
    /// ```
    /// use telemime_sim::arm::{ArmModel, LoadOptions, default_urdf};
    ///
    /// let arm = ArmModel::from_urdf(default_urdf(), &LoadOptions::default())?;
    /// assert_eq!((arm.dof(), arm.tip()), (7, "tcp"));
    /// # Ok::<(), telemime_sim::arm::ArmError>(())
    /// ```
    ///
    /// # Errors
    /// One [`ArmError`] per cause; each says what to change.
    pub fn from_urdf(text: &str, options: &LoadOptions) -> Result<Self, ArmError> {
        super::urdf::read(text, options)
    }

    /// The robot's name in the URDF.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The tip link's name.
    pub fn tip(&self) -> &str {
        &self.tip
    }

    /// Degrees of freedom, 1 to [`MAX_JOINTS`](super::MAX_JOINTS).
    pub fn dof(&self) -> usize {
        self.joints.len()
    }

    /// The moving joints, base first.
    pub fn joints(&self) -> &[Joint] {
        &self.joints
    }

    /// Pose of the tip in the last joint's frame, m.
    pub fn tip_offset(&self) -> &Isometry3<f64> {
        &self.tip_offset
    }

    /// What was assumed while reading.
    pub fn notices(&self) -> &[Notice] {
        &self.notices
    }

    /// Hulls of the arm's bodies, base first.
    pub fn capsules(&self) -> &[Capsule] {
        &self.capsules
    }

    /// Mass of all moving bodies and the payload, kg.
    pub fn moving_mass_kg(&self) -> f64 {
        self.joints.iter().map(|j| j.body.mass_kg).sum()
    }

    /// Length of the chain from the first joint to the tip, m: an upper bound of the reach of a revolute arm at zero
    /// extension of its prismatic joints.
    pub fn chain_length_m(&self) -> f64 {
        let links: f64 = self.joints[1..]
            .iter()
            .map(|j| j.placement.translation.vector.norm())
            .sum();
        links + self.tip_offset.translation.vector.norm()
    }

    /// The farthest that the tip is from the first joint's origin in 10 000 sampled postures, m: the same for the same arm.
    pub fn sampled_reach_m(&self) -> f64 {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(0x4eac);
        let mut kinematics = Kinematics::new();
        let mut reach = 0.0_f64;
        for _ in 0..10_000 {
            kinematics.update(self, &random_posture(self, &mut rng));
            let first = kinematics.joint_frame(0).map(|(p, _)| p.coords);
            reach = reach.max((kinematics.tip() - first.unwrap_or_default()).norm());
        }
        reach
    }

    /// One number per joint from a function of the joint; zero beyond.
    pub fn per_joint(&self, f: impl Fn(&Joint) -> f64) -> Joints {
        let mut out = Joints::zeros();
        for (o, j) in out.iter_mut().zip(&self.joints) {
            *o = f(j);
        }
        out
    }

    /// Joint values from a slice; `None` unless it has [`dof`](Self::dof) finite numbers within the joints' limits.
    pub fn posture(&self, q: &[f64]) -> Option<Joints> {
        let inside = |(q, j): (&f64, &Joint)| q.is_finite() && *q >= j.lower && *q <= j.upper;
        (q.len() == self.dof() && q.iter().zip(&self.joints).all(inside)).then(|| {
            let mut out = Joints::zeros();
            out.as_mut_slice()[..q.len()].copy_from_slice(q);
            out
        })
    }

    /// Viscous and Coulomb friction that a joint velocity meets, smooth within ±0.01 rad/s (m/s) of rest; to be
    /// added to the torque that inverse dynamics asks for.
    pub fn friction(&self, qd: &Joints) -> Joints {
        let mut out = Joints::zeros();
        for ((o, j), v) in out.iter_mut().zip(&self.joints).zip(qd.iter()) {
            *o = j.damping * v + j.friction * (v / 0.01).clamp(-1.0, 1.0);
        }
        out
    }
}
