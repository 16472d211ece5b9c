//! The examples in docs/protocol.md are true: bytes are encoded, numbers computed, by the code.

use std::collections::BTreeMap;
use std::fmt::{Debug, Display};
use std::path::Path;

use nalgebra::{SMatrix, SVector, UnitQuaternion, Vector3};
use telemime_endpoint::Mono;
use telemime_protocol::checkpoint::path::{PathBounds, PathDecoder, PoseKnot, pose as on_path};
use telemime_protocol::checkpoint::{Checkpoint, Grid, Plan, PosePlan};
use telemime_protocol::pose;
use telemime_protocol::predict::{
    BLOCK, Calibration, FEATURES, Forecast, Generic, MAX_KNOTS, Model, Regression, Standardisation,
    TARGETS, TurnForecast, checksum,
};
use telemime_protocol::skill::{Gmm, Pace, Parts, Provenance, Samples, Skill, Source, Stats};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::arm::{WireArm, WireCapsule, WireJoint, WireJointKind, WirePlace};
use telemime_protocol::wire::bend::{WireBend, WireHeld};
use telemime_protocol::wire::codec;
use telemime_protocol::wire::frame::{self, Frame};
use telemime_protocol::wire::hello::{Answer, Hello, RejectCode};
use telemime_protocol::wire::knots::{KnotBlock, PathCode};
use telemime_protocol::wire::memory::WireMemory;
use telemime_protocol::wire::pair::{self, AbortCode, Name, PairMessage, Transcript};
use telemime_protocol::wire::state::WireState;
use telemime_protocol::wire::turn::{WirePose, WireRotation, WireTurn};
use telemime_protocol::wire::v1::{
    self, Cause, Drive, Engage, ExternalClock, Info, Message, Motion, OperatorControl,
    OperatorDatagram, PathTail, Reception, Refusal, RobotControl, RobotDatagram, RobotState,
    ServoTimes, Telemetry, WireParams, model_tag,
};
use telemime_robot::rig::{Rig, RigOptions};
use telemime_robot::servo;
use telemime_robot::servo::thread::Times;
use telemime_robot::session::{Output, Session, SessionConfig};

const STATE: WireState = WireState {
    t_us: 3_000_000,
    x: [4_000, -2_000, 25_000],
    memory: WireMemory {
        exponents: [0x23, 0x45],
        offsets: [[80, -32, 0], [96, -36, 4], [100, -40, 4], [80, -30, 5]],
    },
};

const PARAMS: WireParams = WireParams {
    gain: 255,
    inflation: 136,
    weights: [[13, 1, 1], [11, 2, 2], [8, 4, 3]],
};

const TURN: WireTurn = WireTurn {
    q: WireRotation([4_000, -2_500, 0]),
    memory: WireMemory {
        exponents: [0x45, 0x66],
        offsets: [[80, -40, 0], [80, -40, 6], [70, -30, 5], [90, -40, 8]],
    },
    params: WireParams {
        gain: 255,
        inflation: 128,
        weights: [[0, 0, 12]; 3],
    },
};

const BEND: WireBend = WireBend {
    plan_us: 1_500_000,
    rate: 64,
    left: [200, 0, -50],
    held: Some(WireHeld {
        state: WireState {
            t_us: 3_190_000,
            x: [0, 800, -10],
            memory: WireMemory {
                exponents: [0x23, 0x33],
                offsets: [[0, 80, -2], [0, 90, -2], [1, 120, -4], [1, 125, -4]],
            },
        },
        gain: 255,
        straight: 128,
        weight: [64, 10, 100, 0, -5, 127],
    }),
};

const TIP_Q: WireRotation = WireRotation([7_869, -3_976, 0]);

/// Two of them in the motion, the third by the stream.
const KNOTS: [PoseKnot; 3] = [
    PoseKnot {
        tick: 240_000,
        x: [35, -20, 250, 78, 16, -10, 0],
        v: [2, -4, 0, 0, 2, 0, -2],
        start: true,
    },
    PoseKnot {
        tick: 270_000,
        x: [40, -20, 251, 77, 19, -12, -1],
        v: [0, 2, 0, 0, 2, 0, 0],
        start: false,
    },
    PoseKnot {
        tick: 280_002,
        x: [43, -21, 251, 77, 20, -12, -1],
        v: [16, 0, -8, 0, 0, 0, 0],
        start: false,
    },
];

