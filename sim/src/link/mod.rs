//! A network path as Linux netem shapes it, as a pure function of time: a packet in, its delivery times out.
//!
//! The order of decisions per packet follows `net/sched/sch_netem.c` (Linux 6.18): loss, then the queue's
//! tail drop, then delay with jitter (which reorders), then the rate, whose transmission starts when the
//! packet before it has left. Lengths include all headers, as netem's do.

mod config;

pub use config::{
    LinkConfig, ParseLinkError, parse_duration_s, parse_probability, parse_rate_bit_s,
};

use std::collections::VecDeque;

use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;

/// What becomes of one packet. Times are nanoseconds on whatever clock `Link::send` was given.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fate {
    /// Arrives at this time; not necessarily after its predecessors.
    Deliver {
        /// Time of arrival, ns.
        at_ns: i64,
    },
    /// Lost on the way.
    Lost,
    /// Refused because `limit` packets were queued.
    Overflow,
}

/// One direction of a path.
#[derive(Debug, Clone)]
pub struct Link {
    config: LinkConfig,
    rng: Xoshiro256PlusPlus,
    /// Departure times of the packets still queued, in order of departure.
    queue: VecDeque<i64>,
    last_departure_ns: i64,
}

impl Link {
    /// A link in its initial state. The same seed and the same packets give the same fates.
    pub fn new(config: LinkConfig, seed: u64) -> Self {
        Self {
            config,
            rng: Xoshiro256PlusPlus::seed_from_u64(seed),
            queue: VecDeque::new(),
            last_departure_ns: i64::MIN,
        }
    }

    /// What the link is set to.
    pub fn config(&self) -> &LinkConfig {
        &self.config
    }

    /// Is set to `config` from now on: its chances go on where they were, and what is queued leaves as it would have.
    pub fn reshape(&mut self, config: LinkConfig) {
        self.config = config;
    }

    /// Sends a packet of `len_bytes` (headers included) at `now_ns`, which must not decrease between calls.
    pub fn send(&mut self, now_ns: i64, len_bytes: usize) -> Fate {
        // Both variates are always drawn, so that one packet's fate does not shift the next one's.
        let loss: f64 = self.rng.random();
        let spread: f64 = self.rng.random();
        while self
            .queue
            .front()
            .is_some_and(|&departed| departed <= now_ns)
        {
            self.queue.pop_front();
        }
        if loss < self.config.loss {
            return Fate::Lost;
        }
        if self.queue.len() >= self.config.limit {
            return Fate::Overflow;
        }
        let delay_s = self.config.delay_s + self.config.jitter_s * (2.0 * spread - 1.0);
        let mut at_ns = now_ns.saturating_add((delay_s.max(0.0) * 1e9).round() as i64);
        if let Some(rate_bit_s) = self.config.rate_bit_s {
            // sch_netem.c, netem_enqueue: delay -= last.time_to_send − now; then + packet_time(len).
            at_ns = at_ns.max(self.last_departure_ns);
            at_ns = at_ns.saturating_add((len_bytes as f64 * 8e9 / rate_bit_s).round() as i64);
            self.last_departure_ns = at_ns;
        }
        let place = self.queue.partition_point(|&other| other <= at_ns);
        self.queue.insert(place, at_ns);
        Fate::Deliver { at_ns }
    }
}

#[cfg(test)]
mod tests;
