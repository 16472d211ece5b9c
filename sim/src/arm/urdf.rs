//! From a URDF's numbers to an [`ArmModel`].

use nalgebra::{Isometry3, Matrix3, Translation3, UnitQuaternion, Vector3};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::SeedableRng;
use urdf_rs::{JointType, Pose};

use super::capsule::random_posture;
use super::hull::Hulls;
use super::payload::moments;
use super::tree::{Tree, moves};
use super::{
    ArmError, ArmModel, Body, Dynamics, Joint, JointKind, Joints, LoadOptions, MAX_JOINTS, Notice,
};

/// No link is longer, m.
const MAX_LENGTH_M: f64 = 100.0;

/// No body is heavier, kg, nor its inertia larger, kg·m².
const MAX_MASS: f64 = 1e6;

/// No joint rubs harder, N·m·s/rad and N·m (N·s/m and N).
const MAX_RESISTANCE: f64 = 1e9;

/// A joint's range that ends farther away has no end, rad or m.
const NO_END: f64 = 1e6;

pub(super) fn read(text: &str, options: &LoadOptions) -> Result<ArmModel, ArmError> {
    let robot = urdf_rs::read_from_string(text).map_err(|e| ArmError::Parse {
        message: e.to_string().trim().to_owned(),
    })?;
    let tree = Tree::new(&robot)?;
    let mut notices = Vec::new();
    let tip = match &options.tip {
        Some(tip) if robot.links.iter().any(|l| l.name == *tip) => tip.as_str(),
        Some(tip) => {
            return Err(ArmError::UnknownTip {
                tip: tip.clone(),
                links: robot.links.iter().map(|l| l.name.clone()).collect(),
            });
        }
        None => {
            let (tip, others) = tree.default_tip();
            notices.push(Notice::TipChosen {
                tip: tip.to_owned(),
                others,
            });
            tip
        }
    };
    let path = tree.path(tip);
    let count = path.iter().filter(|j| moves(j)).count();
    if count == 0 {
        return Err(ArmError::NoMovableJoint {
            tip: tip.to_owned(),
        });
    }
    if count > MAX_JOINTS {
        return Err(ArmError::TooManyJoints {
            tip: tip.to_owned(),
            count,
        });
    }
    for name in options.fixed.keys() {
        let on_chain = |j: &&&urdf_rs::Joint| moves(j) && path.iter().any(|p| p.name == j.name);
        let joint = robot.joints.iter().find(|j| j.name == *name);
        if joint.is_none_or(|j| j.joint_type == JointType::Fixed || on_chain(&&j)) {
            return Err(ArmError::NotOffChain {
                joint: name.clone(),
            });
        }
    }

    let mut reader = Reader {
        hulls: Hulls::default(),
        tree,
        options,
        notices,
    };
    reader.hulls.begin(reader.tree.root);
    // The inertia of what does not move is not read.
    reader.placed(reader.tree.root, Isometry3::identity(), path.first())?;
    let mut joints: Vec<Joint> = Vec::with_capacity(count);
    let mut pose = Isometry3::identity();
    for (i, joint) in path.iter().enumerate() {
        let origin = isometry(&joint.origin, "origin", &joint.name)?;
        if moves(joint) {
            let mut checked = reader.joint(joint, pose * origin)?;
            pose = Isometry3::identity();
            reader.hulls.begin(&joint.child.link);
            checked.body = reader.link_and_branches(&joint.child.link, pose, path.get(i + 1))?;
            if checked.body.mass_kg == 0.0 {
                reader.notices.push(Notice::MasslessBody {
                    joint: joint.name.clone(),
                });
            }
            joints.push(checked);
        } else {
            pose = pose * origin * reader.fixed_motion(joint)?;
            let body = reader.link_and_branches(&joint.child.link, pose, path.get(i + 1))?;
            if let Some(last) = joints.last_mut() {
                last.body = last.body.joined(&body);
            }
        }
    }
    if let (Some(payload), Some(last)) = (&options.payload, joints.last_mut()) {
        last.body = last.body.joined(&payload.body().moved(&pose));
    }
    let turns = joints.iter().map(turns).collect();
    let Reader {
        hulls,
        notices,
        tree: Tree { root, .. },
        ..
    } = reader;
    let mut arm = ArmModel {
        name: robot.name.clone(),
        tip: tip.to_owned(),
        joints,
        tip_offset: pose,
        notices,
        capsules: Vec::new(),
        turns,
    };
    let chain: Vec<_> = path.iter().map(|j| j.child.link.as_str()).collect();
    arm.capsules = hulls.capsules(&arm, &[&[root], &chain[..]].concat());
    refuse_massless(&arm)?;
    Ok(arm)
}

