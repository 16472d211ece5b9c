//! Orientation and grip through the servo: from the hand, or a plan, to the tip.
#![allow(
    clippy::unwrap_used,
    reason = "clippy.toml allows it in tests, but does not know these helpers for tests"
)]

use std::sync::Arc;

use nalgebra::{Quaternion, UnitQuaternion, Vector1, Vector3, Vector4};
use telemime_endpoint::Mono;
use telemime_protocol::checkpoint::PoseCurve;
use telemime_protocol::pose;
use telemime_protocol::predict::{
    Forecast, HandState, MEMORY_TAU_S, Params, TurnForecast, TurnState,
};
use telemime_protocol::spline::{BSpline, End};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::{Cause, RobotState};
use telemime_robot::rig::{Rig, RigOptions};
use telemime_robot::servo::{
    Engagement, Handle, Lease, Order, Report, Source, Station, Ticket, Trajectory, rings,
};

const MS: i64 = 1_000_000;

const HAND_M: Vector3<f64> = Vector3::new(0.1, 0.2, 2.0);

/// Hand axes to base axes.
fn rotation() -> UnitQuaternion<f64> {
    UnitQuaternion::from_euler_angles(0.3, -0.7, 1.2)
}

struct Bench {
    core: Station,
    handle: Handle,
    now: Mono,
}

const TICKET: Ticket = Ticket {
    epoch: 1,
    number: 1,
};

impl Bench {
    fn new() -> Self {
        let (rings, handle) = rings();
        let core = Rig::load(&RigOptions::default()).unwrap().servo(rings);
        let mut bench = Self {
            core,
            handle,
            now: Mono(0),
        };
        bench.order(Order::Operator(true));
        bench.tick();
        bench
    }

    fn order(&mut self, order: Order) {
        self.handle.orders.push(order).unwrap();
    }

    fn tick(&mut self) -> Report {
        self.now = Mono(self.now.0 + MS);
        self.core.tick(self.now)
    }

    fn lease(&self) -> Lease {
        Lease {
            from: self.now,
            until: self.now.offset_by_secs(0.65),
        }
    }

    fn engage(&mut self, source: Source) -> Report {
        let lease = self.lease();
        self.order(Order::Engage(Engagement {
            ticket: TICKET,
            model: None,
            source,
            scale: 0.1,
            rotation: rotation(),
            lease,
        }));
        self.tick()
    }

    fn mirror(&self, turn: Option<TurnForecast>, grip: Option<f64>) -> Source {
        Source::Mirror {
            forecast: still(),
            valid_at: self.now,
            turn,
            grip,
        }
    }

    fn track(&mut self, turn: Option<TurnForecast>, grip: Option<f64>) {
        let lease = self.lease();
        self.order(Order::Track {
            ticket: TICKET,
            forecast: still(),
            valid_at: self.now,
            turn,
            grip,
            lease,
        });
    }

    /// The hand held as `orientation` from now on.
    fn held(&self, orientation: UnitQuaternion<f64>) -> Option<TurnForecast> {
        Some(turning(orientation, Vector3::zeros()))
    }

    /// `ms` milliseconds of a message every 50 ms, by `message`.
    fn run(
        &mut self,
        ms: i64,
        mut message: impl FnMut(&Self) -> (Option<TurnForecast>, Option<f64>),
    ) -> Report {
        let mut last = None;
        for i in 0..ms {
            if i % 50 == 0 {
                let (turn, grip) = message(self);
                self.track(turn, grip);
            }
            last = Some(self.tick());
        }
        last.unwrap()
    }
}

/// The hand held as `q` and turning at `omega` rad/s in the axes of its position, undamped.
fn turning(q: UnitQuaternion<f64>, omega: Vector3<f64>) -> TurnForecast {
    let own = q.inverse() * omega;
    let state = TurnState {
        memory: MEMORY_TAU_S.map(|tau_s| pose::moved(&q, &(own * -tau_s))),
        ..TurnState::first(Stamp::ZERO, q)
    };
    TurnForecast::constant_velocity(&state, &Params::only([0.0, 0.0, 1.0]))
}

fn still() -> Forecast {
    Forecast::constant_velocity(&HandState::first(Stamp::ZERO, HAND_M), &Params::DEFAULT)
}

fn hand() -> UnitQuaternion<f64> {
    UnitQuaternion::from_euler_angles(-1.0, 0.4, 2.5)
}

fn turned(axis: Vector3<f64>, angle: f64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_scaled_axis(axis * angle)
}

/// How far the tip has turned since `from`, in base axes.
fn since(report: &Report, from: &Report) -> Vector3<f64> {
    (report.orientation * from.orientation.inverse()).scaled_axis()
}

