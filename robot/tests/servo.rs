//! What the servo promises whatever the session does: leases end, stops arrive, engagements do not mix.
#![allow(
    clippy::unwrap_used,
    reason = "clippy.toml allows it in tests, but does not know these helpers for tests"
)]

use std::sync::{Arc, Mutex};

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use telemime_endpoint::Mono;
use telemime_protocol::checkpoint::PoseCurve;
use telemime_protocol::predict::{Bend, Forecast, HandState, Held, Params};
use telemime_protocol::spline::{BSpline, End};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::{Cause, RobotState};
use telemime_robot::control::joint_accelerations;
use telemime_robot::rig::{Rig, RigOptions};
use telemime_robot::servo::{
    ArmFault, ArmState, Bent, Engagement, Handle, Lease, Manipulator, Order, Report, Setpoint,
    Source, Station, Ticket, Trajectory, rings,
};
use telemime_sim::arm::{Joints, PlantReport};

const MS: i64 = 1_000_000;

const HAND_M: Vector3<f64> = Vector3::new(0.1, 0.2, 2.0);

struct Bench {
    core: Station,
    handle: Handle,
    now_ms: i64,
}

fn ticket(number: u32) -> Ticket {
    Ticket { epoch: 1, number }
}

fn forecast() -> Forecast {
    let hand = HandState::first(Stamp::ZERO, HAND_M);
    Forecast::constant_velocity(&hand, &Params::DEFAULT)
}

impl Bench {
    fn new() -> Self {
        Self::with(&RigOptions::default())
    }

    fn with(options: &RigOptions) -> Self {
        let (rings, handle) = rings();
        let core = Rig::load(options).unwrap().servo(rings);
        let mut bench = Self {
            core,
            handle,
            now_ms: 0,
        };
        bench.order(Order::Operator(true));
        bench.tick_at(1);
        bench
    }

    fn order(&mut self, order: Order) {
        self.handle.orders.push(order).unwrap();
    }

    fn tick_at(&mut self, ms: i64) -> Report {
        self.now_ms = ms;
        self.core.tick(Mono(ms * MS))
    }

    fn lease(&self) -> Lease {
        let from = Mono(self.now_ms * MS);
        Lease {
            from,
            until: from.offset_by_secs(0.65),
        }
    }

    fn engage(&mut self, number: u32, scale: f64) {
        let (lease, valid_at) = (self.lease(), Mono(self.now_ms * MS));
        let forecast = forecast();
        self.order(Order::Engage(Engagement {
            ticket: ticket(number),
            model: None,
            source: Source::Mirror {
                forecast,
                valid_at,
                turn: None,
                grip: None,
            },
            scale,
            rotation: UnitQuaternion::identity(),
            lease,
        }));
    }

    fn track(&mut self, number: u32) {
        let (lease, valid_at) = (self.lease(), Mono(self.now_ms * MS));
        self.order(Order::Track {
            ticket: ticket(number),
            forecast: forecast(),
            valid_at,
            turn: None,
            grip: None,
            lease,
        });
    }
}

/// From rest half a metre along x and to rest again, within 2 s.
fn half_a_metre() -> Arc<Trajectory> {
    let t: Vec<f64> = (0..=20).map(|i| f64::from(i) * 0.1).collect();
    let x: Vec<_> = t
        .iter()
        .map(|t| {
            let u = t / 2.0;
            HAND_M + Vector3::x() * (0.5 * u * u * (3.0 - 2.0 * u))
        })
        .collect();
    Arc::new(Trajectory {
        curve: PoseCurve {
            position: BSpline::interpolate(&t, &x, End::Natural).unwrap(),
            orientation: None,
            grip: None,
        },
        duration_s: 2.0,
    })
}