struct Reader<'a> {
    tree: Tree<'a>,
    options: &'a LoadOptions,
    notices: Vec<Notice>,
    hulls: Hulls,
}

impl<'a> Reader<'a> {
    /// What a link at `pose` fills.
    fn shapes(&mut self, link: &str, pose: &Isometry3<f64>) -> Result<(), ArmError> {
        let Some(link) = self.tree.robot.links.iter().find(|l| l.name == link) else {
            return Ok(());
        };
        for collision in &link.collision {
            let pose = pose * isometry(&collision.origin, "a collision's origin", &link.name)?;
            if !self.hulls.add(&link.name, &pose, &collision.geometry) {
                self.notices.push(Notice::ShapeIgnored {
                    link: link.name.clone(),
                });
            }
        }
        Ok(())
    }

    /// A moving joint of the chain, without its body.
    fn joint(
        &mut self,
        joint: &urdf_rs::Joint,
        placement: Isometry3<f64>,
    ) -> Result<Joint, ArmError> {
        let name = joint.name.clone();
        let kind = match joint.joint_type {
            JointType::Revolute | JointType::Continuous => JointKind::Revolute,
            JointType::Prismatic => JointKind::Prismatic,
            JointType::Floating => return Err(unsupported(joint, "floating")),
            JointType::Planar => return Err(unsupported(joint, "planar")),
            JointType::Spherical | JointType::Fixed => return Err(unsupported(joint, "spherical")),
        };
        let (lower, upper) = limits(joint)?;
        let not_negative = |what: &'static str, value: f64| match value {
            v if v.is_nan() => Err(ArmError::NotFinite {
                what,
                name: joint.name.clone(),
            }),
            v if v < 0.0 => Err(ArmError::Negative {
                what,
                joint: joint.name.clone(),
                value: v,
            }),
            v => Ok(v),
        };
        let velocity = not_negative("the velocity limit", joint.limit.velocity)?;
        let effort = not_negative("the effort limit", joint.limit.effort)?;
        let acceleration = not_negative("the acceleration limit", joint.limit.acceleration)?;
        let deceleration = not_negative("the deceleration limit", joint.limit.deceleration)?;
        let (damping, friction) = joint
            .dynamics
            .as_ref()
            .map_or((0.0, 0.0), |d| (d.damping, d.friction));
        for (what, value) in [("the damping", damping), ("the friction", friction)] {
            if !not_negative(what, value)?.is_finite() {
                return Err(ArmError::NotFinite { what, name });
            }
            at_most(what, &name, value, MAX_RESISTANCE)?;
        }
        let stated = |value: f64| {
            if value == 0.0 { f64::INFINITY } else { value }
        };
        if effort == 0.0 {
            self.notices.push(Notice::NoEffortLimit {
                joint: name.clone(),
            });
        }
        if velocity == 0.0 {
            self.notices.push(Notice::NoVelocityLimit {
                joint: name.clone(),
            });
        }
        Ok(Joint {
            axis: axis(joint)?,
            kind,
            placement,
            lower,
            upper,
            velocity: stated(velocity),
            effort: stated(effort),
            acceleration: stated(acceleration).min(stated(deceleration)),
            damping,
            friction,
            body: Body::EMPTY,
            name,
        })
    }

    /// The body of a link at `pose`, with every branch that hangs on it except along `next`.
    fn link_and_branches(
        &mut self,
        link: &'a str,
        pose: Isometry3<f64>,
        next: Option<&&urdf_rs::Joint>,
    ) -> Result<Body, ArmError> {
        let mut body: Option<Body> = None;
        for (link, pose) in self.placed(link, pose, next)? {
            let own = self.link(link)?.moved(&pose);
            body = Some(body.map_or(own, |body| body.joined(&own)));
        }
        Ok(body.unwrap_or(Body::EMPTY))
    }

    /// The same links and where they are; their shapes are taken.
    fn placed(
        &mut self,
        link: &'a str,
        pose: Isometry3<f64>,
        next: Option<&&urdf_rs::Joint>,
    ) -> Result<Vec<(&'a str, Isometry3<f64>)>, ArmError> {
        self.shapes(link, &pose)?;
        let mut placed = vec![(link, pose)];
        let off_chain = |j: &&urdf_rs::Joint| next.is_none_or(|n| n.name != j.name);
        let branches = self.tree.children(link).iter().copied().filter(off_chain);
        let mut open: Vec<_> = branches.map(|joint| (joint, pose)).collect();
        while let Some((joint, pose)) = open.pop() {
            let pose = pose
                * isometry(&joint.origin, "origin", &joint.name)?
                * self.fixed_motion(joint)?;
            let link = &joint.child.link;
            self.shapes(link, &pose)?;
            placed.push((link, pose));
            open.extend(self.tree.children(link).iter().map(|j| (*j, pose)));
        }
        Ok(placed)
    }

    /// The motion of a joint that does not move the tip, at the value where it is fixed.
    fn fixed_motion(&mut self, joint: &urdf_rs::Joint) -> Result<Isometry3<f64>, ArmError> {
        let turn = match joint.joint_type {
            JointType::Fixed => return Ok(Isometry3::identity()),
            JointType::Revolute | JointType::Continuous => true,
            JointType::Prismatic => false,
            JointType::Floating | JointType::Planar | JointType::Spherical => {
                self.notices.push(Notice::JointFixed {
                    joint: joint.name.clone(),
                    value: 0.0,
                });
                return Ok(Isometry3::identity());
            }
        };
        let value = self.fixed_value(joint)?;
        self.notices.push(Notice::JointFixed {
            joint: joint.name.clone(),
            value,
        });
        let axis = axis(joint)?;
        Ok(if turn {
            Isometry3::rotation(axis * value)
        } else {
            Isometry3::translation(axis.x * value, axis.y * value, axis.z * value)
        })
    }

    fn fixed_value(&self, joint: &urdf_rs::Joint) -> Result<f64, ArmError> {
        let (lower, upper) = limits(joint)?;
        if let Some(&value) = self.options.fixed.get(&joint.name) {
            return if value >= lower && value <= upper {
                Ok(value)
            } else {
                Err(ArmError::FixedOutside {
                    joint: joint.name.clone(),
                    value,
                    lower,
                    upper,
                })
            };
        }
        let default = if lower <= 0.0 && upper >= 0.0 {
            0.0
        } else if lower.is_finite() && upper.is_finite() {
            0.5 * (lower + upper)
        } else {
            lower.max(upper.min(0.0))
        };
        let Some(mimic) = &joint.mimic else {
            return Ok(default);
        };
        let followed =
            self.options.fixed.get(&mimic.joint).map(|leader| {
                mimic.multiplier.unwrap_or(1.0) * leader + mimic.offset.unwrap_or(0.0)
            });
        Ok(followed
            .filter(|v| v.is_finite())
            .map_or(default, |v| v.max(lower).min(upper)))
    }

    /// The body of one link in its own frame.
    fn link(&mut self, name: &str) -> Result<Body, ArmError> {
        let Some(link) = self.tree.robot.links.iter().find(|l| l.name == name) else {
            return Ok(Body::EMPTY);
        };
        let link_name = || link.name.clone();
        let (mass_kg, i) = (link.inertial.mass.value, &link.inertial.inertia);
        let pose = isometry(&link.inertial.origin, "the inertial origin", name)?;
        let inertia = Matrix3::new(
            i.ixx, i.ixy, i.ixz, i.ixy, i.iyy, i.iyz, i.ixz, i.iyz, i.izz,
        );
        if !mass_kg.is_finite() || !inertia.iter().all(|v| v.is_finite()) {
            return Err(ArmError::NotFinite {
                what: "the mass or inertia",
                name: link_name(),
            });
        }
        if mass_kg < 0.0 {
            return Err(ArmError::NegativeMass {
                link: link_name(),
                mass_kg,
            });
        }
        at_most("the mass", name, mass_kg, MAX_MASS)?;
        at_most("the inertia", name, inertia.amax(), MAX_MASS)?;
        let moments = moments(&inertia);
        let rounding = 1e-9 * moments[2].abs();
        if moments[0] < -rounding {
            return Err(ArmError::NegativeInertia {
                link: link_name(),
                moment_kg_m2: moments[0],
            });
        }
        let excess_kg_m2 = moments[2] - moments[1] - moments[0];
        if excess_kg_m2 > 1e-6 * moments[2] {
            self.notices.push(Notice::TriangleInequality {
                link: link_name(),
                excess_kg_m2,
            });
        }
        if mass_kg > 0.0 && moments[2] == 0.0 {
            self.notices.push(Notice::PointMass { link: link_name() });
        }
        if mass_kg == 0.0 && moments[2] > 0.0 {
            self.notices
                .push(Notice::InertiaWithoutMass { link: link_name() });
        }
        let body = Body {
            mass_kg,
            com_m: Vector3::zeros(),
            inertia_kg_m2: inertia,
        };
        Ok(body.moved(&pose))
    }
}

