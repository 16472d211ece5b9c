//! The bytes of version 1, for ever: a message that no longer encodes to these needs a new version.

use telemime_protocol::wire::arm::{WireArm, WireCapsule, WireJoint, WireJointKind, WirePlace};
use telemime_protocol::wire::bend::{WireBend, WireHeld};
use telemime_protocol::wire::hello::{Answer, Hello, RejectCode};
use telemime_protocol::wire::knots::KnotBlock;
use telemime_protocol::wire::memory::WireMemory;
use telemime_protocol::wire::state::WireState;
use telemime_protocol::wire::turn::{WirePose, WireRotation, WireTurn};
use telemime_protocol::wire::v1::*;

const STATE: WireState = WireState {
    t_us: 1_234_570,
    x: [1000, -2500, 25_000],
    memory: WireMemory {
        exponents: [0x12, 0x3f],
        offsets: [[1, -1, 2], [-2, 3, -3], [40, -50, 60], [127, -128, 0]],
    },
};

const PARAMS: WireParams = WireParams {
    gain: 255,
    inflation: 144,
    weights: [[12, 2, 1], [9, 4, 2], [6, 5, 2]],
};

const POSE: WirePose = WirePose {
    turn: Some(WireTurn {
        q: WireRotation([10_000, -31_416, 0]),
        memory: WireMemory {
            exponents: [0x14, 0x0a],
            offsets: [[1, 2, 3], [-1, -2, -3], [127, -128, 0], [5, 6, 7]],
        },
        params: PARAMS,
    }),
    grip: Some(100),
};

const ID: ModelId = [
    0x10, 0x32, 0x54, 0x76, 0x98, 0xba, 0xdc, 0xfe, 0, 1, 2, 3, 4, 5, 6, 0xff,
];

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

fn bytes(hex: &str) -> Vec<u8> {
    let digit = |i: usize| u8::from_str_radix(&hex[i..i + 2], 16).expect("hexadecimal");
    (0..hex.len()).step_by(2).map(digit).collect()
}

fn pinned<M: Message + PartialEq + std::fmt::Debug>(vectors: Vec<(M, &str)>) {
    for (message, golden) in vectors {
        let golden: String = golden.split_whitespace().collect();
        assert_eq!(hex(&message.encode()), golden, "{message:?}");
        assert_eq!(M::decode(&bytes(&golden)), Ok(message));
    }
}

#[test]
fn operator_control() {
    let engage = |drive| {
        OperatorControl::Engage(Engage {
            engagement: 3,
            t_us: 1_234_567,
            drive,
            scale: 0.125,
            rotation: [0.5, -0.5, 0.5, 0.5],
            path_bound_um: 20_000,
            path_turn_bound_urad: 0,
            sample_us: 33_333,
            lease_ms: 650,
        })
    };
    let mirror = |pose| Drive::Mirror {
        state: STATE,
        model: 0x3210,
        params: PARAMS,
        pose,
    };
    pinned(vec![
        (
            OperatorControl::Model {
                id: ID,
                bytes: vec![9, 8, 7],
            },
            "001032547698badcfe00010203040506ff03090807",
        ),
        (
            OperatorControl::Plan {
                id: 300,
                bytes: vec![1, 2],
            },
            "01fb2c01020102",
        ),
        (
            engage(mirror(WirePose::default())),
            "0203fc0ead250000fc14ad2500fbd007fb8713fb50c3123f01ff02fe03fd28ce3c7f8000fb1032ff900c02010904020605020000 \
             0000003e0000003f000000bf0000003f0000003ffb204e00fb3582fb8a02",
        ),
        (
            engage(mirror(POSE)),
            "0203fc0ead250000fc14ad2500fbd007fb8713fb50c3123f01ff02fe03fd28ce3c7f8000fb1032ff900c0201090402060502 \
             01fb204efb6ff500140a010203fffefd7f8000050607ff900c02010904020605020164 \
             0000003e0000003f000000bf0000003f0000003ffb204e00fb3582fb8a02",
        ),
        (
            engage(Drive::Play { plan: 300 }),
            "0203fc0ead250001fb2c010000003e0000003f000000bf0000003f0000003ffb204e00fb3582fb8a02",
        ),
        (
            OperatorControl::Path(PathTail {
                engagement: 3,
                state: STATE,
                first_knot: 300,
                knots: KnotBlock(vec![0x80, 0x7f, 0xff]),
            }),
            "0303fc14ad2500fbd007fb8713fb50c3123f01ff02fe03fd28ce3c7f8000fb2c0103807fff",
        ),
        (OperatorControl::Release { engagement: 3 }, "0403"),
        (OperatorControl::EmergencyStop, "05"),
        (OperatorControl::Reset { changes: 9 }, "0609"),
        (OperatorControl::Goodbye, "07"),
    ]);
}

