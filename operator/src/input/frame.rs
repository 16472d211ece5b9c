//! One line of JSON: a point, or a skeleton with named joints.

use std::collections::BTreeMap;

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use super::{Fault, Kind};
use crate::demonstration::Sample;
use crate::ingest::skeleton;
use crate::ingest::{LengthUnit, TimeUnit};

/// Longest line, bytes: a skeleton of 75 joints with their orientations fits.
pub const LONGEST: usize = 16 * 1024;

/// A hand is nearer than this to the tracker, m.
pub(super) const FARTHEST_M: f64 = 100.0;

/// A quaternion's norm may be off by this much: it is written with a few digits.
const NORM_SLACK: f64 = 0.01;

/// A sender's clock counts less than this, s: beyond it microseconds are lost in its digits.
const LARGEST_T_S: f64 = 4e9;

/// What a sender's numbers mean.
#[derive(Debug, Clone, PartialEq)]
pub struct Units {
    /// Of lengths.
    pub length: LengthUnit,
    /// Of times.
    pub time: TimeUnit,
    /// The gripper's readings when closed and when open.
    pub grip: (f64, f64),
    /// The joint of a skeleton that is the hand.
    pub joint: String,
}

impl Default for Units {
    fn default() -> Self {
        Self {
            length: LengthUnit::M,
            time: TimeUnit::S,
            grip: (0.0, 1.0),
            joint: "right_hand".to_owned(),
        }
    }
}

/// Where the hand is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// m.
    pub position: Vector3<f64>,
    /// From the hand's own axes to the tracker's.
    pub orientation: Option<UnitQuaternion<f64>>,
    /// 0 (closed) to 1 (open).
    pub grip: Option<f64>,
}

/// A frame: where the hand is, whether the clutch is held, or both.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Frame {
    /// By the sender's clock, s.
    pub t_s: Option<f64>,
    /// The hand.
    pub hand: Option<Place>,
    /// The clutch; none, as it was.
    pub engage: Option<bool>,
}

/// A line as it is written. What it has besides is not looked at: trackers say much that is not needed here.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(default)]
struct Line {
    #[serde(skip_serializing_if = "Option::is_none")]
    t: Option<f64>,
    #[serde(flatten)]
    point: Point,
    #[serde(skip_serializing_if = "Option::is_none")]
    grip: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    engage: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    joints: Option<BTreeMap<String, Option<Joint>>>,
}

#[derive(Debug, Default, Clone, Serialize, Deserialize)]
#[serde(default)]
struct Point {
    #[serde(skip_serializing_if = "Option::is_none")]
    x: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    y: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    z: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    qw: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    qx: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    qy: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    qz: Option<f64>,
}

/// A joint: `[x, y, z]`, `[x, y, z, qw, qx, qy, qz]`, or the same by name.
#[derive(Debug, Serialize, Deserialize)]
#[serde(untagged)]
enum Joint {
    Numbers(Vec<f64>),
    Named(Point),
}

impl Joint {
    fn point(&self) -> Result<Point, Fault> {
        match self {
            Self::Named(point) => Ok(point.clone()),
            Self::Numbers(numbers) => {
                let mut point = Point::default();
                let (place, turn) = match numbers[..] {
                    [x, y, z] => ([x, y, z], None),
                    [x, y, z, qw, qx, qy, qz] => ([x, y, z], Some([qw, qx, qy, qz])),
                    _ => {
                        return Err(Fault::new(
                            Kind::Malformed,
                            format!("a joint of {} numbers: write 3 or 7", numbers.len()),
                        ));
                    }
                };
                [point.x, point.y, point.z] = place.map(Some);
                if let Some(turn) = turn {
                    [point.qw, point.qx, point.qy, point.qz] = turn.map(Some);
                }
                Ok(point)
            }
        }
    }
}

