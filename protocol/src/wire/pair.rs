//! Pairing: how two ends that do not know each other's keys yet come to pin them. Its own ALPN, its own
//! stream, a layout that is frozen like the greeting's.
//!
//! ```text
//! "TLMP" kind:u8 …            all integers little-endian, text UTF-8
//!   1 Offer    name_len:u8 name                    operator
//!   2 Commit   commitment:[u8; 32] name_len:u8 name   robot
//!   3 Nonce    nonce:[u8; 32]                      operator
//!   4 Reveal   nonce:[u8; 32]                      robot
//!   5 Confirm                                      operator
//!   6 Stored                                       robot
//!   7 Abort    code:u16 text_len:u8 text           either
//! ```
//!
//! The robot commits to its nonce before it sees the operator's, and the operator chooses its own before it
//! sees the robot's: whoever stands between the two has one guess at a code of eight digits, and no way to
//! search for keys or nonces that give the same code on both sides.

use std::fmt;

use sha2::{Digest, Sha256};

/// The ALPN of pairing.
pub const ALPN: &[u8] = b"telemime-pair/1";

/// Label of the TLS exporter (RFC 8446 §7.5) whose 32 bytes enter the code; its context is empty.
pub const EXPORTER_LABEL: &[u8] = b"EXPORTER-telemime-pair-1";

/// First bytes of every message.
pub const MAGIC: [u8; 4] = *b"TLMP";

/// Longest name of an end, bytes.
pub const MAX_NAME_LEN: usize = 64;

/// Longest message, bytes: what a reader must be ready to hold.
pub const MAX_LEN: usize = 4 + 1 + 2 + 1 + 255;

/// A nonce, a commitment, a fingerprint or what TLS exports.
pub type Bytes32 = [u8; 32];

/// What an end is called: 1 to 64 of `A-Z a-z 0-9 . _ -`, so that it can be shown and stored anywhere.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Name(String);

impl Name {
    /// The name, if it is one.
    pub fn new(text: &str) -> Option<Self> {
        let fits = (1..=MAX_NAME_LEN).contains(&text.len())
            && text
                .bytes()
                .all(|b| b.is_ascii_alphanumeric() || b"._-".contains(&b));
        fits.then(|| Self(text.to_owned()))
    }

    /// A name made of `text`: what may not stand in one becomes `-`.
    pub fn made_of(text: &str) -> Self {
        let fits = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
        let name: String = text
            .chars()
            .take(MAX_NAME_LEN)
            .map(|c| if fits(c) { c } else { '-' })
            .collect();
        Self::new(&name).unwrap_or_else(|| Self("unnamed".to_owned()))
    }
}

impl fmt::Display for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl AsRef<str> for Name {
    fn as_ref(&self) -> &str {
        &self.0
    }
}

/// Why a pairing ends without one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AbortCode {
    /// No window is open.
    Closed,
    /// The window has had its one attempt.
    Used,
    /// The window ended before both users had agreed.
    Expired,
    /// A user says that the codes differ, or wants no pairing.
    Declined,
    /// The name belongs to another key already.
    NameTaken,
    /// The key was revoked.
    Revoked,
    /// A message is none, or not the one that is due, or not there in time.
    Malformed,
    /// The nonce is not the one committed to: somebody stands in between.
    Commitment,
    /// The pin cannot be stored.
    Storage,
    /// A code this build does not know.
    Other(u16),
}

impl AbortCode {
    const KNOWN: [Self; 9] = [
        Self::Closed,
        Self::Used,
        Self::Expired,
        Self::Declined,
        Self::NameTaken,
        Self::Revoked,
        Self::Malformed,
        Self::Commitment,
        Self::Storage,
    ];

    fn to_u16(self) -> u16 {
        match self {
            Self::Other(code) => code,
            known => {
                let at = Self::KNOWN.iter().position(|&code| code == known);
                at.map_or(0, |i| i as u16 + 1)
            }
        }
    }

    fn from_u16(code: u16) -> Self {
        let known = usize::from(code)
            .checked_sub(1)
            .and_then(|i| Self::KNOWN.get(i));
        known.copied().unwrap_or(Self::Other(code))
    }
}

/// One message of a pairing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PairMessage {
    /// The operator's name.
    Offer(Name),
    /// The hash of the robot's nonce, and its name.
    Commit(Bytes32, Name),
    /// The operator's nonce.
    Nonce(Bytes32),
    /// The robot's nonce.
    Reveal(Bytes32),
    /// The operator's user agrees.
    Confirm,
    /// The robot's user agrees too, and the robot has stored the operator's key.
    Stored,
    /// There will be no pairing.
    Abort(AbortCode, String),
}

