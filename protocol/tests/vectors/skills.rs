//! Skills, and what is foretold by them.

use serde_json::json;
use telemime_protocol::skill::{Skill, example, posed_example};
use telemime_protocol::wire::v1::{Message, OperatorDatagram, model_tag};

use super::Vector;
use super::meaning::{foretold, moving, says};

pub(crate) fn skills() -> Vec<Vector> {
    [
        ("one component, one knot", example(1, 1)),
        ("three components", example(3, 5)),
        ("posed, with frames", posed_example(2, 4)),
    ]
    .into_iter()
    .map(|(name, skill)| {
        // What both ends run is what decoding gives.
        let skill = Skill::from_bytes(skill.to_bytes()).expect("a skill");
        let foretold: Vec<_> = (0..6)
            .map(|i| {
                let motion = moving(i);
                let told = foretold(&motion, Some(&skill));
                json!({"motion": super::hex(&OperatorDatagram::Motion(motion).encode()), "foretold": told})
            })
            .collect();
        let value = json!({
            "name": skill.name(),
            "id": super::hex(&skill.id().0),
            "tag": model_tag(&skill.id().0),
            "duration_s": skill.duration_s(),
            "knots": skill.predictor().knots(),
            "foretold": foretold,
        });
        says("skill", name, skill.to_bytes().to_vec(), value)
    })
    .collect()
}
