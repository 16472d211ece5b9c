//! What a motion message does: the future goes to the servo, the path into the record.

use telemime_endpoint::Mono;
use telemime_protocol::checkpoint::path::{POSE, PathDecoder};
use telemime_protocol::predict::{Forecast, HandState, Params, TurnForecast, checksum};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::bend::WireBend;
use telemime_protocol::wire::knots::{KnotBlock, PathCode};
use telemime_protocol::wire::state::WireState;
use telemime_protocol::wire::turn::{WireTurn, dequantise_grip};
use telemime_protocol::wire::v1::{Engage, MAX_TAIL_KNOTS, Motion, PathTail, Refusal, model_tag};

use super::Session;
use crate::servo::{Bent, Lease, Order};

/// Knots of the path kept: minutes of motion, a fixed amount of memory.
const PATH_KNOTS: usize = 8192;

/// A message that cannot be meant.
struct Impossible;

/// A mirror engagement: the path received so far.
#[derive(Debug)]
pub struct Mirror {
    code: PathCode,
    path: PathDecoder<POSE>,
    frontier: u32,
    newest_t: Stamp,
    diverged: bool,
}

impl Session {
    /// A motion; says whether it was of use.
    pub(super) fn on_motion(&mut self, now: Mono, motion: &Motion) -> bool {
        if motion.epoch != self.epoch || motion.engagement != self.engagement {
            return false;
        }
        let Some(mirror) = &mut self.mirror else {
            return false;
        };
        let state = motion.state.dequantise();
        let Some(valid_at) = self.clock.to_mono(state.t) else {
            return false;
        };
        let age_s = now.secs_since(valid_at);
        if age_s < -self.config.max_delay_s {
            return false;
        }
        mirror.take_knots(&motion.state, motion.first_knot, &motion.knots);
        let fresh = motion.seq > self.newest_seq;
        if fresh {
            self.newest_seq = motion.seq;
        }
        // Newest by sample time: reordering and repetition never take the robot back.
        if state.t <= mirror.newest_t {
            return fresh;
        }
        mirror.newest_t = state.t;
        let diverged = mirror.diverged;
        let lease = self.lease(now, motion.lease_ms, self.too_late_s(age_s));
        if lease.until <= now {
            return false;
        }
        self.delay_s = Some(age_s);
        let model = if diverged { 0 } else { motion.model };
        let mut forecast = self.forecast(&state, model, &motion.params.dequantise());
        let mut turn = self.turn_forecast(state.t, model, motion.pose.turn.as_ref());
        let checked = motion
            .checksum
            .filter(|_| !diverged && self.predicts_with(motion.model));
        if checked.is_some_and(|sum| sum != checksum(&forecast, turn.as_ref())) {
            forecast = Forecast::constant_velocity(&state, &motion.params.dequantise());
            turn = self.turn_forecast(state.t, 0, motion.pose.turn.as_ref());
            if let Some(mirror) = &mut self.mirror {
                mirror.diverged = true;
            }
            self.refuse(Refusal::Diverged);
        }
        self.order(Order::Track {
            forecast,
            valid_at,
            turn,
            grip: motion.pose.grip.map(dequantise_grip),
            ticket: self.ticket(),
            lease,
        });
        true
    }

    /// A go of this engagement; says whether it was of use.
    pub(super) fn on_go(
        &mut self,
        now: Mono,
        seq: u32,
        t_us: i64,
        lease_ms: u16,
        bend: Option<&WireBend>,
    ) -> bool {
        if self.mirror.is_some() || seq <= self.newest_seq {
            return false;
        }
        let Some(sent_at) = self.clock.to_mono(Stamp(t_us.saturating_mul(1000))) else {
            return false;
        };
        let age_s = now.secs_since(sent_at);
        if age_s < -self.config.max_delay_s {
            return false;
        }
        let lease = self.lease(now, lease_ms, self.too_late_s(age_s));
        if lease.until <= now {
            return false;
        }
        let Ok(bent) = bend.map(|bend| self.bent(sent_at, bend)).transpose() else {
            return false;
        };
        self.newest_seq = seq;
        self.delay_s = Some(age_s);
        let ticket = self.ticket();
        self.order(Order::Extend {
            ticket,
            lease,
            bent,
        });
        true
    }

