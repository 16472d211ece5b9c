//! Orientations over time, and how far apart two courses of them are.

use nalgebra::UnitQuaternion;
use telemime_protocol::pose;

/// An orientation over time, along the shortest rotation between its points and still outside them.
#[derive(Debug, Clone, PartialEq)]
pub struct Turns(Vec<(f64, UnitQuaternion<f64>)>);

impl Turns {
    /// A course through `points` (s), in order of time; `None` of none.
    pub fn new(points: Vec<(f64, UnitQuaternion<f64>)>) -> Option<Self> {
        let ordered = points.windows(2).all(|w| w[0].0 <= w[1].0);
        (ordered && !points.is_empty()).then_some(Self(points))
    }

    /// The orientation at `t_s`.
    pub fn at(&self, t_s: f64) -> UnitQuaternion<f64> {
        let after = self.0.partition_point(|p| p.0 <= t_s);
        let Some((t0, q0)) = after.checked_sub(1).map(|i| self.0[i]) else {
            return self.0[0].1;
        };
        match self.0.get(after) {
            Some((t1, q1)) if *t1 > t0 => {
                let u = (t_s - t0) / (t1 - t0);
                pose::moved(&q0, &(pose::between(&q0, q1) * u))
            }
            _ => q0,
        }
    }

    /// Root mean square angle to `truth` over the times `grid_s`, rad.
    pub fn rmse_rad(&self, truth: &Self, grid_s: &[f64]) -> f64 {
        let sum: f64 = grid_s
            .iter()
            .map(|&t| pose::between(&self.at(t), &truth.at(t)).norm_squared())
            .sum();
        (sum / grid_s.len().max(1) as f64).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    #[test]
    fn a_late_turn_errs_by_rate_times_delay() {
        let turning = |late_s: f64| {
            let point = |i: i32| {
                let t = f64::from(i) * 0.03;
                (t, pose::exp(&(Vector3::z() * (2.0 * (t - late_s)))))
            };
            Turns::new((0..100).map(point).collect()).unwrap()
        };
        let grid: Vec<_> = (0..290).map(|i| f64::from(i) * 0.01).collect();
        let error = turning(0.1).rmse_rad(&turning(0.0), &grid);
        assert!((error - 0.2).abs() < 1e-9, "{error}");
        assert_eq!(Turns::new(Vec::new()), None);
    }
}
