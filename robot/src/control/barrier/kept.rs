//! What is kept apart: what a person sets.

use core::fmt;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use telemime_sim::arm::{ArmModel, Joints, SelfCollision, Unguarded};

use super::SOFT_M;

/// The most planes a workspace has.
pub const MAX_PLANES: usize = 6;

/// A half-space that the tip must stay in, and every link behind it that begins there.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Plane {
    pub(super) normal: Vector3<f64>,
    pub(super) offset_m: f64,
}

impl Plane {
    /// All points with n·x ≥ `offset_m`, base axes, m; `normal` is made unit.
    ///
    /// # Errors
    /// [`BarrierError::Plane`]: no direction, or a number that is not finite.
    pub fn new(normal: Vector3<f64>, offset_m: f64) -> Result<Self, BarrierError> {
        let unit = normal.try_normalize(1e-9).filter(|n| n.norm().is_finite());
        match unit {
            Some(normal) if offset_m.is_finite() => Ok(Self { normal, offset_m }),
            _ => Err(BarrierError::Plane {
                normal: normal.into(),
                offset_m,
            }),
        }
    }

    /// How far inside a point is, m.
    pub fn height_m(&self, p: &Vector3<f64>) -> f64 {
        self.normal.dot(p) - self.offset_m
    }
}

/// What is kept apart, and how early.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct BarrierConfig {
    /// Whether links are kept apart from each other.
    pub self_collision: bool,
    /// Two capsules never come nearer, m.
    pub stop_m: f64,
    /// Approach is slowed from this much room on, m.
    pub slow_m: f64,
    /// γ, 1/s: room never shrinks faster than by this share of it in a second.
    pub gain: f64,
    /// Planes that the tip, and the links that begin inside, stay inside of.
    pub planes: [Option<Plane>; MAX_PLANES],
}

impl Default for BarrierConfig {
    /// Links 2 cm apart, slowed within 10 cm of that, no planes.
    fn default() -> Self {
        Self {
            self_collision: true,
            stop_m: 0.02,
            slow_m: 0.1,
            gain: 10.0,
            planes: [None; MAX_PLANES],
        }
    }
}

impl BarrierConfig {
    /// The pairs of links that are kept apart, of an arm that starts at `start`: not those that are within 10 mm of the stop distance there, or nearly always.
    pub fn hulls(&self, arm: &ArmModel, start: &Joints) -> SelfCollision {
        SelfCollision::new(arm, start, self.stop_m + 2.0 * SOFT_M)
    }

    /// The same with one plane more.
    ///
    /// # Errors
    /// [`BarrierError::TooManyPlanes`].
    pub fn with_plane(mut self, plane: Plane) -> Result<Self, BarrierError> {
        let free = self.planes.iter_mut().find(|p| p.is_none());
        *free.ok_or(BarrierError::TooManyPlanes)? = Some(plane);
        Ok(self)
    }
}

/// Two links whose hulls are too near each other where the arm starts to be kept apart from there on.
#[derive(Clone, Debug, PartialEq)]
pub struct CloseAtStart {
    /// The links, the one nearer to the base first.
    pub links: [String; 2],
    /// Between their hulls, m; negative if they overlap.
    pub distance_m: f64,
}

impl CloseAtStart {
    /// Those among the `hulls` of `arm`, which [`BarrierConfig::hulls`] gave.
    pub fn among(arm: &ArmModel, hulls: &SelfCollision) -> Vec<Self> {
        let pairs = hulls.unguarded().iter();
        let close = pairs.filter_map(|&((a, b), why)| match why {
            Unguarded::AtStart { distance_m } => Some(Self {
                links: [a, b].map(|i| arm.capsules()[i].link.clone()),
                distance_m,
            }),
            Unguarded::AlwaysClose { .. } => None,
        });
        close.collect()
    }
}

impl fmt::Display for CloseAtStart {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ([a, b], mm) = (&self.links, self.distance_m * 1e3);
        write!(
            f,
            "the hulls of `{a}` and `{b}` are {mm:.0} mm apart at the start already: not guarded"
        )
    }
}

/// Why there is no such barrier.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum BarrierError {
    /// Not a plane.
    #[error("a plane with normal {normal:?} at {offset_m} m: give a direction and a place")]
    Plane {
        /// The normal given.
        normal: [f64; 3],
        /// The place given, m.
        offset_m: f64,
    },
    /// More planes than the fixed array holds.
    #[error("at most {MAX_PLANES} planes are kept")]
    TooManyPlanes,
    /// A distance or gain out of its range.
    #[error("the {what} is {value}; it must be between {least} and {most}")]
    Range {
        /// Which value.
        what: &'static str,
        /// Its value.
        value: f64,
        /// The smallest.
        least: f64,
        /// The largest.
        most: f64,
    },
    /// The arm starts on the wrong side.
    #[error(
        "at the start posture the tip is {:.3} m behind the plane n = {normal:?}, offset {offset_m} m (it must be {SOFT_M} m inside): move the plane, or give another start posture",
        -height_m
    )]
    StartsOutside {
        /// The plane's normal.
        normal: [f64; 3],
        /// Its place, m.
        offset_m: f64,
        /// How far inside the tip is, m.
        height_m: f64,
    },
}
