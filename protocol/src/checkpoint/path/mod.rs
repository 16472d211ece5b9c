//! A motion that is still happening, knot by knot.
//!
//! The curve is C¹, a [`HermiteSpan`](crate::spline::HermiteSpan) between any two knots: appended in
//! O(1), its past immutable. Knots arrive complete and in order (the link's business); the promise is
//! that at every sample up to the newest knot the decoded curve is within the bound of the hand, the
//! samples' stamps taken to [`TICK_NS`].

mod decoder;
mod encoder;

pub use decoder::PathDecoder;
pub use encoder::PathEncoder;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::{CheckpointError, Grid};
use crate::time::Stamp;

/// Knots lie on multiples of this many nanoseconds: 10 µs, 0.05 mm at 5 m/s.
pub const TICK_NS: i64 = 10_000;

/// The longest span between two knots, s.
pub const MAX_SPAN_S: f64 = 1.0;

/// Samples further apart than this, in seconds, are not joined: the path has a hole.
pub const MAX_GAP_S: f64 = 0.5;

/// Coordinates and tangents stay within ± this many steps, so that a difference of two fits an `i32`.
const MAX_STEPS: i32 = 1 << 30;

/// A knot of the path, in integers of a [`PathGrid`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PathKnot {
    /// When, in units of [`TICK_NS`] since the session's epoch.
    pub tick: i64,
    /// Where, in steps of [`PathGrid::step_m`].
    pub x: [i32; 3],
    /// The tangent, in steps of [`PathGrid::slope_step_mps`].
    pub v: [i32; 3],
    /// Nothing joins this knot to the one before it.
    pub start: bool,
}

/// A decoded knot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DecodedKnot {
    /// When.
    pub t: Stamp,
    /// Where, m.
    pub x: Vector3<f64>,
    /// The tangent, m/s.
    pub v: Vector3<f64>,
}

/// Why a sample or a knot was refused. The path is as it was before.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PathError {
    /// NaN or infinite.
    #[error("the sample is not finite")]
    NonFinite,
    /// Not after the newest one, on the grid of ticks.
    #[error("tick {tick} does not come after tick {newest}")]
    Unordered {
        /// The offender's tick.
        tick: i64,
        /// The newest tick so far.
        newest: i64,
    },
    /// Beyond the range of the grid, in time or in space.
    #[error("outside the range of the grid")]
    OutOfRange,
    /// A knot that continues a path further back than [`MAX_SPAN_S`], or no path at all.
    #[error("a knot that continues nothing: {gap_ticks} ticks after its predecessor")]
    Disconnected {
        /// Distance from the predecessor in ticks; 0 if there is none.
        gap_ticks: i64,
    },
}

/// The steps of positions and tangents, derived from the bound by both ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PathGrid {
    step_m: f64,
}

impl PathGrid {
    /// The grid for `bound_m`: positions in steps of a quarter of the bound, tangents in steps of four
    /// bounds a second (half a step moves a span of 0.25 s by at most 0.07 bounds).
    ///
    /// # Errors
    /// [`CheckpointError::Bound`], [`CheckpointError::BoundTooFine`].
    pub fn for_bound(bound_m: f64) -> Result<Self, CheckpointError> {
        Ok(Self {
            step_m: Grid::for_bound(bound_m)?.step_m(),
        })
    }

    /// Step of the positions, m.
    pub fn step_m(self) -> f64 {
        self.step_m
    }

    /// Step of the tangents, m/s.
    pub fn slope_step_mps(self) -> f64 {
        self.step_m * 16.0
    }

    /// The integers nearest to a position and a tangent (m, m/s) at `t`.
    ///
    /// # Errors
    /// [`PathError::NonFinite`], [`PathError::OutOfRange`]. A tangent out of range is not an error but
    /// clamped: any tangent makes a valid knot.
    pub fn quantise(
        self,
        t: Stamp,
        x: &Vector3<f64>,
        v: &Vector3<f64>,
        start: bool,
    ) -> Result<PathKnot, PathError> {
        if !x.iter().chain(v.iter()).all(|c| c.is_finite()) {
            return Err(PathError::NonFinite);
        }
        let limit = f64::from(MAX_STEPS);
        let (x, v) = (x / self.step_m, v / self.slope_step_mps());
        if x.iter().any(|c| c.abs() > limit) {
            return Err(PathError::OutOfRange);
        }
        Ok(PathKnot {
            tick: tick_of(t),
            x: core::array::from_fn(|d| x[d].round() as i32),
            v: core::array::from_fn(|d| v[d].clamp(-limit, limit).round() as i32),
            start,
        })
    }

    /// What a knot stands for.
    ///
    /// # Errors
    /// [`PathError::OutOfRange`] for integers [`quantise`](Self::quantise) never makes.
    pub fn dequantise(self, knot: &PathKnot) -> Result<DecodedKnot, PathError> {
        let range = -MAX_STEPS..=MAX_STEPS;
        let in_range = knot.x.iter().chain(&knot.v).all(|n| range.contains(n));
        let ns = knot.tick.checked_mul(TICK_NS);
        match ns {
            Some(ns) if in_range => Ok(DecodedKnot {
                t: Stamp(ns),
                x: Vector3::from(knot.x.map(f64::from)) * self.step_m,
                v: Vector3::from(knot.v.map(f64::from)) * self.slope_step_mps(),
            }),
            _ => Err(PathError::OutOfRange),
        }
    }
}

/// The tick nearest to `t`.
pub fn tick_of(t: Stamp) -> i64 {
    // Saturating half a tick short of the end keeps `tick * TICK_NS` representable.
    t.0.clamp(i64::MIN + TICK_NS, i64::MAX - TICK_NS)
        .saturating_add(TICK_NS / 2)
        .div_euclid(TICK_NS)
}

#[cfg(test)]
mod tests;
