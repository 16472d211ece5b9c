//! What a predictor is worth on motion it has not seen: errors collected, calibration drawn from them.
//! Lengths are metres, or radians where orientation is predicted.

use std::marker::PhantomData;

use nalgebra::{Matrix3, Vector3};
use telemime_protocol::predict::{Calibration, KNOT_SPACING_S, MAX_KNOTS, Params};

use super::predictor::Course;
use super::stats::quantile;
use crate::demonstration::Demonstration;

/// 90 % quantile of χ² with three degrees of freedom.
pub(crate) const CHI2_3_90: f64 = 6.251;

/// Variances and novelties below these are a sensor at rest, not precision: m², and none.
const LEAST_M2: f64 = 1e-8;
const LEAST_NOVELTY: f64 = 1.0;

/// Knots (from 1) by whose errors the parameters are chosen: 100 to 300 ms, where predictions are used.
const CHOSEN_BY: std::ops::RangeInclusive<usize> = 3..=9;

/// A scalar least-squares problem `min Σ|b − s·a|²`.
#[derive(Clone, Copy, Default)]
struct Slope {
    ab: f64,
    aa: f64,
}

impl Slope {
    fn add(&mut self, a: &Vector3<f64>, b: &Vector3<f64>, weight: f64) {
        self.ab += weight * a.dot(b);
        self.aa += weight * a.norm_squared();
    }

    /// The best s in [0, 1]; `otherwise` if there is nothing to go by.
    fn solve(&self, otherwise: f64) -> f64 {
        let s = self.ab / self.aa;
        if s.is_finite() {
            s.clamp(0.0, 1.0)
        } else {
            otherwise
        }
    }
}

/// The trials of one training.
pub(super) struct Trial<C> {
    course: PhantomData<C>,
    knots: usize,
    damping: f64,
    straight_m2: [f64; MAX_KNOTS],
    /// Σ|error of the mixture|² at each knot, and what holding makes of the same samples.
    mixture_m2: [[f64; 2]; MAX_KNOTS],
    /// Σ|truth|² at each knot, by which errors at different horizons are made comparable.
    moved_m2: [f64; MAX_KNOTS],
    trust: Slope,
    nees: Vec<Vec<f64>>,
    novelties: Vec<f64>,
}

impl<C: Course> Trial<C> {
    /// Tries constant velocity, which needs no training and so nothing held out.
    pub(super) fn straight(demonstrations: &[Demonstration], knots: usize) -> Self {
        let mut moved_m2 = [0.0; MAX_KNOTS];
        visit::<C>(demonstrations, knots, |j, _, truth| {
            moved_m2[j - 1] += truth.norm_squared();
        });
        let mut damping = Slope::default();
        visit::<C>(demonstrations, knots, |j, straight, truth| {
            if CHOSEN_BY.contains(&j) {
                damping.add(straight, truth, share(&moved_m2, j));
            }
        });
        let damping = damping.solve(Params::DEFAULT.cv_damping);
        let mut squared = [0.0; MAX_KNOTS];
        let mut count = [0_u32; MAX_KNOTS];
        visit::<C>(demonstrations, knots, |j, straight, truth| {
            squared[j - 1] += (straight * damping - truth).norm_squared();
            count[j - 1] += 1;
        });
        let mut straight_m2 = Calibration::UNTRIED.straight_m2;
        for ((v, sum), count) in straight_m2.iter_mut().zip(squared).zip(count) {
            if count > 0 {
                *v = (sum / (3.0 * f64::from(count))).max(LEAST_M2);
            }
        }
        Self {
            course: PhantomData,
            knots,
            damping,
            straight_m2,
            mixture_m2: [[0.0; 2]; MAX_KNOTS],
            moved_m2,
            trust: Slope::default(),
            nees: vec![Vec::new(); knots],
            novelties: Vec::new(),
        }
    }

    /// Tries a model on a demonstration it was not trained on.
    pub(super) fn hold_out(&mut self, model: &C::Model, d: &Demonstration) {
        let end_s = d.last().t_s + 1e-9;
        for (i, state) in C::states(d).iter().enumerate() {
            let p = C::posterior(model, state);
            self.novelties.push(p.novelty);
            let velocity = C::velocity(state) * self.damping;
            for j in 1..=self.knots {
                let h_s = j as f64 * KNOT_SPACING_S;
                if d.samples()[i].t_s + h_s > end_s {
                    break;
                }
                let truth = C::displacement(d, i, j);
                let e = p.displacement[j - 1] - truth;
                // A planar motion has no variance across its plane.
                let covariance = p.covariance[j - 1] + Matrix3::identity() * LEAST_M2;
                if let Some(c) = covariance.cholesky() {
                    self.nees[j - 1].push(e.dot(&c.solve(&e)));
                }
                self.mixture_m2[j - 1][0] += e.norm_squared();
                self.mixture_m2[j - 1][1] += truth.norm_squared();
                if CHOSEN_BY.contains(&j) {
                    let straight = velocity * h_s;
                    let apart = p.displacement[j - 1] - straight;
                    let weight = share(&self.moved_m2, j);
                    self.trust.add(&apart, &(truth - straight), weight);
                }
            }
        }
    }

    /// The mixture's squared error over that of holding, summed over the knots that count; 0 of none.
    pub(super) fn ratio(&self) -> f64 {
        let tried = CHOSEN_BY.filter_map(|j| self.mixture_m2.get(j - 1));
        let each = tried.filter(|[_, hold]| *hold > 0.0).map(|[e, hold]| e / hold);
        each.sum()
    }

    /// The share of the states tried whose novelty is above `limit`; 0 of none.
    pub(super) fn beyond(&self, limit: f64) -> f64 {
        let beyond = self.novelties.iter().filter(|n| **n > limit).count();
        beyond as f64 / self.novelties.len().max(1) as f64
    }

    /// `c_h = q₉₀(NEES)/6.251`; trust and damping by least squares.
    pub(super) fn calibration(self) -> Calibration {
        let mut c = Calibration::UNTRIED;
        c.straight_m2 = self.straight_m2;
        c.params.cv_damping = self.damping;
        c.params.trust = self.trust.solve(Params::DEFAULT.trust);
        if !self.novelties.is_empty() {
            c.novelty90 = quantile(self.novelties, 0.9).max(LEAST_NOVELTY);
        }
        for (factor, nees) in c.covariance.iter_mut().zip(self.nees) {
            if !nees.is_empty() {
                *factor = (quantile(nees, 0.9) / CHI2_3_90).max(f64::from(f32::MIN_POSITIVE));
            }
        }
        c
    }
}

/// The weight of an error at knot `j`: relative to how far the hand moves in that time.
fn share(moved_m2: &[f64; MAX_KNOTS], j: usize) -> f64 {
    1.0 / moved_m2[j - 1].max(LEAST_M2)
}

/// Calls `each(knot, undamped constant velocity, truth)` for every moment and knot.
fn visit<C: Course>(
    demonstrations: &[Demonstration],
    knots: usize,
    mut each: impl FnMut(usize, &Vector3<f64>, &Vector3<f64>),
) {
    for d in demonstrations {
        let end_s = d.last().t_s + 1e-9;
        for (i, state) in C::states(d).iter().enumerate() {
            let velocity = C::velocity(state);
            for j in 1..=knots {
                let h_s = j as f64 * KNOT_SPACING_S;
                if d.samples()[i].t_s + h_s > end_s {
                    break;
                }
                each(j, &(velocity * h_s), &C::displacement(d, i, j));
            }
        }
    }
}
