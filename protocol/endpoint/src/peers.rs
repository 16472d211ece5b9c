//! The peer store: a text file that says whose keys are trusted, and whose are not any more.
//!
//! ```text
//! # comments and empty lines are kept
//! NAME ROLE FINGERPRINT ADDED STANDING [ADDRESS]
//! lab-arm robot e3b0…b855 2026-11-22T09:30:00Z trusted lab.example:4433
//! ```

mod follow;
#[cfg(test)]
mod tests;

use std::fmt;
use std::fs::{File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

pub use telemime_protocol::wire::pair::Name;
use time::OffsetDateTime;
use time::format_description::well_known::Rfc3339;

use crate::clock;
use crate::identity::Fingerprint;

pub use follow::{Source, Whom};

/// What a peer is to us.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// It may drive this robot.
    Operator,
    /// This operator drives it.
    Robot,
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Operator => "operator",
            Self::Robot => "robot",
        })
    }
}

/// A line of the store.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Peer {
    /// What it is called, once for each role.
    pub name: Name,
    /// What it is to us.
    pub role: Role,
    /// Its key.
    pub key: Fingerprint,
    /// When it was added, RFC 3339.
    pub added: String,
    /// Whether it was revoked.
    pub revoked: bool,
    /// A robot's `host:port`, as the operator wrote it.
    pub address: Option<String>,
}

impl Peer {
    /// A trusted peer, added now.
    pub fn new(name: Name, role: Role, key: Fingerprint, address: Option<String>) -> Self {
        let now = OffsetDateTime::from_unix_timestamp(clock::wall_s())
            .ok()
            .and_then(|now| now.format(&Rfc3339).ok());
        Self {
            name,
            role,
            key,
            // A host whose clock stands outside the years 0 to 9999 knows no date.
            added: now.unwrap_or_else(|| "-".to_owned()),
            revoked: false,
            address,
        }
    }

    fn parse(line: &str) -> Result<Self, String> {
        let fields: Vec<_> = line.split_ascii_whitespace().collect();
        let [name, role, key, added, standing, rest @ ..] = fields.as_slice() else {
            return Err(format!("{} fields", fields.len()));
        };
        let address = match rest {
            [] => None,
            [address] => Some((*address).to_owned()),
            _ => return Err(format!("{} fields", fields.len())),
        };
        Ok(Self {
            name: Name::new(name).ok_or_else(|| format!("`{name}` is no name"))?,
            role: match *role {
                "operator" => Role::Operator,
                "robot" => Role::Robot,
                other => return Err(format!("`{other}` is neither operator nor robot")),
            },
            key: key
                .parse()
                .map_err(|_| format!("`{key}` is no fingerprint"))?,
            added: (*added).to_owned(),
            revoked: match *standing {
                "trusted" => false,
                "revoked" => true,
                other => return Err(format!("`{other}` is neither trusted nor revoked")),
            },
            address,
        })
    }
}

impl fmt::Display for Peer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            name,
            role,
            key,
            added,
            ..
        } = self;
        let standing = if self.revoked { "revoked" } else { "trusted" };
        write!(f, "{name} {role} {key} {added} {standing}")?;
        self.address.iter().try_for_each(|a| write!(f, " {a}"))
    }
}

