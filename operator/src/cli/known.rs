//! Which robot is meant, and whether it is the one we know.

use telemime_endpoint::Fingerprint;
use telemime_endpoint::peers::{Peers, PeersError, Role};

/// Where a robot is, and its key if we know it.
#[derive(Debug)]
pub(super) struct Known {
    pub(super) address: String,
    pub(super) key: Option<Fingerprint>,
}

impl Known {
    /// What `connect` means, and `peer`, a fingerprint given besides. A robot that is known by another key, or whose
    /// key was revoked, is refused before anything is sent to it.
    pub(super) fn find(peers: &Peers, connect: &str, peer: Option<&str>) -> anyhow::Result<Self> {
        let given: Option<Fingerprint> = peer.map(str::parse).transpose()?;
        let known = peers.robot(connect);
        let key = given.or(known.map(|known| known.key));
        let held = peers
            .iter()
            .find(|p| p.role == Role::Robot && Some(p.key) == key);
        if let Some(revoked) = held.filter(|held| held.revoked) {
            return Err(PeersError::Revoked {
                name: revoked.name.clone(),
                key: revoked.key,
            }
            .into());
        }
        if let (Some(known), Some(new)) = (known, given)
            && known.key != new
        {
            return Err(PeersError::AddressTaken {
                address: connect.to_owned(),
                name: known.name.clone(),
                known: known.key,
                new,
            }
            .into());
        }
        let address = known.and_then(|known| known.address.clone());
        Ok(Self {
            address: address.unwrap_or_else(|| connect.to_owned()),
            key,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_is_known_by_name_and_address_and_another_key_is_refused() {
        let key = |n: u8| Fingerprint::of_spki(&[n]);
        let mut peers = Peers::default();
        let name = telemime_endpoint::peers::Name::new("arm").unwrap();
        let address = Some("lab:4433".to_owned());
        let arm = telemime_endpoint::peers::Peer::new(name, Role::Robot, key(1), address);
        peers.pin(arm).unwrap();
        for connect in ["arm", "lab:4433"] {
            let known = Known::find(&peers, connect, None).unwrap();
            assert_eq!(
                (known.address.as_str(), known.key),
                ("lab:4433", Some(key(1)))
            );
            let same = Known::find(&peers, connect, Some(&key(1).to_string())).unwrap();
            assert_eq!(same.key, Some(key(1)));
            let error = Known::find(&peers, connect, Some(&key(2).to_string())).unwrap_err();
            assert!(
                error.to_string().contains("telemime peers remove arm"),
                "{error}"
            );
        }
        let unknown = Known::find(&peers, "other:4433", None).unwrap();
        assert_eq!(
            (unknown.address.as_str(), unknown.key),
            ("other:4433", None)
        );
        peers.revoke("arm").unwrap();
        for (connect, peer) in [("arm", None), ("other:4433", Some(key(1).to_string()))] {
            let error = Known::find(&peers, connect, peer.as_deref()).unwrap_err();
            assert!(error.to_string().contains("revoked"), "{error}");
        }
    }
}