#[test]
fn the_tip_turns_as_the_hand_does_in_base_axes_and_stays_in_its_place() {
    let mut bench = Bench::new();
    let start = bench.engage(bench.mirror(bench.held(hand()), None));
    assert_eq!(start.state, RobotState::Engaged);
    let turn = Vector3::new(0.2, -0.3, 0.4);
    let mut fastest = 0.0_f64;
    let mut before = start;
    for _ in 0..60 {
        let last = bench.run(50, |b| (b.held(turned(turn, 1.0) * hand()), None));
        fastest = fastest.max(since(&last, &before).norm() / 0.05);
        assert!((last.tip_m - start.tip_m).norm() < 2e-4);
        before = last;
    }
    assert!((since(&before, &start) - rotation() * turn).norm() < 2e-3);
    assert!(before.orientation_error_rad < 2e-3);
    // Eased in over half a second: a step of 0.54 rad is no jump.
    assert!(fastest < 2.0 && fastest > 0.3, "{fastest} rad/s");
}

#[test]
fn a_steady_turn_is_met_without_lag() {
    let mut bench = Bench::new();
    let start = bench.engage(bench.mirror(bench.held(hand()), None));
    let engaged_at = bench.now;
    let (axis, speed) = (Vector3::new(0.0, 0.6, 0.8), 0.3);
    let at = |now: Mono| turned(axis, speed * now.secs_since(engaged_at)) * hand();
    let last = bench.run(1500, |b| (Some(turning(at(b.now), axis * speed)), None));
    // The report is of the tick's beginning, of the arm after the one before.
    let expected = rotation() * axis * (speed * last.at.secs_since(engaged_at));
    let off = (since(&last, &start) - expected).norm();
    assert!(off < 3e-3, "{off} rad");
}

#[test]
fn messages_without_orientation_do_not_take_the_turn_back() {
    let mut bench = Bench::new();
    let start = bench.engage(bench.mirror(bench.held(hand()), None));
    bench.run(600, |b| (b.held(hand()), None));
    let (axis, speed) = (Vector3::z(), 0.8);
    let mut news = Some(turning(hand(), axis * speed));
    let first = bench.run(50, |_| (news.take(), None));
    let mut before = since(&first, &start).norm();
    for _ in 0..60 {
        let now = bench.run(10, |_| (None, None));
        let turned = since(&now, &start).norm();
        assert!(turned > before - 1e-3, "{turned} after {before} rad");
        before = turned;
    }
    // 650 ms after the one forecast there was; a straight turn ends within a radian.
    let way = 0.65 * speed;
    let expected = way / (1.0 + way * way).sqrt();
    assert!((before - expected).abs() < 0.01, "{before} rad");
}

#[test]
fn an_orientation_that_appears_later_has_no_reference_and_is_not_followed() {
    let mut bench = Bench::new();
    let start = bench.engage(bench.mirror(None, None));
    let last = bench.run(1000, |b| (b.held(turned(Vector3::x(), 1.0) * hand()), None));
    assert!(since(&last, &start).norm() < 1e-3);
    assert!(last.orientation_error_rad < 1e-3);
}

#[test]
fn half_turns_and_changes_of_sign_are_no_jolt() {
    let mut bench = Bench::new();
    bench.engage(bench.mirror(bench.held(hand()), None));
    bench.run(600, |b| (b.held(hand()), None));
    let mut flips = 0;
    let (mut before, mut fastest, mut hardest) = (bench.tick(), 0.0_f64, 0.0_f64);
    let mut speed = Vector3::zeros();
    for i in 0..2000 {
        if i % 20 == 0 {
            flips += 1;
            let sign = if flips % 2 == 0 { 1.0 } else { -1.0 };
            // Every second of them as its negative, every fourth on the far side.
            let far = turned(
                Vector3::z(),
                core::f64::consts::PI * f64::from(flips / 4 % 2),
            );
            let q = UnitQuaternion::new_unchecked((far * hand()).into_inner() * sign);
            bench.track(bench.held(q), None);
        }
        let report = bench.tick();
        assert_eq!(report.state, RobotState::Engaged);
        let now = since(&report, &before) / 1e-3;
        fastest = fastest.max(now.norm());
        hardest = hardest.max((now - speed).norm() / 1e-3);
        assert!((report.tip_m - before.tip_m).norm() < 1e-4);
        (speed, before) = (now, report);
    }
    assert!(fastest > 0.2 && fastest < 2.6, "{fastest} rad/s");
    assert!(hardest < 60.0, "{hardest} rad/s²");
}

