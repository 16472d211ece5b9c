//! How far each expert is trusted, by what the hand does.

use telemime_protocol::predict::{Forecast, HandState};

use super::super::adapt::Adaptation;
use super::*;

const FRAME_S: f64 = 1.0 / 30.0;

/// The hand after so many frames of `path`, and what has become of `trust`.
fn follow(
    mut trust: Adaptation<HandState>,
    skill: Option<&Skill>,
    frames: u32,
    path: impl Fn(f64) -> Vector3<f64>,
) -> (HandState, Adaptation<HandState>) {
    let mut hand = HandState::first(Stamp(0), path(0.0));
    for frame in 1..=frames {
        let before = hand;
        let t_s = f64::from(frame) * FRAME_S;
        assert!(hand.advance(Stamp::from_secs_f64(t_s), path(t_s)));
        trust.observe(&before, &hand, skill.map(Skill::predictor));
    }
    (hand, trust)
}

#[test]
fn what_abrupt_motion_taught_does_not_drown_what_smooth_motion_shows() {
    let skill = example(2, 24);
    let calibration = skill.predictor().calibration();
    let [mixture, _, straight, _] = calibration.errors[2];
    assert!(mixture < straight / 3.0, "{mixture} {straight}");
    let trust = Adaptation::of_places(1.0, Some(calibration), 0.5);
    let line = |t_s: f64| Vector3::new(0.0, 0.1 * t_s, 0.0);
    let (hand, trust) = follow(trust, Some(&skill), 40, line);
    let known = Forecast::experts(&hand, Some(skill.predictor())).familiarity;
    assert!(known > 0.98, "the calibration counts: {known}");
    let [near, ..] = trust.params(&hand).weights;
    assert!(near[2] > 0.9, "{near:?}");
}

#[test]
fn the_last_weights_are_found_where_what_is_sent_is_used() {
    // To and fro, a second each way: 0.4 s ahead it mostly still goes on, 0.8 s ahead it has mostly turned.
    let zigzag = |t_s: f64| Vector3::x() * (0.2 * (1.0 - (t_s % 2.0 - 1.0).abs()));
    let weights = |horizon_s: f64| {
        let mut trust = Adaptation::of_places(1.0, None, 0.2);
        trust.used_at(horizon_s);
        let (hand, trust) = follow(trust, None, 180, zigzag);
        trust.params(&hand).weights
    };
    let [near, far] = [0.2, 0.8].map(weights);
    assert_eq!(near[..2], far[..2]);
    assert!(near[2][2] > 0.6, "{near:?}");
    assert!(far[2][2] < 0.3, "{far:?}");
}
