//! The one place where bytes become values: bincode 2 `config::standard()` with a length limit
//! before allocation, and canonical form required (RFC 2119 "MUST" of `docs/protocol.md` §3).

use bincode::config;
use serde::{Serialize, de::DeserializeOwned};

/// Why bytes are not a message.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// Longer than the message may be; refused before anything is read.
    #[error("{len} bytes, the limit is {limit}")]
    TooLong {
        /// Bytes received.
        len: usize,
        /// Bytes allowed.
        limit: usize,
    },
    /// Not an encoding of the type: unknown variant, truncated, or an element count beyond the limit.
    #[error("malformed: {0}")]
    Malformed(String),
    /// Bytes are left after the value.
    #[error("{0} trailing bytes")]
    Trailing(usize),
    /// The value has a shorter encoding: an integer is not minimal.
    #[error("not in canonical form")]
    NotCanonical,
    /// Decoded, but outside what the field may hold.
    #[error("{field}: {why}")]
    Invalid {
        /// The field.
        field: &'static str,
        /// What is wrong with it.
        why: &'static str,
    },
}

/// Encodes `value` in canonical form.
///
/// # Panics
/// Never for the types of this crate: none has a custom `Serialize` that can fail.
pub fn encode<T: Serialize>(value: &T) -> Vec<u8> {
    bincode::serde::encode_to_vec(value, config::standard()).expect("plain data always encodes")
}

/// Decodes a `T` from exactly `bytes`.
///
/// `LIMIT` bounds both the input and what a hostile length field may claim.
///
/// # Errors
/// [`DecodeError`], one variant a cause; range checks (`Invalid`) belong to the type's own parse.
pub fn decode<T: DeserializeOwned + Serialize, const LIMIT: usize>(
    bytes: &[u8],
) -> Result<T, DecodeError> {
    if bytes.len() > LIMIT {
        return Err(DecodeError::TooLong {
            len: bytes.len(),
            limit: LIMIT,
        });
    }
    let config = config::standard().with_limit::<LIMIT>();
    let (value, used) = bincode::serde::decode_from_slice::<T, _>(bytes, config)
        .map_err(|e| DecodeError::Malformed(e.to_string()))?;
    if used != bytes.len() {
        return Err(DecodeError::Trailing(bytes.len() - used));
    }
    if encode(&value) != bytes {
        return Err(DecodeError::NotCanonical);
    }
    Ok(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn canonical_form_is_required() {
        assert_eq!(decode::<u64, 16>(&[5]), Ok(5));
        assert_eq!(
            decode::<u64, 16>(&[0xfb, 5, 0]),
            Err(DecodeError::NotCanonical)
        );
        assert_eq!(decode::<u64, 16>(&[5, 5]), Err(DecodeError::Trailing(1)));
        assert_eq!(
            decode::<u64, 4>(&[0; 5]),
            Err(DecodeError::TooLong { len: 5, limit: 4 })
        );
    }

    #[test]
    fn a_hostile_length_is_refused_before_allocation() {
        let claim = [0xfd, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0x7f];
        assert!(matches!(
            decode::<Vec<u8>, 64>(&claim),
            Err(DecodeError::Malformed(_))
        ));
    }
}
