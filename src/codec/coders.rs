//! One recording through one coder: ours, and those it is measured against.
//!
//! Every coder but the live one ends in a [`Plan`], so that all have the same entropy coding.

use anyhow::Context as _;
use nalgebra::{Vector3, Vector4};
use serde::Serialize;
use telemime_protocol::checkpoint::path::{
    self, Origin, PathDecoder, PathEncoder, PathKnot, TICK_NS, tick_of,
};
use telemime_protocol::checkpoint::{Checkpoint, CheckpointError, Grid, MAX_POINTS, Plan, select};
use telemime_protocol::spline::BSpline;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::MAX_TAIL_KNOTS;

/// What chooses the points and reads them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Coder {
    /// Ours, of a finished motion (play).
    Batch,
    /// Ours, knot by knot (mirror).
    Live,
    /// The publication's rule and its decoder: checkpoints as control points, u for time.
    Publication,
    /// The publication's rule, read in time.
    PublicationInTime,
    /// Every so many samples.
    Uniform,
    /// Ramer, Douglas and Peucker's line simplification.
    RamerDouglasPeucker,
    /// A sample where holding the last one sent misses it by more than the bound.
    DeadbandHold,
    /// A sample where the line through the last two sent misses it by more than the bound.
    DeadbandLinear,
}

impl Coder {
    pub(super) const ALL: [Self; 8] = [
        Self::Batch,
        Self::Live,
        Self::Publication,
        Self::PublicationInTime,
        Self::Uniform,
        Self::RamerDouglasPeucker,
        Self::DeadbandHold,
        Self::DeadbandLinear,
    ];

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Batch => "ours, finished (play)",
            Self::Live => "ours, live (mirror)",
            Self::Publication => "publication, its decoder",
            Self::PublicationInTime => "publication, in time",
            Self::Uniform => "uniform, spline",
            Self::RamerDouglasPeucker => "Ramer-Douglas-Peucker, spline",
            Self::DeadbandHold => "deadband, hold",
            Self::DeadbandLinear => "deadband, linear",
        }
    }
}

/// A hand's path.
#[derive(Clone, Debug)]
pub(super) struct Recording {
    pub(super) t: Vec<f64>,
    pub(super) x: Vec<Vector3<f64>>,
}

impl Recording {
    pub(super) fn duration_s(&self) -> f64 {
        self.t.last().copied().unwrap_or(0.0)
    }
}

/// A recording coded and decoded.
#[derive(Clone, Debug)]
pub(super) struct Coded {
    pub(super) points: usize,
    /// As a plan; for the live coder, as knots by the stream, in one block.
    pub(super) bytes: usize,
    /// With whole bytes for every number; for the live coder, in a block for every two knots, about as motions
    /// bring them.
    pub(super) whole_bytes: usize,
    /// One for each sample.
    pub(super) decoded: Vec<Vector3<f64>>,
}

impl Coded {
    pub(super) fn largest_m(&self, of: &Recording) -> f64 {
        let pairs = self.decoded.iter().zip(&of.x);
        pairs.map(|(a, b)| (a - b).norm()).fold(0.0, f64::max)
    }
}

/// Ours, of a finished motion.
pub(super) fn batch(of: &Recording, bound_m: f64) -> Result<Coded, CheckpointError> {
    in_time(of, &select::bounded(&of.t, &of.x, bound_m)?)
}

/// Ours, with so many points.
pub(super) fn counted(of: &Recording, count: usize) -> Result<Coded, CheckpointError> {
    in_time(of, &select::counted(&of.t, &of.x, count)?)
}

/// Ours, live.
pub(super) fn live(of: &Recording, bound_m: f64) -> anyhow::Result<Coded> {
    let mut encoder = PathEncoder::new(bound_m)?;
    let mut decoder = PathDecoder::new(encoder.grid(), of.t.len() + 2);
    let mut knots = Vec::new();
    for (t, x) in of.t.iter().zip(&of.x) {
        knots.extend(encoder.push(Stamp::from_secs_f64(*t), *x)?);
    }
    knots.extend(encoder.flush());
    knots.iter().try_for_each(|k| decoder.append(k))?;
    let decoded = of.t.iter().zip(&of.x).map(|(t, x)| {
        let on_tick = Stamp(tick_of(Stamp::from_secs_f64(*t)) * TICK_NS);
        // NaN shows in the table: there is no such sample.
        decoder.eval(on_tick).map_or(x * f64::NAN, |jet| jet.x)
    });
    let (bytes, whole_bytes) = live_bytes(&of.t, &knots)?;
    Ok(Coded {
        points: knots.len(),
        bytes,
        whole_bytes,
        decoded: decoded.collect(),
    })
}

