//! Which version a session speaks: an end offers a range, both take the lower of the two maxima.
//!
//! A session thinks in version 1's messages; what another version says differently is translated here, where
//! messages become bytes.

use std::fmt;

use super::codec::DecodeError;
use super::hello::Hello;
use super::v1::{self, Message, OperatorDatagram};
use super::v2;

/// A version this build knows.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Version {
    /// [`v1`].
    #[default]
    V1,
    /// [`v2`], an experiment.
    V2,
}

impl Version {
    /// The version of this number, if this build knows it.
    pub fn from_number(number: u16) -> Option<Self> {
        [Self::V1, Self::V2]
            .into_iter()
            .find(|v| v.number() == number)
    }

    /// Its number in the greeting.
    pub fn number(self) -> u16 {
        match self {
            Self::V1 => v1::VERSION,
            Self::V2 => v2::VERSION,
        }
    }

    /// The bytes of an operator's datagram.
    pub fn encode_operator_datagram(self, message: &OperatorDatagram) -> Vec<u8> {
        match self {
            Self::V1 => message.encode(),
            Self::V2 => v2::encode_operator_datagram(message),
        }
    }

    /// An operator's datagram from untrusted bytes.
    ///
    /// # Errors
    /// [`DecodeError`], as [`Message::decode`].
    pub fn decode_operator_datagram(self, bytes: &[u8]) -> Result<OperatorDatagram, DecodeError> {
        match self {
            Self::V1 => OperatorDatagram::decode(bytes),
            Self::V2 => v2::decode_operator_datagram(bytes),
        }
    }
}

impl fmt::Display for Version {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.number().fmt(f)
    }
}

/// The versions an end offers: all from `lowest` to `highest`. By default version 1 alone.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Versions {
    lowest: Version,
    highest: Version,
}

impl Versions {
    /// From `lowest` to `highest`; `None` if that is no version at all.
    pub fn new(lowest: Version, highest: Version) -> Option<Self> {
        (lowest <= highest).then_some(Self { lowest, highest })
    }

    /// The greeting of an operator that offers these, without features.
    pub fn hello(self) -> Hello {
        Hello {
            min: self.lowest.number(),
            max: self.highest.number(),
            features: 0,
        }
    }

    /// What a robot that offers these speaks with an operator that greets so: the lower of the two maxima, if both
    /// offer it.
    pub fn choose(self, hello: &Hello) -> Option<Version> {
        let version = hello.max.min(self.highest.number());
        (hello.min <= version)
            .then(|| self.known(version))
            .flatten()
    }

    /// The version of this number, if it is one of these.
    pub fn known(self, number: u16) -> Option<Version> {
        Version::from_number(number).filter(|v| (self.lowest..=self.highest).contains(v))
    }
}

impl fmt::Display for Versions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.lowest == self.highest {
            write!(f, "version {}", self.lowest)
        } else {
            write!(f, "versions {} to {}", self.lowest, self.highest)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const OLD: Versions = Versions {
        lowest: Version::V1,
        highest: Version::V1,
    };
    const BOTH: Versions = Versions {
        lowest: Version::V1,
        highest: Version::V2,
    };
    const NEW: Versions = Versions {
        lowest: Version::V2,
        highest: Version::V2,
    };

    #[test]
    fn both_ends_take_the_lower_of_the_two_maxima() {
        let chosen = |robot: Versions, operator: Versions| robot.choose(&operator.hello());
        assert_eq!(chosen(OLD, OLD), Some(Version::V1));
        assert_eq!(chosen(OLD, BOTH), Some(Version::V1));
        assert_eq!(chosen(BOTH, OLD), Some(Version::V1));
        assert_eq!(chosen(BOTH, BOTH), Some(Version::V2));
        assert_eq!(chosen(NEW, BOTH), Some(Version::V2));
        assert_eq!(chosen(BOTH, NEW), Some(Version::V2));
        assert_eq!(chosen(OLD, NEW), None);
        assert_eq!(chosen(NEW, OLD), None);
        assert_eq!(Versions::default(), OLD, "an experiment is not advertised");
        assert_eq!(Versions::new(Version::V2, Version::V1), None);
    }

    #[test]
    fn an_operator_of_the_future_and_one_of_the_past_are_told_apart() {
        let greeted = |min, max| {
            BOTH.choose(&Hello {
                min,
                max,
                features: 0,
            })
        };
        assert_eq!(greeted(1, u16::MAX), Some(Version::V2));
        assert_eq!(greeted(3, 9), None);
        assert_eq!(greeted(0, 0), None);
        // 0 to 1 holds ours, though 0 is no version of anybody's.
        assert_eq!(greeted(0, 1), Some(Version::V1));
    }

    #[test]
    fn the_versions_differ_in_the_pong_and_in_nothing_else() {
        let pong = |t3_us| OperatorDatagram::Pong {
            epoch: 7,
            t1_us: 90_000_000,
            t2_us: 3_000_000,
            t3_us,
        };
        let said = Version::V2.encode_operator_datagram(&pong(3_000_120));
        let expected = [
            2, 7, 0xfc, 0, 0x95, 0xba, 0x0a, 0xfc, 0x80, 0x8d, 0x5b, 0, 120,
        ];
        assert_eq!(said, expected);
        assert_eq!(
            Version::V2.decode_operator_datagram(&said),
            Ok(pong(3_000_120))
        );
        // The same bytes mean something else to version 1.
        assert_eq!(Version::V1.decode_operator_datagram(&said), Ok(pong(60)));
        let stop = OperatorDatagram::Stop { epoch: 7 };
        for version in [Version::V1, Version::V2] {
            let bytes = version.encode_operator_datagram(&stop);
            assert_eq!(bytes, stop.encode());
            assert_eq!(version.decode_operator_datagram(&bytes), Ok(stop.clone()));
        }
    }

    #[test]
    fn hostile_pongs_are_refused_like_any_message() {
        let decode = |bytes: &[u8]| Version::V2.decode_operator_datagram(bytes);
        let late = [
            2, 7, 0, 0xfd, 0xfe, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 1,
        ];
        assert!(matches!(decode(&late), Err(DecodeError::Invalid { .. })));
        assert!(matches!(
            decode(&late[..12]),
            Err(DecodeError::Malformed(_))
        ));
        let more = [2, 7, 0, 0, 0, 0];
        assert_eq!(decode(&more), Err(DecodeError::Trailing(1)));
        assert!(matches!(decode(&[]), Err(DecodeError::Malformed(_))));
    }
}
