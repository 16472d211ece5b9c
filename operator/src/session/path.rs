//! The hand's path on its way to the robot: knots made, sent, repeated until they are acknowledged.

use std::collections::VecDeque;

use nalgebra::{UnitQuaternion, Vector3, Vector4};
use telemime_protocol::checkpoint::CheckpointError;
use telemime_protocol::checkpoint::path::{
    CONTEXT, POSE, PathBounds, PathEncoder, PoseKnot, pose as on_path,
};
use telemime_protocol::pose;
use telemime_protocol::predict::HandState;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::knots::{KnotBlock, PathCode};
use telemime_protocol::wire::state::WireState;
use telemime_protocol::wire::v1::{MAX_TAIL_KNOTS, PathTail};

/// Knots in one message; the oldest unacknowledged first.
const KNOTS_PER_MESSAGE: usize = 24;

/// Their bytes: what is left of a datagram beside the longest state and pose.
const BYTES_PER_MESSAGE: usize = 900;

/// More unacknowledged knots than this go by the stream at once: nothing of the path is ever given up.
const BACKLOG: usize = 256;

/// A knot that is still not acknowledged after the round trip and this long goes again, s.
const PATIENCE_S: f64 = 0.15;

/// Knots that are shown.
const SHOWN_KNOTS: usize = 48;

/// A knot the robot may not have yet.
struct Unacknowledged {
    knot: PoseKnot,
    copies: u8,
    sent: Stamp,
}

/// A knot for display.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShownKnot {
    /// Where, in the hand's axes, m.
    pub x: Vector3<f64>,
    /// The hand's orientation, where the path carries it.
    pub orientation: Option<UnitQuaternion<f64>>,
    /// The robot holds it.
    pub held: bool,
}

/// The path of one engagement.
pub(super) struct Path {
    encoder: PathEncoder<POSE>,
    code: PathCode,
    /// The newest orientation as a point of ℝ⁴, so that the next has its sign; zeros if the path carries none.
    turned: Vector4<f64>,
    /// The last knots the robot holds: those to come are written with them in mind.
    held: VecDeque<PoseKnot>,
    unacknowledged: VecDeque<Unacknowledged>,
    first_unacknowledged: u32,
    /// The newest knots.
    shown: VecDeque<PoseKnot>,
}

impl Path {
    /// An empty path of samples at intervals of `sample_us` (µs), of a hand that is turned so; it carries the
    /// orientation if `bounds` has one.
    pub(super) fn new(
        bounds: PathBounds,
        sample_us: u32,
        turned: Option<UnitQuaternion<f64>>,
    ) -> Result<Self, CheckpointError> {
        let turned = turned.filter(|_| bounds.turn_rad().is_some());
        Ok(Self {
            encoder: bounds.encoder()?,
            code: PathCode::new(bounds, sample_us)?,
            turned: turned.map_or_else(Vector4::zeros, |q| pose::point(&q, None)),
            held: VecDeque::with_capacity(CONTEXT + 1),
            unacknowledged: VecDeque::new(),
            first_unacknowledged: 0,
            shown: VecDeque::with_capacity(SHOWN_KNOTS),
        })
    }

    /// The robot holds every knot before `frontier`.
    pub(super) fn acknowledge(&mut self, frontier: u32) {
        let known = frontier.saturating_sub(self.first_unacknowledged) as usize;
        let known = known.min(self.unacknowledged.len());
        for gone in self.unacknowledged.drain(..known) {
            self.held.push_back(gone.knot);
            if self.held.len() > CONTEXT {
                self.held.pop_front();
            }
        }
        self.first_unacknowledged += known as u32;
    }

    /// The newest knots.
    pub(super) fn shown(&self) -> impl Iterator<Item = ShownKnot> {
        let held = self.shown.len().saturating_sub(self.unacknowledged.len());
        let decoded = self.shown.iter().enumerate().filter_map(move |(i, knot)| {
            let knot = self.code.grid().dequantise(knot).ok()?;
            Some((i, knot.x))
        });
        decoded.map(move |(i, point)| ShownKnot {
            x: on_path::place(&point),
            orientation: on_path::turn(&point),
            held: i < held,
        })
    }

