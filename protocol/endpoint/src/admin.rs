//! The commands that all binaries share: whose key is ours, and whom we trust.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand, ValueEnum};
use serde::Serialize;
use telemime_protocol::wire::pair::Name;

use crate::cli::{config_dir, say};
use crate::config::{self, CheckArgs, Settings};
use crate::identity::{Fingerprint, Identity};
use crate::peers::{Peer, Peers, Role};

/// What a host's key is called if nothing else is said.
pub fn key_file(role: Role) -> PathBuf {
    config_dir().join(format!("{role}.key"))
}

/// The peer store if nothing else is said.
pub fn peer_file() -> PathBuf {
    config_dir().join("peers")
}

/// What this host calls itself: `given`, or the host's name.
///
/// # Errors
/// One line, if what was given is no name.
pub fn own_name(given: Option<&str>) -> anyhow::Result<Name> {
    match given {
        Some(text) => Name::new(text).ok_or_else(|| {
            anyhow::anyhow!("`{text}` is no name: write 1 to 64 of A-Z a-z 0-9 . _ -")
        }),
        None => Ok(Name::made_of(
            &rustix::system::uname().nodename().to_string_lossy(),
        )),
    }
}

/// What a daemon's own program does to its host, besides being the daemon.
#[derive(Debug, Subcommand)]
#[expect(
    missing_docs,
    reason = "a comment here would hide the help that these have"
)]
pub enum HostCommand {
    Identity(IdentityArgs),
    Peers(PeersArgs),
    CheckConfig(CheckArgs),
}

impl HostCommand {
    /// Does it on the host of the daemon `D`, which is this `role`; whether a configuration that was checked would be taken.
    ///
    /// # Errors
    /// One line for a person.
    pub fn run<D: Settings>(&self, role: Role) -> anyhow::Result<bool> {
        match self {
            Self::Identity(args) => identity(args, role).map(|()| true),
            Self::Peers(args) => peers(args).map(|()| true),
            Self::CheckConfig(args) => config::check::<D>(args, &config::environment()),
        }
    }
}

/// Which end's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum End {
    /// The operator daemon's.
    Operator,
    /// The robot daemon's.
    Robot,
}

impl From<End> for Role {
    fn from(end: End) -> Self {
        match end {
            End::Operator => Self::Operator,
            End::Robot => Self::Robot,
        }
    }
}

/// Show this host's key by its fingerprint; make it if there is none.
#[derive(Args, Debug, Clone)]
pub struct IdentityArgs {
    /// Whose key [default: operator's; of telemime-robot: robot's].
    #[arg(value_enum)]
    pub end: Option<End>,
    /// The key file [default: ~/.config/telemime/operator.key or robot.key].
    #[arg(long, value_name = "FILE")]
    pub file: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
}

#[derive(Serialize)]
struct IdentityReport {
    file: PathBuf,
    fingerprint: String,
    short: String,
}

/// Runs `identity`.
///
/// # Errors
/// One line that says what to do.
pub fn identity(args: &IdentityArgs, usual: Role) -> anyhow::Result<()> {
    let role = args.end.map_or(usual, Role::from);
    let file = args.file.clone().unwrap_or_else(|| key_file(role));
    let key = Identity::load_or_create(&file)?.fingerprint();
    let report = IdentityReport {
        fingerprint: key.to_string(),
        short: key.short(),
        file,
    };
    if args.json {
        return say(&serde_json::to_string(&report)?);
    }
    say(&format!(
        "{}\nfingerprint {}\nin short    {}",
        report.file.display(),
        report.fingerprint,
        report.short
    ))
}

/// List whom this host trusts; add, revoke, remove.
///
/// Daemons that run notice a change within a second; a session with a key that is revoked or removed ends.
#[derive(Args, Debug, Clone)]
pub struct PeersArgs {
    #[command(subcommand)]
    deed: Option<Deed>,
    /// The peer file [default: ~/.config/telemime/peers].
    #[arg(long, global = true, value_name = "FILE")]
    file: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Subcommand, Debug, Clone)]
enum Deed {
    /// List everybody, the revoked too.
    List,
    /// Trust a key whose fingerprint you have from a source you trust.
    Add {
        /// What to call it.
        name: String,
        /// What it is to this host.
        role: End,
        /// Its fingerprint.
        fingerprint: String,
        /// Where a robot is reached, HOST:PORT.
        address: Option<String>,
    },
    /// Trust a key no more, and never again by accident: it stays listed.
    Revoke {
        /// A name or a fingerprint.
        who: String,
    },
    /// Forget a key: it can be paired again.
    Remove {
        /// A name or a fingerprint.
        who: String,
    },
}

#[derive(Serialize)]
struct PeerReport<'a> {
    name: &'a str,
    role: String,
    fingerprint: String,
    short: String,
    added: &'a str,
    revoked: bool,
    address: Option<&'a str>,
}

impl<'a> PeerReport<'a> {
    fn of(peer: &'a Peer) -> Self {
        Self {
            name: peer.name.as_ref(),
            role: peer.role.to_string(),
            fingerprint: peer.key.to_string(),
            short: peer.key.short(),
            added: &peer.added,
            revoked: peer.revoked,
            address: peer.address.as_deref(),
        }
    }
}

#[derive(Serialize)]
struct PeersReport<'a> {
    file: &'a Path,
    peers: Vec<PeerReport<'a>>,
}

/// Runs `peers`.
///
/// # Errors
/// One line that says what to do.
pub fn peers(args: &PeersArgs) -> anyhow::Result<()> {
    let file = args.file.clone().unwrap_or_else(peer_file);
    let (what, peers) = deed(args.deed.as_ref().unwrap_or(&Deed::List), &file)?;
    if args.json {
        return say(&serde_json::to_string(&PeersReport {
            file: &file,
            peers: peers.iter().map(PeerReport::of).collect(),
        })?);
    }
    if peers.is_empty() {
        return say(&format!("nobody is known in {}", file.display()));
    }
    for peer in &peers {
        let mut line = format!("{what}{} {} {}", peer.role, peer.name, peer.key.short());
        if let Some(address) = &peer.address {
            line.push_str(&format!(" at {address}"));
        }
        let standing = if peer.revoked { ", revoked" } else { "" };
        line.push_str(&format!(" since {}{standing}\n  {}", peer.added, peer.key));
        say(&line)?;
    }
    Ok(())
}

/// What was done, and to whom.
fn deed(deed: &Deed, file: &Path) -> anyhow::Result<(&'static str, Vec<Peer>)> {
    Ok(match deed {
        Deed::List => ("", Peers::load(file)?.iter().cloned().collect()),
        Deed::Add {
            name,
            role,
            fingerprint,
            address,
        } => {
            let name = own_name(Some(name))?;
            let key: Fingerprint = fingerprint.parse()?;
            let peer = Peer::new(name, (*role).into(), key, address.clone());
            let added = peer.clone();
            Peers::edit(file, |peers| peers.pin(peer))?;
            ("added: ", vec![added])
        }
        Deed::Revoke { who } => ("revoked: ", Peers::edit(file, |peers| peers.revoke(who))?),
        Deed::Remove { who } => ("removed: ", Peers::edit(file, |peers| peers.remove(who))?),
    })
}
