//! A plan as bits: what each coordinate is expected to be, and how far off it is.
//!
//! Nothing is chosen twice: the receiver writes what it read and compares, so a sender must take the first
//! of the cheapest rules and orders, as here.

use super::CheckpointError;
use super::bits::{BitReader, BitWriter, MAX_ORDER, best_order, golomb_bits, zigzag};
use super::plan::{Grid, MAX_POINTS, MAX_STEPS};

/// What a coordinate is expected to be, of the points before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Rule {
    /// As before.
    Hold,
    /// On the line through the last two points, in time.
    Line,
    /// Half-way between the two.
    HalfLine,
    /// As the last but one: a motion to and fro.
    Return,
}

const RULES: [Rule; 4] = [Rule::Hold, Rule::Line, Rule::HalfLine, Rule::Return];

/// Orders of the codes in the head: number of points, mantissas, rates; the order of the gaps, and of the first column.
const COUNT_ORDER: u32 = 5;
const MANTISSA_ORDER: u32 = 4;
const RATE_ORDER: u32 = 5;
const GAP_ORDER: u32 = 1;
const COLUMN_ORDER: u32 = 2;

/// Up to this rate, Hz, no two have the same tick.
const MAX_RATE_HZ: u32 = 1000;

type Point<const D: usize> = (u32, [i32; D]);

fn expected<const D: usize>(rule: Rule, points: &[Point<D>], ticks: u32, d: usize) -> i64 {
    let value = |p: &Point<D>| i64::from(p.1[d]);
    match points {
        [] => 0,
        [one] => value(one),
        [.., before, last] => {
            let step = || {
                // Fits: 2³¹ · 2³², and once more.
                let rise = i128::from(value(last) - value(before));
                let (span, ahead) = (last.0 - before.0, ticks - last.0);
                let share = if rule == Rule::HalfLine { 2 } else { 1 };
                (rise * i128::from(ahead)).div_euclid(i128::from(span) * share)
            };
            match rule {
                Rule::Hold => value(last),
                Rule::Return => value(before),
                Rule::Line | Rule::HalfLine => {
                    let limit = i128::from(MAX_STEPS);
                    (i128::from(value(last)) + step()).clamp(-limit, limit) as i64
                }
            }
        }
    }
}

/// A positive number as mantissa and power of ten, as large as it goes up to 10¹⁵.
fn mantissa(mut n: u32) -> (u32, u32) {
    let mut tens = 0;
    while n.is_multiple_of(10) && tens < 15 {
        n /= 10;
        tens += 1;
    }
    (n, tens)
}

/// For each coordinate the first of the cheapest rules, and its lowest order; in `off` how far each point but the first is
/// off what the last rule tried expects, zigzag.
fn columns<const D: usize>(points: &[Point<D>], off: &mut Vec<u64>) -> [(Rule, u32); D] {
    core::array::from_fn(|d| {
        let mut best = (u64::MAX, (Rule::Hold, 0));
        for rule in RULES {
            off.clear();
            off.extend((1..points.len()).map(|i| off_by(points, i, d, rule)));
            let (order, bits) = best_order(off);
            if bits < best.0 {
                best = (bits, (rule, order));
            }
        }
        best.1
    })
}

/// How far the point `i` is off what the rule expects, zigzag.
fn off_by<const D: usize>(points: &[Point<D>], i: usize, d: usize, rule: Rule) -> u64 {
    let (ticks, x) = &points[i];
    zigzag(i64::from(x[d]) - expected(rule, &points[..i], *ticks, d))
}

/// The tick of so many a second, µs.
fn tick_at(rate_hz: u32) -> u32 {
    (1_000_000 + rate_hz / 2) / rate_hz
}

/// The rate that a tick is written as, if there is one and that takes no more bits than its digits.
fn rate_of(tick_us: u32) -> Option<u32> {
    let rate_hz = (1_000_000 + tick_us / 2).checked_div(tick_us)?;
    let is_one = (1..=MAX_RATE_HZ).contains(&rate_hz) && tick_at(rate_hz) == tick_us;
    let (digits, _) = mantissa(tick_us);
    let short = golomb_bits(u64::from(rate_hz), RATE_ORDER)
        <= golomb_bits(u64::from(digits), MANTISSA_ORDER) + 4;
    (is_one && short).then_some(rate_hz)
}

/// The order of the first point's coordinates: that of a metre in steps.
fn first_order(step_nm: u32) -> u32 {
    (1_000_000_000 / step_nm.max(1)).max(1).ilog2()
}

/// Writes plans, one after the other into the same memory.
#[derive(Clone, Debug, Default)]
pub(super) struct Packer {
    w: BitWriter,
    numbers: Vec<u64>,
}

impl Packer {
    /// The bytes of a plan.
    pub(super) fn pack<const D: usize>(&mut self, grid: Grid, points: &[Point<D>]) -> &[u8] {
        self.write(grid, points);
        self.w.bytes()
    }

