//! Covariance families, variational mixtures, degenerate data, refinement.

use nalgebra::{SMatrix, SVector, Vector2, Vector3};
use proptest::prelude::*;
use telemime_protocol::skill::Gmm;

use super::super::LearnError;
use super::super::em::{
    self, Convergence, Covariance, Degenerate, EmOptions, fit, from_start, update,
};
use super::super::variational::{self, VariationalOptions, WeightPrior};
use super::{blobs, distance, mixture, rows, vector};

fn options(components: usize) -> EmOptions {
    EmOptions {
        components,
        convergence: Convergence::Absolute(1e-7),
        max_iterations: 300,
        ..EmOptions::default()
    }
}

#[test]
fn fewer_parameters_fit_worse_and_hold_their_form() {
    let data = rows::<4>(&vector("gmm_4d_k5"));
    let of = |covariance| {
        fit(
            &data,
            &EmOptions {
                covariance,
                ..options(4)
            },
        )
        .unwrap()
    };
    let [full, tied, diagonal] = Covariance::ALL.map(of);
    assert!(full.score > tied.score && full.score > diagonal.score);
    let first = *tied.gmm.components()[0].covariance();
    for c in tied.gmm.components() {
        assert!((c.covariance() - first).abs().max() < 1e-12);
    }
    assert!(first[(1, 0)].abs() > 1e-6);
    for c in diagonal.gmm.components() {
        let s = c.covariance();
        assert_eq!(*s, SMatrix::from_diagonal(&s.diagonal()));
    }
    for f in [&full, &tied, &diagonal] {
        for w in f.trace.windows(2) {
            assert!(w[1] >= w[0] - 1e-6, "{w:?}");
        }
    }
    assert_eq!(
        Covariance::ALL.map(|c| c.parameters(3, 4)),
        [2 + 12 + 30, 2 + 12 + 10, 2 + 12 + 12]
    );
}

#[test]
fn the_answer_does_not_depend_on_the_number_of_threads() {
    let data = blobs(4, 20_000);
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build();
    let four = rayon::ThreadPoolBuilder::new().num_threads(4).build();
    let run = |pool: rayon::ThreadPool| {
        pool.install(|| {
            let em = EmOptions {
                max_iterations: 5,
                ..options(3)
            };
            let variational = VariationalOptions {
                components: 4,
                restarts: 3,
                max_iterations: 5,
                ..VariationalOptions::default()
            };
            (
                fit(&data, &em).unwrap(),
                variational::fit(&data, &variational).unwrap(),
            )
        })
    };
    assert_eq!(run(one.unwrap()), run(four.unwrap()));
}

#[test]
fn variational_mixtures_are_those_of_scikit_learn() {
    let data = rows::<4>(&vector("gmm_4d_k5"));
    let v = vector("variational_4d_k5");
    let labels: Vec<usize> = serde_json::from_value(v["labels"].clone()).unwrap();
    for (name, weights) in [
        ("process", WeightPrior::Process),
        ("distribution", WeightPrior::Distribution),
    ] {
        for (n, expected) in v[name].as_object().unwrap() {
            let options = VariationalOptions {
                components: 5,
                weights,
                max_iterations: n.parse().unwrap(),
                tolerance: 0.0,
                ..VariationalOptions::default()
            };
            let found = variational::from_labels(&data, &labels, &options).unwrap();
            let expected = mixture::<4>(expected, ["weights", "means", "covariances"]);
            let gap = distance(&found.gmm, &expected);
            assert!(gap < 1e-6, "{name} after {n}: {gap:e}");
        }
    }
}

#[test]
fn a_variational_mixture_needs_no_more_components_than_there_are() {
    let data = blobs(5, 600);
    for weights in [WeightPrior::Process, WeightPrior::Distribution] {
        let found = variational::fit(
            &data,
            &VariationalOptions {
                components: 10,
                weights,
                concentration: Some(1e-3),
                max_iterations: 1000,
                ..VariationalOptions::default()
            },
        )
        .unwrap();
        assert!(found.converged);
        assert!(found.effective_components() <= 5, "{:?}", found.samples);
        assert!(found.effective_components() >= 3, "{:?}", found.samples);
    }
}

/// Rows of every kind that spans no volume.
fn flat() -> Vec<(&'static str, Vec<Vector3<f64>>)> {
    let t = |i: i32| f64::from(i) * 0.1;
    vec![
        ("one point", vec![Vector3::new(0.3, -2.0, 1e3); 40]),
        (
            "two rows",
            vec![Vector3::zeros(), Vector3::new(1.0, 2.0, 3.0)],
        ),
        (
            "a line",
            (0..40)
                .map(|i| Vector3::new(t(i), 2.0 * t(i), -t(i)))
                .collect(),
        ),
        (
            "a constant axis",
            (0..40)
                .map(|i| Vector3::new(t(i), t(i).sin(), 0.7))
                .collect(),
        ),
        (
            "the same demonstration four times",
            (0..160)
                .map(|i| Vector3::new(t(i % 40), t(i % 40).sin(), t(i % 40).cos()))
                .collect(),
        ),
        (
            "one far away",
            (0..40)
                .map(|i| Vector3::repeat(if i == 7 { 1e6 } else { 0.0 }))
                .collect(),
        ),
    ]
}

