//! A skill: any bytes are refused, or are the one encoding of a model whose forecasts are finite.

#![no_main]

use libfuzzer_sys::fuzz_target;
use telemime_protocol::predict::{HandState, Params, TurnState, checksum};
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;

fuzz_target!(|bytes: &[u8]| {
    let Ok(skill) = Skill::from_bytes(bytes) else {
        return;
    };
    assert_eq!(skill.to_bytes(), bytes);
    assert!(skill.motion().log_density(&[0.5, 0.0, 0.0, 0.0].into()) <= f64::MAX);
    let mut hand = HandState::first(Stamp(0), [0.1, 0.2, 2.0].into());
    hand.advance(Stamp(33_000_000), [0.12, 0.19, 2.0].into());
    let params = Params::default();
    let place = skill.predictor().forecast(&hand, &params);
    let turn = skill.turn().map(|turn| {
        let state = TurnState::first(Stamp(0), Default::default());
        turn.predictor.forecast(&state, &params)
    });
    for h in [0.0, 0.05, 1.0] {
        let at = place.at(h);
        assert!(at.position.iter().all(|v| !v.is_nan()) && !at.sigma_m.is_nan());
    }
    checksum(&place, turn.as_ref());
});
