//! An arm that answers late.

use super::*;

#[test]
fn dead_time_is_part_of_the_lag_and_the_tip_arrives_when_it_should() {
    for ms in [0, 10, 20, 30, 50] {
        let dead_time_s = f64::from(ms) * DT;
        let mut rig = rig(&ControlConfig {
            dead_time_s,
            ..ControlConfig::default()
        });
        let lag = rig.controller.lag_s();
        assert!((lag - 3.0 / ControlConfig::default().omega - dead_time_s).abs() < 1e-12);
        let (end, target) = gesture(3, 0.1, rig.start);
        for _ in 0..2000 {
            rig.follow(target(0.0));
        }
        let (mut right, mut short, mut servo) = (0.0, 0.0, 0.0_f64);
        let mut references = std::collections::VecDeque::new();
        for tick in 0..(end / DT) as usize {
            let t = tick as f64 * DT;
            let out = rig.follow(target(t + lag));
            right += (out.tip - target(t)).norm_squared();
            // Who does not know of the dead time has the tip where it is due that much later.
            short += (out.tip - target(t + dead_time_s)).norm_squared();
            references.push_back(out.reference.p);
            if references.len() > ms as usize {
                let due = references.pop_front().unwrap();
                servo = servo.max((out.tip - due).norm());
            }
        }
        println!(
            "{ms} ms: {:.2} mm RMS, {:.2} mm uncompensated; tip within {:.3} mm of its setpoint",
            (right * DT / end).sqrt() * 1e3,
            (short * DT / end).sqrt() * 1e3,
            servo * 1e3
        );
        // Stable: as near to what is due as without any dead time.
        assert!(servo < 1e-3, "{ms} ms: {servo} m");
        assert!(ms < 20 || right < 0.9 * short, "{ms} ms: {right} {short}");
    }
}

#[test]
fn a_stop_with_dead_time_stays_within_limits_and_ends_at_rest() {
    let mut rig = rig(&ControlConfig {
        dead_time_s: 0.05,
        ..ControlConfig::default()
    });
    let far = rig.start + Vector3::new(0.0, 0.2, 0.0);
    for _ in 0..150 {
        rig.follow(far);
    }
    assert!(rig.plant.qd().amax() > 0.05 && rig.controller.fastest_on_its_way() > 0.05);
    for _ in 0..600 {
        rig.tick(Demand::Stop);
    }
    assert!(rig.controller.fastest_on_its_way() < 1e-9);
    assert!(rig.plant.qd().amax() < 1e-3);
    // Afresh: what was on its way is forgotten.
    for _ in 0..20 {
        rig.follow(far);
    }
    let q = *rig.plant.q();
    rig.controller.reset_reference(&q);
    assert_eq!(rig.controller.fastest_on_its_way(), 0.0);
}

#[test]
fn a_dead_time_that_is_not_modelled_is_refused() {
    let arm = Arc::new(ArmModel::from_urdf(default_urdf(), &LoadOptions::default()).unwrap());
    let home = home_posture(&arm);
    for dead_time_s in [-0.001, 0.0511, f64::NAN] {
        let config = ControlConfig {
            dead_time_s,
            ..ControlConfig::default()
        };
        let error = Controller::new(Arc::clone(&arm), &config, &home).unwrap_err();
        assert!(matches!(error, ControlError::DeadTime(_)), "{error}");
    }
}

/// Why dead time lies between the setpoint and the joints' own loop: one inside it would be unstable.
#[test]
fn a_dead_time_of_the_torque_would_need_a_slow_loop() {
    let settles = |torque_dead_time_s: f64, joint_bandwidth: f64| {
        let mut rig = rig(&ControlConfig {
            joint_bandwidth,
            ..ControlConfig::default()
        });
        let mut line =
            telemime_sim::arm::DeadTime::new(torque_dead_time_s, DT, Joints::zeros()).unwrap();
        let target = rig.start + Vector3::new(0.0, 0.05, 0.0);
        let mut worst = 0.0_f64;
        for tick in 0..4000 {
            let demand = Demand::Follow {
                target,
                orientation: None,
                speed_scale: 1.0,
            };
            let (q, qd) = (*rig.plant.q(), *rig.plant.qd());
            let out = rig.controller.tick(demand, &q, &qd);
            rig.plant.step(&line.pass(out.tau), DT);
            if tick > 3000 {
                worst = worst.max(rig.plant.qd().amax());
            }
        }
        println!(
            "torque {:.0} ms late, loop at {joint_bandwidth} rad/s: {worst:.4} rad/s in the fourth second",
            torque_dead_time_s * 1e3
        );
        worst < 0.05
    };
    assert!(settles(0.0, 80.0) && settles(0.002, 80.0));
    assert!(!settles(0.01, 80.0) && !settles(0.02, 80.0));
    settles(0.01, 40.0);
    settles(0.02, 20.0);
    settles(0.05, 8.0);
}
