//! Samples in, knots out, causally.

use nalgebra::SVector;

use super::{DecodedKnot, MAX_GAP_S, MAX_SPAN_S, PathError, PathGrid, PathKnot, TICK_NS, tick_of};
use crate::checkpoint::CheckpointError;
use crate::spline::HermiteSpan;
use crate::time::Stamp;

/// A span holds at most this many samples, so that a push does bounded work.
const MAX_OPEN: usize = 1024;

/// Chooses knots as the samples come.
///
/// The span from the newest knot is stretched from sample to sample while *some* tangent at its far
/// end keeps all samples between within the bound, checked on decoded values; when the next sample
/// cannot be reached, the knot goes to the one before. A span of two neighbours has no sample between,
/// so there is always a next knot and the bound holds by induction.
#[derive(Clone, Debug)]
pub struct PathEncoder<const D: usize = 3> {
    grid: PathGrid<D>,
    bound_m: f64,
    /// The knot the open span grows from, as decoded.
    from: Option<DecodedKnot<D>>,
    /// The samples after it (without it: the one sample a new piece will start at).
    open: Vec<Sample<D>>,
    /// The knot that closes the span at the last open sample.
    close: Option<PathKnot<D>>,
}

#[derive(Clone, Copy, Debug)]
struct Sample<const D: usize> {
    t: Stamp,
    x: SVector<f64, D>,
}

impl<const D: usize> PathEncoder<D> {
    /// An encoder that keeps the decoded path within `bound_m` of every sample.
    ///
    /// # Errors
    /// [`CheckpointError::Bound`], [`CheckpointError::BoundTooFine`].
    pub fn new(bound_m: f64) -> Result<Self, CheckpointError> {
        Ok(Self {
            grid: PathGrid::for_bound(bound_m)?,
            bound_m,
            from: None,
            open: Vec::with_capacity(MAX_OPEN),
            close: None,
        })
    }

    /// The grid its knots lie on.
    pub fn grid(&self) -> PathGrid<D> {
        self.grid
    }

    /// The stamp of the newest knot handed out, if the path goes on from it.
    pub fn frontier(&self) -> Option<Stamp> {
        self.from.map(|k| k.t)
    }

    /// The hand is at `x` (m) at `t`. At most one knot becomes due, at an *earlier* sample: look-ahead
    /// is one sample. A pause longer than [`MAX_GAP_S`] ends the piece; the next one starts afresh.
    ///
    /// # Errors
    /// [`PathError`]: the sample is dropped, the path goes on without it.
    pub fn push(&mut self, t: Stamp, x: SVector<f64, D>) -> Result<Option<PathKnot<D>>, PathError> {
        let tick = tick_of(t);
        let t = Stamp(tick * TICK_NS);
        self.grid.quantise(t, &x, &SVector::zeros(), None)?;
        let sample = Sample { t, x };
        let Some(newest) = self.newest() else {
            self.open.push(sample);
            return Ok(None);
        };
        if t <= newest {
            return Err(PathError::Unordered {
                tick,
                newest: tick_of(newest),
            });
        }
        let hole = t.secs_since(newest) > MAX_GAP_S;
        let due = match (self.from, self.open.last().copied()) {
            (None, Some(first)) => {
                let v = if hole {
                    SVector::zeros()
                } else {
                    slope(first, sample)
                };
                Some(self.grid.quantise(first.t, &first.x, &v, None)?)
            }
            (Some(from), Some(_)) if !hole => {
                if let Some(close) = self.reach(&from, sample) {
                    self.close = Some(close);
                    self.open.push(sample);
                    return Ok(None);
                }
                self.refined(&from, sample).or(self.close)
            }
            _ => self.close,
        };
        self.restart(due, hole, sample)?;
        Ok(due)
    }

    /// Closes the open span at the newest sample: the path is then complete up to it. The piece may go
    /// on with the next sample.
    pub fn flush(&mut self) -> Option<PathKnot<D>> {
        let due = match (self.from, self.open.last()) {
            (None, Some(first)) => {
                let still = SVector::zeros();
                self.grid.quantise(first.t, &first.x, &still, None).ok()
            }
            _ => self.close,
        }?;
        self.from = self.grid.dequantise(&due).ok();
        self.open.clear();
        self.close = None;
        Some(due)
    }

    fn newest(&self) -> Option<Stamp> {
        self.open
            .last()
            .map(|s| s.t)
            .or_else(|| self.from.map(|k| k.t))
    }

