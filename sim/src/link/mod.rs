//! A network path as Linux netem shapes it, as a pure function of time: a packet in, its delivery times out.
//!
//! Decisions and arithmetic per packet are those of `net/sched/sch_netem.c` (Linux 6.18), in its order: duplicate, loss,
//! corruption, the queue's tail drop, reordering or delay with jitter, the bottleneck, slots. docs/experiments.md
//! ("Links") states them, and what is ours: scheduled outages and traces. Lengths are what [`Link::send`] is given, IP
//! and UDP headers included; netem on an Ethernet device counts 14 bytes more.

mod config;
mod draw;
mod loss;
mod parse;
mod show;
mod table;
mod trace;

pub use config::{
    Chance, Distribution, LinkConfig, Loss, Outage, Probability, Rate, Slot, SlotWait,
};
pub use parse::{ParseLinkError, parse_duration_s, parse_probability, parse_rate_bit_s};
pub use trace::{Trace, TraceError, TraceFormat};

use std::collections::VecDeque;

use draw::{Correlated, Draws, What};
use loss::Losses;
use table::{SCALE, SIZE, Table};
use trace::{Cursor, Recording, Step};

/// A bit that is flipped on the way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Damage {
    /// Which byte, from the first of the IP header.
    pub byte: usize,
    /// The bit, alone in its byte.
    pub mask: u8,
}

impl Damage {
    /// Flips the bit in the payload behind headers of `headers` bytes. `false` if it lies in the headers: their
    /// checksums tell, and the receiver's system drops the packet.
    #[must_use]
    pub fn strike(self, payload: &mut [u8], headers: usize) -> bool {
        let hit = self.byte.checked_sub(headers);
        let Some(byte) = hit.and_then(|i| payload.get_mut(i)) else {
            return false;
        };
        *byte ^= self.mask;
        true
    }
}

/// A copy that arrives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Delivery {
    /// Time of arrival, ns on the clock `Link::send` was given; not necessarily after its predecessors.
    pub at_ns: i64,
    /// What has happened to it.
    pub damage: Option<Damage>,
    /// It was sent at once, before those that wait.
    pub at_once: bool,
}

/// What becomes of one copy of a packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// It arrives.
    Deliver(Delivery),
    /// Lost on the way.
    Lost,
    /// Refused because `limit` packets were queued.
    Overflow,
    /// Sent during a scheduled outage.
    Outage,
}

/// What becomes of one packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fate {
    /// Of the packet itself.
    pub packet: Outcome,
    /// Of its duplicate, if it has one; it was queued first.
    pub duplicate: Option<Outcome>,
}

impl Fate {
    /// A packet that arrives once and whole.
    pub fn whole(at_ns: i64) -> Self {
        Self {
            packet: Outcome::Deliver(Delivery {
                at_ns,
                damage: None,
                at_once: false,
            }),
            duplicate: None,
        }
    }

    /// The copies that arrive, in the order in which they were queued.
    pub fn deliveries(&self) -> impl Iterator<Item = Delivery> {
        let delivered = |outcome| match outcome {
            Outcome::Deliver(delivery) => Some(delivery),
            Outcome::Lost | Outcome::Overflow | Outcome::Outage => None,
        };
        [self.duplicate.and_then(delivered), delivered(self.packet)]
            .into_iter()
            .flatten()
    }

    /// When the first whole copy arrives, ns, if any does.
    pub fn arrival_ns(&self) -> Option<i64> {
        let whole = self.deliveries().filter(|d| d.damage.is_none());
        whole.map(|d| d.at_ns).min()
    }
}

/// One direction of a path.
#[derive(Debug, Clone)]
pub struct Link {
    config: LinkConfig,
    seed: u64,
    /// The kernel's integers: ns, and bytes a second.
    delay_ns: i64,
    jitter_ns: i64,
    rate: u64,
    table: Option<&'static Table>,
    packets: u64,
    /// When it began; the first packet says, if nobody did.
    origin_ns: Option<i64>,
    delay_draws: Correlated,
    duplicate_draws: Correlated,
    corrupt_draws: Correlated,
    reorder_draws: Correlated,
    losses: Losses,
    /// Departure times of the packets still queued, in order of departure.
    queue: VecDeque<i64>,
    /// The latest `time_to_send`: what a bottleneck goes on from.
    last_ns: i64,
    /// Packets delayed since one was sent at once.
    counter: u32,
    slot: SlotState,
    cursor: Cursor,
    /// Whole rounds of a schedule before the beginning, so that it is under way then.
    lead_ns: i64,
}

