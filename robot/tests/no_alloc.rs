//! A tick neither allocates nor frees, whatever it is told to do.
#![allow(
    clippy::unwrap_used,
    reason = "clippy.toml allows it in tests, but does not know these helpers for tests"
)]

use std::collections::BTreeSet;
use std::sync::Arc;

use allocation_counter::measure;
use nalgebra::{Matrix3, UnitQuaternion, Vector1, Vector3, Vector4};
use telemime_endpoint::Mono;
use telemime_protocol::checkpoint::PoseCurve;
use telemime_protocol::predict::{
    Bend, Forecast, HandState, Held, Params, TurnForecast, TurnState,
};
use telemime_protocol::skill::example;
use telemime_protocol::spline::{BSpline, End};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::{Cause, RobotState};
use telemime_robot::blackbox::{Header, Recorder, SPAN_S, taps};
use telemime_robot::driver::{DriverArm, DriverConfig, Heard, Sent};
use telemime_robot::rig::{Rig, RigOptions};
use telemime_robot::servo::{
    ArmFault, ArmState, Bent, Engagement, Handle, Lease, Order, Report, Source, Station, Ticket,
    Trajectory, rings,
};

const MS: i64 = 1_000_000;

fn ticket(number: u32) -> Ticket {
    Ticket { epoch: 1, number }
}

struct Bench {
    core: Station,
    handle: Handle,
    now: Mono,
    seen: BTreeSet<String>,
    touched: u64,
    recorder: Option<Recorder>,
    driver: Option<Perfect>,
}

/// A driver whose arm is where it was told to be a tick ago.
struct Perfect {
    says: rtrb::Producer<Heard>,
    hears: rtrb::Consumer<Sent>,
}

impl Perfect {
    fn obey(&mut self, now: Mono) {
        while let Ok(sent) = self.hears.pop() {
            let reference = sent.setpoint.reference;
            let state = ArmState {
                q: reference.q,
                qd: reference.qd,
                opening: sent.setpoint.opening,
            };
            let (at, obeyed) = (now, sent.seq);
            let _ = self.says.push(Heard::State { at, state, obeyed });
        }
    }
}

impl Bench {
    fn new() -> Self {
        let rig = Rig::load(&RigOptions::default()).unwrap();
        let (rings, handle) = rings();
        Self {
            core: rig.servo(rings),
            handle,
            now: Mono(0),
            seen: BTreeSet::new(),
            touched: 0,
            recorder: None,
            driver: None,
        }
    }

    /// The same arm behind a driver.
    fn driven() -> Self {
        let options = RigOptions {
            driver: true,
            ..RigOptions::default()
        };
        let rig = Rig::load(&options).unwrap();
        let (says, heard) = rtrb::RingBuffer::new(64);
        let (setpoints, hears) = rtrb::RingBuffer::new(64);
        let state = ArmState {
            q: rig.home,
            opening: Some(1.0),
            ..ArmState::default()
        };
        let config = DriverConfig {
            rate_hz: 1000.0,
            patience_s: 0.1,
        };
        let arm = DriverArm::new(rig.arm.clone(), config, state, heard, setpoints);
        let (rings, handle) = rings();
        Self {
            core: rig.servo_before(Box::new(arm), Some(1.0), rings),
            handle,
            driver: Some(Perfect { says, hears }),
            ..Self::new()
        }
    }

    fn recorded(mut self) -> Self {
        let rig = Rig::load(&RigOptions::default()).unwrap();
        let (tap, feed) = taps(&self.core.room());
        self.core = self.core.recorded(tap);
        self.recorder = Some(Recorder::new(Header::new(&rig, None), feed, SPAN_S));
        self
    }

    fn order(&mut self, order: Order) {
        self.handle.orders.push(order).unwrap();
    }

    /// Ticks for `ms` and returns the last report; the session's end of the rings is left alone.
    fn tick(&mut self, ms: i64) -> Report {
        let mut last = None;
        for _ in 0..ms {
            self.now = Mono(self.now.0 + MS);
            if let Some(driver) = &mut self.driver {
                driver.obey(self.now);
            }
            if let Some(recorder) = self
                .recorder
                .as_mut()
                .filter(|_| self.now.0 % (50 * MS) == 0)
            {
                recorder.drain();
            }
            let (core, now) = (&mut self.core, self.now);
            let used = measure(|| last = Some(core.tick(now)));
            self.touched += used.count_total + used.count_current.unsigned_abs();
            let state = last.as_ref().map(|r| r.state);
            self.seen.insert(format!("{state:?}"));
        }
        last.unwrap()
    }

