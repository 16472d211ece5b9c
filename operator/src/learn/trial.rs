//! What a predictor is worth on motion it has not seen: errors collected, calibration drawn from them.
//! Lengths are metres, or radians where orientation is predicted.

use std::marker::PhantomData;

use nalgebra::Matrix3;
use telemime_protocol::predict::{Calibration, KNOT_SPACING_S, MAX_KNOTS};

use super::predictor::Course;
use super::stats::quantile;
use crate::demonstration::Demonstration;

/// 90 % quantile of χ² with three degrees of freedom.
pub(crate) const CHI2_3_90: f64 = 6.251;

/// Variances and novelties below these are a sensor at rest, not precision: m², and none.
const LEAST_M2: f64 = 1e-8;
const LEAST_NOVELTY: f64 = 1.0;

/// Knots (from 1) by whose errors a character is chosen: 100 to 300 ms, where predictions are used.
const CHOSEN_BY: std::ops::RangeInclusive<usize> = 3..=9;

/// Experts in the order of [`Calibration::errors`].
const MIXTURE: usize = 0;
const GENERIC: usize = 1;
const STRAIGHT: usize = 2;
const HOLD: usize = 3;

/// Squared errors of one expert.
#[derive(Clone, Copy, Default)]
struct Errors {
    squared: f64,
    count: u32,
}

impl Errors {
    fn add(&mut self, squared: f64) {
        self.squared += squared;
        self.count += 1;
    }

    /// Along one axis.
    fn mean(&self) -> Option<f64> {
        (self.count > 0).then(|| (self.squared / (3.0 * f64::from(self.count))).max(LEAST_M2))
    }
}

/// The trials of one training.
pub(super) struct Trial<C> {
    course: PhantomData<C>,
    knots: usize,
    errors: [[Errors; 4]; MAX_KNOTS],
    nees: Vec<Vec<f64>>,
    novelties: Vec<f64>,
}

impl<C: Course> Trial<C> {
    /// Tries the straight line and holding, which need no training and so nothing held out.
    pub(super) fn straight(demonstrations: &[Demonstration], knots: usize) -> Self {
        let mut errors = [[Errors::default(); 4]; MAX_KNOTS];
        for d in demonstrations {
            for (i, state) in C::states(d).iter().enumerate() {
                let experts = C::experts(None, state);
                for j in within(d, i, knots) {
                    let truth = C::displacement(d, i, j);
                    let straight = experts.displacement[j - 1][STRAIGHT];
                    errors[j - 1][STRAIGHT].add((straight - truth).norm_squared());
                    errors[j - 1][HOLD].add(truth.norm_squared());
                }
            }
        }
        Self {
            course: PhantomData,
            knots,
            errors,
            nees: vec![Vec::new(); knots],
            novelties: Vec::new(),
        }
    }

    /// Tries a model on a demonstration it was not trained on.
    pub(super) fn hold_out(&mut self, model: &C::Model, d: &Demonstration) {
        for (i, state) in C::states(d).iter().enumerate() {
            let p = C::posterior(model, state);
            self.novelties.push(p.novelty);
            let experts = C::experts(Some(model), state);
            for j in within(d, i, self.knots) {
                let truth = C::displacement(d, i, j);
                let e = p.displacement[j - 1] - truth;
                let generic = experts.displacement[j - 1][GENERIC];
                self.errors[j - 1][MIXTURE].add(e.norm_squared());
                self.errors[j - 1][GENERIC].add((generic - truth).norm_squared());
                // A planar motion has no variance across its plane.
                let covariance = p.covariance[j - 1] + Matrix3::identity() * LEAST_M2;
                if let Some(c) = covariance.cholesky() {
                    self.nees[j - 1].push(e.dot(&c.solve(&e)));
                }
            }
        }
    }

    /// The mixture's mean square error over that of holding, summed over the knots that count; 0 if none was tried.
    pub(super) fn ratio(&self) -> f64 {
        let each = CHOSEN_BY.filter_map(|j| {
            let errors = self.errors.get(j - 1)?;
            Some(errors[MIXTURE].mean()? / errors[HOLD].mean()?)
        });
        each.sum()
    }

    /// The share of the states tried whose novelty is above `limit`; 0 of none.
    pub(super) fn beyond(&self, limit: f64) -> f64 {
        let beyond = self.novelties.iter().filter(|n| **n > limit).count();
        beyond as f64 / self.novelties.len().max(1) as f64
    }

    /// `c_h = q₉₀(NEES)/6.251`, and the mean squared errors; where nothing was held out, guesses that
    /// [`Calibration::UNTRIED`] explains stand for those of the mixture and the extrapolator. Farther ahead
    /// than any motion lasted, the errors of the last horizon tried stand for those beyond.
    pub(super) fn calibration(self) -> Calibration {
        let mut c = Calibration::UNTRIED;
        if !self.novelties.is_empty() {
            c.novelty90 = quantile(self.novelties, 0.9).max(LEAST_NOVELTY);
        }
        for (factor, nees) in c.covariance.iter_mut().zip(self.nees) {
            if !nees.is_empty() {
                *factor = (quantile(nees, 0.9) / CHI2_3_90).max(f64::from(f32::MIN_POSITIVE));
            }
        }
        let mut last = None;
        for (errors, tried) in c.errors.iter_mut().zip(&self.errors) {
            if let (Some(straight), Some(hold)) = (tried[STRAIGHT].mean(), tried[HOLD].mean()) {
                let generic = tried[GENERIC].mean().unwrap_or(straight.min(0.5 * hold));
                let mixture = tried[MIXTURE].mean().unwrap_or(0.25 * hold);
                last = Some([mixture, generic, straight, hold]);
            }
            *errors = last.unwrap_or(*errors);
        }
        c
    }
}

/// The knots (from 1) at which the truth for a prediction from sample `i` is known.
fn within(d: &Demonstration, i: usize, knots: usize) -> impl Iterator<Item = usize> {
    let left_s = d.last().t_s + 1e-9 - d.samples()[i].t_s;
    (1..=knots).take_while(move |&j| j as f64 * KNOT_SPACING_S <= left_s)
}
