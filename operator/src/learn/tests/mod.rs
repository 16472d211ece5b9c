mod few;
mod mixtures;

use std::cell::Cell;

use nalgebra::{Matrix3, SMatrix, SVector, UnitQuaternion, Vector3};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use telemime_protocol::predict::{Forecast, Params};
use telemime_protocol::skill::Gmm;

use super::em::{Convergence, EmOptions, Fit, Start, fit, from_start};
use super::predictor::states;
use super::*;
use crate::demonstration::Sample;

fn vector(name: &str) -> serde_json::Value {
    let path = format!(
        "{}/../tests/vectors/{name}.json",
        env!("CARGO_MANIFEST_DIR")
    );
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

fn number(v: &serde_json::Value) -> f64 {
    v.as_f64().unwrap()
}

fn rows<const D: usize>(v: &serde_json::Value) -> Vec<SVector<f64, D>> {
    let data = v["data"].as_array().unwrap();
    data.iter()
        .map(|x| SVector::from_fn(|i, _| number(&x[i])))
        .collect()
}

fn mixture<const D: usize>(v: &serde_json::Value, keys: [&str; 3]) -> Gmm<D> {
    let k = v[keys[0]].as_array().unwrap().len();
    Gmm::new((0..k).map(|i| {
        (
            number(&v[keys[0]][i]),
            SVector::from_fn(|a, _| number(&v[keys[1]][i][a])),
            SMatrix::from_fn(|a, b| number(&v[keys[2]][i][a][b])),
        )
    }))
    .unwrap()
}

/// Largest difference of two mixtures, relative to the largest entry of each kind.
fn distance<const D: usize>(a: &Gmm<D>, b: &Gmm<D>) -> f64 {
    assert_eq!(a.components().len(), b.components().len());
    let pairs = || a.components().iter().zip(b.components());
    let mean = pairs()
        .map(|(_, b)| b.mean().abs().max())
        .fold(0.0, f64::max);
    pairs()
        .map(|(a, b)| {
            let weight = (a.weight() - b.weight()).abs();
            let mean = (a.mean() - b.mean()).abs().max() / mean;
            let size = b.covariance().abs().max();
            weight
                .max(mean)
                .max((a.covariance() - b.covariance()).abs().max() / size)
        })
        .fold(0.0, f64::max)
}

/// scikit-learn's answer from the same start: the mixture after 1, 2, 5 and all iterations, and every likelihood.
fn same_as_scikit_learn<const D: usize>(name: &str) {
    let v = vector(name);
    let data = rows::<D>(&v);
    let start = mixture::<D>(&v, ["weights_init", "means_init", "covariances_init"]);
    let run = |max_iterations, tolerance| {
        from_start(
            &data,
            &start,
            &EmOptions {
                max_iterations,
                convergence: Convergence::Absolute(tolerance),
                ridge: number(&v["reg_covar"]),
                ..EmOptions::default()
            },
        )
        .unwrap()
    };
    for (n, expected) in v["after_iterations"].as_object().unwrap() {
        let expected = mixture::<D>(expected, ["weights", "means", "covariances"]);
        let gap = distance(&run(n.parse().unwrap(), 0.0).gmm, &expected);
        assert!(gap < 1e-6, "{name} after {n}: {gap:e}");
    }
    let all = run(1000, number(&v["tol"]));
    assert_eq!(all.start, Start::Given);
    assert!(all.converged);
    let died = |d: &em::Degenerate| matches!(d, em::Degenerate::Died { .. });
    assert!(!all.degenerate.iter().any(died));
    assert_eq!(all.iterations as u64, v["n_iter"].as_u64().unwrap());
    let trace = v["loglik_trace"].as_array().unwrap();
    assert_eq!(all.trace.len(), trace.len());
    for (a, b) in all.trace.iter().zip(trace) {
        assert!((a - number(b)).abs() < 1e-6, "{a} {b}");
    }
    let finals = ["final_weights", "final_means", "final_covariances"];
    let gap = distance(&all.gmm, &mixture::<D>(&v, finals));
    assert!(gap < 1e-6, "{name}: {gap:e}");
    assert!((all.score - number(&v["score"])).abs() < 1e-6);
    let k = all.gmm.components().len();
    assert!((select::bic(k, D, all.score, data.len()) - number(&v["bic"])).abs() < 1e-3);
    let parameters = em::Covariance::Full.parameters(k, D) as f64;
    let aic = -2.0 * all.score * data.len() as f64 + 2.0 * parameters;
    assert!((aic - number(&v["aic"])).abs() < 1e-3);
}

#[test]
fn em_from_the_same_start_is_that_of_scikit_learn() {
    same_as_scikit_learn::<2>("gmm_2d_k3");
    same_as_scikit_learn::<4>("gmm_4d_k5");
    same_as_scikit_learn::<7>("gmm_7d_k8");
    same_as_scikit_learn::<3>("gmm_paper_task1_k3");
    same_as_scikit_learn::<3>("gmm_paper_task2_k3");
}

#[test]
fn the_criterion_chooses_as_well_as_fifteen_starts_of_scikit_learn() {
    let data = rows::<4>(&vector("gmm_4d_k5"));
    let grid = vector("bic_grid_4d");
    let options = EmOptions {
        convergence: Convergence::Absolute(1e-6),
        max_iterations: 500,
        ..EmOptions::default()
    };
    let found = select::select(&data, 1..=8, 8, &options, |_| ()).unwrap();
    assert_eq!(found.table.len(), 8);
    for c in &found.table {
        let expected = number(&grid["grid"][c.components.to_string()]["bic"]);
        // One component has no local optimum; more have, on either side.
        let allowed = if c.components == 1 {
            0.1
        } else {
            0.01 * expected.abs()
        };
        assert!(c.bic - expected < allowed, "{c:?}, scikit-learn {expected}");
        if c.components == 1 {
            assert!(
                (c.bic - expected).abs() < allowed,
                "{c:?}, scikit-learn {expected}"
            );
        }
    }
    let best = found.best.gmm.components().len();
    assert!((6..=8).contains(&best), "{best}");
}

/// The responsibilities, log densities and conditionals of the mixture scikit-learn ended with.
fn regression_as_published<const D: usize, const I: usize, const O: usize>(name: &str) {
    let v = vector(name);
    let gmm = mixture::<D>(&v, ["final_weights", "final_means", "final_covariances"]);
    let data = rows::<D>(&v);
    let mut shares = vec![0.0; gmm.components().len()];
    for (i, x) in data.iter().take(20).enumerate() {
        let density = gmm.responsibilities(x, &mut shares);
        assert!((density - number(&v["log_prob_first_20"][i])).abs() < 1e-9);
        for (k, share) in shares.iter().enumerate() {
            let want = number(&v["responsibilities_first_20"][i][k]);
            assert!((share - want).abs() < 1e-9, "{name}: {share} {want}");
        }
    }
    let mut tried = 0;
    for case in v["gmr"].as_array().unwrap() {
        let given: Vec<usize> = serde_json::from_value(case["given"].clone()).unwrap();
        let Ok(given) = <[usize; I]>::try_from(given) else {
            continue;
        };
        let gmr = telemime_protocol::skill::Gmr::<I, O>::with_given(&gmm, given).unwrap();
        for query in case["queries"].as_array().unwrap() {
            let at = gmr.query(&SVector::from_fn(|i, _| number(&query["x"][i])));
            let size = at.covariance.abs().max().max(1.0);
            for a in 0..O {
                let want = number(&query["mean"][a]);
                assert!(
                    (at.mean[a] - want).abs() < 1e-9 * want.abs().max(1.0),
                    "{name}"
                );
                for b in 0..O {
                    let want = number(&query["covariance"][a][b]);
                    assert!((at.covariance[(a, b)] - want).abs() < 1e-9 * size, "{name}");
                }
            }
            tried += 1;
        }
    }
    assert!(tried > 0, "{name}: no conditional was compared");
}

#[test]
fn responsibilities_and_conditionals_are_the_reference_answers() {
    regression_as_published::<2, 1, 1>("gmm_2d_k3");
    regression_as_published::<3, 1, 2>("gmm_paper_task1_k3");
    regression_as_published::<3, 1, 2>("gmm_paper_task2_k3");
    regression_as_published::<4, 1, 3>("gmm_4d_k5");
    regression_as_published::<4, 2, 2>("gmm_4d_k5");
    regression_as_published::<4, 3, 1>("gmm_4d_k5");
    regression_as_published::<7, 1, 6>("gmm_7d_k8");
    regression_as_published::<7, 2, 5>("gmm_7d_k8");
    regression_as_published::<7, 3, 4>("gmm_7d_k8");
}

/// Three noisy blobs in three dimensions.
fn blobs(seed: u64, n: usize) -> Vec<Vector3<f64>> {
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
    (0..n)
        .map(|i| {
            let c = (i % 3) as f64;
            let mut noise = || rng.random::<f64>() + rng.random::<f64>() - 1.0;
            Vector3::new(c + 0.4 * noise(), 0.5 * c * c + 0.3 * noise(), noise() - c)
        })
        .collect()
}

fn exact() -> EmOptions {
    EmOptions {
        components: 3,
        ridge: 0.0,
        convergence: Convergence::Absolute(1e-8),
        max_iterations: 300,
        ..EmOptions::default()
    }
}

fn given() -> Gmm<3> {
    Gmm::new((0..3).map(|i| {
        let c = f64::from(i);
        (
            1.0 / 3.0,
            Vector3::new(c, 0.5 * c, -0.5 * c),
            Matrix3::identity(),
        )
    }))
    .unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn the_likelihood_never_falls(seed: u64, n in 40_usize..200) {
        let f = fit(&blobs(seed, n), &exact()).unwrap();
        if f.degenerate.is_empty() {
            for w in f.trace.windows(2) {
                prop_assert!(w[1] >= w[0] - 1e-10, "{:?}", w);
            }
            prop_assert!(f.score >= f.trace[f.trace.len() - 1] - 1e-10);
        }
    }

    #[test]
    fn the_order_of_rows_does_not_matter(seed: u64, n in 40_usize..120, turn in 1_usize..39) {
        let mut data = blobs(seed, n);
        let a = from_start(&data, &given(), &exact()).unwrap();
        data.reverse();
        data.rotate_left(turn);
        let b = from_start(&data, &given(), &exact()).unwrap();
        prop_assert!(distance(&a.gmm, &b.gmm) < 1e-5);
        prop_assert!((a.score - b.score).abs() < 1e-8);
    }

    #[test]
    fn a_change_of_units_changes_the_answer_alike(seed: u64, scales in proptest::array::uniform3(1e-3..1e3), shift in -10.0..10.0) {
        let data = blobs(seed, 90);
        let scale = Vector3::from(scales);
        let moved: Vec<_> = data.iter().map(|x| x.component_mul(&scale).add_scalar(shift)).collect();
        let options = EmOptions {
            components: 3, convergence: Convergence::Absolute(1e-10), max_iterations: 2000, ..EmOptions::default()
        };
        let (a, b) = (fit(&data, &options).unwrap(), fit(&moved, &options).unwrap());
        let jacobian: f64 = scale.iter().map(|s| s.ln()).sum();
        prop_assert!((a.score - jacobian - b.score).abs() < 1e-6, "{} {}", a.score - jacobian, b.score);
        // Which of two starts that reach the same optimum wins is rounding: densities, not components.
        for (x, y) in data.iter().zip(&moved) {
            let apart = a.gmm.log_density(x) - jacobian - b.gmm.log_density(y);
            prop_assert!(apart.abs() < 1e-3, "{apart}");
        }
    }

    #[test]
    fn any_finite_rows_end_in_a_mixture_or_an_error(
        values in proptest::collection::vec(prop_oneof![
            3 => -1.0..1.0, 1 => Just(0.0), 1 => -1e300..1e300, 1 => -1e-300..1e-300, 1 => -1e11..1e11,
        ], 0..90),
        components in 0_usize..12, ridge in prop_oneof![Just(0.0), Just(1e-6)],
    ) {
        let data: Vec<_> = values.chunks_exact(3).map(Vector3::from_column_slice).collect();
        let options = EmOptions { components, ridge, ..EmOptions::default() };
        if let Ok(f) = fit(&data, &options) {
            prop_assert!(f.score.is_finite());
            prop_assert!(f.trace.iter().all(|l| l.is_finite()));
            prop_assert!(data.iter().all(|x| f.gmm.log_density(x).is_finite()));
        }
    }
}

#[test]
fn a_component_that_dies_is_started_again_and_reported() {
    let data = blobs(3, 90);
    let far = Gmm::new([
        (0.5, Vector3::zeros(), Matrix3::identity()),
        (0.5, Vector3::repeat(1e3), Matrix3::identity() * 1e-3),
    ])
    .unwrap();
    let f: Fit<3> = from_start(&data, &far, &exact()).unwrap();
    assert_eq!(f.degenerate.len(), 1);
    assert!(matches!(
        f.degenerate[0],
        em::Degenerate::Died {
            component: 1,
            remedy: em::Remedy::Reseeded,
            ..
        }
    ));
    let one = from_start(
        &data,
        &Gmm::new([(1.0, Vector3::zeros(), Matrix3::identity())]).unwrap(),
        &exact(),
    );
    assert!(f.score > one.unwrap().score + 0.1);
}

#[test]
fn faults_have_their_own_errors() {
    let data = blobs(1, 30);
    let with = |components| EmOptions {
        components,
        ..EmOptions::default()
    };
    assert_eq!(
        fit(&data, &with(0)),
        Err(LearnError::Components { asked: 0 })
    );
    assert_eq!(
        fit(&data, &with(65)),
        Err(LearnError::Components { asked: 65 })
    );
    assert!(matches!(
        fit(&data, &with(31)),
        Err(LearnError::TooFewRows { .. })
    ));
    let mut spoilt = data.clone();
    spoilt[17].y = f64::NAN;
    assert_eq!(
        fit(&spoilt, &with(2)),
        Err(LearnError::OutOfRange { row: 17 })
    );
    let flat: Vec<_> = data.iter().map(|x| Vector3::new(x.x, x.y, 0.0)).collect();
    assert_eq!(fit(&flat, &exact()), Err(LearnError::Singular));
    assert!(fit(&flat, &with(3)).is_ok());
}

/// A swing at 30 Hz with a performer's variation and millimetres of noise.
fn swing(name: &str, seed: u64, planar: bool) -> Demonstration {
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
    let pace = 1.0 + 0.2 * rng.random::<f64>();
    let size = 0.9 + 0.2 * rng.random::<f64>();
    let samples: Vec<_> = (0..60)
        .map(|i| {
            let t_s = f64::from(i) / 30.0;
            let phase = pace * t_s * 4.0;
            let mut noise = || 0.004 * (rng.random::<f64>() - 0.5);
            let z = if planar {
                0.0
            } else {
                0.1 * (2.0 * phase).sin() + noise()
            };
            Sample::at(
                t_s,
                Vector3::new(
                    size * 0.5 * phase.sin() + noise(),
                    size * 0.3 * (1.0 - phase.cos()) + noise(),
                    z,
                ),
            )
        })
        .collect();
    Demonstration::from_samples(name, &samples).unwrap()
}

#[test]
fn a_skill_is_learned_and_the_same_seed_gives_the_same_bytes() {
    let demos: Vec<_> = (0..4)
        .map(|i| swing(&format!("take {i}"), i, false))
        .collect();
    let held = Cell::new(0);
    let learn = || {
        learn_skill("swing", &demos, &LearnOptions::default(), |p| {
            if let Progress::Held { done, of } = p {
                held.set(done);
                // Four demonstrations, two characters.
                assert_eq!(of, 8);
            }
        })
        .unwrap()
    };
    let skill = learn();
    assert_eq!(held.get(), 8);
    assert_eq!(skill.to_bytes(), learn().to_bytes());
    assert_eq!(Skill::from_bytes(skill.to_bytes()).unwrap(), skill);
    assert!((skill.duration_s() - 59.0 / 30.0).abs() < 1e-9);
    assert!(demos.iter().all(|d| skill.was_trained_on(d.sha256())));

    let unseen = swing("another", 77, false);
    assert!(!skill.was_trained_on(unseen.sha256()));
    let (mut error, mut moved) = (0.0, 0.0);
    for state in states(&unseen) {
        let t_s = state.t.as_secs_f64() + 0.2;
        if t_s < unseen.duration_s() {
            let f: Forecast = skill.predictor().forecast(&state, &Params::DEFAULT);
            let truth = unseen.position_at(t_s);
            error += (f.at(0.2).position - truth).norm_squared();
            moved += (state.x - truth).norm_squared();
        }
    }
    assert!((error / moved).sqrt() < 0.25, "{}", (error / moved).sqrt());
    assert_eq!(Params::DEFAULT.checked().map(|p| p.gain), Ok(1.0));
}

#[test]
fn one_demonstration_and_a_planar_one_are_enough() {
    let one = learn_skill(
        "one",
        &[swing("a", 1, false)],
        &LearnOptions::default(),
        |_| (),
    )
    .unwrap();
    assert_eq!(one.predictor().calibration().covariance, [2.5; 24]);
    let planar: Vec<_> = (0..3).map(|i| swing("p", i, true)).collect();
    let skill = learn_skill("flat", &planar, &LearnOptions::default(), |_| ()).unwrap();
    let state = states(&planar[0]).last().unwrap();
    let f = skill.predictor().forecast(&state, &Params::DEFAULT);
    assert!(f.at(0.3).position.z.abs() < 1e-6);
}

#[test]
fn a_hand_that_stays_still_is_learned_without_a_fault() {
    let samples: Vec<_> = (0..20)
        .map(|i| Sample::at(f64::from(i) * 0.1, Vector3::new(0.1, 0.2, 0.3)))
        .collect();
    let demos = [
        Demonstration::from_samples("a", &samples).unwrap(),
        Demonstration::from_samples("b", &samples).unwrap(),
    ];
    let skill = learn_skill("still", &demos, &LearnOptions::default(), |_| ()).unwrap();
    let state = states(&demos[0]).last().unwrap();
    let f = skill.predictor().forecast(&state, &Params::DEFAULT);
    assert!((f.at(0.3).position - state.x).norm() < 1e-6);
}

#[test]
fn names_and_counts_that_no_skill_can_have_are_refused() {
    let demos = [swing("a", 1, false)];
    let learn = |name: &str, demos: &[Demonstration]| {
        learn_skill(name, demos, &LearnOptions::default(), |_| ()).unwrap_err()
    };
    assert_eq!(learn("x", &[]), LearnError::NoDemonstrations);
    assert!(matches!(
        learn("", &demos),
        LearnError::Skill(SkillError::Name { .. })
    ));
}

#[test]
fn recordings_that_show_unlike_things_are_refused_with_the_file_and_the_remedy() {
    let bare = swing("bare", 1, false);
    let posed = |orientation: bool| {
        let samples: Vec<_> = swing("posed", 2, false)
            .samples()
            .iter()
            .map(|s| Sample {
                orientation: orientation.then(UnitQuaternion::identity),
                grip: (!orientation).then_some(0.5),
                ..*s
            })
            .collect();
        Demonstration::from_samples("posed", &samples).unwrap()
    };
    for (orientation, column) in [(true, "qw,qx,qy,qz"), (false, "grip")] {
        let both = [posed(orientation), bare.clone()];
        let refused = learn_skill("mixed", &both, &LearnOptions::default(), |_| ());
        let Err(LearnError::Mixed { .. }) = refused else {
            panic!("{refused:?}");
        };
        let text = refused.unwrap_err().to_string();
        assert!(
            text.contains(column) && text.contains("which posed has"),
            "{text}"
        );
        assert!(
            text.starts_with(&bare.path().display().to_string()),
            "{text}"
        );
    }
}
