//! Trust that follows a store while it changes.

use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;
use std::time::Duration;

use tokio::time::{MissedTickBehavior, interval};

use super::{Peers, PeersError, Role};
use crate::identity::Fingerprint;
use crate::trust::Trust;

/// How often a store is looked at for changes.
pub(super) const LOOK: Duration = Duration::from_millis(250);

/// Whom of a store a daemon trusts.
#[derive(Debug, Clone)]
pub enum Whom {
    /// Every operator of the store, and these keys (robot).
    Operators(Vec<Fingerprint>),
    /// This robot and no other, for as long as the store knows it, or because it was `given` (operator).
    Robot {
        /// Its key.
        key: Fingerprint,
        /// Whether it need not be in the store.
        given: bool,
    },
}

/// Where a daemon's trust comes from.
#[derive(Debug, Clone)]
pub struct Source {
    /// The store.
    pub path: PathBuf,
    /// Whom of it.
    pub whom: Whom,
}

impl Source {
    /// Reads the store into `trust`. What is revoked in the store is not trusted, whoever else gives it.
    ///
    /// # Errors
    /// As [`Peers::load`]; `trust` is then as before.
    pub fn read(&self, trust: &Trust) -> Result<(), PeersError> {
        let peers = Peers::load(&self.path)?;
        match &self.whom {
            Whom::Operators(given) => {
                let pinned = peers.keys(Role::Operator, false);
                trust.set(
                    pinned.chain(given.iter().copied()),
                    peers.keys(Role::Operator, true),
                );
            }
            Whom::Robot { key, given } => {
                let known = *given || peers.keys(Role::Robot, false).any(|k| k == *key);
                trust.set(known.then_some(*key), peers.keys(Role::Robot, true));
            }
        }
        Ok(())
    }

    /// Keeps `trust` up to date with the store for as long as it is polled. A store that cannot be read changes
    /// nothing and is complained of once; it is read again when it changes, or until it can be.
    pub async fn follow(&self, trust: &Trust, mut complain: impl FnMut(PeersError)) {
        let mut look = interval(LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let (mut seen, mut unread) = (None, None);
        loop {
            look.tick().await;
            let now = Some(self.stamp());
            if now == seen {
                continue;
            }
            match self.read(trust) {
                Err(e @ PeersError::Io { .. }) => {
                    // Nothing is wrong with the file itself: what it says now is still to be learned.
                    if unread != now {
                        unread = now;
                        complain(e);
                    }
                    continue;
                }
                Err(e) => complain(e),
                Ok(()) => {}
            }
            (seen, unread) = (now, None);
        }
    }

    /// Changes whenever the file does.
    fn stamp(&self) -> Option<(u64, i64, i64, u64, u32)> {
        let m = std::fs::metadata(&self.path).ok()?;
        Some((m.ino(), m.mtime(), m.mtime_nsec(), m.len(), m.mode()))
    }
}
