//! A hand's path as sessions carry it: its place and, where that is asked for, its orientation.
//!
//! An orientation is a point of ℝ⁴ (w, x, y, z) near the unit sphere, read by normalising it. A path that carries
//! none has zeros there, and no bit of a message is spent on them.

use nalgebra::{SVector, UnitQuaternion, Vector3, Vector4};

use super::{PathEncoder, PathGrid, PathKnot};
use crate::checkpoint::CheckpointError;
use crate::pose;

/// Coordinates of a place (m).
const PLACE: usize = 3;

/// Coordinates of a place and an orientation.
pub const POSE: usize = 7;

/// The largest bound on an orientation, µrad: half a turn.
pub const MAX_TURN_URAD: u32 = 3_141_592;

/// A knot of a hand's path.
pub type PoseKnot = PathKnot<POSE>;

/// How exact a hand's path is, as an engagement states it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PathBounds {
    place_um: u32,
    /// 0: the path carries no orientation.
    turn_urad: u32,
}

impl PathBounds {
    /// From what an engagement says: µm, and µrad or 0.
    pub fn of_wire(place_um: u32, turn_urad: u32) -> Self {
        Self {
            place_um,
            turn_urad: turn_urad.min(MAX_TURN_URAD),
        }
    }

    /// The whole µm and µrad nearest to `place_m` (m) and `turn_rad` (rad; at least one, so that a path that is to
    /// carry orientations does).
    pub fn new(place_m: f64, turn_rad: Option<f64>) -> Self {
        // `as` saturates.
        let micro = |v: f64| (v * 1e6).round() as u32;
        Self::of_wire(micro(place_m), turn_rad.map_or(0, |v| micro(v).max(1)))
    }

    /// The bound of the place, µm.
    pub fn place_um(self) -> u32 {
        self.place_um
    }

    /// The bound of the orientation, µrad; 0 if the path carries none.
    pub fn turn_urad(self) -> u32 {
        self.turn_urad
    }

    /// The bound of the place, m.
    pub fn place_m(self) -> f64 {
        f64::from(self.place_um) * 1e-6
    }

    /// The bound of the orientation, rad, if the path carries one.
    pub fn turn_rad(self) -> Option<f64> {
        (self.turn_urad > 0).then(|| f64::from(self.turn_urad) * 1e-6)
    }

    /// The grid both ends derive: steps of half the bound in metres, and of a quarter of the angle in ℝ⁴.
    ///
    /// # Errors
    /// [`CheckpointError::Bound`], [`CheckpointError::BoundTooFine`].
    pub fn grid(self) -> Result<PathGrid<POSE>, CheckpointError> {
        // Half the angle is a distance in ℝ⁴; without one the coordinates are zero on any grid.
        let distance = self.turn_rad().map_or(1.0, |turn_rad| 0.5 * turn_rad);
        PathGrid::for_bounds(PLACE, [self.place_m(), distance])
    }

    /// An encoder of [`point`]s that keeps both promises: a curve within sin(ε/2) of a unit quaternion is, normalised,
    /// a rotation within ε of its.
    ///
    /// # Errors
    /// As [`PathBounds::grid`].
    pub fn encoder(self) -> Result<PathEncoder<POSE>, CheckpointError> {
        let chord = self.turn_rad().map_or(1.0, |rad| libm::sin(0.5 * rad));
        Ok(PathEncoder::on(
            self.grid()?,
            PLACE,
            [self.place_m(), chord],
        ))
    }
}

/// A sample of the path; `q` without a change of sign between neighbours ([`pose::point`]), zeros if it carries none.
pub fn point(x: &Vector3<f64>, q: &Vector4<f64>) -> SVector<f64, POSE> {
    SVector::from_iterator(x.iter().chain(q.iter()).copied())
}

/// The place in a point of the path, m.
pub fn place(point: &SVector<f64, POSE>) -> Vector3<f64> {
    point.fixed_rows::<PLACE>(0).into_owned()
}

/// The orientation in a point of the path; `None` if the path carries none, or passes too near the origin there.
pub fn turn(point: &SVector<f64, POSE>) -> Option<UnitQuaternion<f64>> {
    pose::nearest(&turn_point(point))
}

/// The point of ℝ⁴ that [`turn`] normalises.
pub fn turn_point(point: &SVector<f64, POSE>) -> Vector4<f64> {
    point.fixed_rows::<{ POSE - PLACE }>(PLACE).into_owned()
}

impl From<PathKnot<PLACE>> for PoseKnot {
    /// Of a path that carries no orientation.
    fn from(knot: PathKnot<PLACE>) -> Self {
        let wide = |n: [i32; PLACE]| [n[0], n[1], n[2], 0, 0, 0, 0];
        Self {
            tick: knot.tick,
            x: wide(knot.x),
            v: wide(knot.v),
            start: knot.start,
        }
    }
}

impl PoseKnot {
    /// The knot without its orientation.
    pub fn place(&self) -> PathKnot<PLACE> {
        let narrow = |n: [i32; POSE]| [n[0], n[1], n[2]];
        PathKnot {
            tick: self.tick,
            x: narrow(self.x),
            v: narrow(self.v),
            start: self.start,
        }
    }
}
