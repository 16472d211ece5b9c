//! A Gaussian mixture whose every component is known to be a distribution.

use nalgebra::{SMatrix, SVector};

/// The largest number of components a mixture may have; bounds the stack a query needs.
pub const MAX_COMPONENTS: usize = 64;

/// Half of ln 2π.
const HALF_LN_TAU: f64 = 0.918_938_533_204_672_8;

/// A pivot below this share of its own variance is rounding, not information.
const LEAST_PIVOT: f64 = 1e-13;

/// Why numbers are not a Gaussian mixture.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum GmmError {
    /// No component at all.
    #[error("a mixture needs at least one component")]
    Empty,
    /// More than [`MAX_COMPONENTS`].
    #[error("{found} components, at most {MAX_COMPONENTS} are allowed")]
    TooMany {
        /// Components offered.
        found: usize,
    },
    /// A mean or covariance entry is NaN or infinite.
    #[error("component {component}: a mean or covariance entry is not finite")]
    NotFinite {
        /// Index of the component.
        component: usize,
    },
    /// A weight outside (0, 1].
    #[error("component {component}: weight {weight} is not in (0, 1]")]
    Weight {
        /// Index of the component.
        component: usize,
        /// Its weight.
        weight: f64,
    },
    /// The weights do not add up to one.
    #[error("the weights sum to {sum}, not to 1")]
    WeightSum {
        /// Their sum.
        sum: f64,
    },
    /// A covariance is not symmetric.
    #[error("component {component}: the covariance is not symmetric")]
    NotSymmetric {
        /// Index of the component.
        component: usize,
    },
    /// A covariance is singular to working precision, or has a negative direction.
    #[error("component {component}: the covariance is not positive definite")]
    NotPositiveDefinite {
        /// Index of the component.
        component: usize,
    },
}

/// One weighted Gaussian of a [`Gmm`], its Cholesky factor kept.
#[derive(Debug, Clone, PartialEq)]
pub struct Component<const D: usize> {
    weight: f64,
    mean: SVector<f64, D>,
    covariance: SMatrix<f64, D, D>,
    factor: SMatrix<f64, D, D>,
    /// ln π − Σ ln Lᵢᵢ − D/2·ln 2π: all of the log density that does not depend on the point.
    log_scale: f64,
}

impl<const D: usize> Component<D> {
    fn new(
        component: usize,
        weight: f64,
        mean: SVector<f64, D>,
        covariance: SMatrix<f64, D, D>,
    ) -> Result<Self, GmmError> {
        if !(weight > 0.0 && weight <= 1.0) {
            return Err(GmmError::Weight { component, weight });
        }
        if !mean.iter().chain(covariance.iter()).all(|v| v.is_finite()) {
            return Err(GmmError::NotFinite { component });
        }
        for i in 0..D {
            for j in 0..i {
                let (a, b) = (covariance[(i, j)], covariance[(j, i)]);
                if (a - b).abs() > 1e-9 * (covariance[(i, i)].abs() + covariance[(j, j)].abs()) {
                    return Err(GmmError::NotSymmetric { component });
                }
            }
        }
        let covariance = (covariance + covariance.transpose()) * 0.5;
        let factor = cholesky(&covariance).ok_or(GmmError::NotPositiveDefinite { component })?;
        let log_det: f64 = (0..D).map(|i| libm::log(factor[(i, i)])).sum();
        Ok(Self {
            weight,
            mean,
            covariance,
            factor,
            log_scale: libm::log(weight) - log_det - D as f64 * HALF_LN_TAU,
        })
    }

    /// The component's share π of the mixture, in (0, 1].
    pub fn weight(&self) -> f64 {
        self.weight
    }

    /// Its mean, in the data's units.
    pub fn mean(&self) -> &SVector<f64, D> {
        &self.mean
    }

    /// Its covariance, in the data's units squared; exactly symmetric.
    pub fn covariance(&self) -> &SMatrix<f64, D, D> {
        &self.covariance
    }

