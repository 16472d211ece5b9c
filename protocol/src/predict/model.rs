//! Memory-feature Gaussian mixture regression: which displacements follow which features.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

use super::standard::Standardisation;
use super::state::{FEATURES, HandState};
use super::{Forecast, Generic, KNOT_SPACING_S, MAX_KNOTS, Params};
use crate::skill::MAX_COMPONENTS;
use crate::skill::gmm::{softmax, solve_lower};

/// Length of the target vector: a displacement for each knot.
pub const TARGETS: usize = 3 * MAX_KNOTS;

/// Entries of a symmetric 3×3 block, stored xx, xy, xz, yy, yz, zz.
pub const BLOCK: usize = 6;

/// The tempering exponent β of the responsibilities: neighbouring samples are not independent evidence.
pub const TEMPER: f64 = 0.5;

/// A component with less of the responsibility than this changes no prediction by a nanometre.
const NEGLIGIBLE: f64 = 1e-12;

/// Why numbers are not a predictor.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ModelError {
    /// No component, or more than the largest mixture may have.
    #[error("{found} predictor components, 1 to {MAX_COMPONENTS} are allowed")]
    Components {
        /// Components offered.
        found: usize,
    },
    /// No knot, or more than a forecast holds.
    #[error("{found} predictor knots, 1 to {MAX_KNOTS} are allowed")]
    Knots {
        /// Knots offered.
        found: usize,
    },
    /// A number is NaN or infinite.
    #[error("predictor: {field} is not finite")]
    NotFinite {
        /// Where.
        field: &'static str,
    },
    /// A number that must be greater than zero is not.
    #[error("predictor: {field} is not greater than zero")]
    NotPositive {
        /// Where.
        field: &'static str,
    },
    /// A number that must not be less than zero is.
    #[error("predictor: {field} is less than zero")]
    Negative {
        /// Where.
        field: &'static str,
    },
    /// Not one chart for each component.
    #[error("{found} charts for {expected} predictor components")]
    Charts {
        /// Charts offered.
        found: usize,
        /// Components.
        expected: usize,
    },
    /// A residual covariance has a negative variance.
    #[error("predictor component {component}: a residual variance is negative")]
    NegativeVariance {
        /// Index of the component.
        component: usize,
    },
}

/// One component: a Gaussian over the features and a linear regression from them to displacements.
#[derive(Debug, Clone, PartialEq)]
pub struct Regression {
    /// Share π of the mixture, > 0.
    pub weight: f64,
    /// Mean of the features, standardised.
    pub mean: SVector<f64, FEATURES>,
    /// Lower Cholesky factor of the features' covariance, standardised; positive diagonal.
    pub factor: SMatrix<f64, FEATURES, FEATURES>,
    /// Mean displacements, m, knot by knot; zero beyond the model's last knot.
    pub target: [f64; TARGETS],
    /// Displacement (m) per standardised feature: one row a feature.
    pub gain: [[f64; TARGETS]; FEATURES],
    /// Covariance of the displacement that the regression leaves, m², one symmetric block a knot.
    pub residual: [[f64; BLOCK]; MAX_KNOTS],
}

/// What the mixture says about the displacements from one state, before any blending.
#[derive(Debug, Clone, PartialEq)]
pub struct Posterior {
    /// Mean displacement at each knot, m.
    pub displacement: [Vector3<f64>; MAX_KNOTS],
    /// Its covariance at each knot, m², not calibrated.
    pub covariance: [Matrix3<f64>; MAX_KNOTS],
    /// Squared Mahalanobis distance of the features to the nearest component.
    pub novelty: f64,
}

/// What trying the predictor on motion it was not trained on has shown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Calibration {
    /// Factors c_h on the mixture's covariance, one a knot, > 0.
    pub covariance: [f64; MAX_KNOTS],
    /// Mean squared errors along one axis of mixture, generic extrapolator, straight line and holding, at each knot, m², > 0.
    pub errors: [[f64; 4]; MAX_KNOTS],
    /// The 90 % quantile of the novelty, > 0.
    pub novelty90: f64,
}

