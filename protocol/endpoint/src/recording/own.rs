//! What no schema of the viewers has: JSON, each with its JSON Schema in the file.

use foxglove::bytes::BufMut;
use foxglove::{Encode, Schema};
use serde::{Deserialize, Serialize};

/// A message of our own.
pub trait Own: Serialize {
    /// The schema's name.
    const NAME: &'static str;
    /// The schema, as JSON Schema.
    const SCHEMA: &'static str;
}

/// A message of our own, as JSON.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Json<T>(pub T);

impl<T: Own> Encode for Json<T> {
    type Error = serde_json::Error;

    fn get_schema() -> Option<Schema> {
        Some(Schema::new(T::NAME, "jsonschema", T::SCHEMA.as_bytes()))
    }

    fn get_message_encoding() -> String {
        "json".to_owned()
    }

    fn encode(&self, buf: &mut impl BufMut) -> Result<(), Self::Error> {
        serde_json::to_writer(buf.writer(), &self.0)
    }
}

/// The hand as the input had it: what demonstrations are made of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Hand {
    /// When it is valid, ns on the session clock.
    pub t_ns: i64,
    /// Where, m, in the input's own axes.
    pub x: [f64; 3],
    /// Unit quaternion w, x, y, z, from the hand's axes to the input's, where the input has it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub orientation: Option<[f64; 4]>,
    /// How far the gripper is to be open, 0 to 1, where the input says so.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub grip: Option<f64>,
    /// Made up, so that a recording begins at rest.
    pub resting: bool,
    /// The session it was taken in.
    pub session: u32,
    /// The engagement that it was asked to be followed in; 0 if it was not.
    pub engagement: u32,
}

impl Own for Hand {
    const NAME: &'static str = "telemime.Hand";
    const SCHEMA: &'static str = include_str!("schema/hand.json");
}

/// What the operator knows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OperatorState {
    /// The robot's state, as last heard: `Idle`, `Ready`, `Engaged`, `Coasting`, `Holding` or `Stopped`.
    pub robot: String,
    /// Why.
    pub cause: String,
    /// The session.
    pub session: u32,
    /// The engagement granted last; 0 before the first.
    pub engagement: u32,
    /// Tip metres per hand metre.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scale: Option<f64>,
    /// Motion messages sent, of what was granted.
    pub messages: u32,
    /// Path knots made.
    pub knots: u32,
    /// Samples taken.
    pub samples: u32,
    /// Glitches replaced.
    pub glitches: u32,
    /// Age of what the robot followed, s, as it says.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub age_s: Option<f64>,
    /// One-way delay to the robot, s, as it says.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub delay_s: Option<f64>,
    /// How wrong its session clock may be, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clock_bound_s: Option<f64>,
    /// From target to tip, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lag_s: Option<f64>,
    /// Ticks of the engagement on which a limit acted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clamps: Option<u32>,
    /// Motions that never came, as the robot says.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lost: Option<u32>,
    /// Knots that the robot holds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub knots_held: Option<u32>,
}

impl Own for OperatorState {
    const NAME: &'static str = "telemime.OperatorState";
    const SCHEMA: &'static str = include_str!("schema/operator.json");
}

/// What the robot decided at one tick.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RobotState {
    /// Counts ticks.
    pub tick: u64,
    /// When the tick began, ns on the robot's monotonic clock.
    pub mono_ns: i64,
    /// `Idle`, `Ready`, `Engaged`, `Coasting`, `Holding` or `Stopped`.
    pub state: String,
    /// Why.
    pub cause: String,
    /// The session of the engagement followed last; 0 before the first.
    pub session: u32,
    /// That engagement.
    pub engagement: u32,
    /// The arm still moves.
    pub moving: bool,
    /// Age of the newest hand state, s.
    pub age_s: f64,
    /// From target to tip, s.
    pub lag_s: f64,
    /// Ticks of the engagement on which a limit acted.
    pub clamps: u32,
    /// Path knots held of the engagement.
    pub knots: u32,
    /// Motions that came, in this session.
    pub received: u32,
    /// Motions that never came.
    pub lost: u32,
    /// How wrong the session clock may be, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clock_bound_s: Option<f64>,
    /// The plan's time while one is played, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plan_s: Option<f64>,
    /// How fast the filter's acceleration changes, m/s³.
    pub jerk_m_s3: f64,
    /// From the orientation to the one asked for, or the one being kept, rad.
    pub orientation_error_rad: f64,
    /// How far the gripper is open, 0 to 1, if that is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub opening: Option<f64>,
    /// What is wrong with the arm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fault: Option<String>,
}

impl Own for RobotState {
    const NAME: &'static str = "telemime.RobotState";
    const SCHEMA: &'static str = include_str!("schema/robot.json");
}
