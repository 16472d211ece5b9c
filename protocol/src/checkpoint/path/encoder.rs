//! Samples in, knots out, causally.

use nalgebra::SVector;

use super::reach::{Bounds, Reach, Sample};
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
    reach: Reach<D>,
    /// The knot the open span grows from, as decoded.
    from: Option<DecodedKnot<D>>,
    /// The samples after it (without it: the one sample a new piece will start at), since `since`.
    open: Vec<Sample<D>>,
    since: Stamp,
    newest: Stamp,
    /// The knot that closes the span at the last open sample.
    close: Option<PathKnot<D>>,
}

impl<const D: usize> PathEncoder<D> {
    /// An encoder that keeps the decoded path within `bound_m` of every sample.
    ///
    /// # Errors
    /// [`CheckpointError::Bound`], [`CheckpointError::BoundTooFine`].
    pub fn new(bound_m: f64) -> Result<Self, CheckpointError> {
        Ok(Self::on(PathGrid::for_bound(bound_m)?, D, [bound_m; 2]))
    }

    /// An encoder for coordinates in two groups, the second of which begins at `second`, that keeps each group of
    /// the decoded path within its own bound.
    ///
    /// # Errors
    /// As [`PathEncoder::new`].
    pub fn with_bounds(second: usize, bounds: [f64; 2]) -> Result<Self, CheckpointError> {
        let grid = PathGrid::for_bounds(second, bounds)?;
        Ok(Self::on(grid, second, bounds))
    }

    /// On a grid that is fine enough for these bounds.
    pub(super) fn on(grid: PathGrid<D>, second: usize, bounds: [f64; 2]) -> Self {
        Self {
            grid,
            reach: Reach::new(Bounds::new(second, bounds), MAX_OPEN),
            from: None,
            open: Vec::with_capacity(MAX_OPEN),
            since: Stamp::ZERO,
            newest: Stamp::ZERO,
            close: None,
        }
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
        if self.from.is_none() && self.open.is_empty() {
            self.begin(t, x);
            return Ok(None);
        }
        if t <= self.newest {
            return Err(PathError::Unordered {
                tick,
                newest: tick_of(self.newest),
            });
        }
        let hole = t.secs_since(self.newest) > MAX_GAP_S;
        let sample = self.sample(t, x);
        let due = match (self.from, self.open.last()) {
            (None, Some(first)) => {
                let v = if hole {
                    SVector::zeros()
                } else {
                    slope(first, &sample)
                };
                let start = self.grid.quantise(self.newest, &first.x, &v, None)?;
                Some(start)
            }
            (Some(from), Some(_)) if !hole => {
                if let Some(close) = self.reach(&from, &sample, t) {
                    self.close = Some(close);
                    self.open.push(sample);
                    self.newest = t;
                    return Ok(None);
                }
                self.refined(&from, &sample).or(self.close)
            }
            _ => self.close,
        };
        self.restart(due, hole, t, x)?;
        Ok(due)
    }

    /// Closes the open span at the newest sample: the path is then complete up to it. The piece may go
    /// on with the next sample.
    pub fn flush(&mut self) -> Option<PathKnot<D>> {
        let due = match (self.from, self.open.last()) {
            (None, Some(first)) => {
                let still = SVector::zeros();
                let start = self.grid.quantise(self.newest, &first.x, &still, None);
                start.ok()
            }
            _ => self.close,
        }?;
        self.grow_from(&due).ok()?;
        Some(due)
    }

    fn sample(&self, t: Stamp, x: SVector<f64, D>) -> Sample<D> {
        Sample {
            t_s: t.secs_since(self.since),
            x,
        }
    }

    /// A new piece, at its first sample.
    fn begin(&mut self, t: Stamp, x: SVector<f64, D>) {
        self.from = None;
        self.close = None;
        self.open.clear();
        (self.since, self.newest) = (t, t);
        self.open.push(self.sample(t, x));
    }

    fn grow_from(&mut self, knot: &PathKnot<D>) -> Result<(), PathError> {
        let from = self.grid.dequantise(knot)?;
        self.from = Some(from);
        self.since = from.t;
        self.reach.restart();
        self.open.clear();
        self.close = None;
        Ok(())
    }

