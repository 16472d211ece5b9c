//! Knots as bits: what the knots before lead to expect, and how far off it is.
//!
//! No choice is left to the sender. The orders of the codes follow from the knots before, at most [`CONTEXT`] of
//! them, which the receiver holds whenever it can use a block at all.

use super::super::bits::{BitReader, BitWriter, MAX_ORDER, unzigzag, zigzag};
use super::{MAX_STEPS, PathGrid, PathKnot, START_SHIFT};

/// So many knots before a block shape its codes.
pub const CONTEXT: usize = 8;

/// Orders of the codes without a past: how many knots; a start's ticks, position and tangent.
const COUNT_ORDER: u32 = 0;
const START_TICK_ORDER: u32 = 12;
const START_X_ORDER: u32 = 6;
const START_V_ORDER: u32 = 4;

/// The numbers of a joined knot: samples and the ticks they are off; then as many positions as tangents.
const TIMES: usize = 2;

/// A column's sum and count to begin with, and the count at which both are halved.
const SAMPLES: (u64, u64) = (8, 2);
const JITTER: (u64, u64) = (0, 2);
const POSITIONS: (u64, u64) = (72, 6);
const TANGENTS: (u64, u64) = (36, 6);
const MEMORY: u64 = 32;

/// Why bytes are not a block of knots.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum BlockError {
    /// The bits end before the knots do, or hold a number that is none.
    #[error("the bits of the knots end too soon")]
    Truncated,
    /// Bits are left over, or the last byte is not filled up with zeros.
    #[error("bits are left over after the knots")]
    Trailing,
    /// More knots than the message may hold.
    #[error("{count} knots, at most {limit} are allowed")]
    TooMany {
        /// What the block claims.
        count: u64,
        /// What is allowed.
        limit: usize,
    },
    /// A time, position or tangent that no knot has.
    #[error("knot {index} of the block is out of range")]
    OutOfRange {
        /// The knot, from 0.
        index: usize,
    },
    /// The time is written in a way no sender writes it.
    #[error("knot {index} of the block is not in canonical form")]
    NotCanonical {
        /// The knot, from 0.
        index: usize,
    },
}

/// What the first knot of a path, which has none before it, is relative to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Origin<const D: usize = 3> {
    /// A tick not before the knot.
    pub tick: i64,
    /// A place, in steps of the grid.
    pub x: [i32; D],
}

/// One column's past: how large its numbers are.
#[derive(Clone, Copy)]
struct Column {
    sum: u64,
    count: u64,
}

impl Column {
    fn new((sum, count): (u64, u64)) -> Self {
        Self { sum, count }
    }

    /// ⌈log₂ of three quarters of the mean⌉.
    fn order(self) -> u32 {
        (0..MAX_ORDER)
            .find(|k| 4 * (self.count << k) >= 3 * self.sum)
            .unwrap_or(MAX_ORDER)
    }

    fn learn(&mut self, number: u64) {
        self.sum += number;
        self.count += 1;
        if self.count == MEMORY {
            self.sum /= 2;
            self.count /= 2;
        }
    }
}

/// Coordinates from this one on, an orientation's, have columns of their own.
const SECOND: usize = 3;

/// The columns, and the interval of the samples, µs.
#[derive(Clone, Copy)]
struct Model {
    samples: Column,
    jitter: Column,
    positions: [Column; 2],
    tangents: [Column; 2],
    interval_us: i64,
}

fn group(d: usize) -> usize {
    usize::from(d >= SECOND)
}

fn orders(columns: &[Column; 2]) -> [u32; 2] {
    columns.map(Column::order)
}

/// A joined knot as the numbers that are written.
struct Numbers<const D: usize> {
    time: [u64; TIMES],
    x: [u64; D],
    v: [u64; D],
}

impl Model {
    fn new<const D: usize>(interval_us: u32, before: &[PathKnot<D>]) -> Self {
        let mut model = Self {
            samples: Column::new(SAMPLES),
            jitter: Column::new(JITTER),
            positions: [Column::new(POSITIONS); 2],
            tangents: [Column::new(TANGENTS); 2],
            interval_us: i64::from(interval_us.max(1)),
        };
        let recent = &before[before.len().saturating_sub(CONTEXT)..];
        for pair in recent.windows(2).filter(|pair| !pair[1].start) {
            // What does not fit cannot have been sent in a block; it teaches nothing.
            if let Some(numbers) = model.numbers(&pair[0], &pair[1]) {
                model.learn(&numbers);
            }
        }
        model
    }

    fn learn<const D: usize>(&mut self, numbers: &Numbers<D>) {
        self.samples.learn(numbers.time[0]);
        self.jitter.learn(numbers.time[1]);
        for (d, (x, v)) in numbers.x.iter().zip(&numbers.v).enumerate() {
            self.positions[group(d)].learn(*x);
            self.tangents[group(d)].learn(*v);
        }
    }

