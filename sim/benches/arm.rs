//! What the arm's arithmetic costs: `cargo bench -p telemime-sim --bench arm`. `beside.py` runs the peers on the same arms.

use std::sync::Arc;

use divan::{Bencher, black_box};
use serde_json::Value;
use telemime_sim::arm::{ArmModel, Dynamics, Joints, Kinematics, LoadOptions, Plant};

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

/// One millisecond of the simulated arm: four substeps.
#[divan::bench(args = ARMS)]
fn plant_tick(bencher: Bencher, axes: usize) {
    let State { arm, .. } = state(axes);
    let start = arm.per_joint(telemime_sim::arm::Joint::mid);
    let mut plant = Plant::new(arm, &start).expect("mid-range is a posture");
    let tau = Joints::zeros();
    bencher.bench_local(|| plant.step(black_box(&tau), 1e-3));
}
