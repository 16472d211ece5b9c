//! Every block of bytes in the document.

use std::collections::BTreeMap;

use telemime_protocol::predict::{Forecast, checksum};
use telemime_protocol::wire::arm::{WireArm, WireCapsule, WireJoint, WireJointKind, WirePlace};
use telemime_protocol::wire::codec;
use telemime_protocol::wire::frame::{self};
use telemime_protocol::wire::hello::{Answer, Hello, RejectCode};
use telemime_protocol::wire::knots::KnotBlock;
use telemime_protocol::wire::pair::{self, AbortCode, PairMessage};
use telemime_protocol::wire::turn::WirePose;
use telemime_protocol::wire::v1::{
    Cause, Drive, Engage, ExternalClock, Motion, OperatorControl, OperatorDatagram, PathTail,
    Reception, Refusal, RobotControl, RobotDatagram, RobotState, ServoTimes,
};

use super::example::*;

pub(super) fn bytes() -> BTreeMap<&'static str, Vec<u8>> {
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