fn places() -> [PoseKnot; 3] {
    KNOTS.map(|knot| knot.place().into())
}

fn pose_code() -> PathCode {
    code(Some(0.05))
}

fn code(turn_rad: Option<f64>) -> PathCode {
    PathCode::new(PathBounds::new(0.02, turn_rad), 33_333).unwrap()
}

fn motion(checksum: Option<u32>) -> Motion {
    Motion {
        epoch: 7,
        engagement: 1,
        seq: 42,
        lease_ms: 650,
        model: 0,
        params: PARAMS,
        checksum,
        state: STATE,
        pose: WirePose::default(),
        first_knot: 0,
        knots: KnotBlock::pack(&STATE, code(None), &[], &KNOTS[..2]).unwrap(),
    }
}

fn plan() -> PosePlan {
    let point = |t_s, x: [f64; 3]| Checkpoint {
        t_s,
        x: SVector::from(x),
    };
    let points = [
        point(0.0, [0.1, 0.0, -0.3]),
        point(0.25, [0.15, 0.05, -0.3]),
        point(0.4, [0.2, 0.01, 0.7]),
    ];
    Plan::quantise(Grid::for_bound(0.004).unwrap(), &points)
        .unwrap()
        .into()
}

/// Two components, three knots; every number is a short binary fraction, so that it survives f32.
fn skill() -> Skill {
    let component = |weight, first_mean, target: f64, gain: f64| {
        let mut mean = SVector::<f64, FEATURES>::zeros();
        mean[0] = first_mean;
        let mut target_m = [0.0; TARGETS];
        let mut gains = [[0.0; TARGETS]; FEATURES];
        for knot in 0..3 {
            target_m[3 * knot] = target * (knot + 1) as f64;
            gains[3][3 * knot] = gain * (knot + 1) as f64;
        }
        Regression {
            weight,
            mean,
            factor: SMatrix::identity(),
            target: target_m,
            gain: gains,
            residual: [[0.0625, 0.0, 0.0, 0.0625, 0.0, 0.0625]; MAX_KNOTS],
        }
    };
    const { assert!(BLOCK == 6) };
    let mut calibration = Calibration::UNTRIED;
    calibration.covariance = [2.0; MAX_KNOTS];
    calibration.errors = [[0.03125, 0.0625, 0.25, 0.5]; MAX_KNOTS];
    calibration.novelty90 = 16.0;
    let mut generic = Generic {
        lead: [[0.0; MAX_KNOTS]; 4],
        products: [0.25; 10],
    };
    for knot in 0..3 {
        generic.lead[0][knot] = 0.5 * (knot + 1) as f64;
        generic.lead[2][knot] = 0.125 * (knot + 1) as f64;
    }
    let model = Model::new(
        3,
        Standardisation {
            mean: SVector::zeros(),
            scale: SVector::repeat(0.5),
            bend: [0.125, 0.0],
            ridge: 0.03125,
            shrinkage: 8.0,
        },
        vec![
            component(0.75, 0.0, 0.125, 0.25),
            component(0.25, 1.0, -0.0625, 0.5),
        ],
        generic,
        calibration,
    )
    .unwrap();
    let motion = Gmm::new([(
        1.0,
        SVector::from([1.0, 0.5, 0.0, 2.0]),
        SMatrix::identity(),
    )])
    .unwrap();
    let stats = Stats {
        speed95_m_s: 4.0,
        acceleration95_m_s2: 32.0,
        reach_m: 0.5,
        min: Vector3::new(0.0, -0.5, 1.5),
        max: Vector3::new(0.5, 0.5, 2.5),
    };
    let provenance = Provenance {
        producer: "example".to_owned(),
        seed: 0,
        sources: vec![Source {
            name: "one".to_owned(),
            sha256: [0xab; 32],
        }],
    };
    Skill::new(Parts {
        name: "wave".to_owned(),
        motion,
        duration_s: 2.0,
        pace: Pace {
            mean_ln_s: 0.75,
            deviation_ln: 0.125,
        },
        predictor: model,
        turn: None,
        grip: None,
        task: None,
        stats,
        samples: Samples {
            motion: 60,
            predictor: 58,
        },
        provenance,
    })
    .unwrap()
}

fn info() -> Info {
    Info {
        name: "mime7".to_owned(),
        joints: 7,
        speed_m_s: 1.5,
        accel_m_s2: 13.0,
        radius_m: 0.25,
        lag_s: 0.0625,
        model: None,
        state: RobotState::Idle,
    }
}