fn unsupported(joint: &urdf_rs::Joint, kind: &'static str) -> ArmError {
    ArmError::UnsupportedJoint {
        joint: joint.name.clone(),
        kind,
    }
}

/// Lower and upper stop; infinite for a continuous joint and the many-axis kinds.
fn limits(joint: &urdf_rs::Joint) -> Result<(f64, f64), ArmError> {
    if !matches!(joint.joint_type, JointType::Revolute | JointType::Prismatic) {
        return Ok((f64::NEG_INFINITY, f64::INFINITY));
    }
    let (lower, upper) = (joint.limit.lower, joint.limit.upper);
    if lower.is_nan() || upper.is_nan() {
        return Err(ArmError::NotFinite {
            what: "a limit",
            name: joint.name.clone(),
        });
    }
    // A joint off the chain may well have no range: it is fixed at its only value.
    if lower > upper || (lower == upper && moves(joint)) {
        return Err(ArmError::EmptyRange {
            joint: joint.name.clone(),
            lower,
            upper,
        });
    }
    let end = |limit: f64| {
        if limit.abs() > NO_END {
            f64::INFINITY.copysign(limit)
        } else {
            limit
        }
    };
    Ok((end(lower), end(upper)))
}

fn at_most(what: &'static str, name: &str, value: f64, most: f64) -> Result<(), ArmError> {
    if value.abs() <= most {
        return Ok(());
    }
    Err(ArmError::TooLarge {
        what,
        name: name.to_owned(),
        value,
        most,
    })
}

