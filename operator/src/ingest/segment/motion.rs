//! A stretch on an even grid of times, smoothed: what segmentation looks at.

use nalgebra::Vector3;

use super::super::Pose;
use super::super::smooth::smooth;

/// Step of the grid, s.
pub(super) const STEP_S: f64 = 0.02;

/// Cut-off of the smoothing, Hz: above what a hand repeats, below most of a sensor's noise.
const CUTOFF_HZ: f64 = 5.0;

pub(super) struct Motion {
    start_s: f64,
    /// Place, m.
    pub(super) x: Vec<Vector3<f64>>,
    /// Velocity, m/s.
    pub(super) v: Vec<Vector3<f64>>,
    /// Speed, m/s.
    pub(super) speed: Vec<f64>,
    /// What 98 % of the time is slower, m/s.
    pub(super) fast_m_s: f64,
    /// What smoothing took away from most samples at least, m: noise, where the hand is not fast.
    pub(super) noise_m: f64,
}

impl Motion {
    /// None of a stretch that is shorter than a few steps, or does not move at all.
    pub(super) fn new(poses: &[Pose]) -> Option<Self> {
        let (first, last) = poses.first().zip(poses.last())?;
        let t: Vec<f64> = poses.iter().map(|p| p.t_s).collect();
        let raw: Vec<[f64; 3]> = poses.iter().map(|p| p.position.into()).collect();
        let smoothed = smooth(&t, &raw, CUTOFF_HZ);
        let mut off: Vec<f64> = raw
            .iter()
            .zip(&smoothed)
            .map(|(a, b)| (Vector3::from(*a) - Vector3::from(*b)).norm())
            .collect();
        off.sort_by(f64::total_cmp);
        let n = ((last.t_s - first.t_s) / STEP_S).floor() as usize + 1;
        if n < 5 {
            return None;
        }
        let mut after = 1;
        let x: Vec<Vector3<f64>> = (0..n)
            .map(|i| {
                let at = first.t_s + STEP_S * i as f64;
                while after + 1 < t.len() && t[after] < at {
                    after += 1;
                }
                let u = (at - t[after - 1]) / (t[after] - t[after - 1]);
                Vector3::from(smoothed[after - 1]).lerp(&smoothed[after].into(), u)
            })
            .collect();
        let v: Vec<Vector3<f64>> = (0..n)
            .map(|i| {
                let (a, b) = (i.saturating_sub(1), (i + 1).min(n - 1));
                (x[b] - x[a]) / (STEP_S * (b - a) as f64)
            })
            .collect();
        let speed: Vec<f64> = v.iter().map(Vector3::norm).collect();
        let mut sorted = speed.clone();
        sorted.sort_by(f64::total_cmp);
        let fast_m_s = sorted[(n - 1) * 98 / 100];
        (fast_m_s > 0.0).then(|| Self {
            start_s: first.t_s,
            x,
            v,
            speed,
            fast_m_s,
            noise_m: off[off.len() / 5],
        })
    }

    /// Steps of the grid.
    pub(super) fn len(&self) -> usize {
        self.x.len()
    }

    /// When the grid is at `i`, s. The step past the last is later than every sample.
    pub(super) fn time(&self, i: usize) -> f64 {
        self.start_s + STEP_S * i as f64
    }
}

/// How many steps of the grid a time is.
pub(super) fn steps(s: f64) -> usize {
    (s / STEP_S).round() as usize
}