#[test]
fn data_without_volume_end_in_a_mixture_and_a_report() {
    for (name, data) in flat() {
        for covariance in Covariance::ALL {
            for k in [1, 2, 5].into_iter().filter(|k| *k <= data.len()) {
                let f = fit(
                    &data,
                    &EmOptions {
                        covariance,
                        ..options(k)
                    },
                )
                .unwrap();
                assert!(f.score.is_finite(), "{name} {k}");
                assert!(
                    covariance == Covariance::Diagonal
                        || !f.degenerate.is_empty()
                        || name.starts_with("the same"),
                    "{name} {k}"
                );
                for d in &f.degenerate {
                    assert!(!d.to_string().is_empty());
                }
            }
        }
        for weights in [WeightPrior::Process, WeightPrior::Distribution] {
            let options = VariationalOptions {
                components: 2,
                weights,
                ..VariationalOptions::default()
            };
            let found = variational::fit(&data, &options).unwrap();
            assert!(found.trace.iter().all(|b| b.is_finite()), "{name}");
        }
    }
    let (_, line) = flat().swap_remove(2);
    let f = fit(&line, &options(2)).unwrap();
    for axis in [1, 2] {
        let floored = Degenerate::Floored {
            axis,
            components: 2,
        };
        assert!(f.degenerate.contains(&floored), "{:?}", f.degenerate);
    }
    let (_, still) = flat().swap_remove(3);
    let f = fit(&still, &options(2)).unwrap();
    assert!(f.degenerate.contains(&Degenerate::Constant { axis: 2 }));
}

