//! Messages, drawn; and damage to their bytes.

use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;
use telemime_protocol::checkpoint::path::{
    MAX_TURN_URAD, PathBounds, PathGrid, PathKnot, PoseKnot,
};
use telemime_protocol::wire::arm::{WireArm, WireCapsule, WireJoint, WireJointKind, WirePlace};
use telemime_protocol::wire::bend::{WireBend, WireHeld};
use telemime_protocol::wire::knots::{KnotBlock, PathCode};
use telemime_protocol::wire::memory::WireMemory;
use telemime_protocol::wire::state::{MAX_POSITION_M, POSITION_STEP_M, WireState};
use telemime_protocol::wire::turn::{WirePose, WireRotation, WireTurn};
use telemime_protocol::wire::v1::*;

pub(crate) fn finite() -> impl Strategy<Value = f32> {
    any::<f32>().prop_filter("finite", |v| v.is_finite())
}

pub(crate) fn positive() -> impl Strategy<Value = f32> {
    any::<f32>().prop_filter("positive", |v| v.is_finite() && *v > 0.0)
}

pub(crate) fn state() -> impl Strategy<Value = WireState> {
    let limit = (MAX_POSITION_M / POSITION_STEP_M) as i32;
    let t_us = (-i64::MAX / 10_000..=i64::MAX / 10_000).prop_map(|ticks| 10 * ticks);
    (
        t_us,
        [-limit..=limit, -limit..=limit, -limit..=limit],
        memory(any::<u8>().boxed()),
    )
        .prop_map(|(t_us, x, memory)| WireState { t_us, x, memory })
}

/// Any offsets, with bytes of exponents.
pub(crate) fn memory(exponents: BoxedStrategy<u8>) -> impl Strategy<Value = WireMemory> {
    let exponents = [exponents.clone(), exponents];
    (exponents, any::<[[i8; 3]; 4]>())
        .prop_map(|(exponents, offsets)| WireMemory { exponents, offsets })
}

pub(crate) fn params() -> impl Strategy<Value = WireParams> {
    let weights = prop::array::uniform3(prop::array::uniform3(0..=5_u8));
    (any::<u8>(), any::<u8>(), weights).prop_map(|(gain, inflation, weights)| WireParams {
        gain,
        inflation,
        weights,
    })
}

pub(crate) fn rotation() -> impl Strategy<Value = WireRotation> {
    [
        -31_416..=31_416_i16,
        -31_416..=31_416_i16,
        -31_416..=31_416_i16,
    ]
    .prop_map(WireRotation)
}

pub(crate) fn pose() -> impl Strategy<Value = WirePose> {
    let exponents = (0..=10u8, 0..=10u8).prop_map(|(a, b)| a << 4 | b);
    let turn = (rotation(), memory(exponents.boxed()), params())
        .prop_map(|(q, memory, params)| WireTurn { q, memory, params });
    (option::of(turn), option::of(any::<u8>())).prop_map(|(turn, grip)| WirePose { turn, grip })
}

pub(crate) fn unit() -> impl Strategy<Value = [f32; 4]> {
    let quaternion = [-1.0..1.0f32, -1.0..1.0f32, -1.0..1.0f32, 0.1..1.0f32];
    quaternion.prop_map(|q| {
        let norm = q.iter().map(|v| v * v).sum::<f32>().sqrt();
        q.map(|v| v / norm)
    })
}

pub(crate) fn engage() -> impl Strategy<Value = Engage> {
    let drive = prop_oneof![
        (state(), any::<u16>(), params(), pose()).prop_map(|(state, model, params, pose)| {
            Drive::Mirror {
                state,
                model,
                params,
                pose,
            }
        }),
        any::<u32>().prop_map(|plan| Drive::Play { plan }),
    ];
    (
        any::<u32>(),
        any::<i64>(),
        drive,
        1e-6..10.0f32,
        unit(),
        (1..=u32::MAX, 0..=MAX_TURN_URAD),
        1..=MAX_SAMPLE_US,
        any::<u16>(),
    )
        .prop_map(
            |(engagement, t_us, drive, scale, rotation, bounds, sample_us, lease_ms)| {
                let (path_bound_um, path_turn_bound_urad) = bounds;
                Engage {
                    engagement,
                    t_us,
                    drive,
                    scale,
                    rotation,
                    path_bound_um,
                    path_turn_bound_urad,
                    sample_us,
                    lease_ms,
                }
            },
        )
}

