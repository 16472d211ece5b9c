//! Which of the known skills the hand is performing, and how far it has got, sample by sample.
//!
//! All of it comes out of the skills as they are: the predictor's mixture is a density over the hand's
//! states (`known`), its calibration says how strange a performance of the skill may look, and
//! the inferred motion is the scale on which progress is read. Nothing else has to be learned or stored.
//!
//! Per sample: the log density ln p(f | s) of every skill s moves a tempered Bayesian filter with a leak,
//!
//! ```text
//! p_s ← (1 − λ)·p_s + λ/S;   p_s ← p_s · p(f | s)^(β·w) / Σ;   w = 30·min(dt, 0.1 s), λ = 1 − (1 − leak)^(30·dt)
//! ```
//!
//! so that a sensor's rate changes nothing. How *strange* the sample is to s is a weighted mean of two
//! ratios, each 1 where one sample in ten of a held-out demonstration lies beyond: the squared
//! Mahalanobis distance to the nearest component, and the squared error of what the skill foretold 200 ms
//! ago. It is averaged over 0.3 s; beyond a threshold the motion is none of the known ones.
//!
//! Figures, and what did worse: `docs/recognition.md`.

mod foretold;
mod known;
mod phase;
#[cfg(test)]
pub(crate) mod tests;
pub mod trial;

use nalgebra::Vector3;
use telemime_protocol::predict::HandState;
use telemime_protocol::skill::{GmrError, Skill};
use telemime_protocol::time::Stamp;

use known::Known;

/// The rate to which β and the leak refer, 1/s.
const RATE_HZ: f64 = 30.0;

/// One sample counts for at most this long, s: what happened in a hole is not known.
const LONGEST_S: f64 = 0.1;

/// After a hole of this length everything begins anew, s.
const HOLE_S: f64 = 1.0;

/// The average of the novelty reaches this far back, s.
const NOVELTY_TAU_S: f64 = 0.3;

/// A hand this near to all its memories rests, m: below it a sensor's noise is all there is to see.
const REST_M: f64 = 0.02;

/// The share of belief at which a skill is named.
const DECIDED: f64 = 0.5;

/// How sharply `none` sets in around the threshold.
const SHARPNESS: i32 = 8;

/// How to recognise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RecogniseOptions {
    /// Standard deviation of the place, m, ≥ 0: how far off, along each axis, a skill may be performed
    /// from where it was learned. Infinite: anywhere.
    pub place_sd_m: f64,
    /// The smoothed novelty, > 0, beyond which a motion is none of the known ones; around 1 is what one
    /// sample in ten of a held-out performance exceeds, 4 is the most there is.
    pub reject_above: f64,
    /// The tempering exponent β in (0, 1] of a sample's evidence at 30 Hz: neighbours are not independent.
    pub temper: f64,
    /// The share in [0, 1) of belief that is forgotten per 1/30 s.
    pub leak: f64,
}

impl Default for RecogniseOptions {
    fn default() -> Self {
        Self {
            place_sd_m: 0.1,
            reject_above: 1.1,
            temper: 0.2,
            leak: 0.02,
        }
    }
}

/// Why nothing can be recognised with these skills and options.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RecogniseError {
    /// An option is outside its range.
    #[error("{field} of {value}: {range}")]
    Option {
        /// Which.
        field: &'static str,
        /// What it is.
        value: f64,
        /// What it may be.
        range: &'static str,
    },
    /// Two skills have the same name, so that an answer would mean nothing.
    #[error("two skills are called {name}: learn one of them from a folder of another name")]
    SameName {
        /// The name.
        name: String,
    },
    /// A skill's motion cannot be read over time.
    #[error("{name}: its motion cannot be inferred: {source}")]
    Motion {
        /// The skill.
        name: String,
        /// Why.
        source: GmrError,
    },
    /// A predictor's covariance is singular to working precision.
    #[error("{name}: predictor component {component} is singular: learn the skill again")]
    Singular {
        /// The skill.
        name: String,
        /// Index of the component.
        component: usize,
    },
}

