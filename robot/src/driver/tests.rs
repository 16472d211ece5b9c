use telemime_endpoint::Mono;
use telemime_sim::arm::Joints;

use super::line::{self, LineError, Said};
use super::*;
use crate::control::JointReference;
use crate::rig::{Rig, RigOptions};

mod gripper;

const MS: i64 = 1_000_000;

struct Bench {
    arm: DriverArm,
    says: rtrb::Producer<Heard>,
    hears: rtrb::Consumer<Sent>,
    now: Mono,
    home: Joints,
}

impl Bench {
    fn new() -> Self {
        let rig = Rig::load(&RigOptions::default()).unwrap();
        let (says, heard) = rtrb::RingBuffer::new(64);
        let (setpoints, hears) = rtrb::RingBuffer::new(8);
        let config = DriverConfig {
            rate_hz: 500.0,
            patience_s: 0.1,
        };
        let state = ArmState {
            q: rig.home,
            opening: Some(0.5),
            ..ArmState::default()
        };
        Self {
            arm: DriverArm::new(rig.arm, config, state, heard, setpoints),
            says,
            hears,
            now: Mono(0),
            home: rig.home,
        }
    }

    fn says(&mut self, q: Joints, qd: Joints, obeyed: u64) {
        let state = ArmState {
            q,
            qd,
            opening: Some(0.5),
        };
        let at = self.now;
        self.says.push(Heard::State { at, state, obeyed }).unwrap();
    }

    /// A millisecond: the servo asks for `q`.
    fn tick(&mut self, q: Joints) -> (ArmState, Option<ArmFault>) {
        self.now = Mono(self.now.0 + MS);
        let sensed = self.arm.sense(self.now);
        let setpoint = Setpoint {
            reference: JointReference {
                q,
                ..JointReference::default()
            },
            tau: Joints::zeros(),
            opening: Some(f64::NAN),
        };
        self.arm.act(self.now, &setpoint, 1e-3);
        sensed
    }

    /// Ticks until there is a fault, the driver obeying `behind` setpoints late and saying so every other tick.
    fn obeys(&mut self, ticks: u64, behind: u64) -> Option<(u64, ArmFault)> {
        let home = self.home;
        for n in 0..ticks {
            if n % 2 == 0 {
                let seq = self.arm.seq.saturating_sub(behind);
                self.says(home, Joints::zeros(), seq);
            }
            while self.hears.pop().is_ok() {}
            if let (_, Some(fault)) = self.tick(home) {
                return Some((n, fault));
            }
        }
        None
    }
}

#[test]
fn a_driver_that_does_what_it_must_is_none_to_complain_of() {
    let mut bench = Bench::new();
    assert_eq!(bench.obeys(1000, 20), None);
    let (state, _) = bench.tick(bench.home);
    assert_eq!((state.q, state.opening), (bench.home, Some(0.5)));
    let sent = bench.hears.pop().unwrap();
    assert_eq!(
        sent.setpoint.opening,
        Some(0.5),
        "where it was, for what is no opening"
    );
    // At rest the torque that goes with a setpoint is what carries the arm.
    let rig = Rig::load(&RigOptions::default()).unwrap();
    let mut dynamics = Dynamics::new();
    dynamics.update(&rig.arm, &rig.home);
    let carried = dynamics.rnea(&Joints::zeros(), &Joints::zeros());
    assert!((sent.setpoint.tau - carried).amax() < 1e-9 && carried.amax() > 1.0);
}

#[test]
fn silence_is_a_fault_after_the_patience_and_for_ever() {
    let mut bench = Bench::new();
    assert_eq!(bench.obeys(100, 2), None);
    let home = bench.home;
    let first = (0..300).find_map(|n| bench.tick(home).1.map(|fault| (n, fault)));
    let Some((n, fault @ ArmFault::Stalled { silent_ms })) = first else {
        panic!("{first:?}");
    };
    assert!(
        (98..=104).contains(&n) && silent_ms == 101,
        "{n}: {silent_ms}"
    );
    assert_eq!(bench.obeys(10, 2), Some((0, fault)), "it does not heal");
}

#[test]
fn a_driver_that_never_says_anything_is_silent_from_the_first_tick_on() {
    let mut bench = Bench::new();
    let home = bench.home;
    let first = (0..300).find_map(|n| bench.tick(home).1.map(|fault| (n, fault)));
    assert!(
        matches!(first, Some((100..=102, ArmFault::Stalled { .. }))),
        "{first:?}"
    );
}

