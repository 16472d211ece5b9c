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

/// So many samples share one memory of how far they were off.
const BLOCK: usize = 16;

/// The largest error of a block of samples under some cubic, in bounds: fewer than one.
#[derive(Clone, Copy, Debug)]
struct Known<const D: usize> {
    cubic: Cubic<D>,
    worst: f64,
}

/// What is known of the span that grows from one knot.
///
/// From sample to sample the span changes little. Of every block of samples it is known how far one cubic was off;
/// where a new one differs from that by less than was left, these samples need no look.
#[derive(Clone, Debug)]
pub(super) struct Reach<const D: usize> {
    bounds: Bounds<D>,
    known: Vec<Option<Known<D>>>,
}

impl<const D: usize> Reach<D> {
    /// For spans of at most so many samples.
    pub(super) fn new(bounds: Bounds<D>, most: usize) -> Self {
        Self {
            bounds,
            known: Vec::with_capacity(most / BLOCK + 1),
        }
    }

    /// The span grows from another knot.
    pub(super) fn restart(&mut self) {
        self.known.clear();
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
        let (blocks, rest) = samples.as_chunks::<BLOCK>();
        if self.worst(&span, rest).is_none() {
            return false;
        }
        if self.known.len() < blocks.len() {
            self.known.resize(blocks.len(), None);
        }
        // The newest first: they are the ones a stretched span misses.
        for (i, block) in blocks.iter().enumerate().rev() {
            let within = [block[0].t_s, block[BLOCK - 1].t_s];
            let still = |known: &Known<D>| {
                known.worst + self.differ(&known.cubic, &cubic, within) <= 1.0 - SLACK
            };
            if self.known[i].as_ref().is_some_and(still) {
                continue;
            }
            let Some(worst) = self.worst(&span, block) else {
                return false;
            };
            self.known[i] = Some(Known { cubic, worst });
        }
        true
    }

    /// The largest error at `samples`, in bounds; `None` if one is beyond them.
    fn worst(&self, span: &HermiteSpan<D>, samples: &[Sample<D>]) -> Option<f64> {
        let mut worst = 0.0f64;
        for s in samples.iter().rev() {
            worst = worst.max(self.bounds.squared(&(span.position(s.t_s)? - s.x)));
            if !(worst <= 1.0 - 1e-12) {
                return None;
            }
        }
        Some(worst.sqrt())
    }

    /// No less than the largest distance of two cubics from one knot, in bounds, between two times: what they
    /// differ by is t²·(Δb + Δc·t), and a line is longest at an end.
    fn differ(&self, a: &Cubic<D>, b: &Cubic<D>, [start_s, end_s]: [f64; 2]) -> f64 {
        let (square, cube) = (b.b - a.b, b.c - a.c);
        let at = |t_s: f64| self.bounds.squared(&(square + cube * t_s));
        let most = at(start_s).max(at(end_s)).sqrt() * end_s * end_s;
        most * (1.0 + SLACK) + a.rounding + b.rounding
    }
}
