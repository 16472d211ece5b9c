//! What decoded messages mean: states, orientations, forecasts without a skill, paths and plans.

use nalgebra::{SVector, UnitQuaternion, Vector3};
use serde_json::{Value, json};
use telemime_protocol::checkpoint::path::{PathDecoder, pose as on_path};
use telemime_protocol::checkpoint::{Checkpoint, Grid, Plan, PosePlan};
use telemime_protocol::pose;
use telemime_protocol::predict::{Forecast, TurnForecast, TurnState, checksum};
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::codec;
use telemime_protocol::wire::knots::KnotBlock;
use telemime_protocol::wire::memory::WireMemory;
use telemime_protocol::wire::pair::{AbortCode, Name, PairMessage, commitment};
use telemime_protocol::wire::state::WireState;
use telemime_protocol::wire::turn::WireTurn;
use telemime_protocol::wire::v1::*;

use super::Vector;
use super::draw::Draw;
use super::messages::{BOUND_UM, SAMPLE_US, code, path_knots};

fn v3(v: &Vector3<f64>) -> Value {
    json!([v.x, v.y, v.z])
}

fn q4(q: &UnitQuaternion<f64>) -> Value {
    // Of q and −q, the one with w ≥ 0.
    let s = if q.w < 0.0 { -1.0 } else { 1.0 };
    json!([s * q.w, s * q.i, s * q.j, s * q.k])
}

/// A motion's forecast by `skill`, or by constant velocity: what follows from the datagram's bytes alone.
pub(crate) fn foretold(motion: &Motion, skill: Option<&Skill>) -> Value {
    let (state, params) = (motion.state.dequantise(), motion.params.dequantise());
    let place = match skill {
        Some(skill) => skill.predictor().forecast(&state, &params),
        None => Forecast::constant_velocity(&state, &params),
    };
    let turn: Option<TurnForecast> = motion.pose.turn.map(|t| t.forecast(state.t, skill));
    let at = |h: f64| {
        let (p, q) = (place.at(h), turn.as_ref().map(|t| t.at(h)));
        json!({
            "h_s": h,
            "x": v3(&p.position),
            "sigma_m": p.sigma_m,
            "q": q.map(|q| q4(&q.orientation)),
            "sigma_rad": q.map(|q| q.sigma_rad),
        })
    };
    let ahead = [-1.0, 0.0, 0.015, 0.1, 0.2499, 0.4, 3.0].map(at);
    json!({"ahead": ahead, "checksum": checksum(&place, turn.as_ref())})
}

/// A motion as an operator would send it while its hand passes through the skills' space.
pub(crate) fn moving(i: u32) -> Motion {
    let s = f64::from(i);
    let mut state = WireState {
        t_us: 3_000_000 + i64::from(i) * 33_330,
        x: [(1000.0 * s) as i32 - 3000, 500 - 200 * i as i32, 8000],
        memory: WireMemory {
            exponents: [
                ((4 + i % 8) << 4 | (5 + i % 8)) as u8,
                ((6 + i % 8) << 4 | (3 + i % 8)) as u8,
            ],
            offsets: [[10, -4, 0], [24, -9, 1], [50, -20, 2], [80, -30, 5]],
        },
    };
    if i == 0 {
        state.memory = WireMemory::default();
    }
    let params = Draw::new(100 + u64::from(i)).params();
    let turn = WireTurn {
        q: telemime_protocol::wire::turn::WireRotation([
            4000 + 2000 * i as i16,
            -2500,
            300 * i as i16,
        ]),
        memory: WireMemory {
            exponents: [
                ((2 + i % 8) << 4 | (1 + i % 8)) as u8,
                ((3 + i % 8) << 4 | (2 + i % 8)) as u8,
            ],
            offsets: [[20, -10, 0], [40, -20, 3], [70, -30, 5], [90, -40, 8]],
        },
        params: Draw::new(200 + u64::from(i)).params(),
    };
    Motion {
        epoch: 7,
        engagement: 1,
        seq: i + 1,
        lease_ms: 650,
        model: 0,
        params,
        checksum: None,
        state,
        pose: telemime_protocol::wire::turn::WirePose {
            turn: (i % 2 == 1).then_some(turn),
            grip: None,
        },
        first_knot: 0,
        knots: KnotBlock::default(),
    }
}

fn states(all: &mut Vec<Vector>) {
    let draw = &mut Draw::new(2);
    for i in 0..12 {
        let wire = match i {
            0 => moving(0).state,
            1..6 => moving(i).state,
            _ => WireState {
                t_us: draw.signed(40),
                ..draw.state()
            },
        };
        let state = wire.dequantise();
        let mut next = state;
        let (dt_us, x) = (
            [33_333, 1000, 1, 2_000_000][i as usize % 4],
            [0.41, -0.2, 2.5],
        );
        assert!(next.advance(Stamp(state.t.0 + dt_us * 1000), Vector3::from(x)));
        let value = json!({
            "t_us": wire.t_us,
            "x": v3(&state.x),
            "m": state.memory.each_ref().map(v3),
            "next": {"after_us": dt_us, "x": x, "m": next.memory.each_ref().map(v3)},
        });
        all.push(says("state", i, codec::encode(&wire), value));
    }
}

