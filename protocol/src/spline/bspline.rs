//! The C² curve of a finished motion.

use nalgebra::SVector;

use super::banded::{self, Row};
use super::{Jet, SplineError};

const DEGREE: usize = 3;

/// What an interpolating spline does where there is no neighbour left to join.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// Zero acceleration at both ends.
    Natural,
    /// The first two and the last two spans are one cubic each: exact for cubics. Three points give
    /// the parabola, two the line.
    NotAKnot,
}

/// A cubic B-spline curve in `D` dimensions over time.
///
/// Built once (which allocates), then queried without allocation by de Boor's local recurrence in a
/// fixed order of operations, so that both ends decode the same bits.
#[derive(Clone, Debug, PartialEq)]
pub struct BSpline<const D: usize> {
    knots: Vec<f64>,
    control: Vec<SVector<f64, D>>,
}

impl<const D: usize> BSpline<D> {
    /// The curve with these knots (s, non-decreasing, four more than control points) and control
    /// points (m). Its span is `knots[3] ..= knots[n]`, of positive length.
    ///
    /// # Errors
    /// [`SplineError`]: fewer than four control points, wrong count of knots, anything not finite,
    /// knots that decrease or repeat more than four times.
    pub fn new(knots: Vec<f64>, control: Vec<SVector<f64, D>>) -> Result<Self, SplineError> {
        let n = control.len();
        if n < DEGREE + 1 {
            return Err(SplineError::TooFew {
                count: n,
                least: DEGREE + 1,
            });
        }
        if knots.len() != n + DEGREE + 1 {
            return Err(SplineError::CountMismatch {
                found: knots.len(),
                expected: n + DEGREE + 1,
            });
        }
        if let Some(index) = knots.iter().position(|k| !k.is_finite()) {
            return Err(SplineError::NonFinite { index });
        }
        check_finite(&control)?;
        if let Some(i) = knots.windows(2).position(|w| w[1] < w[0]) {
            return Err(SplineError::Unordered { index: i + 1 });
        }
        if let Some(i) = (0..n).find(|&i| knots[i + DEGREE + 1] <= knots[i]) {
            return Err(SplineError::Unordered {
                index: i + DEGREE + 1,
            });
        }
        if knots[n] <= knots[DEGREE] {
            return Err(SplineError::Unordered { index: n });
        }
        Ok(Self { knots, control })
    }

    /// The cubic through the points `y[i]` (m) at the times `t[i]` (s, strictly increasing).
    ///
    /// Solves the B-spline collocation system, O(n) (de Boor, *A Practical Guide to Splines*,
    /// ch. XIII).
    ///
    /// # Errors
    /// [`SplineError`]: fewer than two points, lists of different length, anything not finite, times
    /// that do not increase.
    pub fn interpolate(t: &[f64], y: &[SVector<f64, D>], end: End) -> Result<Self, SplineError> {
        let mut interpolation = Interpolation::default();
        interpolation.through(t, y, end)?;
        Ok(interpolation.curve)
    }

    /// The clamped uniform curve on `[0, 1]` with these control points (at least four): the source
    /// publication's decoder, whose parameter is *not* time.
    ///
    /// # Errors
    /// [`SplineError::TooFew`], [`SplineError::NonFinite`].
    pub fn clamped_uniform(control: Vec<SVector<f64, D>>) -> Result<Self, SplineError> {
        let spans = control.len().saturating_sub(DEGREE);
        let inner: Vec<f64> = (1..spans).map(|i| i as f64 / spans as f64).collect();
        Self::new(clamped(0.0, &inner, 1.0), control)
    }

    /// The first and the last moment of the curve, s.
    pub fn span_s(&self) -> (f64, f64) {
        (self.knots[DEGREE], self.knots[self.control.len()])
    }

    /// The knots, s.
    pub fn knots(&self) -> &[f64] {
        &self.knots
    }

    /// The control points, m.
    pub fn control(&self) -> &[SVector<f64, D>] {
        &self.control
    }

    /// Position, velocity and acceleration at `t_s`. At a knot, what jumps is the right-hand value
    /// (at the last moment, the left-hand one).
    ///
    /// # Errors
    /// [`SplineError::OutOfSpan`], also for NaN.
    pub fn eval(&self, t_s: f64) -> Result<Jet<D>, SplineError> {
        let (start_s, end_s) = self.span_s();
        if !(start_s..=end_s).contains(&t_s) {
            return Err(SplineError::OutOfSpan {
                t_s,
                start_s,
                end_s,
            });
        }
        let j = span_of(&self.knots, self.control.len(), t_s);
        let k = &self.knots;
        let c = &self.control[j - 3..=j];
        // Control points of the derivatives on this span (de Boor, ch. X, eq. (15)).
        let slope = |hi: SVector<f64, D>, lo: SVector<f64, D>, a: usize, degree: usize| {
            (hi - lo) * (degree as f64 / (k[a + degree] - k[a]))
        };
        let d = [
            slope(c[1], c[0], j - 2, 3),
            slope(c[2], c[1], j - 1, 3),
            slope(c[3], c[2], j, 3),
        ];
        let e = [slope(d[1], d[0], j - 1, 2), slope(d[2], d[1], j, 2)];
        Ok(Jet {
            x: de_boor(k, j, t_s, [c[0], c[1], c[2], c[3]]),
            v: de_boor(k, j, t_s, d),
            a: de_boor(k, j, t_s, e),
        })
    }
}

