//! What becomes of a numbered flow of datagrams on its way: loss, reordering, duplicates, delay and jitter.
//!
//! The transport's own count of lost packets is no measure of the link: it takes reordering for loss. Ours counts
//! sequence numbers, and both ends use it for what they receive.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Numbers whose arrival is still waited for, behind the newest.
const WINDOW: u32 = u128::BITS;

/// Part of a new difference that enters the jitter (RFC 3550 §6.4.1).
const JITTER_GAIN: f64 = 1.0 / 16.0;

/// A flow whose numbers count up from 1, as one end has received it.
#[derive(Debug, Clone, Default)]
pub struct Reception {
    newest: u32,
    /// Bit i: number `newest − i` has arrived.
    arrived: u128,
    received: u32,
    duplicates: u32,
    reordered: u32,
    settled: Runs,
    jitter_s: f64,
    transit_s: Option<f64>,
    delay: Spread,
}

/// Runs of numbers that did not arrive.
#[derive(Debug, Clone, Copy, Default)]
struct Runs {
    open: u32,
    count: u32,
    longest: u32,
}

impl Runs {
    fn lost(&mut self, numbers: u32) {
        self.count += u32::from(self.open == 0);
        self.open = self.open.saturating_add(numbers);
        self.longest = self.longest.max(self.open);
    }

    fn take(&mut self, arrived: bool) {
        if arrived {
            self.open = 0;
        } else {
            self.lost(1);
        }
    }
}

/// What a [`Reception`] has come to.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Received {
    /// Numbers that arrived, each counted once.
    pub received: u32,
    /// Numbers below the newest that did not arrive, or not yet.
    pub lost: u32,
    /// Arrivals of a number that had arrived before.
    pub duplicates: u32,
    /// Arrivals after a higher number.
    pub reordered: u32,
    /// Runs of consecutive numbers that were lost.
    pub loss_runs: u32,
    /// The longest of them.
    pub longest_loss_run: u32,
    /// Interarrival jitter (RFC 3550 §6.4.1), s: no clock offset enters it.
    pub jitter_s: f64,
    /// One-way delay by the session clock, as wrong as that is known; `None` if nothing could be timed.
    pub delay: Option<Quantiles>,
}

impl Received {
    /// Share of the numbers that was lost, in [0, 1].
    pub fn loss(&self) -> f64 {
        f64::from(self.lost) / f64::from(self.lost.saturating_add(self.received).max(1))
    }
}

impl fmt::Display for Received {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            received,
            duplicates,
            reordered,
            loss_runs,
            longest_loss_run,
            ..
        } = self;
        write!(f, "{received} received, {:.1} % lost", self.loss() * 1e2)?;
        if *loss_runs > 0 {
            write!(f, " in {loss_runs} runs of up to {longest_loss_run}")?;
        }
        if *reordered > 0 {
            write!(f, ", {reordered} out of order")?;
        }
        if *duplicates > 0 {
            write!(f, ", {duplicates} twice")?;
        }
        if let Some(delay) = &self.delay {
            write!(f, ", delay {delay}, jitter {:.1} ms", self.jitter_s * 1e3)?;
        }
        Ok(())
    }
}

impl Reception {
    /// Number `seq` has arrived, `transit_s` after it was said if that can be told.
    pub fn arrive(&mut self, seq: u32, transit_s: Option<f64>) {
        if seq == 0 {
            return;
        }
        let behind = self.newest.checked_sub(seq);
        match behind {
            None => self.advance(seq),
            Some(behind) if behind < WINDOW => {
                let bit = 1 << behind;
                if self.arrived & bit != 0 {
                    self.duplicates = self.duplicates.saturating_add(1);
                    return;
                }
                self.arrived |= bit;
                self.reordered = self.reordered.saturating_add(1);
            }
            // Too long ago to tell whether it is one of the lost or came twice.
            Some(_) => return,
        }
        self.received = self.received.saturating_add(1);
        if let Some(transit_s) = transit_s {
            self.delay.add(transit_s);
            if let Some(before) = self.transit_s.replace(transit_s) {
                self.jitter_s += JITTER_GAIN * ((transit_s - before).abs() - self.jitter_s);
            }
        }
    }

    fn advance(&mut self, seq: u32) {
        let steps = seq - self.newest;
        // What leaves the window is settled, the oldest first.
        for left in (WINDOW.saturating_sub(steps)..WINDOW).rev() {
            if left < self.newest {
                self.settled.take(self.arrived >> left & 1 == 1);
            }
        }
        let never_seen = steps.saturating_sub(WINDOW);
        if never_seen > 0 {
            self.settled.lost(never_seen);
        }
        self.arrived = self.arrived.checked_shl(steps).unwrap_or(0) | 1;
        self.newest = seq;
    }

    /// The highest number so far; 0 before the first.
    pub fn newest(&self) -> u32 {
        self.newest
    }

    /// Numbers that arrived, each counted once.
    pub fn received(&self) -> u32 {
        self.received
    }

    /// What it has come to so far.
    pub fn summary(&self) -> Received {
        let mut runs = self.settled;
        for left in (0..WINDOW.min(self.newest)).rev() {
            runs.take(self.arrived >> left & 1 == 1);
        }
        Received {
            received: self.received,
            lost: self.newest - self.received.min(self.newest),
            duplicates: self.duplicates,
            reordered: self.reordered,
            loss_runs: runs.count,
            longest_loss_run: runs.longest,
            jitter_s: self.jitter_s,
            delay: self.delay.quantiles(),
        }
    }
}

