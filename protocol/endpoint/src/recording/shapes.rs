//! The arm as the viewers' own schemas have it: frames, joints, and a scene that moves with the frames.

use foxglove::messages::{
    Color, CylinderPrimitive, FrameTransform, FrameTransforms, JointState, JointStates, Log, Pose,
    PoseInFrame, Quaternion, SceneEntity, SceneUpdate, SpherePrimitive, Timestamp, Vector3, log,
};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, UnitVector3, Vector3 as V3};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::arm::{WireArm, WireCapsule, WireJoint, WireJointKind, WirePlace};

/// The frame that the arm stands in, and everything is given in.
pub const BASE: &str = "base";

/// How an arm is called and drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Look {
    /// Before the names of its frames.
    pub prefix: &'static str,
    /// Red, green, blue, opacity, 0 to 1.
    pub colour: [f64; 4],
}

/// An arm to be drawn.
#[derive(Debug, Clone)]
pub struct Drawn {
    arm: WireArm,
    look: Look,
    names: Vec<String>,
}

impl Drawn {
    /// `arm`, whose moving joints are called `names`, base first; a joint without a name is called by its number.
    pub fn new(arm: WireArm, look: Look, names: &[&str]) -> Self {
        let name = |i: usize| {
            names
                .get(i)
                .map_or_else(|| format!("joint{}", i + 1), |n| (*n).to_owned())
        };
        Self {
            names: (0..arm.joints.len()).map(name).collect(),
            arm,
            look,
        }
    }

    /// Frame `link`: 0 the base, else after joint `link`, counted from 1.
    fn frame(&self, link: usize) -> String {
        match link {
            0 => BASE.to_owned(),
            link => format!("{}link{link}", self.look.prefix),
        }
    }

    /// Every link in the one before it, the tip last, at joint values `q`, rad or m.
    pub fn transforms(&self, t: Stamp, q: &[f64]) -> FrameTransforms {
        let moved = self
            .arm
            .joints
            .iter()
            .zip(q)
            .enumerate()
            .map(|(i, (joint, q))| {
                transform(t, self.frame(i), self.frame(i + 1), &after(joint, *q))
            });
        let tip = transform(
            t,
            self.frame(self.arm.joints.len()),
            format!("{}tip", self.look.prefix),
            &isometry(&self.arm.tip),
        );
        FrameTransforms {
            transforms: moved.chain([tip]).collect(),
        }
    }

    /// The joints' values, rad or m.
    pub fn joints(&self, t: Stamp, q: &[f64]) -> JointStates {
        let joint = |(name, q): (&String, &f64)| JointState {
            name: name.clone(),
            position: Some(*q),
            ..JointState::default()
        };
        JointStates {
            timestamp: Some(timestamp(t)),
            joints: self.names.iter().zip(q).map(joint).collect(),
        }
    }

    /// The links' hulls, each fixed to its frame: once is enough.
    pub fn scene(&self, t: Stamp) -> SceneUpdate {
        let entity = |link: usize| {
            let capsules = self.arm.capsules.iter();
            let of_link = capsules.filter(|capsule| usize::from(capsule.link) == link);
            let mut entity = SceneEntity {
                timestamp: Some(timestamp(t)),
                frame_id: self.frame(link),
                id: format!("{}hull{link}", self.look.prefix),
                frame_locked: true,
                ..SceneEntity::default()
            };
            for capsule in of_link {
                self.draw(&mut entity, capsule);
            }
            entity
        };
        let entities = (0..=self.arm.joints.len()).map(entity);
        SceneUpdate {
            deletions: Vec::new(),
            entities: entities
                .filter(|entity| !entity.spheres.is_empty())
                .collect(),
        }
    }

    fn draw(&self, entity: &mut SceneEntity, capsule: &WireCapsule) {
        let [from, to] = [capsule.from, capsule.to].map(|m| V3::from(m.map(f64::from)));
        let radius = f64::from(capsule.radius_m);
        let [r, g, b, a] = self.look.colour;
        let color = Some(Color { r, g, b, a });
        let size = |z| Some(vector(&V3::new(2.0 * radius, 2.0 * radius, z)));
        let ball = |at: &V3<f64>| SpherePrimitive {
            pose: Some(pose(at, &UnitQuaternion::identity())),
            size: size(2.0 * radius),
            color,
        };
        entity.spheres.push(ball(&from));
        let along = to - from;
        if along.norm() < 1e-6 {
            return;
        }
        entity.spheres.push(ball(&to));
        // Where they are opposite, any half turn does.
        let turn = UnitQuaternion::rotation_between(&V3::z(), &along).unwrap_or_else(|| {
            UnitQuaternion::from_axis_angle(&V3::x_axis(), std::f64::consts::PI)
        });
        entity.cylinders.push(CylinderPrimitive {
            pose: Some(pose(&(0.5 * (from + to)), &turn)),
            size: size(along.norm()),
            bottom_scale: 1.0,
            top_scale: 1.0,
            color,
        });
    }
}