fn telemetry() -> Telemetry {
    Telemetry {
        epoch: 7,
        seq: 300,
        state: RobotState::Engaged,
        engagement: 1,
        t_us: 3_100_000,
        clock_uncertainty_us: 100_500,
        age_ms: 180,
        delay_ms: 101,
        path_frontier: 5,
        received: 40,
        newest_seq: 42,
        dropped: 0,
        clamps: 3,
        tip_m: [0.5, 0.0, 0.25],
        tip_q: TIP_Q,
        grip: Some(255),
        q: vec![0.0, 1.0],
    }
}

/// Bytes that are a message, and nothing but that message.
fn message<M: Message + PartialEq + Debug>(message: &M) -> Vec<u8> {
    let bytes = message.encode();
    assert_eq!(M::decode(&bytes).as_ref(), Ok(message));
    bytes
}

fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

fn pairing(message: PairMessage) -> Vec<u8> {
    let bytes = message.encode();
    let used = bytes.len();
    assert_eq!(PairMessage::decode(&bytes), Ok(Some((message, used))));
    bytes
}

fn bytes() -> BTreeMap<&'static str, Vec<u8>> {
    let stop = message(&OperatorControl::EmergencyStop);
    let straight = Forecast::constant_velocity(&STATE.dequantise(), &PARAMS.dequantise());
    let rotation = [0.5, -0.5, 0.5, -0.5];
    let engage = |drive| {
        OperatorControl::Engage(Engage {
            engagement: 1,
            t_us: 3_010_000,
            drive,
            scale: 0.125,
            rotation,
            path_bound_um: 20_000,
            path_turn_bound_urad: 0,
            sample_us: 33_333,
            lease_ms: 650,
        })
    };
    let mirror = Drive::Mirror {
        state: STATE,
        model: 0,
        params: PARAMS,
        pose: WirePose::default(),
    };
    let hello = Hello {
        min: 1,
        max: 1,
        features: 0,
    };
    let ack = Answer::Ack {
        version: 1,
        features: 0,
        epoch: 7,
    };
    let reject = Answer::Reject {
        code: RejectCode::Busy,
        text: "another operator has authority".to_owned(),
    };
    BTreeMap::from([
        ("u 0", codec::encode(&0u32)),
        ("u 250", codec::encode(&250u32)),
        ("u 251", codec::encode(&251u32)),
        ("u 65536", codec::encode(&65_536u64)),
        ("u 4294967296", codec::encode(&4_294_967_296u64)),
        ("i -1", codec::encode(&-1i64)),
        ("i 126", codec::encode(&126i32)),
        ("i -126", codec::encode(&-126i32)),
        ("hello", hello.encode()),
        ("hello-ack", ack.encode()),
        ("reject", reject.encode()),
        ("frame", frame::encode(&stop, false)),
        ("engage-mirror", message(&engage(mirror))),
        (
            "path",
            message(&OperatorControl::Path(PathTail {
                engagement: 1,
                state: STATE,
                first_knot: 2,
                knots: KnotBlock::pack(&STATE, code(None), &KNOTS[..2], &KNOTS[2..]).unwrap(),
            })),
        ),
        (
            "path-pose",
            message(&OperatorControl::Path(PathTail {
                engagement: 1,
                state: STATE,
                first_knot: 0,
                knots: KnotBlock::pack(&STATE, pose_code(), &[], &KNOTS).unwrap(),
            })),
        ),
        ("reset", message(&OperatorControl::Reset { changes: 9 })),
        ("engage-play", message(&engage(Drive::Play { plan: 1 }))),
        ("info", message(&RobotControl::Info(info()))),
        (
            "engaged",
            message(&RobotControl::Engaged {
                engagement: 1,
                t_us: 3_050_000,
                hand_m: [0.5, -0.25, 2.5],
                tip_m: [0.5, 0.0, 0.25],
                hand_q: None,
                tip_q: TIP_Q,
            }),
        ),
        (
            "refused",
            message(&RobotControl::Refused {
                reason: Refusal::ClockUnknown,
            }),
        ),
        (
            "state",
            message(&RobotControl::State {
                state: RobotState::Holding,
                cause: Cause::LeaseExpired,
                changes: 9,
            }),
        ),
        (
            "arm",
            message(&RobotControl::Arm(WireArm {
                joints: vec![
                    WireJoint {
                        place: WirePlace {
                            m: [0.0, 0.0, 0.25],
                            q: [1.0, 0.0, 0.0, 0.0],
                        },
                        axis: [0.0, 0.0, 1.0],
                        kind: WireJointKind::Revolute,
                        limits: Some([-2.5, 2.5]),
                    },
                    WireJoint {
                        place: WirePlace {
                            m: [0.0, 0.0, 0.5],
                            q: [0.5, -0.5, 0.5, -0.5],
                        },
                        axis: [0.0, -1.0, 0.0],
                        kind: WireJointKind::Prismatic,
                        limits: None,
                    },
                ],
                tip: WirePlace {
                    m: [0.125, 0.0, 0.0],
                    q: [1.0, 0.0, 0.0, 0.0],
                },
                capsules: vec![WireCapsule {
                    link: 2,
                    from: [0.0, 0.0, 0.0],
                    to: [0.125, 0.0, 0.0],
                    radius_m: 0.0625,
                }],
            })),
        ),
        (
            "motion",
            message(&OperatorDatagram::Motion(motion(Some(checksum(
                &straight, None,
            ))))),
        ),
        (
            "motion-pose",
            message(&OperatorDatagram::Motion(Motion {
                pose: WirePose {
                    turn: Some(TURN),
                    grip: Some(200),
                },
                knots: KnotBlock::default(),
                ..motion(None)
            })),
        ),
        (
            "go",
            message(&OperatorDatagram::Go {
                epoch: 7,
                engagement: 2,
                seq: 43,
                t_us: 3_200_000,
                lease_ms: 650,
                bend: None,
            }),
        ),
        (
            "go-bend",
            message(&OperatorDatagram::Go {
                epoch: 7,
                engagement: 2,
                seq: 44,
                t_us: 3_200_000,
                lease_ms: 650,
                bend: Some(BEND),
            }),
        ),
        (
            "pong",
            message(&OperatorDatagram::Pong {
                epoch: 7,
                t1_us: 90_000_000,
                t2_us: 3_000_000,
                t3_us: 3_000_000,
            }),
        ),
        ("stop", message(&OperatorDatagram::Stop { epoch: 7 })),
        (
            "clock",
            message(&OperatorDatagram::Clock {
                epoch: 7,
                clock: ExternalClock {
                    ahead_us: 1_792_000_000_000_000,
                    dispersion_us: 50,
                },
            }),
        ),
        (
            "ping",
            message(&RobotDatagram::Ping {
                epoch: 7,
                t1_us: 90_000_000,
            }),
        ),
        ("telemetry", message(&RobotDatagram::Telemetry(telemetry()))),
        (
            "reception",
            message(&RobotDatagram::Reception(Reception {
                epoch: 7,
                newest_seq: 42,
                received: 40,
                duplicates: 0,
                reordered: 1,
                loss_runs: 1,
                longest_loss_run: 2,
                jitter_us: 3_300,
                delay_us: [101_000, 100_500, 109_000, 110_000],
                age_us: [150_000, 145_000, 240_000, 310_000],
            })),
        ),
        (
            "servo",
            message(&RobotDatagram::Servo(ServoTimes {
                epoch: 7,
                ticks: 60_000,
                overruns: 2,
                mean_ns: 5_600,
                work_ns: [5_400, 7_400, 12_000, 80_000],
                wake_ns: [55_000, 90_000, 400_000, 1_200_000],
            })),
        ),
        ("plan", codec::encode(&plan())),
        ("pair-offer", pairing(PairMessage::Offer(name("laptop")))),
        (
            "pair-commit",
            pairing(PairMessage::Commit(
                pair::commitment(&[0x22; 32]),
                name("arm"),
            )),
        ),
        (
            "pair-abort",
            pairing(PairMessage::Abort(AbortCode::Declined, "no".into())),
        ),
    ])
}

