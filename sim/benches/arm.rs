//! What the arm's arithmetic costs: `cargo bench -p telemime-sim --bench arm`. `beside.py` runs the peers on the same arms.

use std::sync::Arc;

use divan::{Bencher, black_box};
use serde_json::Value;
use telemime_sim::arm::{
    ArmModel, Dynamics, Integrator, Joints, Kinematics, LoadOptions, Plant, SelfCollision,
    default_urdf,
};

fn main() {
    divan::main();
}

/// Six axes and seven, as Pinocchio and MuJoCo are given them.
const ARMS: [usize; 2] = [6, 7];

struct State {
    arm: Arc<ArmModel>,
    q: Joints,
    qd: Joints,
    qdd: Joints,
}

fn state(axes: usize) -> State {
    let text = match axes {
        6 => include_str!("../../tests/vectors/rigid_ur5_like.json"),
        _ => include_str!("../../tests/vectors/rigid_arm7.json"),
    };
    let vectors: Value = serde_json::from_str(text).expect("the file is JSON");
    let options = LoadOptions {
        tip: vectors["tip"].as_str().map(str::to_owned),
        ..LoadOptions::default()
    };
    let urdf = vectors["urdf"].as_str().expect("the file holds its URDF");
    let arm = Arc::new(ArmModel::from_urdf(urdf, &options).expect("the URDF is an arm"));
    assert_eq!(arm.dof(), axes);
    let joints = |what: &str| {
        let list = vectors["states"][0][what].as_array().expect("a list");
        Joints::from_iterator(
            list.iter()
                .map(|x| x.as_f64().expect("a number"))
                .chain(std::iter::repeat(0.0))
                .take(Joints::zeros().len()),
        )
    };
    State {
        q: joints("q"),
        qd: joints("v"),
        qdd: joints("a"),
        arm,
    }
}

#[divan::bench(args = ARMS)]
fn tip(bencher: Bencher, axes: usize) {
    let State { arm, q, .. } = state(axes);
    let mut kinematics = Kinematics::new();
    bencher.bench_local(|| {
        kinematics.update(&arm, black_box(&q));
        kinematics.tip()
    });
}

#[divan::bench(args = ARMS)]
fn jacobian(bencher: Bencher, axes: usize) {
    let State { arm, q, .. } = state(axes);
    let mut kinematics = Kinematics::new();
    bencher.bench_local(|| {
        kinematics.update(&arm, black_box(&q));
        kinematics.jacobian()
    });
}

#[divan::bench(args = ARMS)]
fn rnea(bencher: Bencher, axes: usize) {
    let State { arm, q, qd, qdd } = state(axes);
    let mut dynamics = Dynamics::new();
    bencher.bench_local(|| {
        dynamics.update(&arm, black_box(&q));
        dynamics.rnea(&qd, &qdd)
    });
}

#[divan::bench(args = ARMS)]
fn crba(bencher: Bencher, axes: usize) {
    let State { arm, q, .. } = state(axes);
    let mut dynamics = Dynamics::new();
    bencher.bench_local(|| {
        dynamics.update(&arm, black_box(&q));
        dynamics.mass_matrix()
    });
}

#[divan::bench(args = ARMS)]
fn aba(bencher: Bencher, axes: usize) {
    let State { arm, q, qd, qdd } = state(axes);
    let mut dynamics = Dynamics::new();
    let none = Joints::zeros();
    bencher.bench_local(|| {
        dynamics.update(&arm, black_box(&q));
        dynamics.aba(&qd, &qdd, &none)
    });
}

fn plant(axes: usize, integrator: Integrator) -> Plant {
    let State { arm, .. } = state(axes);
    let start = arm.per_joint(telemime_sim::arm::Joint::mid);
    let plant = Plant::new(arm, &start).expect("mid-range is a posture");
    plant.integrated_by(integrator)
}

/// One millisecond of the simulated arm: four substeps.
#[divan::bench(args = ARMS)]
fn tick_euler(bencher: Bencher, axes: usize) {
    let mut plant = plant(axes, Integrator::SemiImplicit);
    let tau = Joints::zeros();
    bencher.bench_local(|| plant.step(black_box(&tau), 1e-3));
}

/// The same by Runge and Kutta: four substeps of four.
#[divan::bench(args = ARMS)]
fn tick_rk4(bencher: Bencher, axes: usize) {
    let mut plant = plant(axes, Integrator::Rk4);
    let tau = Joints::zeros();
    bencher.bench_local(|| plant.step(black_box(&tau), 1e-3));
}

/// Seven links placed, and the nearest of all pairs that are kept apart.
#[divan::bench]
fn nearest(bencher: Bencher) {
    let arm = ArmModel::from_urdf(default_urdf(), &LoadOptions::default()).expect("our own");
    let start = arm.per_joint(telemime_sim::arm::Joint::mid);
    let mut hulls = SelfCollision::new(&arm, &start, 0.02);
    let mut kinematics = Kinematics::new();
    bencher.bench_local(|| {
        kinematics.update(&arm, black_box(&start));
        hulls.place(&kinematics);
        hulls.nearest()
    });
}
