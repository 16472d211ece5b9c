//! From hand to tip: a stated, rigid, scaled mapping with a fresh reference at every engage.

use nalgebra::{UnitQuaternion, Vector3};

/// Where the tip may be: a ball around its place in the start posture, wherever it engages.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Workspace {
    /// The tip in the start posture, m in base axes.
    pub home_m: Vector3<f64>,
    /// How far from there it may go, m.
    pub radius_m: f64,
}

impl Workspace {
    /// The nearest place inside, and whether that is another one.
    pub fn clip(&self, tip_m: Vector3<f64>) -> (Vector3<f64>, bool) {
        let offset = tip_m - self.home_m;
        let distance_m = offset.norm();
        if distance_m > self.radius_m {
            (self.home_m + offset * (self.radius_m / distance_m), true)
        } else {
            (tip_m, false)
        }
    }
}

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
    /// Where the tip belongs when the hand is at `hand_m` and the displacement is eased in to the share `eased` ∈ [0, 1], inside the workspace: a tip
    /// that engaged outside is eased in too. The second value says whether the workspace's limit acted.
    pub fn place(
        &self,
        hand_m: Vector3<f64>,
        workspace: &Workspace,
        eased: f64,
    ) -> (Vector3<f64>, bool) {
        let offset = self.rotation * (hand_m - self.hand_m) * self.scale;
        let (placed, clipped) = workspace.clip(self.tip_m + offset);
        (self.tip_m + (placed - self.tip_m) * eased, clipped)
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
        let home_m = Vector3::new(0.4, 0.04, 0.5);
        let workspace = |radius_m| Workspace { home_m, radius_m };
        let (tip, clamped) = mapping.place(hand, &workspace(1.0), 1.0);
        assert!(!clamped && (mapping.unplace(tip) - hand).norm() < 1e-12);
        let small = workspace(0.05);
        let (tip, clamped) = mapping.place(hand, &small, 1.0);
        assert!(clamped && ((tip - home_m).norm() - 0.05).abs() < 1e-12);
        let (halfway, _) = mapping.place(hand, &small, 0.5);
        assert!((halfway - (tip + mapping.tip_m) * 0.5).norm() < 1e-12);
    }
}
