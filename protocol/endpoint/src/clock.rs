//! The host's monotonic clock, which paused tokio time can stand in for.

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};
use telemime_protocol::wire::v1::ExternalClock;
use tokio::time::Instant;

/// A moment on the host's monotonic clock (`CLOCK_MONOTONIC`), ns. Common to all processes of a host.
#[derive(
    Clone,
    Copy,
    Debug,
    Default,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    serde::Serialize,
    serde::Deserialize,
)]
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

/// Two clocks read this close together are paired without another try.
const NARROW: Duration = Duration::from_micros(50);

/// Tries to pair them.
const TRIES: u32 = 32;

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
        Self::between(Instant::now, || {
            let now = clock_gettime(ClockId::Monotonic);
            now.tv_sec * 1_000_000_000 + now.tv_nsec
        })
    }

    /// Pairs a reading of one clock with the middle of two of the other around it. A process that is put aside in
    /// between would be off by that long for good, so the narrowest of some tries counts.
    fn between(mut instant: impl FnMut() -> Instant, mut mono_ns: impl FnMut() -> i64) -> Self {
        let mut best: Option<(Duration, Self)> = None;
        for _ in 0..TRIES {
            let (before, mono_ns, after) = (instant(), mono_ns(), instant());
            let gap = after.duration_since(before);
            if best.as_ref().is_none_or(|(least, _)| gap < *least) {
                let instant = before + gap / 2;
                best = Some((gap, Self { instant, mono_ns }));
            }
            if gap < NARROW {
                break;
            }
        }
        best.map_or_else(Self::from_zero, |(_, clock)| clock)
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
        self.instant + Duration::from_nanos(ahead)
    }
}

/// Seconds since 1970 on the host's wall clock, which may be stepped at any time: to date a note by, nothing else.
pub fn wall_s() -> i64 {
    clock_gettime(ClockId::Realtime).tv_sec
}

/// A clock that is kept right from outside: the host's wall clock, if PTP, chrony or the like disciplines it and
/// the user says how well.
///
/// It is read only relative to the monotonic clock. Both run at the same, disciplined rate, so their difference
/// changes when somebody sets the wall clock, and at no other time: a step is seen as what it is.
#[derive(Debug, Clone)]
pub struct External {
    wall: Wall,
    dispersion: Duration,
}

#[derive(Debug, Clone)]
enum Wall {
    Host,
    Stated(Arc<AtomicI64>),
}

impl External {
    /// The host's wall clock (`CLOCK_REALTIME`), never wrong by more than `dispersion`.
    pub fn host(dispersion: Duration) -> Self {
        let wall = Wall::Host;
        Self { wall, dispersion }
    }

    /// A clock that is ahead of [`HostClock`] by as many ns as `ahead_ns` holds: for virtual time.
    pub fn stated(ahead_ns: Arc<AtomicI64>, dispersion: Duration) -> Self {
        let wall = Wall::Stated(ahead_ns);
        Self { wall, dispersion }
    }

    /// How far it is ahead of the monotonic clock now, ns.
    pub fn ahead_ns(&self) -> i64 {
        match &self.wall {
            Wall::Stated(ahead_ns) => ahead_ns.load(Ordering::Relaxed),
            Wall::Host => {
                let read = |id| {
                    let now = clock_gettime(id);
                    now.tv_sec * 1_000_000_000 + now.tv_nsec
                };
                let pair = || {
                    let before = read(ClockId::Monotonic);
                    let wall = read(ClockId::Realtime);
                    let gap = read(ClockId::Monotonic) - before;
                    (gap, wall - (before + gap / 2))
                };
                // Put aside in between, a reading would be off by that long: the narrowest of some counts.
                let narrowest = (0..4).map(|_| pair()).min_by_key(|(gap, _)| *gap);
                narrowest.map_or(0, |(_, ahead_ns)| ahead_ns)
            }
        }
    }

    /// As it goes over the wire, relative to a clock that shows 0 when the monotonic one shows `zero`.
    pub fn message(&self, zero: Mono) -> ExternalClock {
        ExternalClock {
            ahead_us: self.ahead_ns().saturating_add(zero.0) / 1000,
            dispersion_us: u32::try_from(self.dispersion.as_micros()).unwrap_or(u32::MAX),
        }
    }
}

impl Default for HostClock {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_wall_clock_runs_beside_the_monotonic_one() {
        let external = External::host(Duration::from_micros(50));
        let read = |id| clock_gettime(id).tv_sec;
        let coarse = read(ClockId::Realtime) - read(ClockId::Monotonic);
        assert!((external.ahead_ns() / 1_000_000_000 - coarse).abs() <= 1);
        assert_eq!(external.message(Mono(0)).dispersion_us, 50);
        let stated = External::stated(Arc::new(AtomicI64::new(7_000)), Duration::from_secs(1));
        // A session clock that shows 0 at 5 µs is 12 µs behind at any time.
        assert_eq!(stated.message(Mono(5_000)).ahead_us, 12);
    }

    #[test]
    fn a_pause_between_two_readings_does_not_shift_the_clock() {
        let base = Instant::now();
        let ms = Duration::from_millis;
        // Put aside for 30 ms in the first try, for 2 ms in the second; then read at once.
        let mut instants = [0, 30, 40, 42, 50, 50].into_iter();
        let mut monos = [1, 41, 50].into_iter();
        let clock = HostClock::between(
            || base + ms(instants.next().unwrap()),
            || monos.next().unwrap() * 1_000_000,
        );
        assert_eq!(clock.instant(Mono(80_000_000)), base + ms(80));
        assert_eq!(instants.next(), None, "narrow enough: no further try");
        // Never narrow: there is an end to it, and the middle of the least wide counts.
        let mut read = 0;
        let clock = HostClock::between(
            || {
                read += 1;
                base + ms(read * 4)
            },
            || 0,
        );
        assert_eq!(clock.instant(Mono(0)), base + ms(6));
        assert_eq!(read, 2 * u64::from(TRIES));
    }
}