pub(crate) fn operator_control() -> impl Strategy<Value = OperatorControl> {
    prop_oneof![
        (any::<[u8; 16]>(), vec(any::<u8>(), 0..600))
            .prop_map(|(id, bytes)| OperatorControl::Model { id, bytes }),
        (any::<u32>(), vec(any::<u8>(), 0..600))
            .prop_map(|(id, bytes)| OperatorControl::Plan { id, bytes }),
        engage().prop_map(OperatorControl::Engage),
        any::<u32>().prop_map(|engagement| OperatorControl::Release { engagement }),
        Just(OperatorControl::EmergencyStop),
        any::<u32>().prop_map(|changes| OperatorControl::Reset { changes }),
        (any::<u32>(), state(), any::<u32>(), block()).prop_map(
            |(engagement, state, first_knot, knots)| OperatorControl::Path(PathTail {
                engagement,
                state,
                first_knot,
                knots,
            })
        ),
        Just(OperatorControl::Goodbye),
    ]
}

pub(crate) fn robot_state() -> impl Strategy<Value = RobotState> {
    prop::sample::select(vec![
        RobotState::Idle,
        RobotState::Ready,
        RobotState::Engaged,
        RobotState::Coasting,
        RobotState::Holding,
        RobotState::Stopped,
    ])
}

pub(crate) fn cause() -> impl Strategy<Value = Cause> {
    prop::sample::select(vec![
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
    ])
}

pub(crate) fn refusal() -> impl Strategy<Value = Refusal> {
    prop::sample::select(vec![
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
    ])
}

pub(crate) fn robot_control() -> impl Strategy<Value = RobotControl> {
    let info = (
        "[a-zé ]{0,32}",
        any::<u8>(),
        [positive(), positive(), positive()],
        0.0..=2.0f32,
        option::of(any::<[u8; 16]>()),
        robot_state(),
    )
        .prop_map(
            |(name, joints, [speed_m_s, accel_m_s2, radius_m], lag_s, model, state)| {
                RobotControl::Info(Info {
                    name,
                    joints,
                    speed_m_s,
                    accel_m_s2,
                    radius_m,
                    lag_s,
                    model,
                    state,
                })
            },
        );
    let three = || [finite(), finite(), finite()];
    prop_oneof![
        info,
        any::<[u8; 16]>().prop_map(|id| RobotControl::ModelStored { id }),
        any::<u32>().prop_map(|id| RobotControl::PlanStored { id }),
        (
            any::<u32>(),
            any::<i64>(),
            three(),
            three(),
            option::of(rotation()),
            rotation()
        )
            .prop_map(|(engagement, t_us, hand_m, tip_m, hand_q, tip_q)| {
                RobotControl::Engaged {
                    engagement,
                    t_us,
                    hand_m,
                    tip_m,
                    hand_q,
                    tip_q,
                }
            }),
        refusal().prop_map(|reason| RobotControl::Refused { reason }),
        (robot_state(), cause(), any::<u32>()).prop_map(|(state, cause, changes)| {
            RobotControl::State {
                state,
                cause,
                changes,
            }
        }),
        arm(),
    ]
}

pub(crate) fn arm() -> impl Strategy<Value = RobotControl> {
    let length = || -100.0..=100.0f32;
    let three = move || [length(), length(), length()];
    let q = || prop_oneof![Just([1.0, 0.0, 0.0, 0.0]), Just([0.5f32, -0.5, 0.5, -0.5])];
    let place = move || (three(), q()).prop_map(|(m, q)| WirePlace { m, q });
    let kind = prop_oneof![
        Just(WireJointKind::Revolute),
        Just(WireJointKind::Prismatic)
    ];
    let joint =
        (place(), kind, option::of(0.0..=3.0f32)).prop_map(|(place, kind, upper)| WireJoint {
            place,
            axis: [0.0, -1.0, 0.0],
            kind,
            limits: upper.map(|upper| [-1.0, upper]),
        });
    let capsule = (three(), three(), 1e-3..=100.0f32);
    (vec(joint, 0..=10), place(), vec(capsule, 0..=64)).prop_map(|(joints, tip, capsules)| {
        let links = joints.len() as u8 + 1;
        let numbered = (0..).zip(capsules);
        let capsules = numbered.map(|(i, (from, to, radius_m))| WireCapsule {
            link: i % links,
            from,
            to,
            radius_m,
        });
        RobotControl::Arm(WireArm {
            joints,
            tip,
            capsules: capsules.collect(),
        })
    })
}

