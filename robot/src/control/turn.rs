//! The tip's orientation through the same third-order limited filter as its position, and the limits of turning.

use core::f64::consts::{PI, TAU};

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use telemime_sim::arm::{ArmModel, Dynamics, Joints};

use super::posture::{ACCELERATION_CAP, headroom, turned_around};
use super::resolve::turning_rates;
use super::{ControlError, FilterConfig, FilterError, FilterState, LimitedFilter};

/// A target this close to half a turn away, rad, is approached the way round that the output already turns: noise about
/// half a turn must not send it to and fro.
const EITHER_WAY_RAD: f64 = 0.2;

/// Share of the joints' speed that turning is given: it is needed for the tip's way at the same time.
const SPEED_SHARE: f64 = 0.8;

/// The same of their acceleration and torque.
const SHARE: f64 = 0.5;

/// A quaternion whose squared norm is farther than this from 1 is no orientation.
const UNIT_TOLERANCE: f64 = 1e-3;

/// Speed, acceleration and jerk of the tip's rotation, about any axis.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TurnLimits {
    /// rad/s.
    pub v_max: f64,
    /// rad/s².
    pub a_max: f64,
    /// rad/s³.
    pub j_max: f64,
}

impl TurnLimits {
    /// These limits, lowered to what the joints allow at `q` about the worst axis that the arm can turn about there without moving its tip, by the
    /// rules of [`CartesianLimits::lowered`](super::CartesianLimits::lowered). An arm that cannot turn at all leaves them as they are.
    ///
    /// # Errors
    /// [`ControlError::TooWeak`] if a joint cannot carry the arm at `q`.
    pub fn lowered(self, arm: &ArmModel, q: &Joints, dt_s: f64) -> Result<Self, ControlError> {
        let mut dynamics = Dynamics::new();
        dynamics.update(arm, q);
        let rates = turning_rates(&dynamics.kinematics().jacobian());
        let torques = dynamics.mass_matrix() * rates;
        let headroom = headroom(arm, &mut dynamics)?;
        let mut limits = self;
        for (i, joint) in arm.joints().iter().enumerate() {
            let rate = rates.row(i).norm();
            limits.v_max = limits.v_max.min(SPEED_SHARE * joint.velocity / rate);
            limits.a_max = limits
                .a_max
                .min(SHARE * joint.acceleration.min(ACCELERATION_CAP) / rate)
                .min(SHARE * headroom[i] / torques.row(i).norm());
        }
        limits.a_max = limits
            .a_max
            .min(turned_around(limits.v_max, limits.j_max, dt_s));
        Ok(limits)
    }
}

/// Orientation and its derivatives at the filter's output, in base axes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TurnState {
    /// Tip axes to base axes.
    pub orientation: UnitQuaternion<f64>,
    /// rad/s.
    pub angular_velocity: Vector3<f64>,
    /// rad/s².
    pub angular_acceleration: Vector3<f64>,
}

/// A [`LimitedFilter`] on the rotations: each tick it runs in the chart of rotation vectors around its own output, where the output is 0 and the
/// target is log(q_target·q⁻¹), and then q ← exp(p)·q. Its lag is the same 3/ω, so that orientation and position stay in step.
///
/// In base axes angular velocity is an ordinary vector with the angular acceleration as its derivative, so that both are carried from chart to chart
/// unchanged and the limits hold exactly; within a tick the chart differs from the group by h²/4·|ω × α|, a ten-thousandth of what a tick may change.
#[derive(Clone, Debug)]
pub struct TurnFilter {
    chart: LimitedFilter,
    orientation: UnitQuaternion<f64>,
}

impl TurnFilter {
    /// A filter at rest at `orientation`. The units of `config` are rad instead of m.
    ///
    /// # Errors
    /// [`FilterError`] says which value of `config` is impossible.
    pub fn new(
        config: FilterConfig,
        orientation: UnitQuaternion<f64>,
    ) -> Result<Self, FilterError> {
        Ok(Self {
            chart: LimitedFilter::new(config, Vector3::zeros())?,
            orientation,
        })
    }

    /// The configuration.
    pub fn config(&self) -> &FilterConfig {
        self.chart.config()
    }

    /// Goes on from `state`.
    pub(super) fn restore(&mut self, state: TurnState) {
        self.orientation = state.orientation;
        self.chart.restore(FilterState {
            p: Vector3::zeros(),
            v: state.angular_velocity,
            a: state.angular_acceleration,
        });
    }

    /// The output.
    pub fn state(&self) -> TurnState {
        let FilterState { v, a, .. } = *self.chart.state();
        TurnState {
            orientation: self.orientation,
            angular_velocity: v,
            angular_acceleration: a,
        }
    }

    /// Whether the output neither turns nor begins to.
    pub fn at_rest(&self) -> bool {
        let FilterState { v, a, .. } = self.chart.state();
        v.norm_squared() + a.norm_squared() == 0.0
    }

