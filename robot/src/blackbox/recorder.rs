//! The record off the control thread: a bounded number of chunks, and when they are to be kept.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};
use telemime_protocol::wire::codec;
use telemime_protocol::wire::v1::{Cause, RobotState};

use super::file::{Draft, Header};
use super::tap::{CHUNK_TICKS, Taps, Ticked};
use super::ticks::{pack, row, width};
use crate::servo::{ArmFault, CoreState, Order};

/// After a stop this much more is recorded if the arm does not come to rest before, ticks.
const AFTERMATH_TICKS: u64 = 2000;

/// No more than this is kept, bytes: two minutes of motion take about a quarter of it.
const MAX_BYTES: usize = 128 << 20;

/// What a [`Recorder`] is fed through.
#[derive(Debug)]
pub struct Feed(pub(super) Taps);

/// Up to a second of ticks, after the state they begin in.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Chunk {
    /// Ticks between the chunk before and this one are missing.
    pub(super) gap: bool,
    pub(super) state: CoreState,
    /// With the tick, counted from the chunk's beginning, that took them.
    pub(super) orders: Vec<(u32, Order)>,
    /// What the arm had, from that tick on.
    pub(super) faults: Vec<(u32, ArmFault)>,
    /// Rows of [`width`] words each.
    pub(super) words: Vec<u64>,
}

impl Chunk {
    /// Whether a core can be run on it, whatever is written there.
    pub(super) fn is_sound(&self) -> bool {
        self.state.is_sound() && self.orders.iter().all(|(_, order)| order.is_sound())
    }
}

/// A chunk that is complete, encoded.
#[derive(Debug, Clone)]
pub(super) struct Kept {
    pub(super) ticks: u64,
    pub(super) bytes: Vec<u8>,
}

/// That the record is to be written: it shows something.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Due {
    /// The arm was stopped.
    Stop(Cause),
    /// It was asked for.
    Request,
}

/// Keeps the last minutes; sans-IO, to be [drained](Recorder::drain) several times a second.
pub struct Recorder {
    header: Header,
    dof: usize,
    feed: Taps,
    span_ticks: u64,
    kept: VecDeque<Kept>,
    open: Option<(Chunk, Vec<u64>)>,
    next_tick: u64,
    gap: bool,
    /// Ticks that are not in the record, since somebody asked last.
    missing: u64,
    /// State changes seen.
    transitions: Option<u32>,
    stop: Option<(Cause, u64)>,
}

impl Recorder {
    /// A recorder that keeps `span_s` seconds of what `header` tells the circumstances of.
    pub fn new(header: Header, feed: Feed, span_s: f64) -> Self {
        let span_ticks = (span_s / header.control.dt_s).round() as u64;
        Self {
            dof: header.home.len(),
            header,
            feed: feed.0,
            span_ticks,
            kept: VecDeque::new(),
            open: None,
            next_tick: 0,
            gap: false,
            missing: 0,
            transitions: None,
            stop: None,
        }
    }

    /// Takes what the tick has left. Returns what the record shows, if it is to be written: a stop at rest, or a while after.
    pub fn drain(&mut self) -> Option<Due> {
        let mut due = None;
        while let Ok(ticked) = self.feed.ticks.pop() {
            due = self.take(&ticked).or(due);
        }
        due
    }

    /// The stop that has been seen and has not been told yet: for the last words of a record.
    pub fn pending(&mut self) -> Option<Due> {
        self.stop.take().map(|(cause, _)| Due::Stop(cause))
    }

    /// Ticks that the record lacks since this was asked for last: it was not drained in time, or more orders came than there is room for.
    pub fn missing(&mut self) -> u64 {
        std::mem::take(&mut self.missing)
    }

    /// What is to be written, and for what: `None` while nothing is held.
    pub fn draft(&self, due: Due) -> Option<Draft> {
        let open = self
            .open
            .as_ref()
            .filter(|(chunk, _)| !chunk.words.is_empty());
        let open = open.map(|(chunk, _)| self.keep(chunk));
        let chunks: Vec<_> = self.kept.iter().chain(&open).collect();
        (!chunks.is_empty()).then(|| self.header.draft(due, &chunks))
    }

