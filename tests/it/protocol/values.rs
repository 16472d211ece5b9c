//! Every number that the document says follows.

use std::collections::BTreeMap;

use nalgebra::{UnitQuaternion, Vector3};
use telemime_protocol::checkpoint::path::{PathDecoder, pose as on_path};
use telemime_protocol::pose;
use telemime_protocol::predict::{Forecast, TurnForecast, checksum};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::pair::Transcript;
use telemime_protocol::wire::v1::{self, model_tag};

use super::example::*;

pub(super) fn values() -> BTreeMap<String, String> {
    let mut values = BTreeMap::new();
    let mut say = |name: &str, value: String| {
        assert!(values.insert(name.to_owned(), value).is_none(), "{name}");
    };
    let agreed = Transcript {
        exporter: [0xe5; 32],
        operator: [0x0a; 32],
        robot: [0x0b; 32],
        operator_nonce: [0x11; 32],
        robot_nonce: [0x22; 32],
    };
    say("pairing code", agreed.code().to_string());
    let vector = |v: &Vector3<f64>| format!("{:.9} {:.9} {:.9}", v.x, v.y, v.z);

    let state = STATE.dequantise();
    let params = PARAMS.dequantise();
    (0..4).for_each(|i| say(&format!("m{}", i + 1), vector(&state.memory[i])));
    let (velocity, acceleration) = state.motion();
    say("v", vector(&velocity));
    say("a", vector(&acceleration));
    let straight = Forecast::constant_velocity(&state, &params);
    say("cv(0.1)", vector(&straight.at(0.1).position));
    say("cv sigma(0.1)", format!("{:.9}", straight.at(0.1).sigma_m));
    say("cv checksum", format!("{:08x}", checksum(&straight, None)));

    let mut advanced = state;
    assert!(advanced.advance(Stamp(3_033_000_000), Vector3::new(0.41, -0.2, 2.5)));
    (0..4).for_each(|i| say(&format!("next m{}", i + 1), vector(&advanced.memory[i])));

    let turn = TURN.dequantise(state.t);
    let turned = |q: &UnitQuaternion<f64>| vector(&pose::log(q));
    say("turn m1", turned(&turn.memory[0]));
    say("turn m4", turned(&turn.memory[3]));
    let turning = TurnForecast::constant_velocity(&turn, &TURN.params.dequantise());
    say("turn cv(0.1)", turned(&turning.at(0.1).orientation));
    say(
        "turn cv sigma(0.1)",
        format!("{:.9}", turning.at(0.1).sigma_rad),
    );
    say(
        "turn checksum",
        format!("{:08x}", checksum(&straight, Some(&turning))),
    );
    let mut next = turn;
    assert!(next.advance(
        Stamp(3_033_000_000),
        pose::exp(&Vector3::new(0.45, -0.3, 0.05))
    ));
    say("turn next m1", turned(&next.memory[0]));

    let skill = skill();
    let forecast = skill.predictor().forecast(&state, &params);
    let posterior = skill.predictor().posterior(&state);
    say("skill bytes", skill.to_bytes().len().to_string());
    say("skill id", skill.id().to_string());
    say("skill tag", model_tag(&skill.id().0).to_string());
    say("novelty", format!("{:.9}", posterior.novelty));
    say("mixture(3)", vector(&posterior.displacement[2]));
    say("familiarity", format!("{:.9}", forecast.ahead.familiarity));
    let experts = Forecast::experts(&state, Some(skill.predictor()));
    say("generic(3)", vector(&experts.displacement[2][1]));
    say("straight(3)", vector(&experts.displacement[2][2]));
    say("fused(0.1)", vector(&forecast.at(0.1).position));
    let covariance = forecast.ahead.knots[3].covariance;
    say(
        "fused V(3) diagonal",
        vector(&Vector3::new(covariance[0], covariance[3], covariance[5])),
    );
    say(
        "fused V(3) xy xz yz",
        vector(&Vector3::new(covariance[1], covariance[2], covariance[4])),
    );
    say(
        "fused sigma(0.1)",
        format!("{:.9}", forecast.at(0.1).sigma_m),
    );
    say(
        "fused checksum",
        format!("{:08x}", checksum(&forecast, None)),
    );

    let code = code(None);
    let mut path = PathDecoder::new(code.grid(), 8);
    let knots = motion(None).knots.unpack(&STATE, code, &[], v1::MAX_KNOTS);
    let knots = knots.unwrap();
    assert_eq!(knots, places()[..2]);
    knots.iter().for_each(|knot| path.append(knot).unwrap());
    let jet = path.eval(Stamp(2_500_000_000)).unwrap();
    say("path x(2.5)", vector(&on_path::place(&jet.x)));
    say("path v(2.5)", vector(&on_path::place(&jet.v)));
    let mut path = PathDecoder::new(pose_code().grid(), 8);
    KNOTS.iter().for_each(|knot| path.append(knot).unwrap());
    let jet = path.eval(Stamp(2_500_000_000)).unwrap();
    let q = on_path::turn(&jet.x).unwrap();
    say(
        "path q(2.5)",
        format!("{:.9} {:.9} {:.9} {:.9}", q.w, q.i, q.j, q.k),
    );

    let jet = plan().position().spline().unwrap().eval(0.1).unwrap();
    say("plan x(0.1)", vector(&jet.x));
    say("plan v(0.1)", vector(&jet.v));
    say("plan a(0.1)", vector(&jet.a));

    let bend = BEND.dequantise();
    say("bend plan(3.4)", format!("{:.9}", bend.plan_at(0.2)));
    say("bend offset(3.4)", vector(&bend.offset_at(0.2, 0.21)));
    values
}
