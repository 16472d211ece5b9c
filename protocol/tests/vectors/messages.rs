//! The greeting, numbers, and every message: what is on the wire and what it says.

use serde::Serialize;
use serde_json::json;
use telemime_protocol::checkpoint::path::{POSE, PathBounds, PathGrid, PoseKnot, tick_of};
use telemime_protocol::wire::arm::{WireArm, WireCapsule, WireJoint, WireJointKind, WirePlace};
use telemime_protocol::wire::hello::{Answer, Hello, RejectCode};
use telemime_protocol::wire::knots::{KnotBlock, PathCode};
use telemime_protocol::wire::state::WireState;
use telemime_protocol::wire::v1::*;
use telemime_protocol::wire::{codec, frame};

use super::Vector;
use super::draw::Draw;
use super::meaning::says;

pub(crate) fn greetings() -> Vec<Vector> {
    let mut all = Vec::new();
    for (name, min, max, features) in [
        ("hello", 1, 1, 0),
        ("hello of several versions", 1, 300, 0),
        ("hello with features nobody knows", 1, 1, 1 << 63 | 5),
    ] {
        let hello = Hello { min, max, features };
        let bytes = hello.encode();
        assert_eq!(Hello::decode(&bytes), Ok(Some((hello, bytes.len()))));
        let value = json!({"Hello": {"min": min, "max": max, "features": features}});
        all.push(says("operator greeting", name, bytes, value));
    }
    let ack = Answer::Ack {
        version: 1,
        features: 0,
        epoch: 7,
    };
    let value = json!({"HelloAck": {"version": 1, "features": 0, "epoch": 7}});
    all.push(says("robot greeting", "ack", ack.encode(), value));
    for (name, code, number, text) in [
        (
            "no common version",
            RejectCode::Version,
            1,
            "speaks version 1 only",
        ),
        (
            "busy",
            RejectCode::Busy,
            2,
            "another operator has authority",
        ),
        ("malformed", RejectCode::Malformed, 3, ""),
        (
            "a reason of the future",
            RejectCode::Other(9000),
            9000,
            "früh → spät",
        ),
    ] {
        let reject = Answer::Reject {
            code,
            text: text.to_owned(),
        };
        let bytes = reject.encode();
        assert_eq!(Answer::decode(&bytes), Ok(Some((reject, bytes.len()))));
        let value = json!({"Reject": {"code": number, "text": text}});
        all.push(says("robot greeting", name, bytes, value));
    }
    all
}

pub(crate) fn numbers() -> Vec<Vector> {
    let edges = [
        0,
        1,
        250,
        251,
        65_535,
        65_536,
        4_294_967_295,
        4_294_967_296,
        u64::MAX,
    ];
    let unsigned = edges.map(|n| says("u64", n.to_string(), codec::encode(&n), json!(n)));
    let edges = [
        0,
        -1,
        1,
        125,
        -125,
        126,
        -126,
        32_767,
        -32_768,
        i64::MAX,
        i64::MIN,
    ];
    let signed = edges.map(|n| says("i64", n.to_string(), codec::encode(&n), json!(n)));
    let framed = |name: &str, payload: &[u8], ignorable| {
        let value = json!({"payload": super::hex(payload), "ignorable": ignorable});
        says("frame", name, frame::encode(payload, ignorable), value)
    };
    let frames = [
        framed("empty", &[], false),
        framed("an emergency stop", &[5], false),
        framed("of the future", &[200; 300], true),
    ];
    unsigned.into_iter().chain(signed).chain(frames).collect()
}