/// Why bytes are no message of a pairing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PairDecodeError {
    /// Does not begin with [`MAGIC`].
    #[error("the peer does not speak Telemime's pairing")]
    Magic,
    /// An unknown kind of message.
    #[error("unknown pairing message kind {0}")]
    Kind(u8),
    /// A name with other bytes than a name may have, or too many.
    #[error("the peer's name is none: 1 to 64 of A-Z a-z 0-9 . _ -")]
    Name,
    /// A text that is not UTF-8.
    #[error("the peer's reason is not UTF-8")]
    Text,
}

impl PairMessage {
    /// The bytes of this message.
    pub fn encode(&self) -> Vec<u8> {
        let mut out = MAGIC.to_vec();
        let name = |out: &mut Vec<u8>, name: &Name| {
            out.push(name.0.len() as u8);
            out.extend(name.0.bytes());
        };
        match self {
            Self::Offer(own) => {
                out.push(1);
                name(&mut out, own);
            }
            Self::Commit(commitment, own) => {
                out.push(2);
                out.extend(commitment);
                name(&mut out, own);
            }
            Self::Nonce(nonce) => {
                out.push(3);
                out.extend(nonce);
            }
            Self::Reveal(nonce) => {
                out.push(4);
                out.extend(nonce);
            }
            Self::Confirm => out.push(5),
            Self::Stored => out.push(6),
            Self::Abort(code, text) => {
                out.push(7);
                out.extend(code.to_u16().to_le_bytes());
                let mut len = text.len().min(255);
                while !text.is_char_boundary(len) {
                    len -= 1;
                }
                out.push(len as u8);
                out.extend(text[..len].bytes());
            }
        }
        out
    }

    /// Reads a message from the front of `bytes`: the message and the bytes used, or `None` if more are needed.
    ///
    /// # Errors
    /// [`PairDecodeError`] as soon as the bytes cannot become a message.
    pub fn decode(bytes: &[u8]) -> Result<Option<(Self, usize)>, PairDecodeError> {
        let seen = bytes.len().min(MAGIC.len());
        if bytes[..seen] != MAGIC[..seen] {
            return Err(PairDecodeError::Magic);
        }
        let Some(&kind) = bytes.get(MAGIC.len()) else {
            return Ok(None);
        };
        let mut rest = &bytes[MAGIC.len() + 1..];
        let message = match kind {
            1 => match name(&mut rest)? {
                Some(name) => Self::Offer(name),
                None => return Ok(None),
            },
            2 => {
                let Some(commitment) = fixed(&mut rest) else {
                    return Ok(None);
                };
                match name(&mut rest)? {
                    Some(name) => Self::Commit(commitment, name),
                    None => return Ok(None),
                }
            }
            3 | 4 => match fixed(&mut rest) {
                Some(nonce) if kind == 3 => Self::Nonce(nonce),
                Some(nonce) => Self::Reveal(nonce),
                None => return Ok(None),
            },
            5 => Self::Confirm,
            6 => Self::Stored,
            7 => match (fixed(&mut rest).map(u16::from_le_bytes), short(&mut rest)) {
                (Some(code), Some(text)) => {
                    let text = std::str::from_utf8(text).map_err(|_| PairDecodeError::Text)?;
                    Self::Abort(AbortCode::from_u16(code), text.to_owned())
                }
                _ => return Ok(None),
            },
            other => return Err(PairDecodeError::Kind(other)),
        };
        Ok(Some((message, bytes.len() - rest.len())))
    }
}

fn fixed<const N: usize>(rest: &mut &[u8]) -> Option<[u8; N]> {
    let (head, tail) = rest.split_first_chunk::<N>()?;
    *rest = tail;
    Some(*head)
}

fn short<'a>(rest: &mut &'a [u8]) -> Option<&'a [u8]> {
    let (&len, tail) = rest.split_first()?;
    let (text, tail) = tail.split_at_checked(usize::from(len))?;
    *rest = tail;
    Some(text)
}

/// A name; one that is too long is refused by its length and not waited for.
fn name(rest: &mut &[u8]) -> Result<Option<Name>, PairDecodeError> {
    if rest
        .first()
        .is_some_and(|&len| usize::from(len) > MAX_NAME_LEN)
    {
        return Err(PairDecodeError::Name);
    }
    let Some(text) = short(rest) else {
        return Ok(None);
    };
    let name = std::str::from_utf8(text).ok().and_then(Name::new);
    name.map(Some).ok_or(PairDecodeError::Name)
}

/// What the robot commits to its nonce with.
pub fn commitment(robot_nonce: &Bytes32) -> Bytes32 {
    let mut hash = Sha256::new();
    hash.update(b"telemime-pair/1 commitment");
    hash.update(robot_nonce);
    hash.finalize().into()
}

