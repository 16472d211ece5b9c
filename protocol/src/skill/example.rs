//! A skill made of formulas, for tests.

use nalgebra::{SMatrix, SVector, Vector3, Vector4};

use super::{
    Gmm, Pace, Parts, Placement, Provenance, Samples, Skill, Source, Stats, TaskFrame, TaskModel,
    Turn, TurnMixture,
};
use crate::pose;
use crate::predict::{
    BENT, BLOCK, Calibration, FEATURES, Generic, MAX_KNOTS, Model, Regression, Standardisation,
    TARGETS, TurnModel,
};

/// A skill of `k` components whose predictor has `knots` knots: valid, repeatable, and learned from nothing.
///
/// # Panics
/// For counts that no skill may have.
pub fn example(k: usize, knots: usize) -> Skill {
    Skill::new(example_parts(k, knots)).expect("a valid example")
}

/// [`example`] with orientation, a gripper and two frames.
///
/// # Panics
/// For counts that no skill may have.
pub fn posed_example(k: usize, knots: usize) -> Skill {
    let parts = example_parts(k, knots);
    let charts: Vec<_> = (0..k)
        .map(|i| pose::exp(&Vector3::new(0.3 * i as f64, -1.0, 0.5)))
        .collect();
    let turned = Gmm::new(parts.motion.components().iter().map(|c| {
        let mean = Vector4::new(c.mean()[0], 0.0, 0.0, 0.0);
        (c.weight(), mean, *c.covariance())
    }))
    .expect("a valid example");
    let frame = |name: &str, x: f64| TaskFrame {
        name: name.to_owned(),
        motion: parts.motion.clone(),
        usual: Placement {
            origin: Vector3::new(x, 0.5, 0.25),
            turn: pose::exp(&Vector3::new(0.0, 0.0, x)),
        },
    };
    Skill::new(Parts {
        turn: Some(Turn {
            motion: TurnMixture::new(turned, charts.clone()).expect("a valid example"),
            predictor: TurnModel::new(parts.predictor.clone(), charts).expect("a valid example"),
        }),
        grip: Some(
            Gmm::new([(1.0, SVector::from([1.0, 0.5]), SMatrix::identity() * 0.25)])
                .expect("a valid example"),
        ),
        task: Some(
            TaskModel::new(vec![frame("start", 0.0), frame("goal", 1.0)]).expect("a valid example"),
        ),
        ..parts.clone()
    })
    .expect("a valid example")
}

fn example_parts(k: usize, knots: usize) -> Parts {
    Parts {
        name: "wave".to_owned(),
        motion: Gmm::new((0..k).map(|i| {
            let u = i as f64;
            let mean = Vector4::new(u, 0.1 * u, 1.0 - u, 0.3);
            (
                1.0 / k as f64,
                mean,
                SMatrix::identity() * (0.01 + 0.001 * u),
            )
        }))
        .expect("a valid example"),
        duration_s: 2.5,
        pace: Pace {
            mean_ln_s: 0.9,
            deviation_ln: 0.125,
        },
        predictor: example_model(k, knots),
        turn: None,
        grip: None,
        task: None,
        stats: Stats {
            speed95_m_s: 4.0,
            acceleration95_m_s2: 60.0,
            reach_m: 0.9,
            min: Vector3::new(-1.0, 0.0, 2.0),
            max: Vector3::new(1.0, 1.5, 3.0),
        },
        samples: Samples {
            motion: 100,
            predictor: 90,
        },
        provenance: Provenance {
            producer: "a test".to_owned(),
            seed: 7,
            sources: vec![Source {
                name: "take one".to_owned(),
                sha256: [9; 32],
            }],
        },
    }
}

fn example_generic(knots: usize) -> Generic {
    let mut lead = [[0.0; MAX_KNOTS]; 4];
    for (i, row) in lead.iter_mut().enumerate() {
        for (j, v) in row[..knots].iter_mut().enumerate() {
            *v = 0.1 * (j + 1) as f64 / (i + 1) as f64;
        }
    }
    Generic {
        lead,
        products: [0.004, 0.009, 0.02, 0.015, 0.04, 0.08, 0.02, 0.05, 0.1, 0.15],
    }
}

pub(super) fn example_model(k: usize, knots: usize) -> Model {
    let component = |i: usize| {
        let u = i as f64 / k as f64;
        let mut c = Regression {
            weight: 1.0 / k as f64,
            mean: SVector::from_fn(|j, _| libm::sin(u + j as f64)),
            factor: SMatrix::identity() * (0.5 + u),
            target: [0.0; TARGETS],
            gain: [[0.0; TARGETS]; FEATURES],
            residual: [[0.0; BLOCK]; MAX_KNOTS],
        };
        c.factor[(3, 1)] = 0.2;
        for j in 0..3 * knots {
            c.target[j] = 0.01 * libm::cos(u + j as f64);
            for (f, row) in c.gain.iter_mut().enumerate() {
                row[j] = 0.001 * libm::sin(u + (j * f) as f64);
            }
        }
        for v in &mut c.residual[..knots] {
            *v = [1e-4 * (1.0 + u), 0.0, 1e-5, 2e-4, 0.0, 3e-4];
        }
        c
    };
    Model::new(
        knots,
        Standardisation {
            mean: SVector::from_fn(|j, _| 0.1 * j as f64),
            scale: SVector::from_fn(|j, _| 0.05 + 0.01 * (j / 3) as f64),
            bend: [0.0; BENT],
            ridge: 0.03,
            shrinkage: 8.0,
        },
        (0..k).map(component).collect(),
        example_generic(knots),
        Calibration::UNTRIED,
    )
    .expect("a valid example")
}