/// What a hand is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// It rests: every skill begins and ends like that.
    Resting,
    /// It moves, but as none of the known skills.
    Unknown,
    /// It moves as several of the known skills begin, and none has half of the belief yet.
    Undecided,
    /// It performs the skill of this index.
    Skill(usize),
}

/// The answer to one sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Recognition {
    /// When the sample is valid.
    pub t: Stamp,
    /// What the hand is doing.
    pub verdict: Verdict,
    /// The skill that fits best, whatever the verdict; `None` only if no skill is known.
    pub best: Option<usize>,
    /// Its probability, in [0, 1]; what the others and [`Recognition::none`] leave.
    pub probability: f64,
    /// The probability that it is none of the known skills, in [0, 1]; 1 without any.
    pub none: f64,
    /// How far that skill has got, in [0, 1] of its duration.
    pub phase: f64,
    /// Standard deviation of the phase.
    pub phase_sd: f64,
    /// How strange the motion is to that skill, 0 to 4; infinite without any.
    pub novelty: f64,
}

/// Watches a hand, sample by sample. It knows no clock and allocates nothing after it was made.
#[derive(Debug, Clone)]
pub struct Recogniser {
    options: RecogniseOptions,
    known: Vec<Known>,
    names: Vec<String>,
    /// The filter's p_s, which sum to one.
    belief: Vec<f64>,
    /// β·w·ln p(f | s), then the new belief.
    scratch: Vec<f64>,
    novelty: Vec<f64>,
    last: Option<Recognition>,
}