#[test]
fn a_driver_that_is_behind_its_setpoints_lags() {
    let mut bench = Bench::new();
    let first = bench.obeys(1000, 105);
    assert!(
        matches!(first, Some((_, ArmFault::Lagging { .. }))),
        "{first:?}"
    );
    assert_eq!(Bench::new().obeys(1000, 90), None);
    // One that never says what it obeys is as far behind as it can be.
    let first = Bench::new().obeys(1000, u64::MAX);
    assert!(
        matches!(first, Some((_, ArmFault::Lagging { .. }))),
        "{first:?}"
    );
}

#[test]
fn a_setpoint_that_was_never_made_is_not_obeyed() {
    let mut bench = Bench::new();
    assert_eq!(bench.obeys(50, 0), None, "its own newest is");
    let (home, newest) = (bench.home, bench.arm.seq);
    bench.says(home, Joints::zeros(), newest + 1);
    let unmade = ArmFault::Unmade {
        seq: newest + 1,
        newest,
    };
    assert_eq!(bench.tick(home).1, Some(unmade));
}

#[test]
fn a_driver_is_waited_for_during_three_periods_at_least_and_two_seconds_at_most() {
    let refused = |rate_hz, patience_s| DriverConfig::new(rate_hz, patience_s).unwrap_err();
    for patience_s in [0.009, 2.001, 10.0, f64::NAN] {
        let error = refused(1000.0, patience_s);
        assert!(matches!(error, PatienceError::Range { .. }), "{error}");
    }
    let PatienceError::Short { least_s, .. } = refused(10.0, PATIENCE_S) else {
        panic!("a period of 100 ms");
    };
    assert_eq!(least_s, 0.3);
    for rate_hz in [10.0, 25.0, 30.0, 250.0, 1000.0] {
        // The shortest that is allowed is enough for states a period apart, each a tick late, that answer the setpoint of two periods ago.
        let patience_s = (3.0_f64 / rate_hz).max(PATIENCES_S.0);
        let config = DriverConfig::new(rate_hz, patience_s).unwrap();
        let mut bench = Bench::new();
        bench.arm.config = config;
        let period = (1000.0 / rate_hz) as u64;
        for n in 0..20 * period {
            if n % period == n / period % 2 {
                let (home, seq) = (bench.home, bench.arm.seq.saturating_sub(2 * period - 1));
                bench.says(home, Joints::zeros(), seq);
            }
            let home = bench.home;
            assert_eq!(bench.tick(home).1, None, "{rate_hz} Hz, tick {n}");
        }
    }
    // And the longest is remembered to its end.
    let mut bench = Bench::new();
    bench.arm.config = DriverConfig::new(500.0, PATIENCES_S.1).unwrap();
    assert_eq!(bench.obeys(5000, 1990), None);
    let mut bench = Bench::new();
    bench.arm.config = DriverConfig::new(500.0, PATIENCES_S.1).unwrap();
    let (_, fault) = bench.obeys(5000, 2010).unwrap();
    assert!(
        matches!(
            fault,
            ArmFault::Lagging {
                behind_ms: 2001..=2012
            }
        ),
        "{fault}"
    );
}

#[test]
fn what_joints_cannot_do_is_not_believed() {
    let velocity = Bench::new().arm.arm.joints()[0].velocity;
    let upper = Bench::new().arm.arm.joints()[0].upper;
    let told = |dq: f64, qd: f64| {
        let mut bench = Bench::new();
        assert_eq!(bench.obeys(50, 2), None);
        let (mut q, mut speed) = (bench.home, Joints::zeros());
        q[0] += dq;
        speed[0] = qd;
        let seq = bench.arm.seq;
        bench.says(q, speed, seq);
        let home = bench.home;
        bench.tick(home)
    };
    assert_eq!(told(0.01, velocity).1, None);
    let (state, fault) = told(0.3, 0.0);
    assert!(
        matches!(fault, Some(ArmFault::Leapt { joint: 0, .. })),
        "{fault:?}"
    );
    assert!(
        (state.q - Bench::new().home).amax() < 1e-12,
        "the last that was possible"
    );
    let (_, fault) = told(0.0, 2.0 * velocity);
    assert!(
        matches!(fault, Some(ArmFault::TooFast { joint: 0, .. })),
        "{fault:?}"
    );
    let (_, fault) = told(upper + 1.0, 0.0);
    assert!(
        matches!(fault, Some(ArmFault::Outside { joint: 0, .. })),
        "{fault:?}"
    );
    let (_, fault) = told(f64::NAN, 0.0);
    assert!(matches!(fault, Some(ArmFault::Outside { .. })), "{fault:?}");
}

