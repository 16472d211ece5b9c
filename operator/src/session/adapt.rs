//! All that adapts adapts here, at the operator, which sees every sample, and travels as numbers: how far to trust each
//! expert at each horizon, and how sure to be. The same for positions and orientations. No clock, no I/O: a session runs it,
//! and an evaluation can.
//!
//! Every sample is the truth about what was predicted for it. The weights follow the errors seen lately, in relation to how
//! far the hand moved, beside what the skill's calibration expects of each expert. Three things decide how much that
//! expectation counts: the motion must be familiar, no smoother than what was learned, and the hand in motion. *A resting
//! hand says nothing about the mixture*: at rest everything is right, and a skill knows that motion will begin but not when.

use std::collections::VecDeque;

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use telemime_protocol::pose;
use telemime_protocol::predict::{
    Ahead, BAND_KNOTS, Calibration, Experts, Forecast, HandState, KNOT_SPACING_S, MAX_KNOTS, Model,
    Params, TurnForecast, TurnModel, TurnState, WEIGHTED,
};
use telemime_protocol::time::Stamp;

/// Time is counted in frames of this length, s: what is learned does not depend on the sensor's rate.
const FRAME_S: f64 = 1.0 / 30.0;

/// A gap in the samples counts as at most this many frames.
const LONGEST_FRAMES: f64 = 3.0;

/// What an error made a frame ago still counts: a second ago, two fifths.
const MEMORY: f64 = 0.97;

/// The calibration weighs as much as this many frames, as long as the motion is familiar: one gesture has few independent errors,
/// and a prediction that is on its model at all is on it at every horizon.
const PRIOR: f64 = 100.0;

/// What the mixture errs by (squared) of what was calibrated: the calibration had to learn without a demonstration.
const WHOLE: f64 = 0.65;

/// Straight line and generic extrapolator are as calibrated until as many frames say otherwise.
const ORDINARY: f64 = 1.0;

/// Where they err less than calibrated, the motion is smoother than what was learned, and the calibration counts less by this
/// power of how much less.
const ORDINARY_POWER: i32 = 2;

/// Where the motion is not familiar, the experts are taken as alike at the first horizon, by this many frames …
const UNKNOWN: f64 = 0.3;

/// … and farther ahead as what is known nearer leads to expect, by this many,
const CASCADE: f64 = 5.0;

/// errors (squared, against holding) having grown by this factor.
const GROWTH: [f64; BAND_KNOTS.len() - 1] = [1.5, 4.0];

/// Weights fall with this power of the mean squared errors.
const POWER: i32 = 3;

/// What a familiar state a frame ago still counts.
const FAMILIAR_MEMORY: f64 = 0.6;

/// Less than familiar is unfamiliar: the power of the running mean.
const FAMILIAR_POWER: i32 = 8;

/// Errors below this are right, m and rad.
const RIGHT: f64 = 1e-4;

/// A verdict from rest counts as far as the state was unfamiliar: one minus this power of the familiarity.
const VERDICT_POWER: i32 = 4;

/// A hand that has been seen to rest for this long is taken as resting by half, s. What is demonstrated begins sooner after its
/// recording does (on gestures after 0.07 to 0.3 s), and at the first sample nothing is known of before.
const REST_S: f64 = 0.45;

/// How sharply that turns: 96 % of the trust are left after 0.3 s, 0.2 % after a second.
const REST_POWER: i32 = 8;

/// A hand that has moved less than this share of the skill's reach lately is at rest: at twice of it 6 % at rest, at half of it 94 %,
/// so that what a tracker errs by begins nothing and a motion that has begun is soon believed.
const REST: f64 = 0.01;

/// A hand that turns less than this lately is at rest, rad.
const REST_RAD: f64 = 0.01;

/// The region that is to hold 90 % of what happens: that quantile of χ² with three degrees of freedom. The factor stands where the
/// misses, each counted by how far it missed, are this share.
const REGION: f64 = 6.251;
const MISSED: f64 = 0.11;

/// By how much the logarithm of the covariance's factor moves in a frame in which every region is just missed.
const WIDENING: f64 = 0.45;

/// What is missed by far counts for more: by this much for every e-fold of the squared distance, …
const FAR: f64 = 0.7;

/// … up to so many of them.
const FARTHEST: f64 = 3.0;

/// … unless the samples around it are farther apart than this, s.
const SEEN_S: f64 = 0.25;

/// ln 2¹⁶.
const MOST_LN_INFLATION: f64 = 11.09;

/// What is predicted: a state with memories, in a space where differences are vectors (m, rad).
pub trait Course: Copy {
    /// Where it is.
    type Point: Copy;
    /// What was learned of it.
    type Model;