/// [`BSpline::interpolate`] again and again in the same memory.
#[derive(Clone, Debug)]
pub(crate) struct Interpolation<const D: usize> {
    rows: Vec<Row>,
    curve: BSpline<D>,
}

impl<const D: usize> Default for Interpolation<D> {
    fn default() -> Self {
        let curve = BSpline {
            knots: Vec::new(),
            control: Vec::new(),
        };
        Self {
            rows: Vec::new(),
            curve,
        }
    }
}

impl<const D: usize> Interpolation<D> {
    /// As [`BSpline::interpolate`].
    pub(crate) fn through(
        &mut self,
        t: &[f64],
        y: &[SVector<f64, D>],
        end: End,
    ) -> Result<&BSpline<D>, SplineError> {
        let n = t.len();
        if n < 2 {
            return Err(SplineError::TooFew { count: n, least: 2 });
        }
        if y.len() != n {
            return Err(SplineError::CountMismatch {
                found: y.len(),
                expected: n,
            });
        }
        if let Some(index) = t.iter().position(|v| !v.is_finite()) {
            return Err(SplineError::NonFinite { index });
        }
        check_finite(y)?;
        if let Some(i) = t.windows(2).position(|w| w[1] <= w[0]) {
            return Err(SplineError::Unordered { index: i + 1 });
        }
        let inner = match end {
            End::NotAKnot if n == 3 => &t[1..1],
            End::NotAKnot if n > 3 => &t[2..n - 2],
            _ => &t[1..n - 1],
        };
        let Self {
            rows,
            curve: BSpline { knots, control },
        } = self;
        clamp(knots, t[0], inner, t[n - 1]);
        let count = inner.len() + DEGREE + 1;
        rows.clear();
        rows.resize(count, [0.0; 5]);
        control.clear();
        control.resize(count, SVector::zeros());
        rows[0][2] = 1.0;
        control[0] = y[0];
        rows[count - 1][2] = 1.0;
        control[count - 1] = y[n - 1];
        let mut collocate = |row: usize, i: usize| {
            let (first, weights) = basis(knots, count, t[i]);
            for (c, w) in (first..).zip(weights) {
                if w != 0.0 {
                    rows[row][c + 2 - row] = w;
                }
            }
            control[row] = y[i];
        };
        match end {
            End::NotAKnot if n > 3 => (1..n - 1).for_each(|i| collocate(i, i)),
            End::NotAKnot if n == 3 => {
                collocate(1, 1);
                rows[2] = [-1.0, 3.0, -3.0, 1.0, 0.0];
            }
            _ => {
                (1..n - 1).for_each(|i| collocate(i + 1, i));
                // Equal first-derivative control points on either side: x'' = 0.
                for row in [1, count - 2] {
                    let before = 1.0 / (knots[row + 3] - knots[row]);
                    let after = 1.0 / (knots[row + 4] - knots[row + 1]);
                    rows[row] = [0.0, -before, before + after, -after, 0.0];
                }
            }
        }
        banded::solve(rows, control).ok_or(SplineError::Singular)?;
        Ok(&self.curve)
    }
}

/// De Boor's recurrence for the `N` control points that are alive on span `j`.
fn de_boor<const D: usize, const N: usize>(
    k: &[f64],
    j: usize,
    t: f64,
    mut p: [SVector<f64, D>; N],
) -> SVector<f64, D> {
    let degree = N - 1;
    for r in 1..=degree {
        for i in (r..=degree).rev() {
            let lo = k[j - degree + i];
            let w = (t - lo) / (k[j + 1 + i - r] - lo);
            p[i] = p[i - 1] * (1.0 - w) + p[i] * w;
        }
    }
    p[degree]
}

/// The four basis functions alive at `t`, from the first one's index (Cox–de Boor recurrence).
fn basis(k: &[f64], count: usize, t: f64) -> (usize, [f64; 4]) {
    let j = span_of(k, count, t);
    let mut b = [1.0, 0.0, 0.0, 0.0];
    for degree in 1..=DEGREE {
        let mut carry = 0.0;
        for i in 0..degree {
            let (right, left) = (k[j + 1 + i] - t, t - k[j + 1 + i - degree]);
            let share = b[i] / (right + left);
            b[i] = carry + right * share;
            carry = left * share;
        }
        b[degree] = carry;
    }
    (j - DEGREE, b)
}

/// The non-empty span `[k[j], k[j+1])` that holds `t`; the last one for the last moment.
fn span_of(k: &[f64], count: usize, t: f64) -> usize {
    let at_or_before = k[..=count].partition_point(|&v| v <= t);
    if at_or_before > count {
        let end = k[count];
        k[..count].partition_point(|&v| v < end) - 1
    } else {
        at_or_before - 1
    }
}

fn clamped(start: f64, inner: &[f64], end: f64) -> Vec<f64> {
    let mut knots = Vec::with_capacity(inner.len() + 2 * (DEGREE + 1));
    clamp(&mut knots, start, inner, end);
    knots
}

fn clamp(knots: &mut Vec<f64>, start: f64, inner: &[f64], end: f64) {
    knots.clear();
    knots.extend([start; DEGREE + 1]);
    knots.extend_from_slice(inner);
    knots.extend([end; DEGREE + 1]);
}

fn check_finite<const D: usize>(points: &[SVector<f64, D>]) -> Result<(), SplineError> {
    match points.iter().position(|p| !p.iter().all(|v| v.is_finite())) {
        Some(index) => Err(SplineError::NonFinite { index }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests;
