//! iproute2's distribution tables, made as its generators make them (`netem/normal.c`, `pareto.c`, `paretonormal.c`,
//! which took them from NIST Net): 4096 quantiles in units of 1/8192 standard deviation.

use std::sync::OnceLock;

use super::config::Distribution;

/// `NETEM_DIST_SCALE`: one standard deviation in a table.
pub(super) const SCALE: i64 = 8192;

/// Quantiles in a table.
pub(super) const SIZE: usize = 4096;

/// Points of the cumulative distribution the generators count in.
const FINE: usize = 16384;

pub(super) type Table = [i16; SIZE];

/// The table; `None` for what the kernel computes without one.
pub(super) fn table(distribution: Distribution) -> Option<&'static Table> {
    static NORMAL: OnceLock<Table> = OnceLock::new();
    static PARETO: OnceLock<Table> = OnceLock::new();
    static BOTH: OnceLock<Table> = OnceLock::new();
    match distribution {
        Distribution::Uniform => None,
        Distribution::Normal => {
            Some(NORMAL.get_or_init(|| made(|i| scaled(normal_quantiles()[i]))))
        }
        Distribution::Pareto => Some(PARETO.get_or_init(|| made(pareto))),
        Distribution::ParetoNormal => Some(BOTH.get_or_init(|| {
            // C divides towards zero, as Rust does.
            made(|i| (scaled(normal_quantiles()[i]) + 3 * pareto(i)) / 4)
        })),
    }
}

fn made(value: impl Fn(usize) -> i32) -> Table {
    std::array::from_fn(|n| value(4 * n).clamp(i16::MIN.into(), i16::MAX.into()) as i16)
}

fn scaled(x: f64) -> i32 {
    (x * SCALE as f64).round_ties_even() as i32
}

/// For every i of 16384, the last point of a fine walk whose probability rounds to i.
fn normal_quantiles() -> &'static [f64] {
    static QUANTILES: OnceLock<Vec<f64>> = OnceLock::new();
    QUANTILES.get_or_init(|| {
        let mut quantiles = vec![0.0; FINE + 1];
        let mut x = -10.0;
        // Summed up, not multiplied: the generator's rounding errors are part of its table.
        while x < 10.05 {
            let p = 0.5 + 0.5 * libm::erf(x / std::f64::consts::SQRT_2);
            quantiles[(FINE as f64 * p).round_ties_even() as usize] = x;
            x += 0.000_05;
        }
        quantiles
    })
}

/// Of a Pareto distribution with a = 3 (mean 1.5, standard deviation √¾) at 1 − i/16384; the generator takes its
/// standard deviation for ¾.
fn pareto(i: usize) -> i32 {
    let p = (65536 - 4 * i) as f64 / 65536.0;
    let value = (1.0 / libm::pow(p, 1.0 / 3.0) - 1.5) * (4.0 / 3.0) * SCALE as f64;
    value.min(32767.0).round_ties_even() as i32
}

#[cfg(test)]
mod tests {
    use super::*;

    const TABLES: [Distribution; 3] = [
        Distribution::Normal,
        Distribution::Pareto,
        Distribution::ParetoNormal,
    ];

    /// FNV-1a over the little-endian entries.
    fn print_of(values: impl Iterator<Item = i16>) -> u64 {
        values
            .flat_map(i16::to_le_bytes)
            .fold(0xcbf2_9ce4_8422_2325, |h, b| {
                (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3)
            })
    }

    #[test]
    fn the_tables_are_those_that_iproute2_ships() {
        // Of normal.dist, pareto.dist and paretonormal.dist of iproute2 6.1.0.
        let shipped = [
            0x3f19_8b60_14c3_b3b8_u64,
            0x209e_1d3c_8618_19fa,
            0x468c_e9c9_62a5_ecf9,
        ];
        for (distribution, shipped) in TABLES.into_iter().zip(shipped) {
            let table = table(distribution).unwrap();
            assert_eq!(
                format!("{:016x}", print_of(table.iter().copied())),
                format!("{shipped:016x}"),
                "{}",
                distribution.name()
            );
        }
    }

    #[test]
    fn the_tables_have_the_moments_of_their_distributions() {
        // min((4/3)(V − 1.5), 4) for V = U^(−1/3), cut where V = 4.5: E[V] = 1.475309, E[V²] = 23/9.
        let cut = (4.0 / 3.0) * (1.475309 - 1.5);
        let spread = (4.0 / 3.0) * (23.0 / 9.0 - 1.475309f64.powi(2)).sqrt();
        for (distribution, mean, deviation) in [
            (Distribution::Normal, 0.0, 1.0),
            (Distribution::Pareto, cut, spread),
        ] {
            let table = table(distribution).unwrap();
            let x = table.iter().map(|&v| f64::from(v) / SCALE as f64);
            let m = x.clone().sum::<f64>() / SIZE as f64;
            let sd = (x.map(|v| (v - m).powi(2)).sum::<f64>() / SIZE as f64).sqrt();
            assert!(
                (m - mean).abs() < 1e-3 && (sd / deviation - 1.0).abs() < 2e-3,
                "{}: {m} {sd}",
                distribution.name()
            );
        }
    }
}
