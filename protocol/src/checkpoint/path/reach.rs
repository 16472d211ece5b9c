//! Whether a span passes every sample within the bound, without asking every sample every time.

use nalgebra::SVector;

use super::DecodedKnot;
use crate::spline::HermiteSpan;

/// Aimed at: this much inside the bounds, for what rounding may do.
const SLACK: f64 = 1e-9;

/// A sample, in seconds since the span's first knot.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sample<const D: usize> {
    pub(super) t_s: f64,
    pub(super) x: SVector<f64, D>,
}

/// The bounds of one or two groups of coordinates, as what an error in each coordinate counts.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bounds<const D: usize> {
    first: SVector<f64, D>,
    second: SVector<f64, D>,
}

impl<const D: usize> Bounds<D> {
    pub(super) fn new(second: usize, bounds: [f64; 2]) -> Self {
        let weight = |group: usize, inside: bool| {
            let bound = bounds[group];
            if inside { 1.0 / (bound * bound) } else { 0.0 }
        };
        Self {
            first: SVector::from_fn(|d, _| weight(0, d < second)),
            second: SVector::from_fn(|d, _| weight(1, d >= second)),
        }
    }

    /// The larger of both groups' squared errors, in squared bounds.
    fn squared(&self, e: &SVector<f64, D>) -> f64 {
        let e2 = e.component_mul(e);
        self.first.dot(&e2).max(self.second.dot(&e2))
    }
}

/// A cubic from a knot as x₀ + v₀t + (b + c·t)·t².
#[derive(Clone, Copy, Debug)]
struct Cubic<const D: usize> {
    b: SVector<f64, D>,
    c: SVector<f64, D>,
    /// What rounding can make of its positions at most, in bounds.
    rounding: f64,
}

impl<const D: usize> Cubic<D> {
    fn between(from: &DecodedKnot<D>, to: &DecodedKnot<D>, bounds: &Bounds<D>) -> Self {
        let h = to.t.secs_since(from.t);
        let chord = (to.x - from.x) / h;
        let size = from.x.abs() + to.x.abs() + (from.v.abs() + to.v.abs()) * h;
        Self {
            b: (chord * 3.0 - from.v * 2.0 - to.v) / h,
            c: (from.v + to.v - chord * 2.0) / (h * h),
            rounding: 64.0 * f64::EPSILON * bounds.squared(&size).sqrt(),
        }
    }
}

/// What is known of the span that grows from one knot.
///
/// From sample to sample the span changes little. Of the last cubic that was compared with every sample it is
/// known by how much it stays inside the bound; while a new one differs from it by less, older samples need no look.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reach<const D: usize> {
    bounds: Bounds<D>,
    proven: Option<Proven<D>>,
}

#[derive(Clone, Copy, Debug)]
struct Proven<const D: usize> {
    cubic: Cubic<D>,
    samples: usize,
    until_s: f64,
    /// In bounds.
    margin: f64,
}

impl<const D: usize> Reach<D> {
    pub(super) fn new(bounds: Bounds<D>) -> Self {
        Self {
            bounds,
            proven: None,
        }
    }

    /// The span grows from another knot.
    pub(super) fn restart(&mut self) {
        self.proven = None;
    }

    /// Whether the span between two knots passes `samples`, all that lie between them, within the bounds.
    pub(super) fn holds(
        &mut self,
        from: &DecodedKnot<D>,
        to: &DecodedKnot<D>,
        samples: &[Sample<D>],
    ) -> bool {
        let h = to.t.secs_since(from.t);
        let Some(span) = HermiteSpan::new(h, [from.x, from.v], [to.x, to.v]) else {
            return false;
        };
        let cubic = Cubic::between(from, to, &self.bounds);
        let known = match &self.proven {
            Some(p) if p.samples <= samples.len() && self.differ(p, &cubic) <= p.margin => {
                p.samples
            }
            _ => 0,
        };
        let mut worst = 0.0f64;
        // The newest first: they are the ones a stretched span misses.
        for s in samples[known..].iter().rev() {
            let Some(x) = span.position(s.t_s) else {
                return false;
            };
            worst = worst.max(self.bounds.squared(&(x - s.x)));
            if !(worst <= 1.0 - 1e-12) {
                return false;
            }
        }
        if known == 0 {
            self.proven = samples.last().map(|last| Proven {
                cubic,
                samples: samples.len(),
                until_s: last.t_s,
                margin: 1.0 - SLACK - worst.sqrt() - cubic.rounding,
            });
        }
        true
    }

    /// No less than the largest distance of two cubics from one knot, in bounds, over the proven time: what they
    /// differ by is t²·(Δb + Δc·t), and a line is longest at an end.
    fn differ(&self, p: &Proven<D>, cubic: &Cubic<D>) -> f64 {
        let (b, c) = (cubic.b - p.cubic.b, cubic.c - p.cubic.c);
        let at = |t_s: f64| self.bounds.squared(&(b + c * t_s)).sqrt();
        let (h, half) = (p.until_s, 0.5 * p.until_s);
        let middle = at(half);
        let most = (at(0.0).max(middle) * half * half).max(middle.max(at(h)) * h * h);
        most * (1.0 + SLACK) + cubic.rounding
    }
}
