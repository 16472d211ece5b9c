//! What a skill is: a motion to play, a predictor to mirror with, and where both came from.

mod bytes;
mod confidence;
#[cfg(any(test, feature = "testing"))]
mod example;
mod file;
pub(crate) mod gmm;
mod gmr;
mod predictor;
mod task;
mod turn;

use core::fmt;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::predict::{Model, ModelError, TurnModel};
use crate::wire::codec::DecodeError;

pub use confidence::{chi_squared_cdf, chi_squared_quantile};
#[cfg(any(test, feature = "testing"))]
pub use example::{example, posed_example};
pub use file::FileError;
pub use gmm::{Component, Gmm, GmmError, MAX_COMPONENTS};
pub use gmr::{Gmr, GmrError, Moving, Regressed};
pub use task::{MAX_FRAMES, Placement, TaskError, TaskFrame, TaskModel};
pub use turn::{RegressedTurn, TurnError, TurnMixture};

/// The most bytes an encoded skill may have.
pub const MAX_SKILL_BYTES: usize = 512 * 1024;

/// The most bytes a skill's name may have.
pub const MAX_NAME_BYTES: usize = 64;

/// The longest motion a skill may have, s.
pub const MAX_DURATION_S: f64 = 3600.0;

/// The most demonstrations a skill may name as its origin.
pub const MAX_SOURCES: usize = 256;

/// Which skill: the first 16 bytes of the SHA-256 of its encoding.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct SkillId(pub [u8; 16]);

impl fmt::Display for SkillId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|b| write!(f, "{b:02x}"))
    }
}

impl fmt::Debug for SkillId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "SkillId({self})")
    }
}

/// How the demonstrations moved, in SI units: what a mapping onto an arm needs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Stats {
    /// 95 % quantile of the speed, m/s.
    pub speed95_m_s: f64,
    /// 95 % quantile of the acceleration, m/s².
    pub acceleration95_m_s2: f64,
    /// The farthest any demonstration gets from its own first position, m.
    pub reach_m: f64,
    /// Lower corner of the box around all positions, m.
    pub min: Vector3<f64>,
    /// Upper corner of the box around all positions, m.
    pub max: Vector3<f64>,
}

/// How long performances take: durations are log-normal, since a performance half as long is as likely as
/// one twice as long.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Pace {
    /// Mean of the logarithm of the duration in seconds.
    pub mean_ln_s: f64,
    /// Its standard deviation, > 0.
    pub deviation_ln: f64,
}

impl Pace {
    /// The duration that a share `p` of performances stays below, s: its median at 0.5. `None` unless
    /// 0 < p < 1.
    pub fn quantile_s(&self, p: f64) -> Option<f64> {
        // A squared standard normal has one degree of freedom.
        let z = chi_squared_quantile((2.0 * p - 1.0).abs(), 1)?.sqrt();
        let z = if p < 0.5 { -z } else { z };
        Some(libm::exp(self.mean_ln_s + z * self.deviation_ln))
    }
}

/// How much a skill has seen, so that a further demonstration weighs what it should.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Samples {
    /// Rows the motion's mixture was fitted to, ≥ 1.
    pub motion: u32,
    /// Rows the predictor was trained on, ≥ 1.
    pub predictor: u32,
}

/// Orientation, where the demonstrations have it.
#[derive(Debug, Clone, PartialEq)]
pub struct Turn {
    /// What to play: a mixture over time and orientation.
    pub motion: TurnMixture,
    /// What to mirror with.
    pub predictor: TurnModel,
}

/// One demonstration a skill was learned from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Source {
    /// The demonstration's name.
    pub name: String,
    /// SHA-256 of the file's bytes: what was trained on is never replayed as if unseen.
    pub sha256: [u8; 32],
}

/// Where a skill came from, so that it can be learned again to the byte.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Provenance {
    /// The program that learned it, and its version.
    pub producer: String,
    /// Seed of every random choice in learning.
    pub seed: u64,
    /// The demonstrations, in the order they were used.
    pub sources: Vec<Source>,
}