    /// When it is valid.
    fn t(&self) -> Stamp;
    /// Where it is now.
    fn point(&self) -> Self::Point;
    /// From each memory to the present.
    fn ways(&self) -> [Vector3<f64>; 4];
    /// `u` of the way from one point to the other.
    fn between(from: &Self::Point, to: &Self::Point, u: f64) -> Self::Point;
    /// From one point to the other.
    fn way(from: &Self::Point, to: &Self::Point) -> Vector3<f64>;
    /// What each expert says of it.
    fn experts(&self, model: Option<&Self::Model>) -> Experts;
}

impl Course for HandState {
    type Point = Vector3<f64>;
    type Model = Model;

    fn t(&self) -> Stamp {
        self.t
    }

    fn point(&self) -> Vector3<f64> {
        self.x
    }

    fn ways(&self) -> [Vector3<f64>; 4] {
        HandState::ways(self)
    }

    fn between(from: &Vector3<f64>, to: &Vector3<f64>, u: f64) -> Vector3<f64> {
        from.lerp(to, u)
    }

    fn way(from: &Vector3<f64>, to: &Vector3<f64>) -> Vector3<f64> {
        to - from
    }

    fn experts(&self, model: Option<&Model>) -> Experts {
        Forecast::experts(self, model)
    }
}

impl Course for TurnState {
    type Point = UnitQuaternion<f64>;
    type Model = TurnModel;

    fn t(&self) -> Stamp {
        self.t
    }

    fn point(&self) -> UnitQuaternion<f64> {
        self.q
    }

    fn ways(&self) -> [Vector3<f64>; 4] {
        TurnState::ways(self)
    }

    fn between(
        from: &UnitQuaternion<f64>,
        to: &UnitQuaternion<f64>,
        u: f64,
    ) -> UnitQuaternion<f64> {
        pose::moved(from, &(pose::between(from, to) * u))
    }

    fn way(from: &UnitQuaternion<f64>, to: &UnitQuaternion<f64>) -> Vector3<f64> {
        pose::between(from, to)
    }

    fn experts(&self, model: Option<&TurnModel>) -> Experts {
        TurnForecast::experts(self, model)
    }
}

/// What was said of one horizon, and waits for its truth.
struct Said {
    due: Stamp,
    answers: [Vector3<f64>; WEIGHTED],
    fused: Vector3<f64>,
    /// Inverse of the fused covariance before its factor.
    information: Matrix3<f64>,
}

/// What was said from one sample: displacements from `origin`.
struct Pending<P> {
    origin: P,
    /// Frames it stands for.
    frames: f64,
    /// Frames that its verdict on the experts counts as.
    weight: f64,
    said: [Said; BAND_KNOTS.len()],
}

/// How the experts have done at one horizon: sums over frames, fading.
#[derive(Clone, Copy, Default)]
struct Record {
    squared: [f64; WEIGHTED + 1],
    frames: f64,
}

impl Record {
    /// Mean square of how far the hand has moved (which is how far holding errs).
    fn moved(&self) -> Option<f64> {
        (self.frames > 1e-9).then(|| (self.squared[WEIGHTED] / self.frames).max(1e-12))
    }
}

/// Adapts the predictor's parameters to what the hand does.
///
/// Feed it every sample with [`observe`](Self::observe); ask for [`params`](Self::params) whenever something is sent.
pub struct Adaptation<C: Course> {
    gain: f64,
    rest: f64,
    /// Mean squared errors at each knot that the calibration expects, in all axes; none without a model.
    calibrated: Option<[[f64; WEIGHTED + 1]; MAX_KNOTS]>,
    /// There was a model to predict the newest sample's future with.
    learned: bool,
    records: [Record; BAND_KNOTS.len()],
    /// Running mean of the familiarity.
    familiar: Option<f64>,
    /// For how long the hand has rested, s.
    rested_s: f64,
    ln_inflation: f64,
    /// For each horizon the oldest entry of `pending` that still waits.
    next: [usize; BAND_KNOTS.len()],
    pending: VecDeque<Pending<C::Point>>,
}

impl Adaptation<HandState> {
    /// For positions, with a gain κ in [0, 1]; `start` is what was calibrated with the skill, `reach_m` how far it goes.
    pub fn of_places(gain: f64, start: Option<&Calibration>, reach_m: f64) -> Self {
        Self::new(gain, start, (REST * reach_m).max(1e-3))
    }
}

impl Adaptation<TurnState> {
    /// For orientations.
    pub fn of_turns(gain: f64, start: Option<&Calibration>) -> Self {
        Self::new(gain, start, REST_RAD)
    }
}

