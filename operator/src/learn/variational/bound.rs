//! Expectations under the posterior, and its divergence from the prior: the parts of the lower bound
//! that do not look at the data.

use nalgebra::{Cholesky, SMatrix};

use super::{Posterior, Prior, WeightPrior};
use crate::learn::em::pass::Kernel;

/// ln Γ(x), x > 0.
pub fn ln_gamma(x: f64) -> f64 {
    libm::lgamma(x)
}

/// ψ(x) = d ln Γ(x)/dx, x > 0, to 1e-14: ψ(x) = ψ(x + 1) − 1/x up to x ≥ 10, then the asymptotic series
/// (Abramowitz & Stegun 1964, 6.3.5 and 6.3.18).
pub fn digamma(mut x: f64) -> f64 {
    const SERIES: [f64; 7] = [
        1.0 / 12.0,
        -1.0 / 120.0,
        1.0 / 252.0,
        -1.0 / 240.0,
        1.0 / 132.0,
        -691.0 / 32_760.0,
        1.0 / 12.0,
    ];
    let mut below = 0.0;
    while x < 10.0 {
        below -= 1.0 / x;
        x += 1.0;
    }
    let inverse2 = 1.0 / (x * x);
    let tail = SERIES.iter().rev().fold(0.0, |sum, c| (sum + c) * inverse2);
    below + x.ln() - 0.5 / x - tail
}

/// The posterior of the weights.
pub(super) enum Weights {
    /// α, and α₀.
    Distribution { alpha: Vec<f64>, prior: f64 },
    /// Beta(a, b) of each stick's share, and γ of the prior Beta(1, γ).
    Process { sticks: Vec<(f64, f64)>, prior: f64 },
}

impl Weights {
    pub(super) fn of<const D: usize>(prior: &Prior<D>, now: &[Posterior<D>]) -> Self {
        let samples = now.iter().map(|p| p.samples + 10.0 * f64::EPSILON);
        match prior.weights {
            WeightPrior::Distribution => Self::Distribution {
                alpha: samples.map(|n| prior.concentration + n).collect(),
                prior: prior.concentration,
            },
            WeightPrior::Process => {
                let samples: Vec<f64> = samples.collect();
                let mut after: f64 = samples.iter().sum();
                let sticks = samples
                    .iter()
                    .map(|n| {
                        after -= n;
                        (1.0 + n, prior.concentration + after.max(0.0))
                    })
                    .collect();
                Self::Process {
                    sticks,
                    prior: prior.concentration,
                }
            }
        }
    }

    /// E[ln π_k] (Bishop 2006, eq. 10.66; Blei & Jordan 2006, §3).
    pub(super) fn expected_log(&self) -> Vec<f64> {
        match self {
            Self::Distribution { alpha, .. } => {
                let all = digamma(alpha.iter().sum());
                alpha.iter().map(|a| digamma(*a) - all).collect()
            }
            Self::Process { sticks, .. } => {
                let mut left = 0.0;
                sticks
                    .iter()
                    .map(|&(a, b)| {
                        let both = digamma(a + b);
                        let log = digamma(a) - both + left;
                        left += digamma(b) - both;
                        log
                    })
                    .collect()
            }
        }
    }

    /// E[π_k], normalised where the truncated process leaves a rest.
    pub(super) fn expected(&self) -> Vec<f64> {
        let mut weights: Vec<f64> = match self {
            Self::Distribution { alpha, .. } => alpha.clone(),
            Self::Process { sticks, .. } => {
                let mut left = 1.0;
                sticks
                    .iter()
                    .map(|&(a, b)| {
                        let share = left * a / (a + b);
                        left *= b / (a + b);
                        share
                    })
                    .collect()
            }
        };
        let sum: f64 = weights.iter().sum();
        weights.iter_mut().for_each(|w| *w /= sum);
        weights
    }

    /// KL(q(π) ‖ p(π)).
    pub(super) fn divergence(&self) -> f64 {
        match self {
            Self::Distribution { alpha, prior } => {
                let k = alpha.len() as f64;
                let sum: f64 = alpha.iter().sum();
                let all = digamma(sum);
                let each = alpha
                    .iter()
                    .map(|a| (a - prior) * (digamma(*a) - all) - ln_gamma(*a));
                ln_gamma(sum) - ln_gamma(k * prior) + k * ln_gamma(*prior) + each.sum::<f64>()
            }
            Self::Process { sticks, prior } => {
                let ln_beta = |a: f64, b: f64| ln_gamma(a) + ln_gamma(b) - ln_gamma(a + b);
                sticks
                    .iter()
                    .map(|&(a, b)| {
                        ln_beta(1.0, *prior) - ln_beta(a, b)
                            + (a - 1.0) * digamma(a)
                            + (b - prior) * digamma(b)
                            + (1.0 - a + prior - b) * digamma(a + b)
                    })
                    .sum()
            }
        }
    }
}

