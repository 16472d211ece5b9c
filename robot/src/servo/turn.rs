//! The hand's orientation, ahead of its newest sample or along a plan.

use nalgebra::{Quaternion, SVector, UnitQuaternion, Vector3};
use telemime_endpoint::Mono;
use telemime_protocol::spline::BSpline;

/// Share of the last angular velocity that is expected to go on.
const DAMPING: f64 = 0.5;

/// For how long it is expected to, s; from then on the orientation holds.
const REACH_S: f64 = 0.3;

/// A point of an orientation's curve that is shorter than this is none: the curve passed between a quaternion and its negative.
const LEAST_NORM: f64 = 0.1;

/// What is known of the hand's orientation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Turn {
    /// When it was valid.
    pub valid_at: Mono,
    /// Hand axes turned from the axes that positions are in.
    pub orientation: UnitQuaternion<f64>,
    /// In those axes.
    pub angular_velocity_rad_s: Vector3<f64>,
}

impl Turn {
    /// The orientation at `at`: damped constant angular velocity, then hold.
    pub fn at(&self, at: Mono) -> UnitQuaternion<f64> {
        let ahead_s = at.secs_since(self.valid_at).clamp(0.0, REACH_S);
        UnitQuaternion::from_scaled_axis(self.angular_velocity_rad_s * (ahead_s * DAMPING))
            * self.orientation
    }

    /// Whether all of it is finite, and the quaternion one of a rotation.
    pub fn is_valid(&self) -> bool {
        let off = (self.orientation.as_ref().norm_squared() - 1.0).abs();
        off < 1e-3 && self.angular_velocity_rad_s.iter().all(|x| x.is_finite())
    }
}

/// The orientation of a curve of quaternions (w, x, y, z) at `t_s`, within its span; `None` where the curve is none.
pub(super) fn orientation_of(curve: &BSpline<4>, t_s: f64) -> Option<UnitQuaternion<f64>> {
    let x = within(curve, t_s)?;
    UnitQuaternion::try_new(Quaternion::new(x[0], x[1], x[2], x[3]), LEAST_NORM)
}

/// The curve's value at `t_s`, or at the nearer end of its span.
pub(super) fn within<const D: usize>(curve: &BSpline<D>, t_s: f64) -> Option<SVector<f64, D>> {
    let (start_s, end_s) = curve.span_s();
    curve.eval(t_s.clamp(start_s, end_s)).ok().map(|jet| jet.x)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector4;
    use telemime_protocol::spline::End;

    use super::*;

    #[test]
    fn a_turn_goes_on_fading_and_then_holds() {
        let turn = Turn {
            valid_at: Mono(0),
            orientation: UnitQuaternion::from_euler_angles(0.3, -0.2, 1.0),
            angular_velocity_rad_s: Vector3::new(0.0, 0.0, 2.0),
        };
        let turned = |s: f64| turn.at(Mono(0).offset_by_secs(s)) * turn.orientation.inverse();
        assert_eq!(turned(-1.0).angle(), 0.0);
        assert!((turned(0.1).scaled_axis() - Vector3::z() * 0.1).norm() < 1e-12);
        assert!((turned(0.3).scaled_axis() - Vector3::z() * 0.3).norm() < 1e-12);
        assert_eq!(turned(0.3), turned(9.0));
        assert!(turn.is_valid());
        let spoilt = Turn {
            angular_velocity_rad_s: Vector3::new(f64::NAN, 0.0, 0.0),
            ..turn
        };
        assert!(!spoilt.is_valid());
    }

    #[test]
    fn a_curve_is_read_within_its_span_and_made_unit() {
        let t = [0.0, 1.0, 2.0, 3.0];
        let turned = |a: f64| UnitQuaternion::from_scaled_axis(Vector3::x() * a);
        let points = t.map(|a| {
            let q = turned(0.6 * a);
            Vector4::new(q.w, q.i, q.j, q.k)
        });
        let curve = BSpline::interpolate(&t, &points, End::Natural).unwrap();
        for (t_s, angle) in [(-1.0, 0.0), (1.0, 0.6), (1.5, 0.9), (8.0, 1.8)] {
            let q = orientation_of(&curve, t_s).unwrap();
            assert!((q.as_ref().norm() - 1.0).abs() < 1e-15);
            assert!(q.angle_to(&turned(angle)) < 5e-3, "{t_s}");
        }
        // From a quaternion straight to its negative.
        let points = [1.0, 0.5, -0.5, -1.0].map(|w| Vector4::new(w, 0.0, 0.0, 0.0));
        let curve = BSpline::interpolate(&t, &points, End::Natural).unwrap();
        assert_eq!(orientation_of(&curve, 1.5), None);
        assert_eq!(orientation_of(&curve, f64::NAN), None);
    }
}
