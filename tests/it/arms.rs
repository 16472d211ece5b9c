//! Published arms: their descriptions load with the right notices, hold against gravity, and follow a circle.
//!
//! The descriptions are public but not ours to ship: without them these tests say that they are skipped.

use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};
use telemime_robot::control::{
    CartesianLimits, ControlConfig, Controller, Demand, home_posture, workspace_radius,
};
use telemime_sim::arm::{ArmModel, Kinematics, LoadOptions, Notice, Plant};

use crate::data::needs;

const DT_S: f64 = 1e-3;

fn load(file: &str) -> Option<Arc<ArmModel>> {
    let path = needs(&format!("data/urdf/{file}"))?;
    let text = std::fs::read_to_string(path).unwrap();
    Some(Arc::new(
        ArmModel::from_urdf(&text, &LoadOptions::default()).unwrap(),
    ))
}

#[test]
fn published_descriptions_give_their_arm_and_say_what_was_assumed() {
    let cases = [
        ("ur5e/ur5e.urdf", 6, "tool0"),
        ("example-robot-data/ur5_robot.urdf", 6, "tool0"),
        ("example-robot-data/panda.urdf", 7, "panda_hand_tcp"),
        ("franka_description/fr3.urdf", 7, "fr3_link8"),
        ("franka_description/fer.urdf", 7, "fer_link8"),
        (
            "drake_iiwa14/iiwa14_no_collision.urdf",
            7,
            "iiwa_link_ee_kuka",
        ),
        (
            "kinova_gen3/GEN3-7DOF-NOVISION_FOR_URDF_ARM_V12.urdf",
            7,
            "end_effector_link",
        ),
        ("xarm/xarm6.urdf", 6, "link_eef"),
        ("xarm/xarm7.urdf", 7, "link_eef"),
        ("so-arm100/so100.urdf", 5, "gripper"),
        ("so-arm100/so101_new_calib.urdf", 5, "gripper_frame_link"),
    ];
    for (file, dof, tip) in cases {
        let Some(arm) = load(file) else { return };
        assert_eq!((arm.dof(), arm.tip()), (dof, tip), "{file}");
        let says = |what: fn(&Notice) -> bool| arm.notices().iter().filter(|n| what(n)).count();
        let fixed = says(|n| matches!(n, Notice::JointFixed { .. }));
        let expected = match file {
            "example-robot-data/panda.urdf" => 2,
            "so-arm100/so100.urdf" | "so-arm100/so101_new_calib.urdf" => 1,
            _ => 0,
        };
        assert_eq!(fixed, expected, "{file}");
        let impossible = says(|n| matches!(n, Notice::TriangleInequality { .. }));
        assert_eq!(
            impossible,
            usize::from(file.ends_with("fer.urdf")),
            "{file}"
        );
        let unlimited = arm.joints().iter().filter(|j| !j.is_limited()).count();
        assert_eq!(
            unlimited,
            if file.contains("GEN3") { 4 } else { 0 },
            "{file}"
        );
    }
}

/// What went wrong at worst: m, and rad.
struct Worst {
    /// Tip from where it started, while holding.
    held: f64,
    /// Tip from the filter's output.
    servo: f64,
    /// Tip from the circle.
    off: f64,
    /// Orientation from its filter's output.
    turn_servo: f64,
    /// Orientation from the one demanded for that moment.
    turned_off: f64,
}

/// Holds for a second, then a circle of 5 cm radius in 2 s, 3/ω ahead; with `turning`, at the same time by that rotation vector (rad, base axes) and back.
fn drive(arm: &Arc<ArmModel>, turning: Option<Vector3<f64>>) -> Worst {
    drive_late(arm, turning, 0)
}