pub(crate) fn code(sample_us: u32) -> PathCode {
    PathCode::new(PathBounds::new(0.02, None), sample_us).expect("a grid")
}

/// A path: knots as an encoder makes them, some of them wild, all after the epoch.
pub(crate) fn knots(most: usize) -> impl Strategy<Value = Vec<PoseKnot>> {
    let small = prop::array::uniform6(-40..40i32);
    let any = prop::array::uniform6(-(1i32 << 30)..=1i32 << 30);
    let dt = prop_oneof![
        6 => (1..30i64, -2..=2i64).prop_map(|(n, off)| (10_000 * n) / 3 + off),
        2 => 1..200_000i64,
        1 => 1i64..1i64 << 31,
    ];
    let one = (
        dt,
        prop_oneof![9 => small, 1 => any],
        prop::bool::weighted(0.1),
    );
    vec(one, 0..=most).prop_map(|steps| {
        let (mut knots, mut tick, mut x) = (Vec::<PathKnot>::new(), 0, [0; 3]);
        for (dt, [a, b, c, p, q, r], start) in steps {
            tick += dt;
            let limit = 1 << 30;
            let add = |x: i32, by: i32| (x + by).clamp(-limit, limit);
            x = [add(x[0], a), add(x[1], b), add(x[2], c)];
            let start = start || knots.is_empty();
            let shift = if start {
                1
            } else {
                PathGrid::<3>::slope_shift(dt)
            };
            let v = [p, q, r].map(|v| v >> shift << shift);
            knots.push(PathKnot { tick, x, v, start });
        }
        knots.into_iter().map(PoseKnot::from).collect()
    })
}

/// Blocks that decode, and any bytes.
pub(crate) fn block() -> impl Strategy<Value = KnotBlock> {
    let real = (state(), knots(MAX_KNOTS)).prop_map(|(state, knots)| {
        let mut state = WireState { t_us: 0, ..state };
        state.t_us = knots.first().map_or(0, |k| k.tick * 10);
        KnotBlock::pack(&state, code(33_333), &[], &knots).expect("a path can travel")
    });
    let fits = |b: &KnotBlock| b.0.len() <= 600 && b.count(MAX_KNOTS).is_ok();
    let any = vec(any::<u8>(), 0..40).prop_map(KnotBlock);
    prop_oneof![
        real.prop_filter("short", fits),
        any.prop_filter("a count", fits)
    ]
}

pub(crate) fn motion() -> impl Strategy<Value = Motion> {
    (
        any::<[u32; 4]>(),
        (any::<u8>(), any::<u16>()),
        params(),
        option::of(any::<u32>()),
        (state(), pose()),
        block(),
    )
        .prop_map(
            |(
                [epoch, engagement, seq, first_knot],
                (lease, model),
                params,
                checksum,
                (state, pose),
                knots,
            )| {
                Motion {
                    epoch,
                    engagement,
                    seq,
                    lease_ms: 10 * u16::from(lease),
                    model,
                    params,
                    checksum,
                    state,
                    pose,
                    first_knot: if knots.is_empty() { 0 } else { first_knot },
                    knots,
                }
            },
        )
}

pub(crate) fn bend() -> impl Strategy<Value = WireBend> {
    let crossed = || -64..=64i8;
    let weight = (
        [0..=127i8, 0..=127i8, 0..=127i8],
        [crossed(), crossed(), crossed()],
    )
        .prop_map(|([xx, yy, zz], [yx, zx, zy])| [xx, yx, yy, zx, zy, zz]);
    let held = (state(), any::<[u8; 2]>(), weight).prop_map(|(state, [gain, straight], weight)| {
        WireHeld {
            state,
            gain,
            straight,
            weight,
        }
    });
    let place = || -1_000_000..=1_000_000i32;
    let most = i64::MAX / 1000;
    (
        -most..=most,
        0..=192u8,
        [place(), place(), place()],
        option::of(held),
    )
        .prop_map(|(plan_us, rate, left, held)| WireBend {
            plan_us,
            rate,
            left,
            held,
        })
}