#[derive(Debug, Clone, Copy)]
struct SlotState {
    /// Of a slot's times; `None` while there are no slots, or before the first packet.
    next_ns: Option<i64>,
    last_ns: i64,
    packets: i64,
    bytes: i64,
}

/// A schedule is under way for at least this long before a beginning that is set anew.
const LEAD_NS: i64 = 60_000_000_000;

fn ns(seconds: f64) -> i64 {
    (seconds * 1e9).round() as i64
}

impl Link {
    /// A link in its initial state. The same seed and the same packets give the same fates.
    pub fn new(config: LinkConfig, seed: u64) -> Self {
        let first = Draws::of(seed, u64::MAX, false);
        let correlated = |what, rho| Correlated::new(first.u32(what), rho);
        Self {
            seed,
            delay_ns: ns(config.delay_s),
            // The kernel's own bound: tabledist() takes σ in 31 bits.
            jitter_ns: ns(config.jitter_s).min(i32::MAX.into()),
            rate: config.rate.map_or(0, |rate| rate.bit_s / 8),
            table: table::table(config.distribution),
            packets: 0,
            origin_ns: None,
            delay_draws: correlated(What::Delay, config.delay_correlation),
            duplicate_draws: correlated(What::Duplicate, config.duplicate.correlation),
            corrupt_draws: correlated(What::Corrupt, config.corrupt.correlation),
            reorder_draws: correlated(What::Reorder, config.reorder.correlation),
            losses: Losses::new(config.loss, first),
            queue: VecDeque::new(),
            last_ns: i64::MIN,
            counter: 0,
            slot: SlotState {
                next_ns: None,
                last_ns: i64::MIN,
                packets: 0,
                bytes: 0,
            },
            cursor: Cursor::default(),
            lead_ns: 0,
            config,
        }
    }

    /// Sets when it began, ns: outages and traces count from then. Without it they count from the first packet.
    #[must_use]
    pub fn beginning_at(mut self, origin_ns: i64) -> Self {
        self.origin_ns = Some(origin_ns);
        self
    }

    /// Sets anew when it began, ns, or is to begin: outages and traces count from then, and a trace begins anew. What is
    /// sent before meets the end of the trace, which loops, and none of the outages. Chances, queue and bottleneck go on.
    pub fn begin_at(&mut self, origin_ns: i64) {
        self.origin_ns = Some(origin_ns);
        self.cursor = Cursor::default();
        let recording = self.config.trace.as_ref().map(Trace::recording);
        if let Some(Recording::Opportunities { period_ns, .. }) = recording {
            let period_ns = *period_ns;
            self.lead_ns = period_ns * (LEAD_NS / period_ns + 1);
        }
    }

    /// What the link is set to.
    pub fn config(&self) -> &LinkConfig {
        &self.config
    }

    /// Sends a packet of `len_bytes` (headers included) at `now_ns`, which must not decrease between calls.
    pub fn send(&mut self, now_ns: i64, len_bytes: usize) -> Fate {
        let packet = self.packets;
        self.packets += 1;
        let since_ns = now_ns - *self.origin_ns.get_or_insert(now_ns);
        let alone = |packet| Fate {
            packet,
            duplicate: None,
        };
        while self
            .queue
            .front()
            .is_some_and(|&departed| departed <= now_ns)
        {
            self.queue.pop_front();
        }
        if self.is_out(since_ns) {
            return alone(Outcome::Outage);
        }
        let step = self.step(since_ns);
        let draws = Draws::of(self.seed, packet, false);
        let twice = {
            let rolled = self.duplicate_draws.next(draws.u32(What::Duplicate));
            self.config.duplicate.p.0 > 0 && self.config.duplicate.p.0 >= rolled
        };
        // A packet that is both doubled and lost is sent once.
        if self.is_lost(step, draws) {
            return alone(if twice {
                self.pass(now_ns, since_ns, len_bytes, step, draws, false).0
            } else {
                Outcome::Lost
            });
        }
        let (packet, duplicate) = self.pass(now_ns, since_ns, len_bytes, step, draws, twice);
        Fate { packet, duplicate }
    }

