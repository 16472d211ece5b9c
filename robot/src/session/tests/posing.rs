//! Orientation and gripper, as the robot takes them.

use super::*;
use telemime_protocol::pose;
use telemime_protocol::predict::{Forecast, TurnForecast, TurnState, checksum};
use telemime_protocol::skill::posed_example;
use telemime_protocol::wire::turn::WireTurn;
use telemime_protocol::wire::v1::model_tag;

/// A motion with a hand that has turned steadily.
fn posed(bench: &Bench, seq: u32, model: u16) -> Motion {
    let motion = bench.motion(seq, 50);
    let rate = Vector3::new(0.4, -0.2, 0.6);
    let t = motion.state.dequantise().t;
    let mut state = TurnState::first(Stamp(t.0 - 300 * MS), UnitQuaternion::identity());
    for i in 1..=10 {
        let moment = Stamp(t.0 - 300 * MS + 30 * i * MS);
        assert!(state.advance(moment, pose::exp(&(rate * (0.03 * i as f64)))));
    }
    let turn = WireTurn::quantise(&state, WireParams::quantise(&STEADY));
    Motion {
        model,
        pose: WirePose {
            turn: Some(turn),
            grip: Some(51),
        },
        ..motion
    }
}

/// What the robot should make of it.
fn own(motion: &Motion, skill: Option<&Skill>) -> (Forecast, TurnForecast) {
    let (state, params) = (motion.state.dequantise(), motion.params.dequantise());
    let sent = motion.pose.turn.unwrap();
    let (turn, turn_params) = (sent.dequantise(state.t), sent.params.dequantise());
    (
        match skill {
            Some(skill) => skill.predictor().forecast(&state, &params),
            None => Forecast::constant_velocity(&state, &params),
        },
        match skill.and_then(Skill::turn) {
            Some(learned) => learned.predictor.forecast(&turn, &turn_params),
            None => TurnForecast::constant_velocity(&turn, &turn_params),
        },
    )
}

fn tracked(bench: &Bench) -> (Forecast, Option<TurnForecast>, Option<f64>) {
    let [
        Order::Track {
            forecast,
            turn,
            grip,
            ..
        },
    ] = &bench.orders[..]
    else {
        panic!("{:?}", bench.orders)
    };
    (*forecast, *turn, *grip)
}

#[test]
fn orientation_is_predicted_with_what_was_learned_of_it_and_checked() {
    for skill in [posed_example(2, 24), example(2, 24)] {
        let tag = model_tag(&skill.id().0);
        let mut bench = Bench::mirroring(Some(skill.clone()));
        let mut motion = posed(&bench, 1, tag);
        let (place, turn) = own(&motion, Some(&skill));
        motion.checksum = Some(checksum(&place, Some(&turn)));
        bench.send(&motion);
        assert_eq!(tracked(&bench), (place, Some(turn), Some(0.2)));
        assert_eq!(bench.refusals(), []);

        // A sum of the place alone is another one: both go on without the model.
        bench.pass(10);
        bench.forget();
        let mut motion = posed(&bench, 2, tag);
        let (place, _) = own(&motion, Some(&skill));
        motion.checksum = Some(checksum(&place, None));
        bench.send(&motion);
        assert_eq!(bench.refusals(), [Refusal::Diverged]);
        let (place, turn) = own(&motion, None);
        assert_eq!(tracked(&bench), (place, Some(turn), Some(0.2)));
    }
}

#[test]
fn a_motion_without_orientation_says_nothing_of_it() {
    let mut bench = Bench::mirroring(None);
    let motion = bench.motion(1, 50);
    bench.send(&motion);
    let (_, turn, grip) = tracked(&bench);
    assert_eq!((turn, grip), (None, None));
}
