//! From the mixture's answer to a predicted way: the off-model guard. In metres for positions, in radians
//! (the present's own axes) for orientations.

use nalgebra::Vector3;

use super::{KNOT_SPACING_S, MAX_KNOTS, Model, Params, Posterior};

/// Novelty is counted in multiples of this many 90 % quantiles before trust halves.
const NOVELTY_MARGIN: f64 = 8.0;

/// Horizons at which two ends compare their predictions, s.
pub(super) const CHECK_HORIZONS_S: [f64; 3] = [0.1, 0.2, 0.4];

/// Where a checksum starts (FNV-1a).
pub(super) const FOLD_SEED: u32 = 0x811c_9dc5;

/// Folds numbers, rounded to 10⁻⁶, into a checksum (FNV-1a).
pub(super) fn fold<'a>(seed: u32, values: impl Iterator<Item = &'a f64>) -> u32 {
    let mut hash = seed;
    for v in values {
        for byte in ((v * 1e6).round() as i64).to_le_bytes() {
            hash = (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193);
        }
    }
    hash
}

/// How the present moves, and how suddenly it might.
#[derive(Debug, Clone, Copy)]
pub(super) struct Motion {
    pub(super) velocity: Vector3<f64>,
    pub(super) acceleration: Vector3<f64>,
    /// What rests may start at any moment, about this fast.
    pub(super) onset: f64,
}

/// A predicted displacement and how far to trust it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Knot {
    /// Displacement from the newest position or orientation, m or rad.
    pub displacement: Vector3<f64>,
    /// Standard deviation along any one axis (root mean over the three), m or rad.
    pub sigma: f64,
}

const STILL: Knot = Knot {
    displacement: Vector3::new(0.0, 0.0, 0.0),
    sigma: 0.0,
};

/// Where things go from the present: plain numbers, no reference to the model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ahead {
    /// Knot j is j·[`KNOT_SPACING_S`] ahead; knot 0 is the present and entries beyond `count` are unused.
    pub knots: [Knot; MAX_KNOTS + 1],
    /// The last knot in use, at least 1.
    pub count: usize,
    /// Squared Mahalanobis distance of the state to the nearest component; infinite without a model.
    pub novelty: f64,
    /// The weight the mixture got against constant velocity, in [0, 1]; 0 without a model.
    pub weight: f64,
}

/// One moment of an [`Ahead`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Way {
    /// Displacement from the present, m or rad.
    pub displacement: Vector3<f64>,
    /// Standard deviation along any one axis, m or rad.
    pub sigma: f64,
    /// The moment lies after the last knot: the values are those of the last knot.
    pub beyond: bool,
}

impl Ahead {
    /// Damped constant velocity alone, to the farthest knot.
    pub(super) fn straight(motion: &Motion, params: &Params) -> Self {
        let speed2 = motion.velocity.norm_squared() + motion.onset * motion.onset;
        let mut knots = [STILL; MAX_KNOTS + 1];
        for (j, knot) in knots.iter_mut().enumerate().skip(1) {
            let h_s = j as f64 * KNOT_SPACING_S;
            let bend2 = 0.25 * motion.acceleration.norm_squared() * h_s * h_s;
            *knot = Knot {
                displacement: motion.velocity * (params.cv_damping * h_s * params.gain),
                sigma: h_s * ((speed2 + bend2) / 3.0).sqrt(),
            };
        }
        Self {
            knots,
            count: MAX_KNOTS,
            novelty: f64::INFINITY,
            weight: 0.0,
        }
    }

    /// `w = trust/(1+(d²/(8·nov₉₀))²)`, `x̂ = x + κ·(w·gmr + (1−w)·cv)`; the deviation is that of the
    /// mixture of the two experts, the distance between them included.
    pub(super) fn blended(
        model: &Model,
        posterior: &Posterior,
        motion: &Motion,
        params: &Params,
    ) -> Self {
        let calibration = model.calibration();
        let excess = posterior.novelty / (NOVELTY_MARGIN * calibration.novelty90);
        let weight = params.trust / (1.0 + excess * excess);
        // Where the mixture's density underflows it has no answer that could be weighted with zero.
        let silent = weight.is_nan() || weight <= 0.0;
        let weight = if silent { 0.0 } else { weight };
        let velocity = motion.velocity * params.cv_damping;
        let mut knots = [STILL; MAX_KNOTS + 1];
        for j in 1..=model.knots() {
            let i = j - 1;
            let straight = velocity * (j as f64 * KNOT_SPACING_S);
            let (learned, learned_2) = if silent {
                (straight, 0.0)
            } else {
                let trace = posterior.covariance[i].trace();
                (
                    posterior.displacement[i],
                    calibration.covariance[i] * trace / 3.0,
                )
            };
            let between = (learned - straight).norm_squared() / 3.0;
            let displacement = learned * weight + straight * (1.0 - weight);
            let variance = weight * learned_2
                + (1.0 - weight) * (calibration.straight_m2[i] + weight * between);
            knots[j] = Knot {
                displacement: displacement * params.gain,
                sigma: variance.sqrt(),
            };
        }
        Self {
            knots,
            count: model.knots(),
            novelty: posterior.novelty,
            weight,
        }
    }

    /// The displacement `h_s` seconds ahead: linear between knots, held beyond the last one and said so;
    /// a negative (or NaN) horizon is the present.
    pub fn at(&self, h_s: f64) -> Way {
        let u = h_s.max(0.0) / KNOT_SPACING_S;
        let last = self.count as f64;
        let beyond = u > last;
        let u = u.min(last);
        let i = (u as usize).min(self.count - 1);
        let s = u - i as f64;
        let (a, b) = (&self.knots[i], &self.knots[i + 1]);
        Way {
            displacement: a.displacement * (1.0 - s) + b.displacement * s,
            sigma: a.sigma * (1.0 - s) + b.sigma * s,
            beyond,
        }
    }

    /// The horizon of the last knot, s.
    pub fn reach_s(&self) -> f64 {
        self.count as f64 * KNOT_SPACING_S
    }
}
