//! Orientation and gripper, as the operator sends them.

use super::*;
use telemime_protocol::pose;
use telemime_protocol::predict::{TurnForecast, checksum};
use telemime_protocol::skill::posed_example;

/// 33 ms later the hand is still at `home()`, turned by `turn` (rad) and its gripper as open as `grip` says.
fn pose(bench: &mut Bench, turn: Option<Vector3<f64>>, grip: Option<f64>) {
    bench.idle(33);
    let sample = HandSample {
        orientation: turn.map(|v| pose::exp(&v)),
        grip,
        ..HandSample::at(bench.now, home())
    };
    bench.session.handle_sample(bench.now, sample);
    bench.drain();
}

fn engaged(skill: Option<Skill>) -> Bench {
    let mut bench = Bench::engaged(SessionConfig::default(), skill);
    for _ in 0..60 {
        pose(&mut bench, Some(Vector3::zeros()), Some(1.0));
    }
    bench.forget();
    bench
}

#[test]
fn a_hand_that_only_turns_or_grips_is_told_of() {
    let mut bench = engaged(None);
    for _ in 0..60 {
        pose(&mut bench, Some(Vector3::zeros()), Some(1.0));
    }
    let still = bench.motions().len();
    bench.forget();
    for i in 0..60 {
        let angle = (0.4 * f64::from(i)).sin();
        pose(&mut bench, Some(Vector3::z() * angle), Some(1.0));
    }
    let turning = bench.motions().len();
    assert!(turning > 2 * still, "{turning} {still}");
    bench.idle(1000);
    bench.forget();
    pose(&mut bench, Some(Vector3::zeros()), Some(0.0));
    let told = bench.motions();
    assert_eq!(told.last().map(|m| m.pose.grip), Some(Some(0)));
}

#[test]
fn an_orientation_has_a_way_of_its_own_no_finer_than_what_is_predicted() {
    let said = |future_bound| {
        let config = SessionConfig {
            future_bound,
            ..SessionConfig::default()
        };
        let mut bench = Bench::engaged(config, Some(posed_example(2, 24)));
        for i in 0..90 {
            let angle = 0.3 * (0.3 * f64::from(i)).sin();
            pose(&mut bench, Some(Vector3::z() * angle), None);
        }
        bench.datagrams
    };
    let (fine, wide) = (
        said(FutureBound::Share(0.1)),
        said(FutureBound::Share(10.0)),
    );
    assert_eq!(fine, said(FutureBound::Relative(1.5)));
    assert!(fine.len() > 2 * wide.len(), "{} {}", fine.len(), wide.len());
}

#[test]
fn what_the_tracker_loses_is_held_and_what_is_no_orientation_is_not_taken() {
    let mut bench = engaged(None);
    let turn = Vector3::new(0.3, -0.2, 0.1);
    for _ in 0..30 {
        pose(&mut bench, Some(turn), Some(0.25));
    }
    bench.forget();
    for lost in [None, Some(Vector3::repeat(f64::NAN))] {
        for _ in 0..30 {
            pose(&mut bench, lost, lost.map(|_| f64::NAN));
        }
    }
    let motions = bench.motions();
    assert!(motions.len() > 5);
    for m in motions {
        let q: UnitQuaternion<f64> = m.pose.turn.unwrap().q.dequantise();
        assert!(q.angle_to(&pose::exp(&turn)) < 1e-4);
        assert_eq!(m.pose.grip, Some(64));
    }
}

#[test]
fn keyframes_check_the_orientation_with_and_without_a_model_of_it() {
    for skill in [posed_example(2, 24), example(2, 24)] {
        let mut bench = engaged(Some(skill.clone()));
        for i in 0..60 {
            let angle = 0.4 * (0.3 * f64::from(i)).sin();
            pose(&mut bench, Some(Vector3::x() * angle), None);
        }
        let motions = bench.motions();
        let sums: Vec<_> = motions.iter().filter(|m| m.checksum.is_some()).collect();
        assert!(!sums.is_empty());
        for m in sums {
            let state = m.state.dequantise();
            let place = skill.predictor().forecast(&state, &m.params.dequantise());
            let sent = m.pose.turn.unwrap();
            let (turn, params) = (sent.dequantise(state.t), sent.params.dequantise());
            let turn = match skill.turn() {
                Some(learned) => learned.predictor.forecast(&turn, &params),
                None => TurnForecast::constant_velocity(&turn, &params),
            };
            assert_eq!(m.checksum, Some(checksum(&place, Some(&turn))));
        }
    }
}
