//! Whatever is asked for, the arm does not meet itself, and its tip stays on its side of every plane.
#![allow(
    clippy::unwrap_used,
    reason = "clippy.toml allows it in tests, but does not know these helpers for tests"
)]

use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};
use telemime_robot::control::{
    BarrierConfig, CartesianLimits, ClampCounts, ControlConfig, ControlError, Controller, Demand,
    Output, Plane, home_posture, joint_accelerations,
};
use telemime_sim::arm::{ArmModel, Joints, Kinematics, LoadOptions, Plant, default_urdf};

const DT_S: f64 = 1e-3;

fn arm() -> Arc<ArmModel> {
    Arc::new(ArmModel::from_urdf(default_urdf(), &LoadOptions::default()).unwrap())
}

/// Uniform in [−1, 1).
struct Dice(u64);

impl Dice {
    fn next(&mut self) -> f64 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as f64 / (1_u64 << 30) as f64 - 1.0
    }

    fn vector(&mut self) -> Vector3<f64> {
        Vector3::from_fn(|_, _| self.next())
    }
}

/// Where somebody would put the tip to break something: anywhere, onto a link, behind a plane, on the other side of the base.
struct Adversary {
    dice: Dice,
    left: usize,
    demand: Demand,
}

impl Adversary {
    fn new(seed: u64) -> Self {
        Self {
            dice: Dice(seed),
            left: 0,
            demand: Demand::Stop,
        }
    }

    fn demand(&mut self, kinematics: &Kinematics, dof: usize) -> Demand {
        if self.left == 0 {
            let kind = ((self.dice.next() + 1.0) * 4.0) as usize;
            let tip = kinematics.tip();
            let target = match kind {
                0 => self.dice.vector() * 0.9,
                1 => self.dice.vector() * 3.0,
                2 => {
                    let i = ((self.dice.next() + 1.0) * 0.5 * dof as f64) as usize;
                    let link = kinematics.joint_frame(i.min(dof - 1));
                    link.map_or(tip, |(p, _)| p.coords) + self.dice.vector() * 0.02
                }
                3 => Vector3::new(-tip.x, -tip.y, tip.z),
                4 => Vector3::new(tip.x, tip.y, -0.2),
                5 => Vector3::new(0.05 * self.dice.next(), 0.05 * self.dice.next(), 0.4),
                _ => Vector3::new(0.5, 0.0, 0.4) + self.dice.vector() * 0.4,
            };
            let turned = UnitQuaternion::from_scaled_axis(self.dice.vector() * 2.0);
            self.demand = if kind == 7 && self.dice.next() > 0.5 {
                Demand::Stop
            } else {
                Demand::Follow {
                    target,
                    orientation: (self.dice.next() > 0.0).then_some(turned),
                    speed_scale: (self.dice.next() + 1.5).clamp(0.0, 1.0),
                }
            };
            self.left = 20 + (1200.0 * (self.dice.next() + 1.0)) as usize;
        }
        self.left -= 1;
        self.demand
    }
}

/// The least that was seen.
struct Least {
    between_m: f64,
    tip_m: f64,
    joints_beyond: f64,
    counts: ClampCounts,
    limits: Limits,
}

/// The most of its limits that the reference took, as shares of them.
#[derive(Debug, Default, Clone, Copy)]
struct Limits {
    /// The joints' speed, by what it is said to be and by the way of a tick; and their acceleration.
    joint_speed: f64,
    joint_acceleration: f64,
    /// The tip filter's output, by what it is said to be and by the way of a tick.
    speed: f64,
    acceleration: f64,
    jerk: f64,
    /// The same where the arm could not follow and the filter was set back to what it does: its speed, and the change of it in a tick by the limit.
    held_speed: f64,
    held_change: f64,
    held: usize,
}

