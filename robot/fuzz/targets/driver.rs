//! Lines of an arm's driver: any bytes are refused, or say a greeting or a state that is what it must be; and whatever they say,
//! the setpoints that go back stay finite and within the joints' limits.
//!
//! The input is lines; before each but the first stands a byte, how many ticks pass before it. Positions count from the start
//! posture, so that the search need not find it.

#![no_main]

use std::cell::RefCell;

use libfuzzer_sys::fuzz_target;
use telemime_endpoint::Mono;
use telemime_protocol::wire::v1::RobotState;
use telemime_robot::driver::{DriverArm, DriverConfig, Heard, Sent, line};
use telemime_robot::rig::{Rig, RigOptions};
use telemime_robot::servo::{self, ArmState, Order};
use telemime_sim::arm::MAX_JOINTS;

const TICK_NS: i64 = 1_000_000;
const MOST_TICKS: i64 = 600;

thread_local! {
    static RIG: RefCell<Option<Rig>> = const { RefCell::new(None) };
}

fn judge(rig: &Rig, sent: &Sent) {
    let at = &sent.setpoint.reference;
    for (i, joint) in rig.arm.joints().iter().enumerate() {
        assert!([at.q[i], at.qd[i], at.qdd[i]].iter().all(|v| v.is_finite()));
        assert!(
            at.qd[i].abs() <= joint.velocity * 1.001,
            "{} of joint {i}",
            at.qd[i]
        );
    }
    let mut written = Vec::new();
    line::setpoint(sent, rig.arm.dof(), &mut written);
    assert!(written.ends_with(b"\n") && !written[..written.len() - 1].contains(&b'\n'));
}

fn drive(rig: &Rig, lines: &[&[u8]]) {
    let (mut says, heard) = rtrb::RingBuffer::new(64);
    let (setpoints, mut hears) = rtrb::RingBuffer::new(1024);
    let state = ArmState {
        q: rig.home,
        ..ArmState::default()
    };
    let config = DriverConfig::new(250.0, 0.1).expect("a usable patience");
    let arm = DriverArm::new(rig.arm.clone(), config, state, heard, setpoints);
    let (rings, mut handle) = servo::rings();
    let mut station = rig.servo_before(Box::new(arm), None, rings);
    handle.orders.push(Order::Operator(true)).expect("room");
    let (mut now, mut ticks) = (Mono(1_000_000_000), 0);
    let mut faulty = false;
    for input in lines {
        let (wait, text) = input
            .split_first()
            .map_or((0, *input), |(n, rest)| (i64::from(n % 64), rest));
        for _ in 0..=wait {
            now = Mono(now.0 + TICK_NS);
            ticks += 1;
            let report = station.tick(now);
            assert!(report.q.iter().chain(&report.tip_m).all(|v| v.is_finite()));
            assert!(
                !faulty || report.state == RobotState::Stopped,
                "{:?}",
                report.state
            );
            faulty |= report.state == RobotState::Stopped;
            while let Ok(sent) = hears.pop() {
                judge(rig, &sent);
            }
            while handle.reports.pop().is_ok() {}
        }
        if ticks > MOST_TICKS {
            return;
        }
        let said = match line::said(text, rig.arm.dof()) {
            Ok(line::Said::State(state, obeyed)) => {
                let values = state.q.iter().chain(&state.qd).chain(&state.opening);
                assert!(values.copied().all(f64::is_finite));
                assert!(state.opening.is_none_or(|o| (0.0..=1.0).contains(&o)));
                let (at, mut state) = (now, state);
                state.q += rig.home;
                Heard::State { at, state, obeyed }
            }
            Ok(line::Said::Fault(_)) | Err(_) => continue,
        };
        // A full ring is the bridge's to mend; nothing is pushed faster than it is taken here.
        let _ = says.push(said);
    }
}

fuzz_target!(|data: &[u8]| {
    let lines: Vec<_> = data.split(|b| *b == b'\n').collect();
    if let Ok(hello) = line::hello(lines[0]) {
        assert!((1..=MAX_JOINTS).contains(&hello.joints.len()));
        assert!((10.0..=1000.0).contains(&hello.rate_hz));
    }
    for dof in [1, MAX_JOINTS] {
        if let Ok(line::Said::State(state, _)) = line::said(lines[0], dof) {
            assert!(state.q.iter().skip(dof).all(|v| *v == 0.0));
        }
    }
    RIG.with_borrow_mut(|rig| {
        let rig = rig.get_or_insert_with(|| {
            let options = RigOptions {
                driver: true,
                ..RigOptions::default()
            };
            Rig::load(&options).expect("our own arm")
        });
        drive(rig, &lines[1..]);
    });
});
