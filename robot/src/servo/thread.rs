//! The thread that ticks: absolute deadlines on the monotonic clock, nothing shared but the rings.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::mpsc::sync_channel;
use std::thread::JoinHandle;

use rustix::thread::clock_nanosleep_absolute;
use rustix::time::{ClockId, Timespec, clock_gettime};
use telemime_endpoint::Mono;

use super::realtime::{Priority, Realtime};
use super::station::Station;
use super::stats::{Quantiles, TickStats};

/// Most ticks run in a burst after a delay.
const CATCH_UP_TICKS: i64 = 20;

/// Ticks between two publications of the timing.
const PUBLISHED: u64 = 64;

/// The servo's timing, readable at any time without disturbing it.
#[derive(Debug, Default)]
pub struct Timing {
    mean_ns: AtomicU32,
    work: Shared,
    wake: Shared,
    overruns: AtomicU32,
    ticks: AtomicU64,
}

/// What a [`Timing`] reads.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Times {
    /// Ticks so far.
    pub ticks: u64,
    /// Mean work of a tick, ns.
    pub mean_ns: u32,
    /// Work of a tick.
    pub work: Quantiles,
    /// How late after its deadline a tick began.
    pub wake: Quantiles,
    /// Ticks that began more than a period late.
    pub overruns: u32,
}

#[derive(Debug, Default)]
struct Shared([AtomicU32; 4]);

impl Shared {
    fn write(&self, stats: &TickStats) {
        let q = stats.quantiles();
        let values = [q.p50_ns, q.p99_ns, q.p999_ns, q.max_ns];
        for (shared, value) in self.0.iter().zip(values) {
            shared.store(value, Ordering::Relaxed);
        }
    }

    fn read(&self) -> Quantiles {
        let [p50_ns, p99_ns, p999_ns, max_ns] =
            [0, 1, 2, 3].map(|i| self.0[i].load(Ordering::Relaxed));
        Quantiles {
            p50_ns,
            p99_ns,
            p999_ns,
            max_ns,
        }
    }
}

impl Timing {
    /// The timing up to a moment ago.
    pub fn read(&self) -> Times {
        Times {
            ticks: self.ticks.load(Ordering::Relaxed),
            mean_ns: self.mean_ns.load(Ordering::Relaxed),
            work: self.work.read(),
            wake: self.wake.read(),
            overruns: self.overruns.load(Ordering::Relaxed),
        }
    }

    fn publish(&self, work: &TickStats, wake: &TickStats, overruns: u32) {
        self.mean_ns.store(work.mean_ns(), Ordering::Relaxed);
        self.work.write(work);
        self.wake.write(wake);
        self.overruns.store(overruns, Ordering::Relaxed);
        self.ticks.store(work.count(), Ordering::Relaxed);
    }
}

/// A running servo; dropping it stops the thread after the current tick.
#[derive(Debug)]
pub struct Servo {
    /// Its timing.
    pub timing: Arc<Timing>,
    /// What of the real-time priority asked for was to be had.
    pub realtime: Option<Realtime>,
    quit: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// `CLOCK_MONOTONIC`, ns.
pub(crate) fn now() -> Mono {
    let t = clock_gettime(ClockId::Monotonic);
    Mono(t.tv_sec * 1_000_000_000 + t.tv_nsec)
}

/// Waits until `due_ns` on that clock; returns when that turned out to be.
pub(crate) fn wait_until(due_ns: i64) -> Mono {
    let until = Timespec {
        tv_sec: due_ns / 1_000_000_000,
        tv_nsec: due_ns % 1_000_000_000,
    };
    while clock_nanosleep_absolute(ClockId::Monotonic, &until).is_err() {}
    now()
}

impl Servo {
    /// Starts `station` on a thread of its own, with `priority` if the system grants that.
    ///
    /// # Errors
    /// The system's, if it gives no thread.
    pub fn start(station: Station, priority: Option<Priority>) -> io::Result<Self> {
        let timing = Arc::new(Timing::default());
        let quit = Arc::new(AtomicBool::new(false));
        let (shared, stop) = (timing.clone(), quit.clone());
        let (granted, grants) = sync_channel(1);
        let thread = std::thread::Builder::new()
            .name("servo".into())
            .spawn(move || {
                // Whoever starts it waits for this.
                let _ = granted.send(priority.map(Priority::take));
                run(station, &shared, &stop);
            })?;
        Ok(Self {
            timing,
            realtime: grants.recv().ok().flatten(),
            quit,
            thread: Some(thread),
        })
    }
}

impl Drop for Servo {
    fn drop(&mut self) {
        self.quit.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // The tick does not panic; if it did, the message is already on stderr.
            let _ = thread.join();
        }
    }
}

fn run(mut station: Station, timing: &Timing, quit: &AtomicBool) {
    let period_ns = (station.tick_s() * 1e9).round() as i64;
    let (mut work, mut wake) = (TickStats::default(), TickStats::default());
    let mut overruns = 0;
    let mut due = now().0;
    let small = |ns: i64| ns.clamp(0, i64::from(u32::MAX)) as u32;
    while !quit.load(Ordering::Relaxed) {
        due += period_ns;
        let begun = wait_until(due);
        let late = begun.0 - due;
        wake.add(small(late));
        if late > period_ns {
            overruns += 1;
        }
        // A few missed ticks are made up for, so that the simulated arm's time keeps up with ours; more are not.
        if late > CATCH_UP_TICKS * period_ns {
            due = begun.0;
        }
        station.tick(begun);
        work.add(small(now().0 - begun.0));
        if work.count() % PUBLISHED == 0 {
            timing.publish(&work, &wake, overruns);
        }
    }
    timing.publish(&work, &wake, overruns);
}
