//! Glitches, the input's latency, what was driven, and a skill that changes.

use super::*;
use nalgebra::UnitQuaternion;
use telemime_protocol::checkpoint::path::pose;
use telemime_protocol::predict::Forecast;

/// Where the newest motion says the hand is.
fn said(bench: &Bench) -> Vector3<f64> {
    let motions = bench.motions();
    motions.last().unwrap().state.dequantise().x
}

/// Every sample is told, and the path within 1 mm.
fn telling(glitch_gate: bool) -> SessionConfig {
    SessionConfig {
        future_bound: FutureBound::Absolute(0.0),
        path_bound_m: Some(1e-3),
        min_interval_s: 0.0,
        glitch_gate,
        ..SessionConfig::default()
    }
}

fn along(i: i32) -> Vector3<f64> {
    home() + Vector3::x() * (0.02 * f64::from(i))
}

const STRAY: Vector3<f64> = Vector3::new(0.1, 0.5, 0.0);

#[test]
fn one_or_two_stray_samples_never_leave_and_a_third_is_what_the_hand_does() {
    for running in 1..=3 {
        let mut bench = Bench::engaged(telling(true), None);
        (0..20).for_each(|i| bench.sample(along(i)));
        assert_eq!(bench.session.counters().glitches, 0);
        for i in 20..20 + running {
            bench.forget();
            bench.sample(along(i) + STRAY);
            let strayed = bench.motions().iter().any(|m| {
                let x = m.state.dequantise().x;
                (x - along(i)).norm() > 0.1
            });
            assert_eq!(strayed, i == 22, "only the third is believed");
        }
        let glitches = if running < 3 { running as u32 } else { 0 };
        // What follows shows which it was: back on its way, or on from there.
        let to = |i: i32| along(i) + if running < 3 { Vector3::zeros() } else { STRAY };
        (20 + running..40).for_each(|i| bench.sample(to(i)));
        assert_eq!(bench.session.counters().glitches, glitches, "{running}");
        // What is predicted within a millimetre is not said again.
        let motions = bench.motions();
        let told = motions.last().unwrap();
        let state = told.state.dequantise();
        let known = Forecast::constant_velocity(&state, &told.params.dequantise());
        let now = known.at(bench.now.secs_since(state.t)).position;
        assert!((now - to(39)).norm() < 0.01, "{running}: {now} {}", to(39));
        let mut off = Bench::engaged(telling(false), None);
        off.sample(along(0));
        off.sample(along(1) + STRAY);
        assert!(
            (said(&off) - along(1) - STRAY).norm() < 1e-3,
            "switched off"
        );
        assert_eq!(off.session.counters().glitches, 0);
    }
}

#[test]
fn the_path_waits_for_the_truth() {
    for running in [2, 3] {
        let mut bench = Bench::engaged(telling(true), None);
        (0..20).for_each(|i| bench.sample(along(i)));
        let to = |i: i32| match (i < 20 + running, running) {
            (false, 2) => along(i),
            _ => along(i) + STRAY,
        };
        let mut seen = Vec::new();
        for i in 20..40 {
            bench.sample(to(i));
            seen.push((bench.now, to(i)));
        }
        bench.session.release();
        bench.drain();
        let path = super::path::by_stream(&bench.control, 1e-3);
        for (i, (t, x)) in seen.iter().enumerate() {
            let glitch = running == 2 && i < 2;
            let off_m = (pose::place(&path.eval(*t).unwrap().x) - x).norm();
            if glitch {
                assert!(off_m > 0.4, "a glitch is no part of the path: {off_m}");
            } else {
                assert!(off_m <= 1e-3 + 1e-9, "{running}, sample {i}: {off_m}");
            }
        }
    }
}

#[test]
fn a_wrist_that_flips_for_a_frame_does_not_turn_the_tool() {
    let mut bench = Bench::engaged(telling(true), None);
    let sample = |bench: &mut Bench, i: i32, turned: f64| {
        bench.idle(33);
        let mut sample = HandSample::at(bench.now, along(i));
        sample.orientation = Some(UnitQuaternion::from_euler_angles(0.0, 0.0, turned));
        bench.session.handle_sample(bench.now, sample);
        bench.drain();
        let motions = bench.motions();
        motions.last().unwrap().pose.turn.unwrap()
    };
    for i in 0..20 {
        sample(&mut bench, i, 0.01 * f64::from(i));
    }
    sample(&mut bench, 20, 3.0);
    let told = sample(&mut bench, 21, 0.21).dequantise(Stamp::ZERO);
    assert!(
        told.q
            .angle_to(&UnitQuaternion::from_euler_angles(0.0, 0.0, 0.21))
            < 0.02
    );
    assert_eq!(bench.session.counters().glitches, 1);
}