impl Limits {
    fn see(
        &mut self,
        arm: &ArmModel,
        limits: &CartesianLimits,
        brake: &Joints,
        last: &Output,
        out: &Output,
    ) {
        for (i, joint) in arm.joints().iter().enumerate() {
            let (before, after) = (&last.setpoint, &out.setpoint);
            let way = (after.q[i] - before.q[i]).abs() / DT_S;
            let speed = after.qd[i].abs().max(way) / joint.velocity;
            let change = (after.qd[i] - before.qd[i]).abs() / DT_S;
            self.joint_speed = self.joint_speed.max(speed);
            self.joint_acceleration = self.joint_acceleration.max(change / brake[i]);
        }
        let (before, after) = (&last.reference, &out.reference);
        let way = (after.p - before.p).norm() / DT_S;
        let change = (after.v - before.v).norm() / DT_S;
        let jerk = (after.a - before.a).norm() / DT_S;
        self.acceleration = self.acceleration.max(after.a.norm() / limits.a_max);
        if last.clamps.held_back {
            self.held_speed = self.held_speed.max(after.v.norm() / limits.v_max);
            self.held_change = self.held_change.max(change / limits.a_max);
            self.held += 1;
            return;
        }
        self.speed = self.speed.max(after.v.norm().max(way) / limits.v_max);
        self.acceleration = self.acceleration.max(change / limits.a_max);
        self.jerk = self.jerk.max(jerk / limits.j_max);
    }
}

fn planes() -> Vec<Plane> {
    vec![
        Plane::new(Vector3::z(), 0.15).unwrap(),
        Plane::new(Vector3::new(-1.0, -0.3, 0.0), -0.65).unwrap(),
    ]
}

/// Minutes of the adversary against the controller; `simulated` drives the arm too, and looks at that instead of the reference.
fn attack(seed: u64, minutes: f64, barrier: BarrierConfig, simulated: bool) -> Least {
    let arm = arm();
    let home = home_posture(&arm);
    let config = ControlConfig {
        barrier,
        ..ControlConfig::default()
    };
    let mut controller = Controller::new(Arc::clone(&arm), &config, &home).unwrap();
    let mut plant = Plant::new(Arc::clone(&arm), &home).unwrap();
    // The pairs that are looked at are those the controller guards.
    let mut hulls = BarrierConfig::default().hulls(&arm, &home);
    let mut kinematics = Kinematics::new();
    kinematics.update(&arm, &home);
    let mut adversary = Adversary::new(seed);
    let mut least = Least {
        between_m: f64::INFINITY,
        tip_m: f64::INFINITY,
        joints_beyond: f64::NEG_INFINITY,
        counts: ClampCounts::default(),
        limits: Limits::default(),
    };
    let (limits, brake) = (
        *controller.limits(),
        joint_accelerations(&arm, &home).unwrap(),
    );
    let mut last: Option<Output> = None;
    let (mut q, mut qd) = (home, Joints::zeros());
    for _ in 0..(minutes * 60.0 / DT_S) as usize {
        let demand = adversary.demand(&kinematics, arm.dof());
        let out = controller.tick(demand, &q, &qd);
        if let Some(last) = last.replace(out) {
            least.limits.see(&arm, &limits, &brake, &last, &out);
        }
        if simulated {
            plant.step(&out.tau, DT_S);
            (q, qd) = (*plant.q(), *plant.qd());
        } else {
            qd = (out.setpoint.q - q) / DT_S;
            q = out.setpoint.q;
        }
        kinematics.update(&arm, &q);
        hulls.place(&kinematics);
        let nearest = hulls.nearest().unwrap().proximity.distance_m;
        least.between_m = least.between_m.min(nearest);
        for plane in planes() {
            least.tip_m = least.tip_m.min(plane.height_m(&kinematics.tip()));
        }
        for (i, joint) in arm.joints().iter().enumerate() {
            let beyond = (q[i] - joint.upper).max(joint.lower - q[i]);
            least.joints_beyond = least.joints_beyond.max(beyond);
        }
    }
    least.counts = *controller.counts();
    println!(
        "seed {seed}: hulls {:.2} mm apart, tip {:.2} mm inside the planes; {:?}; {:?}",
        least.between_m * 1e3,
        least.tip_m * 1e3,
        least.counts,
        least.limits
    );
    least
}

fn guarding() -> BarrierConfig {
    let mut config = BarrierConfig::default();
    for plane in planes() {
        config = config.with_plane(plane).unwrap();
    }
    config
}

