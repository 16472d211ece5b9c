//! How well one motion follows another.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use crate::learn::align::Aligned;

/// How well one series follows another: mean absolute and squared error, and R² of the worst axis.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    /// Mean absolute error over all axes, m.
    pub mae_m: f64,
    /// Mean squared error over all axes, m².
    pub mse_m2: f64,
    /// Coefficient of determination, the lowest of the three axes; an axis without motion does not count.
    pub r2: f64,
    /// Largest distance, m.
    pub max_m: f64,
}

impl Scores {
    /// The mean of several; the largest distance is the largest of all.
    fn mean(each: &[Self]) -> Self {
        let n = each.len().max(1) as f64;
        Self {
            mae_m: each.iter().map(|s| s.mae_m).sum::<f64>() / n,
            mse_m2: each.iter().map(|s| s.mse_m2).sum::<f64>() / n,
            r2: each.iter().map(|s| s.r2).sum::<f64>() / n,
            max_m: each.iter().map(|s| s.max_m).fold(0.0, f64::max),
        }
    }

    /// Of a motion against each demonstration on the common time axis, the mean; `motion` gives the position (m)
    /// at a time (s).
    pub fn of_demonstrations(aligned: &Aligned, motion: impl Fn(f64) -> Vector3<f64>) -> Self {
        let estimate: Vec<_> = aligned.times_s.iter().map(|&t_s| motion(t_s)).collect();
        let each: Vec<_> = aligned
            .paths
            .iter()
            .map(|path| Self::of(path, &estimate))
            .collect();
        Self::mean(&each)
    }

    /// Of `estimate` against `truth`, sample by sample; both have the same length.
    pub fn of(truth: &[Vector3<f64>], estimate: &[Vector3<f64>]) -> Self {
        let n = truth.len().max(1) as f64;
        let errors: Vec<_> = truth.iter().zip(estimate).map(|(a, b)| a - b).collect();
        let mean = truth.iter().sum::<Vector3<f64>>() / n;
        let r2 = |axis: usize| {
            let total: f64 = truth.iter().map(|x| (x[axis] - mean[axis]).powi(2)).sum();
            let rest: f64 = errors.iter().map(|e| e[axis].powi(2)).sum();
            // A motion of less than a tenth of a millimetre is none.
            if total / n > 1e-8 {
                1.0 - rest / total
            } else {
                1.0
            }
        };
        Self {
            mae_m: errors.iter().map(|e| e.abs().sum()).sum::<f64>() / (3.0 * n),
            mse_m2: errors.iter().map(|e| e.norm_squared()).sum::<f64>() / (3.0 * n),
            r2: (0..3).map(r2).fold(1.0, f64::min),
            max_m: errors.iter().map(|e| e.norm()).fold(0.0, f64::max),
        }
    }
}

/// How far an orientation is off.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TurnScores {
    /// Root mean square of the angle, rad.
    pub rms_rad: f64,
    /// Largest angle, rad.
    pub max_rad: f64,
}

impl TurnScores {
    /// Of these angles, rad.
    pub fn of(angles: impl Iterator<Item = f64>) -> Self {
        let (mut n, mut square, mut max_rad) = (0_u32, 0.0, 0.0_f64);
        for angle in angles {
            n += 1;
            square += angle * angle;
            max_rad = max_rad.max(angle);
        }
        Self {
            rms_rad: (square / f64::from(n.max(1))).sqrt(),
            max_rad,
        }
    }
}

/// What playing a skill sends.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlayReport {
    /// The skill.
    pub skill: String,
    /// How long its motion takes, s.
    pub duration_s: f64,
    /// The bound asked for, m.
    pub bound_m: f64,
    /// Samples of the inferred motion.
    pub samples: usize,
    /// Checkpoints that stand for them.
    pub checkpoints: usize,
    /// Those of the orientation, where the skill has it.
    pub turn_checkpoints: Option<usize>,
    /// Those of the gripper, where the skill has it.
    pub grip_checkpoints: Option<usize>,
    /// Bytes of the encoded plan.
    pub bytes: usize,
    /// The rebuilt motion against the inferred one.
    pub rebuilt: Scores,
    /// The rebuilt orientation against the inferred one.
    pub rebuilt_turn: Option<TurnScores>,
    /// The checkpoints: time (s) and position (m).
    pub points: Vec<(f64, [f64; 3])>,
}
