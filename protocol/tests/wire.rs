//! The wire, from outside: whatever is sent comes back, and whatever arrives does no harm.

use core::fmt::Debug;

use nalgebra::Vector3;
use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;
use telemime_protocol::checkpoint::path::{
    MAX_TURN_URAD, PathBounds, PathGrid, PathKnot, PoseKnot,
};
use telemime_protocol::predict::{HandState, Params};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::DecodeError;
use telemime_protocol::wire::arm::{WireArm, WireCapsule, WireJoint, WireJointKind, WirePlace};
use telemime_protocol::wire::bend::{WireBend, WireHeld};
use telemime_protocol::wire::hello::{Answer, Hello, RejectCode};
use telemime_protocol::wire::knots::{KnotBlock, PathCode};
use telemime_protocol::wire::memory::WireMemory;
use telemime_protocol::wire::state::{MAX_POSITION_M, POSITION_STEP_M, WireState};
use telemime_protocol::wire::turn::{WirePose, WireRotation, WireTurn};
use telemime_protocol::wire::v1::*;

fn finite() -> impl Strategy<Value = f32> {
    any::<f32>().prop_filter("finite", |v| v.is_finite())
}

fn positive() -> impl Strategy<Value = f32> {
    any::<f32>().prop_filter("positive", |v| v.is_finite() && *v > 0.0)
}