#[test]
fn an_arm_that_stays_behind_where_it_is_told_to_be_is_astray() {
    let mut bench = Bench::new();
    assert_eq!(bench.obeys(50, 0), None);
    let (home, mut told) = (bench.home, bench.home);
    let most = bench.arm.arm.joints()[2].velocity * 0.1 + LEAP;
    let mut first = None;
    for n in 0..1000 {
        told[2] += 1e-3;
        let seq = bench.arm.seq;
        bench.says(home, Joints::zeros(), seq);
        while bench.hears.pop().is_ok() {}
        first = bench.tick(told).1.map(|fault| (n, fault));
        if first.is_some() {
            break;
        }
    }
    let Some((_, ArmFault::Astray { joint: 2, by })) = first else {
        panic!("{first:?}");
    };
    assert!((by.abs() - most).abs() < 3e-3, "{by} of {most}");
}

#[test]
fn a_driver_that_does_not_read_costs_the_tick_nothing_and_is_found_out() {
    let mut bench = Bench::new();
    let home = bench.home;
    bench.tick(home);
    for _ in 0..400 {
        bench.says(home, Joints::zeros(), 1);
        let (_, fault) = bench.tick(home);
        if let Some(fault) = fault {
            assert!(matches!(fault, ArmFault::Lagging { .. }), "{fault}");
            assert_eq!(bench.hears.slots(), 8, "a full ring, and no wait");
            return;
        }
    }
    panic!("it was not found out");
}

#[test]
fn lines_are_understood_or_refused_with_the_reason() {
    let hello = line::hello(br#"{"telemime_driver":1,"joints":["a","b"],"rate_hz":250}"#).unwrap();
    assert_eq!((hello.joints.len(), hello.rate_hz), (2, 250.0));
    let refused = |text: &str| line::hello(text.as_bytes()).unwrap_err();
    let version = refused(r#"{"telemime_driver":2,"joints":["a"],"rate_hz":250}"#);
    assert!(matches!(version, LineError::Version { found: 2 }));
    let rate = refused(r#"{"telemime_driver":1,"joints":["a"],"rate_hz":2}"#);
    assert!(matches!(rate, LineError::Rate { .. }));
    let none = refused(r#"{"telemime_driver":1,"joints":[],"rate_hz":250}"#);
    assert!(matches!(none, LineError::Count { .. }));
    assert!(matches!(refused("hello"), LineError::Json(_)));

    let Ok(Said::State(state, 7)) = line::said(br#"{"q":[1,2],"qd":[0.5,0],"seq":7}"#, 2) else {
        panic!("a state");
    };
    assert_eq!((state.q[1], state.qd[0], state.opening), (2.0, 0.5, None));
    assert!(matches!(
        line::said(br#"{"fault":"too warm"}"#, 2),
        Ok(Said::Fault(text)) if text == "too warm"
    ));
    for bad in [
        "",
        "{}",
        r#"{"q":[1,2],"qd":[0,0]"#,
        r#"{"q":[1,NaN],"qd":[0,0]}"#,
        r#"{"q":[1,1e999],"qd":[0,0]}"#,
        r#"{"q":[1],"qd":[0,0]}"#,
        r#"{"q":[1,2],"qd":[0,0,0]}"#,
        r#"{"q":[1,2],"qd":[0,0],"seq":-1}"#,
        r#"{"q":[1,2],"qd":[0,0],"extra":1}"#,
        "\u{0}\u{1}",
    ] {
        assert!(line::said(bad.as_bytes(), 2).is_err(), "{bad}");
    }
}

#[test]
fn a_setpoint_is_one_line_of_json_that_reads_back_to_the_bit() {
    let mut q = Joints::zeros();
    (q[0], q[1]) = (0.1 + 0.2, -1e-300);
    let sent = Sent {
        seq: 3,
        at: Mono(5),
        setpoint: Setpoint {
            reference: JointReference {
                q,
                ..JointReference::default()
            },
            tau: q * 2.0,
            opening: Some(0.25),
        },
    };
    let mut text = vec![b'x'; 10];
    line::setpoint(&sent, 2, &mut text);
    assert_eq!(text.iter().filter(|b| **b == b'\n').count(), 1);
    let told: serde_json::Value = serde_json::from_slice(&text).unwrap();
    // As text: what reads it back may round.
    let said = String::from_utf8(text.clone()).unwrap();
    assert!(
        said.contains("\"q\":[0.30000000000000004,-1e-300]"),
        "{said}"
    );
    assert_eq!(
        (
            told["seq"].as_u64(),
            told["t_ns"].as_i64(),
            told["opening"].as_f64()
        ),
        (Some(3), Some(5), Some(0.25))
    );
    assert_eq!(told["tau"].as_array().unwrap().len(), 2);
}
