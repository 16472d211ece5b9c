//! Play with corrections: when of the plan it is, and how far the operator's hand bends it (driving.md §9).
//!
//! All of this is decided here and travels as numbers ([`WireBend`]). What is decided takes effect when the message
//! arrives: the plan's time is counted at the arm (`ahead` of now by delay and lag), and a displacement that is let go decays
//! from where the robot has it then. So neither jumps, however long the link is.

mod leeway;

use nalgebra::Vector3;
use telemime_protocol::checkpoint::PoseCurve;
use telemime_protocol::predict::{Bend, HandState, LET_GO_TAU_S, MAX_RATE};
use telemime_protocol::skill::chi_squared_quantile;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::bend::{WireBend, WireHeld};

use super::{FutureBound, HandSample, SessionConfig};
pub use leeway::Leeway;
use leeway::{Fusion, distance2};

/// Of a bound that is a multiple of the deviation: shares grow and fall within a third of a second, and in few steps.
const FINER: f64 = 0.6;

/// The hand gains its say over this time after it took hold, s.
const GRAB_S: f64 = 0.2;

/// A displacement that only one motion in a hundred would show, for this long, takes over, s.
const INSIST_S: f64 = 0.15;
const INSIST_SHARE: f64 = 0.99;

/// The skill then loses its say over this time, s.
const YIELD_S: f64 = 0.3;

/// Without a sample for this long the hand has let go, s: a tracker that lost it holds nothing.
pub const LOST_S: f64 = 0.25;

/// The rate follows what the hand asks for with this time constant, s.
const RATE_TAU_S: f64 = 0.2;

/// A hand so many deviations behind stops the plan.
const HALTING: f64 = 2.0;

/// Below this speed a plan's direction counts for less, m/s.
const STILL_M_S: f64 = 0.05;

/// A push is predicted half as far as its speed would take it: it is about to end.
const STRAIGHT: f64 = 0.5;

/// While a hand bends the plan, or has just done, that is looked at this often, s.
const LOOK_S: f64 = 0.02;

/// What a hand does with a motion that is played.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Change {
    /// It takes hold.
    Grabbed,
    /// It insists, and drives alone from now on.
    TakenOver,
    /// It lets go.
    Released,
    /// It was lost while it held on.
    Lost,
}

/// A played motion as the operator has just told the robot to bend it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bent {
    /// When this holds at the arm, on the session clock.
    pub at: Stamp,
    /// The plan's time then, s.
    pub plan_s: f64,
    /// Plan seconds per second.
    pub rate: f64,
    /// The hand's displacement since it took hold, predicted for then, m; `None` if it does not hold on.
    pub hand_m: Option<Vector3<f64>>,
    /// How far beside the plan the hand belongs then, m.
    pub offset_m: Vector3<f64>,
    /// The hand's share along one axis on average, in [0, 1].
    pub share: f64,
}

impl Bent {
    /// What is true at the arm at `t`, of all it was told in order of time: linear between two, the newest at its rate
    /// after all; `None` before any.
    pub fn among(told: &[Self], t: Stamp) -> Option<Self> {
        let after = told.partition_point(|bent| bent.at <= t);
        let before = told[after.checked_sub(1)?];
        let since_s = t.secs_since(before.at);
        let (plan_s, offset_m) = match told.get(after) {
            Some(next) => {
                let u = since_s / next.at.secs_since(before.at);
                let plan_s = before.plan_s + (next.plan_s - before.plan_s) * u;
                (plan_s, before.offset_m.lerp(&next.offset_m, u))
            }
            None => (before.plan_s + before.rate * since_s, before.offset_m),
        };
        Some(Self {
            at: t,
            plan_s,
            offset_m,
            ..before
        })
    }
}

/// A hand that holds on.
struct Hold {
    since: Stamp,
    origin: Vector3<f64>,
    /// The displacement from there.
    state: HandState,
    /// When its newest sample came.
    heard: Stamp,
    /// Since when it has been where no demonstration was.
    strange: Option<Stamp>,
    taken: Option<Stamp>,
}

/// What the robot was told last, and when.
struct Sent {
    bend: Bend,
    at: Stamp,
    sampled: Stamp,
}

impl Sent {
    fn offset_at(&self, t: Stamp) -> Vector3<f64> {
        self.bend
            .offset_at(t.secs_since(self.at), t.secs_since(self.sampled))
    }
}

/// How far off the robot may be.
#[derive(Debug, Clone, Copy)]
enum CorrectionBound {
    /// m.
    Distance(f64),
    /// Of what is left open once skill and hand have had their say.
    Deviations(f64),
}

