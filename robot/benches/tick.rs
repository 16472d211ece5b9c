//! What a tick of the servo costs, simulated arm included: `cargo bench -p telemime-robot --bench tick`.
//!
//! Mean and percentiles over a minute of a mirrored hand at ten messages a second, in the middle of the workspace and pressed against a plane: a bench of
//! averages would not show the worst one in a hundred.

use std::time::Instant;

use nalgebra::{UnitQuaternion, Vector3};
use telemime_endpoint::Mono;
use telemime_protocol::predict::{Forecast, HandState, Params};
use telemime_protocol::time::Stamp;
use telemime_robot::control::{BarrierConfig, ControlConfig, Plane};
use telemime_robot::rig::{Rig, RigOptions};
use telemime_robot::servo::{Engagement, Lease, Order, Source, Ticket, rings};

const TICK_NS: i64 = 1_000_000;

/// What the hand's newest sample predicts.
fn forecast(now: Mono) -> Forecast {
    let t_s = now.0 as f64 * 1e-9;
    let hand = |t_s: f64| Vector3::new((5.0 * t_s).sin(), (3.0 * t_s).cos(), (4.0 * t_s).sin());
    let mut state = HandState::first(Stamp::ZERO, hand(t_s - 1.0));
    for i in 1..=30 {
        let u = f64::from(i) / 30.0;
        state.advance(Stamp::from_secs_f64(u), hand(t_s - 1.0 + u));
    }
    Forecast::constant_velocity(&state, &Params::DEFAULT)
}

fn run(what: &str, scale: f64, barrier: BarrierConfig) {
    let options = RigOptions {
        control: ControlConfig {
            barrier,
            ..ControlConfig::default()
        },
        ..RigOptions::default()
    };
    let rig = Rig::load(&options).expect("the built-in arm");
    let (rings, mut handle) = rings();
    let mut core = rig.servo(rings);
    let ticket = Ticket {
        epoch: 1,
        number: 1,
    };
    let lease = |now: Mono| Lease {
        from: now,
        until: now.offset_by_secs(0.65),
    };
    let mut order = |order| handle.orders.push(order).expect("the ring has room");
    let mut now = Mono(TICK_NS);
    order(Order::Operator(true));
    core.tick(now);
    order(Order::Engage(Engagement {
        ticket,
        model: None,
        source: Source::Mirror {
            forecast: forecast(now),
            valid_at: now,
            turn: None,
            grip: None,
        },
        scale,
        rotation: UnitQuaternion::identity(),
        lease: lease(now),
    }));
    let mut took_ns = Vec::with_capacity(60_000);
    for tick in 0..60_000 {
        now = Mono(now.0 + TICK_NS);
        if tick % 100 == 50 {
            order(Order::Track {
                ticket,
                forecast: forecast(now),
                valid_at: now,
                turn: None,
                grip: None,
                lease: lease(now),
            });
        }
        let begin = Instant::now();
        std::hint::black_box(core.tick(now));
        took_ns.push(begin.elapsed().as_nanos() as f64);
        // The session's end of the ring.
        while handle.reports.pop().is_ok() {}
    }
    took_ns.sort_by(f64::total_cmp);
    let at = |share: f64| took_ns[(share * took_ns.len() as f64) as usize] * 1e-3;
    let mean = took_ns.iter().sum::<f64>() / took_ns.len() as f64 * 1e-3;
    println!(
        "{what}: mean {mean:.2} µs, p50 {:.2}, p99 {:.2}, p99.9 {:.2}",
        at(0.5),
        at(0.99),
        at(0.999)
    );
}

fn main() {
    let open = BarrierConfig {
        self_collision: false,
        ..BarrierConfig::default()
    };
    run("nothing kept apart", 0.1, open);
    run("links kept apart", 0.1, BarrierConfig::default());
    let rig = Rig::load(&RigOptions::default()).expect("the built-in arm");
    let floor_m = rig.workspace.home_m.z - 0.03;
    let floor = Plane::new(Vector3::z(), floor_m).expect("a plane");
    let floor = BarrierConfig::default().with_plane(floor).expect("room");
    run("pressed against a plane", 0.1, floor);
}
