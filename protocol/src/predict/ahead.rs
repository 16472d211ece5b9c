//! From the experts' answers to a predicted way: the off-model guard. In metres for positions, in radians
//! (the present's own axes) for orientations.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::params::WEIGHTED;
use super::{BLOCK, Experts, KNOT_SPACING_S, MAX_KNOTS, Params};

/// What novelty takes from the mixture goes to the other experts by their weights and this much.
const LEAST_WEIGHT: f64 = 1.0 / 255.0;

/// Without a model, the straight line gets this share of the learned experts' weights: over fast gestures undamped
/// extrapolation is worse than standing still beyond 0.15 s.
const UNLEARNED_SHARE: f64 = 0.5;

/// Nothing is known better than to this, m/s or rad/s.
const FLOOR: f64 = 0.01;

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
    /// As far as a straight line ever goes.
    pub(super) reach: f64,
}

impl Motion {
    /// `v·h/√(1 + |v·h|²/L²)`: constant velocity, but no motion of a hand goes on for longer than it can reach.
    pub(super) fn straight(&self, h_s: f64) -> Vector3<f64> {
        let way = self.velocity * h_s;
        way / (1.0 + way.norm_squared() / (self.reach * self.reach)).sqrt()
    }
}

/// A predicted displacement and how far to trust it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Knot {
    /// Displacement from the newest position or orientation, m or rad.
    pub displacement: Vector3<f64>,
    /// Its covariance, m² or rad²: xx, xy, xz, yy, yz, zz.
    pub covariance: [f64; BLOCK],
    /// Standard deviation along any one axis (root mean over the three), m or rad.
    pub sigma: f64,
}

const STILL: Knot = Knot {
    displacement: Vector3::new(0.0, 0.0, 0.0),
    covariance: [0.0; BLOCK],
    sigma: 0.0,
};

/// Where things go from the present: plain numbers, no reference to the model.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Ahead {
    /// Knot j is j·[`KNOT_SPACING_S`] ahead; knot 0 is the present and entries beyond `count` are unused.
    pub knots: [Knot; MAX_KNOTS + 1],
    /// The last knot in use, at least 1.
    pub count: usize,
    /// Squared Mahalanobis distance of the state to the nearest component; infinite without a model.
    pub novelty: f64,
    /// The share of its weight that novelty leaves the mixture, in [0, 1]; 0 without a model.
    pub familiarity: f64,
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
    /// Whether `count` is of knots that there are: one that was made here always is, one that was read from a file need not.
    pub fn is_sound(&self) -> bool {
        (1..=MAX_KNOTS).contains(&self.count)
    }

    /// Fuses the experts: `x̂ = x + κ·Σ w_e·y_e`, and the covariance of that mixture, the distances between the experts included,
    /// `φ·Σ w_e·(C_e + (y_e − ȳ)(y_e − ȳ)ᵀ)`.
    ///
    /// What novelty takes from the mixture goes to the others in proportion to their own weights.
    pub fn fused(experts: &Experts, params: &Params) -> Self {
        let mut knots = [STILL; MAX_KNOTS + 1];
        for (j, knot) in knots.iter_mut().enumerate().take(experts.count + 1).skip(1) {
            let answers = &experts.displacement[j - 1];
            let [mixture, generic, straight] = params.at(j);
            let (weights, hold) = if experts.learned {
                let hold = (1.0 - mixture - generic - straight).max(0.0);
                let kept = mixture * experts.familiarity;
                let others = generic + straight + hold + 3.0 * LEAST_WEIGHT;
                let share = (mixture - kept) / others;
                let more = |w: f64| w + share * (w + LEAST_WEIGHT);
                ([kept, more(generic), more(straight)], more(hold))
            } else {
                let straight = straight + UNLEARNED_SHARE * (mixture + generic);
                ([0.0, 0.0, straight], 1.0 - straight)
            };
            let mean = answers[0] * weights[0] + answers[1] * weights[1] + answers[2] * weights[2];
            let mut covariance = experts.mixture[j - 1].map(|v| v * weights[0]);
            let others = &experts.others[j - 1];
            let h_s = j as f64 * KNOT_SPACING_S;
            let round = FLOOR * FLOOR * h_s * h_s
                + weights[1] * others[0]
                + weights[2] * others[1]
                + hold * others[2];
            for axis in [0, 3, 5] {
                covariance[axis] += round;
            }
            let mut apart = |w: f64, d: Vector3<f64>| {
                let outer = [
                    d.x * d.x,
                    d.x * d.y,
                    d.x * d.z,
                    d.y * d.y,
                    d.y * d.z,
                    d.z * d.z,
                ];
                for (c, o) in covariance.iter_mut().zip(outer) {
                    *c += w * o;
                }
            };
            for e in 0..WEIGHTED {
                // An expert without weight may be anywhere.
                if weights[e] > 0.0 {
                    apart(weights[e], answers[e] - mean);
                }
            }
            apart(hold, mean);
            let covariance = covariance.map(|v| v * params.inflation);
            *knot = Knot {
                displacement: mean * params.gain,
                covariance,
                sigma: ((covariance[0] + covariance[3] + covariance[5]) / 3.0).sqrt(),
            };
        }
        Self {
            knots,
            count: experts.count,
            novelty: experts.novelty,
            familiarity: experts.familiarity,
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
