use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};
use telemime_protocol::checkpoint::{PosePlan, select};
use telemime_protocol::skill::{Stats, example};
use telemime_protocol::wire::frame::Frame;
use telemime_protocol::wire::turn::WireRotation;
use telemime_protocol::wire::v1::{
    Cause, Drive, Engage, Message, ModelId, Motion, OperatorDatagram, Refusal, RobotControl,
    RobotDatagram, Telemetry,
};
use telemime_protocol::wire::{DecodeError, codec};

use super::*;

mod commands;
mod correcting;
mod gating;
mod mirroring;
mod path;
mod posing;
mod resting;
mod trusting;

const MS: i64 = 1_000_000;
const EPOCH: u32 = 17;

/// A session, its clock, and what came out of it.
struct Bench {
    session: Session,
    now: Stamp,
    control: Vec<OperatorControl>,
    datagrams: Vec<OperatorDatagram>,
    events: Vec<Event>,
}

pub(crate) fn info(model: Option<ModelId>) -> Info {
    Info {
        name: "bench".into(),
        joints: 7,
        speed_m_s: 1.7,
        accel_m_s2: 13.0,
        radius_m: 0.3,
        lag_s: 0.07,
        model,
        state: RobotState::Ready,
    }
}

/// A grant that moves nothing.
fn granted(engagement: u32) -> RobotControl {
    RobotControl::Engaged {
        engagement,
        t_us: 0,
        hand_m: [0.0; 3],
        tip_m: [0.0; 3],
        hand_q: None,
        tip_q: WireRotation::default(),
    }
}

fn telemetry(seq: u32, path_frontier: u32) -> Telemetry {
    Telemetry {
        epoch: EPOCH,
        seq,
        state: RobotState::Engaged,
        engagement: 1,
        clock_uncertainty_us: 50_000,
        age_ms: 100,
        delay_ms: 100,
        path_frontier,
        ..Telemetry::default()
    }
}

impl Bench {
    /// A session as the robot has granted it.
    fn fresh(config: SessionConfig, skill: Option<Skill>) -> Self {
        Self {
            session: Session::new(config, skill.map(Arc::new), EPOCH),
            now: Stamp(3_000 * MS),
            control: Vec::new(),
            datagrams: Vec::new(),
            events: Vec::new(),
        }
    }

    /// A session that is ready; nothing said so far is kept.
    fn ready(config: SessionConfig, skill: Option<Skill>) -> Self {
        let held = skill.as_ref().map(|s| s.id().0);
        let mut bench = Self::fresh(config, skill);
        bench.hears(&RobotControl::Info(info(held)));
        assert_eq!(bench.events, [Event::Ready]);
        bench.forget();
        bench
    }

    /// Engagement 1 is granted; the hand has rested at `home()` for a second and still does.
    fn engaged(config: SessionConfig, skill: Option<Skill>) -> Self {
        let mut bench = Self::ready(config, skill);
        for _ in 0..30 {
            bench.sample(home());
        }
        bench.grant();
        bench.forget();
        bench
    }

    /// Asks for engagement 1, which is granted.
    fn grant(&mut self) {
        self.session.engage(self.now);
        self.hears(&granted(1));
        self.hears(&RobotControl::State {
            state: RobotState::Engaged,
            cause: Cause::Requested,
            changes: 1,
        });
    }

    fn drain(&mut self) {
        while let Some(output) = self.session.poll_output() {
            match output {
                Output::Control(bytes) => {
                    self.control.push(OperatorControl::decode(&bytes).unwrap());
                }
                Output::Datagram { bytes, motion } => {
                    let datagram = OperatorDatagram::decode(&bytes).unwrap();
                    let moves = matches!(
                        datagram,
                        OperatorDatagram::Motion(_) | OperatorDatagram::Go { .. }
                    );
                    assert_eq!(motion, moves, "what carries motion is counted as such");
                    self.datagrams.push(datagram);
                }
            }
        }
        while let Some(event) = self.session.poll_event() {
            self.events.push(event);
        }
    }

    fn forget(&mut self) {
        self.drain();
        self.control.clear();
        self.datagrams.clear();
        self.events.clear();
    }

    fn hears(&mut self, message: &RobotControl) {
        self.frame(message.encode(), false).unwrap();
    }

    fn frame(&mut self, payload: Vec<u8>, ignorable: bool) -> Result<(), DecodeError> {
        let frame = Frame { ignorable, payload };
        let result = self.session.handle_control(self.now, &frame);
        self.drain();
        result
    }

    fn receives(&mut self, datagram: &RobotDatagram) {
        let now = self.now;
        self.session.handle_datagram(now, &datagram.encode());
        self.drain();
    }

    /// Lets 33 ms pass with everything that falls due, then takes a sample.
    fn sample(&mut self, x: Vector3<f64>) {
        self.turned(x, None);
    }

    /// The same of a hand that has an orientation; the sample.
    fn turned(&mut self, x: Vector3<f64>, orientation: Option<UnitQuaternion<f64>>) -> HandSample {
        self.idle(33);
        let sample = HandSample {
            orientation,
            ..HandSample::at(self.now, x)
        };
        self.session.handle_sample(self.now, sample);
        self.drain();
        sample
    }

    /// Lets time pass, and does what falls due when it does.
    fn idle(&mut self, ms: i64) {
        let end = Stamp(self.now.0 + ms * MS);
        while let Some((due, reason)) = self.session.poll_timeout() {
            assert!(!reason.is_empty());
            if due > end {
                break;
            }
            self.now = due.max(self.now);
            self.session.handle_timeout(self.now);
            self.drain();
        }
        self.now = end;
        self.drain();
    }

    fn motions(&self) -> Vec<Motion> {
        let motion = |d: &OperatorDatagram| match d {
            OperatorDatagram::Motion(motion) => Some(motion.clone()),
            _ => None,
        };
        self.datagrams.iter().filter_map(motion).collect()
    }
}

fn home() -> Vector3<f64> {
    Vector3::new(0.1, 0.2, 2.5)
}

/// How an arm stands that a former session left: said once a session begins, maybe after something has been asked for.
const LEFT: RobotControl = RobotControl::State {
    state: RobotState::Holding,
    cause: Cause::LeaseExpired,
    changes: 7,
};

#[test]
fn an_arm_that_holds_from_before_ends_nothing_that_is_only_being_asked_for() {
    let granted = granted(1);
    let mut bench = Bench::ready(SessionConfig::default(), None);
    let t: Vec<f64> = (0..50).map(|i| f64::from(i) * 0.1).collect();
    let x: Vec<_> = t.iter().map(|&t| home() * (0.1 * t)).collect();
    let plan = telemime_protocol::checkpoint::select::bounded(&t, &x, 0.01).unwrap();
    bench.session.play(&plan.into(), None);
    bench.hears(&LEFT);
    bench.hears(&RobotControl::PlanStored { id: 1 });
    let asks = |c: &OperatorControl| matches!(c, OperatorControl::Engage(_));
    assert!(bench.control.iter().any(asks), "{:?}", bench.control);

    let mut bench = Bench::ready(SessionConfig::default(), None);
    bench.sample(home());
    bench.session.engage(bench.now);
    bench.hears(&LEFT);
    bench.hears(&granted);
    bench.forget();
    for _ in 0..30 {
        bench.sample(home());
    }
    assert!(!bench.motions().is_empty(), "it drives");
    bench.hears(&LEFT);
    bench.forget();
    for _ in 0..30 {
        bench.sample(home());
    }
    assert!(bench.motions().is_empty(), "what it was granted is over");
}
