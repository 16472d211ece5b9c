use nalgebra::{SMatrix, SVector, UnitQuaternion};
use proptest::prelude::*;

use super::example::{example, example_model, posed_example};
use super::*;
use crate::predict::{
    Calibration, HandState, Params, Regression, Standardisation, TurnState, checksum,
};
use crate::time::Stamp;

#[test]
fn a_skill_is_what_its_bytes_say() {
    for (k, knots) in [(1, 1), (14, 24), (64, 24)] {
        let skill = example(k, knots);
        let again = Skill::from_bytes(skill.to_bytes()).unwrap();
        assert_eq!(again, skill);
        assert!(skill.to_bytes().len() <= MAX_SKILL_BYTES);
        assert_eq!(skill.predictor().knots(), knots);
        assert_eq!(Skill::new(skill.parts().clone()).unwrap().id(), skill.id());
    }
    for (k, knots) in [(1, 1), (14, 24)] {
        let skill = posed_example(k, knots);
        assert_eq!(Skill::from_bytes(skill.to_bytes()).unwrap(), skill);
        let parts = skill.parts();
        assert!(parts.turn.is_some() && parts.grip.is_some() && parts.task.is_some());
        // What was rounded once is not rounded again.
        assert_eq!(Skill::new(parts.clone()).unwrap(), skill);
    }
    let skill = example(2, 2);
    assert!(skill.was_trained_on(&[9; 32]) && !skill.was_trained_on(&[8; 32]));
    assert_ne!(example(2, 3).id(), skill.id());
}

#[test]
fn a_file_states_version_and_units_and_shows_damage() {
    let skill = example(3, 4);
    let file = skill.to_file();
    let line = String::from_utf8(file.split(|b| *b == b'\n').next().unwrap().to_vec()).unwrap();
    let expected = format!(
        "telemime skill, format 1; m, s; \"wave\", {} bytes and sha256 follow",
        skill.to_bytes().len()
    );
    assert_eq!(line, expected);
    assert_eq!(Skill::from_file(&file).unwrap(), skill);

    let edited = |from: &str, to: &str| {
        let mut other = line.replacen(from, to, 1).into_bytes();
        other.extend_from_slice(&file[line.len()..]);
        Skill::from_file(&other).unwrap_err()
    };
    assert_eq!(
        edited("format 1", "format 2"),
        FileError::Version { found: 2 }
    );
    assert!(matches!(edited("m, s", "mm, s"), FileError::Units { .. }));
    assert_eq!(edited("telemime", "telenova"), FileError::NotASkill);
    assert_eq!(edited("wave", "save"), FileError::Checksum);
    assert_eq!(Skill::from_file(b""), Err(FileError::NotASkill));
    for at in line.len() + 1..file.len() {
        let mut damaged = file.clone();
        damaged[at] ^= 1;
        assert_eq!(Skill::from_file(&damaged), Err(FileError::Checksum));
    }
    for end in line.len() + 1..file.len() {
        let cut = Skill::from_file(&file[..end]);
        assert!(matches!(cut, Err(FileError::Length { .. })));
    }
}

#[test]
fn every_field_is_checked_on_parse() {
    let good = example(2, 2);
    let build = |name: &str, duration_s: f64, stats: Stats, provenance: Provenance| {
        Skill::new(Parts {
            name: name.to_owned(),
            duration_s,
            stats,
            provenance,
            ..good.parts().clone()
        })
        .unwrap_err()
    };
    let (stats, origin) = (*good.stats(), good.provenance().clone());
    assert_eq!(
        build("", 1.0, stats, origin.clone()),
        SkillError::Name { bytes: 0 }
    );
    assert_eq!(
        build(&"x".repeat(65), 1.0, stats, origin.clone()),
        SkillError::Name { bytes: 65 }
    );
    for bad in [0.0, -1.0, f64::INFINITY, f64::NAN] {
        assert!(matches!(
            build("a", bad, stats, origin.clone()),
            SkillError::Duration { .. }
        ));
    }
    let slow = Stats {
        speed95_m_s: -1.0,
        ..stats
    };
    assert_eq!(
        build("a", 1.0, slow, origin.clone()),
        SkillError::Stats { field: "speed" }
    );
    let inverted = Stats {
        min: stats.max,
        max: stats.min,
        ..stats
    };
    assert!(matches!(
        build("a", 1.0, inverted, origin.clone()),
        SkillError::Stats { .. }
    ));
    let crowded = Provenance {
        sources: vec![origin.sources[0].clone(); MAX_SOURCES + 1],
        ..origin
    };
    assert_eq!(
        build("a", 1.0, stats, crowded),
        SkillError::Provenance { field: "sources" }
    );
}