/// All that both ends must agree on.
#[derive(Debug, Clone, Copy)]
pub struct Transcript {
    /// 32 bytes from the TLS exporter with [`EXPORTER_LABEL`].
    pub exporter: Bytes32,
    /// SHA-256 of the operator's SubjectPublicKeyInfo, as the robot sees it.
    pub operator: Bytes32,
    /// SHA-256 of the robot's, as the operator sees it.
    pub robot: Bytes32,
    /// The operator's nonce.
    pub operator_nonce: Bytes32,
    /// The robot's nonce.
    pub robot_nonce: Bytes32,
}

impl Transcript {
    /// The code that the users compare.
    pub fn code(&self) -> Code {
        let mut hash = Sha256::new();
        hash.update(b"telemime-pair/1 code");
        for part in [
            &self.exporter,
            &self.operator,
            &self.robot,
            &self.operator_nonce,
            &self.robot_nonce,
        ] {
            hash.update(part);
        }
        let digest: Bytes32 = hash.finalize().into();
        let (head, _) = digest
            .split_first_chunk::<8>()
            .expect("a digest has 32 bytes");
        Code((u64::from_be_bytes(*head) % 100_000_000) as u32)
    }
}

/// Eight digits, written as two groups of four.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Code(u32);

impl fmt::Display for Code {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:04} {:04}", self.0 / 10_000, self.0 % 10_000)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all() -> Vec<PairMessage> {
        let name = Name::new("lab-robot.1").unwrap();
        let mut all = vec![
            PairMessage::Offer(name.clone()),
            PairMessage::Commit([7; 32], name),
            PairMessage::Nonce([1; 32]),
            PairMessage::Reveal([2; 32]),
            PairMessage::Confirm,
            PairMessage::Stored,
        ];
        for code in 1..=10 {
            let code = AbortCode::from_u16(code);
            all.push(PairMessage::Abort(code, "because".into()));
        }
        all
    }

    #[test]
    fn messages_survive_the_wire_and_every_prefix_is_unfinished() {
        for message in all() {
            let mut bytes = message.encode();
            assert!(bytes.len() <= MAX_LEN);
            for len in 0..bytes.len() {
                assert_eq!(PairMessage::decode(&bytes[..len]), Ok(None), "{message:?}");
            }
            let used = bytes.len();
            bytes.push(0xff);
            assert_eq!(PairMessage::decode(&bytes), Ok(Some((message, used))));
        }
    }

    #[test]
    fn what_is_no_message_is_refused_by_its_reason() {
        let head = |kind: u8, rest: &[u8]| [&MAGIC[..], &[kind], rest].concat();
        for (bytes, error) in [
            (b"TLMM".to_vec(), PairDecodeError::Magic),
            (head(0, &[]), PairDecodeError::Kind(0)),
            (head(8, &[]), PairDecodeError::Kind(8)),
            (head(1, &[0]), PairDecodeError::Name),
            (head(1, &[1, b' ']), PairDecodeError::Name),
            (head(1, b"\x03\x1b[m"), PairDecodeError::Name),
            (
                head(1, &[[65].as_slice(), &[b'a'; 65]].concat()),
                PairDecodeError::Name,
            ),
            // Before it has arrived.
            (head(1, &[65]), PairDecodeError::Name),
            (head(2, &[255; 33]), PairDecodeError::Name),
            (head(7, &[1, 0, 1, 0xff]), PairDecodeError::Text),
        ] {
            assert_eq!(PairMessage::decode(&bytes), Err(error), "{bytes:?}");
        }
        let long = PairMessage::Abort(AbortCode::Closed, "é".repeat(200)).encode();
        let (PairMessage::Abort(_, text), _) = PairMessage::decode(&long).unwrap().unwrap() else {
            panic!("not an abort")
        };
        assert_eq!(text.len(), 254, "cut between characters");
    }

    #[test]
    fn every_part_of_the_transcript_changes_the_code() {
        let parts = |changed: usize| {
            let part = |i: usize| [if i == changed { 9 } else { i as u8 }; 32];
            let transcript = Transcript {
                exporter: part(0),
                operator: part(1),
                robot: part(2),
                operator_nonce: part(3),
                robot_nonce: part(4),
            };
            transcript.code()
        };
        let code = parts(5);
        for changed in 0..5 {
            assert_ne!(parts(changed), code, "part {changed}");
        }
        assert_eq!(code.to_string().len(), 9);
        assert_ne!(commitment(&[1; 32]), commitment(&[2; 32]));
    }

    #[test]
    fn names_are_made_presentable() {
        assert_eq!(Name::made_of("José's laptop").as_ref(), "Jos--s-laptop");
        assert_eq!(Name::made_of("").as_ref(), "unnamed");
        assert_eq!(Name::made_of(&"x".repeat(80)).as_ref().len(), 64);
    }
}