fn state() -> impl Strategy<Value = WireState> {
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
fn memory(exponents: BoxedStrategy<u8>) -> impl Strategy<Value = WireMemory> {
    let exponents = [exponents.clone(), exponents];
    (exponents, any::<[[i8; 3]; 4]>())
        .prop_map(|(exponents, offsets)| WireMemory { exponents, offsets })
}

fn params() -> impl Strategy<Value = WireParams> {
    let weights = prop::array::uniform3(prop::array::uniform3(0..=5_u8));
    (any::<u8>(), any::<u8>(), weights).prop_map(|(gain, inflation, weights)| WireParams {
        gain,
        inflation,
        weights,
    })
}

fn rotation() -> impl Strategy<Value = WireRotation> {
    [
        -31_416..=31_416_i16,
        -31_416..=31_416_i16,
        -31_416..=31_416_i16,
    ]
    .prop_map(WireRotation)
}

fn pose() -> impl Strategy<Value = WirePose> {
    let exponents = (0..=10u8, 0..=10u8).prop_map(|(a, b)| a << 4 | b);
    let turn = (rotation(), memory(exponents.boxed()), params())
        .prop_map(|(q, memory, params)| WireTurn { q, memory, params });
    (option::of(turn), option::of(any::<u8>())).prop_map(|(turn, grip)| WirePose { turn, grip })
}

fn unit() -> impl Strategy<Value = [f32; 4]> {
    let quaternion = [-1.0..1.0f32, -1.0..1.0f32, -1.0..1.0f32, 0.1..1.0f32];
    quaternion.prop_map(|q| {
        let norm = q.iter().map(|v| v * v).sum::<f32>().sqrt();
        q.map(|v| v / norm)
    })
}

fn engage() -> impl Strategy<Value = Engage> {
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

fn operator_control() -> impl Strategy<Value = OperatorControl> {
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

fn robot_state() -> impl Strategy<Value = RobotState> {
    prop::sample::select(vec![
        RobotState::Idle,
        RobotState::Ready,
        RobotState::Engaged,
        RobotState::Coasting,
        RobotState::Holding,
        RobotState::Stopped,
    ])
}

fn cause() -> impl Strategy<Value = Cause> {
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

fn refusal() -> impl Strategy<Value = Refusal> {
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

fn robot_control() -> impl Strategy<Value = RobotControl> {
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

fn arm() -> impl Strategy<Value = RobotControl> {
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

fn code(sample_us: u32) -> PathCode {
    PathCode::new(PathBounds::new(0.02, None), sample_us).expect("a grid")
}

/// A path: knots as an encoder makes them, some of them wild, all after the epoch.
fn knots(most: usize) -> impl Strategy<Value = Vec<PoseKnot>> {
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
fn block() -> impl Strategy<Value = KnotBlock> {
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

fn motion() -> impl Strategy<Value = Motion> {
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

fn bend() -> impl Strategy<Value = WireBend> {
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

fn operator_datagram() -> impl Strategy<Value = OperatorDatagram> {
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

fn robot_datagram() -> impl Strategy<Value = RobotDatagram> {
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
struct Damage {
    keep: prop::sample::Index,
    tail: Vec<u8>,
    changes: Vec<(prop::sample::Index, u8)>,
}

fn damage() -> impl Strategy<Value = Damage> {
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
    fn to(&self, bytes: &[u8]) -> Vec<u8> {
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

/// A message comes back; what was made of it decodes to nothing else than what it says.
fn travels<M: Message + PartialEq + Debug>(
    message: &M,
    damage: &Damage,
) -> Result<(), TestCaseError> {
    let bytes = message.encode();
    let back = M::decode(&bytes);
    prop_assert_eq!(back.as_ref(), Ok(message));
    honest::<M>(&damage.to(&bytes))
}

fn honest<M: Message>(bytes: &[u8]) -> Result<(), TestCaseError> {
    if let Ok(message) = M::decode(bytes) {
        prop_assert_eq!(message.encode(), bytes);
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 512, ..ProptestConfig::default() })]

    #[test]
    fn operator_control_travels(message in operator_control(), damage in damage()) {
        travels(&message, &damage)?;
    }

    #[test]
    fn robot_control_travels(message in robot_control(), damage in damage()) {
        travels(&message, &damage)?;
    }

    #[test]
    fn operator_datagrams_travel(message in operator_datagram(), damage in damage()) {
        travels(&message, &damage)?;
        prop_assert!(message.encode().len() <= MAX_DATAGRAM_LEN);
    }

    #[test]
    fn robot_datagrams_travel(message in robot_datagram(), damage in damage()) {
        travels(&message, &damage)?;
        prop_assert!(message.encode().len() <= MAX_DATAGRAM_LEN);
    }

    #[test]
    fn arbitrary_bytes_are_honest(bytes in vec(any::<u8>(), 0..300), kind in 0..8u8) {
        let mut typed = bytes.clone();
        if let Some(first) = typed.first_mut() {
            *first = kind;
        }
        for bytes in [&bytes, &typed] {
            honest::<OperatorControl>(bytes)?;
            honest::<RobotControl>(bytes)?;
            honest::<OperatorDatagram>(bytes)?;
            honest::<RobotDatagram>(bytes)?;
        }
    }

    #[test]
    fn greetings_travel_and_damaged_ones_are_honest(
        (a, b, features) in any::<(u16, u16, u64)>(),
        (code, text) in (any::<u16>(), "[a-z é]{0,120}"),
        damage in damage(),
    ) {
        let hello = Hello { min: a.min(b), max: a.max(b), features };
        let bytes = hello.encode();
        prop_assert_eq!(Hello::decode(&bytes), Ok(Some((hello, bytes.len()))));
        let damaged = damage.to(&bytes);
        if let Ok(Some((hello, used))) = Hello::decode(&damaged) {
            prop_assert_eq!(hello.encode(), &damaged[..used]);
        }
        let code = match code { 1 => RejectCode::Version, 2 => RejectCode::Busy, 3 => RejectCode::Malformed, n => RejectCode::Other(n) };
        for answer in [Answer::Ack { version: a, features, epoch: u32::from(b) }, Answer::Reject { code, text }] {
            let bytes = answer.encode();
            prop_assert_eq!(Answer::decode(&bytes), Ok(Some((answer, bytes.len()))));
            let damaged = damage.to(&bytes);
            if let Ok(Some((answer, used))) = Answer::decode(&damaged) {
                prop_assert_eq!(answer.encode(), &damaged[..used]);
            }
        }
    }

    /// Position to 0.05 mm, time to 5 µs, each memory to half of its own step: 1/127 of its largest
    /// coordinate, or 12.5 µm if that is more, however far the others are.
    #[test]
    fn a_state_travels_within_its_steps(
        t_ns in -1_000_000_000_000_000i64..1_000_000_000_000_000,
        x in prop::array::uniform3(-100.0..=100.0f64),
        offsets in prop::array::uniform4(prop::array::uniform3(-1.0..1.0f64)),
        reaches_m in prop::array::uniform4(prop_oneof![Just(0.0), 1e-6..1e-3f64, 1e-3..10.0f64, 10.0..104.0f64]),
    ) {
        let x = Vector3::from(x);
        let offsets: [_; 4] = std::array::from_fn(|i| Vector3::from(offsets[i]) * reaches_m[i]);
        let sent = HandState { t: Stamp(t_ns), x, memory: offsets.map(|o| x - o) };
        let wire = WireState::quantise(&sent).expect("within range");
        let back = wire.dequantise();
        prop_assert!((back.t.0 - t_ns).abs() <= 5000);
        prop_assert!((back.x - x).amax() <= 0.5 * POSITION_STEP_M + 1e-12);
        for (memory, offset) in back.memory.iter().zip(&offsets) {
            let bound_m = (offset.amax() / 127.0).max(1.25e-5) + 1e-9;
            let error_m = (back.x - memory - offset).amax();
            prop_assert!(error_m <= bound_m, "{error_m} m of {bound_m} m");
        }
        // Both ends predict from the same numbers: once rounded, always the same.
        let again = WireState::quantise(&back).expect("still within range").dequantise();
        prop_assert_eq!((again.t, again.x), (back.t, back.x));
    }

    #[test]
    fn parameters_travel_to_the_nearest_step(
        gain in 0.0..=1.0f64,
        octaves in -16.0..=15.8f64,
        shares in prop::array::uniform3(prop::array::uniform4(1e-3..=1.0f64)),
    ) {
        let weights = shares.map(|[a, b, c, d]| [a, b, c].map(|v| v / (a + b + c + d)));
        let sent = Params { gain, inflation: octaves.exp2(), weights };
        prop_assert!(sent.checked().is_ok());
        let wire = WireParams::quantise(&sent);
        let back = wire.dequantise();
        prop_assert!(back.checked().is_ok());
        prop_assert!((sent.gain - back.gain).abs() <= 0.5 / 255.0 + 1e-12);
        prop_assert!((sent.inflation / back.inflation).log2().abs() <= 1.0 / 16.0 + 1e-9);
        for (a, b) in sent.weights.iter().flatten().zip(back.weights.iter().flatten()) {
            // Together they are what holding leaves, which is rounded first.
            prop_assert!((a - b).abs() <= 1.5 / 15.0 + 1e-12);
        }
        let held = |p: &Params| p.weights.map(|band| 1.0 - band.iter().sum::<f64>());
        for (a, b) in held(&sent).into_iter().zip(held(&back)) {
            prop_assert!((a - b).abs() <= 0.5 / 15.0 + 1e-12);
        }
        prop_assert_eq!(WireParams::quantise(&back), wire);
    }
}

#[test]
fn weights_of_more_than_all_are_refused() {
    let heavy = |weights| {
        let state = HandState::first(Stamp(0), Vector3::zeros());
        OperatorDatagram::Motion(Motion {
            epoch: 1,
            engagement: 1,
            seq: 1,
            lease_ms: 10,
            model: 0,
            params: WireParams {
                weights,
                ..WireParams::quantise(&Params::DEFAULT)
            },
            checksum: None,
            state: WireState::quantise(&state).expect("within range"),
            pose: WirePose::default(),
            first_knot: 0,
            knots: KnotBlock::default(),
        })
        .encode()
    };
    let all = [[0, 0, 15], [5, 5, 5], [14, 1, 0]];
    assert!(OperatorDatagram::decode(&heavy(all)).is_ok());
    for band in 0..3 {
        let mut more = all;
        more[band][1] += 1;
        assert!(matches!(
            OperatorDatagram::decode(&heavy(more)),
            Err(DecodeError::Invalid {
                field: "motion.params",
                ..
            })
        ));
    }
}

#[test]
fn counts_beyond_their_limits_are_refused() {
    let knot = |n: i64| {
        PoseKnot::from(PathKnot {
            tick: 3_333 * (n - 2_000),
            x: [1; 3],
            v: [0; 3],
            start: n == 0,
        })
    };
    let block = |knots: usize| {
        let knots: Vec<_> = (0..knots as i64).map(knot).collect();
        let state = WireState::quantise(&HandState::first(Stamp(0), Vector3::zeros()));
        let state = state.expect("within range");
        KnotBlock::pack(&state, code(33_333), &[], &knots).expect("a path can travel")
    };
    let motion = |knots: usize| {
        let state = HandState::first(Stamp(0), Vector3::zeros());
        OperatorDatagram::Motion(Motion {
            epoch: 1,
            engagement: 1,
            seq: 1,
            lease_ms: 10,
            model: 0,
            params: WireParams::quantise(&Params::DEFAULT),
            checksum: None,
            state: WireState::quantise(&state).expect("within range"),
            pose: WirePose::default(),
            first_knot: 0,
            knots: block(knots),
        })
    };
    let decoded = |knots| OperatorDatagram::decode(&motion(knots).encode());
    assert_eq!(decoded(MAX_KNOTS), Ok(motion(MAX_KNOTS)));
    assert!(matches!(
        decoded(MAX_KNOTS + 1),
        Err(DecodeError::Invalid {
            field: "motion.knots",
            ..
        })
    ));
    let tail = |knots| {
        OperatorControl::Path(PathTail {
            engagement: 1,
            state: WireState::quantise(&HandState::first(Stamp(0), Vector3::zeros()))
                .expect("within range"),
            first_knot: 0,
            knots: block(knots),
        })
    };
    let decoded = |knots| OperatorControl::decode(&tail(knots).encode());
    assert_eq!(decoded(MAX_TAIL_KNOTS), Ok(tail(MAX_TAIL_KNOTS)));
    assert!(matches!(
        decoded(MAX_TAIL_KNOTS + 1),
        Err(DecodeError::Invalid {
            field: "path.knots",
            ..
        })
    ));
    let model = |len: usize| OperatorControl::Model {
        id: [0; 16],
        bytes: vec![0; len],
    };
    let decoded = |len| OperatorControl::decode(&model(len).encode());
    assert!(decoded(MAX_MODEL_LEN).is_ok() && decoded(MAX_MODEL_LEN + 1).is_err());
}

#[test]
fn a_state_that_no_integers_hold_is_not_sent() {
    let at = |x: f64, m: f64| {
        let mut state = HandState::first(Stamp(0), Vector3::new(x, 0.0, 0.0));
        state.memory[3] = Vector3::new(0.0, m, 0.0);
        WireState::quantise(&state)
    };
    assert!(at(100.0, 4.0).is_some() && at(-100.0, 104.0).is_some());
    for (x, m) in [
        (100.1, 0.0),
        (f64::NAN, 0.0),
        (f64::INFINITY, 0.0),
        (0.0, 104.1),
        (0.0, 1e300),
        (0.0, f64::INFINITY),
    ] {
        assert_eq!(at(x, m), None, "{x} {m}");
    }
}
