use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};
use telemime_endpoint::Mono;
use telemime_protocol::checkpoint::path::{PathBounds, PathEncoder, PoseKnot, TICK_NS};
use telemime_protocol::checkpoint::select;
use telemime_protocol::predict::{HandState, Params};
use telemime_protocol::skill::{Skill, example};
use telemime_protocol::wire::knots::{KnotBlock, PathCode};
use telemime_protocol::wire::state::WireState;
use telemime_protocol::wire::turn::{WirePose, WireRotation};
use telemime_protocol::wire::v1::{Drive, Engage, Motion, ServoTimes, WireParams};
use telemime_sim::arm::Joints;

use super::*;
use crate::servo::thread::Times;
use crate::servo::{Engagement, Mapping, Quantiles, Source, Ticket};

mod control;
mod datagrams;
mod path;
mod posing;

const MS: i64 = 1_000_000;
const EPOCH: u32 = 41;

/// The session clock reads this much more than the robot's, ns.
const OFFSET: i64 = -7_000_000_000_000;

const STEADY: Params = Params::DEFAULT;

/// A session, the robot's clock, and what the session has said so far.
struct Bench {
    session: Session,
    now: Mono,
    control: Vec<RobotControl>,
    datagrams: Vec<RobotDatagram>,
    orders: Vec<Order>,
    brakes: Vec<Cause>,
    goodbyes: u32,
}

fn info() -> Info {
    Info {
        name: "bench".into(),
        joints: 7,
        speed_m_s: 1.7,
        accel_m_s2: 13.0,
        radius_m: 0.3,
        lag_s: 0.067,
        model: None,
        state: RobotState::Idle,
    }
}

fn report(state: RobotState) -> Report {
    let tip_m = Vector3::new(0.4, 0.0, 0.5);
    Report {
        tick: 0,
        at: Mono(0),
        state,
        cause: Cause::Requested,
        transitions: state as u32,
        engagement: Ticket::default(),
        engaged_at: Mono(0),
        declined: Ticket::default(),
        mapping: Mapping {
            scale: 0.1,
            rotation: UnitQuaternion::identity(),
            hand_m: Vector3::new(0.1, 0.2, 2.5),
            tip_m,
            hand_orientation: None,
            tip_orientation: UnitQuaternion::identity(),
        },
        moving: false,
        age_s: 0.0,
        target_m: tip_m,
        reference_m: tip_m,
        jerk_m_s3: 0.0,
        tip_m,
        orientation: UnitQuaternion::identity(),
        orientation_error_rad: 0.0,
        plan_s: None,
        opening: Some(1.0),
        q: Joints::zeros(),
        clamps: 0,
        fault: None,
    }
}

impl Bench {
    /// A session at its very beginning.
    fn fresh(skill: Option<Skill>) -> Self {
        let now = Mono(1_000_000 * MS);
        let mut bench = Self {
            session: Session::new(
                SessionConfig::default(),
                info(),
                EPOCH,
                skill.map(Arc::new),
                now,
            ),
            now,
            control: Vec::new(),
            datagrams: Vec::new(),
            orders: Vec::new(),
            brakes: Vec::new(),
            goodbyes: 0,
        };
        bench.drain();
        bench
    }

    /// A session whose clock is known and whose arm is ready; nothing said so far is kept.
    fn ready(skill: Option<Skill>) -> Self {
        let mut bench = Self::fresh(skill);
        for _ in 0..4 {
            bench.exchange(0, 100);
        }
        bench.reports(RobotState::Ready);
        bench.forget();
        bench
    }

    /// A session in mirror, engagement 1; the hand was at rest at `hand()` now.
    fn mirroring(skill: Option<Skill>) -> Self {
        let mut bench = Self::ready(skill);
        let engage = bench.mirror(1);
        bench.engage(&engage);
        bench.reports(RobotState::Engaged);
        bench.forget();
        bench
    }

    /// A ping sent now comes back after `rtt_ms`, answered half-way by a clock `step` ns off.
    fn exchange(&mut self, step: i64, rtt_ms: i64) {
        let t1 = self.now.0;
        self.pass(rtt_ms);
        let at = t1 + rtt_ms * MS / 2 + OFFSET + step;
        self.datagram(&OperatorDatagram::Pong {
            epoch: EPOCH,
            t1_us: t1 / 1000,
            t2_us: at / 1000,
            t3_us: at / 1000,
        });
    }

    fn pass(&mut self, ms: i64) {
        self.now = Mono(self.now.0 + ms * MS);
    }

    /// The session clock, `ms` before now.
    fn stamp(&self, ms_ago: i64) -> Stamp {
        Stamp(self.now.0 + OFFSET - ms_ago * MS)
    }

