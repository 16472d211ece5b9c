//! How long ticks take, in a fixed histogram.

/// Sixteen buckets an octave: a quantile is right to 6 %.
const PER_OCTAVE: usize = 16;
const BUCKETS: usize = 29 * PER_OCTAVE;

/// Tick times in logarithmic buckets from a nanosecond to four seconds.
#[derive(Debug, Clone)]
pub struct TickStats {
    buckets: [u64; BUCKETS],
    count: u64,
    sum_ns: u64,
    max_ns: u32,
}

/// What a [`TickStats`] comes to, ns.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Quantiles {
    /// Half are below this.
    pub p50_ns: u32,
    /// All but 1 % are.
    pub p99_ns: u32,
    /// All but 0.1 % are.
    pub p999_ns: u32,
    /// The largest, exactly.
    pub max_ns: u32,
}

impl Default for TickStats {
    fn default() -> Self {
        Self {
            buckets: [0; BUCKETS],
            count: 0,
            sum_ns: 0,
            max_ns: 0,
        }
    }
}

/// The bucket of a time: below 16 ns its own, above by octave and the next four bits.
fn bucket(ns: u32) -> usize {
    let octave = (31 - (ns | 1).leading_zeros()) as usize;
    if octave < 4 {
        return ns as usize;
    }
    (octave - 3) * PER_OCTAVE + (ns >> (octave - 4)) as usize - PER_OCTAVE
}

/// The first time beyond a bucket.
fn upper_edge_ns(bucket: usize) -> u32 {
    if bucket < PER_OCTAVE {
        return bucket as u32 + 1;
    }
    let (octave, sub) = (bucket / PER_OCTAVE + 3, bucket % PER_OCTAVE);
    let edge = ((PER_OCTAVE + sub + 1) as u64) << (octave - 4);
    u32::try_from(edge).unwrap_or(u32::MAX)
}

impl TickStats {
    /// Takes one tick's work.
    pub fn add(&mut self, work_ns: u32) {
        self.buckets[bucket(work_ns)] += 1;
        self.count += 1;
        self.sum_ns += u64::from(work_ns);
        self.max_ns = self.max_ns.max(work_ns);
    }

    /// Median, tails and maximum: quantiles are upper edges of their buckets, but never above the maximum.
    pub fn quantiles(&self) -> Quantiles {
        let at = |p| self.quantile_ns(p).min(self.max_ns);
        Quantiles {
            p50_ns: at(0.5),
            p99_ns: at(0.99),
            p999_ns: at(0.999),
            max_ns: self.max_ns,
        }
    }

    /// Ticks counted.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Mean, ns; 0 before the first tick.
    pub fn mean_ns(&self) -> u32 {
        self.sum_ns.checked_div(self.count).unwrap_or(0) as u32
    }

    /// The upper edge of the bucket that holds quantile `p`, ns.
    pub fn quantile_ns(&self, p: f64) -> u32 {
        let rank = (p * self.count as f64).ceil() as u64;
        let mut seen = 0;
        for (i, &n) in self.buckets.iter().enumerate() {
            seen += n;
            if seen >= rank && seen > 0 {
                return upper_edge_ns(i);
            }
        }
        0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buckets_cover_every_time_without_a_gap() {
        assert_eq!(bucket(u32::MAX), BUCKETS - 1);
        for i in 0..BUCKETS - 1 {
            let edge = upper_edge_ns(i);
            assert_eq!((bucket(edge - 1), bucket(edge)), (i, i + 1), "{i}");
        }
    }

    #[test]
    fn quantiles_are_upper_edges_however_long_a_tick_takes() {
        let mut stats = TickStats::default();
        assert_eq!((stats.mean_ns(), stats.quantile_ns(0.99)), (0, 0));
        (0..98).for_each(|_| stats.add(5_100));
        stats.add(40_000);
        stats.add(9_000_000);
        let near = |p: f64, ns: f64| {
            let ratio = f64::from(stats.quantile_ns(p)) / ns;
            assert!((1.0..=1.07).contains(&ratio), "{p}: {ratio}");
        };
        near(0.5, 5_100.0);
        near(0.99, 40_000.0);
        near(1.0, 9_000_000.0);
        let told = stats.quantiles();
        assert_eq!(
            (told.max_ns, told.p999_ns, told.p99_ns),
            (9_000_000, 9_000_000, stats.quantile_ns(0.99))
        );
        assert_eq!(stats.mean_ns(), (98 * 5_100 + 40_000 + 9_000_000) / 100);
    }

    #[test]
    fn months_of_ticks_are_counted() {
        let mut stats = TickStats::default();
        // 50 days of ticks of the same length.
        stats.buckets[bucket(5_100)] = u64::from(u32::MAX);
        stats.count = u64::from(u32::MAX);
        (0..10).for_each(|_| stats.add(5_100));
        assert_eq!(stats.quantile_ns(0.5), upper_edge_ns(bucket(5_100)));
        assert_eq!(stats.count(), u64::from(u32::MAX) + 10);
    }
}
