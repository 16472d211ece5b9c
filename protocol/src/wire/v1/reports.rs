//! What the robot says of itself in datagrams.

use serde::{Deserialize, Serialize};

use super::{MAX_JOINTS, RobotState, WireRotation, finite, require};
use crate::wire::codec::DecodeError;

/// Robot → operator, datagrams.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum RobotDatagram {
    /// Asks for the session clock.
    Ping {
        /// The session's epoch.
        epoch: u32,
        /// When this left, µs on the robot's own clock.
        t1_us: i64,
    },
    /// How the robot is.
    Telemetry(Telemetry),
    /// What has become of the operator's motions on their way.
    Reception(Reception),
    /// How the servo keeps its time.
    Servo(ServoTimes),
}

/// How the robot is.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Telemetry {
    /// The session's epoch.
    pub epoch: u32,
    /// Counts up.
    pub seq: u32,
    /// The state.
    pub state: RobotState,
    /// The engagement followed last.
    pub engagement: u32,
    /// When this holds, µs on the session clock as the robot estimates it; 0 while unknown.
    pub t_us: i64,
    /// Bound of that estimate's error, µs.
    pub clock_uncertainty_us: u32,
    /// Age of the newest hand state, ms.
    pub age_ms: u16,
    /// One-way delay of the newest motion, on the estimated clock, ms.
    pub delay_ms: u16,
    /// Path knots held without a gap: everything before this number is acknowledged.
    pub path_frontier: u32,
    /// Motions and goes of the session that arrived, each counted once.
    pub received: u32,
    /// The highest number of one that has arrived.
    pub newest_seq: u32,
    /// Motions dropped: late, foreign, malformed.
    pub dropped: u32,
    /// Ticks on which a limit was active in this engagement.
    pub clamps: u32,
    /// Tip, m in base axes.
    pub tip_m: [f32; 3],
    /// The tip's orientation, to base axes.
    pub tip_q: WireRotation,
    /// How far the gripper is open, in steps of 1/255, if there is one.
    pub grip: Option<u8>,
    /// Joint positions, rad or m.
    pub q: Vec<f32>,
}

/// What has become of the operator's motions on their way, since the session began.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reception {
    /// The session's epoch.
    pub epoch: u32,
    /// The highest number of a motion or go that has arrived.
    pub newest_seq: u32,
    /// Numbers that arrived, each counted once: the others up to the newest are lost, or late.
    pub received: u32,
    /// Arrivals of a number that had arrived before.
    pub duplicates: u32,
    /// Arrivals after a higher number.
    pub reordered: u32,
    /// Runs of consecutive numbers that did not arrive.
    pub loss_runs: u32,
    /// The longest of them.
    pub longest_loss_run: u32,
    /// Interarrival jitter (RFC 3550 §6.4.1), µs.
    pub jitter_us: u32,
    /// One-way delay on the estimated clock: mean, median, 95 % quantile, largest, µs.
    pub delay_us: [u32; 4],
    /// Age of the hand state that was followed, over the servo ticks: the same four, µs.
    pub age_us: [u32; 4],
}

/// How the servo keeps its time, since it was started.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ServoTimes {
    /// The session's epoch.
    pub epoch: u32,
    /// Ticks.
    pub ticks: u64,
    /// Ticks that began late by more than a period.
    pub overruns: u32,
    /// Mean work of a tick, ns.
    pub mean_ns: u32,
    /// Work of a tick: median, 99 % and 99.9 % quantile, largest, ns.
    pub work_ns: [u32; 4],
    /// How late after its deadline a tick began: the same four, ns.
    pub wake_ns: [u32; 4],
}

impl RobotDatagram {
    pub(super) fn check(&self) -> Result<(), DecodeError> {
        match self {
            Self::Ping { .. } | Self::Reception(_) | Self::Servo(_) => Ok(()),
            Self::Telemetry(telemetry) => {
                require(
                    telemetry.q.len() <= MAX_JOINTS,
                    "telemetry.q",
                    "more than 10 joints",
                )?;
                require(
                    finite(&telemetry.q) && finite(&telemetry.tip_m),
                    "telemetry",
                    "not finite",
                )?;
                telemetry.tip_q.check("telemetry.tip_q")
            }
        }
    }
}