    /// Rest at `orientation`.
    pub fn reset(&mut self, orientation: UnitQuaternion<f64>) {
        self.orientation = orientation;
        self.chart.reset(Vector3::zeros());
    }

    /// One tick towards `target`; `speed_scale` as in [`LimitedFilter::follow`]. A quaternion and its negative are the same target.
    /// Returns whether a limit was active. A target or scale that is not finite stops instead.
    pub fn follow(&mut self, target: UnitQuaternion<f64>, speed_scale: f64) -> bool {
        let limited = self.chart.follow(self.way_to(&target), speed_scale);
        self.absorb();
        limited
    }

    /// One tick towards rest, as [`LimitedFilter::stop`].
    pub fn stop(&mut self) -> bool {
        let limited = self.chart.stop();
        self.absorb();
        limited
    }

    /// Turns the output by `by` (rotation vector in base axes, rad) and takes away what of its velocity leaves `velocity` (rad/s) against it: used where
    /// the arm cannot follow, so that what comes next starts from what it does.
    pub(super) fn hold_back(&mut self, by: Vector3<f64>, velocity: Vector3<f64>) {
        let Some(inward) = by.try_normalize(0.0) else {
            return;
        };
        let v = self.chart.state().v;
        let leaving = (v - velocity).dot(&inward).min(0.0);
        self.chart.hold_back(by, v - inward * leaving);
        self.absorb();
    }

    /// The rotation vector to `target`, rad.
    fn way_to(&self, target: &UnitQuaternion<f64>) -> Vector3<f64> {
        let way = rotation_between(&self.orientation, target);
        let angle = way.norm();
        if angle > PI - EITHER_WAY_RAD && way.dot(&self.chart.state().v) < 0.0 {
            way * (1.0 - TAU / angle)
        } else {
            way
        }
    }

    fn absorb(&mut self) {
        let step = UnitQuaternion::from_scaled_axis(self.chart.recentre());
        self.orientation = UnitQuaternion::new_normalize((step * self.orientation).into_inner());
    }
}

/// The rotation that takes `from` to `to`, the short way round, as an axis times an angle in base axes, rad.
pub(super) fn rotation_between(
    from: &UnitQuaternion<f64>,
    to: &UnitQuaternion<f64>,
) -> Vector3<f64> {
    (to * from.inverse()).scaled_axis()
}

/// `q` made exactly unit, if it is finite and nearly so.
pub(super) fn checked(q: &UnitQuaternion<f64>) -> Option<UnitQuaternion<f64>> {
    let off = (q.as_ref().norm_squared() - 1.0).abs();
    (off <= UNIT_TOLERANCE).then(|| UnitQuaternion::new_normalize(q.into_inner()))
}

#[cfg(test)]
mod tests {
    use nalgebra::Quaternion;
    use proptest::prelude::*;

    use super::*;

    const CONFIG: FilterConfig = FilterConfig {
        omega: 45.0,
        v_max: 2.5,
        a_max: 25.0,
        j_max: 12_500.0,
        dt_s: 1e-3,
    };

    fn filter(config: FilterConfig) -> TurnFilter {
        TurnFilter::new(config, UnitQuaternion::identity()).unwrap()
    }

    fn turn(axis: [f64; 3]) -> UnitQuaternion<f64> {
        UnitQuaternion::from_scaled_axis(axis.into())
    }

    fn negative(q: &UnitQuaternion<f64>) -> UnitQuaternion<f64> {
        UnitQuaternion::new_unchecked(-q.into_inner())
    }

    #[derive(Clone, Debug)]
    enum Move {
        Jump([f64; 3]),
        /// Half a turn, and a little more or less, about the axis that it turns about.
        HalfTurn(f64),
        Spin([f64; 3]),
        Nonsense,
        Stop,
        /// The arm did not follow.
        HoldBack([f64; 3]),
    }