    /// The lower Cholesky factor L of the covariance; the upper triangle is zero.
    pub fn factor(&self) -> &SMatrix<f64, D, D> {
        &self.factor
    }

    /// ln(π·N(x; μ, Σ)); −∞ where the density underflows even in the log domain or `x` is not finite.
    pub fn weighted_log_density(&self, x: &SVector<f64, D>) -> f64 {
        let mut e = x - self.mean;
        solve_lower(&self.factor, &mut e);
        let l = self.log_scale - 0.5 * e.norm_squared();
        if l.is_nan() { f64::NEG_INFINITY } else { l }
    }
}

/// A mixture of at most [`MAX_COMPONENTS`] Gaussians over ℝᴰ, checked on construction.
#[derive(Debug, Clone, PartialEq)]
pub struct Gmm<const D: usize> {
    components: Vec<Component<D>>,
}

impl<const D: usize> Gmm<D> {
    /// Checks and factors a mixture given as (weight, mean, covariance).
    ///
    /// The numbers are kept as they are, apart from symmetrising the covariances: encoding what was
    /// decoded gives the same bytes.
    ///
    /// # Errors
    /// [`GmmError`], one variant a cause. The weights may miss 1 by 1e-6, the rounding of a file.
    pub fn new(
        parts: impl IntoIterator<Item = (f64, SVector<f64, D>, SMatrix<f64, D, D>)>,
    ) -> Result<Self, GmmError> {
        let components = parts
            .into_iter()
            .enumerate()
            .map(|(k, (weight, mean, covariance))| Component::new(k, weight, mean, covariance))
            .collect::<Result<Vec<_>, _>>()?;
        if components.is_empty() {
            return Err(GmmError::Empty);
        }
        if components.len() > MAX_COMPONENTS {
            return Err(GmmError::TooMany {
                found: components.len(),
            });
        }
        let sum: f64 = components.iter().map(|c| c.weight).sum();
        if (sum - 1.0).abs() > 1e-6 {
            return Err(GmmError::WeightSum { sum });
        }
        Ok(Self { components })
    }

    /// The components, at least one.
    pub fn components(&self) -> &[Component<D>] {
        &self.components
    }

    /// ln p(x), by log-sum-exp; −∞ far from every component or for a point that is not finite, never NaN.
    pub fn log_density(&self, x: &SVector<f64, D>) -> f64 {
        let mut l = [f64::NEG_INFINITY; MAX_COMPONENTS];
        self.responsibilities(x, &mut l)
    }

    /// Writes p(k | x) into the first entries of `out`, one a component, and returns ln p(x).
    ///
    /// Where ln p(x) is −∞ the point says nothing about its component: the weights are written.
    ///
    /// # Panics
    /// If `out` is shorter than the number of components.
    pub fn responsibilities(&self, x: &SVector<f64, D>, out: &mut [f64]) -> f64 {
        let out = &mut out[..self.components.len()];
        for (l, c) in out.iter_mut().zip(&self.components) {
            *l = c.weighted_log_density(x);
        }
        let total = softmax(out);
        if total == f64::NEG_INFINITY {
            for (r, c) in out.iter_mut().zip(&self.components) {
                *r = c.weight;
            }
        }
        total
    }
}

/// Turns logarithms into shares that sum to one and returns ln Σ exp; all −∞ are left as they are.
pub(crate) fn softmax(l: &mut [f64]) -> f64 {
    let max = l.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if max == f64::NEG_INFINITY {
        return max;
    }
    let mut sum = 0.0;
    for v in l.iter_mut() {
        *v = libm::exp(*v - max);
        sum += *v;
    }
    for v in l.iter_mut() {
        *v /= sum;
    }
    max + libm::log(sum)
}