    fn lease(&self) -> Lease {
        Lease {
            from: self.now,
            until: self.now.offset_by_secs(0.65),
        }
    }

    /// A hand at `plan_s` of the plan that holds on, or has just let go of a centimetre.
    fn bent(&self, plan_s: f64, holds: bool) -> Bent {
        let held = Held {
            push: self.forecast(false),
            weight: Matrix3::identity() * 0.01,
        };
        Bent {
            bend: Bend {
                plan_s,
                rate: 1.0,
                left: Vector3::x() * 0.01,
                held: holds.then_some(held),
            },
            at: self.now,
            sampled_at: self.now,
        }
    }

    fn extend(&mut self, number: u32, bent: Option<Bent>) {
        let lease = self.lease();
        self.order(Order::Extend {
            ticket: ticket(number),
            lease,
            bent,
        });
    }

    fn engage(&mut self, number: u32, source: Source) {
        self.order(Order::Engage(Engagement {
            ticket: ticket(number),
            model: None,
            source,
            scale: 0.1,
            rotation: UnitQuaternion::identity(),
            lease: self.lease(),
        }));
    }

    /// The hand held turned by `angle` about an axis.
    fn turn(&self, angle: f64) -> TurnForecast {
        let q = UnitQuaternion::from_scaled_axis(Vector3::new(0.6, 0.0, 0.8) * angle);
        let mut state = TurnState::first(Stamp::ZERO, q);
        state.advance(
            Stamp::from_secs_f64(0.03),
            UnitQuaternion::from_scaled_axis(Vector3::new(0.1, 0.0, -0.2)) * q,
        );
        TurnForecast::constant_velocity(&state, &Params::DEFAULT)
    }

    /// What the hand's newest sample, valid now, predicts.
    fn forecast(&self, with_model: bool) -> Forecast {
        let t_s = self.now.0 as f64 * 1e-9;
        let hand = |t_s: f64| Vector3::new((5.0 * t_s).sin(), (3.0 * t_s).cos(), 2.0) * 0.5;
        let mut state = HandState::first(Stamp::ZERO, hand(t_s - 1.0));
        for i in 1..=30 {
            let u = f64::from(i) / 30.0;
            state.advance(Stamp::from_secs_f64(u), hand(t_s - 1.0 + u));
        }
        if with_model {
            example(3, 24)
                .predictor()
                .forecast(&state, &Params::DEFAULT)
        } else {
            Forecast::constant_velocity(&state, &Params::DEFAULT)
        }
    }
}

fn trajectory(duration_s: f64) -> Source {
    let t: Vec<f64> = (0..10).map(|i| duration_s * f64::from(i) / 9.0).collect();
    let x: Vec<_> = t
        .iter()
        .map(|t| Vector3::new(t.sin(), 0.2 * t, 0.0))
        .collect();
    let q: Vec<_> = t
        .iter()
        .map(|t| Vector4::new(1.0, 0.2 * t, 0.0, -0.1 * t))
        .collect();
    let grip: Vec<_> = t.iter().map(|t| Vector1::new(t / duration_s)).collect();
    Source::Play(Arc::new(Trajectory {
        curve: PoseCurve {
            position: BSpline::interpolate(&t, &x, End::Natural).unwrap(),
            orientation: Some(BSpline::interpolate(&t, &q, End::Natural).unwrap()),
            grip: Some(BSpline::interpolate(&t, &grip, End::Natural).unwrap()),
        },
        duration_s,
    }))
}

#[test]
fn the_counter_counts() {
    let used = measure(|| drop(std::hint::black_box(Box::new(1_u64))));
    assert_eq!((used.count_total, used.count_current), (1, 0));
}

#[test]
fn a_tick_never_touches_the_heap() {
    through_every_state(Bench::new());
}