fn turns(all: &mut Vec<Vector>) {
    let draw = &mut Draw::new(3);
    for i in 0..12_u32 {
        let wire = match i {
            0..6 => moving(2 * i + 1).pose.turn.expect("odd ones turn"),
            _ => loop {
                if let Some(turn) = draw.pose().turn {
                    break turn;
                }
            },
        };
        let state: TurnState = wire.dequantise(Stamp(0));
        let mut next = state;
        let (dt_us, to) = (
            [33_333, 1000, 2_000_000][i as usize % 3],
            [0.45, -0.3, 0.05],
        );
        assert!(next.advance(Stamp(dt_us * 1000), pose::exp(&Vector3::from(to))));
        let value = json!({
            "q": q4(&state.q),
            "m": state.memory.each_ref().map(q4),
            "next": {"after_us": dt_us, "rotation_vector": to, "m": next.memory.each_ref().map(q4)},
        });
        all.push(says("turn", i, codec::encode(&wire), value));
    }
}

fn bends(all: &mut Vec<Vector>) {
    let draw = &mut Draw::new(5);
    for i in 0..8 {
        let mut wire = draw.bend();
        if let Some(held) = &mut wire.held {
            held.state = moving(i).state;
        }
        let bend = wire.dequantise();
        let at = [(-0.1, 0.0), (0.0, 0.05), (0.2, 0.21), (0.9, 2.0)].map(|(h, k)| {
            json!({"h_s": h, "k_s": k, "plan_s": bend.plan_at(h), "offset_m": v3(&bend.offset_at(h, k))})
        });
        all.push(says("bend", i, codec::encode(&wire), json!({ "at": at })));
    }
}

/// Every message of pairing.
fn pairing(all: &mut Vec<Vector>) {
    let name = |text| Name::new(text).expect("a name");
    let (operators, robots) = ([0x11; 32], [0x22; 32]);
    let hexed = super::hex;
    let commitment = commitment(&robots);
    for (title, message, value) in [
        (
            "offer",
            PairMessage::Offer(name("laptop")),
            json!({"Offer": {"name": "laptop"}}),
        ),
        (
            "commit",
            PairMessage::Commit(commitment, name("arm-2.left_side")),
            json!({"Commit": {"commitment": hexed(&commitment), "name": "arm-2.left_side"}}),
        ),
        (
            "nonce",
            PairMessage::Nonce(operators),
            json!({"Nonce": {"nonce": hexed(&operators)}}),
        ),
        (
            "reveal",
            PairMessage::Reveal(robots),
            json!({"Reveal": {"nonce": hexed(&robots)}}),
        ),
        ("confirm", PairMessage::Confirm, json!("Confirm")),
        ("stored", PairMessage::Stored, json!("Stored")),
        (
            "abort",
            PairMessage::Abort(AbortCode::Other(900), "für später".to_owned()),
            json!({"Abort": {"code": 900, "text": "für später"}}),
        ),
    ] {
        let bytes = message.encode();
        assert_eq!(
            PairMessage::decode(&bytes),
            Ok(Some((message, bytes.len())))
        );
        all.push(says("pairing", title, bytes, value));
    }
}

fn paths(all: &mut Vec<Vector>) {
    let draw = &mut Draw::new(4);
    let places = [(0, 1), (0, 2), (1, 1), (3, 5), (8, 32), (20, 100)].map(|n| (0, n));
    let poses = [(0, 1), (2, 3), (9, 20)].map(|n| (50_000, n));
    for (i, (turn_urad, (before, n))) in places.into_iter().chain(poses).enumerate() {
        let code = code(turn_urad);
        let state = moving(i as u32).state;
        let all_knots = path_knots(draw, &state, before + n, code);
        let carried = if code.turns() { 7 } else { 3 };
        let (held, sent) = all_knots.split_at(before);
        let tail = PathTail {
            engagement: 1,
            state,
            first_knot: before as u32,
            knots: KnotBlock::pack(&state, code, held, sent).expect("a path before the state"),
        };
        let unpacked = tail.knots.unpack(&state, code, held, MAX_TAIL_KNOTS);
        assert_eq!(unpacked.as_deref(), Ok(sent));
        let mut path = PathDecoder::new(code.grid(), before + n);
        let told: Vec<_> = all_knots
            .iter()
            .map(|k| {
                path.append(k).expect("a path in order");
                json!([k.tick, k.x[..carried], k.v[..carried], k.start])
            })
            .collect();
        let mut at = Vec::new();
        for w in all_knots.windows(2).filter(|w| !w[1].start) {
            let t = Stamp((w[0].tick * 3 + w[1].tick) * 10_000 / 4);
            let jet = path.eval(t).expect("between joined knots");
            at.push(json!({
                "t_ns": t.0,
                "x": v3(&on_path::place(&jet.x)),
                "v": v3(&on_path::place(&jet.v)),
                "q": on_path::turn(&jet.x).map(|q| q4(&q)),
            }));
        }
        let value = json!({
            "path_bound_um": BOUND_UM, "path_turn_bound_urad": turn_urad, "sample_us": SAMPLE_US, "before": before, "knots": told, "at": at,
        });
        all.push(says("path", i, OperatorControl::Path(tail).encode(), value));
    }
}

