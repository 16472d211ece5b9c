//! The thread that keeps the record and writes it; the servo does not know it.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use super::file::{WriteError, write};
use super::recorder::{Due, Recorder};
use crate::servo::thread::wait_until;

/// How often the rings are emptied, ns: they hold four seconds.
const PERIOD_NS: i64 = 50_000_000;

/// What became of a record.
pub type Saved = Result<PathBuf, WriteError>;

/// Keeps a record; dropping it writes what is still to be written.
#[derive(Debug)]
pub struct Keeper {
    asked: Arc<AtomicBool>,
    quit: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// Asks for the record to be written, from any thread.
#[derive(Debug, Clone)]
pub struct Asker(Arc<AtomicBool>);

impl Asker {
    /// Writes what is held now.
    pub fn ask(&self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

impl Keeper {
    /// Keeps `recorder` on a thread of its own and writes into `dir`; `say` is told of every file, or why there is none.
    ///
    /// # Errors
    /// The system's, if it gives no thread.
    pub fn start(
        mut recorder: Recorder,
        dir: &Path,
        say: impl Fn(Due, Saved) + Send + 'static,
    ) -> std::io::Result<Self> {
        let (asked, quit) = (
            Arc::new(AtomicBool::new(false)),
            Arc::new(AtomicBool::new(false)),
        );
        let (request, stop) = (asked.clone(), quit.clone());
        let dir = dir.to_owned();
        let thread = std::thread::Builder::new()
            .name("blackbox".into())
            .spawn(move || {
                let mut at = wait_until(0);
                loop {
                    let last = stop.load(Ordering::Relaxed);
                    let mut due = recorder.drain();
                    if request.swap(false, Ordering::Relaxed) {
                        due = due.or(Some(Due::Request));
                    }
                    if last {
                        due = due.or_else(|| recorder.pending());
                    }
                    if let Some(due) = due
                        && let Some(bytes) = recorder.bytes(due)
                    {
                        say(due, write(&dir, due, &bytes));
                    }
                    if last {
                        return;
                    }
                    at = wait_until(at.0 + PERIOD_NS);
                }
            })?;
        Ok(Self {
            asked,
            quit,
            thread: Some(thread),
        })
    }

    /// By which to ask for the record.
    pub fn asker(&self) -> Asker {
        Asker(self.asked.clone())
    }
}

impl Drop for Keeper {
    fn drop(&mut self) {
        self.quit.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // If it panicked, the message is already on stderr.
            let _ = thread.join();
        }
    }
}
