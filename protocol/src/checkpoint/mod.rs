//! A motion as few points: which moments to send, on what grid, and what they decode to.
//!
//! Two codecs share the idea of Laplacian checkpoints. [`Plan`] is a *finished* motion (play): chosen
//! by [`select`], decoded by one C² [`BSpline`](crate::spline::BSpline). [`path`] is a motion that is
//! still *happening* (mirror): knots appended one by one to a C¹ curve. In both the promise is checked
//! on what the receiver decodes, after quantisation.

pub(crate) mod bits;
mod packed;
pub mod path;
mod plan;
mod pose;
pub mod select;

pub use plan::{Grid, MAX_POINTS, Plan};
pub use pose::{PoseCurve, PosePlan, PosePlanError, turns};

use nalgebra::SVector;

use crate::spline::SplineError;

/// A moment of a motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Checkpoint<const D: usize> {
    /// When, in seconds since the motion's start.
    pub t_s: f64,
    /// Where, m.
    pub x: SVector<f64, D>,
}

/// Why a motion cannot be compressed, or a plan is none.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CheckpointError {
    /// The error bound is zero, negative, NaN or infinite, or beyond the coarsest grid.
    #[error("an error bound of {bound_m} m: it must be positive and at most {largest_m} m")]
    Bound {
        /// The bound asked for, m.
        bound_m: f64,
        /// The largest bound there is a grid for, m.
        largest_m: f64,
    },
    /// The bound is below what the finest grid can promise.
    #[error("an error bound of {bound_m} m is below the quantiser's {least_m} m")]
    BoundTooFine {
        /// The bound asked for, m.
        bound_m: f64,
        /// The least bound there is a grid for, m.
        least_m: f64,
    },
    /// Even with every sample kept, the decoded curve misses a sample by more than the bound.
    #[error(
        "sample {index} is missed by {error_m} m with every sample kept: samples too close in time"
    )]
    Unreachable {
        /// The sample.
        index: usize,
        /// By how much it is missed, m.
        error_m: f64,
    },
    /// The threshold, the sample interval or the largest skip of the publication's rule is unusable.
    #[error("{name} = {value} cannot be used")]
    Rule {
        /// Which parameter.
        name: &'static str,
        /// Its value.
        value: f64,
    },
    /// Fewer points than a motion needs.
    #[error("{count} points, at least {least} are needed")]
    TooFew {
        /// Points given.
        count: usize,
        /// Points needed.
        least: usize,
    },
    /// More points than a plan holds.
    #[error("more than {limit} checkpoints: loosen the bound or split the motion", limit = MAX_POINTS)]
    TooMany,
    /// Times and positions do not pair up.
    #[error("{times} times but {positions} positions")]
    CountMismatch {
        /// Times given.
        times: usize,
        /// Positions given.
        positions: usize,
    },
    /// A time or a position is NaN or infinite.
    #[error("point {index} is not finite")]
    NonFinite {
        /// The point.
        index: usize,
    },
    /// Times do not strictly increase on the grid.
    #[error("point {index} does not come after its predecessor")]
    Unordered {
        /// The point.
        index: usize,
    },
    /// A time is negative, or a time or coordinate is beyond the grid's range.
    #[error("point {index} is outside the range of the grid")]
    OutOfRange {
        /// The point.
        index: usize,
    },
    /// A plan names a grid that does not exist.
    #[error("grid of {step_nm} nm and {tick_us} us")]
    Grid {
        /// Step of the positions, nm.
        step_nm: u32,
        /// Step of the times, µs.
        tick_us: u32,
    },
    /// The bits end before the plan does, or hold a number that is none.
    #[error("the plan's bits end too soon")]
    Truncated,
    /// Bits are left over after the plan.
    #[error("bits are left over after the plan")]
    Trailing,
    /// The points have no interpolating spline.
    #[error("no curve through the points: {0}")]
    Spline(#[from] SplineError),
}

fn check_series<const D: usize>(t: &[f64], x: &[SVector<f64, D>]) -> Result<(), CheckpointError> {
    if t.len() != x.len() {
        return Err(CheckpointError::CountMismatch {
            times: t.len(),
            positions: x.len(),
        });
    }
    if t.len() < 2 {
        return Err(CheckpointError::TooFew {
            count: t.len(),
            least: 2,
        });
    }
    let finite = |i: &usize| t[*i].is_finite() && x[*i].iter().all(|v| v.is_finite());
    if let Some(index) = (0..t.len()).find(|i| !finite(i)) {
        return Err(CheckpointError::NonFinite { index });
    }
    match t.windows(2).position(|w| w[1] <= w[0]) {
        Some(i) => Err(CheckpointError::Unordered { index: i + 1 }),
        None => Ok(()),
    }
}