#[test]
fn a_model_with_a_bad_number_is_refused() {
    let good = example_model(2, 3);
    let spoil = |f: fn(&mut Standardisation, &mut Vec<Regression>, &mut Calibration)| {
        let (mut s, mut c) = (good.standardisation().clone(), good.components().to_vec());
        let mut calibration = *good.calibration();
        f(&mut s, &mut c, &mut calibration);
        Model::new(3, s, c, *good.generic(), calibration).unwrap_err()
    };
    use ModelError as E;
    assert!(matches!(
        spoil(|s, _, _| s.scale[4] = 0.0),
        E::NotPositive { .. }
    ));
    assert!(matches!(
        spoil(|s, _, _| s.mean[4] = f64::NAN),
        E::NotFinite { .. }
    ));
    assert!(matches!(
        spoil(|_, c, _| c.clear()),
        E::Components { found: 0 }
    ));
    assert!(matches!(
        spoil(|_, c, _| c[1].weight = 0.0),
        E::NotPositive { .. }
    ));
    assert!(matches!(
        spoil(|_, c, _| c[1].factor[(2, 2)] = -1.0),
        E::NotPositive { .. }
    ));
    assert!(matches!(
        spoil(|_, c, _| c[1].gain[2][5] = f64::INFINITY),
        E::NotFinite { .. }
    ));
    assert!(matches!(
        spoil(|_, c, _| c[1].residual[2][3] = -1e-9),
        E::NegativeVariance { component: 1 }
    ));
    assert!(matches!(
        spoil(|_, _, c| c.novelty90 = 0.0),
        E::NotPositive { .. }
    ));
    assert!(matches!(
        spoil(|_, _, c| c.errors[1][2] = -1.0),
        E::NotPositive { .. }
    ));
    let (s, c) = (good.standardisation().clone(), good.components().to_vec());
    let mut generic = *good.generic();
    generic.products[5] = 0.0;
    assert!(matches!(
        Model::new(3, s.clone(), c.clone(), generic, *good.calibration()),
        Err(E::NotPositive { .. })
    ));
    assert!(matches!(
        Model::new(25, s, c, *good.generic(), *good.calibration()),
        Err(E::Knots { found: 25 })
    ));
}

/// A step is two hundredths of what remains unexplained at most: predictions change by no more than that.
#[test]
fn rounding_a_predictor_costs_it_nothing() {
    let raw = example_model(14, 24);
    let parts = Parts {
        predictor: raw.clone(),
        ..example(14, 24).parts().clone()
    };
    let skill = Skill::new(parts).unwrap();
    assert!(
        skill.to_bytes().len() < 40_000,
        "{} B",
        skill.to_bytes().len()
    );
    let mut state = HandState::first(Stamp(0), Vector3::new(0.1, 0.2, 0.3));
    for i in 1..60 {
        let u = f64::from(i);
        let x = Vector3::new(libm::sin(0.3 * u), libm::cos(0.2 * u), 0.01 * u);
        state.advance(Stamp(i64::from(i) * 31_000_000), x);
        let (a, b) = (raw.posterior(&state), skill.predictor().posterior(&state));
        for j in 0..24 {
            let off = (a.displacement[j] - b.displacement[j]).norm();
            let sigma = a.covariance[j].trace().sqrt();
            // The steps are per standardised feature: a strange state is a multiple of them off.
            let strange = 1.0 + a.novelty.sqrt();
            assert!(off < 0.02 * sigma * strange, "{off} of {sigma} at knot {j}");
        }
        assert!((a.novelty / b.novelty - 1.0).abs() < 0.02);
    }
}

proptest! {
    #[test]
    fn damaged_bytes_never_panic(at in 0_usize..4096, value: u8, cut in 0_usize..4096) {
        let mut bytes = example(1, 2).to_bytes().to_vec();
        let n = bytes.len();
        bytes[at % n] = value;
        if let Ok(skill) = Skill::from_bytes(&bytes) {
            prop_assert_eq!(skill.to_bytes(), &bytes[..]);
        }
        prop_assert!(Skill::from_bytes(&bytes[..cut % n]).is_err());
    }
}

proptest! {
    /// Whatever a damaged skill still says, both ends can run it.
    #[test]
    fn a_damaged_posed_skill_is_refused_or_runs(
        damage in prop::collection::vec((0_usize..65_536, any::<u8>()), 1..4),
    ) {
        let mut bytes = posed_example(3, 4).to_bytes().to_vec();
        let n = bytes.len();
        for (at, value) in damage {
            bytes[at % n] = value;
        }
        let Ok(skill) = Skill::from_bytes(&bytes) else {
            return Ok(());
        };
        prop_assert_eq!(skill.to_bytes(), &bytes[..]);
        let mut state = HandState::first(Stamp(0), Vector3::new(0.1, 0.2, 2.0));
        state.advance(Stamp(40_000_000), Vector3::new(0.2, 0.2, 1.9));
        let place = skill.predictor().forecast(&state, &Params::DEFAULT);
        prop_assert!(place.at(0.1).position.iter().all(|v| v.is_finite()));
        let turn = skill.turn().map(|turn| {
            let mut state = TurnState::first(Stamp(0), UnitQuaternion::identity());
            state.advance(Stamp(40_000_000), UnitQuaternion::from_euler_angles(0.1, 0.2, 0.3));
            turn.motion.query(0.3);
            turn.predictor.forecast(&state, &Params::DEFAULT)
        });
        if let Some(turn) = &turn {
            prop_assert!(turn.at(0.1).orientation.coords.iter().all(|v| v.is_finite()));
        }
        checksum(&place, turn.as_ref());
        if let Some(task) = skill.task() {
            let usual: Vec<_> = task.frames().iter().map(|f| f.usual).collect();
            task.at(0.5, &usual).unwrap();
            task.turned_at(0.5, &usual).unwrap();
        }
    }
}

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

