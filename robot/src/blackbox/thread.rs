//! The threads that keep the record and write it; the servo does not know them, and a slow disk holds up the second only.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;

use telemime_endpoint::Mono;

use super::file::{Draft, WriteError, write};
use super::ration::{MOST, Ration, Share};
use super::recorder::{Due, Recorder};
use crate::servo::thread::wait_until;

/// How often the rings are emptied, ns: they hold four seconds.
const PERIOD_NS: i64 = 50_000_000;

/// Ticks that are missing are told of this rarely, s.
const MISSING_S: f64 = 10.0;

/// What became of a record.
pub type Saved = Result<PathBuf, WriteError>;

/// What a [`Keeper`] has to say.
#[derive(Debug)]
pub enum News {
    /// The record was to be written, and what became of it.
    Saved(Due, Saved),
    /// So many ticks more are missing in it.
    Missing(u64),
}

/// Keeps a record; dropping it writes what is still to be written.
#[derive(Debug)]
pub struct Keeper {
    asked: Arc<AtomicBool>,
    quit: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
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
    /// Keeps `recorder` on a thread of its own and writes into `dir` on another; `say` is told of every file, or why there is none, and of gaps.
    ///
    /// # Errors
    /// The system's, if it gives no thread.
    pub fn start(
        recorder: Recorder,
        dir: &Path,
        say: impl Fn(News) + Send + Clone + 'static,
    ) -> std::io::Result<Self> {
        let (asked, quit) = (
            Arc::new(AtomicBool::new(false)),
            Arc::new(AtomicBool::new(false)),
        );
        let (records, to_write) = sync_channel(1);
        let busy = Arc::new(AtomicBool::new(false));
        let unwritten = Arc::new(AtomicU32::new(0));
        let writing = {
            let (dir, busy, say) = (dir.to_owned(), busy.clone(), say.clone());
            let unwritten = unwritten.clone();
            std::thread::Builder::new()
                .name("blackbox-out".into())
                .spawn(move || write_all(&to_write, &dir, (&busy, &unwritten), say))?
        };
        let mut keeping = Keeping {
            recorder,
            dir: dir.to_owned(),
            ration: Ration::default(),
            asked: asked.clone(),
            records,
            busy,
            unwritten,
            missing: (0, None),
        };
        let stop = quit.clone();
        let keeping = std::thread::Builder::new()
            .name("blackbox".into())
            .spawn(move || {
                let mut at = wait_until(0);
                loop {
                    let last = stop.load(Ordering::Relaxed);
                    keeping.step(at, last, &say);
                    if last {
                        return;
                    }
                    at = wait_until(at.0 + PERIOD_NS);
                }
            })?;
        Ok(Self {
            asked,
            quit,
            threads: vec![keeping, writing],
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
        // The first ends by itself, and with it what the second waits for.
        for thread in self.threads.drain(..) {
            // If it panicked, the message is already on stderr.
            let _ = thread.join();
        }
    }
}

struct Keeping {
    recorder: Recorder,
    dir: PathBuf,
    ration: Ration,
    asked: Arc<AtomicBool>,
    records: SyncSender<(Due, Draft)>,
    busy: Arc<AtomicBool>,
    /// Stops whose record could not be written, since somebody looked.
    unwritten: Arc<AtomicU32>,
    /// Ticks that nobody was told of, and when somebody was.
    missing: (u64, Option<Mono>),
}

impl Keeping {
    fn step(&mut self, now: Mono, last: bool, say: &impl Fn(News)) {
        let mut stop = self.recorder.drain();
        if last {
            stop = stop.or_else(|| self.recorder.pending());
        }
        if let Some(due) = stop {
            self.ration.note(due);
        }
        self.missing.0 += self.recorder.missing();
        let recently = |told| now.secs_since(told) < MISSING_S;
        if self.missing.0 > 0 && (last || !self.missing.1.is_some_and(recently)) {
            say(News::Missing(self.missing.0));
            self.missing = (0, Some(now));
        }
        if self.busy.load(Ordering::Acquire) && !last {
            return;
        }
        self.ration
            .give_back(self.unwritten.swap(0, Ordering::Acquire));
        let due = match self.ration.take(now, last) {
            Some(Share::Write(due)) => Some(due),
            Some(Share::Enough(due)) => {
                let dir = self.dir.clone();
                say(News::Saved(
                    due,
                    Err(WriteError::Enough { dir, most: MOST }),
                ));
                None
            }
            None => None,
        };
        // What shows a stop is what was asked for, too.
        let asked = self.asked.swap(false, Ordering::Relaxed);
        let due = due.or(asked.then_some(Due::Request));
        if let Some(due) = due
            && let Some(draft) = self.recorder.draft(due)
        {
            self.busy.store(true, Ordering::Release);
            // Nobody hears of it if the other thread has panicked; the message is on stderr.
            let _ = self.records.send((due, draft));
        }
    }
}

fn write_all(
    records: &Receiver<(Due, Draft)>,
    dir: &Path,
    (busy, unwritten): (&AtomicBool, &AtomicU32),
    say: impl Fn(News),
) {
    let mut full = false;
    for (due, draft) in records {
        let saved = write(dir, due, &draft.sealed());
        if saved.is_err() && matches!(due, Due::Stop(_)) {
            unwritten.fetch_add(1, Ordering::Release);
        }
        let was_full = full;
        full = matches!(saved, Err(WriteError::Full { .. }));
        if !(full && was_full) {
            say(News::Saved(due, saved));
        }
        busy.store(false, Ordering::Release);
    }
}
