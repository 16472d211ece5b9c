//! What a daemon says while it runs, and when it has ended.

use std::borrow::Cow;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

use telemime_endpoint::Fingerprint;
use telemime_endpoint::meter::Counts;
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::Version;
use telemime_protocol::wire::hello::RejectCode;

use crate::console::Shape;
use crate::session::{Counters, Event, Seen as LinkSeen};
use crate::task::Outcome;

/// Why the daemon ended without doing its task.
#[derive(Debug, thiserror::Error)]
pub enum DaemonError {
    /// The robot could not be reached at all.
    #[error("cannot reach the robot at {addr}: {why}")]
    Unreachable {
        /// Its address.
        addr: SocketAddr,
        /// The last attempt's error.
        why: String,
    },
    /// The robot declined the session.
    #[error("the robot at {addr} declines: {text}")]
    Rejected {
        /// Its address.
        addr: SocketAddr,
        /// Why, for machines.
        code: RejectCode,
        /// Why, for people.
        text: String,
    },
    /// Another key answers than the one that is pinned.
    #[error(
        "the robot at {addr} has another key than the one we know: it shows {}. Either it was set up anew, or somebody \
         is in between; nothing was sent. If it was on purpose, run `telemime peers remove` for the old key and pair again",
        shown.map_or_else(|| "none we can read".to_owned(), |key| key.to_string())
    )]
    KeyChanged {
        /// Its address.
        addr: SocketAddr,
        /// What it shows.
        shown: Option<Fingerprint>,
    },
    /// The robot has revoked our key.
    #[error(
        "the robot at {addr} has revoked our key: it must be removed there (`telemime peers remove`) before it can be paired again"
    )]
    Revoked {
        /// Its address.
        addr: SocketAddr,
    },
}

/// What there is to know afterwards.
#[derive(Debug, Clone)]
pub struct Summary {
    /// How the task ended.
    pub outcome: Outcome,
    /// Sums over all sessions.
    pub counters: Counters,
    /// Traffic from first packet to last.
    pub total: Counts,
    /// Traffic from the request that was granted until the release had been sent.
    pub engaged: Counts,
    /// Sessions begun.
    pub sessions: u32,
    /// What became of the datagrams of the last session in which something was driven.
    pub seen: LinkSeen,
}

/// Something for a log or a progress bar.
#[derive(Debug, Clone)]
pub enum Notice {
    /// An attempt to connect failed and will be repeated.
    Dialling {
        /// Why.
        why: String,
    },
    /// A session began.
    Connected {
        /// Its epoch.
        epoch: u32,
        /// The protocol version both speak.
        version: Version,
    },
    /// The connection was lost.
    Lost {
        /// Why.
        why: String,
    },
    /// Something happened in the session, at this time of the session clock.
    Event(Stamp, Event),
    /// How far the task has got, in [0, 1]; a few times a second.
    Progress(f64),
    /// What became of something the person at the terminal said.
    Note(Cow<'static, str>),
    /// A performance of the task is over, and its recording's time was 0 then.
    Performed {
        /// Which one, from 1 on.
        number: u32,
        /// When, on the session clock, the recording's first sample was valid.
        zero: Stamp,
    },
    /// The link is to be like that: for whoever shapes it.
    LinkAsked(Shape),
    /// A performance was kept, by this name.
    Kept(String),
    /// The skill was refined.
    Refined {
        /// It.
        skill: Arc<Skill>,
        /// The performance, and the share of it that was new to the skill.
        learned: Vec<(String, f64)>,
    },
    /// The skill was written to this file.
    Saved(PathBuf),
    /// The scale the next engagement uses, and ε_path, m.
    Mapping {
        /// Tip metres per hand metre.
        scale: f64,
        /// ε_path, m.
        path_bound_m: f64,
        /// The robot.
        robot: String,
    },
}

/// Traffic at the request that was granted and after the release.
#[derive(Debug, Default)]
pub(super) struct Marks {
    pub(super) requests: u32,
    pub(super) requested: Counts,
    pub(super) granted: Option<Counts>,
    pub(super) released: Option<Counts>,
    pub(super) progress: f64,
    pub(super) performances: u32,
}

impl Marks {
    /// Before anything that follows the newest request is handed to QUIC.
    pub(super) fn on_request(&mut self, requests: u32, counts: Counts) {
        if self.requests != requests {
            self.requests = requests;
            self.requested = counts;
        }
    }

    pub(super) fn span(&self, total: Counts) -> Counts {
        let Some(from) = self.granted else {
            return Counts::default();
        };
        self.released.unwrap_or(total).since(from)
    }
}
