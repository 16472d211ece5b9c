//! The source publication's own rule.

use nalgebra::SVector;

use super::super::CheckpointError;

/// The derivative of evenly spaced samples: central differences inside, one-sided at the ends
/// (`numpy.gradient`). Fewer than two samples have none: zeros.
pub fn gradient<const D: usize>(y: &[SVector<f64, D>], dt_s: f64) -> Vec<SVector<f64, D>> {
    let n = y.len();
    if n < 2 {
        return vec![SVector::zeros(); n];
    }
    (0..n)
        .map(|i| match i {
            0 => (y[1] - y[0]) / dt_s,
            _ if i == n - 1 => (y[i] - y[i - 1]) / dt_s,
            _ => (y[i + 1] - y[i - 1]) / (2.0 * dt_s),
        })
        .collect()
}

/// The publication's Laplacian rule: which indices it keeps.
///
/// `L = |∇(∇y)|`. Index 0 is kept; then, walking over *all* samples, one is kept where `L` exceeds
/// `threshold` (m/s²) or where more than `max_skip` · n samples in a row were not; the last is
/// appended. As published, the first and the last index may appear twice.
///
/// # Errors
/// [`CheckpointError`]: fewer than two samples, a sample that is not finite, or a parameter that is not
/// a finite number above zero.
pub fn publication<const D: usize>(
    y: &[SVector<f64, D>],
    dt_s: f64,
    threshold: f64,
    max_skip: f64,
) -> Result<Vec<usize>, CheckpointError> {
    let parameters = [
        ("dt_s", dt_s),
        ("threshold", threshold),
        ("max_skip", max_skip),
    ];
    for (name, value) in parameters {
        if !(value > 0.0 && value.is_finite()) {
            return Err(CheckpointError::Rule { name, value });
        }
    }
    let n = y.len();
    if n < 2 {
        return Err(CheckpointError::TooFew { count: n, least: 2 });
    }
    if let Some(index) = y.iter().position(|p| !p.iter().all(|v| v.is_finite())) {
        return Err(CheckpointError::NonFinite { index });
    }
    let laplacian = gradient(&gradient(y, dt_s), dt_s);
    let longest = max_skip * n as f64;
    let mut kept = vec![0];
    let mut skipped = 0;
    for (i, l) in laplacian.iter().enumerate() {
        if l.norm() > threshold || f64::from(skipped) > longest {
            kept.push(i);
            skipped = 0;
        } else {
            skipped += 1;
        }
    }
    kept.push(n - 1);
    Ok(kept)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector1;

    #[test]
    fn it_keeps_what_the_publication_keeps() {
        let file: serde_json::Value = serde_json::from_str(include_str!(concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../tests/vectors/paper_encoder.json"
        )))
        .unwrap();
        let mut checked = 0;
        for case in file["cases"].as_array().unwrap() {
            let list = |v: &serde_json::Value| {
                let values = v.as_array().unwrap().iter();
                values
                    .map(|x| Vector1::new(x.as_f64().unwrap()))
                    .collect::<Vec<_>>()
            };
            let y = list(&case["y"]);
            let second = gradient(&gradient(&y, 1.0 / 49.0), 1.0 / 49.0);
            for (a, b) in second.iter().zip(list(&case["second_gradient"])) {
                assert!((a - b).norm() < 1e-9);
            }
            for (threshold, want) in case["kept"].as_object().unwrap() {
                let want: Vec<usize> = serde_json::from_value(want.clone()).unwrap();
                let threshold: f64 = threshold.parse().unwrap();
                assert_eq!(
                    publication(&y, 1.0 / 49.0, threshold, 0.15).unwrap(),
                    want,
                    "{} at {threshold}",
                    case["name"]
                );
                checked += 1;
            }
        }
        assert_eq!(checked, 20);
    }

    #[test]
    fn unusable_parameters_are_named() {
        let y = [Vector1::new(0.0); 3];
        assert!(matches!(
            publication(&y, 0.1, f64::NAN, 0.15),
            Err(CheckpointError::Rule {
                name: "threshold",
                ..
            })
        ));
        assert!(publication(&y[..1], 0.1, 1.0, 0.15).is_err());
    }
}
