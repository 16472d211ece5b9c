//! What a run leaves behind, whoever followed: the same for ours and for the baselines.

use nalgebra::{UnitQuaternion, Vector3};

/// One servo tick; times are the recording's.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tick {
    pub(super) t_s: f64,
    /// The tip, mapped back to the hand, m.
    pub(super) tip_m: Vector3<f64>,
    pub(super) turn: Option<UnitQuaternion<f64>>,
    /// Of what moves the arm, m/s³ at the tip.
    pub(super) jerk_m_s3: f64,
    /// Whether a limit acted.
    pub(super) limited: bool,
    /// Whether the arm is led, be it by an old message.
    pub(super) follows: bool,
    /// Of what the arm follows, s; none where it follows nothing.
    pub(super) age_s: Option<f64>,
}

/// One packet on its way, all headers included.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Packet {
    /// From operator to robot.
    pub(super) up: bool,
    /// When it was sent, s of the recording.
    pub(super) sent_s: f64,
    pub(super) bytes: usize,
    /// When it arrived; `None` if it was lost.
    pub(super) arrived_s: Option<f64>,
}

/// How the following ended.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Outcome {
    /// With the recording.
    Followed,
    /// Before it, at this time of the recording (s), and why.
    Stopped(f64, String),
    /// It never began.
    NotDriven(String),
}

/// A run.
#[derive(Debug, Clone)]
pub(super) struct Trace {
    /// In order of time.
    pub(super) ticks: Vec<Tick>,
    /// In the order they were sent; none where nobody saw them.
    pub(super) packets: Option<Vec<Packet>>,
    pub(super) outcome: Outcome,
    /// Motion messages sent while the recording lasts.
    pub(super) messages: u32,
    /// Checkpoints of the path made meanwhile, or of the plan sent.
    pub(super) knots: u32,
    /// Tip metres per hand metre.
    pub(super) scale: f64,
    /// When the operator heard from the robot, and when that was true (as far as is known), s of the recording; none where
    /// it does not say.
    pub(super) heard_s: Option<Vec<(f64, Option<f64>)>>,
    /// Seconds of CPU per second that the operator's and the robot's process took; none where they are no processes.
    pub(super) cpu: Option<(f64, f64)>,
    /// How long it ran, s: on a virtual clock, or in truth.
    pub(super) simulated_s: f64,
}
