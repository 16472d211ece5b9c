//! Against Pinocchio's figures, each checked with MuJoCo (tests/vectors/rigid_*.json).

mod faults;
mod physics;

use std::sync::Arc;

use nalgebra::{Isometry3, Matrix3, Translation3, UnitQuaternion, Vector3};
use serde_json::Value;

use super::*;

const VECTORS: [&str; 3] = [
    include_str!(concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../tests/vectors/rigid_arm7.json"
    )),
    include_str!(concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../tests/vectors/rigid_mixed5.json"
    )),
    include_str!(concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../tests/vectors/rigid_ur5_like.json"
    )),
];

fn list(v: &Value) -> Vec<f64> {
    v.as_array()
        .unwrap()
        .iter()
        .map(|x| x.as_f64().unwrap())
        .collect()
}

fn joints(v: &Value) -> Joints {
    let mut out = Joints::zeros();
    let list = list(v);
    out.as_mut_slice()[..list.len()].copy_from_slice(&list);
    out
}

fn load(v: &Value) -> ArmModel {
    let options = LoadOptions {
        tip: v["tip"].as_str().map(str::to_owned),
        ..LoadOptions::default()
    };
    ArmModel::from_urdf(v["urdf"].as_str().unwrap(), &options).unwrap()
}

fn for_each_state(mut check: impl FnMut(&ArmModel, &mut Dynamics, &Value)) {
    for text in VECTORS {
        let v: Value = serde_json::from_str(text).unwrap();
        let arm = load(&v);
        let mut dynamics = Dynamics::new();
        for state in v["states"].as_array().unwrap() {
            dynamics.update(&arm, &joints(&state["q"]));
            check(&arm, &mut dynamics, state);
        }
    }
}

fn relative(ours: &Joints, theirs: &Joints) -> f64 {
    (ours - theirs).norm() / theirs.norm().max(1.0)
}

#[test]
fn names_and_limits_are_the_urdfs() {
    for text in VECTORS {
        let v: Value = serde_json::from_str(text).unwrap();
        let arm = load(&v);
        let names: Vec<&str> = arm.joints().iter().map(|j| j.name.as_str()).collect();
        let expected: Vec<&str> = v["joint_order"]
            .as_array()
            .unwrap()
            .iter()
            .map(|n| n.as_str().unwrap())
            .collect();
        assert_eq!(names, expected);
        assert_eq!(arm.per_joint(|j| j.lower), joints(&v["lower"]));
        assert_eq!(arm.per_joint(|j| j.upper), joints(&v["upper"]));
        assert_eq!(arm.per_joint(|j| j.velocity), joints(&v["velocity_limit"]));
        assert_eq!(arm.per_joint(|j| j.effort), joints(&v["effort_limit"]));
        let mass = v["total_mass_moving"].as_f64().unwrap();
        assert!((arm.moving_mass_kg() - mass).abs() < 1e-12);
    }
}

#[test]
fn poses_and_jacobians() {
    for_each_state(|arm, dynamics, state| {
        let k = dynamics.kinematics();
        assert!((k.tip() - Vector3::from_vec(list(&state["tip_p"]))).norm() < 1e-10);
        let rows = state["tip_R"].as_array().unwrap();
        let theirs = Matrix3::from_fn(|r, c| list(&rows[r])[c]);
        assert!((k.tip_rotation() - theirs).norm() < 1e-10);
        let rows = state["J_world_aligned"].as_array().unwrap();
        let jacobian = k.jacobian();
        for (r, row) in rows.iter().enumerate() {
            let ours = jacobian.row(r).transpose();
            assert!((ours - joints(row)).norm() < 1e-10, "row {r}");
        }
        for (i, joint) in arm.joints().iter().enumerate() {
            let (origin, _) = k.joint_frame(i).unwrap();
            let theirs = list(&state["joint_poses"][&joint.name]["p"]);
            assert!((origin.coords - Vector3::from_vec(theirs)).norm() < 1e-10);
        }
    });
}

