//! The greeting, whose layout is frozen for ever: the first thing on the control stream, each way.
//!
//! ```text
//! "TLMM" kind:u8 …            all integers little-endian
//!   1 Hello     min:u16 max:u16 features:u64
//!   2 HelloAck  version:u16 features:u64 epoch:u32
//!   3 Reject    code:u16 text_len:u8 text:[u8; text_len] (UTF-8)
//! ```

/// First bytes of every greeting.
pub const MAGIC: [u8; 4] = *b"TLMM";

/// Longest greeting, bytes: what a reader must be ready to hold.
pub const MAX_LEN: usize = 4 + 1 + 2 + 1 + 255;

/// What the operator opens with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Hello {
    /// Lowest version spoken.
    pub min: u16,
    /// Highest version spoken.
    pub max: u16,
    /// Optional features, one bit each; version 1 defines none.
    pub features: u64,
}

/// What the robot answers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    /// The session begins.
    Ack {
        /// The version both will speak: the lower of the two maxima.
        version: u16,
        /// The features both know.
        features: u64,
        /// This session's epoch, unique for the life of the robot daemon; every datagram carries it.
        epoch: u32,
    },
    /// There will be no session.
    Reject {
        /// Why, for machines.
        code: RejectCode,
        /// Why, for people.
        text: String,
    },
}

/// Why a robot declines a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RejectCode {
    /// No common version.
    Version,
    /// Another operator has authority.
    Busy,
    /// The greeting was malformed.
    Malformed,
    /// A code this build does not know.
    Other(u16),
}

impl RejectCode {
    fn to_u16(self) -> u16 {
        match self {
            Self::Version => 1,
            Self::Busy => 2,
            Self::Malformed => 3,
            Self::Other(code) => code,
        }
    }

    fn from_u16(code: u16) -> Self {
        match code {
            1 => Self::Version,
            2 => Self::Busy,
            3 => Self::Malformed,
            other => Self::Other(other),
        }
    }
}

/// Why bytes are not a greeting.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum HelloError {
    /// Does not begin with [`MAGIC`]: the peer is not Telemime.
    #[error("the peer does not speak Telemime")]
    Magic,
    /// An unknown kind of greeting.
    #[error("unknown greeting kind {0}")]
    Kind(u8),
    /// `min` above `max`.
    #[error("version range {min}..={max} is empty")]
    Range {
        /// Lowest claimed.
        min: u16,
        /// Highest claimed.
        max: u16,
    },
    /// A reject text that is not UTF-8.
    #[error("reject text is not UTF-8")]
    Text,
}

impl Hello {
    /// The 17 bytes of this greeting.
    pub fn encode(&self) -> Vec<u8> {
        let mut out = MAGIC.to_vec();
        out.push(1);
        out.extend(self.min.to_le_bytes());
        out.extend(self.max.to_le_bytes());
        out.extend(self.features.to_le_bytes());
        out
    }

    /// Reads a greeting from the front of `bytes`: the greeting and the bytes used, or `None` if more are needed.
    ///
    /// # Errors
    /// [`HelloError`] as soon as the bytes cannot become a `Hello`.
    pub fn decode(bytes: &[u8]) -> Result<Option<(Self, usize)>, HelloError> {
        let Some(kind) = kind(bytes)? else {
            return Ok(None);
        };
        if kind != 1 {
            return Err(HelloError::Kind(kind));
        }
        let mut reader = Reader(&bytes[5..]);
        let (Some(min), Some(max), Some(features)) = (reader.u16(), reader.u16(), reader.u64())
        else {
            return Ok(None);
        };
        if min > max {
            return Err(HelloError::Range { min, max });
        }
        Ok(Some((
            Self { min, max, features },
            bytes.len() - reader.0.len(),
        )))
    }
}

