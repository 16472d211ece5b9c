use std::path::Path;
use std::sync::Arc;

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use telemime_endpoint::Mono;
use telemime_protocol::checkpoint::PoseCurve;
use telemime_protocol::predict::{Bend, Forecast, HandState, Held, Params};
use telemime_protocol::spline::{BSpline, End};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::{Cause, RobotState};
use telemime_sim::arm::ContactPlane;

use super::ticks::width;
use super::*;
use crate::control::{BarrierConfig, ControlConfig, Plane};
use crate::driver::{DriverArm, DriverConfig, Heard, Sent};
use crate::rig::{Rig, RigOptions};
use crate::servo::{
    ArmState, Bent, Engagement, Handle, Lease, Order, Report, Source, Station, Ticket, Trajectory,
    rings,
};

const MS: i64 = 1_000_000;
const TICKET: Ticket = Ticket {
    epoch: 3,
    number: 1,
};

struct Bench {
    station: Station,
    handle: Handle,
    recorder: Recorder,
    now: Mono,
    reports: Vec<Report>,
    driver: Option<Sluggish>,
    due: Option<Due>,
}

/// A driver's arm that goes half of the way to its setpoint every 4 ms.
struct Sluggish {
    says: rtrb::Producer<Heard>,
    hears: rtrb::Consumer<Sent>,
    state: ArmState,
}

impl Sluggish {
    fn obey(&mut self, now: Mono) {
        if now.0 % (4 * MS) != 0 {
            return;
        }
        let mut obeyed = 0;
        while let Ok(sent) = self.hears.pop() {
            let to = sent.setpoint.reference;
            let half = (to.q - self.state.q) * 0.5;
            self.state = ArmState {
                q: self.state.q + half,
                qd: to.qd,
                opening: sent.setpoint.opening,
            };
            obeyed = sent.seq;
        }
        let (at, state) = (now, self.state);
        self.says.push(Heard::State { at, state, obeyed }).unwrap();
    }
}

impl Bench {
    fn new(options: &RigOptions, span_s: f64) -> Self {
        let rig = Rig::load(options).unwrap();
        let (rings, handle) = rings();
        let (station, driver) = if options.driver {
            let (says, heard) = rtrb::RingBuffer::new(64);
            let (setpoints, hears) = rtrb::RingBuffer::new(64);
            let state = ArmState {
                q: rig.home,
                opening: Some(0.7),
                ..ArmState::default()
            };
            let config = DriverConfig {
                rate_hz: 250.0,
                patience_s: 0.1,
            };
            let arm = DriverArm::new(rig.arm.clone(), config, state, heard, setpoints);
            let driver = Sluggish { says, hears, state };
            (
                rig.servo_before(Box::new(arm), Some(0.7), rings),
                Some(driver),
            )
        } else {
            (rig.servo(rings), None)
        };
        let (tap, feed) = taps(&station.room());
        let command = options.driver.then(|| "arm.py".to_owned());
        let mut bench = Self {
            station: station.recorded(tap),
            handle,
            recorder: Recorder::new(Header::new(&rig, command), feed, span_s),
            now: Mono(1_000_000_000),
            reports: Vec::new(),
            driver,
            due: None,
        };
        bench.order(Order::Operator(true));
        bench.ticks(5);
        bench
    }

    fn order(&mut self, order: Order) {
        self.handle.orders.push(order).unwrap();
    }

    fn ticks(&mut self, ms: u32) {
        for _ in 0..ms {
            // No two ticks are the same time apart.
            let uneven = self.reports.len() as i64 * 7919 % 1000;
            self.now = Mono(self.now.0 / MS * MS + MS + uneven);
            if let Some(driver) = &mut self.driver {
                driver.obey(Mono(self.now.0 / MS * MS));
            }
            let report = self.station.tick(self.now);
            self.reports.push(report);
            if self.reports.len().is_multiple_of(50) {
                self.due = self.recorder.drain().or(self.due);
            }
        }
        while self.handle.spent.pop().is_ok() {}
        while self.handle.reports.pop().is_ok() {}
    }

    fn forecast(&self) -> Forecast {
        let t_s = self.now.0 as f64 * 1e-9;
        let hand = |t_s: f64| Vector3::new((2.0 * t_s).sin(), (1.3 * t_s).cos(), 2.0) * 0.5;
        let mut state = HandState::first(Stamp::ZERO, hand(t_s - 0.3));
        for i in 1..=10 {
            let u = 0.03 * f64::from(i);
            state.advance(Stamp::from_secs_f64(u), hand(t_s - 0.3 + u));
        }
        Forecast::constant_velocity(&state, &Params::DEFAULT)
    }

