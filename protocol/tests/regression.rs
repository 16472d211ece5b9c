//! Regression as its callers see it: derivatives, open coordinates, regions of confidence, no allocation.
#![allow(
    clippy::unwrap_used,
    reason = "clippy.toml allows it in tests, but does not know these helpers for tests"
)]

use allocation_counter::measure;
use nalgebra::{Matrix2, Matrix3, SMatrix, SVector, Vector1, Vector2, Vector3};
use proptest::prelude::*;
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;
use telemime_protocol::skill::{
    Gmm, Gmr, GmrError, Pace, Regressed, chi_squared_cdf, chi_squared_quantile,
};

fn mixture<const D: usize>(name: &str, k: usize) -> Gmm<D> {
    let path = format!(
        "{}/../tests/vectors/{name}.json",
        env!("CARGO_MANIFEST_DIR")
    );
    let v: serde_json::Value = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    let number = |v: &serde_json::Value| v.as_f64().unwrap();
    Gmm::new((0..k).map(|i| {
        (
            number(&v["final_weights"][i]),
            SVector::from_fn(|a, _| number(&v["final_means"][i][a])),
            SMatrix::from_fn(|a, b| number(&v["final_covariances"][i][a][b])),
        )
    }))
    .unwrap()
}

/// The derivative by central differences of two steps, extrapolated (Richardson): error of order step⁴.
fn differences<const I: usize, const O: usize>(
    gmr: &Gmr<I, O>,
    x: &SVector<f64, I>,
    step: f64,
) -> SMatrix<f64, O, I> {
    let mut slope = SMatrix::<f64, O, I>::zeros();
    for i in 0..I {
        let central = |h: f64| {
            let mut e = SVector::<f64, I>::zeros();
            e[i] = h;
            (gmr.query(&(x + e)).mean - gmr.query(&(x - e)).mean) / (2.0 * h)
        };
        let d = (central(0.5 * step) * 4.0 - central(step)) / 3.0;
        slope.set_column(i, &d);
    }
    slope
}

/// Holds the derivative against differences at the mean of every component and between all of them, where
/// responsibilities change fastest.
fn slopes_agree<const D: usize, const I: usize, const O: usize>(gmm: &Gmm<D>, given: [usize; I]) {
    let gmr = Gmr::<I, O>::with_given(gmm, given).unwrap();
    let input = |k: usize| {
        let c = &gmm.components()[k];
        SVector::<f64, I>::from_fn(|a, _| c.mean()[given[a]])
    };
    let mut bent = 0.0_f64;
    for a in 0..gmm.components().len() {
        for b in a..gmm.components().len() {
            let x = (input(a) + input(b)) * 0.5;
            let moving = gmr.query_moving(&x);
            assert_eq!(moving.at, gmr.query(&x));
            let expected = differences(&gmr, &x, 3e-5);
            let size = expected.abs().max().max(1e-3);
            let gap = (moving.slope - expected).abs().max() / size;
            assert!(gap < 1e-6, "{given:?} {a} {b}: {gap:e}");
            let rate = SVector::<f64, I>::repeat(0.7);
            let along = gmr.query(&(x + rate * 1e-6)).mean - gmr.query(&(x - rate * 1e-6)).mean;
            let gap = (moving.velocity(&rate) - along / 2e-6).norm() / size;
            assert!(gap < 1e-3, "{given:?} {a} {b}: {gap:e}");
            // On a straight line the responsibilities' share of the derivative would go untested.
            let nearest = gmr.query_moving(&(x + (input(a) - x) * 1e-3)).slope;
            bent = bent.max((nearest - moving.slope).abs().max() / size);
        }
    }
    assert!(bent > 1e-4, "{given:?}: the regression is a straight line");
}

#[test]
fn the_velocity_is_the_derivative_of_the_mean() {
    let two = mixture::<2>("gmm_2d_k3", 3);
    slopes_agree::<2, 1, 1>(&two, [0]);
    slopes_agree::<2, 1, 1>(&two, [1]);
    let four = mixture::<4>("gmm_4d_k5", 5);
    slopes_agree::<4, 1, 3>(&four, [0]);
    slopes_agree::<4, 2, 2>(&four, [3, 1]);
    slopes_agree::<4, 3, 1>(&four, [0, 2, 3]);
    let seven = mixture::<7>("gmm_7d_k8", 8);
    slopes_agree::<7, 1, 6>(&seven, [0]);
    slopes_agree::<7, 4, 3>(&seven, [6, 0, 4, 2]);
}

#[test]
fn far_away_the_slope_is_that_of_what_is_answered() {
    let gmm = mixture::<4>("gmm_4d_k5", 5);
    let gmr = Gmr::<1, 3>::new(&gmm).unwrap();
    for x in [50.0, -1e6, 1e160, f64::MAX, f64::INFINITY, f64::NAN] {
        let x = Vector1::new(x);
        let moving = gmr.query_moving(&x);
        assert!(moving.slope.iter().all(|v| v.is_finite()), "{x}");
    }
    // Linear there, so the slope leads from one answer to the next.
    let (a, b) = (
        gmr.query_moving(&Vector1::new(50.0)),
        gmr.query(&Vector1::new(70.0)),
    );
    let gap = (a.at.mean + a.slope * Vector1::new(20.0) - b.mean).norm();
    assert!(gap < 1e-6 * b.mean.norm(), "{gap:e}");
}

