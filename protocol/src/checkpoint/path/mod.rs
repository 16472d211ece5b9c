//! A motion that is still happening, knot by knot.
//!
//! The curve is C¹, a [`HermiteSpan`](crate::spline::HermiteSpan) between any two knots: appended in
//! O(1), its past immutable. Knots arrive complete and in order (the link's business); the promise is
//! that at every sample up to the newest knot the decoded curve is within the bound of the hand, the
//! samples' stamps taken to [`TICK_NS`]. [`pack`] writes knots as bits.

mod decoder;
mod encoder;
mod packed;
pub mod pose;
mod reach;

pub use decoder::PathDecoder;
pub use encoder::PathEncoder;
pub use packed::{BlockError, CONTEXT, Origin, count, pack, unpack};
pub use pose::{MAX_TURN_URAD, POSE, PathBounds, PoseKnot};

use nalgebra::SVector;

use super::CheckpointError;
use crate::time::Stamp;

/// Knots lie on multiples of this many nanoseconds: 10 µs, 0.05 mm at 5 m/s.
pub const TICK_NS: i64 = 10_000;

/// The longest span between two knots, s.
pub const MAX_SPAN_S: f64 = 1.0;

/// Samples further apart than this, in seconds, are not joined: the path has a hole.
pub const MAX_GAP_S: f64 = 0.5;

/// Coordinates and tangents stay within ± this many steps, so that a difference of two fits an `i32`.
const MAX_STEPS: i32 = 1 << 30;

/// Tangents are in units of this many steps of their coordinate a second.
const SLOPE_STEPS: f64 = 8.0;

/// What [`PathGrid::slope_shift`] is at the start of a piece.
const START_SHIFT: u32 = 1;

/// A knot of the path, in integers of a [`PathGrid`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PathKnot<const D: usize = 3> {
    /// When, in units of [`TICK_NS`] since the session's epoch.
    pub tick: i64,
    /// Where, in steps of the grid.
    pub x: [i32; D],
    /// The tangent, in eight of these steps a second; a multiple of two to [`PathGrid::slope_shift`].
    pub v: [i32; D],
    /// Nothing joins this knot to the one before it.
    pub start: bool,
}

/// A decoded knot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DecodedKnot<const D: usize = 3> {
    /// When.
    pub t: Stamp,
    /// Where, m.
    pub x: SVector<f64, D>,
    /// The tangent, m/s.
    pub v: SVector<f64, D>,
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
///
/// The coordinates form one group, or two with a bound each: a place in metres, say, and an orientation in ℝ⁴.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PathGrid<const D: usize = 3> {
    /// The first coordinate of the second group; D if there is none.
    second: usize,
    steps: [f64; 2],
}

impl<const D: usize> PathGrid<D> {
    /// The grid for `bound_m` on the distance: positions in steps of half the bound, tangents in units of four
    /// bounds a second.
    ///
    /// # Errors
    /// [`CheckpointError::Bound`], [`CheckpointError::BoundTooFine`].
    pub fn for_bound(bound_m: f64) -> Result<Self, CheckpointError> {
        let step = step_for(bound_m)?;
        Ok(Self {
            second: D,
            steps: [step; 2],
        })
    }

    /// The same for coordinates in two groups, the second of which begins at `second`, each with a bound on its
    /// own distance.
    ///
    /// # Errors
    /// As [`PathGrid::for_bound`].
    pub fn for_bounds(second: usize, bounds: [f64; 2]) -> Result<Self, CheckpointError> {
        Ok(Self {
            second: second.min(D),
            steps: [step_for(bounds[0])?, step_for(bounds[1])?],
        })
    }

    /// Step of the positions (of the first group), m.
    pub fn step_m(self) -> f64 {
        self.steps[0]
    }

    /// Unit of the tangents (of the first group), m/s.
    pub fn slope_step_mps(self) -> f64 {
        self.step_m() * SLOPE_STEPS
    }

    /// Step of each coordinate.
    fn step(self) -> SVector<f64, D> {
        SVector::from_fn(|d, _| self.steps[usize::from(d >= self.second)])
    }

    /// At the end of a span of so many ticks, tangents are multiples of two to this: half of that moves no
    /// coordinate of the span by more than 0.6 of a step, whatever its length.
    pub fn slope_shift(span_ticks: i64) -> u32 {
        // 10⁵ ticks are a second.
        (1_000_000_000 / TICK_NS / span_ticks.max(1)).max(1).ilog2()
    }

    /// The integers nearest to a position and a tangent (m, m/s) at `t`, `after` the tick of the knot before (`None`: the
    /// start of a piece).
    ///
    /// # Errors
    /// [`PathError::NonFinite`], [`PathError::OutOfRange`]. A tangent out of range is not an error but
    /// clamped: any tangent makes a valid knot.
    pub fn quantise(
        self,
        t: Stamp,
        x: &SVector<f64, D>,
        v: &SVector<f64, D>,
        after: Option<i64>,
    ) -> Result<PathKnot<D>, PathError> {
        if !x.iter().chain(v.iter()).all(|c| c.is_finite()) {
            return Err(PathError::NonFinite);
        }
        let tick = tick_of(t);
        let shift = after.map_or(START_SHIFT, |after| {
            Self::slope_shift(tick.saturating_sub(after))
        });
        let multiple = f64::from(1_u32 << shift);
        let limit = f64::from(MAX_STEPS);
        let step = self.step();
        let (x, v) = (
            x.component_div(&step),
            v.component_div(&(step * SLOPE_STEPS * multiple)),
        );
        if x.iter().any(|c| c.abs() > limit) {
            return Err(PathError::OutOfRange);
        }
        let most = limit / multiple;
        Ok(PathKnot {
            tick,
            x: core::array::from_fn(|d| x[d].round() as i32),
            v: core::array::from_fn(|d| (v[d].clamp(-most, most).round() as i32) << shift),
            start: after.is_none(),
        })
    }

    /// What a knot stands for.
    ///
    /// # Errors
    /// [`PathError::OutOfRange`] for integers [`quantise`](Self::quantise) never makes.
    pub fn dequantise(self, knot: &PathKnot<D>) -> Result<DecodedKnot<D>, PathError> {
        let range = -MAX_STEPS..=MAX_STEPS;
        let in_range = knot.x.iter().chain(&knot.v).all(|n| range.contains(n));
        let ns = knot.tick.checked_mul(TICK_NS);
        match ns {
            Some(ns) if in_range => Ok(DecodedKnot {
                t: Stamp(ns),
                x: SVector::from(knot.x.map(f64::from)).component_mul(&self.step()),
                v: SVector::from(knot.v.map(f64::from)).component_mul(&(self.step() * SLOPE_STEPS)),
            }),
            _ => Err(PathError::OutOfRange),
        }
    }
}

/// Half of `bound`, in whole nanometres (or 10⁻⁹).
fn step_for(bound_m: f64) -> Result<f64, CheckpointError> {
    const LEAST_M: f64 = 2e-9;
    let largest_m = f64::from(u32::MAX) * LEAST_M;
    if !(bound_m > 0.0 && bound_m <= largest_m) {
        return Err(CheckpointError::Bound { bound_m, largest_m });
    }
    // One part in 10⁹ of slack, so that 2 nm is 1 step and not 0.999….
    match (bound_m / LEAST_M * (1.0 + 1e-9)) as u32 {
        0 => Err(CheckpointError::BoundTooFine {
            bound_m,
            least_m: LEAST_M,
        }),
        nm => Ok(f64::from(nm) * 1e-9),
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
