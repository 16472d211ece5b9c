//! Whom a daemon trusts. TLS and the daemon's loop look at the same list, and it may change while they run.

use std::collections::BTreeSet;

use quinn::Connection;
use rustls::pki_types::CertificateDer;
use rustls::server::ParsedCertificate;
use std::sync::Arc;
use tokio::sync::watch;

use crate::identity::Fingerprint;

/// What is thought of a key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Standing {
    /// Pinned.
    Trusted,
    /// It was pinned once, and is not to come back.
    Revoked,
    /// Never heard of.
    Unknown,
}

#[derive(Debug, Default)]
struct State {
    pinned: BTreeSet<Fingerprint>,
    revoked: BTreeSet<Fingerprint>,
    open: bool,
    turned_away: Option<Fingerprint>,
}

impl State {
    fn standing(&self, key: Fingerprint) -> Standing {
        if self.revoked.contains(&key) {
            Standing::Revoked
        } else if self.pinned.contains(&key) {
            Standing::Trusted
        } else {
            Standing::Unknown
        }
    }
}

/// The keys a daemon trusts, and those it does not trust any more. Clones share one list.
#[derive(Debug, Clone)]
pub struct Trust(Arc<watch::Sender<State>>);

impl Trust {
    /// Trusts `pinned` and nobody else.
    pub fn new(pinned: impl IntoIterator<Item = Fingerprint>) -> Self {
        let trust = Self(Arc::new(watch::Sender::new(State::default())));
        trust.set(pinned, []);
        trust
    }

    /// From now on trusts `pinned`, without those in `revoked`.
    pub fn set(
        &self,
        pinned: impl IntoIterator<Item = Fingerprint>,
        revoked: impl IntoIterator<Item = Fingerprint>,
    ) {
        let (pinned, revoked) = (pinned.into_iter().collect(), revoked.into_iter().collect());
        self.0.send_modify(|state| {
            state.pinned = pinned;
            state.revoked = revoked;
        });
    }

    /// From now on trusts `key` too, unless it is revoked.
    pub fn pin(&self, key: Fingerprint) {
        self.0.send_modify(|state| {
            state.pinned.insert(key);
        });
    }

    /// What is thought of `key`.
    pub fn standing(&self, key: Fingerprint) -> Standing {
        self.0.borrow().standing(key)
    }

    /// Whether anybody is trusted.
    pub fn is_empty(&self) -> bool {
        self.0.borrow().pinned.is_empty()
    }

    /// While open, unknown keys may complete a handshake, in order to be paired. They are not trusted: whoever
    /// accepts a connection asks [`Trust::standing`] of its key.
    pub fn set_open(&self, open: bool) {
        self.0.send_modify(|state| state.open = open);
    }

    /// The key that TLS turned away last.
    pub fn turned_away(&self) -> Option<Fingerprint> {
        self.0.borrow().turned_away
    }

    /// Resolves once `key` is not trusted (any more), with what it is instead.
    pub async fn withdrawn(&self, key: Fingerprint) -> Standing {
        let mut changes = self.0.subscribe();
        let changed = changes
            .wait_for(|state| state.standing(key) != Standing::Trusted)
            .await
            .map(|state| state.standing(key));
        match changed {
            Ok(standing) => standing,
            // We hold the sender ourselves.
            Err(_) => std::future::pending().await,
        }
    }

    /// Whether a handshake with `key` may be completed.
    pub(crate) fn admits(&self, key: Fingerprint) -> Standing {
        let standing = {
            let state = self.0.borrow();
            match state.standing(key) {
                Standing::Unknown if state.open => Standing::Trusted,
                standing => standing,
            }
        };
        if standing != Standing::Trusted {
            self.0
                .send_if_modified(|state| state.turned_away.replace(key) != Some(key));
        }
        standing
    }
}

impl From<Vec<Fingerprint>> for Trust {
    fn from(pinned: Vec<Fingerprint>) -> Self {
        Self::new(pinned)
    }
}

impl From<Fingerprint> for Trust {
    fn from(pinned: Fingerprint) -> Self {
        Self::new([pinned])
    }
}

impl From<&Trust> for Trust {
    fn from(trust: &Trust) -> Self {
        trust.clone()
    }
}

/// The key at the other end of a connection whose handshake is complete.
pub fn key_of(connection: &Connection) -> Option<Fingerprint> {
    let identity = connection.peer_identity()?;
    let chain = identity.downcast::<Vec<CertificateDer<'static>>>().ok()?;
    let certificate = ParsedCertificate::try_from(chain.first()?).ok()?;
    Some(Fingerprint::of_spki(&certificate.subject_public_key_info()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key(n: u8) -> Fingerprint {
        Fingerprint::of_spki(&[n])
    }

    #[tokio::test(flavor = "current_thread")]
    async fn revoked_outweighs_pinned_and_openness_pins_nobody() {
        let trust = Trust::new([key(1), key(2)]);
        trust.set([key(1), key(2)], [key(2)]);
        assert_eq!(trust.standing(key(1)), Standing::Trusted);
        assert_eq!(trust.standing(key(2)), Standing::Revoked);
        assert_eq!(trust.withdrawn(key(2)).await, Standing::Revoked);
        trust.set_open(true);
        assert_eq!(trust.admits(key(3)), Standing::Trusted, "to be paired");
        assert_eq!(trust.standing(key(3)), Standing::Unknown, "not trusted");
        assert_eq!(trust.admits(key(2)), Standing::Revoked, "open or not");
        trust.set_open(false);
        assert_eq!(trust.admits(key(3)), Standing::Unknown);
        assert_eq!(trust.turned_away(), Some(key(3)));
        let later = trust.clone();
        let waiting = tokio::spawn(async move { later.withdrawn(key(1)).await });
        tokio::task::yield_now().await;
        trust.set([], []);
        assert_eq!(waiting.await.unwrap(), Standing::Unknown);
    }
}