    /// The hand was at `x` (m) at `t`, turned so if that is known, else as before. Returns how many knots that made.
    pub(super) fn push(
        &mut self,
        t: Stamp,
        x: &Vector3<f64>,
        q: Option<UnitQuaternion<f64>>,
    ) -> u32 {
        if let Some(q) = q.filter(|_| self.code.turns()) {
            self.turned = pose::point(&q, Some(&self.turned));
        }
        // A sample the path cannot hold (out of the grid's range) is still good for the future.
        let Ok(Some(knot)) = self.encoder.push(t, on_path::point(x, &self.turned)) else {
            return 0;
        };
        self.hold(knot, t);
        1
    }

    /// Closes the path at the newest sample; returns how many knots that took.
    pub(super) fn close(&mut self, now: Stamp) -> u32 {
        let last = self.encoder.flush();
        u32::from(last.map(|knot| self.hold(knot, now)).is_some())
    }

    fn hold(&mut self, knot: PoseKnot, now: Stamp) {
        if self.shown.len() == SHOWN_KNOTS {
            self.shown.pop_front();
        }
        self.shown.push_back(knot);
        self.unacknowledged.push_back(Unacknowledged {
            knot,
            copies: 0,
            sent: now,
        });
    }

    /// What goes by the stream because datagrams have not delivered it for too long.
    pub(super) fn backlog(&mut self, now: Stamp) -> Option<PathTail> {
        if self.unacknowledged.len() > BACKLOG {
            self.tail(now)
        } else {
            None
        }
    }

    /// The oldest unacknowledged knots for the stream but for the engagement, `None` if there are none. What is
    /// handed over is forgotten: the stream delivers it as long as the engagement can live at all.
    pub(super) fn tail(&mut self, now: Stamp) -> Option<PathTail> {
        // Only an origin is wanted, and one that can travel wherever the hand is.
        let state = WireState::quantise(&HandState::first(now, Vector3::zeros()))?;
        let count = self.unacknowledged.len().min(MAX_TAIL_KNOTS);
        let knots = self.packed(&state, 0, count).filter(|k| !k.is_empty())?;
        let first_knot = self.first_unacknowledged;
        self.acknowledge(first_knot + count as u32);
        Some(PathTail {
            engagement: 0,
            state,
            first_knot,
            knots,
        })
    }

    /// The knots for a message with this state, sent `now` over a link of this delay, s, each in so many copies:
    /// without a gap, and the number of the first.
    pub(super) fn due(
        &mut self,
        state: &WireState,
        (now, delay_s): (Stamp, f64),
        copies: u8,
    ) -> (u32, KnotBlock) {
        let overdue = |u: &Unacknowledged| now.secs_since(u.sent) > 2.0 * delay_s + PATIENCE_S;
        let start = self
            .unacknowledged
            .iter()
            .position(|u| u.copies < copies || overdue(u));
        let start = start.unwrap_or(self.unacknowledged.len());
        let mut end = self.unacknowledged.len().min(start + KNOTS_PER_MESSAGE);
        let mut packed = self.packed(state, start, end);
        while packed
            .as_ref()
            .is_some_and(|k| k.0.len() > BYTES_PER_MESSAGE)
            && end > start + 1
        {
            end = start + (end - start) / 2;
            packed = self.packed(state, start, end);
        }
        if packed.is_some() {
            for sent in self.unacknowledged.range_mut(start..end) {
                sent.copies = sent.copies.saturating_add(1);
                sent.sent = now;
            }
        }
        (
            self.first_unacknowledged + start as u32,
            packed.unwrap_or_default(),
        )
    }

    /// The unacknowledged knots `from..to` as they travel.
    fn packed(&self, state: &WireState, from: usize, to: usize) -> Option<KnotBlock> {
        let unacknowledged = self.unacknowledged.range(..to).map(|u| u.knot);
        let known: Vec<_> = self.held.iter().copied().chain(unacknowledged).collect();
        let (before, due) = known.split_at(self.held.len() + from);
        KnotBlock::pack(state, self.code, before, due)
    }
}
