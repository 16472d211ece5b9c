//! The thread that ticks: absolute deadlines on the monotonic clock, nothing shared but the rings.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::thread::JoinHandle;

use rustix::thread::clock_nanosleep_absolute;
use rustix::time::{ClockId, Timespec, clock_gettime};
use telemime_endpoint::Mono;

use super::core::Core;
use super::stats::TickStats;

/// Most ticks run in a burst after a delay.
const CATCH_UP_TICKS: i64 = 20;

/// The servo's timing, readable at any time without disturbing it.
#[derive(Debug, Default)]
pub struct Timing {
    /// Mean work of a tick, ns.
    pub mean_ns: AtomicU32,
    /// 99th percentile of it, ns.
    pub p99_ns: AtomicU32,
    /// Ticks that began more than a period late.
    pub overruns: AtomicU32,
    /// Ticks so far.
    pub ticks: AtomicU64,
}

impl Timing {
    /// Ticks, mean and 99th percentile (ns), overruns.
    pub fn read(&self) -> (u64, u32, u32, u32) {
        let get = |value: &AtomicU32| value.load(Ordering::Relaxed);
        (
            self.ticks.load(Ordering::Relaxed),
            get(&self.mean_ns),
            get(&self.p99_ns),
            get(&self.overruns),
        )
    }
}

/// A running servo; dropping it stops the thread after the current tick.
#[derive(Debug)]
pub struct Servo {
    /// Its timing.
    pub timing: Arc<Timing>,
    quit: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// `CLOCK_MONOTONIC`, ns.
fn now() -> Mono {
    let t = clock_gettime(ClockId::Monotonic);
    Mono(t.tv_sec * 1_000_000_000 + t.tv_nsec)
}

impl Servo {
    /// Starts `core` on a thread of its own.
    ///
    /// # Errors
    /// The system's, if it gives no thread.
    pub fn start(core: Core) -> io::Result<Self> {
        let timing = Arc::new(Timing::default());
        let quit = Arc::new(AtomicBool::new(false));
        let (shared, stop) = (timing.clone(), quit.clone());
        let thread = std::thread::Builder::new()
            .name("servo".into())
            .spawn(move || run(core, &shared, &stop))?;
        Ok(Self {
            timing,
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

fn run(mut core: Core, timing: &Timing, quit: &AtomicBool) {
    let period_ns = (core.tick_s() * 1e9).round() as i64;
    let mut stats = TickStats::default();
    let mut overruns = 0;
    let mut due = now().0;
    while !quit.load(Ordering::Relaxed) {
        due += period_ns;
        let until = Timespec {
            tv_sec: due / 1_000_000_000,
            tv_nsec: due % 1_000_000_000,
        };
        while clock_nanosleep_absolute(ClockId::Monotonic, &until).is_err() {}
        let begun = now();
        if begun.0 - due > period_ns {
            overruns += 1;
        }
        // A few missed ticks are made up for, so that the simulated arm's time keeps up with ours; more are not.
        if begun.0 - due > CATCH_UP_TICKS * period_ns {
            due = begun.0;
        }
        core.tick(begun);
        stats.add((now().0 - begun.0).clamp(0, i64::from(u32::MAX)) as u32);
        if stats.count() % 64 == 0 {
            timing.mean_ns.store(stats.mean_ns(), Ordering::Relaxed);
            timing
                .p99_ns
                .store(stats.quantile_ns(0.99), Ordering::Relaxed);
            timing.overruns.store(overruns, Ordering::Relaxed);
            timing.ticks.store(stats.count(), Ordering::Relaxed);
        }
    }
}
