//! What must hold whatever the figures: derivatives, conservation, order of convergence, contact, payload, limits.

use super::*;

fn arm(urdf: &str) -> Arc<ArmModel> {
    Arc::new(ArmModel::from_urdf(urdf, &LoadOptions::default()).unwrap())
}

/// The built-in arm without friction.
fn smooth() -> Arc<ArmModel> {
    let mut arm = ArmModel::from_urdf(default_urdf(), &LoadOptions::default()).unwrap();
    for joint in &mut arm.joints {
        (joint.damping, joint.friction) = (0.0, 0.0);
    }
    Arc::new(arm)
}

/// The same without ends: nothing takes energy out.
fn endless() -> Arc<ArmModel> {
    let smooth = default_urdf().replace("revolute", "continuous");
    let mut arm = ArmModel::from_urdf(&smooth, &LoadOptions::default()).unwrap();
    for joint in &mut arm.joints {
        (joint.damping, joint.friction) = (0.0, 0.0);
        (joint.velocity, joint.effort) = (f64::INFINITY, f64::INFINITY);
    }
    Arc::new(arm)
}

/// Three slides of a kilogram each, without friction.
fn gantry() -> Arc<ArmModel> {
    let mut urdf = String::from(r#"<robot name="gantry"><link name="l0"/>"#);
    for (i, axis) in ["1 0 0", "0 1 0", "0 0 1"].iter().enumerate() {
        urdf += &format!(
            r#"<link name="l{child}"><inertial><mass value="1"/><inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>
            <joint name="j{child}" type="prismatic"><parent link="l{i}"/><child link="l{child}"/><axis xyz="{axis}"/>
            <limit lower="-9" upper="9" velocity="50" effort="500"/></joint>"#,
            child = i + 1,
        );
    }
    arm(&(urdf + "</robot>"))
}

fn of(values: &[f64]) -> Joints {
    let mut q = Joints::zeros();
    q.as_mut_slice()[..values.len()].copy_from_slice(values);
    q
}

#[test]
fn the_jacobians_derivative_is_that_of_its_differences() {
    for_each_state(|arm, dynamics, state| {
        let (q, qd) = (joints(&state["q"]), joints(&state["v"]));
        let ours = dynamics.kinematics().jacobian_derivative(&qd);
        let h = 1e-5;
        let mut at = |t: f64| {
            dynamics.update(arm, &(q + qd * t));
            dynamics.kinematics().jacobian()
        };
        // Fourth order: what is left is rounding.
        let differences = (at(-2.0 * h) - at(2.0 * h) + (at(h) - at(-h)) * 8.0) / (12.0 * h);
        let off = (ours - differences).amax();
        assert!(off < 1e-8 * ours.amax().max(1.0), "{off:e}");
    });
}

fn energy(arm: &ArmModel, plant: &Plant) -> f64 {
    let mut dynamics = Dynamics::new();
    dynamics.update(arm, plant.q());
    dynamics.kinetic_energy_j(plant.qd()) + dynamics.potential_energy_j(arm)
}

/// Falls and swings for `seconds`; the largest change of energy, J, and the share by which the momentum about the vertical changed.
fn swing(dt_s: f64, seconds: f64) -> (f64, f64) {
    let arm = endless();
    let start = of(&[0.0, 0.3, 0.0, -1.5, 0.0, 1.6, 0.0]);
    let mut plant = Plant::new(Arc::clone(&arm), &start)
        .unwrap()
        .integrated_by(Integrator::Rk4);
    let mut kick = Joints::zeros();
    // The first joint turns about the vertical, where gravity has no say.
    kick[0] = 20.0;
    let mut dynamics = Dynamics::new();
    let mut holding = |plant: &Plant| {
        dynamics.update(&arm, plant.q());
        dynamics.rnea(&Joints::zeros(), &Joints::zeros())
    };
    for _ in 0..20 {
        let tau = holding(&plant) + kick;
        plant.step(&tau, dt_s);
    }
    let before = energy(&arm, &plant);
    let mut momentum = {
        let arm = Arc::clone(&arm);
        let mut dynamics = Dynamics::new();
        move |plant: &Plant| {
            dynamics.update(&arm, plant.q());
            (dynamics.mass_matrix() * plant.qd())[0]
        }
    };
    let turning = momentum(&plant);
    assert!(turning > 0.01);
    let (mut worst, mut drift) = (0.0_f64, 0.0_f64);
    for _ in 0..(seconds / dt_s).round() as usize {
        plant.step(&Joints::zeros(), dt_s);
        worst = worst.max((energy(&arm, &plant) - before).abs());
        drift = drift.max((momentum(&plant) - turning).abs() / turning);
    }
    assert!(plant.qd().norm() > 1.0, "it swings");
    (worst, drift)
}

#[test]
fn free_motion_keeps_energy_and_the_momentum_about_the_vertical() {
    let (energy_j, drift) = swing(1e-3, 3.0);
    println!("Runge-Kutta: {energy_j:e} J, {drift:e} of the momentum");
    assert!(energy_j < 1e-5 && drift < 1e-5);
}

#[test]
fn the_rules_have_the_order_they_should() {
    let arm = endless();
    let start = of(&[0.0, 0.3, 0.0, -1.5, 0.0, 1.6, 0.0]);
    let end = |integrator, dt: f64| {
        let mut plant = Plant::new(Arc::clone(&arm), &start)
            .unwrap()
            .integrated_by(integrator);
        for _ in 0..(0.32 / dt).round() as usize {
            plant.step(&Joints::zeros(), dt);
        }
        *plant.q()
    };
    let exact = end(Integrator::Rk4, 1e-3);
    for (integrator, order) in [(Integrator::Rk4, 4.0), (Integrator::SemiImplicit, 1.0)] {
        let coarse = (end(integrator, 0.032) - exact).norm();
        let fine = (end(integrator, 0.016) - exact).norm();
        let seen = (coarse / fine).log2();
        assert!(
            (seen - order).abs() < 0.3 * order,
            "{integrator:?}: order {seen}"
        );
    }
}

#[test]
fn a_payload_is_a_body_fixed_to_the_tip() {
    let payload: Payload = "1.2@0.01,-0.02,0.05@2e-3,2.5e-3,3e-3".parse().unwrap();
    let options = LoadOptions {
        payload: Some(payload),
        ..LoadOptions::default()
    };
    let loaded = ArmModel::from_urdf(default_urdf(), &options).unwrap();
    let drawn = default_urdf().replace(
        "</robot>",
        r#"<link name="cup"><inertial><origin xyz="0.01 -0.02 0.05"/><mass value="1.2"/><inertia ixx="2e-3" iyy="2.5e-3" izz="3e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
        <joint name="grasp" type="fixed"><parent link="tcp"/><child link="cup"/></joint></robot>"#,
    );
    let drawn = arm(&drawn);
    let bare = arm(default_urdf());
    assert_eq!(drawn.tip(), "tcp");
    let (q, qd, qdd) = (
        of(&[0.3, 0.4, -0.2, -1.4, 0.5, 1.2, 0.7]),
        of(&[0.5, -0.4, 0.3, 0.2, -0.6, 0.8, -0.9]),
        of(&[1.0, 2.0, -1.0, 0.5, -0.5, 2.0, 1.0]),
    );
    let torques = |arm: &ArmModel| {
        let mut dynamics = Dynamics::new();
        dynamics.update(arm, &q);
        dynamics.rnea(&qd, &qdd)
    };
    assert!(relative(&torques(&loaded), &torques(&drawn)) < 1e-12);
    assert!((torques(&loaded) - torques(&bare)).norm() > 1.0);
    assert!((loaded.moving_mass_kg() - bare.moving_mass_kg() - 1.2).abs() < 1e-12);
}

/// Steps until `seconds` are over, holding `tau`.
fn run(plant: &mut Plant, tau: &Joints, seconds: f64) {
    for _ in 0..(seconds * 1e3) as usize {
        plant.step(tau, 1e-3);
    }
}

#[test]
fn a_tip_comes_to_rest_on_a_surface_as_deep_as_its_weight_says() {
    let arm = gantry();
    let surface = ContactPlane::new(Vector3::z() * 3.0, 0.5)
        .unwrap()
        .made_of(1e4, 2.0, 0.4)
        .unwrap();
    let mut plant = Plant::new(Arc::clone(&arm), &of(&[0.0, 0.0, 0.6]))
        .unwrap()
        .beside(Some(surface));
    let mut before = energy(&arm, &plant);
    for _ in 0..6000 {
        plant.step(&Joints::zeros(), 1e-3);
        let depth = (-surface.height_m(&plant.q().fixed_rows::<3>(0).into())).max(0.0);
        // What is stored in the surface counts.
        let now = energy(&arm, &plant) + 0.5 * 1e4 * depth * depth;
        assert!(now < before + 2e-3, "{now} J after {before} J");
        before = before.min(now);
        assert!(plant.contact_force().z >= 0.0);
    }
    let depth = 0.5 - plant.q()[2];
    // One kilogram: what the third slide carries.
    assert!((depth - 9.81 / 1e4).abs() < 1e-5, "{depth} m");
    assert!((plant.contact_force().z - 9.81).abs() < 0.05);

    // Friction of 0.4: 3 N is held but for the creep that lets it hold, 5 N slides.
    let normal_n = 9.81;
    run(&mut plant, &of(&[3.0, 0.0, 0.0]), 3.0);
    let creep = 0.05 * 3.0 / (0.4 * normal_n);
    assert!(
        (plant.qd()[0] - creep).abs() < 1e-3,
        "{} m/s",
        plant.qd()[0]
    );
    run(&mut plant, &of(&[5.0, 0.0, 0.0]), 1.0);
    assert!(plant.qd()[0] > 0.2, "{} m/s", plant.qd()[0]);
}

#[test]
fn surfaces_that_are_none_are_refused() {
    let up = Vector3::z();
    assert!(matches!(
        ContactPlane::new(Vector3::zeros(), 0.0),
        Err(ContactError::Normal { .. })
    ));
    assert!(matches!(
        ContactPlane::new(up * f64::NAN, 0.0),
        Err(ContactError::Normal { .. })
    ));
    assert!(matches!(
        ContactPlane::new(up, f64::INFINITY),
        Err(ContactError::Offset { .. })
    ));
    let plane = ContactPlane::new(up, 0.0).unwrap();
    for (k, c, f) in [(1e9, 0.0, 0.0), (1.0, -1.0, 0.0), (1.0, 0.0, f64::NAN)] {
        assert!(matches!(
            plane.made_of(k, c, f),
            Err(ContactError::Range { .. })
        ));
    }
}

#[test]
fn a_drive_does_not_push_a_joint_far_beyond_its_speed_limit() {
    let arm = smooth();
    let limit = arm.joints()[6].velocity;
    let range = (arm.joints()[6].lower, arm.joints()[6].upper);
    let mut start = of(&[0.0, 0.3, 0.0, -1.5, 0.0, 1.6, 0.0]);
    start[6] = range.0;
    let mut plant = Plant::new(Arc::clone(&arm), &start).unwrap();
    let mut dynamics = Dynamics::new();
    let (mut fastest, mut fast) = (0.0_f64, 0);
    for _ in 0..1500 {
        dynamics.update(&arm, plant.q());
        let mut tau = dynamics.rnea(plant.qd(), &Joints::zeros());
        tau[6] += 0.3;
        let report = plant.step(&tau, 1e-3);
        if report.stopped != 0 {
            break;
        }
        fast |= report.fast;
        fastest = fastest.max(plant.qd()[6]);
    }
    assert!(
        fastest > limit && fastest < 1.11 * limit,
        "{fastest} of {limit} rad/s"
    );
    assert_eq!(fast, 1 << 6);
}