/// The corrections of one play.
pub(super) struct Correction {
    curve: PoseCurve,
    leeway: Leeway,
    hand_sigma_m: f64,
    bound: CorrectionBound,
    /// Prediction gain κ.
    gain: f64,
    /// The plan's time and rate at this moment at the arm; `None` until the robot has engaged.
    clock: Option<(Stamp, f64, f64)>,
    hold: Option<Hold>,
    /// What is left of displacements that were let go, decaying from this moment at the arm on.
    left: (Stamp, Vector3<f64>),
    sent: Option<Sent>,
    looked: Stamp,
}

impl Correction {
    pub(super) fn new(curve: PoseCurve, leeway: Leeway, config: &SessionConfig) -> Self {
        Self {
            curve,
            leeway,
            hand_sigma_m: config.hand_sigma_m,
            bound: match config.future_bound {
                FutureBound::Absolute(m) => CorrectionBound::Distance(m),
                FutureBound::Relative(k) => CorrectionBound::Deviations(FINER * k),
                // Nobody has demonstrated how far corrections go.
                FutureBound::Share(_) => CorrectionBound::Deviations(FINER),
            },
            gain: config.gain,
            clock: None,
            hold: None,
            left: (Stamp::ZERO, Vector3::zeros()),
            sent: None,
            looked: Stamp::ZERO,
        }
    }

    /// The robot began to play at `t`.
    pub(super) fn begin(&mut self, t: Stamp) {
        self.clock.get_or_insert((t, 0.0, 1.0));
    }

    /// The hand, live: a sample is a hand that holds on. Says what that changes, and `false` if the sample is of no use.
    pub(super) fn take(
        &mut self,
        now: Stamp,
        ahead: Stamp,
        sample: &HandSample,
    ) -> (bool, Option<Change>) {
        self.look(now, ahead);
        let finite = sample.x.iter().all(|v| v.is_finite());
        if self.clock.is_none() || !finite {
            return (false, None);
        }
        let Some(hold) = &mut self.hold else {
            self.hold = Some(Hold {
                since: now,
                origin: sample.x,
                state: HandState::first(sample.t, Vector3::zeros()),
                heard: now,
                strange: None,
                taken: None,
            });
            return (true, Some(Change::Grabbed));
        };
        if !hold.state.advance(sample.t, sample.x - hold.origin) {
            return (false, None);
        }
        hold.heard = now;
        let leeway = self.leeway.at(plan_at(&self.clock));
        let insists = chi_squared_quantile(INSIST_SHARE, 3)
            .is_some_and(|q| distance2(&leeway, self.hand_sigma_m, &hold.state.x) > q);
        hold.strange = insists.then(|| hold.strange.unwrap_or(now));
        let long = hold
            .strange
            .is_some_and(|since| now.secs_since(since) >= INSIST_S);
        if long && hold.taken.is_none() {
            hold.taken = Some(now);
            return (true, Some(Change::TakenOver));
        }
        (true, None)
    }

    /// The hand lets go; false if it held nothing.
    pub(super) fn let_go(&mut self, now: Stamp, ahead: Stamp) -> bool {
        self.look(now, ahead);
        if self.hold.take().is_none() {
            return false;
        }
        // Where the robot has it when it hears of this.
        let there = self.sent.as_ref().map(|sent| sent.offset_at(ahead));
        self.left = (ahead, there.unwrap_or_default());
        true
    }

    /// Whether the hand's samples have stopped coming.
    pub(super) fn is_lost(&self, now: Stamp) -> bool {
        let lost = |hold: &Hold| now.secs_since(hold.heard) > LOST_S;
        self.hold.as_ref().is_some_and(lost)
    }

    /// When to look again, while there is something to see.
    pub(super) fn due(&self) -> Option<Stamp> {
        let (_, _, rate) = self.clock?;
        let lively = self.hold.is_some()
            || self.left_at(self.looked).norm() > 1e-4
            || (rate - 1.0).abs() > 1e-3;
        lively.then(|| self.looked.offset_by_secs(LOOK_S))
    }

    /// Moves the plan's time on to `ahead`, when what is decided at `now` takes effect at the arm.
    pub(super) fn look(&mut self, now: Stamp, ahead: Stamp) {
        self.looked = now;
        let asked = self.rate_asked(now);
        let Some((t, plan_s, rate)) = &mut self.clock else {
            return;
        };
        let dt_s = ahead.secs_since(*t);
        // A shorter delay than a moment ago: what was decided for then stands.
        if dt_s <= 0.0 {
            return;
        }
        let e = libm::exp(-dt_s / RATE_TAU_S);
        *plan_s += asked * dt_s + (*rate - asked) * RATE_TAU_S * (1.0 - e);
        *rate = asked + (*rate - asked) * e;
        *t = ahead;
    }

