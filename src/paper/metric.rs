//! The publication's comparison of two series.

use nalgebra::Vector2;
use serde::Serialize;
use telemime_protocol::checkpoint::select::gradient;
use telemime_protocol::spline::HermiteSpan;

/// Both series are compared at this many points.
const POINTS: usize = 70;

/// How far an estimate is from its reference, per dimension.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Scores {
    /// Mean absolute error.
    pub(super) mae: [f64; 2],
    /// Mean squared error.
    pub(super) mse: [f64; 2],
    /// 1 − squared error over the reference's squared deviation from its mean; NaN (JSON null) for a
    /// constant reference.
    pub(super) r2: [f64; 2],
}

impl Scores {
    /// Compares series of at least two samples, both evenly spread over the same time.
    pub(super) fn of(reference: &[Vector2<f64>], estimate: &[Vector2<f64>]) -> Self {
        let (reference, estimate) = (resampled(reference), resampled(estimate));
        let n = POINTS as f64;
        let error: Vec<_> = reference
            .iter()
            .zip(&estimate)
            .map(|(r, e)| r - e)
            .collect();
        let mean = reference.iter().sum::<Vector2<f64>>() / n;
        let sum = |d: usize, f: fn(f64) -> f64| error.iter().map(|e| f(e[d])).sum::<f64>();
        let spread = |d: usize| {
            reference
                .iter()
                .map(|r| (r[d] - mean[d]).powi(2))
                .sum::<f64>()
        };
        let each = |f: &dyn Fn(usize) -> f64| [f(0), f(1)];
        Self {
            mae: each(&|d| sum(d, f64::abs) / n),
            mse: each(&|d| sum(d, |e| e * e) / n),
            r2: each(&|d| match spread(d) {
                0.0 => f64::NAN,
                spread => 1.0 - sum(d, |e| e * e) / spread,
            }),
        }
    }
}

/// [`POINTS`] points of the cubic Hermite curve whose slopes are `numpy.gradient`'s.
fn resampled(y: &[Vector2<f64>]) -> Vec<Vector2<f64>> {
    let spans = y.len() - 1;
    let h = 1.0 / spans as f64;
    let slope = gradient(y, h);
    (0..POINTS)
        .map(|j| {
            let at = j as f64 / (POINTS - 1) as f64 * spans as f64;
            let i = (at as usize).min(spans - 1);
            let s = ((at - i as f64) * h).clamp(0.0, h);
            HermiteSpan::new(h, [y[i], slope[i]], [y[i + 1], slope[i + 1]])
                .and_then(|span| span.eval(s))
                .expect("s lies within a span of positive length")
                .x
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_the_publications_metric() {
        let file: serde_json::Value = serde_json::from_str(include_str!(concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/tests/vectors/paper_metric.json"
        )))
        .unwrap();
        let cases = file["cases"].as_array().unwrap();
        assert_eq!(cases.len(), 4);
        for case in cases {
            let series = |name: &str| -> Vec<Vector2<f64>> {
                let values: Vec<f64> = serde_json::from_value(case[name].clone()).unwrap();
                values.iter().map(|&v| Vector2::new(v, -2.0 * v)).collect()
            };
            let resampled = resampled(&series("estimate"));
            for (got, want) in resampled.iter().zip(series("estimate70")) {
                assert!((got - want).norm() < 1e-12);
            }
            let scores = Scores::of(&series("reference"), &series("estimate"));
            for (got, name) in [
                (scores.mae[0], "mae"),
                (scores.mse[0], "mse"),
                (scores.r2[0], "r2"),
                (scores.r2[1], "r2"),
            ] {
                let want = case[name].as_f64().unwrap();
                assert!((got - want).abs() < 1e-11, "{name}: {got} for {want}");
            }
        }
    }
}
