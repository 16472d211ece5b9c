//! Whatever numbers a URDF holds: a refusal with a reason, or an arm that never computes a NaN.

use proptest::prelude::*;

use super::*;

/// Numbers that descriptions have had, and worse.
fn number() -> impl Strategy<Value = f64> {
    prop_oneof![
        4 => -1.0..1.0_f64,
        2 => 0.0..1e-3_f64,
        1 => Just(0.0),
        1 => Just(-0.0),
        1 => Just(1e-300),
        1 => Just(1e-12),
        1 => Just(1e12),
        1 => Just(1e300),
        1 => Just(-1e300),
        1 => Just(f64::NAN),
        1 => Just(f64::INFINITY),
        1 => -10.0..10.0_f64,
    ]
}

/// Numbers that most arms have, with a fault here and there.
fn mostly(good: f64) -> impl Strategy<Value = f64> {
    prop_oneof![12 => Just(good), 1 => number()]
}

fn link(i: usize) -> impl Strategy<Value = String> {
    let inertia = [
        mostly(0.01),
        mostly(0.0),
        mostly(0.0),
        mostly(0.01),
        mostly(0.0),
        mostly(0.01),
    ];
    (mostly(1.0), inertia, [mostly(0.0), mostly(0.1), mostly(0.0)], mostly(0.05), mostly(0.2)).prop_map(
        move |(mass, [ixx, ixy, ixz, iyy, iyz, izz], [x, y, z], radius, length)| {
            format!(
                r#"<link name="l{i}"><inertial><origin xyz="{x} {y} {z}"/><mass value="{mass}"/>
                <inertia ixx="{ixx}" ixy="{ixy}" ixz="{ixz}" iyy="{iyy}" iyz="{iyz}" izz="{izz}"/></inertial>
                <collision><geometry><cylinder radius="{radius}" length="{length}"/></geometry></collision></link>"#
            )
        },
    )
}

fn joint(i: usize) -> impl Strategy<Value = String> {
    let kind = prop::sample::select(vec!["revolute", "continuous", "prismatic", "fixed"]);
    let origin = [mostly(0.1), mostly(0.0), mostly(0.3)];
    let turn = [mostly(0.0), mostly(1.57), mostly(0.3)];
    let axis = [mostly(0.0), mostly(0.0), mostly(1.0)];
    let limits = [mostly(-2.0), mostly(2.0), mostly(3.0), mostly(100.0)];
    let friction = [mostly(0.1), mostly(0.2)];
    (kind, origin, turn, axis, limits, friction).prop_map(
        move |(kind, [x, y, z], [r, p, w], [ax, ay, az], [lower, upper, speed, effort], [damping, friction])| {
            format!(
                r#"<joint name="j{i}" type="{kind}"><parent link="l{i}"/><child link="l{}"/><origin xyz="{x} {y} {z}" rpy="{r} {p} {w}"/>
                <axis xyz="{ax} {ay} {az}"/><limit lower="{lower}" upper="{upper}" velocity="{speed}" effort="{effort}"/>
                <dynamics damping="{damping}" friction="{friction}"/></joint>"#,
                i + 1
            )
        },
    )
}

fn robot() -> impl Strategy<Value = String> {
    (
        [link(0), link(1), link(2), link(3)],
        [joint(0), joint(1), joint(2)],
    )
        .prop_map(|(links, joints)| {
            format!(
                r#"<robot name="r">{}{}</robot>"#,
                links.join(""),
                joints.join("")
            )
        })
        .boxed()
}