#[test]
fn latency_makes_samples_older_and_horizons_longer_and_counts_once() {
    const LATENCY_S: f64 = 0.06;
    let config = SessionConfig {
        input_latency_s: LATENCY_S,
        ..telling(true)
    };
    let mut bench = Bench::ready(config, None);
    for i in 0..10 {
        bench.sample(along(i));
    }
    bench.session.engage(bench.now);
    bench.drain();
    let Some(OperatorControl::Engage(engage)) = bench.control.last() else {
        panic!("{:?}", bench.control)
    };
    assert_eq!(engage.t_us, bench.now.0 / 1000, "asked now");
    let Drive::Mirror { state, .. } = &engage.drive else {
        panic!("{:?}", engage.drive)
    };
    let age_s = |t: Stamp, bench: &Bench| bench.now.secs_since(t);
    assert!((age_s(state.dequantise().t, &bench) - LATENCY_S).abs() < 1e-6);
    bench.sample(along(10));
    let motion = bench.motions().last().unwrap().clone();
    assert!((age_s(motion.state.dequantise().t, &bench) - LATENCY_S).abs() < 1e-6);
    // The age that the robot measures contains the latency; the network's share is the rest.
    bench.receives(&RobotDatagram::Telemetry(telemetry(1, 0)));
    assert!((bench.session.delay_s - 0.1).abs() < 1e-12);
    assert!((bench.session.network_delay_s() - 0.04).abs() < 1e-12);
}

#[test]
fn what_was_driven_is_kept_without_glitches_and_without_rest() {
    let mut bench = Bench::engaged(telling(true), None);
    assert!(bench.session.driven().is_empty());
    for i in 0..20 {
        let mut sample = HandSample::at(bench.now, along(i));
        bench.idle(33);
        sample.t = bench.now;
        sample.resting = i < 5;
        if i == 10 {
            sample.x += STRAY;
        }
        bench.session.handle_sample(bench.now, sample);
    }
    bench.session.release();
    let driven = bench.session.driven();
    let expected: Vec<_> = (5..20).filter(|i| *i != 10).map(along).collect();
    let got: Vec<_> = driven.iter().map(|s| s.x).collect();
    assert_eq!(got, expected);
    // What is refused was not driven.
    bench.session.engage(bench.now);
    bench.sample(along(3));
    bench.hears(&RobotControl::Refused {
        reason: Refusal::Moving,
    });
    assert_eq!(bench.session.driven().len(), expected.len());
}

#[test]
fn a_new_skill_waits_until_nothing_is_driven() {
    let (old, new) = (example(2, 24), Arc::new(example(3, 24)));
    let id = new.id().0;
    let mut bench = Bench::engaged(SessionConfig::default(), Some(old.clone()));
    bench.session.replace_skill(Arc::clone(&new));
    (0..10).for_each(|i| bench.sample(along(i)));
    let tag = telemime_protocol::wire::v1::model_tag(&old.id().0);
    assert!(bench.motions().iter().all(|m| m.model == tag));
    assert!(bench.control.is_empty(), "not while the arm follows");
    bench.session.release();
    bench.drain();
    let [
        ..,
        OperatorControl::Release { .. },
        OperatorControl::Model { id: sent, .. },
    ] = &bench.control[..]
    else {
        panic!("{:?}", bench.control)
    };
    assert_eq!(*sent, id);
    assert!(!bench.session.is_ready());
    bench.hears(&RobotControl::ModelStored { id });
    assert!(bench.session.is_ready());
    bench.forget();
    // With nothing driven it goes at once.
    let newest = Arc::new(old);
    bench.session.replace_skill(Arc::clone(&newest));
    bench.drain();
    assert!(
        matches!(&bench.control[..], [OperatorControl::Model { id, .. }] if *id == newest.id().0)
    );
}
