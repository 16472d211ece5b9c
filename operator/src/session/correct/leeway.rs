//! How much a skill leaves open at each moment of its motion.

use nalgebra::{Matrix3, Vector3};

use crate::placed::Motion;

/// No skill is surer of its place than this, m (driving.md §9).
const LEAST_DEVIATION_M: f64 = 0.01;

/// The covariance is taken at this interval, s; between two it is linear.
const STEP_S: f64 = 0.02;

/// The covariance of a skill's position over the time of its plan, m², never below (1 cm)² in any direction: where the
/// demonstrations agreed a correction moves little, where they did not it moves much.
#[derive(Debug, Clone, PartialEq)]
pub struct Leeway(Vec<Matrix3<f64>>);

impl Leeway {
    /// That of a skill's regression over its duration, s.
    pub fn of(motion: &Motion, duration_s: f64) -> Self {
        let steps = (duration_s / STEP_S).ceil().clamp(1.0, 1e6) as usize;
        let floored = |i: usize| {
            let mut eigen = motion.at(i as f64 * STEP_S).covariance.symmetric_eigen();
            let least = LEAST_DEVIATION_M * LEAST_DEVIATION_M;
            eigen.eigenvalues = eigen.eigenvalues.map(|v| v.max(least));
            symmetric(&eigen.recompose())
        };
        Self((0..=steps).map(floored).collect())
    }

    /// The same along every axis and at every moment: deviation in m.
    pub fn even(deviation_m: f64) -> Self {
        let deviation_m = deviation_m.max(LEAST_DEVIATION_M);
        Self(vec![Matrix3::identity() * (deviation_m * deviation_m)])
    }

    /// The covariance at `plan_s`, m²; before the beginning and after the end, that of there.
    pub fn at(&self, plan_s: f64) -> Matrix3<f64> {
        let last = self.0.len() - 1;
        let u = (plan_s / STEP_S).clamp(0.0, last as f64);
        let i = (u as usize).min(last);
        let j = (i + 1).min(last);
        self.0[i] + (self.0[j] - self.0[i]) * (u - i as f64)
    }
}

/// The hand and the skill together at one moment: the product of two Gaussians (driving.md §9).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Fusion {
    /// W = Λ⁻¹·g·Σ_o⁻¹: how much of the hand's displacement bends the plan.
    pub(super) weight: Matrix3<f64>,
    /// The deviation that remains along one axis, √(tr Λ⁻¹/3), m.
    pub(super) deviation_m: f64,
}

impl Fusion {
    /// Λ = s·Σ_p⁻¹ + g·Σ_o⁻¹, with the skill's `leeway` Σ_p (m²), its say `s`, the hand's deviation (m) along every
    /// axis and its say `g`, both in [0, 1] and not both 0.
    pub(super) fn new(leeway: &Matrix3<f64>, s: f64, hand_m: f64, g: f64) -> Self {
        let hand = hand_m * hand_m;
        // Λ = Σ_p⁻¹·(s·I + g·Σ_p/σ²): no inverse of Σ_p is needed.
        let scaled = Matrix3::identity() * s + leeway * (g / hand);
        let inverse = scaled
            .try_inverse()
            .map_or_else(Matrix3::zeros, |inverse| symmetric(&(inverse * leeway)));
        Self {
            weight: inverse * (g / hand),
            deviation_m: (inverse.trace() / 3.0).sqrt(),
        }
    }
}

/// How far `x` (m) is from where the skill would be, in deviations of the skill and a hand of `hand_m` (m) together, squared.
pub(super) fn distance2(leeway: &Matrix3<f64>, hand_m: f64, x: &Vector3<f64>) -> f64 {
    let together = leeway + Matrix3::identity() * (hand_m * hand_m);
    together
        .try_inverse()
        .map_or(0.0, |inverse| x.dot(&(inverse * x)))
}

fn symmetric(m: &Matrix3<f64>) -> Matrix3<f64> {
    (m + m.transpose()) * 0.5
}

#[cfg(test)]
mod tests {
    use super::*;
    use telemime_protocol::skill::example;

    #[test]
    fn it_is_the_regressions_covariance_and_never_below_a_centimetre() {
        let skill = example(3, 1);
        let motion = Motion::new(&skill, &[]).unwrap();
        let leeway = Leeway::of(&motion, skill.duration_s());
        let least = LEAST_DEVIATION_M * LEAST_DEVIATION_M;
        for i in 0..=50 {
            let t_s = f64::from(i) * STEP_S;
            let eigen = leeway.at(t_s).symmetric_eigenvalues();
            assert!(eigen.min() >= least * (1.0 - 1e-9), "{eigen} at {t_s} s");
            let given = motion.at(t_s).covariance;
            if given.symmetric_eigenvalues().min() > 2.0 * least {
                assert!((leeway.at(t_s) - given).norm() < 0.05 * given.norm());
            }
        }
        assert_eq!(leeway.at(-1.0), leeway.at(0.0));
        assert_eq!(leeway.at(1e3), leeway.at(skill.duration_s() + STEP_S));
        assert_eq!(Leeway::even(0.0), Leeway::even(LEAST_DEVIATION_M));
    }

    #[test]
    fn the_hands_share_follows_from_both_covariances() {
        let turn = nalgebra::Rotation3::from_euler_angles(0.3, 0.9, -0.5);
        let deviations = Vector3::new(0.01, 0.02, 0.06);
        let leeway = turn * Matrix3::from_diagonal(&deviations.map(|d| d * d)) * turn.transpose();
        let shares = |s: f64, g: f64| {
            let w = Fusion::new(&leeway, s, 0.02, g).weight;
            (turn.transpose() * w * turn).diagonal()
        };
        // λ/(λ + σ²): ⅕, ½ and 0.9.
        assert!((shares(1.0, 1.0) - Vector3::new(0.2, 0.5, 0.9)).norm() < 1e-9);
        assert!(shares(1.0, 0.0).norm() < 1e-12);
        assert!((shares(0.0, 1.0) - Vector3::repeat(1.0)).norm() < 1e-9);
        assert!(shares(1.0, 0.3)[1] < shares(1.0, 0.6)[1]);
        let alone = Fusion::new(&leeway, 1.0, 0.02, 0.0).deviation_m;
        let both = Fusion::new(&leeway, 1.0, 0.02, 1.0).deviation_m;
        assert!(both < 0.02 && both < alone);
        let along = turn * Vector3::z() * 0.1;
        let expected = 0.01 / (0.0036 + 0.0004);
        assert!((distance2(&leeway, 0.02, &along) - expected).abs() < 1e-9);
    }
}
