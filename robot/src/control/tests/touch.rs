//! What pushes back, and what is carried.

use super::*;

#[test]
fn a_tip_pressed_on_a_surface_stays_on_it_and_comes_off() {
    let mut rig = rig(&ControlConfig::default());
    let surface_m = rig.start.z - 0.05;
    let surface = ContactPlane::new(Vector3::z(), surface_m).unwrap();
    rig.plant = rig.plant.clone().beside(Some(surface));
    let into = rig.start + Vector3::new(0.02, 0.03, -0.08);
    let (mut deepest, mut hardest_n) = (0.0_f64, 0.0_f64);
    for _ in 0..3000 {
        let out = rig.follow(into);
        deepest = deepest.max(surface_m - out.tip.z);
        hardest_n = hardest_n.max(rig.plant.contact_force().norm());
    }
    println!(
        "pressed: {:.2} mm deep, {hardest_n:.0} N at most, {:.0} N at the end",
        deepest * 1e3,
        rig.plant.contact_force().z
    );
    assert!(rig.plant.contact_force().z > 10.0 && hardest_n < 1000.0);
    assert!(deepest < 0.04 && rig.plant.qd().amax() < 0.01);
    // Pressed, it slid and folded by 0.6 rad, which is taken back at a quarter of a radian a second.
    let mut tip = Vector3::zeros();
    for _ in 0..4000 {
        tip = rig.follow(rig.start).tip;
    }
    assert!(
        (tip - rig.start).norm() < 1e-3,
        "{tip} instead of {}",
        rig.start
    );
    assert_eq!(rig.plant.contact_force(), Vector3::zeros());
}

/// τ/K: what a spring of joints does and a computed torque does not.
#[test]
fn a_joint_impedance_is_pushed_away_by_as_much_as_its_stiffness_says() {
    let pressed = |stiffness: f64| {
        let mut rig = rig(&ControlConfig {
            stiffness: Some(stiffness),
            ..ControlConfig::default()
        });
        let surface_m = rig.start.z - 0.02;
        let surface = ContactPlane::new(Vector3::z(), surface_m).unwrap();
        rig.plant = rig.plant.clone().beside(Some(surface));
        let into = rig.start - Vector3::z() * 0.1;
        let mut last = None;
        for _ in 0..4000 {
            last = Some(rig.follow(into));
        }
        let out = last.unwrap();
        let q = *rig.plant.q();
        let mut kinematics = Kinematics::new();
        kinematics.update(&rig.arm, &q);
        let force = rig.plant.contact_force();
        let jacobian = kinematics.jacobian();
        let springs = super::controller::springs(&rig.arm, &rig.home, stiffness, DT).unwrap();
        let spring = springs.component_mul(&(out.setpoint.q - q));
        let push = jacobian.fixed_rows::<3>(0).transpose() * force;
        let balance = (spring + push).amax() / push.amax();
        println!(
            "stiffness {stiffness}: {:.2} N, off by {balance:.4}",
            force.z
        );
        assert!(rig.plant.qd().amax() < 1e-3);
        (force.z, balance)
    };
    let (soft_n, balance) = pressed(100.0);
    assert!(soft_n > 10.0 && balance < 0.02, "{soft_n} N, {balance}");
    let (firm_n, balance) = pressed(400.0);
    assert!(balance < 0.02, "{firm_n} N, {balance}");
    assert!(
        (2.0..4.5).contains(&(firm_n / soft_n)),
        "{firm_n} N after {soft_n}"
    );
}

#[test]
fn a_joint_impedance_follows_as_a_computed_torque_does_where_nothing_pushes() {
    for stiffness in [30.0, 600.0] {
        let mut rig = rig(&ControlConfig {
            stiffness: Some(stiffness),
            ..ControlConfig::default()
        });
        let (end, target) = gesture(1, 0.1, rig.start);
        let mut off = 0.0_f64;
        for _ in 0..2000 {
            rig.follow(target(0.0));
        }
        for tick in 0..(end / DT) as usize {
            let out = rig.follow(target(tick as f64 * DT));
            off = off.max((out.tip - out.reference.p).norm());
        }
        println!(
            "{stiffness} N·m/rad: {:.3} mm off its filter's output",
            off * 1e3
        );
        assert!(off < 3e-3, "{stiffness}: {off} m");
    }
    let arm = Arc::new(ArmModel::from_urdf(default_urdf(), &LoadOptions::default()).unwrap());
    let home = home_posture(&arm);
    for stiffness in [0.0, -1.0, f64::NAN, 1e6] {
        let config = ControlConfig {
            stiffness: Some(stiffness),
            ..ControlConfig::default()
        };
        let error = Controller::new(Arc::clone(&arm), &config, &home).unwrap_err();
        assert!(
            matches!(error, ControlError::Stiffness { most, .. } if most > 600.0),
            "{error}"
        );
    }
}

#[test]
fn a_payload_that_is_known_is_carried_and_one_too_heavy_refused() {
    let with = |payload: &str| {
        let options = LoadOptions {
            payload: Some(payload.parse().unwrap()),
            ..LoadOptions::default()
        };
        let arm = Arc::new(ArmModel::from_urdf(default_urdf(), &options).unwrap());
        let home = home_posture(&arm);
        Controller::new(Arc::clone(&arm), &ControlConfig::default(), &home)
            .map(|controller| (controller, Plant::new(arm, &home).unwrap(), home))
    };
    let (mut controller, mut plant, home) = with("1.5@0,0,0.05").unwrap();
    for _ in 0..1000 {
        let out = controller.tick(Demand::Stop, plant.q(), plant.qd());
        plant.step(&out.tau, DT);
    }
    assert!((plant.q() - home).norm() < 1e-5);
    let bare = *rig(&ControlConfig::default()).controller.limits();
    assert!(controller.limits().a_max < bare.a_max);
    let error = with("30").unwrap_err();
    assert!(matches!(error, ControlError::TooWeak { .. }), "{error}");
}