    /// A bend on the robot's clock; a hand's sample from the future is none.
    fn bent(&self, at: Mono, bend: &WireBend) -> Result<Bent, Impossible> {
        let sampled_at = match &bend.held {
            Some(held) => {
                let t = Stamp(held.state.t_us.saturating_mul(1000));
                self.clock.to_mono(t).ok_or(Impossible)?
            }
            None => at,
        };
        if sampled_at.secs_since(at) > self.config.max_delay_s {
            return Err(Impossible);
        }
        Ok(Bent {
            bend: bend.dequantise(),
            at,
            sampled_at,
        })
    }

    /// By how much more than is allowed a message that is `age_s` old is late, s.
    fn too_late_s(&self, age_s: f64) -> f64 {
        (age_s - self.config.max_delay_s).max(0.0)
    }

    /// What a message that arrives `now`, and says `lease_ms`, authorises if it is `late_s` late: less than the longest lease by that, whatever it says.
    pub(super) fn lease(&self, now: Mono, lease_ms: u16, late_s: f64) -> Lease {
        let said_s = f64::from(lease_ms) * 1e-3;
        Lease {
            from: now,
            until: now.offset_by_secs(said_s.min(self.config.max_lease_s) - late_s),
        }
    }

    /// Path knots by the stream.
    pub(super) fn on_path(&mut self, tail: &PathTail) {
        if tail.engagement == self.engagement
            && let Some(mirror) = &mut self.mirror
        {
            mirror.take_knots(&tail.state, tail.first_knot, &tail.knots);
        }
    }

    /// The prediction from `state`: by the model named, or by constant velocity until it has arrived.
    pub(super) fn forecast(&self, state: &HandState, model: u16, params: &Params) -> Forecast {
        match &self.skill {
            Some(skill) if self.predicts_with(model) => skill.predictor().forecast(state, params),
            _ => Forecast::constant_velocity(state, params),
        }
    }

    /// The same for the orientation, if there is one; `t` is when it was valid.
    pub(super) fn turn_forecast(
        &self,
        t: Stamp,
        model: u16,
        turn: Option<&WireTurn>,
    ) -> Option<TurnForecast> {
        let skill = self.skill.as_deref().filter(|_| self.predicts_with(model));
        Some(turn?.forecast(t, skill))
    }

    fn predicts_with(&self, model: u16) -> bool {
        model != 0
            && self
                .skill
                .as_ref()
                .is_some_and(|skill| model_tag(&skill.id().0) == model)
    }
}

impl Mirror {
    /// An empty path on the grid of the engagement's bounds; `None` if there is no such grid.
    pub(super) fn new(engage: &Engage) -> Option<Self> {
        let code = PathCode::new(engage.path_bounds(), engage.sample_us).ok()?;
        Some(Self {
            code,
            path: PathDecoder::new(code.grid(), PATH_KNOTS),
            frontier: 0,
            newest_t: Stamp(i64::MIN),
            diverged: false,
        })
    }

    /// Knots held without a gap.
    pub fn frontier(&self) -> u32 {
        self.frontier
    }

    /// The path received: places, and orientations if [`Mirror::turns`].
    pub fn path(&self) -> &PathDecoder<POSE> {
        &self.path
    }

    /// Whether the path carries the hand's orientation.
    pub fn turns(&self) -> bool {
        self.code.turns()
    }

    fn take_knots(&mut self, state: &WireState, first_knot: u32, block: &KnotBlock) {
        // A message that begins beyond the frontier leaves a gap: its knots come again.
        let Some(known) = self.frontier.checked_sub(first_knot) else {
            return;
        };
        let known = known as usize;
        // What is forgotten is older than any block is long.
        let Some(before) = self.path.before(known) else {
            return;
        };
        let Ok(knots) = block.unpack(state, self.code, &before, MAX_TAIL_KNOTS) else {
            return;
        };
        for knot in knots.iter().skip(known) {
            if self.path.append(knot).is_err() {
                return;
            }
            self.frontier += 1;
        }
    }
}