#[test]
fn tip_velocity_and_acceleration() {
    for_each_state(|_, dynamics, state| {
        let (qd, qdd) = (joints(&state["v"]), joints(&state["a"]));
        let k = dynamics.kinematics();
        let velocity = k.jacobian() * qd;
        let acceleration = k.jacobian() * qdd + k.jacobian_derivative(&qd) * qd;
        let v = list(&state["tip_vel_world_aligned"]);
        let a = list(&state["tip_acc_classical_world_aligned"]);
        for i in 0..6 {
            assert!((velocity[i] - v[i]).abs() < 1e-10);
            assert!((acceleration[i] - a[i]).abs() < 1e-9);
        }
    });
}

#[test]
fn torques_and_accelerations() {
    for_each_state(|_, dynamics, state| {
        let (qd, qdd, tau) = (
            joints(&state["v"]),
            joints(&state["a"]),
            joints(&state["tau"]),
        );
        let zero = Joints::zeros();
        let still = dynamics.rnea(&zero, &zero);
        assert!(relative(&still, &joints(&state["gravity"])) < 1e-10);
        assert!(relative(&dynamics.rnea(&qd, &zero), &joints(&state["nle"])) < 1e-10);
        assert!(relative(&dynamics.rnea(&qd, &qdd), &joints(&state["rnea"])) < 1e-10);
        assert!(relative(&dynamics.aba(&qd, &tau, &zero), &joints(&state["aba"])) < 1e-8);
        let m = dynamics.mass_matrix();
        for (r, row) in state["M"].as_array().unwrap().iter().enumerate() {
            assert!(relative(&m.column(r).into(), &joints(row)) < 1e-10);
        }
        let kinetic = state["kinetic"].as_f64().unwrap();
        assert!((dynamics.kinetic_energy_j(&qd) - kinetic).abs() < 1e-10 * kinetic.max(1.0));
    });
}

#[test]
fn added_inertia_is_added_to_the_mass_matrix() {
    for_each_state(|arm, dynamics, state| {
        let (qd, tau) = (joints(&state["v"]), joints(&state["tau"]));
        let added = arm.per_joint(|_| 0.05);
        let qdd = dynamics.aba(&qd, &tau, &added);
        let back = dynamics.rnea(&qd, &qdd) + added.component_mul(&qdd);
        assert!(relative(&back, &tau) < 1e-9);
    });
}

/// RK4 from the vectors' start; returns the worst joint error against them and the worst relative energy error.
fn integrate(v: &Value, law: &str, damping: f64) -> (f64, f64) {
    let arm = load(v);
    let motion = &v[law];
    let (t, q_ref) = (list(&motion["t"]), motion["q"].as_array().unwrap());
    let mut d = Dynamics::new();
    let mut acceleration = |q: &Joints, qd: &Joints| {
        d.update(&arm, q);
        d.aba(qd, &(-qd * damping), &Joints::zeros())
    };
    let (mut q, mut qd) = (joints(&q_ref[0]), Joints::zeros());
    let mut energy = {
        let arm = arm.clone();
        let mut d = Dynamics::new();
        move |q: &Joints, qd: &Joints| {
            d.update(&arm, q);
            d.kinetic_energy_j(qd) + d.potential_energy_j(&arm)
        }
    };
    let start = energy(&q, &qd);
    let (mut worst, mut worst_energy) = (0.0_f64, 0.0_f64);
    for (i, pair) in t.windows(2).enumerate() {
        let steps = 1000;
        let h = (pair[1] - pair[0]) / f64::from(steps);
        for _ in 0..steps {
            let a1 = acceleration(&q, &qd);
            let (v2, a2) = {
                let v = qd + a1 * (h / 2.0);
                (v, acceleration(&(q + qd * (h / 2.0)), &v))
            };
            let (v3, a3) = {
                let v = qd + a2 * (h / 2.0);
                (v, acceleration(&(q + v2 * (h / 2.0)), &v))
            };
            let (v4, a4) = {
                let v = qd + a3 * h;
                (v, acceleration(&(q + v3 * h), &v))
            };
            q += (qd + (v2 + v3) * 2.0 + v4) * (h / 6.0);
            qd += (a1 + (a2 + a3) * 2.0 + a4) * (h / 6.0);
        }
        worst = worst.max((q - joints(&q_ref[i + 1])).norm());
        worst_energy = worst_energy.max((energy(&q, &qd) - start).abs() / start.abs());
    }
    (worst, worst_energy)
}

