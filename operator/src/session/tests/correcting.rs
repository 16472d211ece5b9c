//! A hand that corrects what is played: what it says to the robot, and when.

use super::commands::state;
use super::*;
use telemime_protocol::checkpoint::{PosePlan, select};
use telemime_protocol::predict::Bend;

const DEVIATION_M: f64 = 0.04;

/// Straight on at 0.2 m/s for ten seconds.
fn ten_seconds() -> PosePlan {
    let t: Vec<f64> = (0..=100).map(|i| f64::from(i) * 0.1).collect();
    let x: Vec<_> = t
        .iter()
        .map(|t| home() + Vector3::x() * (0.2 * t))
        .collect();
    select::bounded(&t, &x, 1e-3).unwrap().into()
}

/// A play that may be corrected, engaged at 1 s.
fn playing(leeway: Option<&Leeway>) -> Bench {
    let mut bench = Bench::ready(SessionConfig::default(), None);
    bench.session.play(&ten_seconds(), leeway);
    bench.hears(&RobotControl::PlanStored { id: 1 });
    bench.hears(&RobotControl::Engaged {
        engagement: 1,
        t_us: bench.now.0 / 1000,
        hand_m: [0.0; 3],
        tip_m: [0.0; 3],
        hand_q: None,
        tip_q: WireRotation::default(),
    });
    bench.receives(&RobotDatagram::Telemetry(telemetry(1, 0)));
    bench.idle(500);
    bench.forget();
    bench
}

fn corrected() -> Bench {
    playing(Some(&Leeway::even(DEVIATION_M)))
}

impl Bench {
    /// What the newest go makes of the plan, and when it was sent.
    fn bend(&self) -> Option<(Bend, Stamp)> {
        self.datagrams.iter().rev().find_map(|d| match d {
            OperatorDatagram::Go { bend, t_us, .. } => {
                Some((bend.as_ref()?.dequantise(), Stamp(t_us * 1000)))
            }
            _ => None,
        })
    }

    fn changes(&self) -> Vec<Change> {
        let change = |e: &Event| match e {
            Event::Correction(change) => Some(*change),
            _ => None,
        };
        self.events.iter().filter_map(change).collect()
    }

    fn bents(&self) -> Vec<Bent> {
        let bent = |e: &Event| match e {
            Event::Bent(bent) => Some(*bent),
            _ => None,
        };
        self.events.iter().filter_map(bent).collect()
    }

    /// Moves the hand evenly to `way` from where it took hold, and keeps it there, 33 ms a sample.
    fn push(&mut self, way: Vector3<f64>, moving: u32, still: u32) {
        for i in 0..=moving + still {
            let u = (f64::from(i) / f64::from(moving)).min(1.0);
            self.sample(Vector3::new(5.0, 5.0, 5.0) + way * u);
        }
    }
}

#[test]
fn a_plan_is_not_bent_before_a_hand_takes_hold_nor_where_it_may_not() {
    let mut bench = corrected();
    bench.idle(1000);
    assert!(bench.datagrams.len() >= 9 && bench.bend().is_none());

    let mut bench = playing(None);
    bench.push(Vector3::y() * 0.2, 10, 10);
    assert!(bench.bend().is_none() && bench.changes().is_empty());
    bench.session.let_go(bench.now);
    bench.drain();
    assert!(bench.changes().is_empty());
}

#[test]
fn a_hand_bends_the_plan_by_its_share_and_its_time_goes_on_as_engaged() {
    let mut bench = corrected();
    let engaged = Stamp(bench.now.0 - 500 * MS);
    bench.push(Vector3::y() * 0.08, 10, 30);
    assert_eq!(bench.changes(), [Change::Grabbed]);
    let (bend, sent) = bench.bend().unwrap();
    // A push to the side neither halts nor hastens.
    assert_eq!(bend.rate, 1.0);
    assert!((bend.plan_s - sent.secs_since(engaged)).abs() < 1e-3);
    // λ/(λ + σ²) of 8 cm, quantised.
    let share = DEVIATION_M.powi(2) / (DEVIATION_M.powi(2) + 0.02f64.powi(2));
    let offset = bend.offset_at(0.17, 0.17);
    assert!(
        (offset - Vector3::y() * (share * 0.08)).norm() < 1e-3,
        "{offset}"
    );
    let first = bench.bents()[0];
    assert_eq!((first.share, first.offset_m), (0.0, Vector3::zeros()));
    // At rest it has nothing to say but that it goes on.
    bench.forget();
    bench.push(Vector3::y() * 0.0, 1, 0);
    bench.forget();
    for _ in 0..30 {
        bench.sample(Vector3::new(5.0, 5.0, 5.0));
    }
    assert!(bench.datagrams.len() < 16, "{}", bench.datagrams.len());
}

