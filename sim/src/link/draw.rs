//! The link's chances.

use super::config::Probability;

/// 2⁶⁴ / φ, odd: SplitMix64's increment.
const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;

/// Draws set aside for one packet: those of its two copies.
const PER_PACKET: u64 = 32;

/// What a number is drawn for.
#[derive(Debug, Clone, Copy)]
pub(super) enum What {
    Duplicate,
    Loss,
    LossToo,
    Corrupt,
    Byte,
    Bit,
    Reorder,
    Delay,
    Slot,
    SlotToo,
    SlotThen,
    TraceLoss,
}

/// One copy's numbers, uniform in u32 as the kernel's `prandom_u32_state`.
///
/// SplitMix64 (Steele, Lea, Flood 2014) read at random: every packet has its own numbers, whatever became of those
/// before it, so that two links with the same seed and other settings are compared on the same chances.
#[derive(Debug, Clone, Copy)]
pub(super) struct Draws {
    base: u64,
}

impl Draws {
    pub(super) fn of(seed: u64, packet: u64, copy: bool) -> Self {
        let place = packet.wrapping_mul(PER_PACKET) + if copy { PER_PACKET / 2 } else { 0 };
        Self {
            base: mix(seed.wrapping_add(GOLDEN)).wrapping_add(place.wrapping_mul(GOLDEN)),
        }
    }

    pub(super) fn u32(self, what: What) -> u32 {
        (mix(self.base.wrapping_add((what as u64).wrapping_mul(GOLDEN))) >> 32) as u32
    }

    /// Uniform below `n`, which is positive.
    pub(super) fn below(self, what: What, n: u32) -> u32 {
        ((u64::from(self.u32(what)) * u64::from(n)) >> 32) as u32
    }
}

fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// `get_crandom` of the kernel: a draw that resembles the one before it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Correlated {
    last: u32,
    rho: u32,
}

impl Correlated {
    pub(super) fn new(first: u32, rho: Probability) -> Self {
        Self {
            last: first,
            rho: rho.0,
        }
    }

    pub(super) fn next(&mut self, fresh: u32) -> u32 {
        if self.rho == 0 {
            return fresh;
        }
        let rho = u64::from(self.rho) + 1;
        // The sum is below 2⁶⁴: both weights add up to 2³².
        let sum = u64::from(fresh) * ((1 << 32) - rho) + u64::from(self.last) * rho;
        self.last = (sum >> 32) as u32;
        self.last
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_of_all_packets_and_purposes_are_uniform_and_unrelated() {
        let n = 100_000u64;
        let unit = |d: Draws, what| f64::from(d.u32(what)) / 4_294_967_296.0 - 0.5;
        let (mut mean, mut square, mut across, mut along) = (0.0, 0.0, 0.0, 0.0);
        for i in 0..n {
            let (a, b) = (Draws::of(7, i, false), Draws::of(7, i + 1, false));
            let x = unit(a, What::Delay);
            mean += x;
            square += x * x;
            across += x * unit(Draws::of(7, i, true), What::Delay) + x * unit(a, What::Loss);
            along += x * unit(b, What::Delay);
        }
        let n = n as f64;
        // Four standard errors: 0.289/√n, and 1/12/√n for the products.
        assert!((mean / n).abs() < 4.0 * 0.289 / n.sqrt());
        assert!((square / n * 12.0 - 1.0).abs() < 0.012);
        assert!((across / n).abs() < 4.0 * 2f64.sqrt() / 12.0 / n.sqrt());
        assert!((along / n).abs() < 4.0 / 12.0 / n.sqrt());
    }

    #[test]
    fn correlated_draws_are_an_autoregression() {
        // x' = (1−ρ)u + ρx: mean ½, variance (1−ρ)/(1+ρ)/12, correlation ρ^lag.
        for rho in [0.1, 0.5, 0.9] {
            let mut chain = Correlated::new(1 << 31, Probability::of(rho));
            let x: Vec<f64> = (0..200_000)
                .map(|i| {
                    f64::from(chain.next(Draws::of(3, i, false).u32(What::Delay))) / 2f64.powi(32)
                })
                .collect();
            let mean = x.iter().sum::<f64>() / x.len() as f64;
            let var = x.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / x.len() as f64;
            let cov = x
                .windows(2)
                .map(|w| (w[0] - mean) * (w[1] - mean))
                .sum::<f64>()
                / x.len() as f64;
            assert!((mean - 0.5).abs() < 0.01, "{rho}: {mean}");
            let expected = (1.0 - rho) / (1.0 + rho) / 12.0;
            assert!(
                (var / expected - 1.0).abs() < 0.05,
                "{rho}: {var} {expected}"
            );
            assert!((cov / var - rho).abs() < 0.01, "{rho}: {}", cov / var);
        }
    }
}