    fn lease(&self) -> Lease {
        Lease {
            from: self.now,
            until: self.now.offset_by_secs(0.65),
        }
    }

    fn engage(&mut self, number: u32, source: Source) {
        let lease = self.lease();
        self.order(Order::Engage(Engagement {
            ticket: Ticket { number, ..TICKET },
            model: Some([0xab; 16]),
            source,
            scale: 0.6,
            rotation: UnitQuaternion::identity(),
            lease,
        }));
    }

    /// Mirrors for `s` seconds, 30 messages a second.
    fn mirror(&mut self, s: f64) {
        let source = Source::Mirror {
            forecast: self.forecast(),
            valid_at: self.now,
            turn: None,
            grip: Some(0.3),
        };
        self.engage(1, source);
        for n in 0..(s * 30.0) as u32 {
            self.ticks(33);
            let (forecast, valid_at, lease) = (self.forecast(), self.now, self.lease());
            self.order(Order::Track {
                ticket: TICKET,
                forecast,
                valid_at,
                turn: None,
                grip: (n % 9 == 0).then_some(0.5),
                lease,
            });
        }
    }

    /// What was written for `cause`.
    fn record(&mut self) -> (Due, BlackBox) {
        let due = self.recorder.drain().or(self.due).unwrap();
        let bytes = self.recorder.draft(due).unwrap().sealed();
        (
            due,
            BlackBox::parse(Path::new("a.blackbox"), &bytes).unwrap(),
        )
    }
}

/// What a replay reports, tick by tick, and what it shows.
fn again(record: &BlackBox) -> (Vec<Report>, Replay) {
    let mut reports = Vec::new();
    let shown = replay(record, |row| {
        reports.push(row.report);
        Ok(())
    })
    .unwrap();
    (reports, shown)
}

fn told(shown: &Replay, words: &str) -> bool {
    shown
        .moments
        .iter()
        .any(|moment| moment.what.contains(words))
}

#[test]
fn a_motion_that_silence_ends_replays_to_the_bit_and_tells_its_story() {
    let mut bench = Bench::new(&RigOptions::default(), SPAN_S);
    bench.mirror(3.0);
    bench.ticks(1500);
    let (due, record) = bench.record();
    assert_eq!(due, Due::Stop(Cause::LeaseExpired));
    let (reports, shown) = again(&record);
    assert_eq!(
        (shown.difference.as_ref(), shown.gaps),
        (None, 0),
        "{shown:?}"
    );
    assert_eq!(shown.ticks as usize, bench.reports.len());
    assert_eq!(reports, bench.reports);
    for words in [
        "an operator has authority",
        "asked to engage #1: mirror at scale 0.600, skill abababababab",
        "Engaged (Requested)",
        "Coasting (NewsLate)",
        "Holding (LeaseExpired)",
        "a limit acted on",
    ] {
        assert!(told(&shown, words), "{words}: {:#?}", shown.moments);
    }
}

#[test]
fn a_record_that_begins_in_the_middle_of_a_motion_replays_from_there() {
    let options = RigOptions {
        control: ControlConfig {
            dead_time_s: 0.02,
            ..ControlConfig::default()
        },
        ..RigOptions::default()
    };
    let mut bench = Bench::new(&options, 2.0);
    bench.mirror(7.3);
    bench.handle.brake.pull(Cause::OperatorStop);
    bench.ticks(700);
    let (due, record) = bench.record();
    assert_eq!(due, Due::Stop(Cause::OperatorStop));
    let (reports, shown) = again(&record);
    assert_eq!(shown.difference, None);
    assert!((2000..3100).contains(&shown.ticks), "{}", shown.ticks);
    assert_eq!(reports[0].state, RobotState::Engaged);
    assert_eq!(
        reports[..],
        bench.reports[bench.reports.len() - reports.len()..]
    );
    assert!(told(&shown, "the record begins: Engaged"));
    assert!(told(&shown, "the brake was pulled: OperatorStop"));
}

