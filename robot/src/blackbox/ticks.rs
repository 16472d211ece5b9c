//! A tick as a row of words, and rows against the ones before: what does not change costs a byte, however it is laid out.

use telemime_endpoint::Mono;
use telemime_protocol::wire::v1::{Cause, RobotState};
use telemime_sim::arm::{Joints, PlantReport};

use super::tap::Ticked;
use crate::servo::{ArmState, Pulled, Report, Setpoint};

/// Words before those of the joints.
const FIXED: usize = 13;

/// Words of a tick of an arm with `dof` joints.
pub(super) fn width(dof: usize) -> usize {
    FIXED + 2 + 5 * dof
}

/// What a tick decided, as far as it is recorded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Outcome {
    /// State, cause and changes.
    pub(super) state: u64,
    pub(super) clamps: u64,
    pub(super) target_m: [u64; 3],
    pub(super) reference_m: [u64; 3],
    /// The setpoint's positions.
    pub(super) setpoint: [u64; telemime_sim::arm::MAX_JOINTS],
    /// Of everything else.
    pub(super) digest: u64,
}

/// What a tick was told, from its row.
#[derive(Debug, Clone, Copy)]
pub(super) struct Told {
    pub(super) now: Mono,
    pub(super) pulled: Pulled,
    pub(super) strain: PlantReport,
    pub(super) before: ArmState,
    pub(super) after: ArmState,
}

fn bits(v: &nalgebra::Vector3<f64>) -> [u64; 3] {
    [v.x.to_bits(), v.y.to_bits(), v.z.to_bits()]
}

impl Outcome {
    pub(super) fn of(setpoint: &Setpoint, report: &Report) -> Self {
        let r = &setpoint.reference;
        let q = &report.orientation;
        let numbers = r.qd.iter().chain(r.qdd.iter()).chain(setpoint.tau.iter());
        let numbers = numbers.chain(report.tip_m.iter()).chain(q.coords.iter());
        let rest = [
            setpoint.opening.unwrap_or(f64::NAN),
            report.jerk_m_s3,
            report.orientation_error_rad,
            report.age_s,
            report.plan_s.unwrap_or(f64::NAN),
        ];
        let numbers = numbers.copied().chain(rest).map(f64::to_bits);
        let whole = [
            u64::from(report.moving),
            u64::from(report.engagement.epoch) << 32 | u64::from(report.engagement.number),
            u64::from(report.declined.epoch) << 32 | u64::from(report.declined.number),
            report.engaged_at.0 as u64,
            report.tick,
        ];
        let mut setpoint_q = [0; telemime_sim::arm::MAX_JOINTS];
        for (word, v) in setpoint_q.iter_mut().zip(r.q.iter()) {
            *word = v.to_bits();
        }
        Self {
            state: report.state as u64
                | (report.cause as u64) << 8
                | u64::from(report.transitions) << 16,
            clamps: u64::from(report.clamps),
            target_m: bits(&report.target_m),
            reference_m: bits(&report.reference_m),
            setpoint: setpoint_q,
            digest: numbers.chain(whole).fold(0xcbf2_9ce4_8422_2325, fold),
        }
    }
}

/// One step of a hash: FNV's multiplication, on whole words, with the high half brought down.
fn fold(hash: u64, word: u64) -> u64 {
    let mixed = (hash ^ word).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    mixed ^ (mixed >> 32)
}

fn put_arm(row: &mut Vec<u64>, arm: &ArmState, dof: usize) {
    // NaN is no opening.
    row.push(arm.opening.unwrap_or(f64::NAN).to_bits());
    row.extend(arm.q.iter().take(dof).map(|v| v.to_bits()));
    row.extend(arm.qd.iter().take(dof).map(|v| v.to_bits()));
}

fn take_arm(row: &[u64], dof: usize) -> ArmState {
    let mut arm = ArmState {
        opening: Some(f64::from_bits(row[0])).filter(|opening| !opening.is_nan()),
        ..ArmState::default()
    };
    for i in 0..dof {
        arm.q[i] = f64::from_bits(row[1 + i]);
        arm.qd[i] = f64::from_bits(row[1 + dof + i]);
    }
    arm
}