#[test]
fn a_component_of_few_samples_is_shrunk_and_said_to_be() {
    let mut data = blobs(6, 60);
    data.push(Vector3::new(30.0, 30.0, 30.0));
    data.push(Vector3::new(30.5, 30.0, 30.2));
    let f = fit(&data, &options(4)).unwrap();
    let shrunk = f.degenerate.iter().any(
        |d| matches!(d, Degenerate::Shrunk { samples, share, .. } if *samples < 4.0 && *share > 0.0),
    );
    assert!(shrunk, "{:?}", f.degenerate);
    let pair = f
        .gmm
        .components()
        .iter()
        .find(|c| c.mean().x > 20.0)
        .unwrap();
    let least = pair.factor().diagonal().min();
    assert!(least > 1e-2, "{least}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]

    #[test]
    fn the_bound_never_falls(seed: u64, n in 40_usize..150, k in 1_usize..7, process: bool) {
        let options = VariationalOptions {
            components: k,
            weights: if process { WeightPrior::Process } else { WeightPrior::Distribution },
            ridge: 0.0, tolerance: 1e-9, max_iterations: 200, seed,
            ..VariationalOptions::default()
        };
        let found = variational::fit(&blobs(seed, n), &options).unwrap();
        for w in found.trace.windows(2) {
            prop_assert!(w[1] >= w[0] - 1e-8 * w[0].abs().max(1.0), "{:?}", w);
        }
    }

    #[test]
    fn any_finite_rows_end_in_a_variational_mixture_or_an_error(
        values in proptest::collection::vec(prop_oneof![
            3 => -1.0..1.0, 1 => Just(0.0), 1 => -1e300..1e300, 1 => -1e-300..1e-300, 1 => -1e11..1e11,
        ], 0..60),
        components in 0_usize..8, ridge in prop_oneof![Just(0.0), Just(1e-6)],
    ) {
        let data: Vec<_> = values.chunks_exact(3).map(Vector3::from_column_slice).collect();
        let options = VariationalOptions { components, ridge, ..VariationalOptions::default() };
        if let Ok(f) = variational::fit(&data, &options) {
            prop_assert!(f.trace.iter().all(|l| l.is_finite()));
        }
    }

    #[test]
    fn a_rotation_of_the_data_rotates_the_mixture(seed: u64, angle in -3.0..3.0_f64) {
        let data = blobs(seed, 120);
        let turn = nalgebra::Rotation3::from_euler_angles(angle, 0.3 * angle, -angle);
        let moved: Vec<_> = data.iter().map(|x| turn * x).collect();
        let start = Gmm::new((0..3).map(|i| {
            (1.0 / 3.0, data[i], SMatrix::identity())
        })).unwrap();
        let turned = Gmm::new((0..3).map(|i| {
            (1.0 / 3.0, moved[i], SMatrix::identity())
        })).unwrap();
        let few = EmOptions { max_iterations: 20, ridge: 1e-9, convergence: Convergence::Absolute(0.0), shrink_small: false, ..options(3) };
        let (a, b) = (from_start(&data, &start, &few).unwrap(), from_start(&moved, &turned, &few).unwrap());
        if a.degenerate.is_empty() && b.degenerate.is_empty() {
            prop_assert!((a.score - b.score).abs() < 1e-7, "{} {}", a.score, b.score);
            for (a, b) in a.gmm.components().iter().zip(b.gmm.components()) {
                prop_assert!((turn * a.mean() - b.mean()).norm() < 1e-5);
            }
        }
    }
}

/// Rows (t, x) of one of many performances of the same motion.
fn performance(seed: u64) -> Vec<Vector2<f64>> {
    let own = (seed as f64 * 1.7).sin();
    (0..120)
        .map(|i| {
            let t = f64::from(i) / 119.0;
            let noise = (f64::from(i) * 12.9898 + seed as f64 * 78.233).sin() * 43_758.5453;
            let noise = noise - noise.floor() - 0.5;
            Vector2::new(
                t,
                ((6.0 + 0.2 * own) * t).sin() * (1.0 + 0.1 * own) + 0.05 * noise,
            )
        })
        .collect()
}

fn score(gmm: &Gmm<2>, rows: &[Vector2<f64>]) -> f64 {
    rows.iter().map(|x| gmm.log_density(x)).sum::<f64>() / rows.len() as f64
}

#[test]
fn a_fourth_demonstration_refines_nearly_as_if_all_four_were_there() {
    let in_units = EmOptions {
        standardise: false,
        ..options(6)
    };
    let three: Vec<_> = (1..4).flat_map(performance).collect();
    let all: Vec<_> = (1..5).flat_map(performance).collect();
    let before = fit(&three, &in_units).unwrap().gmm;
    let batch = fit(&all, &in_units).unwrap().gmm;
    let after = update(&before, three.len() as f64, &performance(4), &in_units).unwrap();
    assert_eq!(after.effective_samples, all.len() as f64);
    for w in after.trace.windows(2) {
        assert!(w[1] >= w[0] - 1e-3, "{w:?}");
    }
    let unseen: Vec<_> = (10..20).flat_map(performance).collect();
    let [old, new, best] = [&before, &after.gmm, &batch].map(|g| score(g, &unseen));
    println!("held out: three {old:.4}, refined {new:.4}, all four {best:.4}");
    assert!(new > old, "{old} {new}");
    assert!(best - new < 0.05, "{new} {best}");
}

#[test]
fn forty_refinements_neither_collapse_nor_blow_up() {
    let in_units = EmOptions {
        standardise: false,
        ..options(6)
    };
    let mut gmm = fit(&performance(1), &in_units).unwrap().gmm;
    let mut samples = 120.0;
    for seed in 2..42 {
        let next = update(&gmm, samples, &performance(seed), &in_units).unwrap();
        (gmm, samples) = (next.gmm, next.effective_samples);
    }
    assert_eq!(samples, 41.0 * 120.0);
    assert_eq!(gmm.components().len(), 6);
    let unseen: Vec<_> = (100..120).flat_map(performance).collect();
    let all: Vec<_> = (1..42).flat_map(performance).collect();
    let batch = fit(&all, &in_units).unwrap().gmm;
    let [refined, best] = [&gmm, &batch].map(|g| score(g, &unseen));
    println!("held out: refined forty times {refined:.4}, all at once {best:.4}");
    assert!(best - refined < 0.1, "{refined} {best}");
}

#[test]
fn refinement_refuses_what_it_cannot_use() {
    let gmm = Gmm::new([(1.0, Vector2::zeros(), SMatrix::identity())]).unwrap();
    let options = options(1);
    assert_eq!(
        update(&gmm, 0.0, &[Vector2::zeros()], &options),
        Err(LearnError::EffectiveSamples { found: 0.0 })
    );
    assert_eq!(
        update(&gmm, 10.0, &[Vector2::new(0.0, f64::NAN)], &options),
        Err(LearnError::OutOfRange { row: 0 })
    );
    assert_eq!(update(&gmm, 10.0, &[], &options).unwrap().gmm, gmm);
    // One row is enough, and pulls as much as it weighs.
    let one = update(&gmm, 9.0, &[SVector::from([10.0, 0.0])], &options).unwrap();
    assert!((one.gmm.components()[0].mean().x - 1.0).abs() < 1e-9);
    let again = em::update(&gmm, 9.0, &[SVector::from([10.0, 0.0])], &options).unwrap();
    assert_eq!(one, again);
}
