//! An operator's session under any messages of a robot, any hand and any wishes of its user, at any times: nothing panics,
//! nothing piles up, whatever is said decodes, and motion is asked for only by a user who did.
//!
//! The input is a row of operations, a byte each and what it takes; see the robot's target.

#![no_main]

use std::sync::Arc;

use libfuzzer_sys::fuzz_target;
use nalgebra::Vector3;
use telemime_operator::session::{HandSample, Output, Session};
use telemime_protocol::skill::{Skill, example};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::frame::Frame;
use telemime_protocol::wire::v1::*;

const EPOCH: u32 = 7;

thread_local! {
    static SKILL: Arc<Skill> = Arc::new(example(2, 3));
}

struct Input<'a>(&'a [u8]);

impl<'a> Input<'a> {
    fn byte(&mut self) -> u8 {
        let (&first, rest) = self.0.split_first().unwrap_or((&0, &[]));
        self.0 = rest;
        first
    }

    fn bytes(&mut self) -> &'a [u8] {
        let len = usize::from(u16::from_le_bytes([self.byte(), self.byte()]));
        let (head, rest) = self.0.split_at(len.min(self.0.len()));
        self.0 = rest;
        head
    }
}

struct Bench {
    session: Session,
    now: Stamp,
    wishes: u32,
    asked: u32,
    /// Of the last motion.
    seq: u32,
    over: bool,
}

impl Bench {
    fn flush(&mut self) {
        let mut said = 0;
        while let Some(output) = self.session.poll_output() {
            said += 1;
            assert!(said < 600, "one event makes no flood");
            match output {
                Output::Control(bytes) => {
                    let message =
                        OperatorControl::decode(&bytes).expect("what is said is a message");
                    if matches!(message, OperatorControl::Engage(_)) {
                        self.asked += 1;
                        assert!(self.asked <= self.wishes, "nobody wished to engage");
                    }
                }
                Output::Datagram { bytes, .. } => {
                    assert!(bytes.len() <= MAX_DATAGRAM_LEN);
                    match OperatorDatagram::decode(&bytes).expect("what is said is a message") {
                        OperatorDatagram::Motion(Motion { seq, .. })
                        | OperatorDatagram::Go { seq, .. } => {
                            assert!(self.asked > 0 && seq > self.seq, "{seq} after {}", self.seq);
                            self.seq = seq;
                        }
                        _ => {}
                    }
                }
            }
        }
        let mut events = 0;
        while self.session.poll_event().is_some() {
            events += 1;
            assert!(events < 64);
        }
    }

    fn wait(&mut self, ms: u8) {
        let end = Stamp(self.now.0 + i64::from(ms) * 1_000_000);
        for _ in 0..2 * u32::from(ms) + 8 {
            match self.session.poll_timeout() {
                Some((due, _)) if due <= end => {
                    self.now = due.max(self.now);
                    self.session.handle_timeout(self.now);
                    self.flush();
                }
                _ => {
                    self.now = end;
                    return;
                }
            }
        }
        panic!("a timeout that does not pass");
    }

    fn control(&mut self, payload: Vec<u8>) {
        let decodes = RobotControl::decode(&payload).is_ok();
        let frame = Frame {
            ignorable: false,
            payload,
        };
        let ended = self.session.handle_control(self.now, &frame).is_err();
        assert!(ended || decodes, "malformed ends the session");
        self.over |= ended;
        self.flush();
    }

    fn sample(&mut self, input: &mut Input<'_>) {
        let x = Vector3::from_fn(|_, _| f64::from(input.byte() as i8) * 0.02);
        self.session
            .handle_sample(self.now, HandSample::at(self.now, x));
        self.flush();
    }

    fn wish(&mut self, input: &mut Input<'_>) {
        match input.byte() % 8 {
            0 | 1 => {
                self.wishes += 1;
                self.session.engage(self.now);
            }
            2 => self.session.release(),
            3 => self.session.stop(self.now),
            4 => drop(self.session.reset()),
            5 => self.session.goodbye(),
            _ => {
                let engaged = RobotControl::Engaged {
                    engagement: input.byte().into(),
                    t_us: self.now.0 / 1000,
                    hand_m: [0.0; 3],
                    tip_m: [0.4, 0.0, 0.5],
                    hand_q: None,
                    tip_q: Default::default(),
                };
                self.control(engaged.encode());
            }
        }
        self.flush();
    }

    fn robot(&mut self, input: &mut Input<'_>) {
        let states = [
            RobotState::Idle,
            RobotState::Ready,
            RobotState::Engaged,
            RobotState::Coasting,
            RobotState::Holding,
            RobotState::Stopped,
        ];
        let state = states[usize::from(input.byte()) % 6];
        match input.byte() % 4 {
            0 => self.control(
                RobotControl::Info(Info {
                    name: "bench".into(),
                    joints: 7,
                    speed_m_s: 1.7,
                    accel_m_s2: 13.0,
                    radius_m: 0.3,
                    lag_s: 0.07,
                    model: None,
                    state,
                })
                .encode(),
            ),
            1 => {
                let id = SKILL.with(|s| s.id().0);
                self.control(RobotControl::ModelStored { id }.encode());
            }
            2 => self.control(
                RobotControl::State {
                    state,
                    cause: Cause::Requested,
                    changes: input.byte().into(),
                }
                .encode(),
            ),
            _ => {
                let ping = RobotDatagram::Ping {
                    epoch: EPOCH,
                    t1_us: 5,
                };
                self.session.handle_datagram(self.now, &ping.encode());
                self.flush();
            }
        }
    }
}

fuzz_target!(|data: &[u8]| {
    let skill = SKILL.with(Arc::clone);
    let mut bench = Bench {
        session: Session::new(Default::default(), Some(skill), EPOCH),
        now: Stamp(3_000_000_000),
        wishes: 0,
        asked: 0,
        seq: 0,
        over: false,
    };
    let mut input = Input(data);
    let mut operations = 0;
    while !input.0.is_empty() && !bench.over && operations < 300 {
        operations += 1;
        match input.byte() % 6 {
            0 => {
                let ms = input.byte();
                bench.wait(ms);
            }
            1 => bench.control(input.bytes().to_vec()),
            2 => {
                bench.session.handle_datagram(bench.now, input.bytes());
                bench.flush();
            }
            3 => bench.sample(&mut input),
            4 => bench.wish(&mut input),
            _ => bench.robot(&mut input),
        }
    }
});