#[test]
fn what_is_neither_given_nor_wanted_is_left_open() {
    let gmm = mixture::<7>("gmm_7d_k8", 8);
    let whole = Gmr::<2, 5>::with_given(&gmm, [5, 1]).unwrap();
    let part = Gmr::<2, 2>::between(&gmm, [5, 1], [6, 2]).unwrap();
    let swapped = Gmr::<2, 2>::between(&gmm, [1, 5], [2, 6]).unwrap();
    for c in gmm.components() {
        let x = Vector2::new(c.mean()[5] + 0.1, c.mean()[1] - 0.2);
        // Ascending, the others are 0, 2, 3, 4, 6.
        let (all, two, back) = (
            whole.query(&x),
            part.query(&x),
            swapped.query(&Vector2::new(x.y, x.x)),
        );
        let mean = Vector2::new(all.mean[4], all.mean[1]);
        let covariance = Matrix2::new(
            all.covariance[(4, 4)],
            all.covariance[(4, 1)],
            all.covariance[(1, 4)],
            all.covariance[(1, 1)],
        );
        assert!((two.mean - mean).norm() < 1e-12 * mean.norm());
        assert!((two.covariance - covariance).norm() < 1e-12 * covariance.norm());
        let mirrored = Vector2::new(back.mean.y, back.mean.x);
        assert!((two.mean - mirrored).norm() < 1e-9 * mean.norm());
    }
    assert_eq!(
        Gmr::<1, 1>::between(&gmm, [3], [3]).unwrap_err(),
        GmrError::Repeated { index: 3 }
    );
    assert_eq!(
        Gmr::<1, 1>::between(&gmm, [3], [7]).unwrap_err(),
        GmrError::OutOfRange {
            index: 7,
            dimensions: 7
        }
    );
}

#[test]
fn with_nothing_given_the_answer_is_the_mixture_s_own() {
    let gmm = mixture::<2>("gmm_2d_k3", 3);
    let at = Gmr::<0, 2>::with_given(&gmm, [])
        .unwrap()
        .query(&SVector::<f64, 0>::zeros());
    let mean: Vector2<f64> = gmm.components().iter().map(|c| c.mean() * c.weight()).sum();
    let second: Matrix2<f64> = gmm
        .components()
        .iter()
        .map(|c| (c.covariance() + c.mean() * c.mean().transpose()) * c.weight())
        .sum();
    assert!((at.mean - mean).norm() < 1e-12);
    assert!((at.covariance - (second - mean * mean.transpose())).norm() < 1e-12);
}

/// A motion told over phase is the motion told over time, and its slope the velocity times the duration.
#[test]
fn phase_is_time_in_another_unit() {
    let over_time = mixture::<4>("gmm_4d_k5", 5);
    let duration = 2.5;
    let scale = SMatrix::<f64, 4, 4>::from_diagonal(&[1.0 / duration, 1.0, 1.0, 1.0].into());
    let over_phase = Gmm::new(over_time.components().iter().map(|c| {
        (
            c.weight(),
            scale * c.mean(),
            scale * c.covariance() * scale.transpose(),
        )
    }))
    .unwrap();
    let (time, phase) = (
        Gmr::<1, 3>::new(&over_time).unwrap(),
        Gmr::<1, 3>::new(&over_phase).unwrap(),
    );
    for i in 0..=20 {
        let p = f64::from(i) / 20.0;
        let a = time.query_moving(&Vector1::new(p * duration));
        let b = phase.query_moving(&Vector1::new(p));
        assert!((a.at.mean - b.at.mean).norm() < 1e-9);
        assert!((a.at.covariance - b.at.covariance).norm() < 1e-9);
        assert!((a.slope * duration - b.slope).norm() < 1e-8 * b.slope.norm().max(1.0));
    }
}

const COUNT: usize = 40_000;

/// The share of draws from N(mean, LLᵀ) inside each region, with the region's own arithmetic.
fn covered(l: &Matrix3<f64>, seed: u64, p: f64, degrees: u32) -> f64 {
    let at = Regressed {
        mean: Vector3::new(1.0, -2.0, 0.3),
        covariance: l * l.transpose(),
    };
    let radius2 = chi_squared_quantile(p, degrees).unwrap();
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
    let inside = (0..COUNT)
        .filter(|_| {
            let z = Vector3::from_fn(|_, _| StandardNormal.sample(&mut rng));
            at.distance2(&(at.mean + l * z)).unwrap() <= radius2
        })
        .count();
    inside as f64 / COUNT as f64
}

