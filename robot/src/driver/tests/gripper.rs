//! A gripper behind a driver: what it is sent when nobody asks anything of it.

use nalgebra::{UnitQuaternion, Vector3};
use telemime_protocol::predict::{Forecast, HandState, Params};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::Cause;

use super::*;
use crate::servo::{Engagement, Handle, Lease, Order, Report, Source, Station, Ticket, rings};

const TICKET: Ticket = Ticket {
    epoch: 1,
    number: 1,
};

/// An arm that is where it was told to be, and whose gripper ends at `blocked` or tells nothing.
struct Robot {
    station: Station,
    handle: Handle,
    says: rtrb::Producer<Heard>,
    hears: rtrb::Consumer<Sent>,
    now: Mono,
    state: ArmState,
    blocked: Option<f64>,
    sent: Vec<Option<f64>>,
}

impl Robot {
    fn new(opening: Option<f64>, blocked: Option<f64>) -> Self {
        let options = RigOptions {
            driver: true,
            ..RigOptions::default()
        };
        let rig = Rig::load(&options).unwrap();
        let (says, heard) = rtrb::RingBuffer::new(64);
        let (setpoints, hears) = rtrb::RingBuffer::new(64);
        let state = ArmState {
            q: rig.home,
            opening,
            ..ArmState::default()
        };
        let config = DriverConfig::new(1000.0, PATIENCE_S).unwrap();
        let arm = DriverArm::new(rig.arm.clone(), config, state, heard, setpoints);
        let (rings, mut handle) = rings();
        handle.orders.push(Order::Operator(true)).unwrap();
        Self {
            station: rig.servo_before(Box::new(arm), opening, rings),
            handle,
            says,
            hears,
            now: Mono(1_000_000_000),
            state,
            blocked,
            sent: Vec::new(),
        }
    }

    fn ticks(&mut self, ticks: u32) -> Report {
        let mut last = None;
        for _ in 0..ticks {
            self.now = Mono(self.now.0 + MS);
            while let Ok(sent) = self.hears.pop() {
                let reference = sent.setpoint.reference;
                (self.state.q, self.state.qd) = (reference.q, reference.qd);
                self.sent.push(sent.setpoint.opening);
                if let Some(least) = self.blocked {
                    self.state.opening = sent.setpoint.opening.map(|to| to.max(least));
                }
                let (at, state, obeyed) = (self.now, self.state, sent.seq);
                let _ = self.says.push(Heard::State { at, state, obeyed });
            }
            last = Some(self.station.tick(self.now));
            while self.handle.reports.pop().is_ok() {}
        }
        last.unwrap()
    }

    /// What was sent since this was asked for last, without repetition.
    fn sent(&mut self) -> Vec<Option<f64>> {
        let mut sent = std::mem::take(&mut self.sent);
        sent.dedup();
        sent
    }

    fn engages(&mut self, number: u32, grip: Option<f64>) {
        let still = HandState::first(Stamp::ZERO, Vector3::zeros());
        let engagement = Engagement {
            ticket: Ticket { number, ..TICKET },
            model: None,
            source: Source::Mirror {
                forecast: Forecast::constant_velocity(&still, &Params::DEFAULT),
                valid_at: self.now,
                turn: None,
                grip,
            },
            scale: 1.0,
            rotation: UnitQuaternion::identity(),
            lease: Lease {
                from: self.now,
                until: self.now.offset_by_secs(0.9),
            },
        };
        self.handle.orders.push(Order::Engage(engagement)).unwrap();
    }
}

#[test]
fn a_gripper_that_tells_nothing_is_sent_nothing_before_it_is_asked_for_and_then_keeps_it() {
    let mut robot = Robot::new(None, None);
    assert_eq!(robot.ticks(200).opening, None);
    // A hand without a grip asks nothing of it.
    robot.engages(1, None);
    robot.ticks(300);
    let first = Ticket {
        number: 1,
        ..TICKET
    };
    robot.handle.orders.push(Order::Release(first)).unwrap();
    robot.ticks(200);
    assert_eq!(robot.sent(), [None]);
    robot.engages(2, Some(0.0));
    let gripping = robot.ticks(300);
    assert_eq!((gripping.opening, gripping.clamps), (Some(0.0), 0));
    assert_eq!(robot.sent(), [None, Some(0.0)]);
    // However the motion ends.
    robot.ticks(700);
    let lapsed = robot.ticks(1);
    assert_eq!(lapsed.cause, Cause::LeaseExpired);
    robot.engages(3, None);
    robot.ticks(100);
    robot.handle.brake.stop_here();
    let stopped = robot.ticks(300);
    assert_eq!(
        (stopped.cause, stopped.opening),
        (Cause::LocalStop, Some(0.0))
    );
    assert_eq!(robot.sent(), [Some(0.0)]);
}

#[test]
fn a_gripper_that_is_blocked_keeps_its_force_when_the_motion_ends() {
    let mut robot = Robot::new(Some(1.0), Some(0.4));
    robot.ticks(100);
    assert_eq!(robot.sent(), [Some(1.0)], "where it was at the start");
    robot.engages(1, Some(0.0));
    assert_eq!(
        robot.ticks(300).opening,
        Some(0.4),
        "what is told is measured"
    );
    robot.handle.brake.pull(Cause::OperatorStop);
    robot.ticks(300);
    assert_eq!(robot.sent(), [Some(1.0), Some(0.0)]);
}

#[test]
fn a_line_leaves_out_an_opening_that_nobody_has_asked_for() {
    let sent = |opening| Sent {
        seq: 1,
        at: Mono(0),
        setpoint: Setpoint {
            reference: JointReference::default(),
            tau: Joints::zeros(),
            opening,
        },
    };
    let mut text = Vec::new();
    line::setpoint(&sent(None), 1, &mut text);
    assert!(!String::from_utf8_lossy(&text).contains("opening"));
    line::setpoint(&sent(Some(0.0)), 1, &mut text);
    assert!(String::from_utf8_lossy(&text).contains(r#""opening":0.0"#));
}
