//! What was dropped, and why.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// A reason to drop a frame, for counting.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Longer than a frame may be.
    Oversized,
    /// Not a frame.
    Malformed,
    /// A number that is none, or too large to be of a hand.
    NotFinite,
    /// A quaternion that is no rotation.
    NoRotation,
    /// A gripper's opening outside its range.
    Grip,
    /// The hand is not in it.
    Untracked,
    /// Not later than the frame before.
    Backwards,
    /// More frames than anybody needs.
    Flood,
    /// From another sender than the one that drives.
    Stranger,
}

/// Why a frame was dropped: what to count it by, and what to tell.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{why}")]
pub struct Fault {
    /// For counting.
    pub kind: Kind,
    /// One line for people.
    pub why: String,
}

impl Fault {
    /// A fault of this kind.
    pub(super) fn new(kind: Kind, why: impl Into<String>) -> Self {
        let why = why.into();
        Self { kind, why }
    }
}

/// What became of a source's frames.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Tally {
    /// Samples of the hand that were taken.
    pub samples: u64,
    /// Frames that were dropped, by reason.
    pub dropped: BTreeMap<Kind, u64>,
    /// How often the source was lost.
    pub lost: u32,
}

impl Tally {
    /// Counts `n` dropped frames; whether they are the first of their kind.
    pub(super) fn drop(&mut self, kind: Kind, n: u64) -> bool {
        let count = self.dropped.entry(kind).or_default();
        *count += n;
        *count == n
    }

    /// How many were dropped for this reason.
    pub fn of(&self, kind: Kind) -> u64 {
        self.dropped.get(&kind).copied().unwrap_or(0)
    }
}