#[test]
fn a_region_of_confidence_p_holds_p() {
    let l = Matrix3::new(0.05, 0.0, 0.0, 0.03, 0.002, 0.0, -0.01, 0.001, 0.4);
    for (seed, p) in [(1, 0.1), (2, 0.5), (3, 0.6827), (4, 0.95), (5, 0.99)] {
        let share = covered(&l, seed, p, 3);
        // Four deviations of a binomial share.
        let slack = 4.0 * (p * (1.0 - p) / COUNT as f64).sqrt();
        assert!((share - p).abs() < slack, "{share} for {p}");
    }
    // With d − 1 degrees of freedom, as elsewhere, the region of 95 % holds 89 %.
    let short = covered(&l, 4, 0.95, 2);
    assert!((short - 0.888).abs() < 0.006, "{short}");
    let cdf = chi_squared_cdf(chi_squared_quantile(0.95, 2).unwrap(), 3).unwrap();
    assert!((cdf - short).abs() < 0.006, "{cdf} {short}");
}

#[test]
fn regions_are_measured_in_deviations() {
    let l = Matrix3::new(0.05, 0.0, 0.0, 0.03, 0.002, 0.0, -0.01, 0.001, 0.4);
    let at = Regressed {
        mean: Vector3::new(1.0, -2.0, 0.3),
        covariance: l * l.transpose(),
    };
    let radius2 = chi_squared_quantile(0.95, 3).unwrap();
    let axes = at.axes(radius2);
    for i in 0..3 {
        // The end of every axis is on the surface.
        let d = at.distance2(&(at.mean + axes.column(i))).unwrap();
        assert!((d - radius2).abs() < 1e-9 * radius2, "{d}");
    }
    // The box around the ellipsoid: the root of the sum of the squared axes, coordinate by coordinate.
    let reach = Vector3::from_fn(|i, _| axes.row(i).norm());
    assert!((reach - at.half_widths(radius2)).norm() < 1e-12);
    let one = Regressed {
        covariance: SMatrix::<f64, 3, 3>::zeros(),
        ..at
    };
    assert_eq!(one.distance2(&at.mean), None);
    assert_eq!(at.distance2(&Vector3::repeat(f64::NAN)), None);
}

#[test]
fn a_pace_has_its_quantiles() {
    let pace = Pace {
        mean_ln_s: libm::log(2.0),
        deviation_ln: 0.1,
    };
    let at = |p| pace.quantile_s(p).unwrap();
    assert!((at(0.5) - 2.0).abs() < 1e-12);
    // One deviation to either side holds 68.27 %.
    assert!((at(0.841_344_746_068_542_9) - 2.0 * libm::exp(0.1)).abs() < 1e-12);
    assert!((at(0.158_655_253_931_457_05) - 2.0 * libm::exp(-0.1)).abs() < 1e-12);
    assert!((at(0.975) - 2.0 * libm::exp(0.195_996_398_454_005_4)).abs() < 1e-12);
    for p in [0.0, 1.0, -0.5, f64::NAN] {
        assert_eq!(pace.quantile_s(p), None);
    }
}

#[test]
fn queries_never_touch_the_heap() {
    let counted = measure(|| drop(std::hint::black_box(Box::new(1_u64))));
    assert_eq!((counted.count_total, counted.count_current), (1, 0));

    let gmm = mixture::<4>("gmm_4d_k5", 5);
    let gmr = Gmr::<1, 3>::new(&gmm).unwrap();
    let xs: Vec<_> = (0..100)
        .map(|i| Vector1::new(f64::from(i) * 0.05 - 1.0))
        .collect();
    let mut out = vec![gmr.query(&xs[0]); xs.len()];
    let used = measure(|| {
        gmr.query_into(&xs, &mut out);
        for (x, at) in xs.iter().zip(&out) {
            let moving = gmr.query_moving(x);
            assert_eq!(moving.at, *at);
            let radius2 = chi_squared_quantile(0.95, 3).unwrap();
            std::hint::black_box((at.distance2(&Vector3::zeros()), at.axes(radius2)));
        }
    });
    assert_eq!((used.count_total, used.count_current), (0, 0));
}

proptest! {
    /// Regression of one normal distribution: coverage needs the conditional, exactly.
    #[test]
    fn one_component_is_linear_regression(
        a in -3.0..3.0_f64, b in -3.0..3.0_f64, noise in 0.01..2.0_f64, at in -5.0..5.0_f64,
    ) {
        // x ~ N(1, 4), y = a + b·x + N(0, noise²).
        let gmm = Gmm::new([(
            1.0,
            Vector2::new(1.0, a + b),
            Matrix2::new(4.0, 4.0 * b, 4.0 * b, 4.0 * b * b + noise * noise),
        )])
        .unwrap();
        let moving = Gmr::<1, 1>::new(&gmm).unwrap().query_moving(&Vector1::new(at));
        prop_assert!((moving.at.mean[0] - (a + b * at)).abs() < 1e-10);
        prop_assert!((moving.at.covariance[(0, 0)] - noise * noise).abs() < 1e-10);
        prop_assert!((moving.slope[(0, 0)] - b).abs() < 1e-12);
    }
}