    /// How many intervals are nearest to so many ticks (10 µs), halves upwards.
    fn intervals(&self, ticks: i64) -> i64 {
        (20 * ticks + self.interval_us).div_euclid(2 * self.interval_us)
    }

    /// How many ticks are nearest to so many intervals, halves upwards.
    fn ticks(&self, intervals: i64) -> i64 {
        (intervals * self.interval_us + 5).div_euclid(10)
    }

    fn numbers<const D: usize>(&self, a: &PathKnot<D>, b: &PathKnot<D>) -> Option<Numbers<D>> {
        let ticks = span(a, b)?;
        let shift = PathGrid::<D>::slope_shift(ticks);
        let intervals = self.intervals(ticks);
        let x = expected_x(a, ticks);
        let v = expected_v(a, &b.x, ticks);
        if b.v.iter().any(|v| v % (1 << shift) != 0) {
            return None;
        }
        Some(Numbers {
            time: [intervals as u64 + 1, zigzag(ticks - self.ticks(intervals))],
            x: core::array::from_fn(|d| zigzag(i64::from(b.x[d]) - x[d])),
            v: core::array::from_fn(|d| zigzag((i64::from(b.v[d]) >> shift) - v[d])),
        })
    }
}

/// The ticks between two knots, fewer than 2³¹.
fn span<const D: usize>(a: &PathKnot<D>, b: &PathKnot<D>) -> Option<i64> {
    let ticks = b.tick.checked_sub(a.tick)?;
    (1..1 << 31).contains(&ticks).then_some(ticks)
}

/// Where the tangent leads in five eighths of the time, in steps.
fn expected_x<const D: usize>(a: &PathKnot<D>, ticks: i64) -> [i64; D] {
    let limit = i64::from(MAX_STEPS);
    core::array::from_fn(|d| {
        let ahead = (i64::from(a.v[d]) * ticks + 10_000).div_euclid(20_000);
        (i64::from(a.x[d]) + ahead).clamp(-limit, limit)
    })
}

/// The slope of the chord, in tangents' multiples at the end of such a span.
fn expected_v<const D: usize>(a: &PathKnot<D>, x: &[i32; D], ticks: i64) -> [i64; D] {
    let shift = PathGrid::<D>::slope_shift(ticks);
    let limit = i64::from(MAX_STEPS) >> shift;
    let multiple = ticks << shift;
    core::array::from_fn(|d| {
        let rise = i64::from(x[d]) - i64::from(a.x[d]);
        // 10⁵ ticks a second, 8 steps to a unit.
        (25_000 * rise + multiple)
            .div_euclid(2 * multiple)
            .clamp(-limit, limit)
    })
}

/// `knots` as bytes, given those `before` them on the path (of which the last [`CONTEXT`] count) and the interval of
/// the samples, µs; `origin` counts only if there are none before. No knots, no bytes.
///
/// `None` for knots that no block holds: out of order, more than 2³¹ ticks apart, off the lattice of tangents,
/// not a start where nothing is before, or beyond the origin.
pub fn pack<const D: usize>(
    interval_us: u32,
    origin: &Origin<D>,
    before: &[PathKnot<D>],
    knots: &[PathKnot<D>],
) -> Option<Vec<u8>> {
    let mut w = BitWriter::default();
    let mut model = Model::new(interval_us, before);
    let mut last = before.last().copied();
    if !knots.is_empty() {
        w.golomb(knots.len() as u64 - 1, COUNT_ORDER);
    }
    for knot in knots {
        match last {
            Some(a) if !knot.start => {
                let numbers = model.numbers(&a, knot)?;
                w.golomb(numbers.time[0], model.samples.order());
                w.golomb(numbers.time[1], model.jitter.order());
                let (x, v) = (orders(&model.positions), orders(&model.tangents));
                for (d, n) in numbers.x.iter().enumerate() {
                    w.golomb(*n, x[group(d)]);
                }
                for (d, n) in numbers.v.iter().enumerate() {
                    w.golomb(*n, v[group(d)]);
                }
                model.learn(&numbers);
            }
            _ if !knot.start => return None,
            last => {
                let (ticks, from) = match last {
                    Some(a) => (span(&a, knot)? - 1, a.x),
                    None => (origin.tick.checked_sub(knot.tick)?, origin.x),
                };
                if !(0..1 << 31).contains(&ticks) {
                    return None;
                }
                if last.is_some() {
                    w.golomb(0, model.samples.order());
                }
                w.golomb(ticks as u64, START_TICK_ORDER);
                for (x, from) in knot.x.iter().zip(from) {
                    w.signed(i64::from(*x) - i64::from(from), START_X_ORDER);
                }
                for v in knot.v {
                    if v % (1 << START_SHIFT) != 0 {
                        return None;
                    }
                    w.signed(i64::from(v >> START_SHIFT), START_V_ORDER);
                }
            }
        }
        last = Some(*knot);
    }
    Some(w.finish())
}