#[test]
fn a_motion_pressed_against_a_surface_before_a_plane_replays_to_the_bit() {
    let start = Rig::load(&RigOptions::default()).unwrap().workspace.home_m;
    // The hand goes far to the negative y. 80 mm behind the surface neither tip nor links may go any farther, their hulls among them.
    let surface_m = start.y - 0.05;
    let barrier = BarrierConfig::default()
        .with_plane(Plane::new(Vector3::y(), surface_m - 0.08).unwrap())
        .unwrap();
    let options = RigOptions {
        control: ControlConfig {
            barrier,
            ..ControlConfig::default()
        },
        contact: Some(ContactPlane::new(Vector3::y(), surface_m).unwrap()),
        ..RigOptions::default()
    };
    let mut bench = Bench::new(&options, SPAN_S);
    bench.mirror(3.0);
    bench.ticks(1500);
    let (_, record) = bench.record();
    let (reports, shown) = again(&record);
    assert_eq!(shown.difference, None);
    assert_eq!(reports, bench.reports);
    let pressed = reports.iter().filter(|r| r.tip_m.y < surface_m).count();
    let behind = |r: &&Report| r.target_m.y < surface_m - 0.08;
    let kept = reports.iter().filter(behind).count();
    assert!(pressed > 1000 && kept > 100, "{pressed}, {kept}");
    assert!(reports.iter().all(|r| r.reference_m.y > surface_m - 0.08));
    assert!(told(&shown, "a limit acted on"), "{:#?}", shown.moments);
    // What pushed the arm is not in the record, and what it did is: without the planes the same inputs decide otherwise.
    let mut open = record;
    open.header.control.barrier = BarrierConfig::default();
    assert!(again(&open).1.difference.is_some());
}

#[test]
fn a_played_motion_with_a_hand_beside_it_replays_to_the_bit() {
    let mut bench = Bench::new(&RigOptions::default(), 3.0);
    let t: Vec<f64> = (0..=20).map(|i| f64::from(i) * 0.25).collect();
    let x: Vec<_> = t
        .iter()
        .map(|t| Vector3::new(t.sin(), 0.1 * t, 0.0))
        .collect();
    let trajectory = Arc::new(Trajectory {
        curve: PoseCurve {
            position: BSpline::interpolate(&t, &x, End::Natural).unwrap(),
            orientation: None,
            grip: None,
        },
        duration_s: 5.0,
    });
    bench.engage(1, Source::Play(trajectory));
    for n in 1..=48 {
        bench.ticks(100);
        let held = Held {
            push: bench.forecast(),
            weight: Matrix3::identity() * 0.01,
        };
        let bend = Bend {
            plan_s: 0.1 * f64::from(n),
            rate: 1.0,
            left: Vector3::zeros(),
            held: Some(held),
        };
        let (at, lease) = (bench.now, bench.lease());
        bench.order(Order::Extend {
            ticket: TICKET,
            lease,
            bent: (n > 20).then_some(Bent {
                bend,
                at,
                sampled_at: at,
            }),
        });
    }
    bench.handle.brake.stop_here();
    bench.ticks(700);
    let (_, record) = bench.record();
    let (reports, shown) = again(&record);
    assert_eq!(shown.difference, None);
    assert!(
        reports[0].plan_s.is_some(),
        "it begins while the plan is played"
    );
    assert_eq!(
        reports[..],
        bench.reports[bench.reports.len() - reports.len()..]
    );
}

#[test]
fn a_drivers_joint_states_and_its_failure_are_inputs() {
    let options = RigOptions {
        driver: true,
        ..RigOptions::default()
    };
    let mut bench = Bench::new(&options, SPAN_S);
    bench.mirror(2.0);
    bench.driver = None;
    bench.ticks(2300);
    let (due, record) = bench.record();
    assert_eq!(due, Due::Stop(Cause::ArmFault));
    assert_eq!(record.header.driver.as_deref(), Some("arm.py"));
    let (reports, shown) = again(&record);
    assert_eq!(shown.difference, None);
    assert_eq!(reports, bench.reports);
    assert!(told(&shown, "Engaged"), "{:#?}", shown.moments);
    assert!(told(
        &shown,
        "the driver has not told the joints' state for 100 ms"
    ));
}

#[test]
fn ticks_that_are_lost_are_a_gap_and_not_a_difference() {
    let mut bench = Bench::new(&RigOptions::default(), SPAN_S);
    bench.mirror(2.0);
    // The recorder stalls for longer than the rings hold.
    for _ in 0..6000 {
        bench.now = Mono(bench.now.0 + MS);
        bench.station.tick(bench.now);
    }
    bench.ticks(50);
    bench.mirror(1.0);
    bench.handle.brake.stop_here();
    bench.ticks(500);
    let (_, record) = bench.record();
    let (_, shown) = again(&record);
    assert_eq!((shown.difference, shown.gaps), (None, 1));
    // The rings hold 4096 of the 6000; the others wait for a state to begin with again.
    let missing = bench.recorder.missing();
    let lacking = bench.reports.len() as u64 + 6000 - shown.ticks;
    assert_eq!(missing, lacking);
    assert!(missing >= 6000 - 4096 - 50, "{missing}");
    assert_eq!(bench.recorder.missing(), 0);
}