#[test]
fn what_is_let_go_decays_from_where_the_robot_has_it_when_it_hears() {
    let mut bench = corrected();
    bench.push(Vector3::y() * 0.08, 10, 4);
    let (before, told) = bench.bend().unwrap();
    bench.session.let_go(bench.now);
    bench.drain();
    let (after, now) = bench.bend().unwrap();
    assert_eq!((after.held, now), (None, bench.now));
    // 100 ms of delay and 70 ms of lag.
    let arrival = 0.17;
    let since_s = now.secs_since(told) + arrival;
    let sampled_s = arrival + now.secs_since(told);
    let jump = after.offset_at(arrival, 0.0) - before.offset_at(since_s, sampled_s);
    assert!(jump.norm() < 2e-4, "{jump}");
    assert!(before.offset_at(since_s, sampled_s).norm() > 0.05);
    assert!((after.plan_at(arrival) - before.plan_at(since_s)).abs() < 1e-3);
    assert_eq!(bench.changes(), [Change::Grabbed, Change::Released]);
    // A hand that takes hold again begins where that one is.
    let left = after.offset_at(arrival + 0.2, 0.0);
    bench.idle(200);
    bench.sample(Vector3::zeros());
    let (again, _) = bench.bend().unwrap();
    assert!((again.offset_at(arrival, arrival) - left).norm() < 0.01);
    bench.session.let_go(bench.now);
    bench.idle(3000);
    let (rest, _) = bench.bend().unwrap();
    assert!(rest.is_over(0.0) && rest.rate == 1.0);
}

#[test]
fn a_hand_that_insists_takes_over_and_the_plan_waits() {
    // 3.37 deviations of the two together: 15 cm.
    let mut bench = corrected();
    bench.push(Vector3::y() * 0.12, 6, 30);
    assert_eq!(bench.changes(), [Change::Grabbed]);
    // For 130 ms only.
    for way in [0.2, 0.2, 0.2, 0.2, 0.1, 0.1] {
        bench.sample(Vector3::new(5.0, 5.0 + way, 5.0));
    }
    assert_eq!(bench.changes(), [Change::Grabbed]);
    for _ in 0..30 {
        bench.sample(Vector3::new(5.0, 5.2, 5.0));
    }
    assert_eq!(bench.changes(), [Change::Grabbed, Change::TakenOver]);
    let (bend, _) = bench.bend().unwrap();
    assert!(bend.rate < 0.1, "{}", bend.rate);
    let offset = bend.offset_at(0.17, 0.17);
    assert!((offset - Vector3::y() * 0.2).norm() < 2e-3, "{offset}");
    let bents = bench.bents();
    let steps = bents.windows(2).map(|w| (w[1].share - w[0].share).abs());
    assert!(steps.fold(0.0, f64::max) < 0.5);
    // Let go, the skill goes on.
    bench.session.let_go(bench.now);
    bench.idle(3000);
    let (bend, _) = bench.bend().unwrap();
    assert!(bend.rate > 0.98 && bend.is_over(0.0));
}

#[test]
fn a_hand_behind_slows_the_plan_and_one_before_hastens_it_within_limits() {
    let rate = |way: f64| {
        let mut bench = corrected();
        bench.push(Vector3::x() * way, 6, 60);
        let (bend, _) = bench.bend().unwrap();
        let all = bench.bents();
        assert!(all.iter().all(|b| (0.0..=1.5).contains(&b.rate)));
        // The plan's time never jumps, whatever its rate does.
        for w in all.windows(2) {
            let dt_s = w[1].at.secs_since(w[0].at);
            let step_s = w[1].plan_s - w[0].plan_s;
            assert!(
                (-1e-6..=1.5 * dt_s + 1e-6).contains(&step_s),
                "{step_s} in {dt_s}"
            );
        }
        bend.rate
    };
    let together = (DEVIATION_M.powi(2) + 0.02f64.powi(2)).sqrt();
    assert!((rate(-0.5 * together) - 0.75).abs() < 0.02);
    assert_eq!(rate(-2.2 * together), 0.0);
    assert!((rate(0.4 * together) - 1.2).abs() < 0.02);
    assert!((rate(1.5 * together) - 1.5).abs() < 0.01);
}

#[test]
fn a_hand_that_is_lost_has_let_go_and_nonsense_is_dropped_and_counted() {
    let mut bench = corrected();
    bench.push(Vector3::y() * 0.08, 10, 4);
    let dropped = bench.session.counters().dropped;
    let mut sample = HandSample::at(bench.now, Vector3::zeros());
    bench.session.handle_sample(bench.now, sample);
    sample.t = Stamp(bench.now.0 + MS);
    sample.x[2] = f64::NAN;
    bench.session.handle_sample(bench.now, sample);
    assert_eq!(bench.session.counters().dropped, dropped + 2);
    bench.forget();
    bench.idle(200);
    assert!(bench.changes().is_empty());
    bench.idle(100);
    assert_eq!(bench.changes(), [Change::Lost]);
    assert_eq!(bench.bend().unwrap().0.held, None);
    // A hand that comes from elsewhere later begins anew.
    bench.forget();
    bench.sample(Vector3::new(-9.0, 0.0, 9.0));
    assert_eq!(bench.changes(), [Change::Grabbed]);
    let (bend, _) = bench.bend().unwrap();
    assert!(bend.offset_at(0.17, 0.17).norm() < 0.08);
    // When the robot holds, that is the end of it.
    bench.hears(&state(RobotState::Holding, Cause::LeaseExpired));
    bench.forget();
    bench.push(Vector3::y(), 3, 3);
    assert!(bench.datagrams.is_empty() && bench.changes().is_empty());
}