/// How many knots `bytes` claim to hold.
///
/// # Errors
/// [`BlockError::Truncated`], [`BlockError::TooMany`].
pub fn count(bytes: &[u8], limit: usize) -> Result<usize, BlockError> {
    read_count(&mut BitReader::new(bytes), bytes, limit)
}

fn read_count(r: &mut BitReader<'_>, bytes: &[u8], limit: usize) -> Result<usize, BlockError> {
    if bytes.is_empty() {
        return Ok(0);
    }
    let count = r.golomb(COUNT_ORDER).ok_or(BlockError::Truncated)? + 1;
    match usize::try_from(count) {
        Ok(count) if count <= limit => Ok(count),
        _ => Err(BlockError::TooMany { count, limit }),
    }
}

/// What [`pack`] packed, with the same interval, origin and knots before; at most `limit` knots.
///
/// # Errors
/// [`BlockError`], one variant a cause.
pub fn unpack<const D: usize>(
    interval_us: u32,
    origin: &Origin<D>,
    before: &[PathKnot<D>],
    bytes: &[u8],
    limit: usize,
) -> Result<Vec<PathKnot<D>>, BlockError> {
    let mut r = BitReader::new(bytes);
    let count = read_count(&mut r, bytes, limit)?;
    let mut model = Model::new(interval_us, before);
    let mut last = before.last().copied();
    // A knot takes more than a byte; `limit` is small.
    let mut knots = Vec::with_capacity(count.min(bytes.len()));
    for index in 0..count {
        let knot = read(&mut r, &mut model, origin, last.as_ref(), index)?;
        knots.push(knot);
        last = Some(knot);
    }
    if r.at_end() {
        Ok(knots)
    } else {
        Err(BlockError::Trailing)
    }
}

fn read<const D: usize>(
    r: &mut BitReader<'_>,
    model: &mut Model,
    origin: &Origin<D>,
    last: Option<&PathKnot<D>>,
    index: usize,
) -> Result<PathKnot<D>, BlockError> {
    let truncated = BlockError::Truncated;
    let out_of_range = BlockError::OutOfRange { index };
    let in_range = |n: i64| {
        i32::try_from(n)
            .ok()
            .filter(|n| (-MAX_STEPS..=MAX_STEPS).contains(n))
            .ok_or(BlockError::OutOfRange { index })
    };
    let symbol = match last {
        Some(_) => r.golomb(model.samples.order()).ok_or(truncated.clone())?,
        None => 0,
    };
    let (Some(a), Some(intervals)) = (last, symbol.checked_sub(1)) else {
        let ticks = r.golomb(START_TICK_ORDER).ok_or(truncated.clone())? as i64;
        if ticks >= 1 << 31 {
            return Err(out_of_range);
        }
        let (tick, from) = match last {
            Some(a) => (a.tick.checked_add(ticks + 1), a.x),
            None => (origin.tick.checked_sub(ticks), origin.x),
        };
        let (mut x, mut v) = ([0; D], [0; D]);
        for (x, from) in x.iter_mut().zip(from) {
            let off = r.signed(START_X_ORDER).ok_or(truncated.clone())?;
            *x = in_range(i64::from(from) + off)?;
        }
        for v in &mut v {
            let multiple = r.signed(START_V_ORDER).ok_or(truncated.clone())?;
            *v = in_range(multiple << START_SHIFT)?;
        }
        return Ok(PathKnot {
            tick: tick.ok_or(out_of_range)?,
            x,
            v,
            start: true,
        });
    };
    let jitter = r.golomb(model.jitter.order()).ok_or(truncated.clone())?;
    // Below 2⁴⁰.
    let intervals = intervals as i64;
    let ticks = intervals
        .checked_mul(model.interval_us)
        .filter(|us| *us < 1 << 40)
        .map(|_| model.ticks(intervals) + unzigzag(jitter))
        .filter(|ticks| (1..1 << 31).contains(ticks))
        .ok_or(out_of_range.clone())?;
    if model.intervals(ticks) != intervals {
        return Err(BlockError::NotCanonical { index });
    }
    let mut numbers = Numbers {
        time: [symbol, jitter],
        x: [0; D],
        v: [0; D],
    };
    let (mut x, mut v) = ([0; D], [0; D]);
    let order = orders(&model.positions);
    for (d, expected) in expected_x(a, ticks).into_iter().enumerate() {
        numbers.x[d] = r.golomb(order[group(d)]).ok_or(truncated.clone())?;
        x[d] = in_range(expected + unzigzag(numbers.x[d]))?;
    }
    let (order, shift) = (orders(&model.tangents), PathGrid::<D>::slope_shift(ticks));
    for (d, expected) in expected_v(a, &x, ticks).into_iter().enumerate() {
        numbers.v[d] = r.golomb(order[group(d)]).ok_or(truncated.clone())?;
        v[d] = in_range((expected + unzigzag(numbers.v[d])) << shift)?;
    }
    model.learn(&numbers);
    let tick = a.tick.checked_add(ticks).ok_or(out_of_range)?;
    Ok(PathKnot {
        tick,
        x,
        v,
        start: false,
    })
}