impl Calibration {
    /// What to assume before anything was tried: the covariance factor that three demonstrations of a Kinect gesture need
    /// at 300 ms, motion of 0.5 m/s along each axis that a straight line foretells no better than holding does, the
    /// extrapolator by 0.7 and the mixture by half of that; and the 90 % quantile of χ² with [`FEATURES`] degrees of freedom.
    pub const UNTRIED: Self = {
        let mut errors = [[0.0; 4]; MAX_KNOTS];
        let mut j = 0;
        while j < MAX_KNOTS {
            let way_m = 0.5 * (j + 1) as f64 * KNOT_SPACING_S;
            let hold = way_m * way_m;
            errors[j] = [0.25 * hold, 0.5 * hold, hold, hold];
            j += 1;
        }
        Self {
            covariance: [2.5; MAX_KNOTS],
            errors,
            novelty90: 22.307,
        }
    };
}

/// A learned predictor of at most 64 components and [`MAX_KNOTS`] knots, checked on construction.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    knots: usize,
    standardisation: Standardisation,
    components: Vec<Regression>,
    generic: Generic,
    /// ln π − Σ ln Lᵢᵢ of each component.
    log_scale: Vec<f64>,
    calibration: Calibration,
    /// log₂ of the steps its displacements are whole multiples of, if it was decoded.
    exponents: Option<[i8; MAX_KNOTS]>,
}

impl Model {
    /// Checks a predictor with `knots` knots; what its parts hold beyond them is not used.
    ///
    /// # Errors
    /// [`ModelError`], one variant a cause.
    pub fn new(
        knots: usize,
        standardisation: Standardisation,
        components: Vec<Regression>,
        generic: Generic,
        calibration: Calibration,
    ) -> Result<Self, ModelError> {
        if !(1..=MAX_KNOTS).contains(&knots) {
            return Err(ModelError::Knots { found: knots });
        }
        if !(1..=MAX_COMPONENTS).contains(&components.len()) {
            return Err(ModelError::Components {
                found: components.len(),
            });
        }
        finite("a feature mean", standardisation.mean.iter())?;
        positive("a feature scale", standardisation.scale.iter())?;
        not_negative("a bend", standardisation.bend.iter())?;
        let training = [standardisation.ridge, standardisation.shrinkage];
        not_negative("ridge or shrinkage", training.iter())?;
        positive("a covariance factor", calibration.covariance.iter())?;
        positive("a mean squared error", calibration.errors.iter().flatten())?;
        positive("the novelty quantile", [calibration.novelty90].iter())?;
        finite("a generic factor", generic.lead.iter().flatten())?;
        finite("a product of motion", generic.products.iter())?;
        positive(
            "a mean square of motion",
            [0, 2, 5, 9].map(|i| generic.products[i]).iter(),
        )?;
        let mut log_scale = Vec::with_capacity(components.len());
        for (component, c) in components.iter().enumerate() {
            positive("a weight", [c.weight].iter())?;
            finite("a component mean", c.mean.iter())?;
            finite("a factor", c.factor.iter())?;
            positive("a factor's diagonal", c.factor.diagonal().iter())?;
            finite("a mean displacement", c.target.iter())?;
            finite("a gain", c.gain.iter().flatten())?;
            finite("a residual covariance", c.residual.iter().flatten())?;
            if c.residual
                .iter()
                .any(|v| [v[0], v[3], v[5]].iter().any(|&d| d < 0.0))
            {
                return Err(ModelError::NegativeVariance { component });
            }
            let log_det: f64 = c.factor.diagonal().iter().map(|&d| libm::log(d)).sum();
            log_scale.push(libm::log(c.weight) - log_det);
        }
        Ok(Self {
            knots,
            standardisation,
            components,
            generic,
            log_scale,
            calibration,
            exponents: None,
        })
    }

    /// The same model, known to be in these steps: encoding it again rounds nothing.
    pub(crate) fn in_steps(self, exponents: [i8; MAX_KNOTS]) -> Self {
        Self {
            exponents: Some(exponents),
            ..self
        }
    }

    pub(crate) fn exponents(&self) -> Option<&[i8; MAX_KNOTS]> {
        self.exponents.as_ref()
    }

    /// Number of knots J; the last is J·[`KNOT_SPACING_S`] ahead.
    pub fn knots(&self) -> usize {
        self.knots
    }

    /// How features become standardised ones.
    pub fn standardisation(&self) -> &Standardisation {
        &self.standardisation
    }

    /// The components, at least one.
    pub fn components(&self) -> &[Regression] {
        &self.components
    }

    /// The factors of the generic extrapolator.
    pub fn generic(&self) -> &Generic {
        &self.generic
    }

    /// What held-out motion has shown.
    pub fn calibration(&self) -> &Calibration {
        &self.calibration
    }