pub(crate) fn operator_datagram() -> impl Strategy<Value = OperatorDatagram> {
    prop_oneof![
        motion().prop_map(OperatorDatagram::Motion),
        (
            any::<[u32; 3]>(),
            any::<i64>(),
            any::<u16>(),
            option::of(bend())
        )
            .prop_map(|([epoch, engagement, seq], t_us, lease_ms, bend)| {
                OperatorDatagram::Go {
                    epoch,
                    engagement,
                    seq,
                    t_us,
                    lease_ms,
                    bend,
                }
            }),
        (any::<u32>(), any::<[i64; 3]>()).prop_map(|(epoch, [t1_us, t2_us, t3_us])| {
            OperatorDatagram::Pong {
                epoch,
                t1_us,
                t2_us,
                t3_us,
            }
        }),
        any::<(u32, i64, u32)>().prop_map(|(epoch, ahead_us, dispersion_us)| {
            let clock = ExternalClock {
                ahead_us,
                dispersion_us,
            };
            OperatorDatagram::Clock { epoch, clock }
        }),
        any::<u32>().prop_map(|epoch| OperatorDatagram::Stop { epoch }),
    ]
}

pub(crate) fn robot_datagram() -> impl Strategy<Value = RobotDatagram> {
    let telemetry = (
        any::<[u32; 9]>(),
        any::<[u16; 2]>(),
        any::<i64>(),
        robot_state(),
        [finite(), finite(), finite()],
        (rotation(), option::of(any::<u8>())),
        vec(finite(), 0..=MAX_JOINTS),
    )
        .prop_map(
            |(n, [age_ms, delay_ms], t_us, state, tip_m, (tip_q, grip), q)| {
                RobotDatagram::Telemetry(Telemetry {
                    epoch: n[0],
                    seq: n[1],
                    state,
                    engagement: n[2],
                    t_us,
                    clock_uncertainty_us: n[3],
                    age_ms,
                    delay_ms,
                    path_frontier: n[4],
                    received: n[5],
                    newest_seq: n[6],
                    dropped: n[7],
                    clamps: n[8],
                    tip_m,
                    tip_q,
                    grip,
                    q,
                })
            },
        );
    prop_oneof![
        (any::<u32>(), any::<i64>())
            .prop_map(|(epoch, t1_us)| RobotDatagram::Ping { epoch, t1_us }),
        telemetry,
        (any::<[u32; 8]>(), any::<[u32; 4]>(), any::<[u32; 4]>()).prop_map(
            |(n, delay_us, age_us)| {
                RobotDatagram::Reception(Reception {
                    epoch: n[0],
                    newest_seq: n[1],
                    received: n[2],
                    duplicates: n[3],
                    reordered: n[4],
                    loss_runs: n[5],
                    longest_loss_run: n[6],
                    jitter_us: n[7],
                    delay_us,
                    age_us,
                })
            }
        ),
        (
            any::<[u32; 3]>(),
            any::<u64>(),
            any::<[u32; 4]>(),
            any::<[u32; 4]>()
        )
            .prop_map(|([epoch, overruns, mean_ns], ticks, work_ns, wake_ns)| {
                RobotDatagram::Servo(ServoTimes {
                    epoch,
                    ticks,
                    overruns,
                    mean_ns,
                    work_ns,
                    wake_ns,
                })
            }),
    ]
}

/// Damage to an encoding: cut, prolonged, or bytes changed.
#[derive(Debug, Clone)]
pub(crate) struct Damage {
    keep: prop::sample::Index,
    tail: Vec<u8>,
    changes: Vec<(prop::sample::Index, u8)>,
}

pub(crate) fn damage() -> impl Strategy<Value = Damage> {
    let change = (any::<prop::sample::Index>(), any::<u8>());
    (
        any::<prop::sample::Index>(),
        vec(any::<u8>(), 0..4),
        vec(change, 0..4),
    )
        .prop_map(|(keep, tail, changes)| Damage {
            keep,
            tail,
            changes,
        })
}

impl Damage {
    pub(crate) fn to(&self, bytes: &[u8]) -> Vec<u8> {
        let mut bytes = bytes.to_vec();
        // Half of the time nothing is cut.
        let keep = self.keep.index(2 * bytes.len() + 1).min(bytes.len());
        bytes.truncate(keep);
        bytes.extend(&self.tail);
        for (at, to) in &self.changes {
            if !bytes.is_empty() {
                let at = at.index(bytes.len());
                bytes[at] = *to;
            }
        }
        bytes
    }
}
