//! Where the hand comes from, as people write it.

use std::fmt;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::str::FromStr;

/// Where the hand comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Source {
    /// Lines of JSON on standard input.
    Stdin,
    /// Lines of JSON in datagrams to this address of ours.
    Udp(SocketAddr),
    /// Raw depth frames on standard input.
    DepthStdin,
    /// A folder of depth frames, at their rate.
    DepthFolder(PathBuf),
    /// A gamepad or SpaceMouse of this host; none, whichever there are, to be listed.
    Evdev(Option<PathBuf>),
}

impl FromStr for Source {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match (text, text.split_once(':')) {
            ("-", _) => Ok(Self::Stdin),
            ("depth:-", _) => Ok(Self::DepthStdin),
            (_, Some(("depth", folder))) if !folder.is_empty() => {
                Ok(Self::DepthFolder(folder.into()))
            }
            (_, Some(("evdev", path))) => Ok(Self::Evdev((!path.is_empty()).then(|| path.into()))),
            (_, Some(("udp", addr))) => {
                let port = |port: u16| SocketAddr::from(([127, 0, 0, 1], port));
                let addr = addr.parse().or_else(|_| addr.parse().map(port));
                addr.map(Self::Udp).map_err(|_| {
                    format!("`{text}`: write udp:PORT (this host) or udp:ADDRESS:PORT, as udp:5005")
                })
            }
            _ => Err(format!(
                "`{text}`: write - (lines on standard input), udp:PORT, depth:FOLDER, depth:- (frames on standard input) or evdev:/dev/input/eventN"
            )),
        }
    }
}

impl fmt::Display for Source {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Stdin => f.write_str("standard input"),
            Self::Udp(addr) => write!(f, "udp:{addr}"),
            Self::DepthStdin => f.write_str("depth frames on standard input"),
            Self::DepthFolder(folder) => write!(f, "the depth frames in {}", folder.display()),
            Self::Evdev(Some(path)) => write!(f, "evdev:{}", path.display()),
            Self::Evdev(None) => f.write_str("evdev:"),
        }
    }
}
