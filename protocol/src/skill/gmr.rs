//! Gaussian mixture regression: what some coordinates say about the others.
//! Calinon 2016, "A tutorial on task-parameterized movement learning and retrieval", eq. (13)–(15).

use nalgebra::{SMatrix, SVector};

use super::gmm::{Gmm, MAX_COMPONENTS, cholesky, softmax, solve_lower};

/// Why a mixture cannot be conditioned as asked.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum GmrError {
    /// A given coordinate is beyond the mixture's dimension.
    #[error("coordinate {index} is given, the mixture has {dimensions}")]
    OutOfRange {
        /// The coordinate.
        index: usize,
        /// The mixture's dimension.
        dimensions: usize,
    },
    /// A coordinate is given twice.
    #[error("coordinate {index} is given twice")]
    Repeated {
        /// The coordinate.
        index: usize,
    },
    /// The given block of a covariance is singular to working precision.
    #[error("component {component}: the given block of the covariance is singular")]
    Singular {
        /// Index of the component.
        component: usize,
    },
}

/// One component, conditioned: y = μ_y + A·(x − μ_x) with covariance Σ, weighted by its density at x.
#[derive(Debug, Clone)]
struct Conditional<const I: usize, const O: usize> {
    log_scale: f64,
    mean_in: SVector<f64, I>,
    factor_in: SMatrix<f64, I, I>,
    mean_out: SVector<f64, O>,
    gain: SMatrix<f64, O, I>,
    covariance: SMatrix<f64, O, O>,
}

/// The regression of `O` coordinates on `I` others, everything that does not depend on the query computed.
#[derive(Debug, Clone)]
pub struct Gmr<const I: usize, const O: usize> {
    components: Vec<Conditional<I, O>>,
}

/// The answer of a [`Gmr`] query: mean and covariance of the mixture of conditionals.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Regressed<const O: usize> {
    /// Mean, in the data's units.
    pub mean: SVector<f64, O>,
    /// Covariance (law of total covariance), exactly symmetric.
    pub covariance: SMatrix<f64, O, O>,
}

impl<const I: usize, const O: usize> Gmr<I, O> {
    /// Conditions on the first `I` coordinates. `I + O == D` is checked at compile time.
    ///
    /// # Errors
    /// [`GmrError::Singular`], which a valid mixture shows only at the edge of the working precision.
    pub fn new<const D: usize>(gmm: &Gmm<D>) -> Result<Self, GmrError> {
        Self::with_given(gmm, core::array::from_fn(|i| i))
    }

    /// Conditions on the coordinates `given`, in that order; the answer holds the others, ascending.
    ///
    /// # Errors
    /// [`GmrError`]: a coordinate out of range or repeated, or a singular block.
    pub fn with_given<const D: usize>(gmm: &Gmm<D>, given: [usize; I]) -> Result<Self, GmrError> {
        const {
            assert!(
                I + O == D,
                "inputs and outputs together are the mixture's coordinates"
            )
        };
        let mut is_given = [false; D];
        for index in given {
            let seen = is_given.get_mut(index).ok_or(GmrError::OutOfRange {
                index,
                dimensions: D,
            })?;
            if core::mem::replace(seen, true) {
                return Err(GmrError::Repeated { index });
            }
        }
        let mut wanted = [0; O];
        let others = (0..D).filter(|&i| !is_given[i]);
        wanted.iter_mut().zip(others).for_each(|(w, i)| *w = i);

        let components = gmm
            .components()
            .iter()
            .enumerate()
            .map(|(component, c)| {
                let s = c.covariance();
                let s_ii = SMatrix::<f64, I, I>::from_fn(|a, b| s[(given[a], given[b])]);
                let s_io = SMatrix::<f64, I, O>::from_fn(|a, b| s[(given[a], wanted[b])]);
                let s_oo = SMatrix::<f64, O, O>::from_fn(|a, b| s[(wanted[a], wanted[b])]);
                let factor_in = cholesky(&s_ii).ok_or(GmrError::Singular { component })?;
                // With W = L⁻¹Σ_io: A = WᵀL⁻¹ and Σ_oo − AΣ_io = Σ_oo − WᵀW, symmetric by construction.
                let mut w = s_io;
                for b in 0..O {
                    let mut column = w.column(b).into_owned();
                    solve_lower(&factor_in, &mut column);
                    w.set_column(b, &column);
                }
                let mut gain = SMatrix::<f64, O, I>::zeros();
                for b in 0..O {
                    let row = solve_lower_transposed(&factor_in, w.column(b).into_owned());
                    gain.set_row(b, &row.transpose());
                }
                let log_det: f64 = (0..I).map(|i| libm::log(factor_in[(i, i)])).sum();
                Ok(Conditional {
                    log_scale: libm::log(c.weight()) - log_det,
                    mean_in: SVector::from_fn(|a, _| c.mean()[given[a]]),
                    factor_in,
                    mean_out: SVector::from_fn(|a, _| c.mean()[wanted[a]]),
                    gain,
                    covariance: s_oo - w.transpose() * w,
                })
            })
            .collect::<Result<_, _>>()?;
        Ok(Self { components })
    }

    /// Mean and covariance of the outputs at `x`. No allocation.
    ///
    /// Far from every component the regression continues the nearest one linearly; where even the
    /// log densities underflow (or `x` is not finite) all components count alike.
    pub fn query(&self, x: &SVector<f64, I>) -> Regressed<O> {
        let mut shares = [0.0; MAX_COMPONENTS];
        let shares = &mut shares[..self.components.len()];
        for (l, c) in shares.iter_mut().zip(&self.components) {
            let mut e = x - c.mean_in;
            solve_lower(&c.factor_in, &mut e);
            let log_density = c.log_scale - 0.5 * e.norm_squared();
            *l = if log_density.is_nan() {
                f64::NEG_INFINITY
            } else {
                log_density
            };
        }
        if softmax(shares) == f64::NEG_INFINITY {
            let alike = 1.0 / shares.len() as f64;
            shares.fill(alike);
        }
        let mut mean = SVector::zeros();
        for (h, c) in shares.iter().zip(&self.components) {
            mean += c.predict(x) * *h;
        }
        // Σ h(Σₖ + μₖμₖᵀ) − μμᵀ in its centred form, which cannot cancel.
        let mut covariance = SMatrix::zeros();
        for (h, c) in shares.iter().zip(&self.components) {
            let d = c.predict(x) - mean;
            covariance += (c.covariance + d * d.transpose()) * *h;
        }
        Regressed {
            mean,
            covariance: (covariance + covariance.transpose()) * 0.5,
        }
    }
}

impl<const I: usize, const O: usize> Conditional<I, O> {
    fn predict(&self, x: &SVector<f64, I>) -> SVector<f64, O> {
        self.mean_out + self.gain * (x - self.mean_in)
    }
}

/// L⁻ᵀx by back substitution.
pub(crate) fn solve_lower_transposed<const D: usize>(
    l: &SMatrix<f64, D, D>,
    mut x: SVector<f64, D>,
) -> SVector<f64, D> {
    for j in (0..D).rev() {
        for i in j + 1..D {
            x[j] -= l[(i, j)] * x[i];
        }
        x[j] /= l[(j, j)];
    }
    x
}
