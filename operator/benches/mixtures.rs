//! Mixtures: fitting and regression, at the sizes that others have been measured at.
//!
//! `cargo bench -p telemime-operator`. `beside.py` in this folder runs scikit-learn and `gmr` too, on the
//! same data from the same start, and prints the ratios.

use std::path::PathBuf;

use nalgebra::{SMatrix, SVector};
use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use telemime_operator::learn::em::{self, Convergence, EmOptions};
use telemime_operator::learn::select;
use telemime_protocol::skill::{Gmm, Gmr};

fn main() {
    divan::main();
}

/// Little-endian doubles of `$PEER_DATA/NAME.f64`, where `beside.py` has put them.
fn peers(name: &str) -> Option<Vec<f64>> {
    let dir = PathBuf::from(std::env::var_os("PEER_DATA")?);
    let bytes = std::fs::read(dir.join(format!("{name}.f64"))).ok()?;
    let (numbers, _) = bytes.as_chunks::<8>();
    Some(numbers.iter().map(|b| f64::from_le_bytes(*b)).collect())
}

/// The peers' rows, or rows like theirs: sinusoids of time with noise.
fn rows<const D: usize>(n: usize) -> Vec<SVector<f64, D>> {
    if let Some(values) = peers(&format!("demos_{n}_{D}")) {
        return values
            .chunks_exact(D)
            .map(SVector::from_column_slice)
            .collect();
    }
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(5);
    (0..n)
        .map(|i| {
            let t = (i % 100) as f64 / 99.0;
            SVector::from_fn(|d, _| {
                let noise = 0.07 * (rng.random::<f64>() - 0.5);
                let x = d as f64;
                if d == 0 {
                    t
                } else {
                    (std::f64::consts::TAU * (0.3 + 0.3 * x) * t + x).sin() + noise
                }
            })
        })
        .collect()
}

/// The peers' start, or one of our own.
fn start<const D: usize>(rows: &[SVector<f64, D>], k: usize) -> Gmm<D> {
    if let Some(v) = peers(&format!("start_{}_{D}_{k}", rows.len())) {
        let (weights, rest) = v.split_at(k);
        let (means, covariances) = rest.split_at(k * D);
        let sum: f64 = weights.iter().sum();
        return Gmm::new((0..k).map(|i| {
            (
                weights[i] / sum,
                SVector::from_column_slice(&means[i * D..][..D]),
                SMatrix::from_row_slice(&covariances[i * D * D..][..D * D]),
            )
        }))
        .expect("the peers' start is a mixture");
    }
    let options = EmOptions {
        components: k,
        max_iterations: 1,
        restarts: 1,
        time_bins: false,
        ..EmOptions::default()
    };
    em::fit(rows, &options).expect("a start").gmm
}

fn thirty<const D: usize>(bencher: divan::Bencher<'_, '_>, n: usize, k: usize) {
    let data = rows::<D>(n);
    let start = start(&data, k);
    let options = EmOptions {
        max_iterations: 30,
        convergence: Convergence::Absolute(0.0),
        ..EmOptions::default()
    };
    bencher.bench_local(|| em::from_start(&data, &start, &options));
}

#[divan::bench(sample_count = 50)]
fn em_30_iterations_500_4_3(bencher: divan::Bencher<'_, '_>) {
    thirty::<4>(bencher, 500, 3);
}

#[divan::bench(sample_count = 30)]
fn em_30_iterations_5000_4_10(bencher: divan::Bencher<'_, '_>) {
    thirty::<4>(bencher, 5000, 10);
}

#[divan::bench(sample_count = 7)]
fn em_30_iterations_50000_4_10(bencher: divan::Bencher<'_, '_>) {
    thirty::<4>(bencher, 50_000, 10);
}

#[divan::bench(sample_count = 3, sample_size = 1)]
fn em_30_iterations_100000_7_20(bencher: divan::Bencher<'_, '_>) {
    thirty::<7>(bencher, 100_000, 20);
}

/// K = 1…15, one k-means++ start each, as the peers' script.
#[divan::bench(args = [1e-3, 1e-6], sample_count = 3, sample_size = 1)]
fn bic_grid_3000_4_15(bencher: divan::Bencher<'_, '_>, tolerance: f64) {
    let data = rows::<4>(3000);
    let options = EmOptions {
        max_iterations: 1000,
        convergence: Convergence::Absolute(tolerance),
        restarts: 1,
        time_bins: false,
        standardise: false,
        ..EmOptions::default()
    };
    bencher.bench_local(|| select::select(&data, 1..=15, 15, &options, |_| ()));
}

fn regression() -> Gmr<1, 3> {
    let data = rows::<4>(5000);
    Gmr::new(&start(&data, 10)).expect("regular")
}

#[divan::bench]
fn gmr_one_query_mean_and_covariance(bencher: divan::Bencher<'_, '_>) {
    let gmr = regression();
    bencher.bench_local(|| gmr.query(divan::black_box(&SVector::from([0.37]))));
}

#[divan::bench]
fn gmr_1000_queries_mean_and_covariance(bencher: divan::Bencher<'_, '_>) {
    let gmr = regression();
    let at: Vec<_> = (0..1000)
        .map(|i| SVector::from([f64::from(i) / 999.0]))
        .collect();
    bencher.bench_local(|| at.iter().map(|x| gmr.query(x)).collect::<Vec<_>>());
}
