//! From velocities of the tip to those of the joints, and the algebra for it.

use nalgebra::{Matrix3, Rotation3, SMatrix, SymmetricEigen, UnitQuaternion, Vector3};
use telemime_sim::arm::{ArmModel, Jacobian, Joints, MAX_JOINTS};

/// Below this the freedom to turn about an axis without moving the tip counts as near-singular, rad/rad.
const TURN_SINGULAR_BELOW: f64 = 0.2;

pub(super) type Rows = SMatrix<f64, 3, MAX_JOINTS>;

/// Velocity resolution by task priority: position first, orientation in its null space, posture in both.
pub(super) struct Resolved {
    pub(super) primary: Joints,
    pub(super) secondary: Joints,
    /// What of `secondary` is the posture's, the rest being the orientation's.
    pub(super) idle: Joints,
    /// Smallest singular value of the position Jacobian, m/rad.
    pub(super) sigma_min: f64,
}

/// Damped least squares: q̇ = Jᵀ(JJᵀ + λ²1)⁻¹v with λ² = (ε/2)²(1 − (σ/ε)²) where the smallest singular value σ is below ε
/// (Nakamura & Hanafusa 1986 with the damping of Chiaverini 1997), the second task in the first one's null space
/// (Nakamura 1987, eq. 4.12).
pub(super) fn resolve(
    jacobian: &Jacobian,
    tip_velocity: &Vector3<f64>,
    angular_velocity: &Vector3<f64>,
    posture_velocity: &Joints,
    epsilon: f64,
) -> Resolved {
    // 0.2 rad/rad: an arm of five axes never has a free rotation about every axis, and what it lacks must not be bought dearly.
    let calm = |gram: &Matrix3<f64>| damped_inverse(gram, 0.2 * 0.2);
    resolve_by(
        jacobian,
        tip_velocity,
        angular_velocity,
        posture_velocity,
        epsilon,
        calm,
    )
}

/// As [`resolve`], with the orientation followed as exactly as the arm's freedom allows.
pub(super) fn resolve_turning(
    jacobian: &Jacobian,
    tip_velocity: &Vector3<f64>,
    angular_velocity: &Vector3<f64>,
    posture_velocity: &Joints,
    epsilon: f64,
) -> Resolved {
    resolve_by(
        jacobian,
        tip_velocity,
        angular_velocity,
        posture_velocity,
        epsilon,
        selective_inverse,
    )
}

fn resolve_by(
    jacobian: &Jacobian,
    tip_velocity: &Vector3<f64>,
    angular_velocity: &Vector3<f64>,
    posture_velocity: &Joints,
    epsilon: f64,
    invert_freed: impl Fn(&Matrix3<f64>) -> Matrix3<f64>,
) -> Resolved {
    let linear: Rows = jacobian.fixed_rows::<3>(0).into();
    let angular: Rows = jacobian.fixed_rows::<3>(3).into();
    let gram = linear * linear.transpose();
    let sigma_min = min_eigenvalue(&gram).max(0.0).sqrt();
    let damping = if sigma_min < epsilon {
        0.25 * (epsilon * epsilon - sigma_min * sigma_min)
    } else {
        0.0
    };
    let inverse = damped_inverse(&gram, damping);
    let primary = linear.transpose() * (inverse * tip_velocity);
    let freed = angular - (angular * linear.transpose()) * inverse * linear;
    let inverse_freed = invert_freed(&(freed * freed.transpose()));
    let left_over = angular_velocity - angular * primary;
    let idle = posture_velocity - linear.transpose() * (inverse * (linear * posture_velocity));
    let secondary = idle + freed.transpose() * (inverse_freed * (left_over - freed * idle));
    Resolved {
        primary,
        secondary,
        idle: idle - freed.transpose() * (inverse_freed * (freed * idle)),
        sigma_min,
    }
}

fn damped_inverse(gram: &Matrix3<f64>, damping: f64) -> Matrix3<f64> {
    (gram + Matrix3::from_diagonal_element(damping))
        .try_inverse()
        .unwrap_or_else(Matrix3::zeros)
}

/// The inverse of `gram` axis by axis, damped only about those that the arm can hardly turn about (Maciejewski & Klein 1988): an arm of five axes
/// lacks one, and follows the others no worse for it.
fn selective_inverse(gram: &Matrix3<f64>) -> Matrix3<f64> {
    let Some(eigen) = SymmetricEigen::try_new(*gram, f64::EPSILON, 60) else {
        return damped_inverse(gram, TURN_SINGULAR_BELOW * TURN_SINGULAR_BELOW);
    };
    let most = TURN_SINGULAR_BELOW * TURN_SINGULAR_BELOW;
    let inverse = eigen.eigenvalues.map(|square| {
        let square = square.max(0.0);
        1.0 / (square + 0.25 * (most - square).max(0.0))
    });
    eigen.eigenvectors * Matrix3::from_diagonal(&inverse) * eigen.eigenvectors.transpose()
}

