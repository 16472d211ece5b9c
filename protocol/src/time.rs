//! Time on the session clock.

use core::ops::{Add, AddAssign, Sub};
use core::time::Duration;

use serde::{Deserialize, Serialize};

/// A moment on the session clock: nanoseconds since the session's epoch.
///
/// The operator's monotonic clock is the session clock (the robot converts with its estimate of the
/// offset), and a stamp says when a sample is *valid*, not when it was sent. Signed, because
/// subtracting a sensor's latency may lead to before the epoch.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct Stamp(pub i64);

impl Stamp {
    /// The session's epoch.
    pub const ZERO: Self = Self(0);

    /// The stamp `t_s` seconds after the epoch, rounded to the nanosecond (saturating; NaN is 0).
    pub fn from_secs_f64(t_s: f64) -> Self {
        Self((t_s * 1e9).round() as i64)
    }

    /// Seconds since the epoch.
    pub fn as_secs_f64(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// Seconds from `earlier` to `self`; negative if `earlier` is later.
    pub fn secs_since(self, earlier: Self) -> f64 {
        self.0.saturating_sub(earlier.0) as f64 * 1e-9
    }

    /// This stamp moved by `dt_s` seconds, rounded to the nanosecond, saturating.
    #[must_use]
    pub fn offset_by_secs(self, dt_s: f64) -> Self {
        Self(self.0.saturating_add((dt_s * 1e9).round() as i64))
    }
}

impl Add<Duration> for Stamp {
    type Output = Self;

    fn add(self, rhs: Duration) -> Self {
        Self(
            self.0
                .saturating_add(i64::try_from(rhs.as_nanos()).unwrap_or(i64::MAX)),
        )
    }
}

impl AddAssign<Duration> for Stamp {
    fn add_assign(&mut self, rhs: Duration) {
        *self = *self + rhs;
    }
}

impl Sub<Duration> for Stamp {
    type Output = Self;

    fn sub(self, rhs: Duration) -> Self {
        Self(
            self.0
                .saturating_sub(i64::try_from(rhs.as_nanos()).unwrap_or(i64::MAX)),
        )
    }
}

impl Sub for Stamp {
    /// Nanoseconds, signed.
    type Output = i64;

    fn sub(self, rhs: Self) -> i64 {
        self.0.saturating_sub(rhs.0)
    }
}