    /// Predicts from `state` by this mixture, and by the other experts where the motion is new.
    ///
    /// A pure function; allocates nothing.
    pub fn forecast(&self, state: &HandState, params: &Params) -> Forecast {
        Forecast::fused(state, &Forecast::experts(state, Some(self)), params)
    }

    /// Conditions the mixture on the state's features.
    ///
    /// `l_k = ln π_k − ½‖L_k⁻¹(f−μ_f)‖² − Σ ln diag L_k; r_k ∝ exp(β·l_k); y_k = μ_y + B_kᵀ(f−μ_f);
    /// d = Σ r_k y_k; V = Σ r_k [V_k + (y_k−d)(y_k−d)ᵀ]`
    pub fn posterior(&self, state: &HandState) -> Posterior {
        self.posterior_at(&state.features())
    }

    /// The same from the features themselves, m.
    pub fn posterior_at(&self, features: &SVector<f64, FEATURES>) -> Posterior {
        let bent = self.standardisation.bent(*features);
        self.posterior_of(|_| bent)
    }

    /// The same from the bent features (m or rad) that each component, by index, is given.
    pub(super) fn posterior_of(
        &self,
        mut features: impl FnMut(usize) -> SVector<f64, FEATURES>,
    ) -> Posterior {
        let mut standardised = |k| self.standardisation.scaled(&features(k));
        let mut shares = [0.0; MAX_COMPONENTS];
        let shares = &mut shares[..self.components.len()];
        let mut novelty = f64::INFINITY;
        for (k, (l, c)) in shares.iter_mut().zip(&self.components).enumerate() {
            let mut e = standardised(k) - c.mean;
            solve_lower(&c.factor, &mut e);
            let d2 = e.norm_squared();
            novelty = novelty.min(d2);
            *l = TEMPER * (self.log_scale[k] - 0.5 * d2);
        }
        if softmax(shares) == f64::NEG_INFINITY {
            let alike = 1.0 / shares.len() as f64;
            shares.fill(alike);
        }

        // Weighted mean and spread in one pass (West 1979): no room for every y_k, no E[y²] − d².
        let mut mean = [0.0; TARGETS];
        let mut spread = [[0.0; BLOCK]; MAX_KNOTS];
        let mut total = 0.0;
        for (k, (&r, c)) in shares.iter().zip(&self.components).enumerate() {
            if r < NEGLIGIBLE {
                continue;
            }
            total += r;
            let share = r / total;
            let mut delta = c.target;
            let e = standardised(k) - c.mean;
            for (row, e) in c.gain.iter().zip(e.iter()) {
                for (y, b) in delta.iter_mut().zip(row) {
                    *y += b * e;
                }
            }
            for (y, m) in delta.iter_mut().zip(&mut mean) {
                *y -= *m;
                *m += share * *y;
            }
            let between = r * (1.0 - share);
            for ((s, v), d) in spread
                .iter_mut()
                .zip(&c.residual)
                .zip(delta.chunks_exact(3))
            {
                let (x, y, z) = (d[0], d[1], d[2]);
                let outer = [x * x, x * y, x * z, y * y, y * z, z * z];
                for ((s, v), o) in s.iter_mut().zip(v).zip(outer) {
                    *s += r * v + between * o;
                }
            }
        }
        Posterior {
            displacement: core::array::from_fn(|j| {
                Vector3::new(mean[3 * j], mean[3 * j + 1], mean[3 * j + 2])
            }),
            covariance: core::array::from_fn(|j| {
                let [xx, xy, xz, yy, yz, zz] = spread[j];
                Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz) / total
            }),
            novelty,
        }
    }
}

fn finite<'a>(
    field: &'static str,
    mut values: impl Iterator<Item = &'a f64>,
) -> Result<(), ModelError> {
    if values.all(|v| v.is_finite()) {
        Ok(())
    } else {
        Err(ModelError::NotFinite { field })
    }
}

fn not_negative<'a>(
    field: &'static str,
    mut values: impl Iterator<Item = &'a f64> + Clone,
) -> Result<(), ModelError> {
    finite(field, values.clone())?;
    if values.all(|&v| v >= 0.0) {
        Ok(())
    } else {
        Err(ModelError::Negative { field })
    }
}

fn positive<'a>(
    field: &'static str,
    mut values: impl Iterator<Item = &'a f64> + Clone,
) -> Result<(), ModelError> {
    finite(field, values.clone())?;
    if values.all(|&v| v > 0.0) {
        Ok(())
    } else {
        Err(ModelError::NotPositive { field })
    }
}
