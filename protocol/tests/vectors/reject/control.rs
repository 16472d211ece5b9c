//! Control messages that are none (docs/protocol.md §4).

use telemime_protocol::wire::arm::{WireArm, WireCapsule, WireJoint, WireJointKind, WirePlace};
use telemime_protocol::wire::codec;
use telemime_protocol::wire::v1::*;

use super::super::meaning::moving;
use super::super::messages::{OPERATOR_CONTROL, ROBOT_CONTROL};
use super::with;

pub(super) fn control(say: &mut impl FnMut(&'static str, &str, Vec<u8>, &'static str)) {
    let engage = |drive| {
        OperatorControl::Engage(Engage {
            engagement: 1,
            t_us: 3_010_000,
            drive,
            scale: 0.125,
            rotation: [0.5, -0.5, 0.5, -0.5],
            path_bound_um: 200,
            path_turn_bound_urad: 200,
            sample_us: 200,
            lease_ms: 200,
        })
    };
    let play = engage(Drive::Play { plan: 1 }).encode();
    // From the end: lease 1, samples 1, both bounds 1, rotation 16, scale 4.
    let from_end = |n| play.len() - n;
    let (samples, turned, bound) = (from_end(2), from_end(3), from_end(4));
    let (rotation, scale) = (from_end(20), from_end(24));
    let scaled = |v: f32| {
        let mut bytes = play.clone();
        bytes[scale..scale + 4].copy_from_slice(&v.to_le_bytes());
        bytes
    };
    say(OPERATOR_CONTROL, "nothing", vec![], "Malformed");
    say(OPERATOR_CONTROL, "an unknown message", vec![8], "Malformed");
    say(
        OPERATOR_CONTROL,
        "a marker wider than its field",
        vec![4, 0xfd, 0, 0, 0, 0, 1, 0, 0, 0],
        "Malformed",
    );
    say(
        OPERATOR_CONTROL,
        "release, cut short",
        vec![4, 0xfb, 1],
        "Malformed",
    );
    say(
        OPERATOR_CONTROL,
        "a goodbye and more",
        vec![7, 0],
        "Trailing",
    );
    say(
        OPERATOR_CONTROL,
        "its index in three bytes",
        vec![0xfb, 7, 0],
        "NotCanonical",
    );
    say(OPERATOR_CONTROL, "engage, scale 0", scaled(0.0), "Invalid");
    say(
        OPERATOR_CONTROL,
        "engage, scale beyond 10",
        scaled(10.5),
        "Invalid",
    );
    say(
        OPERATOR_CONTROL,
        "engage, scale not a number",
        scaled(f32::NAN),
        "Invalid",
    );
    say(
        OPERATOR_CONTROL,
        "engage, not a rotation",
        with(play.clone(), rotation + 3, 0x40),
        "Invalid",
    );
    say(
        OPERATOR_CONTROL,
        "engage, an orientation's path bound above half a turn",
        [
            &play[..turned],
            &codec::encode(&3_141_593_u32),
            &play[turned + 1..],
        ]
        .concat(),
        "Invalid",
    );
    say(
        OPERATOR_CONTROL,
        "engage, no path bound",
        with(play.clone(), bound, 0),
        "Invalid",
    );
    say(
        OPERATOR_CONTROL,
        "engage, no interval of samples",
        with(play.clone(), samples, 0),
        "Invalid",
    );
    let mut mirror = moving(1);
    let drive = |m: &Motion| {
        engage(Drive::Mirror {
            state: m.state,
            model: 0,
            params: m.params,
            pose: m.pose,
        })
        .encode()
    };
    mirror.state.x[2] = 1_000_001;
    say(
        OPERATOR_CONTROL,
        "engage, a hand beyond 100 m",
        drive(&mirror),
        "Invalid",
    );
    let plan = OperatorControl::Plan {
        id: 1,
        bytes: vec![0; MAX_PLAN_LEN + 1],
    };
    let head = plan.encode()[..8].to_vec();
    say(
        OPERATOR_CONTROL,
        "a model that claims 2^60 bytes",
        [vec![0; 17], vec![0xfd, 0, 0, 0, 0, 0, 0, 0, 16]].concat(),
        "Malformed",
    );
    say(
        OPERATOR_CONTROL,
        "a plan that is not there",
        head,
        "Malformed",
    );
    let info = |change: fn(&mut Info)| {
        let mut info = Info {
            name: "mime7".to_owned(),
            joints: 7,
            speed_m_s: 1.5,
            accel_m_s2: 13.0,
            radius_m: 0.25,
            lag_s: 0.0625,
            model: None,
            state: RobotState::Idle,
        };
        change(&mut info);
        RobotControl::Info(info).encode()
    };
    let arm = |change: fn(&mut WireArm)| {
        let place = WirePlace {
            m: [0.0, 0.0, 0.25],
            q: [1.0, 0.0, 0.0, 0.0],
        };
        let mut arm = WireArm {
            joints: vec![WireJoint {
                place,
                axis: [0.0, 0.0, 1.0],
                kind: WireJointKind::Revolute,
                limits: Some([-2.5, 2.5]),
            }],
            tip: place,
            capsules: vec![WireCapsule {
                link: 1,
                from: [0.0; 3],
                to: [0.125, 0.0, 0.0],
                radius_m: 0.0625,
            }],
        };
        change(&mut arm);
        RobotControl::Arm(arm).encode()
    };
    type Wrong = (&'static str, fn(&mut WireArm));
    let wrong: [Wrong; 8] = [
        ("eleven joints", |a| a.joints = vec![a.joints[0]; 11]),
        ("65 capsules", |a| a.capsules = vec![a.capsules[0]; 65]),
        ("an axis of no length", |a| a.joints[0].axis = [0.0; 3]),
        ("limits out of order", |a| {
            a.joints[0].limits = Some([1.0, -1.0])
        }),
        ("a tip that is nowhere", |a| a.tip.m[1] = f32::NAN),
        ("a quaternion of length two", |a| a.tip.q[0] = 2.0),
        ("a capsule of nothing", |a| a.capsules[0].radius_m = 0.0),
        ("a capsule of a joint that is not there", |a| {
            a.capsules[0].link = 2
        }),
    ];
    for (name, change) in wrong {
        say(
            ROBOT_CONTROL,
            &format!("arm, {name}"),
            arm(change),
            "Invalid",
        );
    }
    say(
        ROBOT_CONTROL,
        "info, a long name",
        info(|i| i.name = "n".repeat(65)),
        "Invalid",
    );
    say(
        ROBOT_CONTROL,
        "info, no speed",
        info(|i| i.speed_m_s = 0.0),
        "Invalid",
    );
    say(
        ROBOT_CONTROL,
        "info, endless acceleration",
        info(|i| i.accel_m_s2 = f32::INFINITY),
        "Invalid",
    );
    say(
        ROBOT_CONTROL,
        "info, a radius that is none",
        info(|i| i.radius_m = f32::NAN),
        "Invalid",
    );
    say(
        ROBOT_CONTROL,
        "info, negative lag",
        info(|i| i.lag_s = -0.001),
        "Invalid",
    );
    say(
        ROBOT_CONTROL,
        "info, a name not UTF-8",
        with(info(|_| ()), 2, 0xff),
        "Malformed",
    );
    say(
        ROBOT_CONTROL,
        "an unknown refusal",
        vec![4, 11],
        "Malformed",
    );
    say(
        ROBOT_CONTROL,
        "an unknown state",
        vec![5, 6, 0, 0],
        "Malformed",
    );
    say(
        ROBOT_CONTROL,
        "an unknown cause",
        vec![5, 0, 11, 0],
        "Malformed",
    );
}
