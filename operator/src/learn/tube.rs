//! How far demonstrations are apart, moment by moment: in proportional time, where a difference of pace looks like one of
//! place, and aligned, where it does not.

use nalgebra::{Matrix3, Vector3};

use super::align::Aligned;
use crate::demonstration::Demonstration;

/// Mean and spread of paths at each of a row of moments.
#[derive(Debug, Clone, PartialEq)]
pub struct Tube {
    /// Mean position at each moment, m.
    pub mean: Vec<Vector3<f64>>,
    /// Covariance of the positions at each moment, m², with n − 1 in the denominator; zero for a single path.
    pub covariance: Vec<Matrix3<f64>>,
}

impl Tube {
    /// The tube of paths (m) that have a position at every one of the same moments. Without a path it is empty.
    pub fn of(paths: &[Vec<Vector3<f64>>]) -> Self {
        let moments = paths.iter().map(Vec::len).min().unwrap_or(0);
        let count = paths.len() as f64;
        let (mean, covariance) = (0..moments)
            .map(|i| {
                let mean = paths.iter().map(|p| p[i]).sum::<Vector3<f64>>() / count;
                let scatter: Matrix3<f64> = paths
                    .iter()
                    .map(|p| (p[i] - mean) * (p[i] - mean).transpose())
                    .sum();
                (mean, scatter / (count - 1.0).max(1.0))
            })
            .unzip();
        Self { mean, covariance }
    }

    /// The root mean square distance of the paths from their mean, m, averaged over the moments; 0 of no moment.
    pub fn deviation_m(&self) -> f64 {
        let sum: f64 = self.covariance.iter().map(|c| c.trace().sqrt()).sum();
        sum / self.covariance.len().max(1) as f64
    }
}

/// The demonstrations at `points` equal steps of each one's own time: what they would be if pace never varied
/// within a performance. One path (m) a demonstration; at least two points.
pub fn proportional(demonstrations: &[Demonstration], points: usize) -> Vec<Vec<Vector3<f64>>> {
    let last = points.max(2) - 1;
    demonstrations
        .iter()
        .map(|d| {
            let start_s = d.samples()[0].t_s;
            (0..=last)
                .map(|i| d.position_at(start_s + d.duration_s() * i as f64 / last as f64))
                .collect()
        })
        .collect()
}

/// What alignment did to the spread of the demonstrations.
#[derive(Debug, Clone, PartialEq)]
pub struct BeforeAfter {
    /// The tube in proportional time.
    pub before: Tube,
    /// The tube on the common axis.
    pub after: Tube,
}

impl BeforeAfter {
    /// Of the demonstrations that `aligned` was made from; both tubes have a moment for each of its times.
    pub fn of(demonstrations: &[Demonstration], aligned: &Aligned) -> Self {
        Self {
            before: Tube::of(&proportional(demonstrations, aligned.times_s.len())),
            after: Tube::of(&aligned.paths),
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_xoshiro::Xoshiro256PlusPlus;

    use super::super::align::align;
    use super::*;
    use crate::demonstration::Sample;

    /// One shape, each performance displaced and bent a little, its pace its own: the demonstrations, and the tube
    /// of the same performances without any difference of pace.
    fn performances(count: usize, points: usize) -> (Vec<Demonstration>, Tube) {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(11);
        let mut truth = Vec::new();
        let demonstrations = (0..count)
            .map(|n| {
                let mut own = || rng.random::<f64>() - 0.5;
                let (bend, kink) = (0.9 * own(), 0.5 * own());
                let duration_s = 2.0 * (0.6 * own()).exp();
                let offset = Vector3::new(own(), own(), own()) * 0.04;
                let curl = Vector3::new(own(), own(), own()) * 0.03;
                let place = |p: f64| {
                    Vector3::new(0.5 * (6.3 * p).sin(), 0.4 * (9.4 * p).cos(), 0.6 * p)
                        + offset
                        + curl * (3.0 * p).sin()
                };
                let last = (points - 1) as f64;
                truth.push((0..points).map(|i| place(i as f64 / last)).collect());
                let samples: Vec<_> = (0..120)
                    .map(|i| {
                        let u = f64::from(i) / 119.0;
                        let p = u + u * (1.0 - u) * (bend + kink * (1.0 - 2.0 * u));
                        Sample::at(u * duration_s, place(p))
                    })
                    .collect();
                Demonstration::from_samples(format!("{n}"), &samples).unwrap()
            })
            .collect();
        (demonstrations, Tube::of(&truth))
    }

    #[test]
    fn timing_does_not_widen_the_aligned_tube() {
        let (demonstrations, truth) = performances(10, 120);
        let aligned = align(&demonstrations).unwrap();
        let tubes = BeforeAfter::of(&demonstrations, &aligned);
        let (before, after, truth) = (
            tubes.before.deviation_m(),
            tubes.after.deviation_m(),
            truth.deviation_m(),
        );
        assert!(before > 4.0 * truth, "{before} {truth}");
        assert!(after < 1.15 * truth, "{after} {truth}");
        // Nor does alignment explain away what is a difference of place.
        assert!(after > 0.75 * truth, "{after} {truth}");
    }

    #[test]
    fn of_two_paths_the_spread_is_known() {
        let path = |y: f64| vec![Vector3::zeros(), Vector3::new(1.0, y, 0.0)];
        let tube = Tube::of(&[path(0.0), path(0.2)]);
        assert_eq!(tube.mean[1], Vector3::new(1.0, 0.1, 0.0));
        assert!((tube.covariance[1][(1, 1)] - 0.02).abs() < 1e-15);
        assert!((tube.deviation_m() - 0.5 * 0.02_f64.sqrt()).abs() < 1e-15);
    }

    #[test]
    fn one_performance_or_none_has_no_spread() {
        let (one, _) = performances(1, 50);
        let tubes = BeforeAfter::of(&one, &align(&one).unwrap());
        assert_eq!(
            (tubes.before.deviation_m(), tubes.after.deviation_m()),
            (0.0, 0.0)
        );
        assert_eq!(Tube::of(&[]).deviation_m(), 0.0);
    }
}