impl<C: Course> Adaptation<C> {
    /// Predicts with this gain κ in [0, 1] from now on.
    pub fn set_gain(&mut self, gain: f64) {
        self.gain = gain.clamp(0.0, 1.0);
    }

    fn new(gain: f64, start: Option<&Calibration>, rest: f64) -> Self {
        let at = |c: &Calibration| {
            c.errors.map(|[mixture, generic, straight, hold]| {
                [WHOLE * mixture, generic, straight, hold].map(|v| 3.0 * v)
            })
        };
        Self {
            gain: gain.clamp(0.0, 1.0),
            rest,
            calibrated: start.map(at),
            learned: start.is_some(),
            records: [Record::default(); BAND_KNOTS.len()],
            familiar: None,
            rested_s: 0.0,
            ln_inflation: 0.0,
            next: [0; BAND_KNOTS.len()],
            pending: VecDeque::new(),
        }
    }

    /// The hand was seen for this long before, s: if it is at rest now, it has rested for so long.
    #[must_use]
    pub fn seen(self, hand: &C, seen_s: f64) -> Self {
        let rested_s = seen_s * (1.0 - self.moving(hand));
        Self { rested_s, ..self }
    }

    /// Mean squared errors that the calibration expects where this band is judged.
    fn expected(&self, band: usize) -> Option<[f64; WEIGHTED + 1]> {
        Some(self.calibrated.as_ref()?[BAND_KNOTS[band] - 1])
    }

    /// The numbers that travel, for a prediction from `hand`.
    pub fn params(&self, hand: &C) -> Params {
        Params {
            gain: self.gain,
            inflation: self.ln_inflation.exp(),
            weights: self.weights(hand),
        }
    }

