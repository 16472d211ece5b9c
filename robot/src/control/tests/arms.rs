//! Arms of every kind.

use super::*;

#[test]
fn home_is_in_front_conditioned_and_roomy() {
    let rig = rig(&ControlConfig::default());
    assert!(rig.start.x > 0.3 && rig.start.y.abs() < 0.02 && rig.start.z > 0.2);
    let radius = workspace_radius(&rig.arm, &rig.home);
    println!("home {:?}, radius {radius} m", rig.home);
    assert!((0.15..0.4).contains(&radius));
    assert_eq!(home_posture(&rig.arm), rig.home);
    let limits = rig.controller.limits();
    assert!(limits.v_max > 0.8 && limits.a_max > 8.0, "{limits:?}");
}

#[test]
fn arms_that_cannot_are_refused() {
    let config = ControlConfig::default();
    let make = |urdf: &str, q: Option<Joints>| {
        let arm = Arc::new(ArmModel::from_urdf(urdf, &LoadOptions::default()).unwrap());
        let q = q.unwrap_or_else(|| home_posture(&arm));
        Controller::new(arm, &config, &q).map(|_| ())
    };
    let weak = default_urdf().replace(r#"effort="87""#, r#"effort="5""#);
    assert!(matches!(
        make(&weak, None),
        Err(ControlError::TooWeak { .. })
    ));
    let mut straight = Joints::zeros();
    straight[3] = -0.1;
    straight[5] = 0.1;
    assert!(make(default_urdf(), Some(straight)).is_ok());
    straight[3] = 0.0;
    assert!(matches!(
        make(default_urdf(), Some(straight)),
        Err(ControlError::Start(_))
    ));
    let urdf = default_urdf().replace(r#"upper="-0.1""#, r#"upper="0.1""#);
    assert_eq!(
        make(&urdf, Some(Joints::zeros())),
        Err(ControlError::Singular)
    );
}

#[test]
fn springs_need_an_effort_limit_of_every_joint() {
    let stiff = ControlConfig {
        stiffness: Some(100.0),
        ..ControlConfig::default()
    };
    // Of one joint, or of all of them.
    for (from, to) in [
        (r#"effort="12""#, r#"effort="0""#),
        ("effort=", "forgotten="),
    ] {
        let urdf = default_urdf().replace(from, to);
        let arm = Arc::new(ArmModel::from_urdf(&urdf, &LoadOptions::default()).unwrap());
        let unlimited = arm.joints().iter().find(|j| !j.effort.is_finite()).unwrap();
        let home = home_posture(&arm);
        let made = |config| Controller::new(Arc::clone(&arm), config, &home).map(|_| ());
        assert_eq!(
            made(&stiff),
            Err(ControlError::NoEffort {
                joint: unlimited.name.clone()
            })
        );
        assert_eq!(made(&ControlConfig::default()), Ok(()));
    }
}

#[test]
fn a_joint_without_a_spring_is_carried_and_no_more() {
    let rig = rig(&ControlConfig::default());
    let mut stiffness = rig.arm.per_joint(|_| 10.0);
    stiffness[2] = 0.0;
    let mut control = TorqueControl::new(Law::Impedance { stiffness });
    let reference = JointReference {
        q: rig.home.map(|q| q + 0.1),
        ..JointReference::default()
    };
    let (tau, _) = control.torque(&rig.arm, &reference, &rig.home, &Joints::zeros());
    assert!(tau.iter().all(|x| x.is_finite()), "{tau}");
}

/// Three slides of a metre, the last one upright, without any length between them.
pub(super) fn gantry() -> ArmModel {
    let mut urdf = String::from(r#"<robot name="gantry"><link name="l0"/>"#);
    for (i, axis) in ["1 0 0", "0 1 0", "0 0 1"].iter().enumerate() {
        urdf += &format!(
            r#"<link name="l{child}"><inertial><mass value="2"/><inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>
            <joint name="j{child}" type="prismatic"><parent link="l{i}"/><child link="l{child}"/><axis xyz="{axis}"/>
            <limit lower="0" upper="1" velocity="1" effort="200"/></joint>"#,
            child = i + 1,
        );
    }
    ArmModel::from_urdf(&(urdf + "</robot>"), &LoadOptions::default()).unwrap()
}

#[test]
fn a_gantry_of_slides_has_a_workspace_and_moves_in_it() {
    let arm = Arc::new(gantry());
    let home = home_posture(&arm);
    let radius = workspace_radius(&arm, &home);
    // Down to 2 cm above the floor, in steps of 5 mm.
    assert!(
        (0.47..0.485).contains(&radius),
        "{radius} m around {home:?}"
    );
    let mut controller =
        Controller::new(Arc::clone(&arm), &ControlConfig::default(), &home).unwrap();
    let mut plant = Plant::new(Arc::clone(&arm), &home).unwrap();
    let target = Vector3::new(0.7, 0.3, 0.2);
    let mut tip = Vector3::zeros();
    for _ in 0..3000 {
        let demand = Demand::Follow {
            target,
            orientation: None,
            speed_scale: 1.0,
        };
        let out = controller.tick(demand, plant.q(), plant.qd());
        plant.step(&out.tau, DT);
        tip = out.tip;
    }
    assert!((tip - target).norm() < 1e-3, "{tip}");
}

#[test]
fn a_slow_arm_is_driven_gently() {
    // At a hundredth of the built-in arm's joint speeds, full acceleration could not be turned around in time.
    let mut urdf = default_urdf().to_owned();
    for speed in ["2.4", "3"] {
        assert!(urdf.contains(&format!(r#"velocity="{speed}""#)));
        urdf = urdf.replace(&format!(r#"velocity="{speed}""#), r#"velocity="0.02""#);
    }
    let arm = Arc::new(ArmModel::from_urdf(&urdf, &LoadOptions::default()).unwrap());
    let home = home_posture(&arm);
    let controller = Controller::new(Arc::clone(&arm), &ControlConfig::default(), &home).unwrap();
    let CartesianLimits {
        v_max,
        a_max,
        j_max,
    } = *controller.limits();
    assert!(v_max < 0.02 && a_max > 1.0, "{v_max} m/s, {a_max} m/s²");
    assert!(a_max * a_max / j_max + a_max * DT <= 0.81 * v_max);
}
