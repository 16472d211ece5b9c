//! What a session says: bytes to send, events, counts.

use super::correct::{Bent, Change};
use crate::recognise::Verdict;
use std::fmt;

use nalgebra::UnitQuaternion;
use serde::{Deserialize, Serialize};
use telemime_endpoint::reception::{Quantiles, Received, Reception};
use telemime_protocol::wire::v1::{
    Cause, Reception as Told, Refusal, RobotState, ServoTimes, Telemetry,
};

/// What a session wants sent.
#[derive(Debug, Clone, PartialEq)]
pub enum Output {
    /// A message for the control stream, not yet framed.
    Control(Vec<u8>),
    /// A datagram.
    Datagram {
        /// Its bytes.
        bytes: Vec<u8>,
        /// Whether it carries motion (the others keep time).
        motion: bool,
    },
}

/// What has happened.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// The robot has introduced itself, and holds the model.
    Ready,
    /// The arm follows.
    Engaged {
        /// Which engagement.
        engagement: u32,
        /// When, µs on the session clock as the robot estimates it.
        t_us: i64,
        /// The hand position that corresponds to `tip_m`, m.
        hand_m: [f32; 3],
        /// The tip at that instant, m.
        tip_m: [f32; 3],
        /// The hand's orientation that corresponds to `tip_q`, where it is followed.
        hand_q: Option<UnitQuaternion<f64>>,
        /// The tip's orientation at that instant, to base axes.
        tip_q: UnitQuaternion<f64>,
    },
    /// A request was declined.
    Refused(Refusal),
    /// The robot's state changed.
    State(RobotState, Cause),
    /// The hand does something else than before, or is surer or farther on by a twentieth than was said last; for display.
    Recognised {
        /// What.
        verdict: Verdict,
        /// The skill's name, if it is one.
        skill: Option<String>,
        /// How probable that is, in [0, 1].
        probability: f64,
        /// How far it has got, in [0, 1].
        phase: f64,
        /// The verdict is the one that was said last.
        again: bool,
    },
    /// A hand takes hold of what is played, or lets it go.
    Correction(Change),
    /// What the robot was told to make of the plan.
    Bent(Bent),
    /// News of the robot.
    Telemetry(Box<Telemetry>),
}

/// What the session counts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counters {
    /// Samples taken from the request that was granted to the release, those made up at rest left out.
    pub samples: u32,
    /// Those at rest.
    pub rest_samples: u32,
    /// Motions and goes sent, from that request on.
    pub messages: u32,
    /// Those of them that were sent before the first sample that is not at rest.
    pub rest_messages: u32,
    /// Path knots made.
    pub knots: u32,
    /// Those of them that were made before the first sample that is not at rest.
    pub rest_knots: u32,
    /// Samples replaced by their prediction, and not taken back.
    pub glitches: u32,
    /// Datagrams dropped.
    pub dropped: u32,
}

impl Counters {
    /// Adds another session's counts.
    pub fn add(&mut self, other: Self) {
        self.samples += other.samples;
        self.rest_samples += other.rest_samples;
        self.messages += other.messages;
        self.rest_messages += other.rest_messages;
        self.knots += other.knots;
        self.rest_knots += other.rest_knots;
        self.glitches += other.glitches;
        self.dropped += other.dropped;
    }
}

/// What has become of a session's datagrams, each way.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Seen {
    /// Our motions and goes, as the robot said last; `None` if it has not.
    pub up: Option<Received>,
    /// How old the hand state was that the robot followed, over its servo ticks.
    pub age: Option<Quantiles>,
    /// The robot's telemetry.
    pub down: Received,
    /// How wrong the robot's estimate of the session clock may be, s: so may the delays, in opposite directions.
    pub clock_bound_s: Option<f64>,
    /// How the robot's servo has kept its time.
    pub servo: Option<ServoTimes>,
}

impl Seen {
    pub(super) fn new(up: Option<&Told>, down: &Reception, clock_us: Option<u32>) -> Self {
        let times = |us: [u32; 4]| {
            let [mean_s, p50_s, p95_s, max_s] = us.map(|us| f64::from(us) * 1e-6);
            (max_s > 0.0).then_some(Quantiles {
                mean_s,
                p50_s,
                p95_s,
                max_s,
            })
        };
        Self {
            up: up.map(|told| Received {
                received: told.received,
                lost: told.newest_seq.saturating_sub(told.received),
                duplicates: told.duplicates,
                reordered: told.reordered,
                loss_runs: told.loss_runs,
                longest_loss_run: told.longest_loss_run,
                jitter_s: f64::from(told.jitter_us) * 1e-6,
                delay: times(told.delay_us),
            }),
            age: up.and_then(|told| times(told.age_us)),
            down: down.summary(),
            clock_bound_s: clock_us
                .filter(|us| *us != u32::MAX)
                .map(|us| f64::from(us) * 1e-6),
            servo: None,
        }
    }
}

fn us(ns: u32) -> f64 {
    f64::from(ns) * 1e-3
}

impl fmt::Display for Seen {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(up) = &self.up {
            writeln!(f, "to the robot: {up}")?;
        }
        write!(f, "from the robot: {}", self.down)?;
        if let Some(age) = &self.age {
            write!(f, "\nwhat the arm followed was {age} old")?;
        }
        if let Some(bound_s) = self.clock_bound_s {
            write!(f, "; clock known to ±{:.2} ms", bound_s * 1e3)?;
        }
        if let Some(servo) = &self.servo {
            let [work, _, rarely, _] = servo.work_ns.map(us);
            let [wake, _, seldom, _] = servo.wake_ns.map(us);
            write!(
                f,
                "\nthe robot's ticks take {work:.1} µs, one in a thousand over {rarely:.1}, and begin {wake:.0} µs late, one in a thousand over {seldom:.0}; {} of {} overran",
                servo.overruns, servo.ticks
            )?;
        }
        Ok(())
    }
}
