//! The host's monotonic clock, which paused tokio time can stand in for.

use rustix::time::{ClockId, clock_gettime};
use tokio::time::Instant;

/// A moment on the host's monotonic clock (`CLOCK_MONOTONIC`), ns. Common to all processes of a host.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Mono(pub i64);

impl Mono {
    /// Seconds from `earlier` to `self`.
    pub fn secs_since(self, earlier: Self) -> f64 {
        self.0.saturating_sub(earlier.0) as f64 * 1e-9
    }

    /// This moment moved by `dt_s` seconds, rounded to the nanosecond.
    #[must_use]
    pub fn offset_by_secs(self, dt_s: f64) -> Self {
        Self(self.0.saturating_add((dt_s * 1e9).round() as i64))
    }
}

/// Reads [`Mono`] through tokio's clock: real time in the daemons, virtual time under
/// `tokio::time::pause`, with nothing to configure.
#[derive(Clone, Copy, Debug)]
pub struct HostClock {
    instant: Instant,
    mono_ns: i64,
}

impl HostClock {
    /// A clock that reads `CLOCK_MONOTONIC`.
    pub fn new() -> Self {
        let now = clock_gettime(ClockId::Monotonic);
        Self {
            instant: Instant::now(),
            mono_ns: now.tv_sec * 1_000_000_000 + now.tv_nsec,
        }
    }

    /// A clock whose zero is now: virtual runs start alike.
    pub fn from_zero() -> Self {
        Self {
            instant: Instant::now(),
            mono_ns: 0,
        }
    }

    /// Now.
    pub fn now(&self) -> Mono {
        Mono(self.mono_ns + self.instant.elapsed().as_nanos() as i64)
    }

    /// The tokio instant at which this clock reads `at`; now, if that has passed.
    pub fn instant(&self, at: Mono) -> Instant {
        let ahead = at.0.saturating_sub(self.mono_ns).max(0) as u64;
        self.instant + std::time::Duration::from_nanos(ahead)
    }
}

impl Default for HostClock {
    fn default() -> Self {
        Self::new()
    }
}