/// What is wrong with a store, or with a change to it.
#[derive(Debug, thiserror::Error)]
pub enum PeersError {
    /// The file cannot be read or written.
    #[error("peer file {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// Others may write the file.
    #[error(
        "peer file {path} has mode {mode:04o}: others may write it, and so let anybody in; look through it, then run `chmod 600 {path}`"
    )]
    Permissions {
        /// The file.
        path: PathBuf,
        /// Its permission bits.
        mode: u32,
    },
    /// A line is none.
    #[error(
        "peer file {path}, line {line}: {what}; write NAME operator|robot FINGERPRINT ADDED trusted|revoked [ADDRESS]"
    )]
    Line {
        /// The file.
        path: PathBuf,
        /// Counted from 1.
        line: usize,
        /// What is wrong.
        what: String,
    },
    /// The name belongs to another key.
    #[error(
        "the {role} {name} is known by the key {known}, and this one is {new}: if it was set up anew on purpose, run `telemime peers remove {name}` first; if not, somebody may be in between"
    )]
    NameTaken {
        /// The name.
        name: Name,
        /// Whose.
        role: Role,
        /// The key it is known by.
        known: Fingerprint,
        /// The key it is to have.
        new: Fingerprint,
    },
    /// The address belongs to another key.
    #[error(
        "the robot at {address} is known as {name} by the key {known}, and this one is {new}: if it was set up anew on purpose, run `telemime peers remove {name}` first; if not, somebody may be in between"
    )]
    AddressTaken {
        /// The address.
        address: String,
        /// What it is called.
        name: Name,
        /// The key it is known by.
        known: Fingerprint,
        /// The key it is to have.
        new: Fingerprint,
    },
    /// The address would not be read back as one.
    #[error("{0:?} is no address: HOST:PORT, without blanks")]
    Address(String),
    /// The key was revoked.
    #[error(
        "the key {key} of {name} was revoked: run `telemime peers remove {name}` first if it is to be trusted again"
    )]
    Revoked {
        /// What it was called.
        name: Name,
        /// The key.
        key: Fingerprint,
    },
    /// Nobody is called so.
    #[error("no peer `{0}`: `telemime peers` lists the names and fingerprints there are")]
    Unknown(String),
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Line {
    Peer(Peer),
    Other(String),
}

/// What a peer file says.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Peers {
    lines: Vec<Line>,
}

impl Peers {
    /// Reads `path`; a file that does not exist is empty.
    ///
    /// # Errors
    /// [`PeersError::Io`], [`PeersError::Permissions`], [`PeersError::Line`].
    pub fn load(path: &Path) -> Result<Self, PeersError> {
        let io = |source| PeersError::Io {
            path: path.to_owned(),
            source,
        };
        let mut file = match File::open(path) {
            Ok(file) => file,
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(Self::default()),
            Err(e) => return Err(io(e)),
        };
        let mode = file.metadata().map_err(io)?.mode() & 0o777;
        if mode & 0o022 != 0 {
            return Err(PeersError::Permissions {
                path: path.to_owned(),
                mode,
            });
        }
        let mut text = String::new();
        file.read_to_string(&mut text).map_err(io)?;
        let parse = |(i, line): (usize, &str)| {
            if line.trim().is_empty() || line.trim_start().starts_with('#') {
                return Ok(Line::Other(line.to_owned()));
            }
            Peer::parse(line)
                .map(Line::Peer)
                .map_err(|what| PeersError::Line {
                    path: path.to_owned(),
                    line: i + 1,
                    what,
                })
        };
        let lines = text
            .lines()
            .enumerate()
            .map(parse)
            .collect::<Result<_, _>>()?;
        Ok(Self { lines })
    }