/// About the knots of a hand that a message brings.
const KNOTS_A_MESSAGE: usize = 2;

/// What the knots of a hand sampled at `t` take in one block, as by the stream, and in a block for every two.
pub(super) fn live_bytes<const D: usize>(
    t: &[f64],
    knots: &[PathKnot<D>],
) -> anyhow::Result<(usize, usize)> {
    let spans = (t.len() - 1) as f64;
    let interval_us = ((t[t.len() - 1] - t[0]) / spans * 1e6).round().max(1.0) as u32;
    let bytes = |length: usize| {
        let blocks = knots.chunks(length).enumerate();
        blocks
            .map(|(i, block)| block_bytes(interval_us, &knots[..i * length], block))
            .sum::<Option<usize>>()
            .context("a knot that cannot travel")
    };
    Ok((bytes(MAX_TAIL_KNOTS)?, bytes(KNOTS_A_MESSAGE)?))
}

/// A block of knots as in the protocol's §8, with its length.
fn block_bytes<const D: usize>(
    interval_us: u32,
    before: &[PathKnot<D>],
    block: &[PathKnot<D>],
) -> Option<usize> {
    let first = block.first()?;
    let origin = Origin {
        tick: first.tick,
        x: first.x,
    };
    let bytes = path::pack(interval_us, &origin, before, block)?;
    Some(varint(bytes.len() as u64) + bytes.len())
}

fn varint(n: u64) -> usize {
    match n {
        0..251 => 1,
        251..0x1_0000 => 3,
        _ => 5,
    }
}

fn signed_varint(n: i64) -> usize {
    varint((n << 1 ^ n >> 63) as u64)
}

/// A coder of others, its points the fewer the larger `level` is: the samples a point, for the uniform one; the
/// threshold, m/s², for the publication's; else m. `None` where there is no such curve.
pub(super) fn other(coder: Coder, of: &Recording, level: f64, grid: Grid) -> Option<Coded> {
    let n = of.t.len();
    match coder {
        Coder::Batch | Coder::Live => None,
        Coder::Uniform => {
            let spans = ((n - 1) as f64 / level.max(1.0)).round().max(1.0) as usize;
            let kept: Vec<_> = (0..=spans)
                .map(|i| (i * (n - 1) + spans / 2) / spans)
                .collect();
            in_time(of, &plan(of, &kept, grid)?).ok()
        }
        Coder::RamerDouglasPeucker => in_time(of, &plan(of, &peucker(of, level), grid)?).ok(),
        Coder::PublicationInTime | Coder::Publication => {
            let dt_s = of.duration_s() / (n - 1) as f64;
            let mut kept = select::publication(&of.x, dt_s, level, 0.15).ok()?;
            kept.dedup();
            let plan = plan(of, &kept, grid)?;
            if coder == Coder::PublicationInTime {
                return in_time(of, &plan).ok();
            }
            let control = plan.checkpoints().map(|c| c.x).collect();
            let curve = BSpline::clamped_uniform(control).ok()?;
            let at = |i: usize| Some(curve.eval((i + 1) as f64 / n as f64).ok()?.x);
            coded(&plan, (0..n).map(at).collect::<Option<_>>()?).into()
        }
        Coder::DeadbandHold | Coder::DeadbandLinear => {
            deadband(of, level, grid, coder == Coder::DeadbandLinear)
        }
    }
}

fn plan(of: &Recording, kept: &[usize], grid: Grid) -> Option<Plan<3>> {
    let points = kept.iter().map(|&i| Checkpoint {
        t_s: of.t[i],
        x: of.x[i],
    });
    Plan::quantise(grid, &points.collect::<Vec<_>>()).ok()
}

