use super::follow::LOOK;
use super::*;
use crate::trust::{Standing, Trust};
use std::os::unix::fs::PermissionsExt;

fn key(n: u8) -> Fingerprint {
    Fingerprint::of_spki(&[n])
}

fn peer(name: &str, role: Role, n: u8, address: Option<&str>) -> Peer {
    let address = address.map(str::to_owned);
    Peer::new(Name::new(name).unwrap(), role, key(n), address)
}

fn pin(path: &Path, peer: Peer) -> Result<(), PeersError> {
    Peers::edit(path, |peers| peers.pin(peer))
}

#[test]
fn peers_are_kept_with_comments_and_privately() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("config/peers");
    assert_eq!(Peers::load(&path).unwrap(), Peers::default());
    pin(&path, peer("ann", Role::Operator, 1, None)).unwrap();
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, format!("# who may drive\n\n{text}")).unwrap();
    let robot = peer("arm", Role::Robot, 2, Some("lab:4433"));
    pin(&path, robot.clone()).unwrap();
    let mode = std::fs::metadata(&path).unwrap().permissions().mode() & 0o777;
    assert_eq!(mode, 0o600);
    let peers = Peers::load(&path).unwrap();
    assert!(
        peers
            .to_string()
            .starts_with("# who may drive\n\nann operator ")
    );
    assert_eq!(peers.robot("lab:4433"), Some(&robot));
    assert_eq!(peers.robot("arm"), Some(&robot));
    assert_eq!(peers.robot("ann"), None, "an operator is no robot");
    assert!(
        robot.added.starts_with("20") && robot.added.ends_with('Z'),
        "{}",
        robot.added
    );
    let removed = Peers::edit(&path, |peers| peers.remove("arm")).unwrap();
    assert_eq!(removed, [robot]);
    assert!(
        Peers::load(&path)
            .unwrap()
            .to_string()
            .starts_with("# who may drive")
    );
}

#[test]
fn a_changed_key_is_refused_until_the_old_one_is_removed() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("peers");
    pin(&path, peer("arm", Role::Robot, 1, Some("lab:4433"))).unwrap();
    let before = std::fs::read(&path).unwrap();
    let error = pin(&path, peer("arm", Role::Robot, 2, None)).unwrap_err();
    assert!(matches!(error, PeersError::NameTaken { .. }));
    assert!(error.to_string().contains("peers remove arm"), "{error}");
    let error = pin(&path, peer("other", Role::Robot, 2, Some("lab:4433"))).unwrap_err();
    assert!(matches!(error, PeersError::AddressTaken { .. }), "{error}");
    assert_eq!(std::fs::read(&path).unwrap(), before);
    // The same key again is no other key, and an operator may be called like a robot.
    pin(&path, peer("arm-2", Role::Robot, 1, None)).unwrap();
    pin(&path, peer("arm-2", Role::Operator, 3, None)).unwrap();
    let peers = Peers::load(&path).unwrap();
    assert_eq!(peers.iter().count(), 2);
    assert_eq!(
        peers.robot("arm-2").unwrap().address.as_deref(),
        Some("lab:4433")
    );

    Peers::edit(&path, |peers| peers.revoke(&key(1).to_string())).unwrap();
    let error = pin(&path, peer("arm", Role::Robot, 1, None)).unwrap_err();
    assert!(matches!(error, PeersError::Revoked { .. }), "{error}");
    let peers = Peers::load(&path).unwrap();
    assert_eq!(peers.keys(Role::Robot, true).collect::<Vec<_>>(), [key(1)]);
    assert_eq!(peers.keys(Role::Robot, false).count(), 0);
    let error = Peers::edit(&path, |peers| peers.remove("nobody")).unwrap_err();
    assert!(matches!(error, PeersError::Unknown(_)));
}

#[test]
fn a_store_that_others_may_write_or_that_is_damaged_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("peers");
    pin(&path, peer("ann", Role::Operator, 1, None)).unwrap();
    let good = std::fs::read_to_string(&path).unwrap();
    for mode in [0o620, 0o602] {
        std::fs::set_permissions(&path, PermissionsExt::from_mode(mode)).unwrap();
        let error = Peers::load(&path).unwrap_err();
        assert!(matches!(error, PeersError::Permissions { .. }), "{error}");
    }
    std::fs::set_permissions(&path, PermissionsExt::from_mode(0o644)).unwrap();
    for (bad, what) in [
        ("ann operator", "2 fields"),
        (&good.replace("operator", "friend"), "`friend`"),
        (&good.replace("trusted", "adored"), "`adored`"),
        (&good.replace("trusted", "trusted a b"), "7 fields"),
        ("ann operator abc now trusted", "`abc`"),
        ("a/b operator abc now trusted", "`a/b`"),
    ] {
        std::fs::write(&path, format!("# one\n{bad}\n")).unwrap();
        let error = Peers::load(&path).unwrap_err().to_string();
        assert!(error.contains("line 2") && error.contains(what), "{error}");
    }
}

#[tokio::test(flavor = "current_thread", start_paused = true)]
async fn a_change_of_the_store_is_followed_and_a_damaged_one_changes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let source = Source {
        path: dir.path().join("peers"),
        whom: Whom::Operators(vec![key(9)]),
    };
    let trust = Trust::new([]);
    source.read(&trust).unwrap();
    let mut complaints = Vec::new();
    let scenario = async {
        pin(&source.path, peer("ann", Role::Operator, 1, None)).unwrap();
        pin(&source.path, peer("arm", Role::Robot, 2, None)).unwrap();
        tokio::time::advance(LOOK * 2).await;
        tokio::task::yield_now().await;
        assert_eq!(trust.standing(key(1)), Standing::Trusted);
        assert_eq!(
            trust.standing(key(2)),
            Standing::Unknown,
            "a robot does not drive"
        );
        let arm = Source {
            path: source.path.clone(),
            whom: Whom::Robot {
                key: key(2),
                given: false,
            },
        };
        let robot = Trust::new([]);
        arm.read(&robot).unwrap();
        assert_eq!(robot.standing(key(2)), Standing::Trusted);
        assert_eq!(robot.standing(key(1)), Standing::Unknown);
        std::fs::write(&source.path, "nonsense\n").unwrap();
        tokio::time::advance(LOOK * 2).await;
        tokio::task::yield_now().await;
        assert_eq!(trust.standing(key(1)), Standing::Trusted);
        std::fs::remove_file(&source.path).unwrap();
        assert_eq!(trust.withdrawn(key(1)).await, Standing::Unknown);
        assert_eq!(trust.standing(key(9)), Standing::Trusted);
    };
    tokio::select! {
        () = source.follow(&trust, |e| complaints.push(e.to_string())) => {}
        () = scenario => {}
    }
    assert_eq!(complaints.len(), 1, "{complaints:?}");
}

#[test]
fn an_address_that_would_not_be_read_back_is_not_written() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("peers");
    for address in ["lab arm:4433", "", "lab:1\nx robot", "lab\t:1"] {
        let wrong = pin(&path, peer("arm", Role::Robot, 1, Some(address)));
        assert!(matches!(wrong, Err(PeersError::Address(_))), "{address:?}");
    }
    pin(&path, peer("arm", Role::Robot, 1, Some("lab:1"))).unwrap();
    assert_eq!(Peers::load(&path).unwrap().iter().count(), 1);
}
