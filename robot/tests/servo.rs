//! What the servo promises whatever the session does: leases end, stops arrive, engagements do not mix.
#![allow(
    clippy::unwrap_used,
    reason = "clippy.toml allows it in tests, but does not know these helpers for tests"
)]

use nalgebra::{UnitQuaternion, Vector3};
use telemime_endpoint::Mono;
use telemime_protocol::predict::{Forecast, HandState, Params};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::{Cause, RobotState};
use telemime_robot::rig::{Rig, RigOptions};
use telemime_robot::servo::{
    Core, Engagement, Handle, Lease, Order, Report, Source, Ticket, rings,
};

const MS: i64 = 1_000_000;

const HAND_M: Vector3<f64> = Vector3::new(0.1, 0.2, 2.0);

struct Bench {
    core: Core,
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
        let (rings, handle) = rings();
        let core = Rig::load(&RigOptions::default()).unwrap().servo(rings);
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
