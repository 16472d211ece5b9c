//! Rotations as a manifold: logarithm, exponential, transport and mean of unit quaternions.
//!
//! A rotation near `a` is written as the vector `log(a⁻¹·b)` (rad, in the axes of `a`): length is angle,
//! direction is axis. q and −q are the same rotation, and every function here treats them so.
//! Solà, Deray, Atchuthan 2018, "A micro Lie theory", eqs. (25), (26), (133), (138).

use nalgebra::{Quaternion, UnitQuaternion, Vector3, Vector4};

/// Below this angle the series is exact to the last bit of a double, rad.
const SMALL_RAD: f64 = 1e-4;

/// A mean is found when the next step is shorter than this, rad.
const MEAN_FOUND_RAD: f64 = 1e-12;

/// Steps towards a mean; within a hemisphere it takes four or five.
const MEAN_STEPS: usize = 50;

/// The rotation vector of `q`, rad, of length at most π.
///
/// Antipodal-safe: `log(q) = log(−q)`. At exactly π the axis has two signs and one of them is returned.
pub fn log(q: &UnitQuaternion<f64>) -> Vector3<f64> {
    let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
    let v = q.imag() * sign;
    let sine = v.norm();
    if sine < SMALL_RAD {
        // asin(s)/s = 1 + s²/6 + O(s⁴)
        return v * (2.0 + sine * sine / 3.0);
    }
    v * (2.0 * libm::atan2(sine, q.w * sign) / sine)
}

/// The rotation by the vector `v`, rad.
pub fn exp(v: &Vector3<f64>) -> UnitQuaternion<f64> {
    let half = 0.5 * v.norm();
    let (cosine, scale) = if half < SMALL_RAD {
        let square = half * half;
        (1.0 - 0.5 * square, 0.5 - square / 12.0)
    } else {
        (libm::cos(half), 0.5 * libm::sin(half) / half)
    };
    normalised(Quaternion::from_parts(cosine, v * scale))
}

/// What turns `from` into `to`: `log(from⁻¹·to)`, rad, in the axes of either.
pub fn between(from: &UnitQuaternion<f64>, to: &UnitQuaternion<f64>) -> Vector3<f64> {
    log(&(from.inverse() * to))
}

/// `from` turned by `by` (rad, in its own axes): `between(from, moved(from, by)) = by` up to an angle of π.
pub fn moved(from: &UnitQuaternion<f64>, by: &Vector3<f64>) -> UnitQuaternion<f64> {
    normalised((from * exp(by)).into_inner())
}

/// A vector of the tangent space at one rotation, carried along the geodesic to the rotation `by` (rad) away.
///
/// In the rotations' own axes, parallel transport (of the metric in which length is angle) turns by half of the way back.
pub fn transported(vector: &Vector3<f64>, by: &Vector3<f64>) -> Vector3<f64> {
    exp(&(by * -0.5)) * vector
}

/// The rotation from which the weighted squared angles to all others are least (Karcher mean), by
/// Gauss–Newton from the heaviest; `None` if there is nothing of weight above zero.
pub fn mean(
    rotations: impl Iterator<Item = (f64, UnitQuaternion<f64>)> + Clone,
) -> Option<UnitQuaternion<f64>> {
    let mut best = (0.0, None);
    let mut total = 0.0;
    for (weight, q) in rotations.clone() {
        total += weight;
        if weight > best.0 {
            best = (weight, Some(q));
        }
    }
    let mut mean = best.1?;
    for _ in 0..MEAN_STEPS {
        let mut step = Vector3::zeros();
        for (weight, q) in rotations.clone() {
            step += between(&mean, &q) * (weight / total);
        }
        mean = moved(&mean, &step);
        if step.norm() < MEAN_FOUND_RAD {
            break;
        }
    }
    Some(mean)
}

/// The rotation at a point of ℝ⁴ (w, x, y, z), where a spline through quaternions passes between them;
/// `None` so near the origin that the direction means nothing.
pub fn nearest(point: &Vector4<f64>) -> Option<UnitQuaternion<f64>> {
    let [w, x, y, z]: [f64; 4] = (*point).into();
    // Written so that NaN fails too.
    let clear = point.norm_squared() > 1e-4;
    clear.then(|| normalised(Quaternion::new(w, x, y, z)))
}