#[test]
fn what_is_no_orientation_is_not_engaged_with_and_stops_what_moves() {
    let nan = UnitQuaternion::new_unchecked(Quaternion::new(f64::NAN, 0.0, 0.0, 1.0));
    let zero = UnitQuaternion::new_unchecked(Quaternion::new(0.0, 0.0, 0.0, 0.0));
    for bad in [nan, zero] {
        let mut bench = Bench::new();
        let report = bench.engage(bench.mirror(bench.held(bad), None));
        assert_eq!((report.state, report.declined), (RobotState::Ready, TICKET));

        let mut bench = Bench::new();
        bench.engage(bench.mirror(bench.held(hand()), None));
        let turned = |b: &Bench| b.held(turned(Vector3::x(), 1.0) * hand());
        let moving = bench.run(400, |b| (turned(b), None));
        assert!(moving.moving);
        let stopped = bench.run(500, |b| (b.held(bad), None));
        assert!(!stopped.moving && stopped.orientation.as_ref().norm().is_finite());
        assert_eq!(stopped.clamps - moving.clamps, 500);
        // And goes on with the next that is one.
        let last = bench.run(2000, |b| (turned(b), None));
        assert!(last.orientation_error_rad < 2e-3);
    }
}

#[test]
fn the_grip_follows_at_its_own_speed_and_stays_when_the_motion_ends() {
    let mut bench = Bench::new();
    let start = bench.engage(bench.mirror(None, Some(1.0)));
    assert_eq!(start.opening, Some(1.0));
    let closing = bench.run(400, |_| (None, Some(0.0)));
    let half = closing.opening.unwrap();
    assert!((half - 0.5).abs() < 5e-3, "{half}");
    // No news of it: the last one holds.
    let closed = bench.run(600, |_| (None, None));
    assert_eq!(closed.opening, Some(0.0));
    let opening = bench.run(200, |_| (None, Some(1.0)));
    bench.handle.brake.pull(Cause::OperatorStop);
    let mut last = bench.tick();
    assert_eq!(last.opening, opening.opening);
    for _ in 0..1000 {
        last = bench.tick();
    }
    assert_eq!(last.state, RobotState::Stopped);
    assert_eq!(last.opening, opening.opening);
}

#[test]
fn a_plan_is_played_with_its_orientation_and_grip() {
    let t: Vec<f64> = (0..=20).map(|i| 0.1 * f64::from(i)).collect();
    let smooth = |t: f64| {
        let u = (t / 2.0).clamp(0.0, 1.0);
        u.powi(3) * (10.0 - 15.0 * u + 6.0 * u * u)
    };
    let turn = Vector3::new(0.3, 0.2, -0.4);
    let x: Vec<_> = t
        .iter()
        .map(|&t| HAND_M + Vector3::x() * smooth(t))
        .collect();
    let q: Vec<_> = t
        .iter()
        .map(|&t| turned(turn, smooth(t)) * hand())
        // A knot's length does not matter.
        .map(|q| Vector4::new(q.w, q.i, q.j, q.k) * 1.7)
        .collect();
    let grip: Vec<_> = t.iter().map(|&t| Vector1::new(1.0 - smooth(t))).collect();
    let mut bench = Bench::new();
    let start = bench.engage(Source::Play(Arc::new(Trajectory {
        curve: PoseCurve {
            position: BSpline::interpolate(&t, &x, End::Natural).unwrap(),
            orientation: Some(BSpline::interpolate(&t, &q, End::Natural).unwrap()),
            grip: Some(BSpline::interpolate(&t, &grip, End::Natural).unwrap()),
        },
        duration_s: 2.0,
    })));
    let engaged_at = bench.now;
    let (mut off, mut off_turn, mut last) = (0.0_f64, 0.0_f64, start);
    for i in 0..2250 {
        if i % 100 == 0 {
            let lease = bench.lease();
            bench.order(Order::Extend {
                ticket: TICKET,
                lease,
                bent: None,
            });
        }
        last = bench.tick();
        let share = smooth(last.at.secs_since(engaged_at));
        let tip = start.tip_m + rotation() * Vector3::x() * (0.1 * share);
        off = off.max((last.tip_m - tip).norm());
        off_turn = off_turn.max((since(&last, &start) - rotation() * turn * share).norm());
    }
    println!("off by {off} m and {off_turn} rad");
    assert!(off < 2e-3 && off_turn < 8e-3, "{off} m, {off_turn} rad");
    assert!((since(&last, &start) - rotation() * turn).norm() < 2e-3);
    assert_eq!((last.opening, last.clamps), (Some(0.0), 0));
    for _ in 0..500 {
        last = bench.tick();
    }
    assert_eq!(
        (last.state, last.cause),
        (RobotState::Ready, Cause::PlanFinished)
    );
    assert!(!last.moving && last.opening == Some(0.0));
}
