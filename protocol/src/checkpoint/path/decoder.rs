//! Knots in, the path out.

use std::collections::VecDeque;

use super::{CONTEXT, DecodedKnot, MAX_SPAN_S, PathError, PathGrid, PathKnot, TICK_NS};
use crate::spline::{HermiteSpan, Jet};
use crate::time::Stamp;

/// The path up to the newest knot, the oldest knots forgotten beyond a fixed number.
#[derive(Clone, Debug)]
pub struct PathDecoder<const D: usize = 3> {
    grid: PathGrid<D>,
    capacity: usize,
    knots: VecDeque<(DecodedKnot<D>, PathKnot<D>)>,
    /// Also those that are forgotten.
    appended: usize,
}

impl<const D: usize> PathDecoder<D> {
    /// An empty path that remembers the newest `capacity` knots (at least two).
    pub fn new(grid: PathGrid<D>, capacity: usize) -> Self {
        let capacity = capacity.max(2);
        Self {
            grid,
            capacity,
            knots: VecDeque::with_capacity(capacity),
            appended: 0,
        }
    }

    /// The next knot. All that was decoded before stays as it was.
    ///
    /// # Errors
    /// [`PathError`]: out of range, not after the newest knot, or continuing what is not there.
    pub fn append(&mut self, knot: &PathKnot<D>) -> Result<(), PathError> {
        let decoded = self.grid.dequantise(knot)?;
        let newest = self.knots.back().map(|(k, _)| k.t);
        let gap_ns = newest.map_or(0, |newest| decoded.t - newest);
        if let Some(newest) = newest
            && gap_ns <= 0
        {
            return Err(PathError::Unordered {
                tick: knot.tick,
                newest: newest.0 / TICK_NS,
            });
        }
        let joined = newest.is_some() && gap_ns as f64 * 1e-9 <= MAX_SPAN_S;
        if !knot.start && !joined {
            return Err(PathError::Disconnected {
                gap_ticks: gap_ns / TICK_NS,
            });
        }
        if self.knots.len() == self.capacity {
            self.knots.pop_front();
        }
        self.knots.push_back((decoded, *knot));
        self.appended += 1;
        Ok(())
    }

    /// The motion at `t`; `None` before the oldest knot, after the newest, and in a hole.
    pub fn eval(&self, t: Stamp) -> Option<Jet<D>> {
        let after = self.knots.partition_point(|(k, _)| k.t <= t);
        let (a, _) = self.knots.get(after.checked_sub(1)?)?;
        match self.knots.get(after) {
            Some((b, knot)) if !knot.start => span(a, b)?.eval(t.secs_since(a.t)),
            _ if a.t == t => self.end_of_piece(after - 1),
            _ => None,
        }
    }

    /// The stamp of the newest knot: up to it the path is complete.
    pub fn frontier(&self) -> Option<Stamp> {
        self.knots.back().map(|(k, _)| k.t)
    }

    /// The knots it remembers, oldest first.
    pub fn knots(&self) -> impl ExactSizeIterator<Item = &DecodedKnot<D>> {
        self.knots.iter().map(|(k, _)| k)
    }

    /// As [`PathDecoder::knots`], with whether the path starts afresh there.
    pub fn marked(&self) -> impl ExactSizeIterator<Item = (&DecodedKnot<D>, bool)> {
        self.knots.iter().map(|(k, knot)| (k, knot.start))
    }

    /// The knots, at most [`CONTEXT`], before the newest `count`: what a block that begins with these is read
    /// with. `None` where they are forgotten.
    pub fn before(&self, count: usize) -> Option<Vec<PathKnot<D>>> {
        let end = self.knots.len().checked_sub(count)?;
        let from = end.saturating_sub(CONTEXT);
        let whole = end - from == CONTEXT || self.appended == self.knots.len();
        let knots = || self.knots.range(from..end).map(|(_, knot)| *knot);
        whole.then(|| knots().collect())
    }

    fn end_of_piece(&self, index: usize) -> Option<Jet<D>> {
        let (b, knot) = self.knots.get(index)?;
        let before = index.checked_sub(1).and_then(|i| self.knots.get(i));
        match before {
            Some((a, _)) if !knot.start => span(a, b)?.eval(b.t.secs_since(a.t)),
            _ => Some(Jet {
                x: b.x,
                v: b.v,
                a: nalgebra::SVector::zeros(),
            }),
        }
    }
}

fn span<const D: usize>(a: &DecodedKnot<D>, b: &DecodedKnot<D>) -> Option<HermiteSpan<D>> {
    HermiteSpan::new(b.t.secs_since(a.t), [a.x, a.v], [b.x, b.v])
}