fn points<const D: usize>(plan: &Plan<D>) -> Value {
    let grid = plan.grid();
    let points: Vec<_> = plan
        .checkpoints()
        .map(|c| {
            let x = c.x.map(|v| (v / grid.step_m()).round() as i64);
            json!([(c.t_s / grid.tick_s()).round() as u64, x.as_slice()])
        })
        .collect();
    json!({"step_nm": grid.step_nm(), "tick_us": grid.tick_us(), "points": points})
}

pub(crate) fn plan<const D: usize>(grid: Grid, n: usize, at: impl Fn(f64) -> [f64; D]) -> Plan<D> {
    let point = |i: usize| {
        // Uneven, and the first at 0.
        let t_s = 0.1 * i as f64 + 0.03 * f64::from((i % 3) as u8);
        Checkpoint {
            t_s,
            x: SVector::from(at(t_s)),
        }
    };
    let points: Vec<_> = (0..n).map(point).collect();
    Plan::quantise(grid, &points).expect("a plan in range")
}

fn plans(all: &mut Vec<Vector>) {
    let place = |t: f64| [0.3 * libm::sin(2.0 * t), 0.2 * libm::cos(3.0 * t), 0.1 * t];
    let turning = |t: f64| {
        let q = pose::exp(&Vector3::new(0.4 * t, -0.2, 0.3 * libm::sin(t)));
        [q.w, q.i, q.j, q.k]
    };
    let opening = |t: f64| [0.5 + 0.5 * libm::sin(t)];
    let coarse = Grid::new(1_000_000, 1000).expect("a grid");
    let fine = Grid::new(12_345, 333).expect("a grid");
    let unit = Grid::new(1_000_000, 1000).expect("a grid");
    let jumps = |t: f64| {
        [
            if (t * 10.0) as i64 % 2 == 0 {
                1.0
            } else {
                -1.0
            },
            0.0,
            t * t,
        ]
    };
    for (name, position, posed) in [
        ("two points", plan(coarse, 2, place), false),
        ("a wave", plan(coarse, 12, place), false),
        ("a wave, finely", plan(fine, 40, place), false),
        ("to and fro", plan(coarse, 20, jumps), false),
        ("posed", plan(coarse, 15, place), true),
    ] {
        let (orientation, grip) = match posed {
            true => (Some(plan(unit, 10, turning)), Some(plan(unit, 6, opening))),
            false => (None, None),
        };
        let pose_plan = PosePlan::new(position, orientation, grip).expect("a motion");
        let curve = pose_plan.curve().expect("a curve");
        let at: Vec<_> = [0.0, 0.05, 0.1, 0.123, 0.4, 0.77, 5.0]
            .into_iter()
            .map(|t: f64| {
                let inside = t <= curve.end_s();
                let jet = inside.then(|| curve.position.eval(t).expect("within the plan"));
                json!({
                    "t_s": t,
                    "x": v3(&curve.position_at(t)),
                    "v": jet.map(|j| v3(&j.v)),
                    "a": jet.map(|j| v3(&j.a)),
                    "q": curve.orientation_at(t).map(|q| q4(&q)),
                    "grip": curve.grip_at(t),
                })
            })
            .collect();
        let value = json!({
            "position": points(pose_plan.position()),
            "turn": pose_plan.orientation().map(points),
            "grip": pose_plan.grip().map(points),
            "at": at,
        });
        let bytes = codec::encode(&pose_plan);
        assert_eq!(
            codec::decode::<PosePlan, MAX_PLAN_LEN>(&bytes),
            Ok(pose_plan)
        );
        all.push(says("plan", name, bytes, value));
    }
}

pub(crate) fn says(
    kind: &'static str,
    name: impl ToString,
    bytes: Vec<u8>,
    value: Value,
) -> Vector {
    Vector {
        kind,
        name: name.to_string(),
        bytes,
        means: Ok(value),
    }
}

pub(crate) fn meanings() -> Vec<Vector> {
    let mut all = Vec::new();
    states(&mut all);
    turns(&mut all);
    for i in 0..8 {
        let motion = moving(i);
        let value = foretold(&motion, None);
        let bytes = OperatorDatagram::Motion(motion).encode();
        all.push(says("constant velocity", i, bytes, value));
    }
    bends(&mut all);
    pairing(&mut all);
    paths(&mut all);
    plans(&mut all);
    all
}