    fn is_out(&self, since_ns: i64) -> bool {
        let since_s = since_ns as f64 * 1e-9;
        self.config.outages.iter().any(|o| o.covers(since_s))
    }

    fn step(&self, since_ns: i64) -> Option<Step> {
        match self.config.trace.as_ref()?.recording() {
            Recording::Steps { steps, period_ns } => {
                Some(trace::step_at(steps, *period_ns, since_ns))
            }
            Recording::Delays(_) | Recording::Opportunities { .. } => None,
        }
    }

    fn is_lost(&mut self, step: Option<Step>, draws: Draws) -> bool {
        let traced = step.is_some_and(|s| s.loss.0 > 0 && s.loss.0 >= draws.u32(What::TraceLoss));
        // The chain moves on whatever the trace says.
        self.losses.next(draws) || traced
    }

    /// `netem_enqueue` after its loss: the packet, and its duplicate if it has one.
    fn pass(
        &mut self,
        now_ns: i64,
        since_ns: i64,
        len: usize,
        step: Option<Step>,
        draws: Draws,
        twice: bool,
    ) -> (Outcome, Option<Outcome>) {
        let rolled = self.corrupt_draws.next(draws.u32(What::Corrupt));
        let corrupt = self.config.corrupt.p.0;
        let damage = (corrupt > 0 && corrupt >= rolled && len > 0).then(|| Damage {
            byte: draws.below(What::Byte, u32::try_from(len).unwrap_or(u32::MAX)) as usize,
            mask: 1 << draws.below(What::Bit, 8),
        });
        if self.queue.len() >= self.config.limit {
            return (Outcome::Overflow, None);
        }
        // The duplicate enters from the start, before its original is queued, and is not doubled again.
        let duplicate = twice.then(|| {
            let draws = Draws::of(self.seed, self.packets - 1, true);
            if self.is_lost(step, draws) {
                return Outcome::Lost;
            }
            self.pass(now_ns, since_ns, len, step, draws, false).0
        });
        let at_once = {
            let gap = self.config.gap;
            gap > 0
                && self.counter >= gap - 1
                && self.config.reorder.p.0 >= self.reorder_draws.next(draws.u32(What::Reorder))
        };
        let at_ns = if at_once {
            self.counter = 0;
            now_ns
        } else {
            self.counter = self.counter.saturating_add(1);
            let due_ns = self.due(now_ns, since_ns, len, step, draws);
            let at_ns = self.slotted(now_ns, due_ns, len, draws);
            let place = self.queue.partition_point(|&other| other <= at_ns);
            self.queue.insert(place, at_ns);
            at_ns
        };
        let delivery = Delivery {
            at_ns,
            damage,
            at_once,
        };
        (Outcome::Deliver(delivery), duplicate)
    }

    /// `time_to_send`: delay, then bottleneck.
    fn due(
        &mut self,
        now_ns: i64,
        since_ns: i64,
        len: usize,
        step: Option<Step>,
        draws: Draws,
    ) -> i64 {
        let mut mean_ns = self.delay_ns + step.map_or(0, |s| s.delay_ns);
        let recording = self.config.trace.as_ref().map(Trace::recording);
        if let Some(Recording::Delays(delays)) = recording {
            mean_ns += self.cursor.delay(delays);
        }
        let fresh = draws.u32(What::Delay);
        let delay_ns = if self.jitter_ns == 0 {
            mean_ns
        } else {
            spread(
                mean_ns,
                self.jitter_ns,
                self.delay_draws.next(fresh),
                self.table,
            )
        };
        let mut due_ns = now_ns + delay_ns;
        if let Some(Recording::Opportunities { at_ns, period_ns }) = recording {
            let origin_ns = now_ns - since_ns - self.lead_ns;
            let from_ns = (due_ns.max(self.last_ns).max(now_ns) - origin_ns).max(0);
            due_ns = origin_ns + self.cursor.leave(at_ns, *period_ns, from_ns, len);
        }
        let rate = match step {
            Some(step) if step.rate > 0 => step.rate,
            _ => self.rate,
        };
        if rate > 0 {
            // From the last in the queue, if one still waits: delay = max(0, delay − (last − now)).
            if self.last_ns > now_ns {
                due_ns = due_ns.max(self.last_ns);
            }
            due_ns = due_ns.saturating_add(self.packet_time_ns(len, rate));
        }
        self.last_ns = self.last_ns.max(due_ns);
        due_ns
    }

