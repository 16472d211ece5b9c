//! Gaussian mixture regression: what some coordinates say about the others.
//! Calinon 2016, "A tutorial on task-parameterized movement learning and retrieval", eq. (13)–(15).
//!
//! What is given may be time, any coordinates, or phase: a motion's mixture is over time from 0 to its duration
//! T, so phase φ is given as φT, and a performance that takes T′ moves at the slope times T/T′.

use nalgebra::{SMatrix, SVector};

use super::confidence;
use super::gmm::{Gmm, MAX_COMPONENTS, cholesky, softmax, solve_lower};

/// Why a mixture cannot be conditioned as asked.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum GmrError {
    /// A coordinate is beyond the mixture's dimension.
    #[error("coordinate {index} is asked for, the mixture has {dimensions}, counted from 0")]
    OutOfRange {
        /// The coordinate.
        index: usize,
        /// The mixture's dimension.
        dimensions: usize,
    },
    /// A coordinate is named twice, as given or as wanted.
    #[error("coordinate {index} is named twice")]
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

/// A [`Regressed`] answer and how its mean changes with what was given.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moving<const I: usize, const O: usize> {
    /// Mean and covariance.
    pub at: Regressed<O>,
    /// ∂mean/∂given: given time in s and wanted positions in m, the velocity in m/s.
    pub slope: SMatrix<f64, O, I>,
}

impl<const I: usize, const O: usize> Moving<I, O> {
    /// How fast the mean moves while the given coordinates change at `rate` (their units a second).
    pub fn velocity(&self, rate: &SVector<f64, I>) -> SVector<f64, O> {
        self.slope * rate
    }
}

impl<const O: usize> Regressed<O> {
    /// The squared Mahalanobis distance of `y` from the mean, in deviations; `None` if the covariance is
    /// singular to working precision or `y` not finite. `y` lies in the region of confidence p if this is at
    /// most [`chi_squared_quantile`](super::chi_squared_quantile)`(p, O)`: with as many degrees of freedom as
    /// there are coordinates.
    pub fn distance2(&self, y: &SVector<f64, O>) -> Option<f64> {
        let factor = cholesky(&self.covariance)?;
        let mut e = y - self.mean;
        solve_lower(&factor, &mut e);
        let distance2 = e.norm_squared();
        distance2.is_finite().then_some(distance2)
    }

    /// The semi-axes of the ellipsoid of squared radius `radius2` (deviations²), one a column, longest first,
    /// in the data's units; each points to where its largest entry is positive.
    pub fn axes(&self, radius2: f64) -> SMatrix<f64, O, O> {
        confidence::axes(&self.covariance, radius2)
    }

    /// How far the ellipsoid of squared radius `radius2` reaches to either side along each coordinate, in the
    /// data's units. With the quantile for *one* degree of freedom it is each coordinate's own interval.
    pub fn half_widths(&self, radius2: f64) -> SVector<f64, O> {
        SVector::from_fn(|i, _| (radius2 * self.covariance[(i, i)]).sqrt())
    }
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
        let mut wanted = [0; O];
        let others = (0..D).filter(|i| !given.contains(i));
        wanted.iter_mut().zip(others).for_each(|(w, i)| *w = i);
        Self::between(gmm, given, wanted)
    }

    /// Conditions on the coordinates `given`, in that order, for the coordinates `wanted`, in that order; what
    /// is neither is left open (integrated out). With nothing given, the mixture's own mean and covariance.
    ///
    /// # Errors
    /// [`GmrError`]: a coordinate out of range or named twice, or a singular block.
    pub fn between<const D: usize>(
        gmm: &Gmm<D>,
        given: [usize; I],
        wanted: [usize; O],
    ) -> Result<Self, GmrError> {
        let mut named = [false; D];
        for index in given.into_iter().chain(wanted) {
            let seen = named.get_mut(index).ok_or(GmrError::OutOfRange {
                index,
                dimensions: D,
            })?;
            if core::mem::replace(seen, true) {
                return Err(GmrError::Repeated { index });
            }
        }

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
        self.shares(x, shares);
        self.combine(x, shares)
    }

    /// As [`query`](Self::query) for every one of `xs`, into the caller's buffer. No allocation.
    ///
    /// # Panics
    /// If `out` is not as long as `xs`.
    pub fn query_into(&self, xs: &[SVector<f64, I>], out: &mut [Regressed<O>]) {
        assert_eq!(xs.len(), out.len(), "one answer a query");
        for (x, answer) in xs.iter().zip(out) {
            *answer = self.query(x);
        }
    }

    /// As [`query`](Self::query), and the exact derivative of the mean by what is given. No allocation.
    pub fn query_moving(&self, x: &SVector<f64, I>) -> Moving<I, O> {
        let mut shares = [0.0; MAX_COMPONENTS];
        let shares = &mut shares[..self.components.len()];
        let informed = self.shares(x, shares);
        let at = self.combine(x, shares);
        let mut slope = SMatrix::zeros();
        for (h, c) in shares.iter().zip(&self.components) {
            slope += c.gain * *h;
            // h′ₖ = hₖ(gₖ − Σ hⱼgⱼ) with g = ∇ ln N; Σ hₖ(μₖ − μ) = 0 drops the sum. Where h underflows, g may
            // be anything.
            if informed && *h > 0.0 {
                let g = c.log_density_gradient(x);
                slope += (c.predict(x) - at.mean) * g.transpose() * *h;
            }
        }
        Moving { at, slope }
    }

    /// Writes each component's responsibility for `x`, and says whether `x` decided them.
    fn shares(&self, x: &SVector<f64, I>, shares: &mut [f64]) -> bool {
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
        let informed = softmax(shares) > f64::NEG_INFINITY;
        if !informed {
            let alike = 1.0 / shares.len() as f64;
            shares.fill(alike);
        }
        informed
    }

    fn combine(&self, x: &SVector<f64, I>, shares: &[f64]) -> Regressed<O> {
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

    /// −Σ⁻¹(x − μ), of the given block.
    fn log_density_gradient(&self, x: &SVector<f64, I>) -> SVector<f64, I> {
        let mut e = self.mean_in - x;
        solve_lower(&self.factor_in, &mut e);
        solve_lower_transposed(&self.factor_in, e)
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
