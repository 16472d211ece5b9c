//! How demonstrations move, measured so that a sensor's noise is not mistaken for motion.

use nalgebra::{Matrix3, Vector3};
use telemime_protocol::skill::Stats;

use crate::demonstration::{Demonstration, Sample};

/// Half the window of a local fit, s: two frames of a Kinect on either side.
const HALF_WINDOW_S: f64 = 0.075;

/// The quantile of speed and acceleration.
const QUANTILE: f64 = 0.95;

/// Speed, acceleration, reach and bounding box of demonstrations.
///
/// At 30 Hz, 5 mm of noise make 0.2 m/s of a difference of neighbours and 11 m/s² of a second one. So
/// velocity and acceleration are those of the parabola fitted by least squares to the samples within
/// ±75 ms (five at 30 Hz: a quarter of that noise). The 95 % quantile is taken in each demonstration,
/// and of these the median, so that neither a tracking jump nor a spoilt recording decides.
pub fn statistics(demonstrations: &[Demonstration]) -> Stats {
    let mut speeds = Vec::new();
    let mut accelerations = Vec::new();
    let mut reach_m = 0.0_f64;
    let mut min = Vector3::repeat(f64::INFINITY);
    let mut max = Vector3::repeat(f64::NEG_INFINITY);
    for d in demonstrations {
        let start = d.samples()[0].position;
        for s in d.samples() {
            reach_m = reach_m.max((s.position - start).norm());
            min = min.inf(&s.position);
            max = max.sup(&s.position);
        }
        let motion: Vec<_> = local_motion(d.samples()).collect();
        speeds.push(quantile(motion.iter().map(|m| m.0).collect(), QUANTILE));
        accelerations.push(quantile(motion.iter().map(|m| m.1).collect(), QUANTILE));
    }
    Stats {
        speed95_m_s: quantile(speeds, 0.5),
        acceleration95_m_s2: quantile(accelerations, 0.5),
        reach_m,
        min,
        max,
    }
}

/// Speed (m/s) and acceleration (m/s²) at every sample, from a parabola through those around it; at
/// rates below 27 Hz the window grows to hold two on either side.
fn local_motion(samples: &[Sample]) -> impl Iterator<Item = (f64, f64)> + '_ {
    (2..samples.len().saturating_sub(2)).filter_map(|i| {
        let t_s = samples[i].t_s;
        let first = samples
            .partition_point(|s| s.t_s < t_s - HALF_WINDOW_S)
            .min(i - 2);
        let end = samples
            .partition_point(|s| s.t_s <= t_s + HALF_WINDOW_S)
            .max(i + 3);
        let mut normal = Matrix3::zeros();
        let mut right = Matrix3::zeros();
        for s in &samples[first..end] {
            let u = (s.t_s - t_s) / HALF_WINDOW_S;
            let basis = Vector3::new(1.0, u, u * u);
            normal += basis * basis.transpose();
            right += basis * (s.position - samples[i].position).transpose();
        }
        let fit = normal.cholesky()?.solve(&right);
        let speed = fit.row(1).norm() / HALF_WINDOW_S;
        let acceleration = 2.0 * fit.row(2).norm() / (HALF_WINDOW_S * HALF_WINDOW_S);
        (speed.is_finite() && acceleration.is_finite()).then_some((speed, acceleration))
    })
}

/// The quantile `q` of the values, linear between neighbours; 0 of none.
pub(super) fn quantile(mut values: Vec<f64>, q: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let Some(last) = values.len().checked_sub(1) else {
        return 0.0;
    };
    let at = q * last as f64;
    let i = at as usize;
    let (a, b) = (values[i], values[(i + 1).min(last)]);
    a + (b - a) * (at - i as f64)
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{PI, TAU};

    use rand::{RngExt, SeedableRng};
    use rand_xoshiro::Xoshiro256PlusPlus;

    use super::*;

    /// A circle of 0.5 m at 1 turn a second: 3.1 m/s, 19.7 m/s².
    fn circle(noise_m: f64, jump_every: usize) -> Stats {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(4);
        let mut noise = || (rng.random::<f64>() - 0.5) * 12.0_f64.sqrt() * noise_m;
        let samples: Vec<_> = (0..150)
            .map(|i| {
                let t_s = i as f64 / 30.0;
                let (sin, cos) = (TAU * t_s).sin_cos();
                let jump = if jump_every > 0 && i % jump_every == 7 {
                    0.5
                } else {
                    0.0
                };
                Sample::at(
                    t_s,
                    Vector3::new(0.5 * cos + noise() + jump, 0.5 * sin + noise(), noise()),
                )
            })
            .collect();
        statistics(&[Demonstration::from_samples("circle", &samples).unwrap()])
    }

    #[test]
    fn a_circle_has_its_speed_and_acceleration() {
        let s = circle(0.0, 0);
        assert!((s.speed95_m_s - PI).abs() < 0.1, "{s:?}");
        assert!((s.acceleration95_m_s2 - 19.7).abs() < 1.0, "{s:?}");
        assert!((s.reach_m - 1.0).abs() < 0.01 && (s.max.x - 0.5).abs() < 1e-9);
    }

    #[test]
    fn five_millimetres_of_noise_and_rare_jumps_change_little() {
        let s = circle(0.005, 0);
        assert!((s.speed95_m_s - PI).abs() < 0.25, "{s:?}");
        assert!((s.acceleration95_m_s2 - 19.7).abs() < 5.0, "{s:?}");
        let s = circle(0.005, 149);
        assert!((s.acceleration95_m_s2 - 19.7).abs() < 6.0, "{s:?}");
    }

    #[test]
    fn quantiles_interpolate() {
        assert_eq!(quantile(vec![3.0, 1.0, 2.0], 0.5), 2.0);
        assert_eq!(quantile(vec![0.0, 1.0], 0.95), 0.95);
        assert_eq!(quantile(vec![], 0.5), 0.0);
    }
}