impl Recogniser {
    /// A recogniser of these skills, in this order; none at all is possible, and then nothing is known.
    ///
    /// # Errors
    /// [`RecogniseError`].
    pub fn new<'a>(
        skills: impl IntoIterator<Item = &'a Skill>,
        options: RecogniseOptions,
    ) -> Result<Self, RecogniseError> {
        let options = options.checked()?;
        let mut known = Vec::new();
        let mut names: Vec<String> = Vec::new();
        for skill in skills {
            if names.iter().any(|n| n == skill.name()) {
                return Err(RecogniseError::SameName {
                    name: skill.name().to_owned(),
                });
            }
            names.push(skill.name().to_owned());
            known.push(Known::new(skill, options.place_sd_m)?);
        }
        let count = known.len();
        Ok(Self {
            options,
            known,
            names,
            belief: vec![1.0 / count.max(1) as f64; count],
            scratch: vec![0.0; count],
            novelty: vec![0.0; count],
            last: None,
        })
    }

    /// The skills' names, in the order of their indices.
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// How probable each skill is as the hand was last seen; with [`Recognition::none`] they sum to one.
    pub fn probabilities(&self) -> impl ExactSizeIterator<Item = f64> + '_ {
        let some = self.last.map_or(0.0, |r| 1.0 - r.none);
        self.belief.iter().map(move |p| p * some)
    }

    /// Forgets the hand, not the skills.
    pub fn reset(&mut self) {
        let alike = 1.0 / self.known.len().max(1) as f64;
        self.belief.fill(alike);
        self.known.iter_mut().for_each(Known::reset);
        self.last = None;
    }

    /// Takes the newest state of the hand and says what it is doing.
    ///
    /// A state that is not finite or not later than the last changes nothing: the last answer is given
    /// again (`None` if there is none yet). After a hole of a second everything begins anew.
    pub fn take(&mut self, state: &HandState) -> Option<Recognition> {
        if !state.is_finite() || self.last.is_some_and(|last| state.t <= last.t) {
            return self.last;
        }
        let mut dt_s = self.last.map(|last| state.t.secs_since(last.t));
        if dt_s.is_some_and(|dt_s| dt_s > HOLE_S) {
            self.reset();
            dt_s = None;
        }
        let weight = RATE_HZ * dt_s.unwrap_or(1.0 / RATE_HZ).min(LONGEST_S);
        let memory = dt_s.map_or(0.0, |dt_s| (-dt_s / NOVELTY_TAU_S).exp());
        let resting = rests(state);

        let temper = self.options.temper * weight;
        let f = state.features();
        for ((known, l), novelty) in self
            .known
            .iter_mut()
            .zip(&mut self.scratch)
            .zip(&mut self.novelty)
        {
            let (log_density, strange) = known.judge(state.t, &f);
            // At rest nothing is seen that could speak for one skill against another.
            *l = if resting { 0.0 } else { temper * log_density };
            *novelty = memory * *novelty + (1.0 - memory) * strange;
            known.progress(&f, dt_s.unwrap_or(0.0), weight);
        }
        self.believe(dt_s.unwrap_or(0.0));
        let answer = self.answer(state.t, resting);
        self.last = Some(answer);
        self.last
    }

    /// One step of the filter.
    fn believe(&mut self, dt_s: f64) {
        let leak = 1.0 - (1.0 - self.options.leak).powf(RATE_HZ * dt_s);
        let alike = 1.0 / self.belief.len().max(1) as f64;
        let most = self
            .scratch
            .iter()
            .copied()
            .fold(f64::NEG_INFINITY, f64::max);
        let mut sum = 0.0;
        for (p, l) in self.belief.iter_mut().zip(&self.scratch) {
            // The farthest hand is −∞ to all alike, and says nothing.
            let relative = if most.is_finite() { l - most } else { 0.0 };
            *p = ((1.0 - leak) * *p + leak * alike) * relative.exp();
            sum += *p;
        }
        for p in &mut self.belief {
            *p = if sum > 0.0 { *p / sum } else { alike };
        }
    }

    fn answer(&self, t: Stamp, resting: bool) -> Recognition {
        let mut best: Option<usize> = None;
        for (i, p) in self.belief.iter().enumerate() {
            if best.is_none_or(|b| *p > self.belief[b]) {
                best = Some(i);
            }
        }
        let Some(i) = best else {
            return Recognition {
                t,
                verdict: if resting {
                    Verdict::Resting
                } else {
                    Verdict::Unknown
                },
                best,
                probability: 0.0,
                none: 1.0,
                phase: 0.0,
                phase_sd: 0.0,
                novelty: f64::INFINITY,
            };
        };
        let novelty = self.novelty[i];
        let fits = 1.0 / (1.0 + (novelty / self.options.reject_above).powi(SHARPNESS));
        let (phase, phase_sd) = self.known[i].phase();
        Recognition {
            t,
            verdict: if resting {
                Verdict::Resting
            } else if novelty > self.options.reject_above {
                Verdict::Unknown
            } else if self.belief[i] < DECIDED {
                Verdict::Undecided
            } else {
                Verdict::Skill(i)
            },
            best,
            probability: self.belief[i] * fits,
            none: 1.0 - fits,
            phase,
            phase_sd,
            novelty,
        }
    }
}

impl RecogniseOptions {
    fn checked(self) -> Result<Self, RecogniseError> {
        let refuse = |field, value, range| {
            Err(RecogniseError::Option {
                field,
                value,
                range,
            })
        };
        if !(self.place_sd_m >= 0.0) {
            return refuse("place_sd_m", self.place_sd_m, "0 m or more");
        }
        if !(self.reject_above > 0.0) {
            return refuse("reject_above", self.reject_above, "more than 0");
        }
        if !(self.temper > 0.0 && self.temper <= 1.0) {
            return refuse("temper", self.temper, "more than 0, at most 1");
        }
        if !(0.0..1.0).contains(&self.leak) {
            return refuse("leak", self.leak, "0 or more, less than 1");
        }
        Ok(self)
    }
}

/// Whether the hand is where it has been for the last second.
fn rests(state: &HandState) -> bool {
    let away = |m: &Vector3<f64>| (state.x - m).norm();
    state.memory.iter().all(|m| away(m) < REST_M)
}