fn finite(joints: &Joints) -> bool {
    joints.iter().all(|x| x.is_finite())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(600))]

    #[test]
    fn no_description_computes_a_nan(
        urdf in robot(),
        at in prop::array::uniform3(0.0..1.0_f64),
        speeds in prop::array::uniform3(-3.0..3.0_f64),
        torques in prop::array::uniform3(-50.0..50.0_f64),
    ) {
        let Ok(arm) = ArmModel::from_urdf(&urdf, &LoadOptions::default()) else {
            return Ok(());
        };
        let arm = Arc::new(arm);
        let (mut q, mut qd, mut tau) = (Joints::zeros(), Joints::zeros(), Joints::zeros());
        for (i, joint) in arm.joints().iter().enumerate() {
            let (lower, upper) = (joint.lower.max(-5.0), joint.upper.min(5.0));
            q[i] = (lower + (upper - lower) * at[i]).clamp(joint.lower, joint.upper);
            qd[i] = speeds[i];
            tau[i] = torques[i];
        }
        let mut dynamics = Dynamics::new();
        dynamics.update(&arm, &q);
        prop_assert!(dynamics.kinematics().tip().iter().all(|x| x.is_finite()));
        prop_assert!(dynamics.kinematics().jacobian().iter().all(|x| x.is_finite()));
        prop_assert!(dynamics.kinematics().jacobian_derivative(&qd).iter().all(|x| x.is_finite()));
        prop_assert!(finite(&dynamics.rnea(&qd, &tau)));
        prop_assert!(dynamics.mass_matrix().iter().all(|x| x.is_finite()));
        prop_assert!(finite(&dynamics.aba(&qd, &tau, &Joints::zeros())));
        prop_assert!(dynamics.kinetic_energy_j(&qd).is_finite());
        let mut hulls = SelfCollision::new(&arm, &q, 0.02);
        hulls.place(dynamics.kinematics());
        prop_assert!(hulls.nearest().is_none_or(|n| n.proximity.distance_m.is_finite()));
        for integrator in [Integrator::SemiImplicit, Integrator::Rk4] {
            let mut plant = Plant::new(Arc::clone(&arm), &q).unwrap().integrated_by(integrator);
            for _ in 0..30 {
                plant.step(&tau, 1e-3);
                prop_assert!(finite(plant.q()) && finite(plant.qd()), "{integrator:?}");
            }
        }
    }
}

#[test]
fn numbers_that_would_overflow_are_refused_by_name() {
    for (from, to) in [
        (r#"<mass value="3"/>"#, r#"<mass value="1e7"/>"#),
        (r#"ixx="0.0127"#, r#"ixx="1e1"#),
        (r#"damping="0.1""#, r#"damping="1e12""#),
        (r#"<origin xyz="0 0 0.08"/>"#, r#"<origin xyz="0 0 1e3"/>"#),
    ] {
        // The base's own inertia moves nothing and is not read.
        let broken = default_urdf().replace(from, to);
        assert_ne!(broken, default_urdf(), "{from}");
        let loaded = ArmModel::from_urdf(&broken, &LoadOptions::default());
        if from.contains("0.08") {
            assert!(loaded.is_ok());
        } else {
            let error = loaded.unwrap_err();
            assert!(
                matches!(error, ArmError::TooLarge { .. }),
                "{from}: {error}"
            );
        }
    }
}

#[test]
fn a_step_too_long_for_an_explicit_rule_is_survived() {
    // Drives without torque beyond a picometre a second are as stiff as damping gets.
    let urdf = default_urdf().replace(r#"velocity="2.4""#, r#"velocity="1e-12""#);
    let arm = Arc::new(ArmModel::from_urdf(&urdf, &LoadOptions::default()).unwrap());
    let start = arm.per_joint(Joint::mid);
    let mut tau = Joints::zeros();
    tau[1] = 50.0;
    for integrator in [Integrator::SemiImplicit, Integrator::Rk4] {
        let mut plant = Plant::new(Arc::clone(&arm), &start)
            .unwrap()
            .integrated_by(integrator);
        for _ in 0..200 {
            plant.step(&tau, 1e-3);
            assert!(finite(plant.q()) && finite(plant.qd()), "{integrator:?}");
        }
    }
}

#[test]
fn the_smaller_of_acceleration_and_deceleration_is_the_limit() {
    let with = |attributes: &str| {
        let urdf = default_urdf()
            .replace(r#"<robot "#, r#"<robot version="1.2" "#)
            .replacen("effort=\"87\"", &format!("effort=\"87\" {attributes}"), 1);
        ArmModel::from_urdf(&urdf, &LoadOptions::default()).map(|arm| arm.joints()[0].acceleration)
    };
    for (attributes, limit) in [
        ("", f64::INFINITY),
        (r#"acceleration="5""#, 5.0),
        (r#"acceleration="5" deceleration="3""#, 3.0),
        (r#"acceleration="5" deceleration="8""#, 5.0),
        (r#"deceleration="3""#, 3.0),
        (r#"acceleration="5" deceleration="0""#, 5.0),
    ] {
        assert_eq!(with(attributes), Ok(limit), "{attributes}");
    }
    for wrong in ["-1", "NaN"] {
        let refused = with(&format!(r#"deceleration="{wrong}""#));
        assert!(refused.is_err(), "{wrong}: {refused:?}");
    }
}