#[test]
fn a_tick_that_is_recorded_does_not_either() {
    through_every_state(Bench::new().recorded());
}

#[test]
fn a_record_that_nobody_takes_costs_no_heap() {
    let mut bench = Bench::new().recorded();
    bench.recorder.as_mut().unwrap().drain();
    let stalled = bench.recorder.take();
    through_every_state(bench);
    drop(stalled);
}

#[test]
fn a_tick_before_a_driver_does_not_either() {
    through_every_state(Bench::driven().recorded());
}

#[test]
fn a_driver_that_fails_is_a_stop_without_the_heap() {
    let mut bench = Bench::driven().recorded();
    bench.tick(5);
    bench.driver = None;
    let stopped = bench.tick(200);
    assert_eq!(
        (stopped.state, stopped.cause),
        (RobotState::Stopped, Cause::ArmFault)
    );
    assert!(matches!(stopped.fault, Some(ArmFault::Stalled { .. })));
    assert_eq!(bench.touched, 0);
}

fn through_every_state(mut bench: Bench) {
    bench.tick(5);
    bench.order(Order::Operator(true));
    bench.tick(5);

    let (forecast, valid_at) = (bench.forecast(false), bench.now);
    bench.engage(
        1,
        Source::Mirror {
            forecast,
            valid_at,
            turn: Some(bench.turn(0.0)),
            grip: Some(0.0),
        },
    );
    for i in 0..60 {
        bench.tick(33);
        let (forecast, valid_at) = (bench.forecast(i % 2 == 0), bench.now);
        // Slowly, by leaps, from one sign to the other, and not at all.
        let turn = match i % 20 {
            0..15 => bench.turn(0.02 * f64::from(i)),
            15..18 => bench.turn(3.0 * f64::from(i)),
            _ => bench.turn(f64::NAN),
        };
        let lease = bench.lease();
        bench.order(Order::Track {
            ticket: ticket(1),
            forecast,
            valid_at,
            turn: (i % 5 > 0).then_some(turn),
            grip: (i % 3 > 0).then_some(0.1 * f64::from(i % 10)),
            lease,
        });
    }
    let moving = bench.tick(10);
    assert!(moving.state == RobotState::Engaged && moving.moving);
    let held = bench.tick(1500);
    assert_eq!(
        (held.state, held.cause),
        (RobotState::Holding, Cause::LeaseExpired)
    );

    // A plan to its end, one that takes the place of another, and one that is refused.
    bench.engage(2, trajectory(0.5));
    let mut played = bench.tick(400);
    bench.extend(2, None);
    bench.engage(3, trajectory(0.5));
    for i in 1..=16 {
        played = bench.tick(100);
        // A hand takes hold, and lets go after 0.4 s.
        let bent = (i <= 4).then(|| bench.bent(0.1 * f64::from(i), i < 4));
        bench.extend(2, bent);
    }
    assert_eq!(
        (played.state, played.cause),
        (RobotState::Ready, Cause::PlanFinished)
    );
    bench.engage(4, trajectory(2.0));
    bench.tick(300);
    bench.handle.brake.pull(Cause::ClockStep);
    assert_eq!(bench.tick(700).state, RobotState::Holding);

    let (forecast, valid_at) = (bench.forecast(true), bench.now);
    bench.engage(
        5,
        Source::Mirror {
            forecast,
            valid_at,
            turn: None,
            grip: None,
        },
    );
    bench.tick(300);
    bench.order(Order::Release(ticket(5)));
    bench.tick(500);
    bench.handle.brake.pull(Cause::OperatorStop);
    bench.tick(10);
    let stop = Some(bench.tick(1).transitions);
    bench.order(Order::Reset {
        operator: true,
        stop,
    });
    bench.tick(10);
    bench.order(Order::Operator(false));
    assert_eq!(bench.tick(10).state, RobotState::Idle);

    assert_eq!(bench.seen.len(), 6, "every state: {:?}", bench.seen);
    assert_eq!(bench.handle.spent.slots(), 3, "plans are freed elsewhere");
    assert_eq!(
        bench.handle.reports.slots(),
        4096,
        "a full ring costs nothing"
    );
    assert_eq!(
        bench.touched, 0,
        "allocations and deallocations on the tick"
    );
}