#[test]
fn a_difference_is_found_at_its_tick() {
    let mut bench = Bench::new(&RigOptions::default(), SPAN_S);
    bench.mirror(3.0);
    bench.ticks(1500);
    let (_, record) = bench.record();
    let width = width(record.header.home.len());

    let mut altered = record.clone();
    // One bit of the target's x in the 300th tick of the second second.
    altered.chunks[1].words[300 * width + 6] ^= 1;
    let (_, shown) = again(&altered);
    let first = shown.difference.unwrap();
    assert_eq!((first.tick, first.what.as_str()), (1300, "the target"));
    assert_eq!(shown.differing, 700, "each to the end of its chunk");

    let mut altered = record.clone();
    let (at, _) = altered.chunks[1].orders.remove(10);
    let (_, shown) = again(&altered);
    let first = shown.difference.unwrap();
    assert_eq!(first.tick, 1000 + u64::from(at), "an order less");

    let mut altered = record;
    altered.header.control.omega = 44.0;
    let (_, shown) = again(&altered);
    assert!(shown.difference.is_some(), "another arm");
}

#[test]
fn what_is_foreign_cut_off_or_damaged_is_refused() {
    let mut bench = Bench::new(&RigOptions::default(), SPAN_S);
    bench.mirror(0.5);
    bench.ticks(1200);
    let due = bench.recorder.drain().or(bench.due).unwrap();
    let good = bench.recorder.draft(due).unwrap().sealed();
    let path = Path::new("a.blackbox");
    let read = |bytes: &[u8]| BlackBox::parse(path, bytes);
    assert!(read(&good).is_ok());
    for foreign in [
        &b""[..],
        b"telemime skill, format 1\n",
        b"\n",
        &[0xff; 4000],
    ] {
        assert!(matches!(read(foreign), Err(ReadError::Foreign { .. })));
    }
    let body = good.iter().position(|b| *b == b'\n').unwrap() + 1;
    for cut in [
        body,
        body + 1,
        good.len() / 2,
        good.len() - 33,
        good.len() - 1,
    ] {
        assert!(
            matches!(read(&good[..cut]), Err(ReadError::Truncated { .. })),
            "{cut}"
        );
    }
    for at in (body..good.len()).step_by(good.len() / 97) {
        let mut bad = good.clone();
        bad[at] ^= 0x10;
        assert!(matches!(read(&bad), Err(ReadError::Damaged { .. })), "{at}");
    }
    let mut longer = good.clone();
    longer.push(0);
    assert!(matches!(read(&longer), Err(ReadError::Damaged { .. })));
    let newer = [b"telemime black box, format 2; ", &good[30..]].concat();
    assert!(matches!(
        read(&newer),
        Err(ReadError::Format { found: 2, .. })
    ));
    let missing = BlackBox::load(Path::new("no/such.blackbox"));
    assert!(matches!(missing, Err(ReadError::Io { .. })));
}

#[test]
fn a_checksum_that_fits_makes_no_record_of_what_is_none() {
    use sha2::{Digest, Sha256};
    let whole = |body: &[u8]| {
        let line = format!(
            "telemime black box, format 1; request; {} bytes and sha256 follow\n",
            body.len()
        );
        let mut bytes = [line.as_bytes(), body].concat();
        let hash = Sha256::digest(&bytes);
        bytes.extend(hash);
        BlackBox::parse(Path::new("a.blackbox"), &bytes)
    };
    assert!(matches!(whole(b""), Err(ReadError::Damaged { .. })));
    assert!(matches!(whole(&[0xff; 64]), Err(ReadError::Damaged { .. })));
    assert!(matches!(
        whole(&[3, 0, 0, 0, 1, 2, 3, 0, 0, 0, 0]),
        Err(ReadError::Content { .. })
    ));
}

#[test]
fn files_are_whole_numbered_and_never_overwritten() {
    let dir = tempfile::tempdir().unwrap();
    let due = Due::Stop(Cause::LeaseExpired);
    let first = file::write(dir.path(), due, b"one").unwrap();
    let second = file::write(dir.path(), due, b"two").unwrap();
    assert!(
        first.ends_with("0001-stop-leaseexpired.blackbox"),
        "{first:?}"
    );
    assert!(second.ends_with("0002-stop-leaseexpired.blackbox"));
    assert_eq!(std::fs::read(&first).unwrap(), b"one");
    assert_eq!(
        std::fs::read_dir(dir.path()).unwrap().count(),
        2,
        "and nothing else"
    );
    assert!(file::has_room(due, 1000, 1000 + (256 << 20)));
    assert!(!file::has_room(due, 1000, 999 + (256 << 20)));
    assert!(file::has_room(Due::Request, 1000, 1000), "who asks decides");
    let gone = dir.path().join("gone");
    let error = file::write(&gone, due, b"three").unwrap_err();
    assert!(
        error.to_string().contains("choose another --black-box"),
        "{error}"
    );
}