/// `q` as a point of ℝ⁴ (w, x, y, z): of q and −q the one nearer to `before`.
pub fn point(q: &UnitQuaternion<f64>, before: Option<&Vector4<f64>>) -> Vector4<f64> {
    let point = Vector4::new(q.w, q.i, q.j, q.k);
    if before.is_some_and(|b| b.dot(&point) < 0.0) {
        -point
    } else {
        point
    }
}

/// Rounding of products must not accumulate.
fn normalised(q: Quaternion<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::new_unchecked(q / q.norm_squared().sqrt())
}

#[cfg(test)]
mod tests {
    use core::f64::consts::PI;

    use proptest::prelude::*;

    use super::*;

    fn vector(most: f64) -> impl Strategy<Value = Vector3<f64>> {
        prop::array::uniform3(-1.0..1.0_f64)
            .prop_map(move |v| Vector3::from(v) * (most / 3f64.sqrt()))
    }

    proptest! {
        #[test]
        fn log_undoes_exp(v in vector(PI * 0.999_999)) {
            prop_assert!((log(&exp(&v)) - v).norm() < 1e-12);
            let q = exp(&v);
            let other = UnitQuaternion::new_unchecked(-q.into_inner());
            prop_assert_eq!(log(&q), log(&other));
        }

        #[test]
        fn small_angles_are_exact(v in vector(3e-4)) {
            let q = UnitQuaternion::from_scaled_axis(v);
            prop_assert!((exp(&v).coords - q.coords).norm() < 1e-15);
            prop_assert!((log(&q) - v).norm() < 1e-15);
        }

        #[test]
        fn moving_and_back(a in vector(3.0), b in vector(3.0)) {
            let (p, q) = (exp(&a), exp(&b));
            prop_assert!(moved(&p, &between(&p, &q)).angle_to(&q) < 1e-7);
            // The axis of a rotation is not turned by it: the vector is the same in the axes of either end.
            prop_assert!((between(&p, &q) + between(&q, &p)).norm() < 1e-12);
        }

        #[test]
        fn transport_keeps_lengths_and_the_way_itself(v in vector(2.0), by in vector(3.0)) {
            prop_assert!((transported(&v, &by).norm() - v.norm()).abs() < 1e-12);
            prop_assert!((transported(&by, &by) - by).norm() < 1e-12);
        }

        #[test]
        fn the_mean_has_no_gradient(
            centre in vector(3.0),
            rest in prop::collection::vec((0.1..1.0_f64, vector(1.2), any::<bool>()), 1..8),
        ) {
            let centre = exp(&centre);
            let rotations: Vec<_> = rest
                .iter()
                .map(|(w, v, flip)| {
                    let q = moved(&centre, v);
                    (*w, if *flip { UnitQuaternion::new_unchecked(-q.into_inner()) } else { q })
                })
                .collect();
            let mean = mean(rotations.iter().copied()).unwrap();
            let gradient: Vector3<f64> = rotations.iter().map(|(w, q)| between(&mean, q) * *w).sum();
            prop_assert!(gradient.norm() < 1e-10, "{gradient}");
        }
    }

    #[test]
    fn transport_is_parallel() {
        let way = Vector3::new(0.3, -0.8, 0.5);
        let vector = Vector3::new(1.0, 0.2, -0.4);
        let mut stepwise = vector;
        for _ in 0..1000 {
            stepwise = transported(&stepwise, &(way / 1000.0));
        }
        assert!((stepwise - transported(&vector, &way)).norm() < 1e-12);
        let back = transported(&transported(&vector, &way), &-way);
        assert!((back - vector).norm() < 1e-14);
        // The covariant derivative of the left-invariant field v along w is ½[w, v] = ½ w × v.
        let h = 1e-6;
        let derivative = (vector - transported(&vector, &(way * h))) / h;
        assert!((derivative - way.cross(&vector) * 0.5).norm() < 1e-6);
    }

    #[test]
    fn no_rotation_has_no_mean_and_the_origin_no_direction() {
        assert_eq!(mean([].into_iter()), None);
        assert_eq!(mean([(0.0, UnitQuaternion::identity())].into_iter()), None);
        assert_eq!(nearest(&Vector4::zeros()), None);
        assert_eq!(nearest(&Vector4::repeat(f64::NAN)), None);
    }

    #[test]
    fn points_lie_on_one_side() {
        let q = exp(&Vector3::new(0.1, 0.2, 0.3));
        let p = point(&q, None);
        assert_eq!(point(&q, Some(&-p)), -p);
        assert!(nearest(&(-p * 0.9)).unwrap().angle_to(&q) < 1e-12);
    }
}
