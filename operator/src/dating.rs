//! When a sample was valid, by the clock of whoever took it.

use telemime_protocol::time::Stamp;

/// A sender's clock may run away from ours by this, s a sample: what was fastest once is not for ever.
const DRIFT_S: f64 = 1e-4;

/// Maps a sender's times to ours by the fastest sample so far (a minimum-delay filter): what each later one took longer is
/// jitter of the way, and is taken out. What the fastest itself took cannot be seen from here.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Dating {
    /// Our clock less the sender's at the fastest sample, s.
    ahead_s: f64,
    /// No sample is dated back by more, s.
    oldest_s: f64,
}

impl Dating {
    /// Dates nothing back by more than `oldest_s`.
    pub(crate) fn new(oldest_s: f64) -> Self {
        Self {
            ahead_s: f64::INFINITY,
            oldest_s,
        }
    }

    /// When a sample was valid that the sender took at `sender_s` of its clock and that arrived at `now`.
    pub(crate) fn dated(&mut self, now: Stamp, sender_s: f64) -> Stamp {
        let ahead_s = now.0 as f64 * 1e-9 - sender_s;
        self.ahead_s = ahead_s.min(self.ahead_s + DRIFT_S);
        let late_s = (ahead_s - self.ahead_s).clamp(0.0, self.oldest_s);
        now.offset_by_secs(-late_s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn jitter_is_taken_out_and_a_clock_that_drifts_is_followed() {
        let mut dating = Dating::new(0.25);
        // 50 Hz, a way of 5 ms and up to 20 ms more, a clock 300 ppm fast.
        for i in 0..3000_i64 {
            let taken_ns = i * 20_000_000;
            let jitter_ns = (i * 7 % 5) * 5_000_000;
            let now = Stamp(taken_ns + 5_000_000 + jitter_ns);
            let sender_s = 1000.0 + taken_ns as f64 * 1e-9 * 1.0003;
            let dated = dating.dated(now, sender_s);
            let late_s = dated.secs_since(Stamp(taken_ns)) - 5e-3;
            assert!(i < 5 || late_s.abs() < 1e-3, "{i}: {late_s}");
        }
        // A second late: as old as it may be.
        let now = Stamp(3000 * 20_000_000 + 1_000_000_000);
        let late = dating.dated(now, 1000.0 + 60.0 * 1.0003);
        assert!((now.secs_since(late) - 0.25).abs() < 1e-9);
    }
}
