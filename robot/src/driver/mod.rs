//! An arm behind a driver: a process that tells the joints' state and takes setpoints, one JSON object to a line (docs/driver.md).
//!
//! [`DriverArm`] is the servo's end: it reads and writes rings, and judges what it reads. [`bridge`] has the process and its threads.

pub mod bridge;
pub mod line;

#[cfg(test)]
mod tests;

use std::sync::Arc;

use telemime_endpoint::Mono;
use telemime_sim::arm::{ArmModel, Dynamics, Joints, PlantReport};

use crate::servo::{ArmFault, ArmState, Manipulator, Setpoint};

/// Setpoints whose time is remembered: with a tick of 1 ms two seconds, the longest patience.
const REMEMBERED: usize = 2048;

/// A joint may be told to be this far beyond its range, rad or m: sensors are offset, and stops give.
const BEYOND: f64 = 0.1;

/// A joint's speed may be told to be this much above its limit, as a factor, and this many rad/s or m/s.
const TOO_FAST: (f64, f64) = (1.5, 0.1);

/// A joint may leap by this much beyond what its speed explains, rad or m.
const LEAP: f64 = 0.05;

/// Most states a second that a driver may tell.
pub const FASTEST_HZ: f64 = 1000.0;

/// How long an arm may be silent or behind if nothing is said, s.
pub const PATIENCE_S: f64 = 0.1;

/// The shortest and the longest patience, s: behind by more than the longest, a setpoint's time is not remembered any more.
const PATIENCES_S: (f64, f64) = (0.01, 2.0);

/// A driver's period counts this often in its patience: a setpoint waits for up to one of them, its answer for another.
const PERIODS: f64 = 3.0;

/// What the driver said, from the thread that reads it.
#[derive(Debug, Clone, Copy)]
pub enum Heard {
    /// The joints' state.
    State {
        /// When it arrived.
        at: Mono,
        /// It.
        state: ArmState,
        /// The setpoint that the arm obeys, 0 before the first.
        obeyed: u64,
    },
    /// What made it the last word.
    Fault(ArmFault),
}

/// A setpoint on its way to the thread that writes.
#[derive(Debug, Clone, Copy)]
pub struct Sent {
    /// Counts from 1.
    pub seq: u64,
    /// When it was made.
    pub at: Mono,
    /// Positions, velocities and accelerations, the gripper's opening, and the torques that go with them.
    pub setpoint: Setpoint,
}

/// What a [`DriverArm`] goes by.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriverConfig {
    /// Joint states a second that the driver promises.
    pub rate_hz: f64,
    /// How long it may be silent, or behind its setpoints, s.
    pub patience_s: f64,
}

/// Why a driver cannot be waited for in that way.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum PatienceError {
    /// No patience that anybody should have.
    #[error("--driver-patience is {given_s} s: write one from 10ms to 2s")]
    Range {
        /// What was asked for, s.
        given_s: f64,
    },
    /// The driver speaks too rarely for it.
    #[error(
        "--driver-patience is {given_s} s, and the driver tells its state {rate_hz} times a second: give it three of its periods, {least_s:.3} s, or a higher rate_hz"
    )]
    Short {
        /// What was asked for, s.
        given_s: f64,
        /// The driver's rate, 1/s.
        rate_hz: f64,
        /// The least that goes with it, s.
        least_s: f64,
    },
}

impl DriverConfig {
    /// A driver that tells its state `rate_hz` times a second is waited for during `patience_s`.
    ///
    /// # Errors
    /// [`PatienceError`].
    pub fn new(rate_hz: f64, patience_s: f64) -> Result<Self, PatienceError> {
        let given_s = patience_s;
        if !(PATIENCES_S.0..=PATIENCES_S.1).contains(&given_s) {
            return Err(PatienceError::Range { given_s });
        }
        let least_s = PERIODS / rate_hz;
        if !(given_s >= least_s) {
            return Err(PatienceError::Short {
                given_s,
                rate_hz,
                least_s,
            });
        }
        Ok(Self {
            rate_hz,
            patience_s,
        })
    }
}

/// The servo's end of a driver.
pub struct DriverArm {
    arm: Arc<ArmModel>,
    dynamics: Dynamics,
    config: DriverConfig,
    heard: rtrb::Consumer<Heard>,
    setpoints: rtrb::Producer<Sent>,
    state: ArmState,
    heard_at: Option<Mono>,
    /// The first tick: silence counts from it.
    began: Option<Mono>,
    fault: Option<ArmFault>,
    seq: u64,
    obeyed: u64,
    /// The opening that the gripper was sent last, or told to have at the start.
    told: Option<f64>,
    /// When the newest setpoints were made, and their positions.
    made: Box<[(Mono, Joints); REMEMBERED]>,
}

impl DriverArm {
    /// The end of a driver whose `arm` is in `state`.
    pub fn new(
        arm: Arc<ArmModel>,
        config: DriverConfig,
        state: ArmState,
        heard: rtrb::Consumer<Heard>,
        setpoints: rtrb::Producer<Sent>,
    ) -> Self {
        Self {
            arm,
            dynamics: Dynamics::new(),
            config,
            heard,
            setpoints,
            made: Box::new([(Mono(0), state.q); REMEMBERED]),
            told: state.opening,
            state,
            heard_at: None,
            began: None,
            fault: None,
            seq: 0,
            obeyed: 0,
        }
    }