#[test]
fn adversarial_targets_never_bring_links_together_nor_the_tip_through_a_plane() {
    let stop_m = BarrierConfig::default().stop_m;
    for seed in 1..=4 {
        let least = attack(seed, 1.0, guarding(), false);
        assert!(least.between_m >= stop_m, "{} m", least.between_m);
        assert!(least.tip_m >= 0.0, "{} m", least.tip_m);
        assert!(least.joints_beyond <= 0.0, "{}", least.joints_beyond);
        // To rounding, on every tick, whatever the barrier does.
        let most = least.limits;
        for share in [most.joint_speed, most.joint_acceleration] {
            assert!(share <= 1.0 + 1e-9, "{most:?}");
        }
        for share in [most.speed, most.acceleration, most.jerk, most.held_speed] {
            assert!(share <= 1.0 + 1e-9, "{most:?}");
        }
        // What the filter is set back to is what the joints do, and that is within their limits, not the tip's: measured up to 22.4 times the tip's acceleration.
        assert!(most.held_change <= 30.0, "{most:?}");
        // It was tried.
        assert!(most.held > 10_000 && most.speed > 0.9 && most.joint_speed > 0.9);
        assert!(least.counts.near_itself > 0 && least.counts.near_plane > 0);
    }
}

#[test]
fn the_simulated_arm_stays_within_millimetres_of_what_its_reference_keeps() {
    let least = attack(9, 1.0, guarding(), true);
    assert!(least.between_m >= 0.015, "{} m", least.between_m);
    assert!(least.tip_m >= -0.003, "{} m", least.tip_m);
}

#[test]
fn without_the_barrier_the_same_targets_do_both() {
    let open = BarrierConfig {
        self_collision: false,
        ..BarrierConfig::default()
    };
    let least = (1..=4)
        .map(|seed| attack(seed, 0.5, open, false))
        .fold((f64::INFINITY, f64::INFINITY), |sofar, least| {
            (sofar.0.min(least.between_m), sofar.1.min(least.tip_m))
        });
    assert!(least.0 < 0.0 && least.1 < -0.1, "{least:?}");
}

#[test]
fn a_tip_slides_along_a_plane_to_the_nearest_place_it_may_be() {
    let arm = arm();
    let home = home_posture(&arm);
    let mut kinematics = Kinematics::new();
    kinematics.update(&arm, &home);
    let start = kinematics.tip();
    let floor_m = start.z - 0.1;
    let plane = Plane::new(Vector3::z(), floor_m).unwrap();
    let config = ControlConfig {
        barrier: BarrierConfig::default().with_plane(plane).unwrap(),
        ..ControlConfig::default()
    };
    let mut controller = Controller::new(Arc::clone(&arm), &config, &home).unwrap();
    let mut plant = Plant::new(Arc::clone(&arm), &home).unwrap();
    let target = start + Vector3::new(0.05, 0.1, -0.3);
    let mut tip = start;
    for _ in 0..3000 {
        let (q, qd) = (*plant.q(), *plant.qd());
        let out = controller.tick(
            Demand::Follow {
                target,
                orientation: None,
                speed_scale: 1.0,
            },
            &q,
            &qd,
        );
        plant.step(&out.tau, DT_S);
        tip = out.tip;
        assert!(tip.z > floor_m);
    }
    assert!((tip.xy() - target.xy()).norm() < 2e-3, "{tip}");
    assert!(tip.z - floor_m < 0.01, "{tip}");
    assert!(controller.counts().near_plane > 2000);
}

#[test]
fn an_arm_that_starts_behind_a_plane_is_refused() {
    let arm = arm();
    let home = home_posture(&arm);
    let high = Plane::new(Vector3::z(), 2.0).unwrap();
    let config = ControlConfig {
        barrier: BarrierConfig::default().with_plane(high).unwrap(),
        ..ControlConfig::default()
    };
    let error = Controller::new(Arc::clone(&arm), &config, &home).unwrap_err();
    assert!(matches!(error, ControlError::Barrier(_)), "{error}");
    let config = ControlConfig {
        barrier: BarrierConfig {
            stop_m: f64::NAN,
            ..BarrierConfig::default()
        },
        ..ControlConfig::default()
    };
    assert!(Controller::new(arm, &config, &home).is_err());
}