/// The joint speeds (columns) that turn the tip about each base axis at 1 rad/s without moving it, as far as the arm can.
pub(super) fn turning_rates(jacobian: &Jacobian) -> SMatrix<f64, MAX_JOINTS, 3> {
    let (zero, none) = (Vector3::zeros(), Joints::zeros());
    let column = |axis: Vector3<f64>| resolve_turning(jacobian, &zero, &axis, &none, 0.0).secondary;
    SMatrix::from_columns(&[
        column(Vector3::x()),
        column(Vector3::y()),
        column(Vector3::z()),
    ])
}

/// The rotation `axes` (columns: tip axes in base axes) as a quaternion.
pub(super) fn quaternion(axes: &Matrix3<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(*axes))
}

/// Smallest eigenvalue of a symmetric matrix (Smith 1961).
pub(super) fn min_eigenvalue(m: &Matrix3<f64>) -> f64 {
    let mean = m.trace() / 3.0;
    let off = m - Matrix3::from_diagonal_element(mean);
    let spread = (off.norm_squared() / 6.0).sqrt();
    if spread <= f64::EPSILON * mean.abs() {
        return mean;
    }
    let r = ((off / spread).determinant() / 2.0).clamp(-1.0, 1.0);
    mean + 2.0 * spread * (r.acos() / 3.0 + 2.0 * core::f64::consts::FRAC_PI_3).cos()
}

/// The rotation that takes `from` to `to`, as an axis times an angle in the base frame, rad.
pub(super) fn orientation_error(from: &Matrix3<f64>, to: &Matrix3<f64>) -> Vector3<f64> {
    UnitQuaternion::from_matrix_eps(
        &(to * from.transpose()),
        1e-12,
        50,
        UnitQuaternion::identity(),
    )
    .scaled_axis()
}

/// The smallest singular value below which a posture counts as near-singular, for an arm of this length.
pub(super) fn singular_below(arm: &ArmModel) -> f64 {
    0.08 * arm.chain_length_m()
}

/// The largest share in [0, 1] of `addend` that keeps `base + share·addend` within the bounds; `base` is within them.
pub(super) fn largest_share(base: &Joints, addend: &Joints, lower: &Joints, upper: &Joints) -> f64 {
    let mut share = 1.0_f64;
    for i in 0..MAX_JOINTS {
        let bound = if addend[i] > 0.0 { upper[i] } else { lower[i] };
        if addend[i] != 0.0 {
            share = share.min(((bound - base[i]) / addend[i]).max(0.0));
        }
    }
    share
}

/// The largest share in [0, 1] of `addend` that keeps |`base` + share·`addend`| within `radius`; 0 if there is none.
pub(super) fn share_within(base: &Vector3<f64>, addend: &Vector3<f64>, radius: f64) -> f64 {
    let (a, b) = (addend.norm_squared(), base.dot(addend));
    let c = base.norm_squared() - radius * radius;
    if a + 2.0 * b + c <= 0.0 {
        return 1.0;
    }
    // a > 0 here unless `base` itself is outside.
    let root = (b * b - a * c).max(0.0).sqrt();
    if a > 0.0 {
        ((root - b) / a).clamp(0.0, 1.0)
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::SymmetricEigen;
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn smallest_eigenvalue_is_nalgebras(x in prop::array::uniform9(-2.0..2.0_f64)) {
            let a = Matrix3::from_row_slice(&x);
            let m = a * a.transpose();
            let theirs = SymmetricEigen::new(m).eigenvalues.min();
            prop_assert!((min_eigenvalue(&m) - theirs).abs() < 1e-7 * m.trace().max(1e-3));
        }

        #[test]
        fn share_is_the_largest(base in -1.0..1.0_f64, addend in -9.0..9.0_f64) {
            let one = |x: f64| { let mut j = Joints::zeros(); j[2] = x; j };
            let share = largest_share(&one(base), &one(addend), &one(-1.0), &one(1.0));
            prop_assert!((0.0..=1.0).contains(&share));
            let reached = base + share * addend;
            prop_assert!(reached.abs() <= 1.0 + 1e-12);
            prop_assert!(share == 1.0 || reached.abs() > 1.0 - 1e-9);
        }
    }
}