/// The lower Cholesky factor, or `None` if a pivot is not clearly positive against its own variance
/// (nalgebra's factorisation accepts any pivot above zero, however little of it is left).
pub(crate) fn cholesky<const D: usize>(a: &SMatrix<f64, D, D>) -> Option<SMatrix<f64, D, D>> {
    let mut l = SMatrix::<f64, D, D>::zeros();
    for j in 0..D {
        let mut pivot = a[(j, j)];
        for k in 0..j {
            pivot -= l[(j, k)] * l[(j, k)];
        }
        // Written so that NaN fails too.
        let clear = pivot > LEAST_PIVOT * a[(j, j)] && pivot > f64::MIN_POSITIVE;
        if !clear || !pivot.is_finite() {
            return None;
        }
        let root = pivot.sqrt();
        l[(j, j)] = root;
        for i in j + 1..D {
            let mut s = a[(i, j)];
            for k in 0..j {
                s -= l[(i, k)] * l[(j, k)];
            }
            l[(i, j)] = s / root;
        }
    }
    Some(l)
}

/// x ← L⁻¹x by forward substitution, down the columns so that the inner loop is contiguous.
pub(crate) fn solve_lower<const D: usize>(l: &SMatrix<f64, D, D>, x: &mut SVector<f64, D>) {
    for j in 0..D {
        let v = x[j] / l[(j, j)];
        x[j] = v;
        for i in j + 1..D {
            x[i] -= l[(i, j)] * v;
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix2, Vector2};

    use super::*;

    fn two() -> Gmm<2> {
        Gmm::new([
            (0.25, Vector2::new(-1.0, 0.0), Matrix2::identity() * 0.5),
            (
                0.75,
                Vector2::new(2.0, 1.0),
                Matrix2::new(1.0, 0.3, 0.3, 2.0),
            ),
        ])
        .unwrap()
    }

    #[test]
    fn the_density_far_away_is_minus_infinity_and_never_nan() {
        let mut r = [0.0; 2];
        for x in [1e200, f64::INFINITY, f64::NAN] {
            let l = two().responsibilities(&Vector2::new(x, 0.0), &mut r);
            assert_eq!(l, f64::NEG_INFINITY);
            assert_eq!(r, [0.25, 0.75]);
        }
        let l = two().responsibilities(&Vector2::new(1e6, -1e6), &mut r);
        assert!(
            l.is_finite() && (r[0] + r[1] - 1.0).abs() < 1e-15,
            "{l} {r:?}"
        );
    }

    #[test]
    fn each_fault_has_its_own_error() {
        let (m, c) = (Vector2::zeros(), Matrix2::identity());
        let one = |w, m, c| Gmm::<2>::new([(w, m, c)]).unwrap_err();
        assert_eq!(Gmm::<2>::new([]), Err(GmmError::Empty));
        assert_eq!(
            Gmm::new(vec![(1.0 / 65.0, m, c); 65]),
            Err(GmmError::TooMany { found: 65 })
        );
        assert!(matches!(one(0.0, m, c), GmmError::Weight { .. }));
        assert!(matches!(one(f64::NAN, m, c), GmmError::Weight { .. }));
        assert!(matches!(one(0.5, m, c), GmmError::WeightSum { .. }));
        assert!(matches!(
            one(1.0, Vector2::new(f64::NAN, 0.0), c),
            GmmError::NotFinite { component: 0 }
        ));
        assert!(matches!(
            one(1.0, m, Matrix2::new(1.0, 0.5, 0.4, 1.0)),
            GmmError::NotSymmetric { .. }
        ));
        for singular in [
            Matrix2::new(1.0, 1.0, 1.0, 1.0),
            Matrix2::new(1.0, 2.0, 2.0, 1.0),
            Matrix2::zeros(),
            Matrix2::new(1e-6, 1e-6, 1e-6, 1e-6 * (1.0 + 1e-15)),
        ] {
            assert_eq!(
                one(1.0, m, singular),
                GmmError::NotPositiveDefinite { component: 0 }
            );
        }
    }

    #[test]
    fn millimetres_are_not_mistaken_for_singular() {
        let c = Matrix2::new(1e-10, 0.5e-10, 0.5e-10, 1e-10);
        assert!(Gmm::new([(1.0, Vector2::zeros(), c)]).is_ok());
    }
}
