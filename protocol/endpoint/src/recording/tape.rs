//! What messages are written on: a file, viewers that are connected, or both.

use std::collections::{BTreeMap, VecDeque};
use std::path::Path;

use foxglove::Encode;
use telemime_protocol::time::Stamp;

use super::live::Live;
use super::reel::Reel;
use super::shapes::warning;
use super::{Outcome, RecordError};

/// Where losses are told.
const LOG: &str = "/recording/log";

/// The two times of a message, both on the session clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct At {
    /// When it was known here: MCAP's log time.
    pub log: Stamp,
    /// When what it says held: MCAP's publish time, and the message's own timestamp.
    pub publish: Stamp,
}

impl At {
    /// Known as soon as it held.
    pub fn once(t: Stamp) -> Self {
        Self { log: t, publish: t }
    }
}

/// A file being written, or several (one per session clock), and viewers that are shown the same.
pub struct Tape {
    reel: Option<Reel>,
    live: Option<Live>,
    newest: Stamp,
    dropped: u64,
    ended: VecDeque<Outcome>,
    buffer: Vec<u8>,
}

impl Tape {
    /// Begins the file, which must not exist, if there is to be one.
    pub(super) fn create(
        path: Option<&Path>,
        live: Option<Live>,
        about: BTreeMap<String, String>,
    ) -> Result<Self, RecordError> {
        Ok(Self {
            reel: path.map(|path| Reel::create(path, about)).transpose()?,
            live,
            newest: Stamp::ZERO,
            dropped: 0,
            ended: VecDeque::new(),
            buffer: Vec::new(),
        })
    }

    /// Writes `message` under `topic`.
    ///
    /// # Errors
    /// [`RecordError::Write`], [`RecordError::Format`]; none while viewers are served, for whom it goes on without the file.
    pub fn message<T: Encode>(
        &mut self,
        topic: &'static str,
        at: At,
        message: &T,
    ) -> Result<(), RecordError> {
        self.buffer.clear();
        message
            .encode(&mut self.buffer)
            .expect("a vector has room for any message");
        self.newest = self.newest.max(at.log);
        if let Some(live) = &mut self.live {
            live.message::<T>(topic, at, &self.buffer);
        }
        let done = match &mut self.reel {
            Some(reel) => reel.message::<T>(topic, at, &self.buffer),
            None => Ok(()),
        };
        self.or_without(done)
    }

    /// Ends the file and begins another beside it: `NAME-2.mcap`, or the next number that is free. For another session
    /// clock, whose times would lie among those of the first. Viewers are told to forget.
    ///
    /// # Errors
    /// [`RecordError`]; none while viewers are served.
    pub fn another(&mut self) -> Result<(), RecordError> {
        self.newest = Stamp::ZERO;
        if let Some(live) = &mut self.live {
            live.another();
        }
        let Some(reel) = &mut self.reel else {
            return Ok(());
        };
        self.ended.push_back(reel.end(self.dropped, None));
        let done = reel.another();
        self.or_without(done)
    }

    /// So many entries were lost since the beginning.
    pub(super) fn lost(&mut self, dropped: u64) -> Result<(), RecordError> {
        let more = dropped - self.dropped;
        self.dropped = dropped;
        if more == 0 {
            return Ok(());
        }
        let slow = match self.reel {
            Some(_) => "disk",
            None => "computer",
        };
        let text = format!("{more} entries are missing here: the {slow} was too slow");
        let at = At::once(self.newest);
        self.message(LOG, at, &warning(at.publish, &text))
    }

    /// What became of a file that is over, although more is to come.
    pub(super) fn take_ended(&mut self) -> Option<Outcome> {
        self.ended.pop_front()
    }

    /// Completes the chunk if it is a second old, or if there is time.
    pub(super) fn flush(&mut self, idle: bool) -> Result<(), RecordError> {
        let done = match &mut self.reel {
            Some(reel) => reel.flush(idle),
            None => Ok(()),
        };
        self.or_without(done)
    }

    /// Ends the file, if there is one; with an `error`, where it last was whole.
    pub(super) fn end(&mut self, error: Option<RecordError>) -> Option<Outcome> {
        let mut reel = self.reel.take()?;
        Some(reel.end(self.dropped, error))
    }

    /// A file that cannot be continued ends; with viewers to serve it goes on without.
    fn or_without(&mut self, done: Result<(), RecordError>) -> Result<(), RecordError> {
        match done {
            Err(error) if self.live.is_some() => {
                let ended = self.end(Some(error));
                self.ended.extend(ended);
                Ok(())
            }
            done => done,
        }
    }
}
