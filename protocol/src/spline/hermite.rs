//! One span of the live, C¹ curve.

use nalgebra::SVector;

use super::Jet;

/// A cubic between two knots that carry position and velocity: a cubic B-spline with double knots.
///
/// Local: a knot fixes nothing but the span on either side of it, so a curve made of these is
/// appended in O(1) and its past never changes. Time is counted from the span's first knot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HermiteSpan<const D: usize> {
    duration_s: f64,
    start: [SVector<f64, D>; 2],
    end: [SVector<f64, D>; 2],
    /// x = x0 + h·(v0 u + c2 u² + c3 u³)
    c2: SVector<f64, D>,
    c3: SVector<f64, D>,
}

impl<const D: usize> HermiteSpan<D> {
    /// The span of `duration_s` between `[x, v]` and `[x, v]` (m, m/s); `None` unless the duration is
    /// positive and finite.
    pub fn new(
        duration_s: f64,
        start: [SVector<f64, D>; 2],
        end: [SVector<f64, D>; 2],
    ) -> Option<Self> {
        let [x0, v0] = start;
        let [x1, v1] = end;
        let secant = (x1 - x0) / duration_s;
        (duration_s > 0.0 && duration_s.is_finite()).then_some(Self {
            duration_s,
            start,
            end,
            c2: secant * 3.0 - v0 * 2.0 - v1,
            c3: v0 + v1 - secant * 2.0,
        })
    }

    /// How long the span lasts, s.
    pub fn duration_s(&self) -> f64 {
        self.duration_s
    }

    /// The motion `s` seconds after the span's start; `None` outside `[0, duration]`.
    pub fn eval(&self, s: f64) -> Option<Jet<D>> {
        let x = self.position(s)?;
        let (h, v0, c2, c3) = (self.duration_s, self.start[1], self.c2, self.c3);
        let u = s / h;
        Some(Jet {
            x,
            v: v0 + (c2 * 2.0 + c3 * (3.0 * u)) * u,
            a: (c2 * 2.0 + c3 * (6.0 * u)) / h,
        })
    }

    /// The position of [`HermiteSpan::eval`] alone, to the bit.
    #[inline]
    pub fn position(&self, s: f64) -> Option<SVector<f64, D>> {
        if !(0.0..=self.duration_s).contains(&s) {
            return None;
        }
        // The end is met exactly, whatever the rounding of the polynomial.
        if s == self.duration_s {
            return Some(self.end[0]);
        }
        let u = s / self.duration_s;
        let [x0, v0] = self.start;
        Some(x0 + (v0 + (self.c2 + self.c3 * u) * u) * s)
    }
}

#[cfg(test)]
mod tests {
    use super::super::BSpline;
    use super::*;

    #[test]
    fn it_is_the_bspline_with_double_knots() {
        let (h, x0, v0, x1, v1) = (
            0.4,
            SVector::from([0.1, 2.0]),
            SVector::from([3.0, -1.0]),
            SVector::from([0.7, 1.5]),
            SVector::from([0.0, 4.0]),
        );
        let span = HermiteSpan::new(h, [x0, v0], [x1, v1]).unwrap();
        let control = vec![x0, x0 + v0 * (h / 3.0), x1 - v1 * (h / 3.0), x1];
        let curve = BSpline::new(vec![0.0, 0.0, 0.0, 0.0, h, h, h, h], control).unwrap();
        for i in 0..=40 {
            let s = h * f64::from(i) / 40.0;
            let (a, b) = (span.eval(s).unwrap(), curve.eval(s).unwrap());
            assert!((a.x - b.x).norm() < 1e-14);
            assert!((a.v - b.v).norm() < 1e-13);
            assert!((a.a - b.a).norm() < 1e-11);
        }
        assert_eq!(span.eval(h).unwrap().x, x1);
    }

    #[test]
    fn nothing_outside_the_span() {
        let o = SVector::from([0.0]);
        assert!(HermiteSpan::new(0.0, [o, o], [o, o]).is_none());
        let span = HermiteSpan::new(1.0, [o, o], [o, o]).unwrap();
        assert!(span.eval(-1e-9).is_none());
        assert!(span.eval(1.0 + 1e-9).is_none());
        assert!(span.eval(f64::NAN).is_none());
    }
}
