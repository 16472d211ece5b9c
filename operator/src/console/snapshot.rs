//! What a page is shown, at one moment.

use std::sync::Arc;

use serde::Serialize;
use telemime_protocol::wire::arm::WireArm;

use super::Shape;

/// Everything a page shows, complete: one that misses some of them has missed nothing. Places are m in base axes, where
/// the arm's tip is to be; times are ms on the session clock.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Snapshot {
    /// When.
    pub t: f64,
    /// Whether there is a session with a robot …
    pub linked: bool,
    /// … and if not, why.
    pub why: String,
    /// Sent apart, once.
    #[serde(skip)]
    pub built: Option<Arc<WireArm>>,
    /// Whose clutch is held: a page's number.
    #[serde(skip)]
    pub holder: Option<u64>,
    /// What for.
    pub driving: Option<&'static str>,
    /// What the robot said of itself.
    pub robot: Option<Robot>,
    /// Where the arm is.
    pub arm: Option<Arm>,
    /// The hand.
    pub hand: Option<HandShown>,
    /// What is added to the page's hand.
    pub offset: [f64; 3],
    /// What the robot predicts of the hand from now on: x, y, z, deviation.
    pub path: Vec<[f64; 4]>,
    /// The newest checkpoints: x, y, z, and 1 if the robot holds it.
    pub knots: Vec<[f64; 4]>,
    /// What was sent.
    pub sent: Sent,
    /// What the hand does.
    pub seen: Option<Seen>,
    /// Prediction gain κ.
    pub gain: f64,
    /// Lengths of the strokes recorded, s.
    pub strokes: Vec<f64>,
    /// A skill is being learned.
    pub learning: bool,
    /// The skills there are.
    pub skills: Vec<String>,
    /// The one that mirrors.
    pub using: Option<String>,
    /// The link, where it can be set.
    pub shape: Option<Shape>,
    /// Commands that were not obeyed.
    pub refused: u64,
    /// The last things worth saying, numbered.
    pub notes: Vec<(u64, String)>,
}

/// The robot.
#[derive(Debug, Clone, Serialize)]
pub struct Robot {
    /// Its name.
    pub name: String,
    /// Its state …
    pub state: String,
    /// … why …
    pub cause: String,
    /// … and how often it has changed: a reset names it.
    pub changes: u32,
    /// Largest tip speed, m/s.
    pub speed_m_s: f32,
    /// How far the tip may go, m.
    pub radius_m: f32,
    /// From target to tip, ms.
    pub lag_ms: f64,
}

/// The newest report of the arm.
#[derive(Debug, Clone, Serialize)]
pub struct Arm {
    /// When it held.
    pub t: f64,
    /// Joints, rad or m.
    pub q: Vec<f32>,
    /// The tip.
    pub tip: [f32; 3],
    /// Age of what the robot knew of the hand, ms.
    pub age_ms: u16,
    /// One-way delay, ms.
    pub delay_ms: u16,
    /// How well the robot knows the clock, µs.
    pub uncertainty_us: u32,
    /// Ticks on which a limit was active.
    pub clamps: u32,
    /// Motions that never came.
    pub lost: u32,
}

/// The hand, where the tip is to be.
#[derive(Debug, Clone, Serialize)]
pub struct HandShown {
    /// When it was there.
    pub t: f64,
    /// Where.
    pub p: [f64; 3],
}

/// What was sent so far.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Sent {
    /// To the robot, with all headers.
    pub bytes: u64,
    /// Motion messages.
    pub messages: u32,
}

/// What the hand is recognised to do.
#[derive(Debug, Clone, Serialize)]
pub struct Seen {
    /// In words, if it is no skill.
    pub what: String,
    /// The skill.
    pub skill: Option<String>,
    /// How probable.
    pub probability: f64,
    /// How far it has got, 0 to 1.
    pub phase: f64,
}