/// How times are spread.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Quantiles {
    /// Mean, s.
    pub mean_s: f64,
    /// Half of them are below, s.
    pub p50_s: f64,
    /// 95 % of them are below, s.
    pub p95_s: f64,
    /// The largest, s.
    pub max_s: f64,
}

impl fmt::Display for Quantiles {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [p50, p95, max] = [self.p50_s, self.p95_s, self.max_s].map(|s| s * 1e3);
        write!(f, "{p50:.1}/{p95:.1}/{max:.1} ms (p50/p95/max)")
    }
}

/// Sixteen steps an octave, so that a quantile is at most 6 % above the truth, from 0.12 ms to 32 s.
const STEPS: usize = 18 * 16;

/// Of an f64: its exponent, and the first four bits behind it.
const SHIFT: u32 = 48;

const LEAST_S: f64 = 1.0 / 8192.0;

/// Times, counted in a fixed amount of memory.
#[derive(Debug, Clone)]
pub struct Spread {
    counts: Box<[u32; STEPS]>,
    count: u64,
    sum_s: f64,
    max_s: f64,
}

impl Default for Spread {
    fn default() -> Self {
        Self {
            counts: Box::new([0; STEPS]),
            count: 0,
            sum_s: 0.0,
            max_s: 0.0,
        }
    }
}

impl Spread {
    /// Counts `time_s`. What lies before zero, by a clock that is not known exactly, counts as zero.
    pub fn add(&mut self, time_s: f64) {
        if !time_s.is_finite() {
            return;
        }
        let time_s = time_s.max(0.0);
        let step = (time_s.max(LEAST_S).to_bits() >> SHIFT) - (LEAST_S.to_bits() >> SHIFT);
        let step = (step as usize).min(STEPS - 1);
        self.counts[step] = self.counts[step].saturating_add(1);
        self.count += 1;
        self.sum_s += time_s;
        self.max_s = self.max_s.max(time_s);
    }

    /// How they are spread; `None` before the first.
    pub fn quantiles(&self) -> Option<Quantiles> {
        let below = |share: f64| {
            let wanted = (share * self.count as f64).ceil() as u64;
            let mut so_far = 0;
            let step = self.counts.iter().position(|&n| {
                so_far += u64::from(n);
                so_far >= wanted
            });
            let above = (LEAST_S.to_bits() >> SHIFT) + step.unwrap_or(STEPS) as u64 + 1;
            f64::from_bits(above << SHIFT).min(self.max_s)
        };
        (self.count > 0).then(|| Quantiles {
            mean_s: self.sum_s / self.count as f64,
            p50_s: below(0.5),
            p95_s: below(0.95),
            max_s: self.max_s,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(numbers: &[u32]) -> Received {
        let mut flow = Reception::default();
        for &seq in numbers {
            flow.arrive(seq, None);
        }
        flow.summary()
    }

    #[test]
    fn losses_runs_reordering_and_duplicates_are_told_apart() {
        let seen = of(&[1, 2, 5, 4, 4, 9, 10]);
        let expected = Received {
            received: 6,
            lost: 4,
            duplicates: 1,
            reordered: 1,
            // 3, and 6 to 8.
            loss_runs: 2,
            longest_loss_run: 3,
            ..Received::default()
        };
        assert_eq!(seen, expected);
        assert!((seen.loss() - 0.4).abs() < 1e-12);
        // What was lost before the first counts.
        assert_eq!((of(&[3]).lost, of(&[3]).longest_loss_run), (2, 2));
        assert_eq!(of(&[]), Received::default());
    }

    #[test]
    fn what_left_the_window_counts_as_before() {
        // Every third is lost, and twice a hole far longer than the window.
        let mut numbers: Vec<u32> = (1..=600).filter(|n| n % 3 != 0).collect();
        numbers.extend((1_000..1_300).chain(5_000_000..5_000_010));
        let seen = of(&numbers);
        assert_eq!(seen.received, 400 + 300 + 10);
        assert_eq!(seen.lost, 5_000_009 - 710);
        // 600 and what follows it are one run.
        assert_eq!(seen.loss_runs, 199 + 1 + 1);
        assert_eq!(seen.longest_loss_run, 5_000_000 - 1_300);
        assert_eq!(of(&[u32::MAX, 1, 0]).received, 1, "long gone");
    }

    #[test]
    fn quantiles_are_within_a_step_and_never_beyond_the_largest() {
        let mut spread = Spread::default();
        assert_eq!(spread.quantiles(), None);
        for i in 0..1000 {
            spread.add(0.1 + 1e-4 * f64::from(i));
        }
        let seen = spread.quantiles().unwrap();
        assert!((seen.mean_s - 0.149_95).abs() < 1e-9);
        for (got, truth) in [(seen.p50_s, 0.15), (seen.p95_s, 0.195)] {
            assert!(got >= truth && got < 1.065 * truth, "{got} of {truth}");
        }
        assert!((seen.max_s - 0.1999).abs() < 1e-9);
        // A clock that is a little off may say that something came before it was sent.
        spread.add(-0.5);
        spread.add(f64::NAN);
        spread.add(1e9);
        assert_eq!(spread.quantiles().unwrap().max_s, 1e9);
    }

    #[test]
    fn jitter_is_blind_to_the_clocks_offset() {
        let jitter = |offset_s: f64| {
            let mut flow = Reception::default();
            for seq in 1..500 {
                let wave_s = if seq % 2 == 0 { 0.004 } else { -0.004 };
                flow.arrive(seq, Some(offset_s + wave_s));
            }
            flow.summary().jitter_s
        };
        assert!((jitter(0.1) - 0.008).abs() < 1e-6);
        assert!((jitter(-70.0) - jitter(0.1)).abs() < 1e-9);
    }
}
