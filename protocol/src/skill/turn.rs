//! A mixture over time and orientation, and its regression over time, on the manifold of rotations.
//! Zeestraten et al. 2017, "An approach for imitation learning on Riemannian manifolds", §III.

use nalgebra::{Matrix3, UnitQuaternion, Vector3, Vector4};

use super::gmm::{Gmm, MAX_COMPONENTS, softmax};
use crate::pose;

/// Half of ln 2π.
const HALF_LN_TAU: f64 = 0.918_938_533_204_672_8;

/// Why numbers are not a mixture over orientations.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum TurnError {
    /// Not one chart for each component.
    #[error("{found} orientations for {expected} components")]
    Charts {
        /// Charts offered.
        found: usize,
        /// Components.
        expected: usize,
    },
    /// A component's mean lies elsewhere than its chart.
    #[error("component {component}: its mean orientation is not its chart")]
    OffCentre {
        /// Index of the component.
        component: usize,
    },
    /// A chart is not a unit quaternion.
    #[error("component {component}: not a rotation")]
    NotARotation {
        /// Index of the component.
        component: usize,
    },
}

/// A mixture over (t s, orientation): component k is Gaussian over (t, log(M_k⁻¹·q) rad) with mean
/// (t_k, 0), in the tangent space at its own mean orientation M_k.
#[derive(Debug, Clone, PartialEq)]
pub struct TurnMixture {
    gmm: Gmm<4>,
    charts: Vec<UnitQuaternion<f64>>,
}

/// The answer of a [`TurnMixture`] query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RegressedTurn {
    /// Mean orientation.
    pub mean: UnitQuaternion<f64>,
    /// Covariance in the tangent space there (its own axes), rad².
    pub covariance: Matrix3<f64>,
}

impl TurnMixture {
    /// `gmm` over (t, rotation vector) with `charts`, one a component.
    ///
    /// # Errors
    /// [`TurnError`], one variant a cause.
    pub fn new(gmm: Gmm<4>, charts: Vec<UnitQuaternion<f64>>) -> Result<Self, TurnError> {
        if charts.len() != gmm.components().len() {
            return Err(TurnError::Charts {
                found: charts.len(),
                expected: gmm.components().len(),
            });
        }
        for (component, (c, chart)) in gmm.components().iter().zip(&charts).enumerate() {
            if c.mean().fixed_rows::<3>(1).iter().any(|v| *v != 0.0) {
                return Err(TurnError::OffCentre { component });
            }
            // Written so that NaN fails too.
            if !((chart.coords.norm_squared() - 1.0).abs() < 1e-6) {
                return Err(TurnError::NotARotation { component });
            }
        }
        Ok(Self { gmm, charts })
    }

    /// The Gaussians in their tangent spaces.
    pub fn gmm(&self) -> &Gmm<4> {
        &self.gmm
    }

    /// The mean orientations M_k.
    pub fn charts(&self) -> &[UnitQuaternion<f64>] {
        &self.charts
    }

    /// Writes p(k | t, q) into the first entries of `out` and returns ln p(t, q); as
    /// [`Gmm::responsibilities`].
    ///
    /// # Panics
    /// If `out` is shorter than the number of components.
    pub fn responsibilities(&self, t_s: f64, q: &UnitQuaternion<f64>, out: &mut [f64]) -> f64 {
        let components = self.gmm.components();
        let out = &mut out[..components.len()];
        for ((l, c), chart) in out.iter_mut().zip(components).zip(&self.charts) {
            let v = pose::between(chart, q);
            *l = c.weighted_log_density(&Vector4::new(t_s, v.x, v.y, v.z));
        }
        let total = softmax(out);
        if total == f64::NEG_INFINITY {
            for (r, c) in out.iter_mut().zip(components) {
                *r = c.weight();
            }
        }
        total
    }

