//! What each expert says, before their answers are fused.

use nalgebra::Vector3;

use super::ahead::Motion;
use super::params::WEIGHTED;
use super::{BLOCK, KNOT_SPACING_S, MAX_KNOTS, Model, Posterior};

/// The mixture's weight has halved where the novelty is this many times its 90 % quantile.
const NOVELTY_MARGIN: f64 = 6.0;

/// The variance of the other experts grows with the motion, but for this share of it.
const STILL_SHARE: f64 = 0.1;

/// The generic extrapolator, for motion that was never demonstrated: `d_j = Σᵢ G[i][j]·(x − mᵢ)`.
///
/// Scalars, so that it turns with the motion: a gesture is as familiar whichever way it is made.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Generic {
    /// G: for every memory, at every knot, the factor on the way from that memory to the present.
    pub lead: [[f64; MAX_KNOTS]; 4],
    /// Means of `(x − mₐ)·(x − m_b)` over the rows it was fitted to, m², lower triangle row by row; diagonal > 0. The
    /// normal equations, by which it can be fitted further.
    pub products: [f64; 10],
}

impl Generic {
    /// Mean square of the way from the third memory to the present, m².
    pub fn motion_m2(&self) -> f64 {
        self.products[5]
    }
}

/// The answers of all experts from one state: displacements in m or rad.
#[derive(Debug, Clone, Copy)]
pub struct Experts {
    /// At each knot what mixture, generic extrapolator and straight line say. The fourth expert holds: zero.
    pub displacement: [[Vector3<f64>; WEIGHTED]; MAX_KNOTS],
    /// The mixture's calibrated covariance at each knot: xx, xy, xz, yy, yz, zz.
    pub(super) mixture: [[f64; BLOCK]; MAX_KNOTS],
    /// Variance along one axis of generic extrapolator, straight line and holding.
    pub(super) others: [[f64; WEIGHTED]; MAX_KNOTS],
    /// The last knot in use.
    pub count: usize,
    /// Squared Mahalanobis distance of the state to the nearest component; infinite without a model.
    pub novelty: f64,
    /// The share of its weight that novelty leaves the mixture, in [0, 1]; 0 without a model.
    pub familiarity: f64,
    /// There is a mixture, and a generic extrapolator.
    pub(super) learned: bool,
}

impl Experts {
    /// The straight line alone, to the farthest knot.
    pub(super) fn straight(motion: &Motion) -> Self {
        let zero = Vector3::zeros();
        let mut out = Self {
            displacement: [[zero; WEIGHTED]; MAX_KNOTS],
            mixture: [[0.0; BLOCK]; MAX_KNOTS],
            others: [[0.0; WEIGHTED]; MAX_KNOTS],
            count: MAX_KNOTS,
            novelty: f64::INFINITY,
            familiarity: 0.0,
            learned: false,
        };
        let speed2 = motion.velocity.norm_squared() + motion.onset * motion.onset;
        let knots = out.displacement.iter_mut().zip(&mut out.others);
        for (j, (displacement, others)) in knots.enumerate() {
            let h_s = (j + 1) as f64 * KNOT_SPACING_S;
            displacement[2] = motion.straight(h_s);
            let bend2 = 0.25 * motion.acceleration.norm_squared() * h_s * h_s;
            *others = [h_s * h_s * (speed2 + bend2) / 3.0; WEIGHTED];
        }
        out
    }

    /// All of them; `ways` lead from each memory to the present.
    pub(super) fn all(
        model: &Model,
        posterior: &Posterior,
        ways: &[Vector3<f64>; 4],
        motion: &Motion,
    ) -> Self {
        let mut out = Self::straight(motion);
        let calibration = model.calibration();
        let excess = posterior.novelty / (NOVELTY_MARGIN * calibration.novelty90);
        let familiarity = 1.0 / (1.0 + excess * excess);
        // Where the mixture's density underflows it has no answer that could be weighted with zero.
        let silent = familiarity.is_nan() || familiarity <= 0.0;
        out.count = model.knots();
        out.novelty = posterior.novelty;
        out.familiarity = if silent { 0.0 } else { familiarity };
        out.learned = true;
        let generic = model.generic();
        let usual = generic.motion_m2();
        let still = STILL_SHARE * usual;
        let moving = (ways[2].norm_squared() + still) / (usual + still);
        for i in 0..model.knots() {
            let mut d = Vector3::zeros();
            for (way, lead) in ways.iter().zip(&generic.lead) {
                d += way * lead[i];
            }
            out.displacement[i][1] = d;
            let errors = &calibration.errors[i];
            out.others[i] = core::array::from_fn(|e| errors[e + 1] * moving);
            if !silent {
                out.displacement[i][0] = posterior.displacement[i];
                let c = calibration.covariance[i];
                let v = &posterior.covariance[i];
                out.mixture[i] = [v.m11, v.m12, v.m13, v.m22, v.m23, v.m33].map(|v| c * v);
            }
        }
        out
    }
}