#[test]
fn free_motion_keeps_its_energy_and_path() {
    for text in VECTORS {
        let v: Value = serde_json::from_str(text).unwrap();
        let (path, energy) = integrate(&v, "motion_free", 0.0);
        assert!(energy < 1e-9, "energy {energy:e}");
        assert!(path < 1e-5, "path {path:e}");
    }
}

#[test]
fn damped_motion_follows_its_path() {
    for text in VECTORS {
        let v: Value = serde_json::from_str(text).unwrap();
        let (path, _) = integrate(&v, "motion_damped", 2.0);
        assert!(path < 1e-6, "path {path:e}");
    }
}

#[test]
fn plant_converges_to_the_free_motion() {
    let v: Value = serde_json::from_str(VECTORS[0]).unwrap();
    let arm = Arc::new(load(&v));
    let motion = &v["motion_free"];
    let end = joints(&motion["q"][2]);
    let error = |dt: f64| {
        let mut plant = Plant::new(Arc::clone(&arm), &joints(&motion["q"][0])).unwrap();
        for _ in 0..(0.2 / dt).round() as usize {
            let report = plant.step(&Joints::zeros(), dt);
            assert_eq!(report, PlantReport::default());
        }
        (plant.q() - end).norm()
    };
    let (coarse, fine) = (error(1e-3), error(2.5e-4));
    assert!(coarse < 2e-3, "{coarse:e}");
    assert!(fine < 0.3 * coarse, "{fine:e} against {coarse:e}");
}

#[test]
fn plant_clamps_stops_and_survives_nonsense() {
    let arm = Arc::new(ArmModel::from_urdf(default_urdf(), &LoadOptions::default()).unwrap());
    let mid = arm.per_joint(Joint::mid);
    let mut plant = Plant::new(Arc::clone(&arm), &mid).unwrap();
    let mut tau = Joints::zeros();
    tau[0] = 1e9;
    tau[3] = f64::NAN;
    let report = plant.step(&tau, 1e-3);
    assert_eq!((report.clamped, report.invalid), (1, 1 << 3));
    let mut stopped = 0;
    for _ in 0..3000 {
        stopped |= plant.step(&tau, 1e-3).stopped;
        for (i, j) in arm.joints().iter().enumerate() {
            assert!(plant.q()[i] >= j.lower && plant.q()[i] <= j.upper);
        }
    }
    assert_eq!(stopped & 1, 1);
    assert_eq!(plant.q()[0], arm.joints()[0].upper);
    let before = *plant.q();
    plant.step(&tau, f64::NAN);
    plant.step(&tau, -1.0);
    assert_eq!(*plant.q(), before);
    assert!(matches!(
        Plant::new(Arc::clone(&arm), &(mid * f64::NAN)),
        Err(PlantError::StartOutside { .. })
    ));
}