fn mixture<const D: usize>(v: &serde_json::Value, k: usize) -> Gmm<D> {
    Gmm::new((0..k).map(|i| {
        (
            number(&v["final_weights"][i]),
            SVector::from_fn(|a, _| number(&v["final_means"][i][a])),
            SMatrix::from_fn(|a, b| number(&v["final_covariances"][i][a][b])),
        )
    }))
    .unwrap()
}

/// Every query of one `gmr` entry, within 1e-9 of the largest entry of the answer.
fn regression<const D: usize, const I: usize, const O: usize>(gmm: &Gmm<D>, v: &serde_json::Value) {
    let given: [usize; I] = std::array::from_fn(|i| v["given"][i].as_u64().unwrap() as usize);
    let gmr = Gmr::<I, O>::with_given(gmm, given).unwrap();
    if given == std::array::from_fn(|i| i) {
        let x = gmm.components()[0].mean().fixed_rows::<I>(0).into_owned();
        assert_eq!(Gmr::<I, O>::new(gmm).unwrap().query(&x), gmr.query(&x));
    }
    for q in v["queries"].as_array().unwrap() {
        let answer = gmr.query(&SVector::from_fn(|i, _| number(&q["x"][i])));
        let mean = SVector::<f64, O>::from_fn(|i, _| number(&q["mean"][i]));
        let covariance = SMatrix::<f64, O, O>::from_fn(|i, j| number(&q["covariance"][i][j]));
        let mean_gap = (answer.mean - mean).abs().max() / mean.abs().max();
        let gap = (answer.covariance - covariance).abs().max() / covariance.abs().max();
        assert!(
            mean_gap < 1e-9 && gap < 1e-9,
            "{mean_gap:e} {gap:e} at {}",
            q["x"]
        );
        assert_eq!(answer.covariance, answer.covariance.transpose());
    }
}

/// Densities and responsibilities of the first twenty rows.
fn densities<const D: usize>(gmm: &Gmm<D>, v: &serde_json::Value) {
    for i in 0..20 {
        let x = SVector::from_fn(|a, _| number(&v["data"][i][a]));
        let mut r = [0.0; MAX_COMPONENTS];
        let l = gmm.responsibilities(&x, &mut r);
        assert!((l - number(&v["log_prob_first_20"][i])).abs() < 1e-6);
        assert_eq!(gmm.log_density(&x), l);
        for k in 0..gmm.components().len() {
            assert!((r[k] - number(&v["responsibilities_first_20"][i][k])).abs() < 1e-6);
        }
    }
}

#[test]
fn mixtures_and_regressions_agree_with_other_implementations() {
    let v = vector("gmm_2d_k3");
    let gmm = mixture::<2>(&v, 3);
    densities(&gmm, &v);
    regression::<2, 1, 1>(&gmm, &v["gmr"][0]);

    let v = vector("gmm_4d_k5");
    let gmm = mixture::<4>(&v, 5);
    densities(&gmm, &v);
    let v7 = vector("gmm_7d_k8");
    let gmm7 = mixture::<7>(&v7, 8);
    densities(&gmm7, &v7);
    for q in v["gmr"].as_array().unwrap() {
        match q["given"].as_array().unwrap().len() {
            1 => regression::<4, 1, 3>(&gmm, q),
            2 => regression::<4, 2, 2>(&gmm, q),
            3 => regression::<4, 3, 1>(&gmm, q),
            n => panic!("{n} coordinates given"),
        }
    }
    for q in v7["gmr"].as_array().unwrap() {
        match q["given"].as_array().unwrap().len() {
            1 => regression::<7, 1, 6>(&gmm7, q),
            2 => regression::<7, 2, 5>(&gmm7, q),
            3 => regression::<7, 3, 4>(&gmm7, q),
            4 => regression::<7, 4, 3>(&gmm7, q),
            n => panic!("{n} coordinates given"),
        }
    }
}

#[test]
fn coordinates_that_cannot_be_given_are_refused() {
    let gmm = mixture::<4>(&vector("gmm_4d_k5"), 5);
    assert_eq!(
        Gmr::<2, 2>::with_given(&gmm, [1, 4]).unwrap_err(),
        GmrError::OutOfRange {
            index: 4,
            dimensions: 4
        }
    );
    assert_eq!(
        Gmr::<2, 2>::with_given(&gmm, [1, 1]).unwrap_err(),
        GmrError::Repeated { index: 1 }
    );
}