#[test]
fn robot_control() {
    let info = |model| {
        RobotControl::Info(Info {
            name: "mime7".into(),
            joints: 7,
            speed_m_s: 1.5,
            accel_m_s2: 13.0,
            radius_m: 0.25,
            lag_s: 0.0625,
            model,
            state: RobotState::Holding,
        })
    };
    pinned(vec![
        (
            info(None),
            "00056d696d6537070000c03f000050410000803e0000803d0004",
        ),
        (
            info(Some(ID)),
            "00056d696d6537070000c03f000050410000803e0000803d011032547698badcfe00010203040506 \
             ff04",
        ),
        (
            RobotControl::ModelStored { id: ID },
            "011032547698badcfe00010203040506ff",
        ),
        (RobotControl::PlanStored { id: 300 }, "02fb2c01"),
        (
            RobotControl::Engaged {
                engagement: 3,
                t_us: -1,
                hand_m: [0.5, -0.25, 2.5],
                tip_m: [0.5, 0.0, 0.5],
                hand_q: None,
                tip_q: WireRotation([0, 1, -1]),
            },
            "0303010000003f000080be000020400000003f000000000000003f00000201",
        ),
        (
            RobotControl::Engaged {
                engagement: 3,
                t_us: -1,
                hand_m: [0.5, -0.25, 2.5],
                tip_m: [0.5, 0.0, 0.5],
                hand_q: Some(WireRotation([31_416, -31_416, 125])),
                tip_q: WireRotation([0, 1, -1]),
            },
            "0303010000003f000080be000020400000003f000000000000003f01fb70f5fb6ff5fa000201",
        ),
        (
            RobotControl::Refused {
                reason: Refusal::Diverged,
            },
            "0409",
        ),
        (
            RobotControl::State {
                state: RobotState::Coasting,
                cause: Cause::NewsLate,
                changes: 9,
            },
            "05030209",
        ),
        (
            RobotControl::Arm(WireArm {
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
            }),
            "060200000000000000000000803e0000803f00000000000000000000000000000000000000000000803f0001000020c000002040 \
             00000000000000000000003f0000003f000000bf0000003f000000bf00000000000080bf000000000100 \
             0000003e00000000000000000000803f000000000000000000000000 \
             01020000000000000000000000000000003e00000000000000000000803d",
        ),
        (
            RobotControl::Arm(WireArm {
                joints: Vec::new(),
                tip: WirePlace {
                    m: [0.0; 3],
                    q: [1.0, 0.0, 0.0, 0.0],
                },
                capsules: Vec::new(),
            }),
            "0600 000000000000000000000000 0000803f000000000000000000000000 00",
        ),
    ]);
}