#[test]
fn friction_far_above_inertia_stays_stable() {
    let urdf = default_urdf().replace(r#"damping="0.1""#, r#"damping="50""#);
    let arm = Arc::new(ArmModel::from_urdf(&urdf, &LoadOptions::default()).unwrap());
    let mut plant = Plant::new(Arc::clone(&arm), &arm.per_joint(Joint::mid)).unwrap();
    let mut tau = Joints::zeros();
    tau[6] = 10.0;
    for _ in 0..500 {
        plant.step(&tau, 1e-3);
    }
    // 10 N·m against 50 N·m·s/rad and 0.1 N·m.
    assert!((plant.qd()[6] - 9.9 / 50.0).abs() < 0.01, "{}", plant.qd());
}

#[test]
fn default_arm_is_as_described() {
    let arm = ArmModel::from_urdf(default_urdf(), &LoadOptions::default()).unwrap();
    assert_eq!((arm.name(), arm.dof(), arm.tip()), ("mime7", 7, "tcp"));
    assert!((arm.chain_length_m() - 0.85).abs() < 1e-12);
    assert!((15.0..16.0).contains(&arm.moving_mass_kg()));
    assert_eq!(arm.notices().len(), 1);
}

#[test]
fn a_fixed_prismatic_branch_is_lumped_where_it_is_fixed() {
    let urdf = r#"<robot name="r"><link name="b"/><link name="l"><inertial><mass value="1"/><inertia ixx=".1" ixy="0" ixz="0" iyy=".1" iyz="0" izz=".1"/></inertial></link>
        <link name="f"><inertial><mass value="1"/><inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial></link><link name="tcp"/>
        <joint name="j" type="continuous"><parent link="b"/><child link="l"/><axis xyz="0 0 2"/></joint>
        <joint name="finger" type="prismatic"><parent link="l"/><child link="f"/><axis xyz="1 0 0"/><limit lower=".2" upper=".6" velocity="1" effort="1"/></joint>
        <joint name="t" type="fixed"><parent link="l"/><child link="tcp"/><origin xyz="1 0 0"/></joint></robot>"#;
    let arm = ArmModel::from_urdf(urdf, &LoadOptions::default()).unwrap();
    let body = &arm.joints()[0].body;
    assert!((body.com_m - Vector3::new(0.2, 0.0, 0.0)).norm() < 1e-15);
    let mut d = Dynamics::new();
    d.update(&arm, &Joints::zeros());
    assert!((d.mass_matrix()[(0, 0)] - (0.1 + 0.16)).abs() < 1e-15);
    assert!(!arm.joints()[0].is_limited());
    assert!(arm.notices().contains(&Notice::JointFixed {
        joint: "finger".into(),
        value: 0.4
    }));

    let mut options = LoadOptions::default();
    options.fixed.insert("finger".into(), 0.6);
    let arm = ArmModel::from_urdf(urdf, &options).unwrap();
    assert!((arm.joints()[0].body.com_m.x - 0.3).abs() < 1e-15);
    options.fixed.insert("finger".into(), 0.7);
    assert!(matches!(
        ArmModel::from_urdf(urdf, &options),
        Err(ArmError::FixedOutside { .. })
    ));
    let mut options = LoadOptions::default();
    options.fixed.insert("j".into(), 0.0);
    assert!(matches!(
        ArmModel::from_urdf(urdf, &options),
        Err(ArmError::NotOffChain { .. })
    ));
}

#[test]
fn faults_have_their_own_errors() {
    type IsIt = fn(&ArmError) -> bool;
    let cases: [(&str, &str, &str, IsIt); 13] = [
        ("not xml", "<robot", "<robot <", |e| {
            matches!(e, ArmError::Parse { .. })
        }),
        (
            "two links",
            r#"<link name="link2">"#,
            r#"<link name="link1">"#,
            |e| matches!(e, ArmError::Duplicate { .. }),
        ),
        (
            "unknown child",
            r#"<child link="link2"/>"#,
            r#"<child link="nowhere"/>"#,
            |e| matches!(e, ArmError::UndefinedLink { .. }),
        ),
        (
            "two parents",
            r#"<child link="link3"/>"#,
            r#"<child link="link2"/>"#,
            |e| matches!(e, ArmError::TwoParents { .. }),
        ),
        (
            "no root",
            r#"<link name="tcp"/>"#,
            r#"<link name="tcp"/><link name="loose"/>"#,
            |e| matches!(e, ArmError::Roots { .. }),
        ),
        (
            "loop",
            r#"<parent link="link2"/>"#,
            r#"<parent link="tool"/>"#,
            |e| matches!(e, ArmError::Loop { .. }),
        ),
        (
            "planar",
            r#"name="joint3" type="revolute""#,
            r#"name="joint3" type="planar""#,
            |e| matches!(e, ArmError::UnsupportedJoint { .. }),
        ),
        (
            "no axis",
            r#"<axis xyz="0 0 1"/>"#,
            r#"<axis xyz="0 0 0"/>"#,
            |e| matches!(e, ArmError::ZeroAxis { .. }),
        ),
        (
            "NaN",
            r#"<mass value="3"/>"#,
            r#"<mass value="NaN"/>"#,
            |e| matches!(e, ArmError::NotFinite { .. }),
        ),
        ("range", r#"lower="-1.8""#, r#"lower="1.8""#, |e| {
            matches!(e, ArmError::EmptyRange { .. })
        }),
        ("speed", r#"velocity="3""#, r#"velocity="-3""#, |e| {
            matches!(e, ArmError::Negative { .. })
        }),
        (
            "mass",
            r#"<mass value="3"/>"#,
            r#"<mass value="-3"/>"#,
            |e| matches!(e, ArmError::NegativeMass { .. }),
        ),
        ("inertia", r#"ixx="0.0127"#, r#"ixx="-0.0127"#, |e| {
            matches!(e, ArmError::NegativeInertia { .. })
        }),
    ];
    for (what, from, to, is_it) in cases {
        let broken = default_urdf().replacen(from, to, 1);
        assert_ne!(broken, default_urdf(), "{what}");
        let error = ArmModel::from_urdf(&broken, &LoadOptions::default()).unwrap_err();
        assert!(is_it(&error), "{what}: {error}");
    }
    let with_tip = |tip: &str| {
        let options = LoadOptions {
            tip: Some(tip.into()),
            ..LoadOptions::default()
        };
        ArmModel::from_urdf(default_urdf(), &options).unwrap_err()
    };
    assert!(matches!(with_tip("hand"), ArmError::UnknownTip { .. }));
    assert!(matches!(with_tip("base"), ArmError::NoMovableJoint { .. }));
    assert!(matches!(
        ArmModel::from_urdf("", &LoadOptions::default()),
        Err(ArmError::Parse { .. })
    ));
}

