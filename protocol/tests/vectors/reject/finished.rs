//! What is none of the things that are sent whole: plans and skills.

use telemime_protocol::checkpoint::PosePlan;
use telemime_protocol::skill::example;
use telemime_protocol::wire::codec;

use super::with;

pub(super) fn plans_and_skills(say: &mut impl FnMut(&'static str, &str, Vec<u8>, &'static str)) {
    let plan = [
        0x14, 0x8e, 0x2c, 0x89, 0xec, 0x88, 0x01, 0x15, 0xca, 0x16, 0x41, 0xdf, 0x9e, 0x4e, 0x4e,
        0x57, 0x93, 0x3c, 0x00, 0xfa, 0x20, 0, 0,
    ];
    say(
        "plan",
        "cut short",
        plan[..plan.len() - 1].to_vec(),
        "Malformed",
    );
    say(
        "plan",
        "and more",
        [plan.as_slice(), &[0]].concat(),
        "Trailing",
    );
    say(
        "plan",
        "bits too soon at an end",
        with(plan[..].to_vec(), 0, 0x13)[..22].to_vec(),
        "Malformed",
    );
    say(
        "plan",
        "nothing but zeros",
        [vec![20], vec![0; 22]].concat(),
        "Malformed",
    );
    say(
        "plan",
        "the same points from dearer codes",
        vec![
            0x15, 0x8e, 0x2c, 0x89, 0xec, 0x88, 0x01, 0x15, 0xca, 0x16, 0x30, 0x21, 0xf9, 0xe4,
            0xb2, 0x72, 0xbc, 0x94, 0xf0, 0x03, 0xe8, 0x80, 0, 0,
        ],
        "NotCanonical",
    );
    // Three points at 30 a second: (0; 40 −20 250), (8; 60 −10 250), (13; 55 0 246), in steps of 10 mm.
    let rated = [
        0x0f, 0x8e, 0x2f, 0xfa, 0x90, 0xce, 0x23, 0x45, 0x10, 0x20, 0xde, 0xe1, 0xce, 0x65, 0xc1,
        0x00, 0, 0,
    ];
    assert!(codec::decode::<PosePlan, 64>(&rated).is_ok());
    say(
        "plan",
        "a tick in digits that has a rate",
        vec![
            0x12, 0x8e, 0x2e, 0x00, 0x10, 0x48, 0xa1, 0x48, 0x67, 0x11, 0xa2, 0x88, 0x10, 0x6f,
            0x70, 0xe7, 0x32, 0xe0, 0x80, 0, 0,
        ],
        "NotCanonical",
    );
    say(
        "plan",
        "none a second",
        with(rated.to_vec(), 3, 0x82),
        "Malformed",
    );
    say(
        "plan",
        "1001 a second",
        vec![
            0x10, 0x8e, 0x2f, 0x04, 0x09, 0xa4, 0x33, 0x88, 0xd1, 0x44, 0x08, 0x37, 0xb8, 0x73,
            0x99, 0x70, 0x40, 0, 0,
        ],
        "Malformed",
    );
    say(
        "plan",
        "an order of 32",
        vec![
            0x17, 0x8e, 0x2f, 0xfa, 0x90, 0xce, 0x23, 0x40, 0x88, 0x40, 0x83, 0x40, 0x00, 0x00,
            0x01, 0xdc, 0x39, 0x80, 0x00, 0x00, 0x02, 0x65, 0xc1, 0x00, 0, 0,
        ],
        "Malformed",
    );
    say(
        "plan",
        "a step of five metres",
        vec![0x08, 0x8a, 0xb2, 0x89, 0xee, 0x51, 0x09, 0xfc, 0xbc, 0, 0],
        "Malformed",
    );
    let skill = example(1, 1).to_bytes().to_vec();
    say(
        "skill",
        "cut short",
        skill[..skill.len() - 1].to_vec(),
        "Malformed",
    );
    say(
        "skill",
        "and more",
        [skill.as_slice(), &[0]].concat(),
        "Trailing",
    );
    // "wave" stands in bytes 1 to 4, the duration after it.
    let mut still = skill.clone();
    still[5..13].copy_from_slice(&0.0_f64.to_le_bytes());
    say("skill", "of no duration", still, "Invalid");
    let mut nameless = skill.clone();
    nameless.drain(1..5);
    nameless[0] = 0;
    say("skill", "without a name", nameless, "Invalid");
}