#[test]
fn a_hand_bends_a_plan_by_its_weight_and_the_plan_waits_for_it() {
    let mut bench = Bench::new();
    let trajectory = half_a_metre();
    let curve = trajectory.curve.clone();
    let lease = bench.lease();
    bench.order(Order::Engage(Engagement {
        ticket: ticket(1),
        model: None,
        source: Source::Play(trajectory),
        scale: 0.2,
        rotation: UnitQuaternion::identity(),
        lease,
    }));
    let go = |bench: &mut Bench, number: u32, bend: Option<Bend>| {
        let (lease, at) = (bench.lease(), Mono(bench.now_ms * MS));
        let bent = bend.map(|bend| Bent {
            bend,
            at,
            sampled_at: at,
        });
        let ticket = ticket(number);
        bench.order(Order::Extend {
            ticket,
            lease,
            bent,
        });
    };
    let beside = |r: &Report| {
        let plan = curve.position_at(r.plan_s.unwrap());
        r.mapping.unplace(r.tip_m) - plan
    };
    let aside = Vector3::new(0.0, 0.1, 0.0);
    let still = HandState::first(Stamp::ZERO, aside);
    let held = Bend {
        plan_s: 1.0,
        rate: 0.0,
        left: Vector3::zeros(),
        held: Some(Held {
            push: Forecast::constant_velocity(&still, &Params::DEFAULT),
            weight: Matrix3::from_diagonal(&Vector3::new(1.0, 0.6, 1.0)),
        }),
    };
    for ms in 2..=1000 {
        bench.tick_at(ms);
        if ms % 100 == 0 {
            go(&mut bench, 1, None);
        }
    }
    // Nobody else's hand, then ours; what is not said again goes on.
    let other = Bend {
        plan_s: 0.0,
        ..held
    };
    go(&mut bench, 2, Some(other));
    assert!((bench.tick_at(1001).plan_s.unwrap() - 0.999).abs() < 1e-9);
    go(&mut bench, 1, Some(held));
    let mut last = None;
    for ms in 1002..=2600 {
        let report = bench.tick_at(ms);
        assert_eq!(report.plan_s, Some(1.0));
        assert_eq!(
            report.state,
            RobotState::Engaged,
            "it is not over while held"
        );
        if ms % 100 == 0 {
            go(&mut bench, 1, None);
        }
        last = Some(report);
    }
    let off = beside(&last.unwrap());
    assert!((off - aside * 0.6).norm() < 1e-3, "{off}");
    // Let go: it decays, and the plan goes on from where it waited.
    let let_go = Bend {
        rate: 1.0,
        left: aside * 0.6,
        held: None,
        ..held
    };
    go(&mut bench, 1, Some(let_go));
    let mut ended_ms = 0;
    for ms in 2601..=5000 {
        let report = bench.tick_at(ms);
        if ms == 2900 {
            let third = beside(&report).norm() / 0.06;
            assert!((third - (-1.0f64).exp()).abs() < 0.05, "{third}");
        }
        if report.cause == Cause::PlanFinished && ended_ms == 0 {
            ended_ms = ms;
        }
        if ms % 100 == 0 {
            go(&mut bench, 1, None);
        }
    }
    // One second of the plan, and 0.3 s to settle.
    assert!((3900..=3903).contains(&ended_ms), "{ended_ms}");
}

#[test]
fn a_lease_that_ended_while_the_servo_stalled_is_not_revived_by_what_waits() {
    let mut bench = Bench::new();
    bench.engage(1, 0.1);
    assert_eq!(bench.tick_at(2).state, RobotState::Engaged);
    bench.track(1);
    let report = bench.tick_at(3000);
    assert_eq!(
        (report.state, report.cause),
        (RobotState::Holding, Cause::LeaseExpired)
    );
    // The same for a request: it waited longer than it was meant for.
    bench.now_ms = 3000;
    bench.engage(2, 0.1);
    let report = bench.tick_at(6000);
    assert_eq!(
        (report.state, report.declined),
        (RobotState::Holding, ticket(2))
    );
}