fn values() -> BTreeMap<String, String> {
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

fn document() -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/protocol.md");
    std::fs::read_to_string(path).unwrap()
}

/// The content of every fenced block that begins with "```kind", with what follows the kind.
fn blocks<'a>(text: &'a str, kind: &str) -> Vec<(&'a str, &'a str)> {
    let fence = format!("```{kind} ");
    let mut found = Vec::new();
    let mut rest = text;
    while let Some(at) = rest.find(&fence) {
        let (title, after) = rest[at + fence.len()..].split_once('\n').unwrap();
        let (body, after) = after.split_once("```").unwrap();
        found.push((title.trim(), body));
        rest = after;
    }
    found
}

fn hex(bytes: &[u8]) -> String {
    let pairs: Vec<_> = bytes.iter().map(|b| format!("{b:02x}")).collect();
    pairs.join(" ")
}

/// Fails with all that the document should say instead.
fn same<K: Ord + Display>(written: &BTreeMap<K, String>, expected: &BTreeMap<K, String>) {
    let wrong = expected.iter().filter(|(k, v)| written.get(k) != Some(v));
    let wrong: String = wrong.map(|(k, v)| format!("{k} = {v}\n")).collect();
    assert!(wrong.is_empty(), "docs/protocol.md should say\n{wrong}");
    let stray = written.keys().filter(|k| !expected.contains_key(k));
    let stray: String = stray.map(|k| format!("{k}\n")).collect();
    assert!(stray.is_empty(), "no code stands behind\n{stray}");
}