    fn moves() -> impl Strategy<Value = (Move, f64, usize)> {
        let vector = |most: f64| prop::array::uniform3(-most..most);
        let kind = prop_oneof![
            vector(3.0).prop_map(Move::Jump),
            (-0.3..0.3_f64).prop_map(Move::HalfTurn),
            vector(8.0).prop_map(Move::Spin),
            Just(Move::Nonsense),
            Just(Move::Stop),
            vector(0.05).prop_map(Move::HoldBack),
        ];
        (kind, 0.0..1.2_f64, 1..150_usize)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        /// What is measured is what the orientations do, not what the filter says of itself.
        #[test]
        fn limits_hold_whatever_the_target_does(
            plan in prop::collection::vec(moves(), 1..25),
            omega in 5.0..200.0_f64,
            v_max in 0.05..4.0_f64,
            a_max in 0.5..40.0_f64,
            j_max in 200.0..15_000.0_f64,
        ) {
            let config = FilterConfig { omega, v_max, a_max, j_max, dt_s: 1e-3 };
            let Ok(mut f) = TurnFilter::new(config, UnitQuaternion::identity()) else {
                return Ok(());
            };
            for (kind, scale, ticks) in plan {
                for tick in 0..ticks {
                    let before = f.state();
                    let axis = before.angular_velocity.try_normalize(1e-9).unwrap_or(Vector3::z());
                    match &kind {
                        Move::Jump(x) => f.follow(turn(*x), scale),
                        Move::HalfTurn(x) => f.follow(
                            UnitQuaternion::from_scaled_axis(axis * (PI + x)) * before.orientation,
                            scale,
                        ),
                        Move::Spin(x) => f.follow(turn((Vector3::from(*x) * (tick as f64 * 1e-3)).into()), scale),
                        Move::Nonsense => f.follow(
                            UnitQuaternion::new_unchecked(Quaternion::new(f64::NAN, 0.0, 0.0, 1.0)),
                            scale,
                        ),
                        Move::Stop => f.stop(),
                        Move::HoldBack(by) => {
                            f.hold_back(Vector3::from(*by), Vector3::zeros());
                            let speed = f.state().angular_velocity.norm();
                            prop_assert!(speed <= v_max * (1.0 + 1e-9));
                            continue;
                        }
                    };
                    let after = f.state();
                    let speed = rotation_between(&before.orientation, &after.orientation).norm() / 1e-3;
                    let jerk = (after.angular_acceleration - before.angular_acceleration).norm() / 1e-3;
                    // The velocity between two ticks may pass that at the ticks by what the jerk bends it.
                    prop_assert!(speed <= v_max * (1.0 + 1e-9) + j_max * 1e-6, "{speed}");
                    prop_assert!(after.angular_velocity.norm() <= v_max * (1.0 + 1e-9));
                    prop_assert!(after.angular_acceleration.norm() <= a_max * (1.0 + 1e-9));
                    prop_assert!(jerk <= j_max * (1.0 + 1e-6), "{jerk}");
                    prop_assert!((after.orientation.as_ref().norm() - 1.0).abs() < 1e-12);
                }
            }
        }

        #[test]
        fn any_turn_arrives_without_overshoot_and_signs_do_not_matter(
            axis in prop::array::uniform3(-1.0..1.0_f64),
            angle in 0.1..PI,
            omega in 15.0..90.0_f64,
        ) {
            let Some(axis) = Vector3::from(axis).try_normalize(1e-3) else {
                return Ok(());
            };
            let target = UnitQuaternion::from_scaled_axis(axis * angle);
            let config = FilterConfig { omega, ..CONFIG };
            let (mut f, mut other) = (filter(config), filter(config));
            let mut beyond = 0.0_f64;
            for tick in 0..4000 {
                f.follow(target, 1.0);
                other.follow(if tick % 2 == 0 { negative(&target) } else { target }, 1.0);
                let turned = f.state().orientation.angle();
                beyond = beyond.max(turned - angle);
            }
            prop_assert!(f.state().orientation.angle_to(&target) < 1e-6);
            prop_assert!(other.state().orientation.angle_to(&f.state().orientation) < 1e-9);
            prop_assert!(beyond < 5e-3, "{beyond} rad");
        }
    }

    #[test]
    fn a_steady_turn_is_followed_three_over_omega_late() {
        let mut f = filter(CONFIG);
        let velocity = Vector3::new(0.4, -0.3, 0.8);
        let target = |t: f64| UnitQuaternion::from_scaled_axis(velocity * t);
        for tick in 0..6000 {
            f.follow(target(f64::from(tick) * CONFIG.dt_s), 1.0);
        }
        let late = f
            .state()
            .orientation
            .angle_to(&target(6.0 - 3.0 / CONFIG.omega));
        assert!(late < 1e-9, "{late} rad");
        assert!((f.state().angular_velocity - velocity).norm() < 1e-9);
    }

    #[test]
    fn noise_about_half_a_turn_does_not_send_it_to_and_fro() {
        let mut f = filter(CONFIG);
        let mut least = f64::INFINITY;
        for tick in 0..3000 {
            let noise = if tick % 2 == 0 { 0.05 } else { -0.05 };
            f.follow(turn([0.0, 0.0, PI + noise]), 1.0);
            if (100..800).contains(&tick) {
                least = least.min(f.state().angular_velocity.norm());
            }
        }
        assert!(least > 0.5, "{least} rad/s");
        assert!(
            f.state()
                .orientation
                .angle_to(&turn([0.0, 0.0, core::f64::consts::PI]))
                < 0.06
        );
    }

    #[test]
    fn what_is_no_orientation_is_found() {
        let q = |w: f64, x: f64| UnitQuaternion::new_unchecked(Quaternion::new(w, x, 0.0, 0.0));
        assert_eq!(checked(&q(f64::NAN, 0.0)), None);
        assert_eq!(checked(&q(f64::INFINITY, 0.0)), None);
        assert_eq!(checked(&q(0.0, 0.0)), None);
        assert_eq!(checked(&q(2.0, 0.0)), None);
        let near = checked(&q(0.8002, 0.6)).unwrap();
        assert!((near.as_ref().norm() - 1.0).abs() < 1e-15);
    }
}