    fn write<const D: usize>(&mut self, grid: Grid, points: &[Point<D>]) {
        let Self { w, numbers } = self;
        w.clear();
        w.golomb(points.len() as u64, COUNT_ORDER);
        let number = |w: &mut BitWriter, n| {
            let (digits, tens) = mantissa(n);
            w.golomb(u64::from(digits), MANTISSA_ORDER);
            w.put(u64::from(tens), 4);
        };
        number(w, grid.step_nm());
        let rate = rate_of(grid.tick_us());
        w.put(u64::from(rate.is_some()), 1);
        match rate {
            Some(rate_hz) => w.golomb(u64::from(rate_hz), RATE_ORDER),
            None => number(w, grid.tick_us()),
        }
        let Some(first) = points.first() else {
            return;
        };
        w.golomb(u64::from(first.0), 0);
        for x in first.1 {
            w.signed(i64::from(x), first_order(grid.step_nm()));
        }
        let gap = |i: usize| u64::from(points[i].0 - points[i - 1].0 - 1);
        numbers.clear();
        numbers.extend((1..points.len()).map(gap));
        let (gap_order, _) = best_order(numbers);
        w.golomb(u64::from(gap_order), GAP_ORDER);
        let columns = columns(points, numbers);
        let mut before = None;
        for (rule, order) in columns {
            w.put(rule as u64, 2);
            match before.replace(order) {
                None => w.golomb(u64::from(order), COLUMN_ORDER),
                Some(before) => w.signed(i64::from(order) - i64::from(before), 0),
            }
        }
        for i in 1..points.len() {
            w.golomb(gap(i), gap_order);
            for (d, (rule, order)) in columns.into_iter().enumerate() {
                w.golomb(off_by(points, i, d, rule), order);
            }
        }
    }
}

pub(super) fn pack<const D: usize>(grid: Grid, points: &[Point<D>]) -> Vec<u8> {
    let mut packer = Packer::default();
    packer.write(grid, points);
    packer.w.finish()
}

/// What values cost with the rules and orders that are best for some points, and a little more for what is far off:
/// what leads to fewer bits in the end.
pub(super) struct Price<const D: usize> {
    columns: [(Rule, u32); D],
}

impl<const D: usize> Price<D> {
    pub(super) fn of(points: &[Point<D>], packer: &mut Packer) -> Self {
        Self {
            columns: columns(points, &mut packer.numbers),
        }
    }

    /// Bits of the coordinate `d` of those points whose code depends on the points `j` and `j + 1`.
    pub(super) fn around(&self, points: &[Point<D>], j: usize, d: usize) -> f64 {
        let (rule, order) = self.columns[d];
        let bits = |i: usize| {
            let off = off_by(points, i, d, rule);
            let unit = (1_u64 << order) as f64;
            golomb_bits(off, order) as f64 + 0.3 * libm::log2(1.0 + 2.0 * off as f64 / unit)
        };
        (j.max(1)..points.len().min(j + 4)).map(bits).sum()
    }
}

/// What [`pack`] packed.
pub(super) fn unpack<const D: usize>(
    bytes: &[u8],
) -> Result<(Grid, Vec<Point<D>>), CheckpointError> {
    let mut r = BitReader::new(bytes);
    let truncated = CheckpointError::Truncated;
    let count = r.golomb(COUNT_ORDER).ok_or(truncated.clone())?;
    if count > MAX_POINTS as u64 {
        return Err(CheckpointError::TooMany);
    }
    if count < 2 {
        return Err(CheckpointError::TooFew {
            count: count as usize,
            least: 2,
        });
    }
    let number = |r: &mut BitReader<'_>| {
        let digits = r.golomb(MANTISSA_ORDER)?;
        let tens = r.take(4)? as u32;
        // Too large for any grid is not a grid.
        Some(u32::try_from(digits.saturating_mul(10u64.pow(tens))).unwrap_or(0))
    };
    let step_nm = number(&mut r).ok_or(truncated.clone())?;
    let tick_us = match r.take(1).ok_or(truncated.clone())? {
        0 => number(&mut r),
        _ => r.golomb(RATE_ORDER).map(|rate_hz| {
            let rate_hz = u32::try_from(rate_hz).unwrap_or(0);
            // No rate is not a grid either.
            if (1..=MAX_RATE_HZ).contains(&rate_hz) {
                tick_at(rate_hz)
            } else {
                0
            }
        }),
    };
    let grid = Grid::new(step_nm, tick_us.ok_or(truncated.clone())?)?;
    let mut points: Vec<Point<D>> = Vec::with_capacity(count as usize);
    let in_range = |n: i64, index| {
        i32::try_from(n)
            .ok()
            .filter(|n| (-MAX_STEPS..=MAX_STEPS).contains(n))
            .ok_or(CheckpointError::OutOfRange { index })
    };
    let first = r.golomb(0).ok_or(truncated.clone())?;
    let first = u32::try_from(first).map_err(|_| CheckpointError::OutOfRange { index: 0 })?;
    let mut x = [0; D];
    for x in &mut x {
        *x = in_range(r.signed(first_order(step_nm)).ok_or(truncated.clone())?, 0)?;
    }
    points.push((first, x));
    let order = |n: Option<i64>| {
        n.and_then(|n| u32::try_from(n).ok())
            .filter(|n| *n <= MAX_ORDER)
            .ok_or(CheckpointError::Truncated)
    };
    let gap_order = order(r.golomb(GAP_ORDER).map(|n| n as i64))?;
    let mut columns = [(Rule::Hold, 0); D];
    let mut before = None;
    for column in &mut columns {
        let rule = r.take(2).ok_or(truncated.clone())? as usize;
        let this = order(match before {
            None => r.golomb(COLUMN_ORDER).map(|n| n as i64),
            Some(before) => r.signed(0).map(|n| i64::from(before) + n),
        })?;
        before = Some(this);
        *column = (RULES[rule], this);
    }
    for index in 1..count as usize {
        let gap = r.golomb(gap_order).ok_or(truncated.clone())?;
        let before = points[index - 1].0;
        let ticks = u32::try_from(u64::from(before) + gap + 1)
            .map_err(|_| CheckpointError::OutOfRange { index })?;
        for (d, (rule, order)) in columns.iter().enumerate() {
            let off = r.signed(*order).ok_or(truncated.clone())?;
            x[d] = in_range(expected(*rule, &points, ticks, d) + off, index)?;
        }
        points.push((ticks, x));
    }
    if !r.at_end() {
        return Err(CheckpointError::Trailing);
    }
    Ok((grid, points))
}
