//! How long ticks take, in a fixed histogram.

const BUCKETS: usize = 512;
const BUCKET_NS: u32 = 500;

/// Tick times in half-microsecond buckets; the last one also holds everything longer.
#[derive(Debug, Clone)]
pub struct TickStats {
    buckets: [u32; BUCKETS],
    count: u64,
    sum_ns: u64,
}

impl Default for TickStats {
    fn default() -> Self {
        Self {
            buckets: [0; BUCKETS],
            count: 0,
            sum_ns: 0,
        }
    }
}

impl TickStats {
    /// Takes one tick's work.
    pub fn add(&mut self, work_ns: u32) {
        self.buckets[((work_ns / BUCKET_NS) as usize).min(BUCKETS - 1)] += 1;
        self.count += 1;
        self.sum_ns += u64::from(work_ns);
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
            seen += u64::from(n);
            if seen >= rank && seen > 0 {
                return (i as u32 + 1) * BUCKET_NS;
            }
        }
        0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_upper_edges() {
        let mut stats = TickStats::default();
        assert_eq!((stats.mean_ns(), stats.quantile_ns(0.99)), (0, 0));
        (0..98).for_each(|_| stats.add(5_100));
        stats.add(40_000);
        stats.add(9_000_000);
        assert_eq!(stats.quantile_ns(0.5), 5_500);
        assert_eq!(stats.quantile_ns(0.99), 40_500);
        assert_eq!(stats.quantile_ns(1.0), 256_000);
        assert_eq!(stats.mean_ns(), (98 * 5_100 + 40_000 + 9_000_000) / 100);
    }
}