impl Point {
    /// Position and orientation in m; `None` if there is nothing of them.
    fn place(&self, metres: f64) -> Result<Option<Place>, Fault> {
        let malformed = |why: &str| Fault::new(Kind::Malformed, why);
        let position = match (self.x, self.y, self.z) {
            (Some(x), Some(y), Some(z)) => Vector3::new(x, y, z) * metres,
            (None, None, None) => return Ok(None),
            _ => return Err(malformed("x, y and z belong together")),
        };
        if !position.iter().all(|v| v.abs() <= FARTHEST_M) {
            let [x, y, z] = position.into();
            return Err(Fault::new(
                Kind::NotFinite,
                format!("the hand is at {x}, {y}, {z} m; is the unit right? (--unit)"),
            ));
        }
        let orientation = match (self.qw, self.qx, self.qy, self.qz) {
            (Some(w), Some(x), Some(y), Some(z)) => {
                let q = Quaternion::new(w, x, y, z);
                let norm = q.norm();
                if !((norm - 1.0).abs() <= NORM_SLACK) {
                    let why = format!("a quaternion of length {norm} is no rotation");
                    return Err(Fault::new(Kind::NoRotation, why));
                }
                Some(UnitQuaternion::from_quaternion(q))
            }
            (None, None, None, None) => None,
            _ => return Err(malformed("qw, qx, qy and qz belong together")),
        };
        Ok(Some(Place {
            position,
            orientation,
            grip: None,
        }))
    }
}

/// The frame of a line.
///
/// # Errors
/// A [`Fault`]: why there is none.
pub fn parse(line: &[u8], units: &Units) -> Result<Frame, Fault> {
    if line.len() > LONGEST {
        return Err(oversized());
    }
    let line: Line = serde_json::from_slice(line).map_err(|e| {
        // Python writes numbers that are none by these names, and JSON has no such numbers.
        let text = String::from_utf8_lossy(line);
        let unreal = ["NaN", "Infinity"].iter().any(|name| text.contains(name));
        let kind = if unreal || e.to_string().contains("out of range") {
            Kind::NotFinite
        } else {
            Kind::Malformed
        };
        Fault::new(kind, e.to_string())
    })?;
    let t_s = line.t.map(|t| t * units.time.seconds());
    if let Some(t_s) = t_s.filter(|t_s| !(t_s.abs() <= LARGEST_T_S)) {
        let why = format!("t is {t_s} s; is its unit right? (--time-unit)");
        return Err(Fault::new(Kind::NotFinite, why));
    }
    let metres = units.length.metres();
    let mut hand = match &line.joints {
        None => line.point.place(metres)?,
        Some(joints) => {
            let joint = joints
                .iter()
                .find(|(name, _)| skeleton::same(name, &units.joint))
                .and_then(|(_, joint)| joint.as_ref());
            match joint {
                Some(joint) => joint.point()?.place(metres)?,
                None => None,
            }
        }
    };
    if let (Some(hand), Some(value)) = (&mut hand, line.grip) {
        let (closed, open) = units.grip;
        let grip = (value - closed) / (open - closed);
        if !(0.0..=1.0).contains(&grip) {
            let why = format!("grip is {value}, not from {closed} to {open} (--grip-range)");
            return Err(Fault::new(Kind::Grip, why));
        }
        hand.grip = Some(grip);
    }
    match (hand, line.engage, &line.joints) {
        (None, None, Some(_)) => Err(Fault::new(
            Kind::Untracked,
            format!("no {} among the joints", units.joint),
        )),
        (None, None, None) => Err(Fault::new(
            Kind::Malformed,
            "neither x, y, z nor joints nor engage",
        )),
        (hand, engage, _) => Ok(Frame { t_s, hand, engage }),
    }
}

pub(super) fn oversized() -> Fault {
    let why = format!("a frame of more than {LONGEST} bytes");
    Fault::new(Kind::Oversized, why)
}

/// A sample as a line, without its end, with [`Units::default`]: what [`parse`] reads back.
pub fn line(sample: &Sample, engage: Option<bool>) -> String {
    let p = &sample.position;
    let mut point = Point {
        x: Some(p.x),
        y: Some(p.y),
        z: Some(p.z),
        ..Point::default()
    };
    if let Some(q) = &sample.orientation {
        [point.qw, point.qx, point.qy, point.qz] = [q.w, q.i, q.j, q.k].map(Some);
    }
    let line = Line {
        t: Some(sample.t_s),
        point,
        grip: sample.grip,
        engage,
        joints: None,
    };
    serde_json::to_string(&line).expect("numbers and names are JSON")
}
