//! Who was turned away, why, and how often: told when it happens first, then counted.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

/// Why somebody was turned away.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Reason {
    /// Its key is not pinned.
    UnknownKey,
    /// Its key was revoked.
    RevokedKey,
    /// No common version.
    Version,
    /// Another operator has authority.
    Busy,
    /// It did not greet, or with something else.
    Greeting,
    /// It wanted to be paired, and no window was open for it.
    NoWindow,
    /// The handshake did not come to its end.
    Handshake,
}

impl Reason {
    /// All of them.
    pub const ALL: [Self; 7] = [
        Self::UnknownKey,
        Self::RevokedKey,
        Self::Version,
        Self::Busy,
        Self::Greeting,
        Self::NoWindow,
        Self::Handshake,
    ];

    /// One word, for machines.
    pub fn word(self) -> &'static str {
        match self {
            Self::UnknownKey => "unknown_key",
            Self::RevokedKey => "revoked_key",
            Self::Version => "version",
            Self::Busy => "busy",
            Self::Greeting => "greeting",
            Self::NoWindow => "no_window",
            Self::Handshake => "handshake",
        }
    }
}

/// Somebody was turned away, not for the first time perhaps.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refused {
    /// Who.
    pub peer: SocketAddr,
    /// Why, for machines.
    pub reason: Reason,
    /// Why, for people.
    pub why: String,
    /// How often this host was, for this reason.
    pub times: u32,
}

/// Hosts and reasons told apart; what is beyond counts as one.
const MAX_APART: usize = 256;

/// Counts refusals.
#[derive(Debug, Default)]
pub struct Tally {
    hosts: BTreeMap<(Reason, IpAddr), u32>,
    totals: BTreeMap<Reason, u64>,
}

impl Tally {
    /// Counts one. It is told the first time, and then the tenth, the hundredth and so on.
    pub fn count(&mut self, peer: SocketAddr, reason: Reason, why: String) -> Option<Refused> {
        *self.totals.entry(reason).or_default() += 1;
        let mut who = (reason, peer.ip());
        if self.hosts.len() >= MAX_APART && !self.hosts.contains_key(&who) {
            who.1 = IpAddr::V4(Ipv4Addr::UNSPECIFIED);
        }
        let times = self.hosts.entry(who).or_default();
        *times = times.saturating_add(1);
        let times = *times;
        let round = 10_u32.checked_pow(times.ilog10()) == Some(times);
        round.then_some(Refused {
            peer,
            reason,
            why,
            times,
        })
    }

    /// How often anybody was turned away, by reason.
    pub fn totals(&self) -> &BTreeMap<Reason, u64> {
        &self.totals
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_is_told_once_and_then_ever_more_rarely() {
        let mut tally = Tally::default();
        let peer = |host: u16, port| {
            let [a, b] = host.to_be_bytes();
            SocketAddr::from(([10, 0, a, b], port))
        };
        let mut count = |host, port, reason| {
            tally
                .count(peer(host, port), reason, String::new())
                .map(|refused| refused.times)
        };
        // Another port is the same host.
        let told: Vec<_> = (0..150)
            .filter_map(|i| count(1, 4000 + i, Reason::Busy))
            .collect();
        assert_eq!(told, [1, 10, 100]);
        assert_eq!(count(1, 1, Reason::UnknownKey), Some(1));
        let flood = (2..2000).filter_map(|host| count(host, 1, Reason::UnknownKey));
        let told = flood.count();
        assert!(told < MAX_APART + 5, "{told}");
        assert!(tally.hosts.len() <= MAX_APART + 7);
        let totals: Vec<_> = tally.totals().values().copied().collect();
        assert_eq!(totals, [1 + 1998, 150]);
    }
}
