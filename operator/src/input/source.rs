//! Where the hand comes from, as people write it.

use std::fmt;
use std::net::SocketAddr;
use std::str::FromStr;

/// Where the hand comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Source {
    /// Lines of JSON on standard input.
    Stdin,
    /// Lines of JSON in datagrams to this address of ours.
    Udp(SocketAddr),
}

impl FromStr for Source {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "-" {
            return Ok(Self::Stdin);
        }
        if let Some(addr) = text.strip_prefix("udp:") {
            let port = |port: u16| SocketAddr::from(([127, 0, 0, 1], port));
            let addr = addr.parse().or_else(|_| addr.parse().map(port));
            return addr.map(Self::Udp).map_err(|_| {
                format!("`{text}`: write udp:PORT (this host) or udp:ADDRESS:PORT, as udp:5005")
            });
        }
        Err(format!("`{text}`: write - (standard input) or udp:PORT"))
    }
}

impl fmt::Display for Source {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Stdin => f.write_str("standard input"),
            Self::Udp(addr) => write!(f, "udp:{addr}"),
        }
    }
}