#[test]
fn a_stop_arrives_through_a_full_ring_and_wins_over_all_that_waits() {
    let mut bench = Bench::new();
    bench.engage(1, 0.1);
    bench.tick_at(2);
    while bench.handle.orders.slots() > 0 {
        bench.track(1);
    }
    bench.handle.brake.stop_here();
    let report = bench.tick_at(3);
    assert_eq!(
        (report.state, report.cause),
        (RobotState::Stopped, Cause::LocalStop)
    );
    bench.order(Order::Reset {
        operator: true,
        stop: Some(report.transitions),
    });
    assert_eq!(
        bench.tick_at(4).state,
        RobotState::Stopped,
        "a local stop is left at the robot"
    );
    bench.order(Order::Reset {
        operator: true,
        stop: None,
    });
    bench.handle.brake.pull(Cause::OperatorStop);
    assert_eq!(
        bench.tick_at(5).state,
        RobotState::Stopped,
        "a stop beats a reset of the same tick"
    );
    let stop = bench.tick_at(6).transitions;
    for (wrong, state) in [(stop - 1, RobotState::Stopped), (stop, RobotState::Ready)] {
        bench.order(Order::Reset {
            operator: true,
            stop: Some(wrong),
        });
        let report = bench.tick_at(7);
        assert_eq!(report.state, state, "reset of stop {wrong} of {stop}");
    }
}

#[test]
fn what_belongs_to_another_engagement_moves_nothing() {
    let mut bench = Bench::new();
    bench.engage(1, 1.0);
    bench.engage(2, 0.05);
    let report = bench.tick_at(2);
    assert_eq!((report.engagement, report.declined), (ticket(1), ticket(2)));
    for ms in (100..=600).step_by(100) {
        bench.now_ms = ms;
        bench.track(2);
        bench.order(Order::Release(ticket(2)));
        let lease = bench.lease();
        bench.order(Order::Extend {
            ticket: ticket(1),
            lease,
            bent: None,
        });
        let report = bench.tick_at(ms);
        assert!(
            report.age_s > f64::from(ms as i32 - 1) * 1e-3 - 1e-9,
            "followed another's sample"
        );
        assert!(matches!(
            report.state,
            RobotState::Engaged | RobotState::Coasting
        ));
    }
    assert_eq!(
        bench.tick_at(660).state,
        RobotState::Holding,
        "another's lease was extended"
    );
}

#[test]
fn engaging_again_and_again_does_not_walk_out_of_the_workspace() {
    let mut bench = Bench::new();
    let workspace = Rig::load(&RigOptions::default()).unwrap().workspace;
    let down = Vector3::new(0.0, 0.0, -0.15);
    let mut farthest_m = 0.0_f64;
    for number in 1..=3 {
        let began = bench.now_ms;
        bench.engage(number, 1.0);
        for ms in began + 1..=began + 2000 {
            let report = bench.tick_at(ms);
            assert_eq!(report.engagement, ticket(number));
            farthest_m = farthest_m.max((report.tip_m - workspace.home_m).norm());
            if ms - began < 1500 {
                let (lease, valid_at) = (bench.lease(), Mono(ms * MS));
                let hand = HandState::first(Stamp::ZERO, HAND_M + down);
                bench.order(Order::Track {
                    ticket: ticket(number),
                    forecast: Forecast::constant_velocity(&hand, &Params::DEFAULT),
                    valid_at,
                    turn: None,
                    grip: None,
                    lease,
                });
            } else {
                bench.order(Order::Release(ticket(number)));
            }
        }
        let report = bench.tick_at(began + 2001);
        assert!(!report.moving);
        let clipped = f64::from(number) * -down.z > workspace.radius_m;
        assert_eq!(report.clamps > 1000, clipped, "{} ticks", report.clamps);
    }
    let over_mm = (farthest_m - workspace.radius_m) * 1e3;
    assert!((-1.0..1.0).contains(&over_mm), "{over_mm} mm beyond");
}

#[test]
fn an_arm_that_has_yet_to_obey_is_not_at_rest_and_not_engaged() {
    let mut options = RigOptions::default();
    options.control.dead_time_s = 0.05;
    let mut bench = Bench::with(&options);
    bench.engage(1, 0.1);
    assert_eq!(bench.tick_at(2).state, RobotState::Engaged);
    let hand = |x: f64| HandState::first(Stamp::ZERO, HAND_M + Vector3::x() * x);
    let far = Forecast::constant_velocity(&hand(0.3), &Params::DEFAULT);
    let lease = bench.lease();
    bench.order(Order::Track {
        ticket: ticket(1),
        forecast: far,
        valid_at: Mono(2 * MS),
        turn: None,
        grip: None,
        lease,
    });
    // The displacement is eased in: after 40 ms it is asked for, and the arm has not moved.
    let still = bench.tick_at(3);
    let mut report = still;
    for ms in 4..60 {
        report = bench.tick_at(ms);
        if report.moving {
            break;
        }
    }
    assert!(report.moving);
    assert!((report.q - still.q).amax() < 1e-9, "not yet");
    bench.order(Order::Release(ticket(1)));
    let from = bench.now_ms + 1;
    let mut rested = None;
    for ms in from..from + 600 {
        let report = bench.tick_at(ms);
        let obeying = report.tip_m != still.tip_m;
        if rested.is_none() && obeying && !report.moving {
            rested = Some((ms, report.q));
        }
    }
    let (_, q) = rested.unwrap();
    let end = bench.tick_at(from + 700);
    assert!((end.q - q).amax() < 1e-4, "what is said to rest rests");
}

