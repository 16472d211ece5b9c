//! How far each expert is trusted, by what the hand does.

use nalgebra::{SMatrix, SVector};
use telemime_protocol::predict::{
    BENT, Calibration, FEATURES, Forecast, Generic, HandState, MAX_KNOTS, Model, Regression,
    Standardisation, TARGETS,
};

use super::super::adapt::Adaptation;
use super::*;

const FRAME_S: f64 = 1.0 / 30.0;

/// The hand after so many frames of `path`, and what has become of `trust`.
fn follow(
    mut trust: Adaptation<HandState>,
    model: Option<&Model>,
    frames: u32,
    path: impl Fn(f64) -> Vector3<f64>,
) -> (HandState, Adaptation<HandState>) {
    let mut hand = HandState::first(Stamp(0), path(0.0));
    for frame in 1..=frames {
        let before = hand;
        let t_s = f64::from(frame) * FRAME_S;
        assert!(hand.advance(Stamp::from_secs_f64(t_s), path(t_s)));
        trust.observe(&before, &hand, model);
    }
    (hand, trust)
}

/// Learned where the hand soon turned back, and then sure that it stays where it is: a fiftieth of the squared error of a straight line.
fn abrupt() -> Model {
    let component = Regression {
        weight: 1.0,
        mean: SVector::zeros(),
        factor: SMatrix::identity(),
        target: [0.0; TARGETS],
        gain: [[0.0; TARGETS]; FEATURES],
        residual: [[1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4]; MAX_KNOTS],
    };
    let standardisation = Standardisation {
        mean: SVector::zeros(),
        scale: SVector::repeat(1.0),
        bend: [0.0; BENT],
        ridge: 0.03,
        shrinkage: 8.0,
    };
    let generic = Generic {
        lead: [[0.0; MAX_KNOTS]; 4],
        products: [0.1; 10],
    };
    let calibration = Calibration {
        covariance: [1.0; MAX_KNOTS],
        errors: [[0.005, 0.25, 0.25, 0.5]; MAX_KNOTS],
        novelty90: 22.0,
    };
    Model::new(
        MAX_KNOTS,
        standardisation,
        vec![component],
        generic,
        calibration,
    )
    .unwrap()
}

#[test]
fn what_abrupt_motion_taught_does_not_drown_what_smooth_motion_shows() {
    let model = abrupt();
    let trust = Adaptation::of_places(1.0, Some(model.calibration()), 0.5);
    let line = |t_s: f64| Vector3::new(0.0, 0.1 * t_s, 0.0);
    let (hand, trust) = follow(trust, Some(&model), 40, line);
    let known = Forecast::experts(&hand, Some(&model)).familiarity;
    assert!(known > 0.98, "the calibration counts: {known}");
    let [near, ..] = trust.params(&hand).weights;
    assert!(near[2] > 0.9, "{near:?}");
}

/// The factor of the covariance after a hand that kept still and then went `far_m` in `gap_s` without a sample.
fn widened(gap_s: f64, far_m: f64) -> f64 {
    let still = |_| Vector3::zeros();
    let (hand, mut trust) = follow(Adaptation::of_places(1.0, None, 0.5), None, 60, still);
    let mut there = hand;
    let t = hand.t.offset_by_secs(gap_s);
    assert!(there.advance(t, Vector3::new(far_m, 0.0, 0.0)));
    let before = trust.params(&hand).inflation;
    trust.observe(&hand, &there, None);
    trust.params(&there).inflation / before
}

#[test]
fn a_miss_by_far_widens_the_regions_but_not_across_a_hole() {
    // As many are judged in both.
    let [seen, hole] = [0.24, 0.26].map(|gap_s| widened(gap_s, 1.0));
    assert!(seen > 1.5 * hole && hole > 1.0, "{seen} and {hole}");
}