/// As [`drive`], with an arm that obeys `late` ticks late: all that is measured is as late.
fn drive_late(arm: &Arc<ArmModel>, turning: Option<Vector3<f64>>, late: u32) -> Worst {
    let home = home_posture(arm);
    let mut kinematics = Kinematics::new();
    kinematics.update(arm, &home);
    let start = kinematics.tip();
    let config = ControlConfig {
        dead_time_s: f64::from(late) * DT_S,
        ..ControlConfig::default()
    };
    let mut controller = Controller::new(Arc::clone(arm), &config, &home).unwrap();
    let mut due = std::collections::VecDeque::new();
    let mut plant = Plant::new(Arc::clone(arm), &home).unwrap();
    // Minimum jerk along the circle: it begins and ends at rest.
    let angle = |t: f64| {
        let turned = (t.max(0.0) / 2.0).min(1.0);
        core::f64::consts::TAU * turned.powi(3) * (10.0 - 15.0 * turned + 6.0 * turned * turned)
    };
    let circle = |t: f64| {
        let angle = angle(t);
        start + Vector3::new(0.0, angle.sin(), 1.0 - angle.cos()) * 0.05
    };
    let upright = controller.turn_reference().orientation;
    let turn = |t: f64| {
        let share = 0.5 * (1.0 - angle(t).cos());
        UnitQuaternion::from_scaled_axis(turning.unwrap_or_default() * share) * upright
    };
    let mut worst = Worst {
        held: 0.0,
        servo: 0.0,
        off: 0.0,
        turn_servo: 0.0,
        turned_off: 0.0,
    };
    for tick in 0..3500 {
        let t = f64::from(tick) * DT_S - 1.0;
        let demand = if t < 0.0 {
            Demand::Stop
        } else {
            Demand::Follow {
                target: circle(t + controller.lag_s()),
                orientation: turning.map(|_| turn(t + controller.lag_s())),
                speed_scale: 1.0,
            }
        };
        let (q, qd) = (*plant.q(), *plant.qd());
        let out = controller.tick(demand, &q, &qd);
        let report = plant.step(&out.tau, DT_S);
        assert_eq!((report.stopped, report.invalid, report.clamped), (0, 0, 0));
        if t < 0.0 {
            worst.held = worst.held.max((out.tip - start).norm());
        } else {
            due.push_back(out.reference.p);
            if due.len() > late as usize {
                let due = due.pop_front().unwrap();
                worst.servo = worst.servo.max((out.tip - due).norm());
            }
            worst.off = worst.off.max((out.tip - circle(t)).norm());
            let turn_servo = out.orientation.angle_to(&out.turn.orientation);
            worst.turn_servo = worst.turn_servo.max(turn_servo);
            worst.turned_off = worst.turned_off.max(out.orientation.angle_to(&turn(t)));
        }
    }
    let CartesianLimits { v_max, a_max, .. } = *controller.limits();
    println!(
        "{}: reach {:.3} m around home, {v_max:.2} m/s, {a_max:.1} m/s², {:?}; held within {:.4} mm, filter to tip {:.3} mm, off the circle {:.3} mm, orientation {:.5} rad off its filter's output and {:.5} off the one asked, {:?}",
        arm.name(),
        workspace_radius(arm, &home),
        controller.turn_limits(),
        worst.held * 1e3,
        worst.servo * 1e3,
        worst.off * 1e3,
        worst.turn_servo,
        worst.turned_off,
        controller.counts()
    );
    worst
}

#[test]
fn published_arms_hold_and_follow_a_circle() {
    for file in [
        "ur5e/ur5e.urdf",
        "example-robot-data/panda.urdf",
        "franka_description/fr3.urdf",
        "franka_description/fer.urdf",
        "drake_iiwa14/iiwa14_no_collision.urdf",
        "kinova_gen3/GEN3-7DOF-NOVISION_FOR_URDF_ARM_V12.urdf",
        "xarm/xarm6.urdf",
        "xarm/xarm7.urdf",
        "so-arm100/so101_new_calib.urdf",
    ] {
        let Some(arm) = load(file) else { return };
        let Worst {
            held, servo, off, ..
        } = drive(&arm, None);
        assert!(held < 1e-4, "{file}: {held} m");
        assert!(servo < 1e-3, "{file}: {servo} m");
        assert!(off < 4e-3, "{file}: {off} m");
    }
}

#[test]
fn published_arms_with_dead_time_are_where_they_should_be_when_they_should() {
    for file in [
        "ur5e/ur5e.urdf",
        "example-robot-data/panda.urdf",
        "drake_iiwa14/iiwa14_no_collision.urdf",
        "kinova_gen3/GEN3-7DOF-NOVISION_FOR_URDF_ARM_V12.urdf",
        "xarm/xarm6.urdf",
        "so-arm100/so101_new_calib.urdf",
    ] {
        let Some(arm) = load(file) else { return };
        let prompt = drive(&arm, None);
        for late in [10, 20, 30, 50] {
            let Worst { servo, off, .. } = drive_late(&arm, None, late);
            assert!(servo < 1e-3, "{file}, {late} ms: {servo} m");
            assert!(off < 1.1 * prompt.off + 1e-4, "{file}, {late} ms: {off} m");
        }
    }
}

#[test]
fn published_arms_turn_as_they_go() {
    for (file, turn_rad, off_at_most) in [
        ("ur5e/ur5e.urdf", 0.25, 1e-2),
        ("example-robot-data/panda.urdf", 0.25, 1e-2),
        ("franka_description/fr3.urdf", 0.25, 1e-2),
        ("drake_iiwa14/iiwa14_no_collision.urdf", 0.25, 1e-2),
        // Its joints are slow, and its wrist bends most of the way.
        (
            "kinova_gen3/GEN3-7DOF-NOVISION_FOR_URDF_ARM_V12.urdf",
            0.12,
            1e-2,
        ),
        ("xarm/xarm6.urdf", 0.25, 1e-2),
        ("xarm/xarm7.urdf", 0.25, 1e-2),
        // Five axes cannot have both: the place is kept, and the orientation given up as far as it must be.
        ("so-arm100/so100.urdf", 0.25, 0.6),
        ("so-arm100/so101_new_calib.urdf", 0.25, 0.6),
    ] {
        let Some(arm) = load(file) else { return };
        let straight = drive(&arm, None);
        for axis in [Vector3::x(), Vector3::y(), Vector3::z()] {
            let Worst {
                servo,
                off,
                turn_servo,
                turned_off,
                ..
            } = drive(&arm, Some(axis * turn_rad));
            assert!(servo < 1e-3, "{file}: {servo} m");
            assert!(off < 1.1 * straight.off, "{file}: {off} m");
            assert!(turned_off < off_at_most, "{file}: {turned_off} rad");
            // Wrists with friction are a few mrad behind; where an arm cannot turn, its filter waits.
            let led_at_most = if arm.dof() > 5 { 1e-2 } else { 0.06 };
            assert!(turn_servo < led_at_most, "{file}: {turn_servo} rad");
        }
    }
}