fn axis(joint: &urdf_rs::Joint) -> Result<Vector3<f64>, ArmError> {
    let axis = Vector3::from(joint.axis.xyz.0);
    if !axis.iter().all(|v| v.is_finite()) {
        return Err(ArmError::NotFinite {
            what: "the axis",
            name: joint.name.clone(),
        });
    }
    axis.try_normalize(1e-9).ok_or_else(|| ArmError::ZeroAxis {
        joint: joint.name.clone(),
    })
}

fn isometry(pose: &Pose, what: &'static str, name: &str) -> Result<Isometry3<f64>, ArmError> {
    let ([x, y, z], [roll, pitch, yaw]) = (pose.xyz.0, pose.rpy.0);
    if ![x, y, z, roll, pitch, yaw].iter().all(|v| v.is_finite()) {
        return Err(ArmError::NotFinite {
            what,
            name: name.to_owned(),
        });
    }
    for value in [x, y, z] {
        at_most(what, name, value, MAX_LENGTH_M)?;
    }
    Ok(Isometry3::from_parts(
        Translation3::new(x, y, z),
        UnitQuaternion::from_euler_angles(roll, pitch, yaw),
    ))
}

fn turns(joint: &Joint) -> [Matrix3<f64>; 3] {
    let at_zero = *joint.placement.rotation.to_rotation_matrix().matrix();
    let cross = joint.axis.cross_matrix();
    [at_zero, at_zero * cross, at_zero * cross * cross]
}

/// Every joint must move some inertia, or forward dynamics divides by zero: looked at with all joints mid-range and in 32 postures more.
fn refuse_massless(arm: &ArmModel) -> Result<(), ArmError> {
    let mut dynamics = Dynamics::new();
    let mass = arm.moving_mass_kg();
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(1);
    let mut posture = arm.per_joint(Joint::mid);
    for _ in 0..33 {
        dynamics.update(arm, &posture);
        let pivots = dynamics.pivots(&Joints::zeros());
        for (joint, pivot) in arm.joints.iter().zip(pivots.iter()) {
            // 1 µg, or 1 µg at 1 m: below what any arm has, above what rounding leaves.
            if !(*pivot > 1e-9 * mass.max(1.0)) {
                return Err(ArmError::Massless {
                    joint: joint.name.clone(),
                });
            }
        }
        posture = random_posture(arm, &mut rng);
    }
    Ok(())
}
