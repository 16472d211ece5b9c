//! Between what drives and what writes: bounded, and the newest wins.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Entries on their way to the disk: some seconds of them.
pub(super) const ROOM: usize = 2048;

/// What waits to be written.
#[derive(Debug)]
pub(super) struct Queue<E> {
    inner: Mutex<Inner<E>>,
    wake: Condvar,
}

#[derive(Debug)]
struct Inner<E> {
    waiting: VecDeque<E>,
    dropped: u64,
    closed: bool,
}

/// What was taken from a queue.
#[derive(Debug)]
pub(super) struct Taken<E> {
    pub(super) entries: VecDeque<E>,
    /// Entries that had to make room since the beginning.
    pub(super) dropped: u64,
    /// Nothing comes after these.
    pub(super) closed: bool,
}

impl<E> Queue<E> {
    pub(super) fn new() -> Self {
        Self {
            inner: Mutex::new(Inner {
                waiting: VecDeque::with_capacity(ROOM),
                dropped: 0,
                closed: false,
            }),
            wake: Condvar::new(),
        }
    }

    /// A panic elsewhere leaves a queue that is still one.
    fn lock(&self) -> MutexGuard<'_, Inner<E>> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Never waits for the writer: where it is too slow the oldest entry goes, and is counted.
    pub(super) fn push(&self, entry: E) {
        let mut inner = self.lock();
        if inner.closed {
            return;
        }
        if inner.waiting.len() == ROOM {
            inner.waiting.pop_front();
            inner.dropped += 1;
        }
        inner.waiting.push_back(entry);
        drop(inner);
        self.wake.notify_one();
    }

    /// Nothing is taken from now on.
    pub(super) fn close(&self) {
        self.lock().closed = true;
        self.wake.notify_one();
    }

    /// All there is, or nothing after `patience`.
    pub(super) fn take(&self, patience: Duration) -> Taken<E> {
        let idle = |inner: &mut Inner<E>| inner.waiting.is_empty() && !inner.closed;
        let (mut inner, _) = self
            .wake
            .wait_timeout_while(self.lock(), patience, idle)
            .unwrap_or_else(PoisonError::into_inner);
        Taken {
            entries: std::mem::replace(&mut inner.waiting, VecDeque::with_capacity(ROOM)),
            dropped: inner.dropped,
            closed: inner.closed,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_wins_and_what_made_room_is_counted() {
        let queue = Queue::new();
        for i in 0..ROOM + 5 {
            queue.push(i);
        }
        let taken = queue.take(Duration::ZERO);
        assert_eq!((taken.dropped, taken.entries.len()), (5, ROOM));
        assert_eq!(taken.entries.front(), Some(&5));
        assert_eq!(taken.entries.back(), Some(&(ROOM + 4)));
        queue.close();
        queue.push(0);
        let taken = queue.take(Duration::from_secs(3600));
        assert!(taken.closed && taken.entries.is_empty());
    }
}