    /// Judges what was predicted for the time up to `newest`, and notes what is predicted from there.
    ///
    /// `previous` is the sample before; `model` what the robot predicts with, if it has one.
    pub fn observe(&mut self, previous: &C, newest: &C, model: Option<&C::Model>) {
        let span_s = newest.t().secs_since(previous.t());
        let frames = (span_s / FRAME_S).clamp(0.0, LONGEST_FRAMES);
        self.learned = model.is_some();
        let fade = MEMORY.powf(frames);
        for record in &mut self.records {
            record.squared.iter_mut().for_each(|v| *v *= fade);
            record.frames *= fade;
        }
        self.judge(previous, newest, span_s);
        let moving = self.moving(newest);
        self.rested_s = (self.rested_s + span_s) * (1.0 - moving);

        let experts = newest.experts(model);
        let fade = FAMILIAR_MEMORY.powf(frames);
        let familiar = match self.familiar {
            Some(before) => before * fade + experts.familiarity * (1.0 - fade),
            None => experts.familiarity,
        };
        self.familiar = Some(familiar);
        let params = Params {
            gain: 1.0,
            inflation: 1.0,
            weights: self.weights(newest),
        };
        let ahead = Ahead::fused(&experts, &params);
        let unfamiliar = 1.0 - experts.familiarity.powi(VERDICT_POWER);
        let said = BAND_KNOTS.map(|knot| {
            let knot = knot.min(experts.count);
            let fused = &ahead.knots[knot];
            let [xx, xy, xz, yy, yz, zz] = fused.covariance;
            let covariance = Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz);
            Said {
                due: newest.t().offset_by_secs(knot as f64 * KNOT_SPACING_S),
                answers: experts.displacement[knot - 1],
                fused: fused.displacement,
                information: covariance.try_inverse().unwrap_or_else(Matrix3::zeros),
            }
        });
        self.pending.push_back(Pending {
            origin: newest.point(),
            frames,
            weight: frames * (moving + (1.0 - moving) * unfamiliar),
            said,
        });
    }

    /// What the newest sample says of what was foretold of it.
    fn judge(&mut self, previous: &C, newest: &C, span_s: f64) {
        for band in 0..BAND_KNOTS.len() {
            while let Some(pending) = self.pending.get(self.next[band]) {
                let said = &pending.said[band];
                if said.due > newest.t() {
                    break;
                }
                self.next[band] += 1;
                let u = (said.due.secs_since(previous.t()) / span_s).clamp(0.0, 1.0);
                let truth = C::between(&previous.point(), &newest.point(), u);
                let moved = C::way(&pending.origin, &truth);
                let record = &mut self.records[band];
                record.frames += pending.weight;
                for (sum, answer) in record.squared.iter_mut().zip(&said.answers) {
                    *sum += pending.weight * (answer - moved).norm_squared();
                }
                record.squared[WEIGHTED] += pending.weight * moved.norm_squared();
                let e = said.fused - moved;
                let out = e.dot(&(said.information * e)) / (REGION * self.ln_inflation.exp());
                // Across a hole the truth is drawn, not seen.
                let far = if span_s <= SEEN_S { FAR } else { 0.0 };
                let missed = if out > 1.0 {
                    1.0 + far * out.ln().min(FARTHEST)
                } else {
                    0.0
                };
                let step = WIDENING * pending.frames / BAND_KNOTS.len() as f64;
                self.ln_inflation += step * (missed - MISSED);
            }
        }
        self.ln_inflation = self
            .ln_inflation
            .clamp(-MOST_LN_INFLATION, MOST_LN_INFLATION);
        let done = self.next.into_iter().min().unwrap_or(0);
        self.pending.drain(..done);
        self.next = self.next.map(|next| next - done);
    }

    /// How much the calibration counts, from 0 to 1.
    fn credit(&self) -> f64 {
        match &self.calibrated {
            Some(_) => self.familiar.unwrap_or(1.0).powi(FAMILIAR_POWER),
            None => 0.0,
        }
    }

    /// Frames that the calibration weighs as. What a skill learned from abrupt motion expects of each expert must not drown what
    /// smooth motion shows.
    fn prior(&self) -> f64 {
        let (Some(expected), Some(moved)) = (self.expected(0), self.records[0].moved()) else {
            return PRIOR;
        };
        let [.., hold] = expected;
        let Record {
            squared, frames, ..
        } = &self.records[0];
        let simple = 1..WEIGHTED;
        let share = simple
            .map(|e| {
                let promised = expected[e] / hold * moved;
                (squared[e] + ORDINARY * promised) / ((frames + ORDINARY) * promised)
            })
            .fold(1.0, f64::min);
        PRIOR * share.powi(ORDINARY_POWER)
    }

    /// Weights ∝ (mean squared error)⁻³ at every horizon.
    fn weights(&self, hand: &C) -> [[f64; WEIGHTED]; BAND_KNOTS.len()] {
        let (credit, prior) = (self.credit(), self.prior());
        let moving = self.moving(hand);
        let rested = (self.rested_s / REST_S).powi(REST_POWER);
        let moving = moving + (1.0 - moving) / (1.0 + rested);
        let mut nearer: Option<[f64; WEIGHTED + 1]> = None;
        let mut out = [[0.0; WEIGHTED]; BAND_KNOTS.len()];
        for (band, weights) in out.iter_mut().enumerate() {
            let record = &self.records[band];
            let unknown = match nearer {
                None => [UNKNOWN; WEIGHTED + 1],
                Some(errors) => {
                    let grown = |e: f64| (e * GROWTH[band - 1]).min(1e4);
                    let [mixture, generic, straight, hold] = errors;
                    [grown(mixture), grown(generic), grown(straight), hold].map(|e| CASCADE * e)
                }
            };
            let expected = self.expected(band);
            let hold = expected.map_or(1.0, |e| e[WEIGHTED]);
            let moved = record.moved().unwrap_or(hold);
            let right = RIGHT * RIGHT * (record.frames + prior);
            let errors: [f64; WEIGHTED + 1] = std::array::from_fn(|e| {
                let calibrated = expected.map_or(0.0, |expected| prior * expected[e] / hold);
                let before = credit * calibrated + (1.0 - credit) * unknown[e];
                record.squared[e] + before * moved + right
            });
            nearer = Some(errors.map(|e| e / errors[WEIGHTED]));
            // Without a model there are two experts.
            let learned = if self.learned { 0 } else { 2 };
            let least = errors[learned..]
                .iter()
                .copied()
                .fold(f64::INFINITY, f64::min);
            let raw: [f64; WEIGHTED + 1] = std::array::from_fn(|e| {
                if e < learned {
                    0.0
                } else {
                    (least / errors[e]).powi(POWER)
                }
            });
            let total: f64 = raw.iter().sum();
            let share = raw.map(|w| w / total);
            let mixture = share[0] * moving;
            let others = if share[0] < 1.0 {
                (1.0 - mixture) / (1.0 - share[0])
            } else {
                0.0
            };
            *weights = [mixture, share[1] * others, share[2] * others];
        }
        out
    }

    /// From 0 for a hand at rest to 1 for one in motion.
    fn moving(&self, hand: &C) -> f64 {
        let moved = hand
            .ways()
            .iter()
            .map(Vector3::norm_squared)
            .fold(0.0, f64::max);
        let (moved, rest) = (moved * moved, self.rest.powi(4));
        moved / (moved + rest)
    }
}