    /// Mean and covariance of the orientation at `t_s`. No allocation.
    ///
    /// Far from every component the regression goes on turning as the nearest one does; where `t_s` is not
    /// finite all components count alike.
    ///
    /// `q_k = M_k·exp(Σ_qt Σ_tt⁻¹ (t − t_k))`; the mean is the intrinsic one of the q_k, and each
    /// conditional covariance is carried to it by parallel transport.
    pub fn query(&self, t_s: f64) -> RegressedTurn {
        let components = self.gmm.components();
        let mut shares = [0.0; MAX_COMPONENTS];
        let shares = &mut shares[..components.len()];
        let mut turned = [UnitQuaternion::identity(); MAX_COMPONENTS];
        let turned = &mut turned[..components.len()];
        for (((l, q), c), chart) in shares
            .iter_mut()
            .zip(turned.iter_mut())
            .zip(components)
            .zip(&self.charts)
        {
            let (e, variance) = (t_s - c.mean()[0], c.covariance()[(0, 0)]);
            let log_density = libm::log(c.weight())
                - 0.5 * (e * e / variance + libm::log(variance))
                - HALF_LN_TAU;
            *l = if log_density.is_nan() {
                f64::NEG_INFINITY
            } else {
                log_density
            };
            *q = if e.is_finite() {
                pose::moved(chart, &(gain(c.covariance()) * e))
            } else {
                *chart
            };
        }
        if softmax(shares) == f64::NEG_INFINITY {
            let alike = 1.0 / shares.len() as f64;
            shares.fill(alike);
        }
        let mean = pose::mean(shares.iter().copied().zip(turned.iter().copied()))
            .unwrap_or(self.charts[0]);
        let mut covariance = Matrix3::zeros();
        for (((h, q), c), chart) in shares
            .iter()
            .zip(turned.iter())
            .zip(components)
            .zip(&self.charts)
        {
            let s = c.covariance();
            let conditional: Matrix3<f64> =
                s.fixed_view::<3, 3>(1, 1) - gain(s) * s.fixed_view::<1, 3>(0, 1);
            let way = pose::between(chart, &mean);
            let carried = Matrix3::from_columns(
                &[Vector3::x(), Vector3::y(), Vector3::z()].map(|v| pose::transported(&v, &way)),
            );
            let d = pose::between(&mean, q);
            covariance += (carried * conditional * carried.transpose() + d * d.transpose()) * *h;
        }
        RegressedTurn {
            mean,
            covariance: (covariance + covariance.transpose()) * 0.5,
        }
    }
}

