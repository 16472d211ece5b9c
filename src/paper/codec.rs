//! From an inferred motion to checkpoints and back: the publication's way, and ours.

use nalgebra::{Vector1, Vector2};
use telemime_protocol::checkpoint::{CheckpointError, select};
use telemime_protocol::spline::{BSpline, End, SplineError};

use super::task::times;

/// The most samples the publication's rule leaves out in a row, as a share of all.
const MAX_SKIP: f64 = 0.15;

/// Our bound, as a share of x2's range.
const BOUND: f64 = 0.005;

/// A motion through a codec.
#[derive(Clone, Debug)]
pub(super) struct Coded {
    /// The checkpoints' times and positions.
    pub(super) checkpoints: Vec<(f64, Vector2<f64>)>,
    /// The decoded motion, one value for each sample that went in.
    pub(super) decoded: Vec<Vector2<f64>>,
}

/// The publication's encoder: its rule on x2. Index 0 and the last may appear twice.
pub(super) fn publication_indices(
    inferred: &[Vector2<f64>],
    threshold: f64,
) -> Result<Vec<usize>, CheckpointError> {
    let x2: Vec<_> = inferred.iter().map(|x| Vector1::new(x.y)).collect();
    let dt = 1.0 / (inferred.len() - 1) as f64;
    select::publication(&x2, dt, threshold, MAX_SKIP)
}

/// The publication's decoder: the checkpoints are *control points* of a clamped uniform B-spline, read
/// at u = (i + 1)/n.
pub(super) fn publication(
    inferred: &[Vector2<f64>],
    indices: &[usize],
) -> Result<Coded, SplineError> {
    let n = inferred.len();
    let control: Vec<_> = indices.iter().map(|&i| inferred[i]).collect();
    let curve = BSpline::clamped_uniform(control)?;
    let decoded = (1..=n)
        .map(|i| Ok(curve.eval(i as f64 / n as f64)?.x))
        .collect::<Result<_, SplineError>>()?;
    let t = times(n);
    Ok(Coded {
        checkpoints: indices.iter().map(|&i| (t[i], inferred[i])).collect(),
        decoded,
    })
}

/// These samples read as what they are, points of a motion in time: the interpolating B-spline.
pub(super) fn in_time(inferred: &[Vector2<f64>], indices: &[usize]) -> Result<Coded, SplineError> {
    let t = times(inferred.len());
    let mut indices = indices.to_vec();
    indices.dedup();
    let at: Vec<f64> = indices.iter().map(|&i| t[i]).collect();
    let x: Vec<_> = indices.iter().map(|&i| inferred[i]).collect();
    let curve = BSpline::interpolate(&at, &x, End::Natural)?;
    Ok(Coded {
        decoded: read(&curve, &t)?,
        checkpoints: at.into_iter().zip(x).collect(),
    })
}

/// `count` samples at even distances.
pub(super) fn uniform(samples: usize, count: usize) -> Vec<usize> {
    let last = samples - 1;
    let spans = count.clamp(2, samples) - 1;
    (0..=spans)
        .map(|i| (i * last + spans / 2) / spans)
        .collect()
}

/// Ours: as few quantised checkpoints as keep the decoded motion within half a per cent of x2's range
/// (returned beside it) at every sample.
pub(super) fn bounded(inferred: &[Vector2<f64>]) -> Result<(Coded, f64), CheckpointError> {
    let t = times(inferred.len());
    let (low, high) = inferred
        .iter()
        .fold((f64::MAX, f64::MIN), |(low, high), x| {
            (low.min(x.y), high.max(x.y))
        });
    let bound = BOUND * (high - low);
    let plan = select::bounded(&t, inferred, bound)?;
    let decoded = read(&plan.spline()?, &t)?;
    let checkpoints = plan.checkpoints().map(|c| (c.t_s, c.x)).collect();
    Ok((
        Coded {
            checkpoints,
            decoded,
        },
        bound,
    ))
}

fn read(curve: &BSpline<2>, t: &[f64]) -> Result<Vec<Vector2<f64>>, SplineError> {
    let (start, end) = curve.span_s();
    t.iter()
        .map(|t| Ok(curve.eval(t.clamp(start, end))?.x))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uniform_indices_are_even_and_hold_both_ends() {
        assert_eq!(uniform(50, 5), [0, 12, 25, 37, 49]);
        assert_eq!(uniform(3, 9), [0, 1, 2]);
    }
}
