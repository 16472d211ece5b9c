//! Mass, centre of mass and rotational inertia of a rigid body.

use nalgebra::{Isometry3, Matrix3, Matrix6, Vector3};

/// A rigid body in the frame of the joint that moves it.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Body {
    /// Mass, kg.
    pub mass_kg: f64,
    /// Centre of mass, m.
    pub com_m: Vector3<f64>,
    /// Rotational inertia about the centre of mass, in the axes of the frame, kg·m².
    pub inertia_kg_m2: Matrix3<f64>,
}

impl Body {
    /// Nothing.
    pub const EMPTY: Self = Self {
        mass_kg: 0.0,
        com_m: Vector3::new(0.0, 0.0, 0.0),
        inertia_kg_m2: Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    };

    /// The same body seen from a frame in which its own frame has this pose.
    #[must_use]
    pub fn moved(&self, pose: &Isometry3<f64>) -> Self {
        let r = pose.rotation.to_rotation_matrix();
        Self {
            mass_kg: self.mass_kg,
            com_m: pose.transform_point(&self.com_m.into()).coords,
            inertia_kg_m2: r * self.inertia_kg_m2 * r.transpose(),
        }
    }

    /// Both bodies, rigidly joined (parallel-axis theorem).
    #[must_use]
    pub fn joined(&self, other: &Self) -> Self {
        let mass_kg = self.mass_kg + other.mass_kg;
        if mass_kg == 0.0 {
            return Self {
                inertia_kg_m2: self.inertia_kg_m2 + other.inertia_kg_m2,
                ..*self
            };
        }
        let com_m = (self.com_m * self.mass_kg + other.com_m * other.mass_kg) / mass_kg;
        let about = |b: &Self| b.inertia_kg_m2 + point_inertia(b.mass_kg, &(b.com_m - com_m));
        Self {
            mass_kg,
            com_m,
            inertia_kg_m2: about(self) + about(other),
        }
    }

    /// Spatial inertia about the base origin for a frame at (`rotation`, `origin`), order (angular, linear)
    /// (Featherstone 2008, eq. 2.63).
    pub(super) fn spatial(&self, rotation: &Matrix3<f64>, origin: &Vector3<f64>) -> Matrix6<f64> {
        let c = rotation * self.com_m + origin;
        let rotational =
            rotation * self.inertia_kg_m2 * rotation.transpose() + point_inertia(self.mass_kg, &c);
        let mc = c.cross_matrix() * self.mass_kg;
        let mut out = Matrix6::zeros();
        out.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotational);
        out.fixed_view_mut::<3, 3>(0, 3).copy_from(&mc);
        out.fixed_view_mut::<3, 3>(3, 0).copy_from(&-mc);
        out[(3, 3)] = self.mass_kg;
        out[(4, 4)] = self.mass_kg;
        out[(5, 5)] = self.mass_kg;
        out
    }
}

/// Inertia about the origin of a point mass at `r`: m(r·r 1 − r rᵀ).
fn point_inertia(mass_kg: f64, r: &Vector3<f64>) -> Matrix3<f64> {
    (Matrix3::from_diagonal_element(r.norm_squared()) - r * r.transpose()) * mass_kg
}

#[cfg(test)]
mod tests {
    use nalgebra::{Translation3, UnitQuaternion};

    use super::*;

    #[test]
    fn two_halves_of_a_rod_are_the_rod() {
        let rod = |length: f64, mass_kg: f64| {
            let i = mass_kg * length * length / 12.0;
            Body {
                mass_kg,
                com_m: Vector3::zeros(),
                inertia_kg_m2: Matrix3::from_diagonal(&Vector3::new(i, i, 0.0)),
            }
        };
        let turn = UnitQuaternion::from_euler_angles(0.3, -0.8, 1.1);
        let at = |z: f64| {
            rod(0.5, 1.0).moved(&Isometry3::from_parts(
                Translation3::from(turn * Vector3::new(0.0, 0.0, z)),
                turn,
            ))
        };
        let whole = at(0.25).joined(&at(-0.25));
        let expected = rod(1.0, 2.0).moved(&Isometry3::from_parts(Translation3::identity(), turn));
        assert!((whole.com_m - expected.com_m).norm() < 1e-15);
        assert!((whole.inertia_kg_m2 - expected.inertia_kg_m2).norm() < 1e-15);
    }
}
