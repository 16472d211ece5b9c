//! The newest of the hand, and what it remembers: all that a prediction depends on.

use nalgebra::{SVector, Vector3};

use crate::time::Stamp;

/// Time constants of the four exponential memories, s.
pub const MEMORY_TAU_S: [f64; 4] = [0.05, 0.1333, 0.3333, 0.8333];

/// Length of the feature vector: the position and its distance to each memory.
pub const FEATURES: usize = 3 * (1 + MEMORY_TAU_S.len());

/// Samples nearer in time than this are taken as this far apart, s.
const LEAST_STEP_S: f64 = 1e-4;

/// The newest position of the hand with exponential memories of where it has been.
///
/// The memories are exact for a path that is linear between samples, so jitter and lost samples cost
/// nothing but the bend they hide. A checkpoint carries precisely this.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HandState {
    /// When the newest sample is valid.
    pub t: Stamp,
    /// The newest position, m.
    pub x: Vector3<f64>,
    /// Exponential memories of the position, m, one for each of [`MEMORY_TAU_S`].
    pub memory: [Vector3<f64>; 4],
}

impl HandState {
    /// The state after the first sample: the hand has always been at `x`, m.
    pub fn first(t: Stamp, x: Vector3<f64>) -> Self {
        Self {
            t,
            x,
            memory: [x; 4],
        }
    }

    /// Takes the sample `x` (m), valid at `t`; says whether it was taken.
    ///
    /// A sample that is not later than the newest, or not finite, changes nothing.
    ///
    /// `e = exp(−dt/τ); q = (1−e)·τ/dt; m ← e·m + (1−q)·x + (q−e)·x_prev`
    pub fn advance(&mut self, t: Stamp, x: Vector3<f64>) -> bool {
        if t <= self.t || !x.iter().all(|v| v.is_finite()) {
            return false;
        }
        for (m, tau_s) in self.memory.iter_mut().zip(MEMORY_TAU_S) {
            let (e, q) = blend(t.secs_since(self.t), tau_s);
            *m = *m * e + x * (1.0 - q) + self.x * (q - e);
        }
        self.t = t;
        self.x = x;
        true
    }

    /// `[x, x−m₁, x−m₂, x−m₃, x−m₄]`, m.
    pub fn features(&self) -> SVector<f64, FEATURES> {
        let mut f = SVector::<f64, FEATURES>::zeros();
        f.fixed_rows_mut::<3>(0).copy_from(&self.x);
        for (i, m) in self.memory.iter().enumerate() {
            f.fixed_rows_mut::<3>(3 * (i + 1)).copy_from(&(self.x - m));
        }
        f
    }

    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        self.x
            .iter()
            .chain(self.memory.iter().flatten())
            .all(|v| v.is_finite())
    }
}

/// What a step of `dt_s` leaves of a memory of time constant `tau_s`: `e = exp(−dt/τ)`, and `q = (1−e)·τ/dt`.
pub(super) fn blend(dt_s: f64, tau_s: f64) -> (f64, f64) {
    let dt_s = dt_s.max(LEAST_STEP_S);
    let e = libm::exp(-dt_s / tau_s);
    (e, (1.0 - e) * tau_s / dt_s)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memories_do_not_depend_on_how_a_straight_line_is_sampled() {
        let line = |t_s: f64| Vector3::new(0.3 + 2.0 * t_s, -t_s, 0.5);
        let run = |stamps_ms: &[i64]| {
            let mut s = HandState::first(Stamp(0), line(0.0));
            for &ms in stamps_ms {
                let t = Stamp(ms * 1_000_000);
                assert!(s.advance(t, line(t.as_secs_f64())));
            }
            s
        };
        let dense = run(&(1..=300).collect::<Vec<_>>());
        let sparse = run(&[17, 40, 41, 170, 300]);
        for (a, b) in dense.memory.iter().zip(sparse.memory) {
            assert!((a - b).norm() < 1e-12);
        }
    }

    #[test]
    fn in_steady_motion_a_memory_lags_by_its_time_constant() {
        let v = Vector3::new(1.0, -2.0, 0.5);
        let mut s = HandState::first(Stamp(0), Vector3::zeros());
        for i in 1..=600 {
            let t = Stamp(i * 33_333_333);
            s.advance(t, v * t.as_secs_f64());
        }
        for (m, tau_s) in s.memory.iter().zip(MEMORY_TAU_S) {
            assert!((s.x - m - v * tau_s).norm() < 1e-9);
        }
    }

    #[test]
    fn late_repeated_and_non_finite_samples_change_nothing() {
        let mut s = HandState::first(Stamp(10), Vector3::zeros());
        let before = s;
        assert!(!s.advance(Stamp(10), Vector3::x()));
        assert!(!s.advance(Stamp(9), Vector3::x()));
        assert!(!s.advance(Stamp(11), Vector3::new(0.0, f64::NAN, 0.0)));
        assert_eq!(s, before);
    }
}
