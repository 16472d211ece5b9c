//! From hand to tip: a stated, rigid mapping, scaled in its lengths, with a fresh reference at every engage.

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

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

/// `tip = tip₀ + s · R · (hand − hand₀)`, and for orientations `q_tip = R · (q_hand · q_hand₀⁻¹) · R⁻¹ · q_tip₀`: rotation is never scaled.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Mapping {
    /// Tip metres per hand metre.
    pub scale: f64,
    /// Hand axes to base axes.
    pub rotation: UnitQuaternion<f64>,
    /// The hand at the instant of engaging, m.
    pub hand_m: Vector3<f64>,
    /// The tip at that instant, m in base axes.
    pub tip_m: Vector3<f64>,
    /// The hand's orientation at that instant, if it has one.
    pub hand_orientation: Option<UnitQuaternion<f64>>,
    /// The tip's at that instant: tip axes to base axes.
    pub tip_orientation: UnitQuaternion<f64>,
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

    /// How the tip is to be oriented when the hand is oriented as `hand`, the turn since the engage eased in to the share `eased` ∈ [0, 1].
    pub fn orient(&self, hand: &UnitQuaternion<f64>, eased: f64) -> UnitQuaternion<f64> {
        let Some(reference) = &self.hand_orientation else {
            return self.tip_orientation;
        };
        let turned = self.rotation * (hand * reference.inverse()) * self.rotation.inverse();
        let turned = if eased < 1.0 {
            UnitQuaternion::from_scaled_axis(turned.scaled_axis() * eased)
        } else {
            turned
        };
        turned * self.tip_orientation
    }

    /// The hand's orientation that [`Mapping::orient`] would turn to `tip`; `None` if none is followed.
    pub fn unorient(&self, tip: &UnitQuaternion<f64>) -> Option<UnitQuaternion<f64>> {
        let turned = tip * self.tip_orientation.inverse();
        Some(self.rotation.inverse() * turned * self.rotation * self.hand_orientation?)
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
            hand_orientation: None,
            tip_orientation: UnitQuaternion::identity(),
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

    #[test]
    fn turning_is_that_of_the_hand_seen_in_base_axes_and_never_scaled() {
        let mapping = Mapping {
            scale: 0.1,
            // Hand axes: x to the right of the person is −y of the base.
            rotation: UnitQuaternion::from_euler_angles(0.0, 0.0, -core::f64::consts::FRAC_PI_2),
            hand_m: Vector3::zeros(),
            tip_m: Vector3::zeros(),
            hand_orientation: Some(UnitQuaternion::from_euler_angles(0.4, 0.5, -0.6)),
            tip_orientation: UnitQuaternion::from_euler_angles(3.0, 0.1, 0.2),
        };
        let hand = |turn: Vector3<f64>| {
            UnitQuaternion::from_scaled_axis(turn) * mapping.hand_orientation.unwrap()
        };
        let seen = |turn: Vector3<f64>, eased: f64| {
            (mapping.orient(&hand(turn), eased) * mapping.tip_orientation.inverse()).scaled_axis()
        };
        let turn = Vector3::x() * 0.8;
        assert!((seen(turn, 1.0) + Vector3::y() * 0.8).norm() < 1e-12);
        assert!((seen(turn, 0.25) + Vector3::y() * 0.2).norm() < 1e-12);
        assert!(seen(turn, 0.0).norm() < 1e-12 && seen(Vector3::zeros(), 1.0).norm() < 1e-12);
        // A quaternion and its negative are one orientation, while it is eased in too.
        let negative = UnitQuaternion::new_unchecked(-hand(turn).into_inner());
        for eased in [0.25, 1.0] {
            let angle = mapping
                .orient(&negative, eased)
                .angle_to(&mapping.orient(&hand(turn), eased));
            assert!(angle < 1e-12);
        }
    }
}