    /// `packet_time_ns`.
    fn packet_time_ns(&self, len: usize, rate: u64) -> i64 {
        let mut len = len as i64;
        if let Some(set) = self.config.rate {
            len = (len + i64::from(set.overhead)).max(0);
            if set.cell > 0 {
                let cells = (len + i64::from(set.cell) - 1) / i64::from(set.cell);
                len = (cells * (i64::from(set.cell) + i64::from(set.cell_overhead))).max(0);
            }
        }
        // The kernel's product wraps; a packet that would take centuries waits for them.
        let ns = u128::from(len as u64) * 1_000_000_000 / u128::from(rate);
        i64::try_from(ns).unwrap_or(i64::MAX)
    }

    /// When what is due at `due_ns` leaves (`netem_dequeue`).
    fn slotted(&mut self, now_ns: i64, due_ns: i64, len: usize, draws: Draws) -> i64 {
        let due_ns = due_ns.max(now_ns);
        let Some(slot) = self.config.slot else {
            return due_ns;
        };
        let full = |state: &mut SlotState| {
            state.packets = slot.packets.map_or(i64::MAX, i64::from);
            state.bytes = slot.bytes.map_or(i64::MAX, i64::from);
        };
        let mut state = self.slot;
        let mut next_ns = state.next_ns.unwrap_or_else(|| {
            full(&mut state);
            self.origin_ns.unwrap_or(now_ns)
        });
        // The queue is looked at when the packet comes to its head, and again when it is due: a slot that has begun
        // by then is over.
        for (look_ns, what) in [
            (now_ns.max(state.last_ns), What::Slot),
            (due_ns, What::SlotToo),
        ] {
            if next_ns < due_ns {
                next_ns = look_ns + slot_wait(&slot, draws.u32(what));
                full(&mut state);
            }
        }
        let at_ns = due_ns.max(next_ns);
        state.packets -= 1;
        state.bytes = state.bytes.saturating_sub(len as i64);
        if state.packets <= 0 || state.bytes <= 0 {
            next_ns = at_ns + slot_wait(&slot, draws.u32(What::SlotThen));
            full(&mut state);
        }
        self.slot = SlotState {
            next_ns: Some(next_ns),
            last_ns: at_ns,
            ..state
        };
        at_ns
    }
}

/// `tabledist`: a value about `mean` that spreads by `sigma`, 0 < `sigma` < 2³¹.
fn spread(mean: i64, sigma: i64, drawn: u32, table: Option<&Table>) -> i64 {
    let Some(table) = table else {
        return i64::from(drawn) % (2 * sigma) + mean - sigma;
    };
    let t = i64::from(table[drawn as usize % SIZE]);
    let x = (sigma % SCALE) * t;
    let half = if x >= 0 { SCALE / 2 } else { -SCALE / 2 };
    (x + half) / SCALE + (sigma / SCALE) * t + mean
}

/// `get_slot_next`, from the moment it is asked.
fn slot_wait(slot: &Slot, drawn: u32) -> i64 {
    match slot.wait {
        SlotWait::Between { min_s, max_s } => {
            let (min, max) = (ns(min_s), ns(max_s));
            min + ((i128::from(max - min) * i128::from(drawn)) >> 32) as i64
        }
        SlotWait::Around {
            distribution,
            delay_s,
            jitter_s,
        } => {
            let sigma = ns(jitter_s).clamp(1, i32::MAX.into());
            spread(ns(delay_s), sigma, drawn, table::table(distribution)).max(0)
        }
    }
}

#[cfg(test)]
mod tests;