    /// Whether the joints can be there, with what they were before, `since_s` ago.
    fn judge(&self, state: &ArmState, since_s: Option<f64>) -> Result<(), ArmFault> {
        let period_s = 1.0 / self.config.rate_hz;
        for (i, joint) in self.arm.joints().iter().enumerate() {
            let n = i as u8;
            let (at, speed) = (state.q[i], state.qd[i]);
            if !(at >= joint.lower - BEYOND && at <= joint.upper + BEYOND) {
                return Err(ArmFault::Outside { joint: n, at });
            }
            let fastest = joint.velocity * TOO_FAST.0 + TOO_FAST.1;
            if !(speed.abs() <= fastest) {
                return Err(ArmFault::TooFast { joint: n, speed });
            }
            let by = at - self.state.q[i];
            // Two states that arrive at once were a period apart.
            let span_s = since_s.unwrap_or(self.config.patience_s).max(period_s) + period_s;
            if !(by.abs() <= fastest * span_s + LEAP) {
                return Err(ArmFault::Leapt { joint: n, by });
            }
        }
        Ok(())
    }

    /// Whether the arm, when it was last heard of, obeyed the setpoints of then and was where they had told it to be.
    fn follows(&self) -> Result<(), ArmFault> {
        let (1.., Some(heard_at)) = (self.seq, self.heard_at) else {
            return Ok(());
        };
        let obeyed = self.obeyed;
        let waiting = self.seq - obeyed;
        if waiting > 0 {
            let since = if waiting as usize >= REMEMBERED {
                f64::INFINITY
            } else {
                heard_at.secs_since(self.made[(obeyed + 1) as usize % REMEMBERED].0)
            };
            if since > self.config.patience_s {
                let behind_ms = (since * 1e3).min(f64::from(u32::MAX)) as u32;
                return Err(ArmFault::Lagging { behind_ms });
            }
        }
        let told = &self.made[obeyed as usize % REMEMBERED].1;
        for (i, joint) in self.arm.joints().iter().enumerate() {
            let by = self.state.q[i] - told[i];
            if by.abs() > joint.velocity * self.config.patience_s + LEAP {
                return Err(ArmFault::Astray { joint: i as u8, by });
            }
        }
        Ok(())
    }
}

impl Manipulator for DriverArm {
    fn sense(&mut self, now: Mono) -> (ArmState, Option<ArmFault>) {
        let began = *self.began.get_or_insert(now);
        while let Ok(heard) = self.heard.pop() {
            let found = match heard {
                _ if self.fault.is_some() => continue,
                Heard::Fault(fault) => Err(fault),
                Heard::State { obeyed, .. } if obeyed > self.seq => Err(ArmFault::Unmade {
                    seq: obeyed,
                    newest: self.seq,
                }),
                Heard::State {
                    at,
                    mut state,
                    obeyed,
                } => {
                    let since_s = self.heard_at.map(|last| at.secs_since(last));
                    // A gripper that tells nothing is where it was sent.
                    state.opening = state.opening.or(self.told);
                    self.judge(&state, since_s).map(|()| {
                        (self.state, self.heard_at) = (state, Some(at));
                        self.obeyed = obeyed;
                    })
                }
            };
            self.fault = found.err();
        }
        if self.fault.is_none() {
            let silent_s = now.secs_since(self.heard_at.unwrap_or(began));
            self.fault = if silent_s > self.config.patience_s {
                let silent_ms = (silent_s * 1e3) as u32;
                Some(ArmFault::Stalled { silent_ms })
            } else {
                self.follows().err()
            };
        }
        (self.state, self.fault)
    }

    fn act(&mut self, now: Mono, setpoint: &Setpoint, _dt_s: f64) -> (PlantReport, ArmState) {
        self.seq += 1;
        let reference = &setpoint.reference;
        self.made[self.seq as usize % REMEMBERED] = (now, reference.q);
        // The driver closes its own loop: what it is given is what the reference takes, not what an error adds.
        self.dynamics.update(&self.arm, &reference.q);
        let carried = self.dynamics.rnea(&reference.qd, &reference.qdd);
        let most = self.arm.per_joint(|joint| joint.effort);
        let tau = carried + self.arm.friction(&reference.qd);
        let tau = tau.zip_map(&most, |tau, most| tau.clamp(-most, most));
        if let Some(opening) = setpoint.opening.filter(|opening| opening.is_finite()) {
            self.told = Some(opening.clamp(0.0, 1.0));
        }
        // A full ring is a driver that does not read: it is told from the setpoint it obeys.
        let _ = self.setpoints.push(Sent {
            seq: self.seq,
            at: now,
            setpoint: Setpoint {
                reference: *reference,
                tau,
                opening: self.told,
            },
        });
        (PlantReport::default(), self.state)
    }
}
