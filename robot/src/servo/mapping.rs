//! From hand to tip: a stated, rigid, scaled mapping with a fresh reference at every engage.

use nalgebra::{UnitQuaternion, Vector3};

/// `tip = tip₀ + s · R · (hand − hand₀)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mapping {
    /// Tip metres per hand metre.
    pub scale: f64,
    /// Hand axes to base axes.
    pub rotation: UnitQuaternion<f64>,
    /// The hand at the instant of engaging, m.
    pub hand_m: Vector3<f64>,
    /// The tip at that instant, m in base axes.
    pub tip_m: Vector3<f64>,
}

impl Mapping {
    /// Where the tip belongs when the hand is at `hand_m`, no farther than `radius_m` from `tip₀`.
    /// The second value says whether that limit acted.
    pub fn place(&self, hand_m: Vector3<f64>, radius_m: f64) -> (Vector3<f64>, bool) {
        let offset = self.rotation * (hand_m - self.hand_m) * self.scale;
        let distance_m = offset.norm();
        if distance_m > radius_m {
            (self.tip_m + offset * (radius_m / distance_m), true)
        } else {
            (self.tip_m + offset, false)
        }
    }

    /// The hand position that [`Mapping::place`] would put at `tip_m`.
    pub fn unplace(&self, tip_m: Vector3<f64>) -> Vector3<f64> {
        self.hand_m + self.rotation.inverse() * (tip_m - self.tip_m) / self.scale
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn placing_is_undone_by_unplacing_and_bounded() {
        let mapping = Mapping {
            scale: 0.1,
            rotation: UnitQuaternion::from_euler_angles(0.3, -1.0, 2.0),
            hand_m: Vector3::new(1.0, 2.0, 3.0),
            tip_m: Vector3::new(0.4, 0.0, 0.5),
        };
        let hand = Vector3::new(0.2, 2.5, 3.1);
        let (tip, clamped) = mapping.place(hand, 1.0);
        assert!(!clamped && (mapping.unplace(tip) - hand).norm() < 1e-12);
        let (tip, clamped) = mapping.place(hand, 0.05);
        assert!(clamped && ((tip - mapping.tip_m).norm() - 0.05).abs() < 1e-12);
    }
}