    /// Reads `path`, changes it and writes it back whole (mode 0600), while no other process does the same.
    ///
    /// # Errors
    /// [`PeersError`]; the file is then as before.
    pub fn edit<T>(
        path: &Path,
        change: impl FnOnce(&mut Self) -> Result<T, PeersError>,
    ) -> Result<T, PeersError> {
        let io = |source| PeersError::Io {
            path: path.to_owned(),
            source,
        };
        if let Some(folder) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
            std::fs::create_dir_all(folder).map_err(io)?;
        }
        let private = |path: &Path| {
            let mut options = OpenOptions::new();
            options.write(true).create(true).truncate(true).mode(0o600);
            options.open(path)
        };
        let beside = |end: &str| {
            let mut name = path.as_os_str().to_owned();
            name.push(end);
            PathBuf::from(name)
        };
        let lock = private(&beside(".lock")).map_err(io)?;
        lock.lock().map_err(io)?;
        let mut peers = Self::load(path)?;
        let before = peers.clone();
        let done = change(&mut peers)?;
        if peers != before {
            let next = beside(".new");
            let write = || {
                let mut file = private(&next)?;
                write!(file, "{peers}")?;
                file.sync_all()?;
                std::fs::rename(&next, path)
            };
            write().map_err(io)?;
        }
        Ok(done)
    }

    /// Everybody, in the file's order.
    pub fn iter(&self) -> impl Iterator<Item = &Peer> {
        self.lines.iter().filter_map(|line| match line {
            Line::Peer(peer) => Some(peer),
            Line::Other(_) => None,
        })
    }

    /// The keys with this role that are revoked (or are not).
    pub fn keys(&self, role: Role, revoked: bool) -> impl Iterator<Item = Fingerprint> {
        let wanted = move |p: &&Peer| p.role == role && p.revoked == revoked;
        self.iter().filter(wanted).map(|peer| peer.key)
    }

    /// The robot that an operator means by a name or an address.
    pub fn robot(&self, name_or_address: &str) -> Option<&Peer> {
        let robots = || self.iter().filter(|p| p.role == Role::Robot);
        robots()
            .find(|p| p.name.as_ref() == name_or_address)
            .or_else(|| robots().find(|p| p.address.as_deref() == Some(name_or_address)))
    }

    /// Trusts `peer` from now on. A key that is there already keeps its line, with the new name and address.
    ///
    /// # Errors
    /// [`PeersError::Address`], [`PeersError::NameTaken`], [`PeersError::AddressTaken`], [`PeersError::Revoked`].
    pub fn pin(&mut self, peer: Peer) -> Result<(), PeersError> {
        let unreadable = |text: &&String| {
            text.is_empty() || text.contains(|c: char| c.is_whitespace() || c.is_control())
        };
        if let Some(address) = peer.address.as_ref().filter(unreadable) {
            return Err(PeersError::Address(address.clone()));
        }
        for known in self.iter().filter(|p| p.role == peer.role) {
            if known.key == peer.key {
                if known.revoked {
                    return Err(PeersError::Revoked {
                        name: known.name.clone(),
                        key: known.key,
                    });
                }
            } else if known.name == peer.name {
                return Err(PeersError::NameTaken {
                    name: peer.name.clone(),
                    role: peer.role,
                    known: known.key,
                    new: peer.key,
                });
            } else if let Some(address) = known.address.clone()
                && !known.revoked
                && known.address == peer.address
            {
                return Err(PeersError::AddressTaken {
                    address,
                    name: known.name.clone(),
                    known: known.key,
                    new: peer.key,
                });
            }
        }
        let held = self.lines.iter_mut().find_map(|line| match line {
            Line::Peer(held) if held.role == peer.role && held.key == peer.key => Some(held),
            _ => None,
        });
        match held {
            Some(held) => {
                held.name = peer.name;
                held.address = peer.address.or(held.address.take());
            }
            None => self.lines.push(Line::Peer(peer)),
        }
        Ok(())
    }

    /// Revokes whoever is called so, or has this fingerprint: it stays listed, and is refused. Returns the lines.
    ///
    /// # Errors
    /// [`PeersError::Unknown`].
    pub fn revoke(&mut self, who: &str) -> Result<Vec<Peer>, PeersError> {
        let mut found = Vec::new();
        for line in &mut self.lines {
            if let Line::Peer(peer) = line
                && peer.is(who)
            {
                peer.revoked = true;
                found.push(peer.clone());
            }
        }
        if found.is_empty() {
            return Err(PeersError::Unknown(who.to_owned()));
        }
        Ok(found)
    }

    /// Forgets whoever is called so, or has this fingerprint. Returns the lines.
    ///
    /// # Errors
    /// [`PeersError::Unknown`].
    pub fn remove(&mut self, who: &str) -> Result<Vec<Peer>, PeersError> {
        let found: Vec<_> = self.iter().filter(|p| p.is(who)).cloned().collect();
        if found.is_empty() {
            return Err(PeersError::Unknown(who.to_owned()));
        }
        self.lines
            .retain(|line| !matches!(line, Line::Peer(peer) if peer.is(who)));
        Ok(found)
    }
}

impl Peer {
    fn is(&self, who: &str) -> bool {
        self.name.as_ref() == who || who.parse().is_ok_and(|key: Fingerprint| key == self.key)
    }
}

impl fmt::Display for Peers {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.lines.iter().try_for_each(|line| match line {
            Line::Peer(peer) => writeln!(f, "{peer}"),
            Line::Other(text) => writeln!(f, "{text}"),
        })
    }
}
