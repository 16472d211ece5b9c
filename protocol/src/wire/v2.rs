//! Version 2, an experiment that nobody speaks by default: version 1 but for one message, to prove that two ends of
//! different ages find what both speak.
//!
//! `Pong` says for how long the ping was held instead of when the answer left: { `epoch` u32, `t1_us` i64, `t2_us` i64,
//! `held_us` u32 }, t₃ = t₂ + held. An answer that leaves before the ping arrived, which version 1 has to ignore, cannot
//! be said. Its index is version 1's.

use serde::{Deserialize, Serialize};

use super::codec::{self, DecodeError};
use super::v1::{MAX_DATAGRAM_LEN, Message, OperatorDatagram};

/// The version this module speaks.
pub const VERSION: u16 = 2;

/// Index of `Pong` among the operator's datagrams, and its one byte on the wire.
const PONG: u8 = 2;

#[derive(Serialize, Deserialize)]
struct Pong {
    index: u32,
    epoch: u32,
    t1_us: i64,
    t2_us: i64,
    held_us: u32,
}

pub(super) fn encode_operator_datagram(message: &OperatorDatagram) -> Vec<u8> {
    let &OperatorDatagram::Pong {
        epoch,
        t1_us,
        t2_us,
        t3_us,
    } = message
    else {
        return message.encode();
    };
    codec::encode(&Pong {
        index: PONG.into(),
        epoch,
        t1_us,
        t2_us,
        held_us: t3_us
            .saturating_sub(t2_us)
            .clamp(0, u32::MAX.into())
            .try_into()
            .expect("clamped to what it holds"),
    })
}

pub(super) fn decode_operator_datagram(bytes: &[u8]) -> Result<OperatorDatagram, DecodeError> {
    if bytes.first() != Some(&PONG) {
        return OperatorDatagram::decode(bytes);
    }
    let Pong {
        epoch,
        t1_us,
        t2_us,
        held_us,
        ..
    } = codec::decode::<_, MAX_DATAGRAM_LEN>(bytes)?;
    let t3_us = t2_us
        .checked_add(held_us.into())
        .ok_or(DecodeError::Invalid {
            field: "pong.held_us",
            why: "beyond the session clock",
        })?;
    Ok(OperatorDatagram::Pong {
        epoch,
        t1_us,
        t2_us,
        t3_us,
    })
}