fn in_time(of: &Recording, plan: &Plan<3>) -> Result<Coded, CheckpointError> {
    let curve = plan.spline()?;
    let (start_s, end_s) = curve.span_s();
    let decoded =
        of.t.iter()
            .map(|t| Ok(curve.eval(t.clamp(start_s, end_s))?.x))
            .collect::<Result<_, CheckpointError>>()?;
    Ok(coded(plan, decoded))
}

fn coded(plan: &Plan<3>, decoded: Vec<Vector3<f64>>) -> Coded {
    let (step_m, tick_s) = (plan.grid().step_m(), plan.grid().tick_s());
    let points: Vec<Vector4<f64>> = plan
        .checkpoints()
        .map(|c| (c.x / step_m).insert_row(3, c.t_s / tick_s))
        .collect();
    let mut whole_bytes = 0;
    for (i, p) in points.iter().enumerate() {
        let expected = match &points[..i] {
            [] => Vector4::zeros(),
            [one] => *one,
            [.., a, b] => b + (b - a) * ((p.w - b.w) / (b.w - a.w)),
        };
        let since = if i == 0 { p.w } else { p.w - points[i - 1].w };
        whole_bytes += varint(since.round() as u64);
        let off = |d: usize| signed_varint((p[d] - expected[d].round()).round() as i64);
        whole_bytes += (0..3).map(off).sum::<usize>();
    }
    Coded {
        points: plan.len(),
        bytes: plan.byte_len(),
        whole_bytes,
        decoded,
    }
}

/// The samples that a chord within `level_m` of all others leaves (Ramer 1972, Douglas and Peucker 1973).
fn peucker(of: &Recording, level_m: f64) -> Vec<usize> {
    let n = of.t.len();
    let mut keep = vec![false; n];
    (keep[0], keep[n - 1]) = (true, true);
    let mut open = vec![(0, n - 1)];
    while let Some((a, b)) = open.pop() {
        let chord = of.x[b] - of.x[a];
        let far = |i: &usize| {
            let off = of.x[*i] - of.x[a];
            let along = off.dot(&chord) / chord.norm_squared().max(f64::MIN_POSITIVE);
            (off - chord * along.clamp(0.0, 1.0)).norm()
        };
        let worst = (a + 1..b).max_by(|i, j| far(i).total_cmp(&far(j)));
        if let Some(i) = worst.filter(|i| far(i) > level_m) {
            keep[i] = true;
            open.extend([(a, i), (i, b)]);
        }
    }
    (0..n).filter(|&i| keep[i]).collect()
}

/// What a receiver expects, and a sample wherever that is off by more than `level_m` (Hinterseer et al. 2008, with
/// a bound in metres for the share that is perceived). Its receiver shows what it expects.
fn deadband(of: &Recording, level_m: f64, grid: Grid, linear: bool) -> Option<Coded> {
    let step_m = grid.step_m();
    let mut sent: Vec<(f64, Vector3<f64>)> = Vec::new();
    let mut points = Vec::new();
    let mut decoded = Vec::with_capacity(of.t.len());
    for (i, (&t, x)) in of.t.iter().zip(&of.x).enumerate() {
        let expected = match sent.as_slice() {
            [] => None,
            [.., a, b] if linear => Some(b.1 + (b.1 - a.1) * ((t - b.0) / (b.0 - a.0))),
            [.., b] => Some(b.1),
        };
        let fits = expected.filter(|e| (e - x).norm() <= level_m);
        decoded.push(fits.unwrap_or_else(|| {
            let on_grid = (x / step_m).map(f64::round) * step_m;
            sent.push((t, on_grid));
            points.push(i);
            on_grid
        }));
    }
    // A plan has two points; a motion that never leaves the band has one, and half its bytes.
    let alone = points.len() == 1;
    if alone {
        points.push(of.t.len() - 1);
    }
    if points.len() > MAX_POINTS {
        return None;
    }
    let mut coded = coded(&plan(of, &points, grid)?, decoded);
    coded.points -= usize::from(alone);
    Some(coded)
}
