//! How far a skill has got: a filter over the phases of its inferred motion.

use nalgebra::SVector;
use telemime_protocol::predict::{FEATURES, HandState, Standardisation};
use telemime_protocol::skill::{Gmr, GmrError, Skill};
use telemime_protocol::time::Stamp;

/// Phases the belief distinguishes, from 0 to 1.
const PHASES: usize = 48;

/// The motion is followed in steps of a phase over this while its features form.
const FINER: usize = 4;

/// Paces, as multiples of the inferred motion's, that are equally likely from one sample to the next.
const PACES: [f64; 5] = [0.4, 0.7, 1.0, 1.3, 1.7];

/// The share of belief that is spread over all phases per 1/30 s: a repeated part may come again.
const LEAK: f64 = 0.03;

/// A belief over the phases of one skill.
#[derive(Debug, Clone)]
pub(super) struct Phases {
    /// Features along the inferred motion, in units of `per_unit`.
    templates: Vec<SVector<f64, FEATURES>>,
    per_unit: SVector<f64, FEATURES>,
    /// Phases a second at the pace of the inferred motion.
    per_s: f64,
    belief: [f64; PHASES],
}

impl Phases {
    /// Plays the skill's inferred motion and remembers what the hand's features are on the way.
    ///
    /// A phase is as unlike a state as their distance in the predictor's units, the place blurred by
    /// `place_sd_m`.
    pub(super) fn new(
        skill: &Skill,
        units: &Standardisation,
        place_sd_m: f64,
    ) -> Result<Self, GmrError> {
        let gmr = Gmr::<1, 3>::new(skill.motion())?;
        let mut per_unit = units.scale.map(|s| 1.0 / s);
        for i in 0..3 {
            per_unit[i] = 1.0 / units.scale[i].hypot(place_sd_m);
        }
        let at = |t_s: f64| gmr.query(&SVector::from([t_s])).mean;
        let step_s = skill.duration_s() / ((PHASES - 1) * FINER) as f64;
        let mut state = HandState::first(Stamp(0), at(0.0));
        let mut templates = Vec::with_capacity(PHASES);
        for i in 0..=(PHASES - 1) * FINER {
            let t_s = i as f64 * step_s;
            state.advance(Stamp::from_secs_f64(t_s), at(t_s));
            if i % FINER == 0 {
                templates.push(units.bent(state.features()).component_mul(&per_unit));
            }
        }
        let mut phases = Self {
            templates,
            per_unit,
            per_s: (PHASES - 1) as f64 / skill.duration_s(),
            belief: [0.0; PHASES],
        };
        phases.reset();
        Ok(phases)
    }

    pub(super) fn reset(&mut self) {
        self.belief = [1.0 / PHASES as f64; PHASES];
    }

    /// Moves on by `dt_s` and weighs with what is seen; `weight` is 1 for a sample at 30 Hz.
    pub(super) fn take(&mut self, f: &SVector<f64, FEATURES>, dt_s: f64, weight: f64) {
        let mut moved = [0.0; PHASES];
        for pace in PACES {
            let steps = (dt_s * pace * self.per_s).min(PHASES as f64);
            let whole = steps as usize;
            let part = steps - whole as f64;
            for (i, p) in self.belief.iter().enumerate() {
                // What would pass the end stays there.
                moved[(i + whole).min(PHASES - 1)] += (1.0 - part) * p;
                moved[(i + whole + 1).min(PHASES - 1)] += part * p;
            }
        }
        let total: f64 = moved.iter().sum();
        let leak = 1.0 - (1.0 - LEAK).powf(weight);
        let z = f.component_mul(&self.per_unit);
        let mut unlike = [0.0; PHASES];
        let mut least = f64::INFINITY;
        for (u, template) in unlike.iter_mut().zip(&self.templates) {
            *u = 0.5 * weight * (z - template).norm_squared();
            least = least.min(*u);
        }
        let mut sum = 0.0;
        for ((p, moved), unlike) in self.belief.iter_mut().zip(&moved).zip(&unlike) {
            let before = (1.0 - leak) * moved / total + leak / PHASES as f64;
            *p = before * (least - unlike).exp();
            sum += *p;
        }
        if sum > 0.0 && sum.is_finite() {
            self.belief.iter_mut().for_each(|p| *p /= sum);
        } else {
            self.reset();
        }
    }

    /// Mean and standard deviation of the phase, in [0, 1].
    pub(super) fn estimate(&self) -> (f64, f64) {
        let phase = |i: usize| i as f64 / (PHASES - 1) as f64;
        let each = || self.belief.iter().enumerate();
        let mean: f64 = each().map(|(i, p)| p * phase(i)).sum();
        let variance: f64 = each().map(|(i, p)| p * (phase(i) - mean).powi(2)).sum();
        (mean.clamp(0.0, 1.0), variance.sqrt())
    }
}
