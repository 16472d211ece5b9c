//! Limits of the tip: speed, acceleration, turning.

use super::*;

/// Uniform in [−1, 1).
fn noise(seed: u64) -> impl FnMut() -> f64 {
    let mut state = seed;
    move || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as f64 / (1_u64 << 30) as f64 - 1.0
    }
}

/// Targets that jump about the edge of the workspace, stay for a time and jump again: the largest speed and acceleration of the joints' reference and
/// of the simulated arm, each at the tip.
fn jumps(seed: u64, every: usize, radius: f64) -> [(f64, f64); 2] {
    let mut rig = rig(&ControlConfig::default());
    let mut unit = noise(seed);
    let mut kinematics = Kinematics::new();
    let mut tips: [Vec<Vector3<f64>>; 2] = Default::default();
    let mut target = rig.start;
    for tick in 0..8000 {
        if tick % every == 0 {
            let direction = Vector3::from_fn(|_, _| unit());
            target = rig.start + direction.normalize() * radius;
        }
        let out = rig.follow(target);
        kinematics.update(&rig.arm, &out.setpoint.q);
        tips[0].push(kinematics.tip());
        tips[1].push(out.tip);
        let beyond = (out.tip - rig.start).norm() - radius;
        assert!(beyond < 1e-3, "{beyond} m beyond where any target was");
    }
    tips.map(|tip| {
        let speeds: Vec<_> = tip.windows(2).map(|w| (w[1] - w[0]) / DT).collect();
        let harder = speeds.windows(2).map(|w| ((w[1] - w[0]) / DT).norm());
        (
            speeds.iter().map(|v| v.norm()).fold(0.0, f64::max),
            harder.fold(0.0, f64::max),
        )
    })
}

#[test]
fn limits_hold_at_the_tip_wherever_the_target_jumps() {
    let limits = *rig(&ControlConfig::default()).controller.limits();
    for (seed, every, radius) in [(1, 400, 0.2), (2, 250, 0.2), (3, 120, 0.2), (4, 600, 0.1)] {
        let [reference, arm] = jumps(seed, every, radius);
        println!(
            "every {every} ms, {radius} m: reference {reference:?}, arm {arm:?} of {limits:?}"
        );
        for (speed, acceleration) in [reference, arm] {
            assert!(speed <= limits.v_max * 1.01, "{speed} m/s");
            assert!(acceleration <= limits.a_max * 1.15, "{acceleration} m/s²");
        }
    }
}

#[test]
fn limits_of_turning_hold_at_the_tip_wherever_the_target_turns() {
    for (seed, every, radius) in [
        (1, 400, 0.0),
        (2, 250, 0.03),
        (3, 120, 0.03),
        (4, 700, 0.0),
        (5, 400, 0.15),
    ] {
        let mut rig = rig(&ControlConfig::default());
        let TurnLimits { v_max, a_max, .. } = *rig.controller.turn_limits();
        let upright = rig.controller.turn_reference().orientation;
        let mut unit = noise(seed);
        let mut kinematics = Kinematics::new();
        let (mut target, mut turn) = (rig.start, upright);
        let mut before = [(upright, Vector3::zeros()); 2];
        let mut most = [(0.0_f64, 0.0_f64); 2];
        let mut off = 0.0_f64;
        for tick in 0..8000 {
            if tick % every == 0 {
                target = rig.start + Vector3::from_fn(|_, _| unit()).normalize() * radius;
                let axis = Vector3::from_fn(|_, _| unit());
                turn = UnitQuaternion::from_scaled_axis(axis.normalize() * 0.6) * upright;
            }
            let out = rig.tick(Demand::Follow {
                target,
                orientation: Some(turn),
                speed_scale: 1.0,
            });
            off = off.max((out.tip - out.reference.p).norm());
            kinematics.update(&rig.arm, &out.setpoint.q);
            let asked = resolve::quaternion(kinematics.tip_rotation());
            for (i, now) in [asked, out.orientation].into_iter().enumerate() {
                let (last, speed) = before[i];
                let now_speed = super::turn::rotation_between(&last, &now) / DT;
                before[i] = (now, now_speed);
                most[i].0 = most[i].0.max(now_speed.norm());
                most[i].1 = most[i].1.max((now_speed - speed).norm() / DT);
            }
        }
        println!(
            "every {every} ms, {radius} m: reference {:?}, arm {:?} of {v_max} rad/s, {a_max} rad/s²; tip {off} m off its filter's output; {:?}",
            most[0],
            most[1],
            rig.controller.counts()
        );
        // The tip's way comes first: targets that jump about leave its error as it is without turning (2 mm), and may turn the tip harder than it is asked to.
        assert!(off < 2.1e-3, "{off} m");
        if radius == 0.0 {
            // A wrist's friction turns around within a tick, and its inertia is small: the arm itself is not as smooth as its reference.
            for ((speed, acceleration), slack) in most.into_iter().zip([1.05, 2.5]) {
                assert!(speed <= v_max * 1.02, "{speed} rad/s");
                assert!(acceleration <= a_max * slack, "{acceleration} rad/s²");
            }
        }
    }
}

