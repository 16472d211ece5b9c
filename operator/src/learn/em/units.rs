//! The units a mixture is fitted in.

use nalgebra::{SMatrix, SVector, Vector3};
use telemime_protocol::skill::Gmm;

use crate::learn::LearnError;

/// The affine map between the data's units and those of the fit.
pub(in crate::learn) struct Units<const D: usize> {
    mean: SVector<f64, D>,
    scale: SVector<f64, D>,
    /// Coordinates that do not vary.
    pub(in crate::learn) constant: Vec<usize>,
}

impl<const D: usize> Units<D> {
    /// A coordinate that does not vary keeps its unit, so that the ridge is its variance.
    pub(in crate::learn) fn of(data: &[SVector<f64, D>], standardise: bool) -> Self {
        let mut units = Self {
            mean: SVector::zeros(),
            scale: SVector::repeat(1.0),
            constant: Vec::new(),
        };
        if standardise {
            let n = data.len() as f64;
            units.mean = data.iter().sum::<SVector<f64, D>>() / n;
            for i in 0..D {
                let mean = units.mean[i];
                let variance = data
                    .iter()
                    .map(|x| (x[i] - mean) * (x[i] - mean))
                    .sum::<f64>()
                    / n;
                let deviation = variance.sqrt();
                if deviation > 1e-9 * mean.abs().max(1e-3) {
                    units.scale[i] = deviation;
                } else {
                    units.constant.push(i);
                }
            }
        }
        units
    }

    pub(in crate::learn) fn apply(&self, data: &[SVector<f64, D>]) -> Vec<SVector<f64, D>> {
        data.iter()
            .map(|x| (x - self.mean).component_div(&self.scale))
            .collect()
    }

    /// ln of a volume in the data's units over that of the fit.
    pub(in crate::learn) fn log_jacobian(&self) -> f64 {
        self.scale.iter().map(|s| s.ln()).sum()
    }

    /// A mixture of the fit in the data's units.
    pub(in crate::learn) fn restore(&self, gmm: &Gmm<D>) -> Result<Gmm<D>, LearnError> {
        let scale = SMatrix::<f64, D, D>::from_diagonal(&self.scale);
        Gmm::new(gmm.components().iter().map(|c| {
            (
                c.weight(),
                c.mean().component_mul(&self.scale) + self.mean,
                scale * c.covariance() * scale,
            )
        }))
        .map_err(|_| LearnError::Singular)
    }

    pub(in crate::learn) fn mean(&self) -> &SVector<f64, D> {
        &self.mean
    }

    pub(in crate::learn) fn scale(&self) -> &SVector<f64, D> {
        &self.scale
    }
}

impl Units<4> {
    /// A position of the fit, m.
    pub(in crate::learn) fn position(&self, x: &Vector3<f64>) -> Vector3<f64> {
        x.component_mul(&self.scale.fixed_rows::<3>(1)) + self.mean.fixed_rows::<3>(1)
    }
}
