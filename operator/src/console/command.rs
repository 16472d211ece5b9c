//! What a page may say: one JSON object a message, checked before anything is done.

use serde::{Deserialize, Serialize};

/// Longest command, bytes.
pub const MAX_COMMAND_LEN: usize = 1024;

/// Nobody's hand is farther from the base, m.
pub const MAX_HAND_M: f64 = 5.0;

/// Longest name of a skill that is taught in the page, characters.
pub const MAX_NAME: usize = 32;

/// A command of a page.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(tag = "do", rename_all = "lowercase", deny_unknown_fields)]
pub enum Command {
    /// Presses the clutch: `hand` drives the arm, `record` takes a stroke, `play` plays a skill. All only while it is held.
    Hold {
        /// What for.
        what: Holding,
        /// Of `play`: which skill.
        skill: Option<String>,
        /// The page's clock, ms.
        t: f64,
        /// The hand, m in base axes.
        x: [f64; 3],
    },
    /// The hand, while the clutch is held.
    Hand {
        /// The page's clock, ms.
        t: f64,
        /// The hand, m in base axes.
        x: [f64; 3],
    },
    /// The clutch is still held.
    Alive {},
    /// Lets go of the clutch.
    Release {},
    /// Emergency stop.
    Stop {},
    /// Leaves the latched stop that the page shows.
    Reset {
        /// The `changes` of the robot as the page was shown them.
        changes: u32,
    },
    /// Prediction gain κ.
    Predict {
        /// In [0, 1].
        gain: f64,
    },
    /// Forgets the stroke recorded last.
    Discard {},
    /// Learns a skill from the strokes.
    Learn {
        /// What it is to be called.
        name: String,
    },
    /// Goes on with this skill.
    Use {
        /// Its name.
        skill: String,
    },
    /// Sets the link, where it is one that can be set.
    Link(Shape),
}

/// What the clutch is held for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Holding {
    /// The arm follows.
    Hand,
    /// A stroke is recorded, and the arm stays.
    Record,
    /// A skill is played.
    Play,
}

/// What a demonstration's link does, the same both ways.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Shape {
    /// Delay one way, ms.
    pub delay_ms: f64,
    /// Uniform spread around it, ms.
    pub jitter_ms: f64,
    /// Packets lost, of a hundred.
    pub loss_percent: f64,
}

/// Why a command is not obeyed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum BadCommand {
    /// It is too long.
    #[error("{len} bytes: a command has at most {MAX_COMMAND_LEN}")]
    TooLong {
        /// Its length.
        len: usize,
    },
    /// It is no command.
    #[error("not a command: {0}")]
    NoCommand(String),
    /// A number is not finite, or outside what it may be.
    #[error("{field} is {value}: it must be from {least} to {most}")]
    OutOfRange {
        /// Which.
        field: &'static str,
        /// What it is.
        value: f64,
        /// At least.
        least: f64,
        /// At most.
        most: f64,
    },
    /// A name that is none.
    #[error(
        "a skill's name has 1 to {MAX_NAME} characters, none of them a slash, a dot in front or a control character"
    )]
    Name,
}

fn within(field: &'static str, value: f64, least: f64, most: f64) -> Result<(), BadCommand> {
    if (least..=most).contains(&value) {
        Ok(())
    } else {
        Err(BadCommand::OutOfRange {
            field,
            value,
            least,
            most,
        })
    }
}

fn name(name: &str) -> Result<(), BadCommand> {
    let wrong = |c: char| c.is_control() || c == '/' || c == '\\';
    let fits = (1..=MAX_NAME).contains(&name.chars().count());
    if fits && name.trim() == name && !name.starts_with('.') && !name.contains(wrong) {
        Ok(())
    } else {
        Err(BadCommand::Name)
    }
}

impl Shape {
    fn check(&self) -> Result<(), BadCommand> {
        within("delay_ms", self.delay_ms, 0.0, 2000.0)?;
        within("jitter_ms", self.jitter_ms, 0.0, 1000.0)?;
        within("loss_percent", self.loss_percent, 0.0, 100.0)
    }
}

impl Command {
    /// The command of a message.
    ///
    /// # Errors
    /// [`BadCommand`].
    pub fn parse(text: &str) -> Result<Self, BadCommand> {
        if text.len() > MAX_COMMAND_LEN {
            return Err(BadCommand::TooLong { len: text.len() });
        }
        let command: Self =
            serde_json::from_str(text).map_err(|e| BadCommand::NoCommand(e.to_string()))?;
        match &command {
            Self::Hold { t, x, skill, .. } => {
                skill.as_deref().map_or(Ok(()), name)?;
                at(*t, x)?;
            }
            Self::Hand { t, x } => at(*t, x)?,
            Self::Predict { gain } => within("gain", *gain, 0.0, 1.0)?,
            Self::Learn { name: given } => name(given)?,
            Self::Use { skill } => name(skill)?,
            Self::Link(shape) => shape.check()?,
            Self::Alive {}
            | Self::Release {}
            | Self::Stop {}
            | Self::Reset { .. }
            | Self::Discard {} => {}
        }
        Ok(command)
    }
}

fn at(t: f64, x: &[f64; 3]) -> Result<(), BadCommand> {
    within("t", t, 0.0, 1e12)?;
    x.iter()
        .try_for_each(|v| within("x", *v, -MAX_HAND_M, MAX_HAND_M))
}