    /// `sample` is the first after `due` (or, after a hole, the first of a new piece).
    fn restart(
        &mut self,
        due: Option<PathKnot<D>>,
        hole: bool,
        sample: Sample<D>,
    ) -> Result<(), PathError> {
        if hole {
            self.from = None;
        } else if let Some(knot) = due {
            self.from = Some(self.grid.dequantise(&knot)?);
        }
        self.open.clear();
        self.close = match self.from {
            Some(from) => self.reach(&from, sample),
            None => None,
        };
        self.open.push(sample);
        Ok(())
    }

    /// The knot at `end` that closes the span over all open samples, if there is one.
    fn reach(&self, from: &DecodedKnot<D>, end: Sample<D>) -> Option<PathKnot<D>> {
        if self.open.len() >= MAX_OPEN || end.t.secs_since(from.t) > MAX_SPAN_S {
            return None;
        }
        let start = Sample {
            t: from.t,
            x: from.x,
        };
        // With nothing after the end to look at: the end slope of the parabola through the last three.
        let tangent = match self.open.as_slice() {
            [] => slope(start, end),
            [.., before, last] => end_slope(*before, *last, end),
            [last] => end_slope(start, *last, end),
        };
        self.fit(from, &self.open, end, tangent)
    }

    /// The knot at the last open sample, its tangent chosen with a view to the sample after it.
    fn refined(&self, from: &DecodedKnot<D>, after: Sample<D>) -> Option<PathKnot<D>> {
        let (end, between) = self.open.split_last()?;
        let before = between.last().copied().unwrap_or(Sample {
            t: from.t,
            x: from.x,
        });
        let (h0, h1) = (end.t.secs_since(before.t), after.t.secs_since(end.t));
        let tangent = (slope(before, *end) * h1 + slope(*end, after) * h0) / (h0 + h1);
        self.fit(from, between, *end, tangent)
    }

    /// A knot at `end` whose span from `from` passes all of `between` within the bound; its tangent as
    /// near to `wish` as that allows, on the way to the one that fits best by least squares.
    fn fit(
        &self,
        from: &DecodedKnot<D>,
        between: &[Sample<D>],
        end: Sample<D>,
        wish: SVector<f64, D>,
    ) -> Option<PathKnot<D>> {
        let h = end.t.secs_since(from.t);
        let after = Some(tick_of(from.t));
        let still = SVector::zeros();
        let wished = self.grid.quantise(end.t, &end.x, &wish, after).ok()?;
        if self.holds(from, &wished, between) {
            return Some(wished);
        }
        let knot = self.grid.quantise(end.t, &end.x, &still, after).ok()?;
        let base = self.span(from, &knot)?;
        let (mut num, mut den) = (SVector::zeros(), 0.0);
        for s in between {
            let t_s = s.t.secs_since(from.t);
            let u = t_s / h;
            let weight = h * u * u * (u - 1.0);
            num += (s.x - base.position(t_s)?) * weight;
            den += weight * weight;
        }
        let best = if den > 0.0 { num / den } else { wish };
        [0.25, 0.5, 0.75, 1.0].into_iter().find_map(|share| {
            let tangent = wish + (best - wish) * share;
            let knot = self.grid.quantise(end.t, &end.x, &tangent, after).ok()?;
            self.holds(from, &knot, between).then_some(knot)
        })
    }

    fn span(&self, from: &DecodedKnot<D>, knot: &PathKnot<D>) -> Option<HermiteSpan<D>> {
        let to = self.grid.dequantise(knot).ok()?;
        HermiteSpan::new(to.t.secs_since(from.t), [from.x, from.v], [to.x, to.v])
    }

    fn holds(&self, from: &DecodedKnot<D>, knot: &PathKnot<D>, between: &[Sample<D>]) -> bool {
        let limit = self.bound_m * self.bound_m * (1.0 - 1e-12);
        self.span(from, knot).is_some_and(|span| {
            // The newest first: they are the ones a stretched span misses.
            between.iter().rev().all(|s| {
                span.position(s.t.secs_since(from.t))
                    .is_some_and(|x| (x - s.x).norm_squared() <= limit)
            })
        })
    }
}

fn slope<const D: usize>(a: Sample<D>, b: Sample<D>) -> SVector<f64, D> {
    (b.x - a.x) / b.t.secs_since(a.t)
}

fn end_slope<const D: usize>(a: Sample<D>, b: Sample<D>, c: Sample<D>) -> SVector<f64, D> {
    let (before, last) = (slope(a, b), slope(b, c));
    let (h0, h1) = (b.t.secs_since(a.t), c.t.secs_since(b.t));
    last + (last - before) * (h1 / (h0 + h1))
}
