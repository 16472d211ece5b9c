//! A session and the servo behind it, under any messages at any times: nothing panics, nothing piles up, and the arm moves
//! only by an engagement of this session, while a lease runs, within its workspace and its speed.
//!
//! The input is a row of operations, a byte each and what it takes: raw bytes as a control message or a datagram, or a
//! well-formed message with fields from the input, so that the search need not find out about clocks first.

#![no_main]

use std::cell::RefCell;

use libfuzzer_sys::fuzz_target;
use nalgebra::Vector3;
use telemime_endpoint::Mono;
use telemime_protocol::predict::HandState;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::frame::Frame;
use telemime_protocol::wire::state::WireState;
use telemime_protocol::wire::v1::*;
use telemime_robot::rig::{Rig, RigOptions};
use telemime_robot::servo::thread::Times;
use telemime_robot::servo::{self, Handle, Order};
use telemime_robot::session::{Output, Session};

const EPOCH: u32 = 7;
/// The session clock reads this much more than the robot's, ns.
const OFFSET: i64 = 2_000_000_000;
const MOST_TICKS: u32 = 400;
/// No lease is longer, s (docs/protocol.md §11).
const LONGEST_LEASE_S: f64 = 1.0;

thread_local! {
    static RIG: RefCell<Option<Rig>> = const { RefCell::new(None) };
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
    core: servo::Station,
    handle: Handle,
    info: Info,
    now: Mono,
    ticks: u32,
    /// When anything last arrived that could have carried a lease.
    heard: Mono,
    /// Engages that were well-formed, as far as anybody can tell from outside.
    engages: u32,
    engagement: u32,
    pings: Vec<i64>,
    seq: u32,
    home: Option<Vector3<f64>>,
    tip: Option<Vector3<f64>>,
    over: bool,
}

impl Bench {
    fn new(rig: &Rig) -> Self {
        let (rings, handle) = servo::rings();
        let now = Mono(1_000_000_000);
        Self {
            session: Session::new(Default::default(), rig.info(), EPOCH, None, now),
            core: rig.servo(rings),
            handle,
            info: rig.info(),
            now,
            ticks: 0,
            heard: Mono(i64::MIN / 2),
            engages: 0,
            engagement: 0,
            pings: Vec::new(),
            seq: 0,
            home: None,
            tip: None,
            over: false,
        }
    }

    fn flush(&mut self) {
        let mut said = 0;
        while let Some(output) = self.session.poll_output() {
            said += 1;
            assert!(said < 64, "one event makes no flood");
            match output {
                Output::Control(bytes) => {
                    RobotControl::decode(&bytes).expect("what is said is a message");
                }
                Output::Datagram(bytes) => match RobotDatagram::decode(&bytes) {
                    Ok(RobotDatagram::Ping { t1_us, .. }) => {
                        self.pings.push(t1_us);
                        self.pings.truncate(8);
                    }
                    Ok(
                        RobotDatagram::Telemetry(_)
                        | RobotDatagram::Reception(_)
                        | RobotDatagram::Servo(_),
                    ) => {}
                    Err(e) => panic!("{e}"),
                },
                Output::Order(order) => self.order(order),
                Output::Brake(cause) => self.handle.brake.pull(cause),
                Output::Goodbye => self.over = true,
            }
        }
    }

    fn order(&mut self, order: Order) {
        if self.handle.orders.push(order).is_err() {
            self.handle.brake.pull(Cause::Fault);
        }
    }

    fn tick(&mut self) {
        self.now = Mono(self.now.0 + 1_000_000);
        self.ticks += 1;
        let report = self.core.tick(self.now);
        while let Ok(report) = self.handle.reports.pop() {
            self.session.handle_report(&report, Times::default());
        }
        while self.handle.spent.pop().is_ok() {}
        if self.session.poll_timeout().0 <= self.now {
            self.session.handle_timeout(self.now);
        }
        self.flush();

        assert!(
            report
                .tip_m
                .iter()
                .chain(report.q.as_slice())
                .all(|v| v.is_finite())
        );
        let home = *self.home.get_or_insert(report.tip_m);
        let away = (report.tip_m - home).norm();
        assert!(
            away < f64::from(self.info.radius_m) + 0.02,
            "{away} m from the start"
        );
        let moved = (report.tip_m - self.tip.replace(report.tip_m).unwrap_or(report.tip_m)).norm();
        assert!(
            moved < 1.2e-3 * f64::from(self.info.speed_m_s) + 1e-5,
            "{moved} m in a tick"
        );
        if matches!(report.state, RobotState::Engaged | RobotState::Coasting) {
            assert!(self.engages > 0, "nobody asked for motion");
            let silent = (self.now.0 - self.heard.0) as f64 * 1e-9;
            assert!(
                silent < LONGEST_LEASE_S + 2e-3,
                "{silent} s after the last message"
            );
        }
    }

    fn control(&mut self, payload: Vec<u8>) {
        let decoded = OperatorControl::decode(&payload);
        if let Ok(OperatorControl::Engage(engage)) = &decoded {
            self.engages += 1;
            self.engagement = engage.engagement;
            self.heard = self.now;
        }
        let frame = Frame {
            ignorable: false,
            payload,
        };
        let ended = self.session.handle_control(self.now, &frame).is_err();
        assert_eq!(
            ended,
            decoded.is_err(),
            "malformed ends the session, nothing else does"
        );
        self.over |= ended;
        self.flush();
    }

