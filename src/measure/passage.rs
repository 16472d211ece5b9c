//! What a link did to packets.

/// What became of the packets of one direction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Passing {
    /// Median one-way delay, s.
    pub delay_p50_s: f64,
    /// 99th percentile of the one-way delay, s.
    pub delay_p99_s: f64,
    /// Delay variation: the 99th percentile less the least (RFC 5481's PDV), s.
    pub variation_s: f64,
    /// Share of the packets that never arrived.
    pub loss: f64,
    /// Share of those that arrived after one that was sent later (RFC 4737).
    pub reordered: f64,
}

impl Passing {
    /// Of packets in the order they were sent: when (s), and when they arrived, if they did. `None` if none did.
    pub fn of(packets: impl IntoIterator<Item = (f64, Option<f64>)>) -> Option<Self> {
        let (mut sent, mut delays, mut arrivals) = (0_usize, Vec::new(), Vec::new());
        for (sent_s, arrived_s) in packets {
            sent += 1;
            if let Some(arrived_s) = arrived_s {
                delays.push(arrived_s - sent_s);
                arrivals.push(arrived_s);
            }
        }
        let arrived = delays.len() as f64;
        let loss = 1.0 - arrived / sent.max(1) as f64;
        // From the back: one that is sent later and has arrived before.
        let mut earliest = f64::INFINITY;
        let mut reordered = 0.0;
        for at_s in arrivals.iter().rev() {
            if earliest < *at_s {
                reordered += 1.0;
            }
            earliest = earliest.min(*at_s);
        }
        let delay_p50_s = super::quantile(&mut delays, 0.5)?;
        let delay_p99_s = super::quantile(&mut delays, 0.99)?;
        Some(Self {
            delay_p50_s,
            delay_p99_s,
            variation_s: delay_p99_s - delays[0],
            loss,
            reordered: reordered / arrived,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delay_variation_loss_and_reordering_are_counted() {
        // Every fourth is lost; every second 30 ms late instead of 10 ms, and sent 5 ms apart: overtaken.
        let packet = |i: i32| {
            let sent_s = f64::from(i) * 5e-3;
            let late_s = if i % 2 == 0 { 0.03 } else { 0.01 };
            (sent_s, (i % 4 != 3).then_some(sent_s + late_s))
        };
        let passing = Passing::of((0..400).map(packet)).unwrap();
        assert!((passing.loss - 0.25).abs() < 1e-12);
        assert!((passing.delay_p50_s - 0.03).abs() < 1e-9);
        assert!((passing.variation_s - 0.02).abs() < 1e-9);
        // Packet 4k is overtaken by 4k + 1; 4k + 2 by 4(k + 1) + 1, sent 15 ms later with 20 ms less; the last one by nobody.
        assert!(
            (passing.reordered - 199.0 / 300.0).abs() < 1e-12,
            "{}",
            passing.reordered
        );
        assert_eq!(Passing::of([(0.0, None)]), None);
    }
}
