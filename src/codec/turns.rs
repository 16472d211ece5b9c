//! Orientations, by our codec of finished motions.

use anyhow::Context;
use nalgebra::UnitQuaternion;
use rayon::prelude::*;
use serde::Serialize;
use telemime_operator::demonstration::Demonstration;
use telemime_protocol::checkpoint;
use telemime_protocol::pose;

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
