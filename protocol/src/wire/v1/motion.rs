//! The message that is sent most: its fields as bits, none wider than it has to be (`docs/protocol.md` §5).

use serde::{Deserialize, Serialize};

use super::{DecodeError, MAX_DATAGRAM_LEN, MAX_KNOTS};
use crate::checkpoint::bits::{BitReader, BitWriter};
use crate::wire::knots::KnotBlock;
use crate::wire::params::WireParams;
use crate::wire::state::WireState;
use crate::wire::turn::{WirePose, WireTurn};

/// A lease counts in a motion in steps of this many ms …
const LEASE_STEP_MS: u16 = 10;

/// … and is at most so many of them.
const MAX_LEASE_STEPS: u16 = 255;

/// Orders of the codes (§9 of the document): epochs and engagements are few, numbers of messages and knots grow.
const SESSION_ORDER: u32 = 3;
const NUMBER_ORDER: u32 = 8;

/// Bits of the kind in the first byte, which are 0 in a motion and in no other datagram.
const KIND_BITS: u32 = 3;

/// The newest state of the hand, and the knots of its path that are not yet acknowledged.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Motion {
    /// The session's epoch.
    pub epoch: u32,
    /// The engagement this belongs to.
    pub engagement: u32,
    /// Counts up with every motion or go of the session.
    pub seq: u32,
    /// For how long motion is authorised from arrival, ms: travels in steps of 10 ms, rounded down, and as 2550 if it is more.
    pub lease_ms: u16,
    /// [`model_tag`](super::model_tag) of the model to predict with; 0 is constant velocity.
    pub model: u16,
    /// Parameters to predict with.
    pub params: WireParams,
    /// Checksum of the operator's own prediction from `state` and `pose`, in keyframes.
    pub checksum: Option<u32>,
    /// The newest hand state.
    pub state: WireState,
    /// The newest orientation and gripper, as far as the input has them.
    pub pose: WirePose,
    /// Number of the first of `knots` in the engagement's path; without knots it does not travel, and is 0.
    pub first_knot: u32,
    /// Unacknowledged knots of the path in order, the oldest first.
    pub knots: KnotBlock,
}

impl Motion {
    /// Whether bytes are meant as a motion: their first says so.
    pub(super) fn begins(bytes: &[u8]) -> bool {
        bytes
            .first()
            .is_some_and(|byte| byte & ((1 << KIND_BITS) - 1) == 0)
    }

    pub(super) fn pack(&self) -> Vec<u8> {
        let mut w = BitWriter::default();
        let (turn, grip) = (&self.pose.turn, self.pose.grip);
        let knots = !self.knots.is_empty();
        for flag in [
            self.checksum.is_some(),
            self.model != 0,
            turn.is_some(),
            grip.is_some(),
            knots,
        ] {
            w.put(u64::from(flag), 1);
        }
        w.put(0, KIND_BITS);
        w.golomb(u64::from(self.epoch), SESSION_ORDER);
        w.golomb(u64::from(self.engagement), SESSION_ORDER);
        w.golomb(u64::from(self.seq), NUMBER_ORDER);
        w.put(
            u64::from((self.lease_ms / LEASE_STEP_MS).min(MAX_LEASE_STEPS)),
            8,
        );
        if self.model != 0 {
            w.put(u64::from(self.model), 16);
        }
        self.params.write(&mut w);
        if let Some(checksum) = self.checksum {
            w.put(u64::from(checksum), 32);
        }
        self.state.write(&mut w);
        if let Some(turn) = turn {
            turn.write(&mut w);
        }
        if let Some(grip) = grip {
            w.put(u64::from(grip), 8);
        }
        if knots {
            w.golomb(u64::from(self.first_knot), NUMBER_ORDER);
        }
        let mut bytes = w.finish();
        bytes.extend(&self.knots.0);
        bytes
    }

    /// From exactly these bytes; ranges are the caller's to check.
    pub(super) fn unpack(bytes: &[u8]) -> Result<Self, DecodeError> {
        if bytes.len() > MAX_DATAGRAM_LEN {
            return Err(DecodeError::TooLong {
                len: bytes.len(),
                limit: MAX_DATAGRAM_LEN,
            });
        }
        let mut r = BitReader::new(bytes);
        let (mut motion, knots) = Self::read(&mut r).ok_or_else(|| {
            DecodeError::Malformed("the bits end too soon, or hold a number that is none".into())
        })?;
        let rest = r.rest();
        if knots {
            motion.knots = KnotBlock(rest.to_vec());
        } else if !rest.is_empty() {
            return Err(DecodeError::Trailing(rest.len()));
        }
        if motion.pack() != bytes {
            return Err(DecodeError::NotCanonical);
        }
        Ok(motion)
    }

    /// The fields before the knots, and whether there are any.
    fn read(r: &mut BitReader<'_>) -> Option<(Self, bool)> {
        let mut flags = [false; 5];
        for flag in &mut flags {
            *flag = r.take(1)? == 1;
        }
        let [checksum, model, turn, grip, knots] = flags;
        r.take(KIND_BITS)?;
        let number = |r: &mut BitReader<'_>, order| u32::try_from(r.golomb(order)?).ok();
        let motion = Self {
            epoch: number(r, SESSION_ORDER)?,
            engagement: number(r, SESSION_ORDER)?,
            seq: number(r, NUMBER_ORDER)?,
            lease_ms: r.take(8)? as u16 * LEASE_STEP_MS,
            model: if model { r.take(16)? as u16 } else { 0 },
            params: WireParams::read(r)?,
            checksum: if checksum {
                Some(r.take(32)? as u32)
            } else {
                None
            },
            state: WireState::read(r)?,
            pose: WirePose {
                turn: if turn { Some(WireTurn::read(r)?) } else { None },
                grip: if grip { Some(r.take(8)? as u8) } else { None },
            },
            first_knot: if knots { number(r, NUMBER_ORDER)? } else { 0 },
            knots: KnotBlock::default(),
        };
        Some((motion, knots))
    }

    pub(super) fn check(&self) -> Result<(), DecodeError> {
        self.knots.check("motion.knots", MAX_KNOTS)?;
        self.state.check()?;
        self.params.check("motion.params")?;
        self.pose.check()
    }
}