#[test]
fn the_bytes_in_the_specification_are_those_of_the_code() {
    let text = document();
    let mut written = BTreeMap::new();
    for (title, body) in blocks(&text, "hex") {
        for line in body.lines() {
            let line = line.split('#').next().unwrap_or_default();
            // One block may hold several short encodings, each line under its own name.
            let (name, digits) = line.split_once(" = ").unwrap_or((title, line));
            let bytes = digits
                .split_whitespace()
                .map(|pair| u8::from_str_radix(pair, 16).unwrap());
            let all: &mut Vec<u8> = written.entry(name.trim()).or_default();
            all.extend(bytes);
        }
    }
    let written: BTreeMap<_, _> = written.iter().map(|(n, b)| (*n, hex(b))).collect();
    let expected: BTreeMap<_, _> = bytes().iter().map(|(n, b)| (*n, hex(b))).collect();
    same(&written, &expected);
}

#[test]
fn the_numbers_in_the_specification_are_those_of_the_code() {
    let text = document();
    let written: BTreeMap<_, _> = blocks(&text, "values")
        .iter()
        .flat_map(|(_, body)| body.lines())
        .filter_map(|line| line.split_once(" = "))
        .map(|(name, value)| (name.trim().to_owned(), value.trim().to_owned()))
        .collect();
    same(&written, &values());
}

#[test]
fn a_plan_that_does_not_begin_at_zero_is_refused() {
    let rig = Rig::load(&RigOptions::default()).unwrap();
    let (rings, _handle) = servo::rings();
    let report = rig.servo(rings).tick(Mono(0));
    let mut session = Session::new(SessionConfig::default(), rig.info(), 1, None, Mono(0));
    session.handle_report(&report, Times::default());
    // Before it knows the clock it judges no request at all.
    for _ in 0..4 {
        let pong = OperatorDatagram::Pong {
            epoch: 1,
            t1_us: 0,
            t2_us: 0,
            t3_us: 0,
        };
        session.handle_datagram(Mono(1), &pong.encode());
    }
    let point = |t_s| Checkpoint {
        t_s,
        x: SVector::from([0.0, 0.0, t_s]),
    };
    let late = Plan::quantise(Grid::for_bound(0.004).unwrap(), &[point(0.5), point(1.0)]).unwrap();
    let late = PosePlan::from(late);
    let mut ask = |message: OperatorControl| {
        let frame = Frame {
            ignorable: false,
            payload: message.encode(),
        };
        session.handle_control(Mono(1), &frame).unwrap();
        let mut said = Vec::new();
        while let Some(output) = session.poll_output() {
            if let Output::Control(bytes) = output {
                said.push(RobotControl::decode(&bytes).unwrap());
            }
        }
        said
    };
    ask(OperatorControl::Plan {
        id: 1,
        bytes: codec::encode(&late),
    });
    let said = ask(OperatorControl::Engage(Engage {
        engagement: 1,
        t_us: 0,
        drive: Drive::Play { plan: 1 },
        scale: 0.1,
        rotation: [1.0, 0.0, 0.0, 0.0],
        path_bound_um: 1000,
        path_turn_bound_urad: 0,
        sample_us: 33_333,
        lease_ms: 650,
    }));
    assert_eq!(
        said,
        [RobotControl::Refused {
            reason: Refusal::BadPlan
        }]
    );
}