    /// The sample at `t` is the first after `due` (or, after a hole, the first of a new piece).
    fn restart(
        &mut self,
        due: Option<PathKnot<D>>,
        hole: bool,
        t: Stamp,
        x: SVector<f64, D>,
    ) -> Result<(), PathError> {
        if hole {
            self.begin(t, x);
            return Ok(());
        }
        if let Some(knot) = due {
            self.grow_from(&knot)?;
        }
        let sample = self.sample(t, x);
        self.open.clear();
        self.close = match self.from {
            Some(from) => self.reach(&from, &sample, t),
            None => None,
        };
        self.open.push(sample);
        self.newest = t;
        Ok(())
    }

    /// The knot at `end`, which is at `t`, that closes the span over all open samples, if there is one.
    fn reach(&mut self, from: &DecodedKnot<D>, end: &Sample<D>, t: Stamp) -> Option<PathKnot<D>> {
        if self.open.len() >= MAX_OPEN || end.t_s > MAX_SPAN_S {
            return None;
        }
        let start = Sample {
            t_s: 0.0,
            x: from.x,
        };
        // With nothing after the end to look at: the end slope of the parabola through the last three.
        let tangent = match self.open.as_slice() {
            [] => slope(&start, end),
            [.., before, last] => end_slope(before, last, end),
            [last] => end_slope(&start, last, end),
        };
        self.fit(from, self.open.len(), end, t, tangent)
    }

    /// The knot at the last open sample, its tangent chosen with a view to the sample after it.
    fn refined(&mut self, from: &DecodedKnot<D>, after: &Sample<D>) -> Option<PathKnot<D>> {
        let (end, between) = self.open.split_last()?;
        let (end, count) = (*end, between.len());
        let before = between.last().copied().unwrap_or(Sample {
            t_s: 0.0,
            x: from.x,
        });
        let (h0, h1) = (end.t_s - before.t_s, after.t_s - end.t_s);
        let tangent = (slope(&before, &end) * h1 + slope(&end, after) * h0) / (h0 + h1);
        self.fit(from, count, &end, self.newest, tangent)
    }

    /// A knot at `end`, which is at `t`, whose span from `from` passes the first `count` open samples within the
    /// bound; its tangent as near to `wish` as that allows, on the way to the one that fits best by least squares.
    fn fit(
        &mut self,
        from: &DecodedKnot<D>,
        count: usize,
        end: &Sample<D>,
        t: Stamp,
        wish: SVector<f64, D>,
    ) -> Option<PathKnot<D>> {
        let after = Some(tick_of(from.t));
        let still = SVector::zeros();
        let wished = self.grid.quantise(t, &end.x, &wish, after).ok()?;
        if self.holds(from, &wished, count) {
            return Some(wished);
        }
        let knot = self.grid.quantise(t, &end.x, &still, after).ok()?;
        let to = self.grid.dequantise(&knot).ok()?;
        let h = to.t.secs_since(from.t);
        let base = HermiteSpan::new(h, [from.x, from.v], [to.x, to.v])?;
        let (mut num, mut den) = (SVector::zeros(), 0.0);
        for s in &self.open[..count] {
            let u = s.t_s / h;
            let weight = h * u * u * (u - 1.0);
            num += (s.x - base.position(s.t_s)?) * weight;
            den += weight * weight;
        }
        let best = if den > 0.0 { num / den } else { wish };
        [0.25, 0.5, 0.75, 1.0].into_iter().find_map(|share| {
            let tangent = wish + (best - wish) * share;
            let knot = self.grid.quantise(t, &end.x, &tangent, after).ok()?;
            self.holds(from, &knot, count).then_some(knot)
        })
    }

    fn holds(&mut self, from: &DecodedKnot<D>, knot: &PathKnot<D>, count: usize) -> bool {
        let to = self.grid.dequantise(knot);
        to.is_ok_and(|to| self.reach.holds(from, &to, &self.open[..count]))
    }
}

fn slope<const D: usize>(a: &Sample<D>, b: &Sample<D>) -> SVector<f64, D> {
    (b.x - a.x) / (b.t_s - a.t_s)
}

fn end_slope<const D: usize>(a: &Sample<D>, b: &Sample<D>, c: &Sample<D>) -> SVector<f64, D> {
    let (before, last) = (slope(a, b), slope(b, c));
    let (h0, h1) = (b.t_s - a.t_s, c.t_s - b.t_s);
    last + (last - before) * (h1 / (h0 + h1))
}