/// A message with the value it decodes to.
fn message<M>(kind: &'static str, name: impl ToString, message: &M) -> Vector
where
    M: Message + Serialize + PartialEq + std::fmt::Debug,
{
    let bytes = message.encode();
    assert_eq!(M::decode(&bytes).as_ref(), Ok(message));
    let value = serde_json::to_value(message).expect("plain data");
    says(kind, name, bytes, value)
}

pub(crate) const OPERATOR_CONTROL: &str = "operator control";
pub(crate) const ROBOT_CONTROL: &str = "robot control";
pub(crate) const OPERATOR_DATAGRAM: &str = "operator datagram";
pub(crate) const ROBOT_DATAGRAM: &str = "robot datagram";

const STATES: [RobotState; 6] = [
    RobotState::Idle,
    RobotState::Ready,
    RobotState::Engaged,
    RobotState::Coasting,
    RobotState::Holding,
    RobotState::Stopped,
];

const CAUSES: [Cause; 10] = [
    Cause::Requested,
    Cause::NewsArrived,
    Cause::NewsLate,
    Cause::LeaseExpired,
    Cause::PlanFinished,
    Cause::ConnectionLost,
    Cause::OperatorStop,
    Cause::LocalStop,
    Cause::ClockStep,
    Cause::Fault,
];

const REASONS: [Refusal; 11] = [
    Refusal::Stopped,
    Refusal::AlreadyEngaged,
    Refusal::OldEngagement,
    Refusal::StaleReference,
    Refusal::ClockUnknown,
    Refusal::BadModel,
    Refusal::BadPlan,
    Refusal::BadMapping,
    Refusal::Moving,
    Refusal::Diverged,
    Refusal::NotYours,
];

pub(crate) const BOUND_UM: u32 = 20_000;

pub(crate) const SAMPLE_US: u32 = 33_333;

/// What a path is coded with; a bound of 0 µrad carries no orientation.
pub(crate) fn code(turn_urad: u32) -> PathCode {
    let bounds = PathBounds::of_wire(BOUND_UM, turn_urad);
    PathCode::new(bounds, SAMPLE_US).expect("a usable bound")
}

/// A path of `n` knots that ends shortly before the state.
pub(crate) fn path_knots(
    draw: &mut Draw,
    state: &WireState,
    n: usize,
    code: PathCode,
) -> Vec<PoseKnot> {
    let s = state.dequantise();
    let mut tick = tick_of(s.t) - 30_000 * n as i64;
    let place = (s.x / code.grid().step_m()).map(|v| v.round() as i32);
    let mut x = [place.x, place.y, place.z, 40, -30, 9, 0];
    let carried = if code.turns() { POSE } else { 3 };
    x[carried..].fill(0);
    (0..n)
        .map(|i| {
            let span = 1 + draw.bits(14) as i64;
            tick += span;
            x[..carried]
                .iter_mut()
                .for_each(|v| *v += draw.signed(6) as i32);
            let start = i == 0 || draw.below(8) == 0;
            let shift = if start {
                1
            } else {
                PathGrid::<3>::slope_shift(span)
            };
            let mut v = [0; POSE];
            v[..carried]
                .iter_mut()
                .for_each(|v| *v = (draw.signed(5) as i32) << shift);
            PoseKnot { tick, x, v, start }
        })
        .collect()
}

fn engage(draw: &mut Draw, drive: Drive) -> OperatorControl {
    OperatorControl::Engage(Engage {
        engagement: draw.u32(),
        t_us: draw.signed(53),
        drive,
        scale: [0.125, 1.0, 10.0][draw.below(3)],
        rotation: [[1.0, 0.0, 0.0, 0.0], [0.5, -0.5, 0.5, -0.5]][draw.below(2)],
        path_bound_um: 1 + draw.bits(31) as u32,
        path_turn_bound_urad: draw.maybe(|draw| draw.bits(21) as u32).unwrap_or(0),
        sample_us: 1 + draw.bits(19) as u32,
        lease_ms: draw.u16(),
    })
}

fn motion(draw: &mut Draw, knot_count: usize) -> Motion {
    let state = draw.state();
    let path = path_knots(draw, &state, knot_count, code(0));
    Motion {
        epoch: draw.u32(),
        engagement: draw.u32(),
        seq: draw.u32(),
        lease_ms: 10 * u16::from(draw.u8()),
        model: draw.u16(),
        params: draw.params(),
        checksum: draw.maybe(Draw::u32),
        state,
        pose: draw.pose(),
        first_knot: if path.is_empty() { 0 } else { draw.u32() },
        knots: KnotBlock::pack(&state, code(0), &[], &path).expect("a path before the state"),
    }
}

fn telemetry(draw: &mut Draw) -> Telemetry {
    Telemetry {
        epoch: draw.u32(),
        seq: draw.u32(),
        state: STATES[draw.below(6)],
        engagement: draw.u32(),
        t_us: draw.signed(53),
        clock_uncertainty_us: draw.u32(),
        age_ms: draw.u16(),
        delay_ms: draw.u16(),
        path_frontier: draw.u32(),
        received: draw.u32(),
        newest_seq: draw.u32(),
        dropped: draw.u32(),
        clamps: draw.u32(),
        tip_m: std::array::from_fn(|_| draw.fraction()),
        tip_q: draw.rotation(),
        grip: draw.maybe(Draw::u8),
        q: (0..draw.below(11)).map(|_| draw.fraction()).collect(),
    }
}

fn servo(draw: &mut Draw) -> ServoTimes {
    ServoTimes {
        epoch: draw.u32(),
        ticks: draw.signed(53).unsigned_abs(),
        overruns: draw.u32(),
        mean_ns: draw.u32(),
        work_ns: std::array::from_fn(|_| draw.u32()),
        wake_ns: std::array::from_fn(|_| draw.u32()),
    }
}

fn reception(draw: &mut Draw) -> Reception {
    Reception {
        epoch: draw.u32(),
        newest_seq: draw.u32(),
        received: draw.u32(),
        duplicates: draw.u32(),
        reordered: draw.u32(),
        loss_runs: draw.u32(),
        longest_loss_run: draw.u32(),
        jitter_us: draw.u32(),
        delay_us: std::array::from_fn(|_| draw.u32()),
        age_us: std::array::from_fn(|_| draw.u32()),
    }
}

pub(crate) fn messages() -> Vec<Vector> {
    let draw = &mut Draw::new(1);
    let id: ModelId = std::array::from_fn(|i| 17 * i as u8);
    let mut all = vec![
        message(
            OPERATOR_CONTROL,
            "model",
            &OperatorControl::Model {
                id,
                bytes: vec![9, 0, 255],
            },
        ),
        message(
            OPERATOR_CONTROL,
            "plan",
            &OperatorControl::Plan {
                id: 300,
                bytes: vec![1; 251],
            },
        ),
        message(
            OPERATOR_CONTROL,
            "release",
            &OperatorControl::Release { engagement: 3 },
        ),
        message(
            OPERATOR_CONTROL,
            "emergency stop",
            &OperatorControl::EmergencyStop,
        ),
        message(
            OPERATOR_CONTROL,
            "reset",
            &OperatorControl::Reset { changes: 9 },
        ),
        message(OPERATOR_CONTROL, "goodbye", &OperatorControl::Goodbye),
        message(
            ROBOT_CONTROL,
            "model stored",
            &RobotControl::ModelStored { id },
        ),
        message(
            ROBOT_CONTROL,
            "plan stored",
            &RobotControl::PlanStored { id: u32::MAX },
        ),
        message(
            OPERATOR_DATAGRAM,
            "stop",
            &OperatorDatagram::Stop { epoch: 7 },
        ),
        message(
            OPERATOR_DATAGRAM,
            "clock",
            &OperatorDatagram::Clock {
                epoch: 7,
                clock: ExternalClock {
                    ahead_us: 1_792_000_000_000_000,
                    dispersion_us: 50,
                },
            },
        ),
    ];
    for i in 0..8 {
        let drive = match i % 2 {
            0 => Drive::Play { plan: draw.u32() },
            _ => Drive::Mirror {
                state: draw.state(),
                model: draw.u16(),
                params: draw.params(),
                pose: draw.pose(),
            },
        };
        let m = engage(draw, drive);
        all.push(message(OPERATOR_CONTROL, format!("engage {i}"), &m));
    }
    for (i, n) in [0, 1, 2, 7, 200].into_iter().enumerate() {
        let m = motion(draw, n);
        let tail = PathTail {
            engagement: m.engagement,
            state: m.state,
            first_knot: m.first_knot,
            knots: m.knots,
        };
        all.push(message(
            OPERATOR_CONTROL,
            format!("path {i}"),
            &OperatorControl::Path(tail),
        ));
    }
    for (i, state) in STATES.into_iter().enumerate() {
        let info = Info {
            name: ["", "mime7", "Gelenkarm № 7"][i % 3].to_owned(),
            joints: draw.u8(),
            speed_m_s: 1.5,
            accel_m_s2: 13.0,
            radius_m: 0.25,
            lag_s: [0.0, 0.0625, 2.0][i % 3],
            model: draw.maybe(|_| id),
            state,
        };
        all.push(message(
            ROBOT_CONTROL,
            format!("info {i}"),
            &RobotControl::Info(info),
        ));
        let engaged = RobotControl::Engaged {
            engagement: draw.u32(),
            t_us: draw.signed(53),
            hand_m: std::array::from_fn(|_| draw.fraction()),
            tip_m: std::array::from_fn(|_| draw.fraction()),
            hand_q: draw.maybe(Draw::rotation),
            tip_q: draw.rotation(),
        };
        all.push(message(ROBOT_CONTROL, format!("engaged {i}"), &engaged));
    }
    for reason in REASONS {
        let name = format!("refused: {reason:?}");
        all.push(message(
            ROBOT_CONTROL,
            name,
            &RobotControl::Refused { reason },
        ));
    }
    for cause in CAUSES {
        let (state, changes) = (STATES[draw.below(6)], draw.u32());
        let m = RobotControl::State {
            state,
            cause,
            changes,
        };
        all.push(message(ROBOT_CONTROL, format!("state: {cause:?}"), &m));
    }
    // Came later: what is drawn for the others stays.
    let m = RobotControl::State {
        state: RobotState::Stopped,
        cause: Cause::ArmFault,
        changes: 3,
    };
    all.push(message(ROBOT_CONTROL, "state: ArmFault", &m));
    for (i, n) in [0, 0, 1, 2, 3, 5, 8, 13, 21, 32].into_iter().enumerate() {
        let m = OperatorDatagram::Motion(motion(draw, n));
        all.push(message(OPERATOR_DATAGRAM, format!("motion {i}"), &m));
    }
    for i in 0..4 {
        let go = OperatorDatagram::Go {
            epoch: draw.u32(),
            engagement: draw.u32(),
            seq: draw.u32(),
            t_us: draw.signed(53),
            lease_ms: draw.u16(),
            bend: draw.maybe(Draw::bend),
        };
        let pong = OperatorDatagram::Pong {
            epoch: draw.u32(),
            t1_us: draw.signed(63),
            t2_us: draw.signed(63),
            t3_us: draw.signed(63),
        };
        let ping = RobotDatagram::Ping {
            epoch: draw.u32(),
            t1_us: draw.signed(63),
        };
        all.push(message(OPERATOR_DATAGRAM, format!("go {i}"), &go));
        all.push(message(OPERATOR_DATAGRAM, format!("pong {i}"), &pong));
        all.push(message(ROBOT_DATAGRAM, format!("ping {i}"), &ping));
    }
    for i in 0..8 {
        let m = RobotDatagram::Telemetry(telemetry(draw));
        all.push(message(ROBOT_DATAGRAM, format!("telemetry {i}"), &m));
    }
    // After all others, which would otherwise be drawn anew.
    for i in 0..4 {
        let m = RobotDatagram::Reception(reception(draw));
        all.push(message(ROBOT_DATAGRAM, format!("reception {i}"), &m));
    }
    for joints in [0, 1, 7, 10] {
        let m = RobotControl::Arm(arm(draw, joints));
        all.push(message(ROBOT_CONTROL, format!("arm of {joints}"), &m));
    }
    for i in 0..4 {
        let m = RobotDatagram::Servo(servo(draw));
        all.push(message(ROBOT_DATAGRAM, format!("servo {i}"), &m));
    }
    all
}

fn arm(draw: &mut Draw, joints: u8) -> WireArm {
    let place = |draw: &mut Draw| WirePlace {
        m: std::array::from_fn(|_| draw.fraction()),
        q: [[1.0, 0.0, 0.0, 0.0], [0.5, -0.5, 0.5, -0.5]][draw.below(2)],
    };
    WireArm {
        joints: (0..joints)
            .map(|_| WireJoint {
                place: place(draw),
                axis: [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]][draw.below(2)],
                kind: [WireJointKind::Revolute, WireJointKind::Prismatic][draw.below(2)],
                limits: draw.maybe(|_| [-1.5, 2.75]),
            })
            .collect(),
        tip: place(draw),
        capsules: (0..=joints)
            .map(|link| WireCapsule {
                link,
                from: std::array::from_fn(|_| draw.fraction()),
                to: std::array::from_fn(|_| draw.fraction()),
                radius_m: 0.0625,
            })
            .collect(),
    }
}
