//! A plan as bits: what each coordinate is expected to be, and how far off it is.
//!
//! Nothing is chosen twice: the receiver writes what it read and compares, so a sender must take the first
//! of the cheapest rules and orders, as here.

use super::CheckpointError;
use super::bits::{BitReader, BitWriter, best_order, zigzag};
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

/// Orders of the codes in the head: number of points, mantissas, first coordinates.
const COUNT_ORDER: u32 = 5;
const MANTISSA_ORDER: u32 = 4;
const FIRST_ORDER: u32 = 10;

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

pub(super) fn pack<const D: usize>(grid: Grid, points: &[Point<D>]) -> Vec<u8> {
    let mut w = BitWriter::default();
    w.golomb(points.len() as u64, COUNT_ORDER);
    for n in [grid.step_nm(), grid.tick_us()] {
        let (digits, tens) = mantissa(n);
        w.golomb(u64::from(digits), MANTISSA_ORDER);
        w.put(u64::from(tens), 4);
    }
    let Some((first, rest)) = points.split_first() else {
        return w.finish();
    };
    w.golomb(u64::from(first.0), 0);
    for x in first.1 {
        w.signed(i64::from(x), FIRST_ORDER);
    }
    let gaps: Vec<u64> = points
        .windows(2)
        .map(|p| u64::from(p[1].0 - p[0].0 - 1))
        .collect();
    let (gap_order, _) = best_order(&gaps);
    w.put(u64::from(gap_order), 5);
    let off = |rule: Rule, d: usize| -> Vec<u64> {
        rest.iter()
            .enumerate()
            .map(|(i, p)| {
                let expected = expected(rule, &points[..=i], p.0, d);
                zigzag(i64::from(p.1[d]) - expected)
            })
            .collect()
    };
    let columns: [_; D] = core::array::from_fn(|d| {
        let tried = RULES.iter().enumerate().map(|(index, rule)| {
            let off = off(*rule, d);
            let (order, bits) = best_order(&off);
            (bits, index, order, off)
        });
        // The first of the cheapest.
        tried
            .min_by_key(|(bits, ..)| *bits)
            .unwrap_or((0, 0, 0, Vec::new()))
    });
    for (_, rule, order, _) in &columns {
        w.put(*rule as u64, 2);
        w.put(u64::from(*order), 5);
    }
    for (i, gap) in gaps.iter().enumerate() {
        w.golomb(*gap, gap_order);
        for (_, _, order, off) in &columns {
            w.golomb(off[i], *order);
        }
    }
    w.finish()
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
    let mut number = || {
        let digits = r.golomb(MANTISSA_ORDER)?;
        let tens = r.take(4)? as u32;
        // Too large for any grid is not a grid.
        Some(u32::try_from(digits.saturating_mul(10u64.pow(tens))).unwrap_or(0))
    };
    let step_nm = number().ok_or(truncated.clone())?;
    let tick_us = number().ok_or(truncated.clone())?;
    let grid = Grid::new(step_nm, tick_us)?;
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
        *x = in_range(r.signed(FIRST_ORDER).ok_or(truncated.clone())?, 0)?;
    }
    points.push((first, x));
    let gap_order = r.take(5).ok_or(truncated.clone())? as u32;
    let mut columns = [(Rule::Hold, 0); D];
    for column in &mut columns {
        let rule = r.take(2).ok_or(truncated.clone())? as usize;
        *column = (RULES[rule], r.take(5).ok_or(truncated.clone())? as u32);
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