#[test]
fn operator_datagrams() {
    let motion = |checksum, pose, knots: KnotBlock| {
        OperatorDatagram::Motion(Motion {
            epoch: 1,
            engagement: 3,
            seq: 70_000,
            lease_ms: 650,
            model: 0x3210,
            params: PARAMS,
            checksum,
            state: STATE,
            pose,
            first_knot: if knots.is_empty() { 0 } else { 250 },
            knots,
        })
    };
    let go = |bend| OperatorDatagram::Go {
        epoch: 1,
        engagement: 3,
        seq: 251,
        t_us: 1_234_567,
        lease_ms: 650,
        bend,
    };
    // Two of them, whatever they are.
    let knots = KnotBlock(vec![0x5a, 0x00, 0xc3, 0xfe]);
    pinned(vec![
        (
            motion(Some(0xdead_beef), WirePose::default(), knots),
            "c89b00893820990864308650994b7ab6fbbc000f120a3e85387206a02d86651a4f17321dc47043821b0fd05a00c3fe",
        ),
        (
            motion(None, WirePose::default(), KnotBlock::default()),
            "409b008938209908643086509948000f120a3e85387206a02d86651a4f17321dc47043821b00",
        ),
        (
            motion(None, POSE, KnotBlock::default()),
            "709b008938209908643086509948000f120a3e85387206a02d86651a4f17321dc47043821b027108548000013880aca9 \
             68cea13e15e2835ef643086509949900",
        ),
        (go(None), "010103fbfb00fc0ead2500fb8a0200"),
        (
            go(Some(WireBend {
                plan_us: -126,
                rate: 192,
                left: [0, -1, 126],
                held: None,
            })),
            "010103fbfb00fc0ead2500fb8a0201fbfb00c00001fbfc0000",
        ),
        (
            go(Some(WireBend {
                plan_us: 1_500_000,
                rate: 128,
                left: [0; 3],
                held: Some(WireHeld {
                    state: STATE,
                    gain: 255,
                    straight: 128,
                    weight: [127, -64, 0, 64, 1, 100],
                }),
            })),
            "010103fbfb00fc0ead2500fb8a0201fcc0c62d008000000001fc14ad2500fbd007fb8713fb50c3123f \
             01ff02fe03fd28ce3c7f8000ff807fc000400164",
        ),
        (
            OperatorDatagram::Pong {
                epoch: 1,
                t1_us: -5_000_000_000,
                t2_us: 125,
                t3_us: -126,
            },
            "0201fdffe30b5402000000fafbfb00",
        ),
        (
            OperatorDatagram::Clock {
                epoch: 1,
                clock: ExternalClock {
                    ahead_us: 1_792_000_000_000_000,
                    dispersion_us: 50,
                },
            },
            "0401fd0000e006a1bb0c0032",
        ),
        (OperatorDatagram::Stop { epoch: 65_536 }, "03fc00000100"),
    ]);
}

#[test]
fn robot_datagrams() {
    let telemetry = Telemetry {
        epoch: 1,
        seq: 2,
        state: RobotState::Engaged,
        engagement: 3,
        t_us: 1_234_567,
        clock_uncertainty_us: 50_000,
        age_ms: 110,
        delay_ms: 105,
        path_frontier: 250,
        received: 251,
        newest_seq: 252,
        dropped: 4,
        clamps: 5,
        tip_m: [0.5, 0.0, -0.5],
        tip_q: WireRotation([125, -126, 0]),
        grip: Some(255),
        q: vec![1.0, -2.0],
    };
    pinned(vec![
        (
            RobotDatagram::Ping {
                epoch: 1,
                t1_us: 1_234_567,
            },
            "0001fc0ead2500",
        ),
        (
            RobotDatagram::Telemetry(telemetry),
            "0101020203fc0ead2500fb50c36e69fafbfb00fbfc0004050000003f000000 \
             00000000bffafbfb000001ff020000803f000000c0",
        ),
        (
            RobotDatagram::Reception(Reception {
                epoch: 1,
                newest_seq: 252,
                received: 250,
                duplicates: 1,
                reordered: 3,
                loss_runs: 2,
                longest_loss_run: 1,
                jitter_us: 4_000,
                delay_us: [100_000, 99_000, 110_000, 65_536],
                age_us: [180_000, 0, 250, 251],
            }),
            "0201fbfc00fa01030201fba00ffca0860100fcb8820100fcb0ad0100fc00000100fc20bf020000fafbfb00",
        ),
        (
            RobotDatagram::Servo(ServoTimes {
                epoch: 1,
                ticks: 60_000,
                overruns: 6,
                mean_ns: 6_000,
                work_ns: [5_500, 70_000, 70_001, 4_000_000],
                wake_ns: [250, 251, 65_536, 0],
            }),
            "0301fb60ea06fb7017fb7c15fc70110100fc71110100fc00093d00fafbfb00fc0000010000",
        ),
    ]);
}

