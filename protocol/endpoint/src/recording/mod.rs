//! Recordings in [MCAP](https://mcap.dev), which Foxglove, Lichtblick and rerun open: docs/recordings.md.
//!
//! What drives pushes entries; a thread of their own turns them into messages and writes them. It can hold nothing up: the
//! queue is bounded, the newest wins, and a disk that is full ends the recording and nothing else. The same messages go to
//! viewers that are connected, if they are to ([`live`]).

pub mod live;
mod own;
mod queue;
pub mod read;
mod reel;
mod shapes;
mod tape;

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use telemime_protocol::time::Stamp;

use live::Live;
pub use own::{Hand, Json, OperatorState, Own, RobotState};
use queue::{Queue, Taken};
pub use shapes::{BASE, Drawn, Look, in_base, info, points, poses, warning};
pub use tape::{At, Tape};

/// What is written is on the disk's side of the process after this long, s: more is not lost when it is killed.
pub const FLUSH_S: f64 = 1.0;

/// An entry that no other follows waits this long for company.
const PATIENCE: Duration = Duration::from_millis(500);

/// Why there is no recording, or no more of it.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// Nothing is overwritten.
    #[error("{} exists, and a recording overwrites nothing: give --record another name", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// It is named as something else.
    #[error("--record {}: name it NAME.mcap", path.display())]
    Name {
        /// The file.
        path: PathBuf,
    },
    /// It cannot be begun.
    #[error("{} cannot be written: {source}", path.display())]
    Create {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// It cannot be continued.
    #[error("{}: {source}; the recording ends here, and what was written before is whole", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The format has no room for it.
    #[error("{}: {source}; the recording ends here, and what was written before is whole", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// What the library said.
        source: mcap::McapError,
    },
    /// The system gives no thread.
    #[error("no thread to record from: {0}")]
    Thread(std::io::Error),
    /// Viewers cannot be waited for.
    #[error(transparent)]
    Live(#[from] live::LiveError),
}

/// Where a recording goes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct To<'a> {
    /// Into this new file.
    pub file: Option<&'a Path>,
    /// To viewers that connect here; port 0: any that is free.
    pub live: Option<SocketAddr>,
}

impl To<'_> {
    /// There is nowhere for it to go.
    pub fn is_nowhere(&self) -> bool {
        self.file.is_none() && self.live.is_none()
    }
}

/// What became of a file.
#[derive(Debug)]
pub struct Outcome {
    /// It.
    pub path: PathBuf,
    /// Messages in it, as far as it is whole.
    pub messages: u64,
    /// Entries that were lost since the beginning because the disk was too slow.
    pub dropped: u64,
    /// Why it ended before its time.
    pub error: Option<RecordError>,
}

/// What became of a file, in words.
pub fn told(path: &Path, messages: u64, dropped: u64, error: Option<&str>) -> String {
    let said = error.map_or_else(
        || format!("recorded {} ({messages} messages)", path.display()),
        |e| format!("recording: {e}"),
    );
    match dropped {
        0 => said,
        n => format!("{said}; {n} entries are missing: the disk was too slow"),
    }
}

/// Whether a file is named as a recording is.
pub fn is_named(path: &Path) -> bool {
    path.extension()
        .is_some_and(|ending| ending.eq_ignore_ascii_case("mcap"))
}

/// A recording under way; dropping it writes what is still to be written, and ends the file.
#[derive(Debug)]
pub struct Recording<E> {
    live: Option<SocketAddr>,
    queue: Arc<Queue<E>>,
    thread: Option<JoinHandle<()>>,
}

impl<E: Send + 'static> Recording<E> {
    /// Records `to` a new file, which begins by saying what it is `about`, to viewers, or both. `write` makes messages of
    /// an entry; `say` is told once of every file that has ended, on the recording's thread.
    ///
    /// # Errors
    /// [`RecordError`]: the file is not called NAME.mcap, exists or cannot be begun, viewers cannot be waited for, or there
    /// is no thread.
    pub fn start(
        to: To<'_>,
        about: BTreeMap<String, String>,
        mut write: impl FnMut(&mut Tape, E) -> Result<(), RecordError> + Send + 'static,
        say: impl Fn(Outcome) + Send + 'static,
    ) -> Result<Self, RecordError> {
        if let Some(path) = to.file.filter(|path| !is_named(path)) {
            let path = path.to_owned();
            return Err(RecordError::Name { path });
        }
        let role = about.get("role").map_or("", String::as_str);
        let live = to.live.map(|addr| Live::start(addr, role)).transpose()?;
        let at = live.as_ref().map(Live::addr);
        let mut tape = Tape::create(to.file, live, about)?;
        let queue = Arc::new(Queue::new());
        let theirs = Arc::clone(&queue);
        let thread = std::thread::Builder::new()
            .name("recording".into())
            .spawn(move || {
                let ended = run(&theirs, &mut tape, &mut write, &say);
                theirs.close();
                tell(&mut tape, &say);
                if let Some(outcome) = tape.end(ended.err()) {
                    say(outcome);
                }
            })
            .map_err(RecordError::Thread)?;
        Ok(Self {
            live: at,
            queue,
            thread: Some(thread),
        })
    }

    /// Where viewers connect, if they can.
    pub fn live(&self) -> Option<SocketAddr> {
        self.live
    }

    /// Leaves an entry to be written; never waits.
    pub fn push(&self, entry: E) {
        self.queue.push(entry);
    }
}

fn run<E>(
    queue: &Queue<E>,
    tape: &mut Tape,
    write: &mut impl FnMut(&mut Tape, E) -> Result<(), RecordError>,
    say: &impl Fn(Outcome),
) -> Result<(), RecordError> {
    loop {
        let Taken {
            entries,
            dropped,
            closed,
        } = queue.take(PATIENCE);
        let idle = entries.is_empty();
        tape.lost(dropped)?;
        for entry in entries {
            write(tape, entry)?;
            tell(tape, say);
        }
        if closed {
            return Ok(());
        }
        tape.flush(idle)?;
        tell(tape, say);
    }
}

fn tell(tape: &mut Tape, say: &impl Fn(Outcome)) {
    while let Some(outcome) = tape.take_ended() {
        say(outcome);
    }
}

impl<E> Drop for Recording<E> {
    fn drop(&mut self) {
        self.queue.close();
        if let Some(thread) = self.thread.take() {
            // If it panicked, the message is already on stderr.
            let _ = thread.join();
        }
    }
}

/// Nanoseconds as MCAP counts them: none below 0.
fn nanos(t: Stamp) -> u64 {
    u64::try_from(t.0).unwrap_or(0)
}

#[cfg(test)]
mod tests;
