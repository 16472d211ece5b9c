//! Orientations: by our codec of finished motions, and with the place by the live one.

use anyhow::Context;
use nalgebra::{UnitQuaternion, Vector4};
use rayon::prelude::*;
use serde::Serialize;
use telemime_operator::demonstration::Demonstration;
use telemime_protocol::checkpoint;
use telemime_protocol::checkpoint::path::{
    PathBounds, PathDecoder, TICK_NS, pose as on_path, tick_of,
};
use telemime_protocol::pose;
use telemime_protocol::time::Stamp;

use super::coders::live_bytes;

/// What the recordings that have an orientation come to.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct TurnRow {
    pub(super) recordings: usize,
    pub(super) bound_rad: f64,
    pub(super) points: usize,
    pub(super) bytes: usize,
    pub(super) bytes_per_s: f64,
    pub(super) largest_error_rad: f64,
    pub(super) rms_error_rad: f64,
}

/// Place and orientation together, live.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub(super) struct PoseRow {
    pub(super) recordings: usize,
    pub(super) knots: usize,
    /// In one block, as by the stream.
    pub(super) bytes: usize,
    /// In a block for every two knots, about as motions bring them.
    pub(super) bytes_in_twos: usize,
    /// What the samples take as eight `f32` each.
    pub(super) raw_bytes: usize,
    pub(super) duration_s: f64,
    pub(super) largest_error_m: f64,
    pub(super) largest_error_rad: f64,
}

/// Codes every recording that has an orientation as a hand that is followed; `None` without any.
///
/// # Errors
/// A recording is refused.
pub(super) fn live(of: &[Demonstration], bounds: PathBounds) -> anyhow::Result<Option<PoseRow>> {
    let coded = of
        .par_iter()
        .filter(|d| d.has_orientation())
        .map(|d| one_live(d, bounds).with_context(|| d.path().display().to_string()))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let sum = |a: PoseRow, b: PoseRow| PoseRow {
        recordings: a.recordings + b.recordings,
        knots: a.knots + b.knots,
        bytes: a.bytes + b.bytes,
        bytes_in_twos: a.bytes_in_twos + b.bytes_in_twos,
        raw_bytes: a.raw_bytes + b.raw_bytes,
        duration_s: a.duration_s + b.duration_s,
        largest_error_m: a.largest_error_m.max(b.largest_error_m),
        largest_error_rad: a.largest_error_rad.max(b.largest_error_rad),
    };
    Ok(coded.into_iter().reduce(sum))
}

fn one_live(of: &Demonstration, bounds: PathBounds) -> anyhow::Result<PoseRow> {
    let mut encoder = bounds.encoder()?;
    let mut decoder = PathDecoder::new(encoder.grid(), of.samples().len() + 2);
    let (mut knots, mut turned) = (Vec::new(), None::<Vector4<f64>>);
    for s in of.samples() {
        let q = s.orientation.context("a sample without its orientation")?;
        let q = pose::point(&q, turned.as_ref());
        turned = Some(q);
        let point = on_path::point(&s.position, &q);
        knots.extend(encoder.push(Stamp::from_secs_f64(s.t_s), point)?);
    }
    knots.extend(encoder.flush());
    knots.iter().try_for_each(|k| decoder.append(k))?;
    let t: Vec<f64> = of.samples().iter().map(|s| s.t_s).collect();
    let (bytes, bytes_in_twos) = live_bytes(&t, &knots)?;
    let mut row = PoseRow {
        recordings: 1,
        knots: knots.len(),
        bytes,
        bytes_in_twos,
        raw_bytes: 32 * t.len(),
        duration_s: of.duration_s(),
        ..PoseRow::default()
    };
    for s in of.samples() {
        let on_tick = Stamp(tick_of(Stamp::from_secs_f64(s.t_s)) * TICK_NS);
        let at = decoder.eval(on_tick).context("a sample in a hole")?.x;
        let turn = on_path::turn(&at).context("the orientation's curve meets the origin")?;
        let error_m = (on_path::place(&at) - s.position).norm();
        row.largest_error_m = row.largest_error_m.max(error_m);
        let error_rad = s.orientation.map_or(0.0, |q| turn.angle_to(&q));
        row.largest_error_rad = row.largest_error_rad.max(error_rad);
    }
    Ok(row)
}

struct Coded {
    points: usize,
    bytes: usize,
    errors: Vec<f64>,
    duration_s: f64,
}

/// Codes every orientation there is; `None` without any.
///
/// # Errors
/// A recording is refused.
pub(super) fn code(of: &[Demonstration], bound_rad: f64) -> anyhow::Result<Option<TurnRow>> {
    let coded = of
        .par_iter()
        .filter(|d| d.has_orientation())
        .map(|d| one(d, bound_rad).with_context(|| d.path().display().to_string()))
        .collect::<anyhow::Result<Vec<_>>>()?;
    if coded.is_empty() {
        return Ok(None);
    }
    let errors = || coded.iter().flat_map(|c| &c.errors);
    let bytes = coded.iter().map(|c| c.bytes).sum::<usize>();
    Ok(Some(TurnRow {
        recordings: coded.len(),
        bound_rad,
        points: coded.iter().map(|c| c.points).sum(),
        bytes,
        bytes_per_s: bytes as f64 / coded.iter().map(|c| c.duration_s).sum::<f64>(),
        largest_error_rad: errors().copied().fold(0.0, f64::max),
        rms_error_rad: (errors().map(|e| e * e).sum::<f64>() / errors().count() as f64).sqrt(),
    }))
}

fn one(of: &Demonstration, bound_rad: f64) -> anyhow::Result<Coded> {
    let (t, q): (Vec<f64>, Vec<UnitQuaternion<f64>>) = of
        .samples()
        .iter()
        .filter_map(|s| Some((s.t_s, s.orientation?)))
        .unzip();
    let plan = checkpoint::turns(&t, &q, bound_rad)?;
    let curve = plan.spline()?;
    let (start_s, end_s) = curve.span_s();
    let errors = t
        .iter()
        .zip(&q)
        .map(|(t, q)| {
            let at = curve.eval(t.clamp(start_s, end_s))?.x;
            let decoded = pose::nearest(&at).context("the orientation's curve meets the origin")?;
            Ok(decoded.angle_to(q))
        })
        .collect::<anyhow::Result<_>>()?;
    Ok(Coded {
        points: plan.len(),
        bytes: plan.byte_len(),
        errors,
        duration_s: of.duration_s(),
    })
}
