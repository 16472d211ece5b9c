//! Checkpoints chosen and read: `cargo bench -p telemime-protocol --bench checkpoints`.

use divan::counter::ItemsCount;
use divan::{Bencher, black_box};
use nalgebra::{SVector, Vector3};
use telemime_protocol::checkpoint::Plan;
use telemime_protocol::checkpoint::path::{PathDecoder, PathEncoder};
use telemime_protocol::checkpoint::select::{Effort, Selector};
use telemime_protocol::pose::exp;
use telemime_protocol::time::Stamp;

fn main() {
    divan::main();
}

fn swing(rate_hz: f64, samples: u32) -> (Vec<f64>, Vec<Vector3<f64>>) {
    let at = |t: f64| {
        Vector3::new(
            0.4 * libm::sin(3.0 * t),
            0.2 * libm::cos(5.0 * t),
            0.1 * libm::sin(7.0 * t),
        )
    };
    (0..samples)
        .map(|i| f64::from(i) / rate_hz)
        .map(|t| (t, at(t)))
        .unzip()
}

/// 300 samples in three dimensions.
#[divan::bench(args = [Effort::Quick, Effort::Brisk, Effort::Thorough])]
fn selection(bencher: Bencher, effort: Effort) {
    let (t, x) = swing(30.0, 300);
    let mut selector = Selector::new();
    bencher.bench_local(|| {
        selector
            .bounded(&t, &x, black_box(0.002), effort)
            .map(Plan::len)
    });
}

/// 46 of 300 samples in three dimensions.
#[divan::bench(args = [Effort::Brisk, Effort::Thorough])]
fn selection_of_a_number(bencher: Bencher, effort: Effort) {
    let (t, x) = swing(30.0, 300);
    let mut selector = Selector::new();
    bencher.bench_local(|| {
        selector
            .counted(&t, &x, black_box(46), effort)
            .map(Plan::len)
    });
}

/// A second of samples at 1 kHz, a sample an item.
#[divan::bench(args = [0.0005, 0.002, 0.01])]
fn live_encoding(bencher: Bencher, bound_m: f64) {
    let (t, x) = swing(1000.0, 1000);
    let samples: Vec<_> = t
        .iter()
        .zip(&x)
        .map(|(t, x)| (Stamp::from_secs_f64(*t), *x))
        .collect();
    bencher
        .counter(ItemsCount::new(samples.len()))
        .with_inputs(|| PathEncoder::new(bound_m).expect("a bound"))
        .bench_values(|mut encoder| {
            for (t, x) in &samples {
                black_box(encoder.push(*t, *x).expect("a sample"));
            }
        });
}

/// The same of a place and an orientation in ℝ⁴.
#[divan::bench(args = [0.0005, 0.002, 0.01])]
fn live_encoding_of_poses(bencher: Bencher, bound_m: f64) {
    let samples = turning();
    bencher
        .counter(ItemsCount::new(samples.len()))
        .with_inputs(|| PathEncoder::with_bounds(3, [bound_m, 0.01]).expect("bounds"))
        .bench_values(|mut encoder| {
            for (t, x) in &samples {
                black_box(encoder.push(*t, *x).expect("a sample"));
            }
        });
}

/// A second at 1 kHz.
fn turning() -> Vec<(Stamp, SVector<f64, 7>)> {
    let (t, x) = swing(1000.0, 1000);
    let pose = |(t, x): (&f64, &Vector3<f64>)| {
        let q = exp(&(Vector3::new(1.0, 0.2, libm::sin(*t)) * (1.5 * t)));
        let all = x.iter().chain(q.coords.iter()).copied();
        (Stamp::from_secs_f64(*t), SVector::from_iterator(all))
    };
    t.iter().zip(&x).map(pose).collect()
}

/// A knot of a pose appended, and the path read at its frontier.
#[divan::bench]
fn live_decoding_of_poses(bencher: Bencher) {
    let mut encoder = PathEncoder::with_bounds(3, [0.002, 0.01]).expect("bounds");
    let pushed = turning()
        .into_iter()
        .filter_map(|(t, x)| encoder.push(t, x).expect("a sample"));
    let knots: Vec<_> = pushed.collect();
    let grid = encoder.grid();
    bencher
        .counter(ItemsCount::new(knots.len()))
        .with_inputs(|| PathDecoder::new(grid, 64))
        .bench_values(|mut decoder| {
            for knot in &knots {
                decoder.append(knot).expect("a knot that fits");
                black_box(decoder.eval(decoder.frontier().expect("a knot")));
            }
        });
}

/// A knot appended, and the path read at its frontier.
#[divan::bench]
fn live_decoding(bencher: Bencher) {
    let (t, x) = swing(100.0, 2000);
    let mut encoder = PathEncoder::new(0.002).expect("a bound");
    let knots: Vec<_> = t
        .iter()
        .zip(&x)
        .filter_map(|(t, x)| {
            encoder
                .push(Stamp::from_secs_f64(*t), *x)
                .expect("a sample")
        })
        .collect();
    let grid = encoder.grid();
    bencher
        .counter(ItemsCount::new(knots.len()))
        .with_inputs(|| PathDecoder::new(grid, 64))
        .bench_values(|mut decoder| {
            for knot in &knots {
                decoder.append(knot).expect("a knot that fits");
                black_box(decoder.eval(decoder.frontier().expect("a knot")));
            }
        });
}

/// A finished motion read at one moment.
#[divan::bench]
fn plan_evaluation(bencher: Bencher) {
    let (t, x) = swing(30.0, 300);
    let mut selector = Selector::new();
    let plan = selector
        .bounded(&t, &x, 0.002, Effort::Quick)
        .expect("a plan");
    let curve = plan.spline().expect("a curve");
    bencher.bench(|| curve.eval(black_box(4.321)));
}