/// The row of a tick, not yet against any other: outcome, inputs, arm before, arm after.
pub(super) fn row(ticked: &Ticked, dof: usize) -> Vec<u64> {
    let outcome = Outcome::of(&ticked.setpoint, &ticked.report);
    let strain = &ticked.strain;
    let mut row = Vec::with_capacity(width(dof));
    row.extend([
        ticked.now.0 as u64,
        u64::from(ticked.pulled.bits()),
        u64::from(strain.clamped)
            | u64::from(strain.stopped) << 16
            | u64::from(strain.invalid) << 32
            | u64::from(strain.fast) << 48,
        outcome.state,
        outcome.clamps,
        outcome.digest,
    ]);
    row.extend(outcome.target_m);
    row.extend(outcome.reference_m);
    row.push(u64::from(ticked.orders));
    row.extend(&outcome.setpoint[..dof]);
    put_arm(&mut row, &ticked.before, dof);
    put_arm(&mut row, &ticked.after, dof);
    row
}

/// The inverse of [`row`].
pub(super) fn read(row: &[u64], dof: usize) -> (Told, Outcome, u32) {
    let mut setpoint = [0; telemime_sim::arm::MAX_JOINTS];
    setpoint[..dof].copy_from_slice(&row[FIXED..FIXED + dof]);
    let arms = &row[FIXED + dof..];
    let told = Told {
        now: Mono(row[0] as i64),
        pulled: Pulled::from_bits(row[1] as u8),
        strain: PlantReport {
            clamped: row[2] as u16,
            stopped: (row[2] >> 16) as u16,
            invalid: (row[2] >> 32) as u16,
            fast: (row[2] >> 48) as u16,
        },
        before: take_arm(arms, dof),
        after: take_arm(&arms[1 + 2 * dof..], dof),
    };
    let outcome = Outcome {
        state: row[3],
        clamps: row[4],
        digest: row[5],
        target_m: [row[6], row[7], row[8]],
        reference_m: [row[9], row[10], row[11]],
        setpoint,
    };
    (told, outcome, row[12] as u32)
}

/// A row against the one before it, in place: the arm before against the arm after the last tick, the arm after against the arm before. What stays the same is 0.
pub(super) fn pack(row: &mut [u64], last: &[u64], dof: usize) {
    let arms = FIXED + dof;
    let half = 1 + 2 * dof;
    for i in (arms + half..row.len()).rev() {
        row[i] ^= row[i - half];
    }
    for i in arms..arms + half {
        row[i] ^= last[i + half];
    }
    for i in 0..arms {
        row[i] ^= last[i];
    }
}

/// The inverse of [`pack`]; `last` unpacked.
pub(super) fn unpack(row: &mut [u64], last: &[u64], dof: usize) {
    let arms = FIXED + dof;
    let half = 1 + 2 * dof;
    for i in 0..arms {
        row[i] ^= last[i];
    }
    for i in arms..arms + half {
        row[i] ^= last[i + half];
    }
    for i in arms + half..row.len() {
        row[i] ^= row[i - half];
    }
}

/// State and cause of a recorded outcome, as the protocol names them.
pub(super) fn state_of(word: u64) -> Option<(RobotState, Cause)> {
    let states = [
        RobotState::Idle,
        RobotState::Ready,
        RobotState::Engaged,
        RobotState::Coasting,
        RobotState::Holding,
        RobotState::Stopped,
    ];
    let causes = [
        Cause::Requested,
        Cause::NewsArrived,
        Cause::NewsLate,
        Cause::LeaseExpired,
        Cause::PlanFinished,
        Cause::ConnectionLost,
        Cause::OperatorStop,
        Cause::LocalStop,
        Cause::ClockStep,
        Cause::Fault,
        Cause::ArmFault,
    ];
    let state = states.into_iter().find(|s| *s as u64 == word & 0xff)?;
    let cause = causes.into_iter().find(|c| *c as u64 == word >> 8 & 0xff)?;
    Some((state, cause))
}

/// The joints' values of words.
pub(super) fn joints(words: &[u64]) -> Joints {
    let mut q = Joints::zeros();
    for (v, word) in q.iter_mut().zip(words) {
        *v = f64::from_bits(*word);
    }
    q
}