/// An arm that is where it was told to be, and keeps what it was told; its driver measures no speed, or has not yet.
struct Told {
    q: Joints,
    told: Arc<Mutex<Vec<Joints>>>,
}

impl Told {
    fn state(&self) -> ArmState {
        ArmState {
            q: self.q,
            ..ArmState::default()
        }
    }
}

impl Manipulator for Told {
    fn sense(&mut self, _now: Mono) -> (ArmState, Option<ArmFault>) {
        (self.state(), None)
    }

    fn act(&mut self, _now: Mono, setpoint: &Setpoint, _dt_s: f64) -> (PlantReport, ArmState) {
        self.q = setpoint.reference.q;
        self.told.lock().unwrap().push(setpoint.reference.qd);
        (PlantReport::default(), self.state())
    }
}

#[test]
fn setpoints_that_move_are_not_engaged_whatever_a_driver_measures() {
    let rig = Rig::load(&RigOptions {
        driver: true,
        ..RigOptions::default()
    })
    .unwrap();
    let most = joint_accelerations(&rig.arm, &rig.home).unwrap();
    let told = Arc::new(Mutex::new(Vec::new()));
    let arm = Told {
        q: rig.home,
        told: told.clone(),
    };
    let (rings, handle) = rings();
    let mut bench = Bench {
        core: rig.servo_before(Box::new(arm), None, rings),
        handle,
        now_ms: 0,
    };
    bench.order(Order::Operator(true));
    let (mut number, mut declined) = (0, 0);
    for (wait_ms, side) in [
        (1, 1.0),
        (2, -1.0),
        (5, 1.0),
        (10, -1.0),
        (20, 1.0),
        (50, -1.0),
    ] {
        // A quick way aside, and rest there: what does not move the tip still returns to the start posture.
        number += 1;
        let aside = HAND_M + Vector3::new(0.0, 1.2 * side, 0.6);
        let aside = HandState::first(Stamp::ZERO, aside);
        bench.engage(number, 0.2);
        for ms in 0..900 {
            bench.tick_at(bench.now_ms + 1);
            if ms % 50 == 0 {
                let (lease, valid_at) = (bench.lease(), Mono(bench.now_ms * MS));
                bench.order(Order::Track {
                    ticket: ticket(number),
                    forecast: Forecast::constant_velocity(&aside, &Params::DEFAULT),
                    valid_at,
                    turn: None,
                    grip: None,
                    lease,
                });
            }
        }
        // Let go, and pressed again.
        bench.order(Order::Release(ticket(number)));
        for _ in 0..wait_ms {
            bench.tick_at(bench.now_ms + 1);
        }
        number += 1;
        bench.engage(number, 0.2);
        declined += u32::from(bench.tick_at(bench.now_ms + 1).declined == ticket(number));
        bench.order(Order::Release(ticket(number)));
        let mut last = None;
        for _ in 0..500 {
            last = Some(bench.tick_at(bench.now_ms + 1));
        }
        assert!(!last.unwrap().moving, "it comes to rest");
    }
    let told = told.lock().unwrap();
    let mut worst = 0.0_f64;
    for pair in told.windows(2) {
        let change = (pair[1] - pair[0]) / 1e-3;
        worst = worst.max(change.component_div(&most).fold(0.0, |a: f64, b| {
            if b.is_finite() { a.max(b.abs()) } else { a }
        }));
    }
    println!("{worst:.3} of the largest acceleration; {declined} declined");
    assert!(worst < 1.001, "{worst}");
    assert!(declined > 0);
}
