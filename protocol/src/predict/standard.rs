//! From features in metres to the units of the mixture.

use nalgebra::SVector;

use super::state::FEATURES;

/// Memories whose difference to the present may be bent: the quickest.
pub const BENT: usize = 2;

/// The map from features in metres (rad) to the units the mixture was fitted in: the differences to the quickest
/// memories are bent, then every feature is shifted and scaled.
#[derive(Debug, Clone, PartialEq)]
pub struct Standardisation {
    /// Mean of every bent feature, m.
    pub mean: SVector<f64, FEATURES>,
    /// Scale of every bent feature, m, > 0; one value within a 3-vector keeps space isotropic.
    pub scale: SVector<f64, FEATURES>,
    /// Where the differences to the [`BENT`] quickest memories turn from linear to logarithmic, m, ≥ 0; 0 is linear.
    pub bend: [f64; BENT],
    /// The variance that was added to every standardised feature in training, ≥ 0: nothing to predict with, but
    /// needed to go on learning.
    pub ridge: f64,
    /// The pseudo-samples of the pooled covariance that every component was given, ≥ 0: the same.
    pub shrinkage: f64,
}

impl Standardisation {
    /// The features (m, rad) with the quickest memories bent, in the same units.
    ///
    /// `u ← u·b·ln(1 + |u|/b)/|u|` for the difference u to a memory of bend b. On a linear scale the first
    /// centimetres of a motion are nothing beside its middle; but that a hand has begun to move, and where to, is
    /// what tells most of what follows.
    pub fn bent(&self, mut features: SVector<f64, FEATURES>) -> SVector<f64, FEATURES> {
        for (i, &bend) in self.bend.iter().enumerate() {
            let mut u = features.fixed_rows_mut::<3>(3 * (i + 1));
            let length = libm::sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2]);
            if bend > 0.0 && length > 0.0 {
                u *= bend * libm::log(1.0 + length / bend) / length;
            }
        }
        features
    }

    /// Bent features in the units of the mixture.
    pub fn scaled(&self, bent: &SVector<f64, FEATURES>) -> SVector<f64, FEATURES> {
        (bent - self.mean).component_div(&self.scale)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with(bend: [f64; BENT]) -> Standardisation {
        Standardisation {
            mean: SVector::zeros(),
            scale: SVector::repeat(1.0),
            bend,
            ridge: 0.0,
            shrinkage: 0.0,
        }
    }

    #[test]
    fn little_stays_and_much_becomes_its_logarithm() {
        let f = SVector::<f64, FEATURES>::from_fn(|i, _| match i {
            3 => 3e-6,
            4 => 4e-6,
            6 => -0.03,
            8 => 0.04,
            _ => 0.5,
        });
        let f = SVector::from_fn(|i, _| if i == 5 || i == 7 { 0.0 } else { f[i] });
        let bent = with([0.01, 0.01]).bent(f);
        assert!((bent[3] - 3e-6).abs() < 1e-8 && (bent[4] - 4e-6).abs() < 1e-8);
        // |u| = 0.05 = 5 b, in the same direction.
        let length = 0.01 * libm::log(6.0);
        assert!((bent[6] + 0.6 * length).abs() < 1e-15);
        assert!((bent[8] - 0.8 * length).abs() < 1e-15);
        assert_eq!(bent.rows(0, 3), f.rows(0, 3));
        assert_eq!(bent.rows(9, 6), f.rows(9, 6));
    }

    #[test]
    fn without_a_bend_or_a_motion_nothing_changes() {
        let f = SVector::from_fn(|i, _| 0.1 * i as f64);
        assert_eq!(with([0.0; BENT]).bent(f), f);
        let rest = SVector::zeros();
        assert_eq!(with([0.01; BENT]).bent(rest), rest);
    }
}