impl<const D: usize> Posterior<D> {
    /// E[ln |Λ|] (Bishop 2006, eq. 10.65), with |W| = |ν·C|⁻¹.
    fn expected_log_det(&self) -> f64 {
        let digammas: f64 = (0..D)
            .map(|i| digamma(0.5 * (self.freedom - i as f64)))
            .sum();
        digammas + D as f64 * std::f64::consts::LN_2 + self.log_det_w()
    }

    /// ln |W|
    fn log_det_w(&self) -> f64 {
        -(D as f64) * self.freedom.ln() - log_det(&self.factor)
    }

    /// ln ρ (Bishop 2006, eq. 10.46 with 10.64).
    pub(super) fn kernel(&self, log_weight: f64) -> Kernel<D> {
        let d = D as f64;
        let scale = log_weight + 0.5 * self.expected_log_det()
            - 0.5 * d * std::f64::consts::TAU.ln()
            - 0.5 * d / self.mean_precision;
        Kernel::new(scale, &self.mean, &self.factor)
    }
}

fn log_det<const D: usize>(factor: &SMatrix<f64, D, D>) -> f64 {
    (0..D).map(|i| 2.0 * factor[(i, i)].ln()).sum()
}

/// −ln B(W, ν) of a Wishart distribution (Bishop 2006, eq. B.79).
fn ln_wishart_norm<const D: usize>(log_det_w: f64, freedom: f64) -> f64 {
    let d = D as f64;
    let gammas: f64 = (0..D).map(|i| ln_gamma(0.5 * (freedom - i as f64))).sum();
    0.5 * freedom * log_det_w
        + 0.5 * freedom * d * std::f64::consts::LN_2
        + 0.25 * d * (d - 1.0) * std::f64::consts::PI.ln()
        + gammas
}

/// Σ_k KL(q(μ, Λ) ‖ p(μ, Λ)). Up to a constant where the prior's scatter is singular.
pub(super) fn divergence<const D: usize>(prior: &Prior<D>, now: &[Posterior<D>]) -> f64 {
    let d = D as f64;
    let log_det_prior = nalgebra::Cholesky::new(prior.scatter)
        .map_or(0.0, |factor| -log_det(&factor.l_dirty().clone()));
    let norm_prior = ln_wishart_norm::<D>(log_det_prior, prior.freedom);
    now.iter()
        .map(|p| {
            let factor = Cholesky::pack_dirty(p.factor);
            let apart = p.mean - prior.mean;
            let distance2 = apart.dot(&factor.solve(&apart));
            let ratio = prior.mean_precision / p.mean_precision;
            let mean = 0.5 * (d * (ratio - 1.0 - ratio.ln()) + prior.mean_precision * distance2);
            let norm = ln_wishart_norm::<D>(p.log_det_w(), p.freedom);
            let wishart = norm_prior - norm
                + 0.5 * (p.freedom - prior.freedom) * p.expected_log_det()
                + 0.5 * factor.solve(&prior.scatter).trace()
                - 0.5 * p.freedom * d;
            mean + wishart
        })
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digamma_at_known_points() {
        // −γ; −γ − 2·ln 2; ψ(10) = H₉ − γ.
        const EULER: f64 = 0.577_215_664_901_532_9;
        let harmonic: f64 = (1..10).map(|i| 1.0 / f64::from(i)).sum();
        for (x, want) in [
            (1.0, -EULER),
            (0.5, -EULER - 2.0 * std::f64::consts::LN_2),
            (10.0, harmonic - EULER),
        ] {
            assert!((digamma(x) - want).abs() < 1e-13, "{x}: {}", digamma(x));
        }
        // It is the slope of ln Γ.
        for x in [1e-3, 0.3, 2.5, 9.99, 700.0] {
            let h = 1e-5 * x;
            let slope = (ln_gamma(x + h) - ln_gamma(x - h)) / (2.0 * h);
            assert!(
                (digamma(x) - slope).abs() < 1e-6 * slope.abs().max(1.0),
                "{x}"
            );
        }
    }
}