/// A joint's frame in the one before it, with the joint at `q`.
fn after(joint: &WireJoint, q: f64) -> Isometry3<f64> {
    let axis = V3::from(joint.axis.map(f64::from));
    let moved = match joint.kind {
        WireJointKind::Revolute => Isometry3::from_parts(
            Translation3::identity(),
            UnitQuaternion::from_axis_angle(&UnitVector3::new_normalize(axis), q),
        ),
        WireJointKind::Prismatic => Isometry3::translation(axis.x * q, axis.y * q, axis.z * q),
    };
    isometry(&joint.place) * moved
}

fn isometry(place: &WirePlace) -> Isometry3<f64> {
    let [w, x, y, z] = place.q.map(f64::from);
    let turn = UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(w, x, y, z));
    Isometry3::from_parts(V3::from(place.m.map(f64::from)).into(), turn)
}

fn transform(t: Stamp, parent: String, child: String, at: &Isometry3<f64>) -> FrameTransform {
    FrameTransform {
        timestamp: Some(timestamp(t)),
        parent_frame_id: parent,
        child_frame_id: child,
        translation: Some(vector(&at.translation.vector)),
        rotation: Some(quaternion(&at.rotation)),
    }
}

fn vector(v: &V3<f64>) -> Vector3 {
    Vector3 {
        x: v.x,
        y: v.y,
        z: v.z,
    }
}

fn quaternion(q: &UnitQuaternion<f64>) -> Quaternion {
    Quaternion {
        x: q.i,
        y: q.j,
        z: q.k,
        w: q.w,
    }
}

/// A place (m) and an orientation.
fn pose(at: &V3<f64>, turn: &UnitQuaternion<f64>) -> Pose {
    Pose {
        position: Some(vector(at)),
        orientation: Some(quaternion(turn)),
    }
}

/// A pose in [`BASE`].
pub fn in_base(t: Stamp, at: &V3<f64>, turn: &UnitQuaternion<f64>) -> PoseInFrame {
    PoseInFrame {
        timestamp: Some(timestamp(t)),
        frame_id: BASE.to_owned(),
        pose: Some(pose(at, turn)),
    }
}

/// Points in [`BASE`], m, in order.
pub fn points(t: Stamp, at: impl Iterator<Item = V3<f64>>) -> foxglove::messages::PosesInFrame {
    poses(t, at.map(|m| (m, UnitQuaternion::identity())))
}

/// Poses in [`BASE`], m, in order.
pub fn poses(
    t: Stamp,
    at: impl Iterator<Item = (V3<f64>, UnitQuaternion<f64>)>,
) -> foxglove::messages::PosesInFrame {
    foxglove::messages::PosesInFrame {
        timestamp: Some(timestamp(t)),
        frame_id: BASE.to_owned(),
        poses: at.map(|(m, turn)| pose(&m, &turn)).collect(),
    }
}

/// As the viewers' schemas have it; the session clock counts from its own zero.
pub(super) fn timestamp(t: Stamp) -> Timestamp {
    let ns = super::nanos(t);
    let sec = u32::try_from(ns / 1_000_000_000).unwrap_or(u32::MAX);
    Timestamp::new(sec, (ns % 1_000_000_000) as u32)
}

/// Something worth knowing.
pub fn info(t: Stamp, text: &str) -> Log {
    line(t, text, log::Level::Info)
}

/// Something that is not as it should be.
pub fn warning(t: Stamp, text: &str) -> Log {
    line(t, text, log::Level::Warning)
}

fn line(t: Stamp, text: &str, level: log::Level) -> Log {
    Log {
        timestamp: Some(timestamp(t)),
        level: level as i32,
        message: text.to_owned(),
        name: "telemime".to_owned(),
        ..Log::default()
    }
}
