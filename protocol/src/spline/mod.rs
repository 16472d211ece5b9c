//! Cubic splines in time: what a checkpointed motion decodes to.
//!
//! [`BSpline`] is the C² curve of a finished motion (*play*); [`HermiteSpan`] is one span of the C¹
//! curve that grows knot by knot (*mirror*). Both answer position, velocity and acceleration, and
//! both are explicit outside their span: nothing is extrapolated.

mod banded;
mod bspline;
mod hermite;

pub(crate) use bspline::Interpolation;
pub use bspline::{BSpline, End};
pub use hermite::HermiteSpan;

use nalgebra::SVector;

/// A point of a motion with its first two time derivatives.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Jet<const D: usize> {
    /// Position, m.
    pub x: SVector<f64, D>,
    /// Velocity, m/s.
    pub v: SVector<f64, D>,
    /// Acceleration, m/s².
    pub a: SVector<f64, D>,
}

/// Why there is no spline, or no point of it.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SplineError {
    /// Fewer points than the construction needs.
    #[error("{count} points, at least {least} are needed")]
    TooFew {
        /// Points given.
        count: usize,
        /// Points needed.
        least: usize,
    },
    /// Times and values, or knots and control points, do not pair up.
    #[error("{found} values where {expected} belong")]
    CountMismatch {
        /// How many were given.
        found: usize,
        /// How many the other list asks for.
        expected: usize,
    },
    /// A time, knot or coordinate is NaN or infinite.
    #[error("value {index} is not finite")]
    NonFinite {
        /// Where.
        index: usize,
    },
    /// Times do not strictly increase, or knots decrease.
    #[error("time {index} does not come after its predecessor")]
    Unordered {
        /// The offending entry.
        index: usize,
    },
    /// The knots are finite and ordered, but too close for the arithmetic of `f64`.
    #[error("the knots are too close together to solve for the control points")]
    Singular,
    /// The query lies outside the curve.
    #[error("t = {t_s} s is outside [{start_s}, {end_s}] s")]
    OutOfSpan {
        /// The query, s.
        t_s: f64,
        /// The curve's first moment, s.
        start_s: f64,
        /// The curve's last moment, s.
        end_s: f64,
    },
}