    fn datagram(&mut self, bytes: &[u8]) {
        if OperatorDatagram::decode(bytes).is_ok() {
            self.heard = self.now;
        }
        self.session.handle_datagram(self.now, bytes);
        self.flush();
    }

    fn session_us(&self, ms_ago: u8) -> i64 {
        (self.now.0 + OFFSET) / 1000 - i64::from(ms_ago) * 1000
    }

    fn state(&self, input: &mut Input<'_>, ms_ago: u8) -> WireState {
        let x = Vector3::from_fn(|_, _| f64::from(input.byte() as i8) * 0.01);
        let t = Stamp(self.session_us(ms_ago) * 1000);
        let mut hand = HandState::first(Stamp(t.0 - 30_000_000), x * 0.9);
        hand.advance(t, x);
        WireState::quantise(&hand).expect("within 100 m")
    }

    fn pong(&mut self, input: &mut Input<'_>) {
        let Some(t1_us) = self.pings.pop() else {
            return;
        };
        let early = input.byte() % 16;
        let t2_us = self.session_us(early);
        let pong = OperatorDatagram::Pong {
            epoch: EPOCH,
            t1_us,
            t2_us,
            t3_us: t2_us + i64::from(early) * 500,
        };
        self.datagram(&pong.encode());
    }

    fn engage(&mut self, input: &mut Input<'_>) {
        let (engagement, ms_ago) = (input.byte().into(), input.byte());
        let weights = [[0, 0, input.byte() & 15]; 3];
        let params = WireParams {
            gain: 255,
            inflation: 128,
            weights,
        };
        let drive = match engagement % 8 {
            7 => Drive::Play { plan: 1 },
            _ => Drive::Mirror {
                state: self.state(input, ms_ago),
                model: 0,
                params,
                pose: Default::default(),
            },
        };
        let engage = OperatorControl::Engage(Engage {
            engagement,
            t_us: self.session_us(ms_ago),
            drive,
            scale: 0.5,
            rotation: [1.0, 0.0, 0.0, 0.0],
            path_bound_um: 20_000,
            path_turn_bound_urad: 50_000 * u32::from(engagement % 2 == 0),
            sample_us: 33_333,
            lease_ms: 650,
        });
        self.control(engage.encode());
    }

    fn motion(&mut self, input: &mut Input<'_>) {
        self.seq += 1;
        let ms_ago = input.byte();
        let motion = OperatorDatagram::Motion(Motion {
            epoch: EPOCH,
            engagement: self.engagement,
            seq: self.seq,
            lease_ms: u16::from(input.byte()) * 10,
            model: 0,
            params: WireParams {
                gain: 255,
                inflation: 128,
                weights: [[0, 0, input.byte() & 15]; 3],
            },
            checksum: None,
            state: self.state(input, ms_ago),
            pose: Default::default(),
            first_knot: 0,
            knots: Default::default(),
        });
        self.datagram(&motion.encode());
    }

    fn small(&mut self, input: &mut Input<'_>) {
        let kind = input.byte();
        match kind % 8 {
            0 => self.control(
                OperatorControl::Release {
                    engagement: self.engagement,
                }
                .encode(),
            ),
            1 => self.control(OperatorControl::EmergencyStop.encode()),
            2 => self.control(
                OperatorControl::Reset {
                    changes: input.byte().into(),
                }
                .encode(),
            ),
            3 => self.datagram(&OperatorDatagram::Stop { epoch: EPOCH }.encode()),
            4 => {
                self.seq += 1;
                let go = OperatorDatagram::Go {
                    epoch: EPOCH,
                    engagement: self.engagement,
                    seq: self.seq,
                    t_us: self.session_us(input.byte()),
                    lease_ms: 650,
                    bend: None,
                };
                self.datagram(&go.encode());
            }
            5 => self.handle.brake.stop_here(),
            6 => self.order(Order::Reset {
                operator: true,
                stop: None,
            }),
            _ => self.control(OperatorControl::Goodbye.encode()),
        }
    }
}

fuzz_target!(|data: &[u8]| {
    RIG.with_borrow_mut(|rig| {
        let rig =
            rig.get_or_insert_with(|| Rig::load(&RigOptions::default()).expect("our own arm"));
        let mut bench = Bench::new(rig);
        let mut input = Input(data);
        bench.flush();
        while !input.0.is_empty() && !bench.over && bench.ticks < MOST_TICKS {
            match input.byte() % 7 {
                0 => (0..=input.byte() % 64).for_each(|_| bench.tick()),
                1 => bench.control(input.bytes().to_vec()),
                2 => bench.datagram(input.bytes()),
                3 => {
                    bench.tick();
                    bench.pong(&mut input);
                }
                4 => bench.engage(&mut input),
                5 => bench.motion(&mut input),
                _ => bench.small(&mut input),
            }
        }
        bench.session.handle_closed();
    });
});
