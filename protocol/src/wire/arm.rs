//! How the arm is built, for whoever draws it. Nothing is computed from it that moves.

use serde::{Deserialize, Serialize};

use super::codec::DecodeError;
use super::v1::MAX_JOINTS;

/// Most capsules of a [`WireArm`].
pub const MAX_CAPSULES: usize = 64;

/// Nothing of an arm is farther from its joint, or thicker, m.
pub const MAX_LENGTH_M: f32 = 100.0;

/// Moving joints from the base to the tip, and what surrounds them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WireArm {
    /// The moving joints, base first, at most [`MAX_JOINTS`]; as many as [`Info`](super::v1::Info) counts.
    pub joints: Vec<WireJoint>,
    /// The tip in the last joint's frame.
    pub tip: WirePlace,
    /// At most [`MAX_CAPSULES`].
    pub capsules: Vec<WireCapsule>,
}

/// A frame in another one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct WirePlace {
    /// Its origin, m.
    pub m: [f32; 3],
    /// Its orientation, unit quaternion w, x, y, z.
    pub q: [f32; 4],
}

/// A moving joint.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct WireJoint {
    /// The joint's frame at zero in the previous joint's (the base for the first).
    pub place: WirePlace,
    /// Unit axis in the joint's frame.
    pub axis: [f32; 3],
    /// What its value is.
    pub kind: WireJointKind,
    /// Lower and upper stop, rad or m, where there are any.
    pub limits: Option<[f32; 2]>,
}

/// How a joint moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum WireJointKind {
    /// Turns about its axis, rad.
    Revolute,
    /// Slides along its axis, m.
    Prismatic,
}

/// Everything within a distance of a line: what a link takes up, roughly.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct WireCapsule {
    /// Whose frame: 0 the base's, else the joint of this number, counted from 1.
    pub link: u8,
    /// One end of the line, m.
    pub from: [f32; 3],
    /// The other end, m.
    pub to: [f32; 3],
    /// The distance, m, above 0.
    pub radius_m: f32,
}

fn invalid(field: &'static str, why: &'static str) -> DecodeError {
    DecodeError::Invalid { field, why }
}

/// Written so that NaN fails too.
fn lengths(values: &[f32], field: &'static str) -> Result<(), DecodeError> {
    if values.iter().all(|v| v.abs() <= MAX_LENGTH_M) {
        Ok(())
    } else {
        Err(invalid(field, "not finite, or beyond 100 m"))
    }
}

fn unit(values: &[f32], field: &'static str) -> Result<(), DecodeError> {
    let square: f32 = values.iter().map(|v| v * v).sum();
    if (square - 1.0).abs() < 1e-3 {
        Ok(())
    } else {
        Err(invalid(field, "not of length one"))
    }
}

impl WirePlace {
    fn check(&self) -> Result<(), DecodeError> {
        lengths(&self.m, "arm.m")?;
        unit(&self.q, "arm.q")
    }
}

impl WireArm {
    pub(super) fn check(&self) -> Result<(), DecodeError> {
        if self.joints.len() > MAX_JOINTS {
            return Err(invalid("arm.joints", "more than 10"));
        }
        if self.capsules.len() > MAX_CAPSULES {
            return Err(invalid("arm.capsules", "more than 64"));
        }
        for joint in &self.joints {
            joint.place.check()?;
            unit(&joint.axis, "arm.axis")?;
            if let Some([lower, upper]) = joint.limits {
                let ordered = lower.is_finite() && upper.is_finite() && lower <= upper;
                if !ordered {
                    return Err(invalid("arm.limits", "not finite, or not in order"));
                }
            }
        }
        self.tip.check()?;
        for capsule in &self.capsules {
            lengths(&capsule.from, "arm.capsules.from")?;
            lengths(&capsule.to, "arm.capsules.to")?;
            lengths(&[capsule.radius_m], "arm.capsules.radius_m")?;
            if !(capsule.radius_m > 0.0) {
                return Err(invalid("arm.capsules.radius_m", "not above 0"));
            }
            if usize::from(capsule.link) > self.joints.len() {
                return Err(invalid("arm.capsules.link", "no such joint"));
            }
        }
        Ok(())
    }
}