    /// Whether the robot would be off by more than ε_future without news.
    pub(super) fn has_changed(&self, now: Stamp, ahead: Stamp) -> bool {
        let Some(wire) = self.bend(now, ahead) else {
            return false;
        };
        let Some(sent) = &self.sent else {
            return true;
        };
        let bend = wire.dequantise();
        let since_sample_s = ahead.secs_since(self.sampled().unwrap_or(now));
        let told = self
            .curve
            .position_at(sent.bend.plan_at(ahead.secs_since(sent.at)))
            + sent.offset_at(ahead);
        let meant = self.curve.position_at(bend.plan_at(ahead.secs_since(now)))
            + bend.offset_at(ahead.secs_since(now), since_sample_s);
        let bound_m = match self.bound {
            CorrectionBound::Distance(m) => m,
            CorrectionBound::Deviations(k) => k * self.fusion(now).deviation_m,
        };
        // Written so that NaN speaks.
        !((told - meant).norm() <= bound_m)
    }

    /// What to tell the robot; nothing before the first hold.
    pub(super) fn tell(&mut self, now: Stamp, ahead: Stamp) -> Option<(WireBend, Bent)> {
        let wire = self.bend(now, ahead)?;
        let sampled = self.sampled().unwrap_or(now);
        let sent = Sent {
            bend: wire.dequantise(),
            at: now,
            sampled,
        };
        let h_s = ahead.secs_since(now);
        let bent = Bent {
            at: ahead,
            plan_s: sent.bend.plan_at(h_s),
            rate: sent.bend.rate,
            hand_m: sent
                .bend
                .held
                .map(|held| held.displacement_at(ahead.secs_since(sampled))),
            offset_m: sent.offset_at(ahead),
            share: sent.bend.held.map_or(0.0, |held| held.weight.trace() / 3.0),
        };
        self.sent = Some(sent);
        Some((wire, bent))
    }

    fn bend(&self, now: Stamp, ahead: Stamp) -> Option<WireBend> {
        let (t, plan_s, rate) = self.clock?;
        if self.hold.is_none() && self.sent.is_none() {
            return None;
        }
        let ahead_s = ahead.secs_since(now);
        let held = match &self.hold {
            Some(hold) => {
                let weight = self.fusion(now).weight;
                Some(WireHeld::quantise(
                    &hold.state,
                    self.gain,
                    STRAIGHT,
                    &weight,
                )?)
            }
            None => None,
        };
        // Stated for now such that it is true when it arrives.
        let left = self.left_at(ahead) * libm::exp(ahead_s.max(0.0) / LET_GO_TAU_S);
        WireBend::quantise(plan_s, t.secs_since(now), rate, &left, held)
    }

    fn left_at(&self, t: Stamp) -> Vector3<f64> {
        let (from, left) = self.left;
        left * libm::exp(-t.secs_since(from).max(0.0) / LET_GO_TAU_S)
    }

    fn sampled(&self) -> Option<Stamp> {
        self.hold.as_ref().map(|hold| hold.state.t)
    }

    fn fusion(&self, now: Stamp) -> Fusion {
        let leeway = self.leeway.at(plan_at(&self.clock));
        let (s, g) = self.says(now);
        Fusion::new(&leeway, s, self.hand_sigma_m, g)
    }

    /// The say of the skill, and of the hand.
    fn says(&self, now: Stamp) -> (f64, f64) {
        let Some(hold) = &self.hold else {
            return (1.0, 0.0);
        };
        let yielded = hold
            .taken
            .map_or(0.0, |taken| eased(now.secs_since(taken) / YIELD_S));
        (1.0 - yielded, eased(now.secs_since(hold.since) / GRAB_S))
    }

    /// The rate that the hand's place along the plan asks for: less behind, more before, none once it has taken over.
    fn rate_asked(&self, now: Stamp) -> f64 {
        let Some(hold) = &self.hold else {
            return 1.0;
        };
        let (s, g) = self.says(now);
        let plan_s = plan_at(&self.clock);
        let (start_s, end_s) = self.curve.position.span_s();
        let jet = self.curve.position.eval(plan_s.clamp(start_s, end_s));
        let velocity = jet.map_or_else(|_| Vector3::zeros(), |jet| jet.v);
        let speed = velocity.norm();
        let direction = velocity / speed.max(f64::MIN_POSITIVE);
        let hand = self.hand_sigma_m * self.hand_sigma_m;
        let variance = direction.dot(&(self.leeway.at(plan_s) * direction)) + hand;
        let along = hold.state.x.dot(&direction) / variance.sqrt() * (speed / STILL_M_S).min(1.0);
        s * (1.0 + g * along / HALTING).clamp(0.0, MAX_RATE)
    }
}

/// The plan's time where the newest decision takes effect, s.
fn plan_at(clock: &Option<(Stamp, f64, f64)>) -> f64 {
    clock.map_or(0.0, |(_, plan_s, _)| plan_s)
}

/// From 0 at 0 to 1 at 1, smoothly.
fn eased(u: f64) -> f64 {
    let u = u.clamp(0.0, 1.0);
    u * u * (3.0 - 2.0 * u)
}