    fn keep(&self, chunk: &Chunk) -> Kept {
        Kept {
            ticks: (chunk.words.len() / width(self.dof)) as u64,
            bytes: codec::encode(chunk),
        }
    }

    fn take(&mut self, ticked: &Ticked) -> Option<Due> {
        let tick = ticked.report.tick - 1;
        if tick != self.next_tick {
            // Nothing can be replayed across it: the chunk ends, and the next begins with a state.
            self.close();
            self.gap = !self.kept.is_empty();
            self.missing += tick.saturating_sub(self.next_tick);
        }
        self.next_tick = tick + 1;
        self.begin_chunk(tick);
        let mut orders = Vec::new();
        while self.feed.orders.peek().is_ok_and(|(at, _)| *at <= tick) {
            if let Ok((at, order)) = self.feed.orders.pop()
                && at == tick
            {
                orders.push(order);
            }
        }
        if orders.len() as u32 != ticked.orders {
            self.close();
            self.gap = true;
        }
        if let Some((chunk, last)) = &mut self.open {
            let at = (chunk.words.len() / width(self.dof)) as u32;
            chunk
                .orders
                .extend(orders.into_iter().map(|order| (at, order)));
            if let Some(fault) = ticked.fault
                && chunk.faults.is_empty()
            {
                chunk.faults.push((at, fault));
            }
            let words = row(ticked, self.dof);
            let mut packed = words.clone();
            pack(&mut packed, last, self.dof);
            chunk.words.extend(packed);
            *last = words;
        } else {
            self.missing += 1;
        }
        self.watch(ticked)
    }

    /// Ends the chunk and begins another where a state was recorded.
    fn begin_chunk(&mut self, tick: u64) {
        while let Ok(state) = self.feed.states.peek() {
            if state.tick() > tick {
                return;
            }
            let Ok(mut state) = self.feed.states.pop() else {
                return;
            };
            if state.tick() == tick {
                self.close();
                let chunk = Chunk {
                    gap: std::mem::take(&mut self.gap),
                    state: (*state).clone(),
                    orders: Vec::new(),
                    faults: Vec::new(),
                    words: Vec::with_capacity(width(self.dof) * CHUNK_TICKS as usize),
                };
                self.open = Some((chunk, vec![0; width(self.dof)]));
            }
            // The tick must not be the one to free what it held.
            state.let_go();
            // There are no more states than places.
            let _ = self.feed.spare.push(state);
        }
    }

    fn close(&mut self) {
        let Some((chunk, _)) = self.open.take() else {
            return;
        };
        if chunk.words.is_empty() {
            return;
        }
        self.kept.push_back(self.keep(&chunk));
        let mut held: u64 = self.kept.iter().map(|kept| kept.ticks).sum();
        let mut bytes: usize = self.kept.iter().map(|kept| kept.bytes.len()).sum();
        while self.kept.len() > 1
            && let Some(oldest) = self.kept.front()
            && (held - oldest.ticks >= self.span_ticks || bytes > MAX_BYTES)
        {
            held -= oldest.ticks;
            bytes -= oldest.bytes.len();
            self.kept.pop_front();
        }
    }

    fn watch(&mut self, ticked: &Ticked) -> Option<Due> {
        let report = &ticked.report;
        let changed = self.transitions.replace(report.transitions) != Some(report.transitions);
        let stopped = matches!(report.state, RobotState::Stopped | RobotState::Holding);
        if changed && stopped {
            let since = self.stop.map_or(report.tick, |(_, since)| since);
            self.stop = Some((report.cause, since));
        }
        let (cause, since) = self.stop?;
        let over = !report.moving || report.tick - since >= AFTERMATH_TICKS;
        over.then(|| {
            self.stop = None;
            Due::Stop(cause)
        })
    }
}