/// Σ_qt Σ_tt⁻¹, rad/s.
fn gain(covariance: &nalgebra::Matrix4<f64>) -> Vector3<f64> {
    covariance.fixed_view::<3, 1>(1, 0) / covariance[(0, 0)]
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix4;

    use super::*;
    use crate::skill::Gmr;

    fn mixture(means: &[(f64, Vector3<f64>)], rate: Vector3<f64>) -> TurnMixture {
        // Each component turns at `rate`: Σ_qt = rate·Σ_tt.
        let spread = 0.04;
        let k = means.len() as f64;
        let parts = means.iter().map(|(t, _)| {
            let mut s = Matrix4::identity() * 1e-4;
            s[(0, 0)] = spread;
            for i in 0..3 {
                s[(i + 1, 0)] = rate[i] * spread;
                s[(0, i + 1)] = rate[i] * spread;
                for j in 0..3 {
                    s[(i + 1, j + 1)] += rate[i] * rate[j] * spread;
                }
            }
            (1.0 / k, Vector4::new(*t, 0.0, 0.0, 0.0), s)
        });
        let charts = means.iter().map(|(_, v)| pose::exp(v)).collect();
        TurnMixture::new(Gmm::new(parts).unwrap(), charts).unwrap()
    }

    #[test]
    fn a_steady_turn_through_more_than_half_a_circle_comes_out_steady() {
        // Five components every 0.25 s on a turn of 4 rad/s about one axis: 4 rad, past the cut of any one chart.
        let rate = Vector3::new(0.0, 0.0, 4.0);
        let means: Vec<_> = (0..5)
            .map(|i| (0.25 * f64::from(i), rate * (0.25 * f64::from(i))))
            .collect();
        let turn = mixture(&means, rate);
        for i in 0..=100 {
            let t_s = f64::from(i) * 0.01;
            let at = turn.query(t_s);
            assert!(at.mean.angle_to(&pose::exp(&(rate * t_s))) < 1e-9, "{t_s}");
            assert!((at.covariance - Matrix3::identity() * 1e-4).norm() < 1e-9);
        }
    }

    #[test]
    fn near_the_identity_it_is_the_flat_regression() {
        let small = 1e-5;
        let means: Vec<_> = (0..3)
            .map(|i| {
                let u = f64::from(i);
                (0.3 * u, Vector3::new(u, 1.0 - u * u, 0.5 * u) * small)
            })
            .collect();
        let rate = Vector3::new(0.2, -0.1, 0.3) * small;
        let turn = mixture(&means, rate);
        let flat = Gmm::new(
            turn.gmm()
                .components()
                .iter()
                .zip(&means)
                .map(|(c, (_, v))| {
                    let mut mean = *c.mean();
                    mean.fixed_rows_mut::<3>(1).copy_from(v);
                    (c.weight(), mean, *c.covariance())
                }),
        )
        .unwrap();
        let gmr = Gmr::<1, 3>::new(&flat).unwrap();
        for i in 0..=10 {
            let t_s = f64::from(i) * 0.07;
            let (a, b) = (turn.query(t_s), gmr.query(&[t_s].into()));
            assert!((pose::log(&a.mean) - b.mean).norm() < 1e-9);
            assert!((a.covariance - b.covariance).norm() < 1e-4 * b.covariance.norm());
        }
    }

    #[test]
    fn the_sign_of_a_quaternion_means_nothing() {
        let turn = mixture(
            &[(0.0, Vector3::x()), (0.5, Vector3::y() * 3.0)],
            Vector3::zeros(),
        );
        let flipped: Vec<_> = turn
            .charts()
            .iter()
            .map(|q| UnitQuaternion::new_unchecked(-q.into_inner()))
            .collect();
        let flipped = TurnMixture::new(turn.gmm().clone(), flipped).unwrap();
        for t_s in [-3.0, 0.0, 0.2, 0.31, 9.0] {
            let (a, b) = (turn.query(t_s), flipped.query(t_s));
            assert!(a.mean.angle_to(&b.mean) < 1e-7);
            let q = pose::exp(&Vector3::new(0.2, 0.4, 0.1));
            let (mut r, mut s) = ([0.0; 2], [0.0; 2]);
            let (l, m) = (
                turn.responsibilities(t_s, &q, &mut r),
                flipped.responsibilities(t_s, &q, &mut s),
            );
            assert!((l - m).abs() < 1e-9 && (r[0] - s[0]).abs() < 1e-9);
        }
        assert!(
            turn.query(f64::NAN)
                .mean
                .coords
                .iter()
                .all(|v| v.is_finite())
        );
    }

    #[test]
    fn what_is_no_mixture_is_refused() {
        let turn = mixture(&[(0.0, Vector3::x())], Vector3::zeros());
        assert!(matches!(
            TurnMixture::new(turn.gmm().clone(), Vec::new()),
            Err(TurnError::Charts {
                found: 0,
                expected: 1
            })
        ));
        let off = Gmm::new([(1.0, Vector4::new(0.0, 0.1, 0.0, 0.0), Matrix4::identity())]).unwrap();
        assert!(matches!(
            TurnMixture::new(off, turn.charts().to_vec()),
            Err(TurnError::OffCentre { component: 0 })
        ));
        let long = UnitQuaternion::new_unchecked(nalgebra::Quaternion::new(2.0, 0.0, 0.0, 0.0));
        assert!(matches!(
            TurnMixture::new(turn.gmm().clone(), vec![long]),
            Err(TurnError::NotARotation { component: 0 })
        ));
    }
}