impl Answer {
    /// The bytes of this answer; a reject's text is cut at 255 bytes.
    pub fn encode(&self) -> Vec<u8> {
        let mut out = MAGIC.to_vec();
        match self {
            Self::Ack {
                version,
                features,
                epoch,
            } => {
                out.push(2);
                out.extend(version.to_le_bytes());
                out.extend(features.to_le_bytes());
                out.extend(epoch.to_le_bytes());
            }
            Self::Reject { code, text } => {
                let end = (0..=text.len().min(255))
                    .rev()
                    .find(|&i| text.is_char_boundary(i))
                    .unwrap_or(0);
                let text = &text[..end];
                out.push(3);
                out.extend(code.to_u16().to_le_bytes());
                out.push(text.len() as u8);
                out.extend(text.as_bytes());
            }
        }
        out
    }

    /// Reads an answer from the front of `bytes`: the answer and the bytes used, or `None` if more are needed.
    ///
    /// # Errors
    /// [`HelloError`] as soon as the bytes cannot become an answer.
    pub fn decode(bytes: &[u8]) -> Result<Option<(Self, usize)>, HelloError> {
        let Some(kind) = kind(bytes)? else {
            return Ok(None);
        };
        let mut reader = Reader(&bytes[5..]);
        let answer = match kind {
            2 => {
                let (Some(version), Some(features), Some(epoch)) =
                    (reader.u16(), reader.u64(), reader.u32())
                else {
                    return Ok(None);
                };
                Self::Ack {
                    version,
                    features,
                    epoch,
                }
            }
            3 => {
                let (Some(code), Some(len)) = (reader.u16(), reader.take(1)) else {
                    return Ok(None);
                };
                let Some(text) = reader.take(len[0] as usize) else {
                    return Ok(None);
                };
                let text = str::from_utf8(text)
                    .map_err(|_| HelloError::Text)?
                    .to_owned();
                Self::Reject {
                    code: RejectCode::from_u16(code),
                    text,
                }
            }
            other => return Err(HelloError::Kind(other)),
        };
        Ok(Some((answer, bytes.len() - reader.0.len())))
    }
}

/// The kind byte, once the magic has been seen whole.
fn kind(bytes: &[u8]) -> Result<Option<u8>, HelloError> {
    let seen = bytes.len().min(4);
    if bytes[..seen] != MAGIC[..seen] {
        return Err(HelloError::Magic);
    }
    Ok(bytes.get(4).copied())
}

struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    fn take(&mut self, n: usize) -> Option<&'a [u8]> {
        let (head, tail) = self.0.split_at_checked(n)?;
        self.0 = tail;
        Some(head)
    }

    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (head, tail) = self.0.split_first_chunk::<N>()?;
        self.0 = tail;
        Some(*head)
    }

    fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn greetings_round_trip_and_wait_for_the_rest() {
        let hello = Hello {
            min: 1,
            max: 3,
            features: 0x8000_0000_0000_0001,
        };
        let bytes = hello.encode();
        assert_eq!(bytes.len(), 17);
        assert_eq!(&bytes[..9], b"TLMM\x01\x01\x00\x03\x00");
        for cut in 0..17 {
            assert_eq!(Hello::decode(&bytes[..cut]), Ok(None), "{cut} bytes");
        }
        assert_eq!(
            Hello::decode(&[&bytes[..], b"next"].concat()),
            Ok(Some((hello, 17)))
        );
        for answer in [
            Answer::Ack {
                version: 1,
                features: 0,
                epoch: 9,
            },
            Answer::Reject {
                code: RejectCode::Busy,
                text: "another operator has authority".into(),
            },
        ] {
            let bytes = answer.encode();
            assert!(bytes.len() <= MAX_LEN);
            assert_eq!(Answer::decode(&bytes[..bytes.len() - 1]), Ok(None));
            assert_eq!(Answer::decode(&bytes), Ok(Some((answer, bytes.len()))));
        }
    }

    #[test]
    fn strangers_are_recognised_at_the_first_byte() {
        assert_eq!(Hello::decode(b"G"), Err(HelloError::Magic));
        assert_eq!(Hello::decode(b"TLMM\x02"), Err(HelloError::Kind(2)));
        assert_eq!(
            Hello::decode(
                &Hello {
                    min: 2,
                    max: 1,
                    features: 0
                }
                .encode()
            ),
            Err(HelloError::Range { min: 2, max: 1 })
        );
    }
}