    fn drain(&mut self) {
        while let Some(output) = self.session.poll_output() {
            match output {
                Output::Control(bytes) => self.control.push(RobotControl::decode(&bytes).unwrap()),
                Output::Datagram(bytes) => {
                    self.datagrams.push(RobotDatagram::decode(&bytes).unwrap());
                }
                Output::Order(order) => self.orders.push(order),
                Output::Brake(cause) => self.brakes.push(cause),
                Output::Goodbye => self.goodbyes += 1,
            }
        }
    }

    fn forget(&mut self) {
        self.drain();
        self.control.clear();
        self.datagrams.clear();
        self.orders.clear();
        self.brakes.clear();
    }

    fn control(&mut self, message: &OperatorControl) {
        self.frame(message.encode(), false).unwrap();
    }

    fn frame(&mut self, payload: Vec<u8>, ignorable: bool) -> Result<(), DecodeError> {
        let frame = Frame { ignorable, payload };
        let result = self.session.handle_control(self.now, &frame);
        self.drain();
        result
    }

    fn datagram(&mut self, message: &OperatorDatagram) {
        self.bytes(&message.encode());
    }

    fn bytes(&mut self, bytes: &[u8]) {
        self.session.handle_datagram(self.now, bytes);
        self.drain();
    }

    /// A tick's report, in this state and of the engagement asked for last.
    fn reports(&mut self, state: RobotState) {
        let engaged = Report {
            engagement: self.session.ticket(),
            engaged_at: self.now,
            at: self.now,
            ..report(state)
        };
        self.report(&engaged);
    }

    fn report(&mut self, report: &Report) {
        let four = |at| Quantiles {
            p50_ns: at,
            p99_ns: at + 1,
            p999_ns: at + 2,
            max_ns: at + 3,
        };
        let times = Times {
            ticks: 60_000,
            mean_ns: 5_600,
            work: four(1),
            wake: four(5),
            overruns: 2,
        };
        self.session.handle_report(report, times);
        self.drain();
    }

    /// A request to mirror a hand at rest.
    fn mirror(&self, engagement: u32) -> Engage {
        Engage {
            engagement,
            t_us: self.stamp(0).0 / 1000,
            drive: Drive::Mirror {
                state: WireState::quantise(&HandState::first(self.stamp(0), hand())).unwrap(),
                model: 0,
                params: WireParams::quantise(&STEADY),
                pose: WirePose::default(),
            },
            scale: 0.1,
            rotation: [1.0, 0.0, 0.0, 0.0],
            path_bound_um: 20_000,
            path_turn_bound_urad: 0,
            sample_us: 33_333,
            lease_ms: 650,
        }
    }

    fn engage(&mut self, engage: &Engage) {
        self.control(&OperatorControl::Engage(engage.clone()));
    }

    /// The answer to `engage`, if it is refused.
    fn refusal(&mut self, engage: &Engage) -> Option<Refusal> {
        self.forget();
        self.engage(engage);
        let engaged = self.orders.iter().any(|o| matches!(o, Order::Engage(_)));
        let refused = self.refusals();
        assert_eq!(
            usize::from(engaged) + refused.len(),
            1,
            "one answer to one request"
        );
        refused.first().copied()
    }

    fn refusals(&self) -> Vec<Refusal> {
        let refused = |m: &RobotControl| match m {
            RobotControl::Refused { reason } => Some(*reason),
            _ => None,
        };
        self.control.iter().filter_map(refused).collect()
    }

    /// A motion of engagement 1 whose hand state is `ms_ago` old.
    fn motion(&self, seq: u32, ms_ago: i64) -> Motion {
        Motion {
            epoch: EPOCH,
            engagement: 1,
            seq,
            lease_ms: 650,
            model: 0,
            params: WireParams::quantise(&STEADY),
            checksum: None,
            state: WireState::quantise(&moving(self.stamp(ms_ago))).unwrap(),
            pose: WirePose::default(),
            first_knot: 0,
            knots: KnotBlock::default(),
        }
    }

    fn send(&mut self, motion: &Motion) {
        self.datagram(&OperatorDatagram::Motion(motion.clone()));
    }

    /// The leases of the tracks ordered so far, ms.
    fn leases_ms(&self) -> Vec<i64> {
        let lease = |o: &Order| match o {
            Order::Track { lease, .. } | Order::Extend { lease, .. } => {
                Some((lease.until.secs_since(lease.from) * 1e3).round() as i64)
            }
            _ => None,
        };
        self.orders.iter().filter_map(lease).collect()
    }

    fn dropped(&self) -> u32 {
        self.session.counters().dropped
    }
}

fn hand() -> Vector3<f64> {
    Vector3::new(0.1, 0.2, 2.5)
}

/// A hand at `t` that has moved steadily.
fn moving(t: Stamp) -> HandState {
    let v = Vector3::new(0.8, -0.4, 0.2);
    let mut state = HandState::first(Stamp(t.0 - 300 * MS), hand());
    for i in 1..=10 {
        let moment = Stamp(t.0 - 300 * MS + 30 * i * MS);
        assert!(state.advance(moment, hand() + v * (0.03 * i as f64)));
    }
    state
}