#[test]
fn an_orientation_let_go_is_braked_and_kept() {
    let mut rig = rig(&ControlConfig::default());
    let upright = rig.controller.turn_reference().orientation;
    let turn = UnitQuaternion::from_euler_angles(0.5, 0.0, 0.0) * upright;
    let follow = |orientation| Demand::Follow {
        target: rig.start,
        orientation,
        speed_scale: 1.0,
    };
    let (turning, none) = (follow(Some(turn)), follow(None));
    for letting_go in [none, Demand::Stop] {
        for _ in 0..150 {
            rig.tick(turning);
        }
        let speed = rig.controller.turn_reference().angular_velocity.norm();
        assert!(speed > 0.5, "{speed} rad/s");
        let mut last = rig.tick(letting_go);
        for _ in 0..1500 {
            last = rig.tick(letting_go);
        }
        assert!(rig.plant.qd().norm() < 1e-3);
        let kept = rig.controller.turn_reference();
        assert_eq!(kept.angular_velocity, Vector3::zeros());
        let off = last.orientation.angle_to(&kept.orientation);
        assert!(off < 1e-3, "{off} rad");
        assert!(last.orientation_error_rad < 1e-3);
        let q = *rig.plant.q();
        rig.controller.reset_reference(&q);
    }
}

#[test]
fn what_is_no_orientation_stops_and_is_counted() {
    let mut rig = rig(&ControlConfig::default());
    let target = rig.start + Vector3::new(0.0, 0.15, 0.0);
    for _ in 0..150 {
        rig.follow(target);
    }
    let nan = UnitQuaternion::new_unchecked(nalgebra::Quaternion::from_parts(
        1.0,
        Vector3::new(f64::NAN, 0.0, 0.0),
    ));
    for _ in 0..1000 {
        let out = rig.tick(Demand::Follow {
            target,
            orientation: Some(nan),
            speed_scale: 1.0,
        });
        assert!(out.clamps.invalid && out.orientation_error_rad.is_finite());
    }
    assert_eq!(rig.controller.counts().invalid, 1000);
    assert!(rig.plant.qd().norm() < 1e-3);
}

#[test]
fn limits_of_turning_come_from_the_joints() {
    let arm = Arc::new(ArmModel::from_urdf(default_urdf(), &LoadOptions::default()).unwrap());
    let home = home_posture(&arm);
    let fast = TurnLimits {
        v_max: 1e3,
        a_max: 1e5,
        j_max: 1e7,
    };
    let limits = fast.lowered(&arm, &home, DT).unwrap();
    assert!(limits.v_max > 0.5 && limits.v_max < 10.0, "{limits:?}");
    assert!(limits.a_max > 5.0 && limits.a_max < 1e3, "{limits:?}");
    let config = |turn_limits| ControlConfig {
        turn_limits,
        ..ControlConfig::default()
    };
    let made = |limits| Controller::new(Arc::clone(&arm), &config(limits), &home).map(|_| ());
    assert_eq!(made(fast), Ok(()));
    let error = made(TurnLimits {
        v_max: -1.0,
        ..fast
    })
    .unwrap_err();
    assert!(matches!(error, ControlError::Turn(_)), "{error}");
    // Slides cannot turn: nothing lowers what they are never asked.
    let gantry = arms::gantry();
    let home = home_posture(&gantry);
    assert_eq!(fast.lowered(&gantry, &home, DT).unwrap().v_max, 1e3);
}