/// The numbers of states, causes and refusals, which other messages only show one of.
#[test]
fn enumerations() {
    let states = [
        RobotState::Idle,
        RobotState::Ready,
        RobotState::Engaged,
        RobotState::Coasting,
        RobotState::Holding,
        RobotState::Stopped,
    ];
    let causes = [
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
        Cause::ArmFault,
    ];
    let refusals = [
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
    for (n, state) in states.into_iter().enumerate() {
        let cause = Cause::Requested;
        assert_eq!(
            RobotControl::State {
                state,
                cause,
                changes: 0
            }
            .encode(),
            [5, n as u8, 0, 0]
        );
    }
    for (n, cause) in causes.into_iter().enumerate() {
        let state = RobotState::Idle;
        assert_eq!(
            RobotControl::State {
                state,
                cause,
                changes: 0
            }
            .encode(),
            [5, 0, n as u8, 0]
        );
    }
    for (n, reason) in refusals.into_iter().enumerate() {
        assert_eq!(RobotControl::Refused { reason }.encode(), [4, n as u8]);
    }
}

#[test]
fn greetings() {
    let hello = Hello {
        min: 1,
        max: 0x0203,
        features: 0x8000_0000_0000_0001,
    };
    assert_eq!(
        hex(&hello.encode()),
        "544c4d4d 01 0100 0302 0100000000000080".replace(' ', "")
    );
    let ack = Answer::Ack {
        version: 1,
        features: 2,
        epoch: 0x0102_0304,
    };
    assert_eq!(
        hex(&ack.encode()),
        "544c4d4d 02 0100 0200000000000000 04030201".replace(' ', "")
    );
    for (code, number) in [
        (RejectCode::Version, "0100"),
        (RejectCode::Busy, "0200"),
        (RejectCode::Malformed, "0300"),
        (RejectCode::Other(0xabcd), "cdab"),
    ] {
        let text = "no".to_owned();
        let golden = format!("544c4d4d03{number}026e6f");
        assert_eq!(hex(&Answer::Reject { code, text }.encode()), golden);
    }
}

/// Bytes that a decoder must refuse, each for its own reason.
#[test]
fn must_reject() {
    for (why, control) in [
        ("no such message", "08"),
        ("nothing", ""),
        ("cut", "04"),
        ("trailing byte", "0500"),
        ("long form of 3", "04fb0300"),
        ("a length of 2^63", "010afdffffffffffffff7f"),
    ] {
        assert!(OperatorControl::decode(&bytes(control)).is_err(), "{why}");
    }
    for (why, datagram) in [
        ("no such datagram", "05"),
        ("long form of epoch 1", "03fb0100"),
        ("trailing byte", "030100"),
        ("cut", "01010304"),
        ("a bend neither there nor not", "01010304060202"),
        ("a rate above 1.5", "0101030406020100c100000000"),
        ("beyond 100 m", "01010304060201008000fc82841e000000"),
    ] {
        assert!(OperatorDatagram::decode(&bytes(datagram)).is_err(), "{why}");
    }
    for good in [
        "0301",
        "0101030406020100c000000000",
        "01010304060201008000fc80841e000000",
    ] {
        assert!(OperatorDatagram::decode(&bytes(good)).is_ok(), "{good}");
    }
}