/// Why numbers are not a skill.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SkillError {
    /// The bytes are not an encoding, or not a canonical one.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// The motion is not a mixture.
    #[error("motion: {0}")]
    Motion(#[from] GmmError),
    /// The predictor is not one.
    #[error(transparent)]
    Predictor(#[from] ModelError),
    /// The orientation's mixture is not one.
    #[error("orientation: {0}")]
    Turn(#[from] TurnError),
    /// The frames are not a motion.
    #[error(transparent)]
    Task(#[from] TaskError),
    /// The durations' distribution is not one.
    #[error("pace: {field} is not usable")]
    Pace {
        /// Which number.
        field: &'static str,
    },
    /// It was learned from nothing.
    #[error("samples: none for the {field}")]
    Samples {
        /// Of what.
        field: &'static str,
    },
    /// The name is empty or too long.
    #[error("a name of {bytes} bytes, 1 to {MAX_NAME_BYTES} are allowed")]
    Name {
        /// Its length.
        bytes: usize,
    },
    /// The duration is not a positive number, or longer than [`MAX_DURATION_S`].
    #[error("a duration of {seconds} s: more than 0 s and at most an hour are possible")]
    Duration {
        /// The duration, s.
        seconds: f64,
    },
    /// A statistic of the demonstrations is negative, not finite or contradicts another.
    #[error("statistics: {field} is not usable")]
    Stats {
        /// Which.
        field: &'static str,
    },
    /// The provenance is longer than allowed.
    #[error("provenance: {field} is too long")]
    Provenance {
        /// Which.
        field: &'static str,
    },
}

/// What a skill is made of.
#[derive(Debug, Clone, PartialEq)]
pub struct Parts {
    /// Its name, 1 to [`MAX_NAME_BYTES`] bytes.
    pub name: String,
    /// The motion to play: a mixture over (t s, x m, y m, z m), t from 0 to `duration_s`.
    pub motion: Gmm<4>,
    /// How long the motion takes as played, s, at most [`MAX_DURATION_S`].
    pub duration_s: f64,
    /// How long it took to perform.
    pub pace: Pace,
    /// The predictor to mirror with.
    pub predictor: Model,
    /// Orientation, where demonstrated.
    pub turn: Option<Turn>,
    /// The gripper to play, where demonstrated: a mixture over (t s, opening 0 to 1).
    pub grip: Option<Gmm<2>>,
    /// The motion relative to frames, where it was learned so.
    pub task: Option<TaskModel>,
    /// How the demonstrations moved.
    pub stats: Stats,
    /// How much was seen of them.
    pub samples: Samples,
    /// Where the skill came from.
    pub provenance: Provenance,
}

/// A learned skill. It exists only in the form its encoding gives it: a predictor's numbers are
/// rounded on construction as they travel, so that whoever learned it runs what everybody else runs.
#[derive(Debug, Clone, PartialEq)]
pub struct Skill {
    parts: Parts,
    id: SkillId,
    bytes: Vec<u8>,
}

impl Skill {
    /// Checks, encodes and decodes a skill.
    ///
    /// # Errors
    /// [`SkillError`], one variant a cause.
    pub fn new(parts: Parts) -> Result<Self, SkillError> {
        Self::from_bytes(&bytes::encode(parts))
    }

    /// Decodes and checks a skill of at most [`MAX_SKILL_BYTES`].
    ///
    /// # Errors
    /// [`SkillError`], one variant a cause.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, SkillError> {
        bytes::decode(bytes)
    }

    /// The canonical encoding; [`Skill::from_bytes`] of it is this skill.
    pub fn to_bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Which skill this is: a hash of its encoding.
    pub fn id(&self) -> SkillId {
        self.id
    }

    /// All it is made of.
    pub fn parts(&self) -> &Parts {
        &self.parts
    }

    /// Its name, 1 to [`MAX_NAME_BYTES`] bytes.
    pub fn name(&self) -> &str {
        &self.parts.name
    }

    /// The motion to play: a mixture over (t s, x m, y m, z m).
    pub fn motion(&self) -> &Gmm<4> {
        &self.parts.motion
    }

    /// How long the motion takes as played, s.
    pub fn duration_s(&self) -> f64 {
        self.parts.duration_s
    }

    /// How long it took to perform.
    pub fn pace(&self) -> &Pace {
        &self.parts.pace
    }

    /// The predictor to mirror with.
    pub fn predictor(&self) -> &Model {
        &self.parts.predictor
    }

    /// Orientation, where demonstrated.
    pub fn turn(&self) -> Option<&Turn> {
        self.parts.turn.as_ref()
    }

    /// The gripper to play, where demonstrated.
    pub fn grip(&self) -> Option<&Gmm<2>> {
        self.parts.grip.as_ref()
    }

    /// The motion relative to frames, where it was learned so.
    pub fn task(&self) -> Option<&TaskModel> {
        self.parts.task.as_ref()
    }

    /// How the demonstrations moved.
    pub fn stats(&self) -> &Stats {
        &self.parts.stats
    }

    /// Where the skill came from.
    pub fn provenance(&self) -> &Provenance {
        &self.parts.provenance
    }

    /// Whether a recording with this SHA-256 was trained on.
    pub fn was_trained_on(&self, sha256: &[u8; 32]) -> bool {
        self.parts
            .provenance
            .sources
            .iter()
            .any(|s| s.sha256 == *sha256)
    }
}

#[cfg(test)]
mod tests;

fn sha256(bytes: &[u8]) -> [u8; 32] {
    Sha256::digest(bytes).into()
}