#[test]
fn a_chain_that_moves_no_inertia_is_refused() {
    let massless = default_urdf()
        .replace(r#"<mass value="0.7"/>"#, r#"<mass value="0"/>"#)
        .replace(r#"<mass value="0.4"/>"#, r#"<mass value="0"/>"#);
    let mut kept = String::new();
    let mut skip = false;
    for line in massless.lines() {
        skip |= line.contains(r#"name="link7""#) || line.contains(r#"name="tool""#);
        let inertia = skip && line.contains("<inertia ");
        skip &= !line.contains("</link>");
        if !inertia {
            kept.push_str(line);
        } else {
            kept.push_str(r#"<inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/>"#);
        }
    }
    assert_eq!(
        ArmModel::from_urdf(&kept, &LoadOptions::default()),
        Err(ArmError::Massless {
            joint: "joint7".into()
        })
    );
}

#[test]
fn more_joints_than_the_arrays_hold_are_refused() {
    let mut urdf = String::from(r#"<robot name="snake"><link name="l0"/>"#);
    for i in 1..=11 {
        urdf += &format!(
            r#"<link name="l{i}"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
            <joint name="j{i}" type="continuous"><parent link="l{}"/><child link="l{i}"/><origin xyz=".1 0 0"/><axis xyz="0 0 1"/></joint>"#,
            i - 1
        );
    }
    urdf += "</robot>";
    let error = ArmModel::from_urdf(&urdf, &LoadOptions::default()).unwrap_err();
    assert!(matches!(error, ArmError::TooManyJoints { count: 11, .. }));
    let options = LoadOptions {
        tip: Some("l10".into()),
        ..LoadOptions::default()
    };
    assert_eq!(ArmModel::from_urdf(&urdf, &options).unwrap().dof(), 10);
}

#[test]
fn base_motion_of_a_body_is_its_pose() {
    let pose = Isometry3::from_parts(
        Translation3::new(0.1, 0.2, 0.3),
        UnitQuaternion::from_euler_angles(0.0, 0.0, 1.0),
    );
    let body = Body {
        mass_kg: 2.0,
        com_m: Vector3::zeros(),
        inertia_kg_m2: Matrix3::identity(),
    };
    assert_eq!(body.moved(&pose).com_m, Vector3::new(0.1, 0.2, 0.3));
}
