//! A warp of time that ascends at every step and warps no more than it must.
//!
//! Plain dynamic time warping stops the clock wherever that is free (at rests) or pays off by a hair (on noise). Here
//! every step along the reference moves on by between a quarter and four steps, and departing from proportional
//! time costs: by the squared logarithm of the pace, so that twice as fast is as far as half as fast.

use nalgebra::Vector3;

/// Positions between two points of the path.
const FINE: usize = 4;

/// The largest pace, in points of the path a point of the reference; the smallest is its inverse.
const FASTEST: usize = 4;

/// What a pace of e costs a point, as a share of the reference's mean squared distance from its centre. From a third
/// to three times this the tubes of recorded gestures are equally narrow; here the pace of generated ones, which is
/// known, comes out best, and so do channels that alignment does not see (the orientation of recorded pouring).
const STIFFNESS: f64 = 1e-2;

/// How often the quantised warp is smoothed with (1, 2, 1)/4.
const SMOOTHINGS: usize = 4;

/// For each point of `reference` the (fractional) point of `path` that belongs to it, strictly ascending from
/// the first to the last; both have the same number of points, at least two. No phase strays from proportional
/// time by more than `band` points.
pub(super) fn phases(reference: &[Vector3<f64>], path: &[Vector3<f64>], band: usize) -> Vec<f64> {
    let n = reference.len();
    let last = (n - 1) * FINE;
    let fine: Vec<_> = (0..=last)
        .map(|j| {
            let (i, part) = (j / FINE, (j % FINE) as f64 / FINE as f64);
            path[i] + (path[(i + 1).min(n - 1)] - path[i]) * part
        })
        .collect();
    let centre = reference.iter().sum::<Vector3<f64>>() / n as f64;
    let size = reference
        .iter()
        .map(|p| (p - centre).norm_squared())
        .sum::<f64>()
        / n as f64;
    // A hand that never moves has no scale: any price above nothing keeps it in proportional time.
    let size = size.max(1e-200);
    let price: Vec<f64> = (0..=FASTEST * FINE)
        .map(|step| match step {
            0 => f64::INFINITY,
            _ => STIFFNESS * size * (step as f64 / FINE as f64).ln().powi(2),
        })
        .collect();

    let mut costs = vec![f64::INFINITY; last + 1];
    costs[0] = (reference[0] - fine[0]).norm_squared();
    let mut steps = vec![0_u8; n * (last + 1)];
    for i in 1..n {
        let mut next = vec![f64::INFINITY; last + 1];
        let (low, high) = (i.saturating_sub(band) * FINE, ((i + band) * FINE).min(last));
        for j in low.max(1)..=high {
            let (mut best, mut taken) = (f64::INFINITY, 0);
            for step in 1..=(FASTEST * FINE).min(j) {
                let cost = costs[j - step] + price[step];
                if cost < best {
                    (best, taken) = (cost, step);
                }
            }
            next[j] = best + (reference[i] - fine[j]).norm_squared();
            steps[i * (last + 1) + j] = taken as u8;
        }
        costs = next;
    }
    let mut phases = vec![0.0; n];
    let mut j = last;
    for i in (1..n).rev() {
        phases[i] = j as f64 / FINE as f64;
        j -= usize::from(steps[i * (last + 1) + j]);
    }
    for _ in 0..SMOOTHINGS {
        let before = phases.clone();
        for i in 1..n - 1 {
            phases[i] = 0.25 * (before[i - 1] + before[i + 1]) + 0.5 * before[i];
        }
    }
    phases
}

#[cfg(test)]
mod tests {
    use super::*;

    fn curve(points: usize, phase: impl Fn(f64) -> f64) -> Vec<Vector3<f64>> {
        (0..points)
            .map(|i| {
                let p = phase(i as f64 / (points - 1) as f64);
                Vector3::new((6.0 * p).sin(), (4.0 * p).cos(), p)
            })
            .collect()
    }

    /// The least and greatest step, in points of the path a point of the reference.
    fn paces(phases: &[f64]) -> (f64, f64) {
        let steps = phases.windows(2).map(|w| w[1] - w[0]);
        steps.fold((f64::INFINITY, 0.0), |(a, b), s| (a.min(s), b.max(s)))
    }

    #[test]
    fn a_path_is_its_own_warp() {
        let path = curve(60, |u| u);
        for (i, phase) in phases(&path, &path, 15).into_iter().enumerate() {
            assert_eq!(phase, i as f64);
        }
    }

    #[test]
    fn a_known_warp_is_found() {
        let (reference, path) = (curve(100, |u| u), curve(100, |u| u * (0.6 + 0.4 * u)));
        for (i, phase) in phases(&reference, &path, 25).into_iter().enumerate() {
            let (u, own) = (i as f64 / 99.0, phase / 99.0);
            assert!((own * (0.6 + 0.4 * own) - u).abs() < 0.015, "{i}: {phase}");
        }
    }

    #[test]
    fn rests_of_other_lengths_stop_no_clock() {
        // At rest for the first 10 % of one and 30 % of the other, and the other way round at the end.
        let rest = |u: f64, from: f64, to: f64| ((u - from) / (to - from)).clamp(0.0, 1.0);
        let reference = curve(100, |u| rest(u, 0.1, 0.7));
        let path = curve(100, |u| rest(u, 0.3, 0.9));
        let found = phases(&reference, &path, 25);
        let (least, greatest) = paces(&found);
        assert!(least > 0.2 && greatest < 4.01, "{least} {greatest}");
        for (i, phase) in found.iter().enumerate().take(65).skip(15) {
            assert!((phase - i as f64 - 20.0).abs() < 4.0, "{i}: {phase}");
        }
    }

    #[test]
    fn noise_is_not_taken_for_pace() {
        let mut state = 1_u64;
        let mut noisy = curve(100, |u| u);
        for p in &mut noisy {
            for v in p.iter_mut() {
                state = state
                    .wrapping_mul(6_364_136_223_846_793_005)
                    .wrapping_add(1);
                *v += 0.04 * ((state >> 33) as f64 / (1_u64 << 31) as f64 - 0.5);
            }
        }
        let (least, greatest) = paces(&phases(&curve(100, |u| u), &noisy, 25));
        assert!(least > 0.7 && greatest < 1.4, "{least} {greatest}");
    }

    #[test]
    fn a_hand_that_rests_throughout_is_not_warped() {
        let still = vec![Vector3::new(1.0, 2.0, 3.0); 30];
        let found = phases(&still, &still, 8);
        let even: Vec<f64> = (0..30).map(f64::from).collect();
        assert_eq!(found, even);
    }
}
