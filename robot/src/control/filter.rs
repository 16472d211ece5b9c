//! The third-order limited filter between the prediction and the arm.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// Limits and bandwidth of a [`LimitedFilter`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FilterConfig {
    /// All three poles lie at −ω, rad/s: the lag behind a ramp is 3/ω.
    pub omega: f64,
    /// Largest speed, m/s.
    pub v_max: f64,
    /// Largest acceleration, m/s².
    pub a_max: f64,
    /// Largest jerk, m/s³.
    pub j_max: f64,
    /// Tick, s.
    pub dt_s: f64,
}

/// Why a [`FilterConfig`] is refused.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum FilterError {
    /// A value that is not a positive number.
    #[error("{what} is {value}; it must be a positive number")]
    NotPositive {
        /// Which value.
        what: &'static str,
        /// The value.
        value: f64,
    },
    /// Too fast for the tick: the acceleration loop, 3ω, would overshoot within one tick.
    #[error("omega {omega} rad/s is too fast for a tick of {dt_s} s: 3·omega·dt must be at most 1")]
    TooFast {
        /// Bandwidth, rad/s.
        omega: f64,
        /// Tick, s.
        dt_s: f64,
    },
    /// The jerk limit cannot turn full acceleration around within the velocity limit.
    #[error("j_max {j_max} m/s³ is too small: a_max²/j_max + a_max·dt must be below v_max")]
    JerkTooSmall {
        /// Jerk limit, m/s³.
        j_max: f64,
    },
}

/// Position, velocity and acceleration of the filter's output.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FilterState {
    /// Position, m.
    pub p: Vector3<f64>,
    /// Velocity, m/s.
    pub v: Vector3<f64>,
    /// Acceleration, m/s².
    pub a: Vector3<f64>,
}

impl FilterState {
    /// At rest at `p`.
    pub fn at_rest(p: Vector3<f64>) -> Self {
        Self {
            p,
            v: Vector3::zeros(),
            a: Vector3::zeros(),
        }
    }
}

/// A filter whose output's speed, acceleration and jerk never exceed their limits, whatever the target does.
///
/// With e = target − p it is a cascade of saturations, its own velocity and acceleration being what the arm is fed with:
///
/// - v_cmd = ω/3·e, at most v_max, and at most the speed from which braking at 0.8·a_max ends at the target;
/// - a_cmd = ω·(v_cmd − v), at most a_max;
/// - j = 3ω·(a_cmd − a), at most j_max.
///
/// While nothing saturates, j = ω³e − 3ω²v − 3ωa exactly, and a ramp is followed 3/ω late. The jerk is held for a tick and integrated exactly.
///
/// Invariant, at every tick: |a| ≤ a_max, |v| ≤ v_max, and the velocity reached by taking the acceleration to zero at j_max is
/// within v_max too. A jerk that would break it is blended towards the one that takes the acceleration to zero, which keeps it.
#[derive(Clone, Debug)]
pub struct LimitedFilter {
    config: FilterConfig,
    state: FilterState,
}

impl LimitedFilter {
    /// A filter at rest at `p`.
    ///
    /// # Errors
    /// [`FilterError`] says which value of `config` is impossible.
    pub fn new(config: FilterConfig, p: Vector3<f64>) -> Result<Self, FilterError> {
        let c = &config;
        for (what, value) in [
            ("omega", c.omega),
            ("v_max", c.v_max),
            ("a_max", c.a_max),
            ("j_max", c.j_max),
            ("dt_s", c.dt_s),
        ] {
            if !(value.is_finite() && value > 0.0) {
                return Err(FilterError::NotPositive { what, value });
            }
        }
        if 3.0 * c.omega * c.dt_s > 1.0 {
            return Err(FilterError::TooFast {
                omega: c.omega,
                dt_s: c.dt_s,
            });
        }
        if c.a_max * c.a_max / c.j_max + c.a_max * c.dt_s >= c.v_max {
            return Err(FilterError::JerkTooSmall { j_max: c.j_max });
        }
        Ok(Self {
            config,
            state: FilterState::at_rest(p),
        })
    }

    /// The configuration.
    pub fn config(&self) -> &FilterConfig {
        &self.config
    }

    /// The output.
    pub fn state(&self) -> &FilterState {
        &self.state
    }

    /// Goes on from `state`.
    pub(super) fn restore(&mut self, state: FilterState) {
        self.state = state;
    }

    /// Rest at `p`.
    pub fn reset(&mut self, p: Vector3<f64>) {
        self.state = FilterState::at_rest(p);
    }

    /// Moves the output by `by` metres and gives it the velocity `v`: used where the arm cannot follow, so that what comes next starts from what it does.
    pub(super) fn hold_back(&mut self, by: Vector3<f64>, v: Vector3<f64>) {
        self.state.p += by;
        self.state.v = limited(v, self.config.v_max).0;
        if !self.keeps_invariant(&self.state) {
            self.state.a = Vector3::zeros();
        }
    }

    /// Makes the output the origin, velocity and acceleration unchanged; returns where it was.
    pub(super) fn recentre(&mut self) -> Vector3<f64> {
        core::mem::take(&mut self.state.p)
    }

    /// One tick towards `target`, m. `speed_scale` ∈ [0, 1] multiplies the commanded velocity: 0 fades to a stop.
    /// Returns whether a limit was active. A target or scale that is not finite stops instead.
    pub fn follow(&mut self, target: Vector3<f64>, speed_scale: f64) -> bool {
        if !target.iter().all(|x| x.is_finite()) || !speed_scale.is_finite() {
            return self.stop();
        }
        let FilterConfig { omega, .. } = self.config;
        let FilterState { p, v, a } = self.state;
        let (approach, fast) = self.approach(target - p);
        let v_cmd = approach * speed_scale.clamp(0.0, 1.0);
        let (a_cmd, hard) = limited((v_cmd - v) * omega, self.config.a_max);
        let (j, jerky) = limited((a_cmd - a) * (3.0 * omega), self.config.j_max);
        self.advance(j) | fast | hard | jerky
    }

    /// One tick towards rest: decelerates along the velocity within the limits of acceleration and jerk, never past zero except as far as an
    /// acceleration that already points backwards cannot be undone in time. Returns whether a limit was active.
    pub fn stop(&mut self) -> bool {
        let FilterConfig {
            a_max, j_max, dt_s, ..
        } = self.config;
        let FilterState { v, a, .. } = self.state;
        let (speed, acceleration) = (v.norm(), a.norm());
        if speed < 1e-5 && acceleration < 0.01 * j_max * dt_s {
            self.state = FilterState::at_rest(self.state.p);
            return false;
        }
        // Exponential at the end: its jerk, rate·a_max at most, leaves half of j_max to get onto it.
        let rate = (0.125 / dt_s).min(0.5 * j_max / a_max);
        let (a_cmd, _) = limited(-v * rate, a_max);
        let (j, jerky) = limited((a_cmd - a) / dt_s, j_max);
        self.advance(j) | jerky
    }

    /// The velocity to approach a target at `e` with: linear near it, then the speed from which braking at 0.8·a_max stops there
    /// (both meet with equal slope), at most v_max.
    fn approach(&self, e: Vector3<f64>) -> (Vector3<f64>, bool) {
        let FilterConfig { omega, a_max, .. } = self.config;
        let (gain, braking) = (omega / 3.0, 0.8 * a_max);
        let distance = e.norm();
        let linear = braking / (gain * gain);
        if distance <= linear {
            return limited(e * gain, self.config.v_max);
        }
        let speed = (2.0 * braking * (distance - 0.5 * linear)).sqrt();
        (e * (speed.min(self.config.v_max) / distance), true)
    }

    /// Integrates a jerk over a tick, reduced as far as the invariant needs; returns whether it was.
    fn advance(&mut self, jerk: Vector3<f64>) -> bool {
        let wanted = self.after(jerk);
        if self.keeps_invariant(&wanted) {
            self.state = wanted;
            return false;
        }
        let FilterConfig { j_max, dt_s, .. } = self.config;
        let (relief, _) = limited(-self.state.a / dt_s, j_max);
        let (mut kept, mut broken) = (0.0, 1.0);
        let mut next = self.after(relief);
        for _ in 0..20 {
            let blend = 0.5 * (kept + broken);
            let candidate = self.after(relief.lerp(&jerk, blend));
            if self.keeps_invariant(&candidate) {
                (kept, next) = (blend, candidate);
            } else {
                broken = blend;
            }
        }
        self.state = next;
        true
    }

    fn after(&self, j: Vector3<f64>) -> FilterState {
        let FilterState { p, v, a } = self.state;
        let h = self.config.dt_s;
        FilterState {
            p: p + v * h + a * (h * h / 2.0) + j * (h * h * h / 6.0),
            v: v + a * h + j * (h * h / 2.0),
            a: a + j * h,
        }
    }

    fn keeps_invariant(&self, s: &FilterState) -> bool {
        let FilterConfig {
            v_max,
            a_max,
            j_max,
            dt_s,
            ..
        } = self.config;
        let acceleration = s.a.norm();
        // h/2 on top of |a|/2j covers the last, partial tick of taking the acceleration to zero.
        let settled = s.v + s.a * (0.5 * acceleration / j_max + 0.5 * dt_s);
        acceleration <= a_max && s.v.norm() <= v_max && settled.norm() <= v_max
    }
}

/// `x` shortened to length `max`, and whether it was.
pub(super) fn limited(x: Vector3<f64>, max: f64) -> (Vector3<f64>, bool) {
    let norm = x.norm();
    if norm > max {
        (x * (max / norm), true)
    } else {
        (x, false)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const CONFIG: FilterConfig = FilterConfig {
        omega: 45.0,
        v_max: 1.7,
        a_max: 13.0,
        j_max: 6500.0,
        dt_s: 1e-3,
    };

    fn filter(config: FilterConfig) -> LimitedFilter {
        LimitedFilter::new(config, Vector3::zeros()).unwrap()
    }

    /// The jerk is not part of the state: it is what changed the acceleration.
    fn assert_within(config: &FilterConfig, before: &FilterState, after: &FilterState) {
        let slack = 1.0 + 1e-9;
        let jerk = (after.a - before.a).norm() / config.dt_s;
        assert!(after.v.norm() <= config.v_max * slack, "{}", after.v.norm());
        assert!(after.a.norm() <= config.a_max * slack, "{}", after.a.norm());
        assert!(jerk <= config.j_max * (1.0 + 1e-6), "{jerk}");
    }

    #[derive(Clone, Debug)]
    enum Move {
        Jump([f64; 3]),
        /// Demand against the present velocity, metres ahead of the output.
        Against(f64),
        Ramp([f64; 3]),
        Stop,
    }

    fn moves() -> impl Strategy<Value = (Move, f64, usize)> {
        let vector = || prop::array::uniform3(-3.0..3.0_f64);
        let kind = prop_oneof![
            vector().prop_map(Move::Jump),
            (-3.0..3.0_f64).prop_map(Move::Against),
            vector().prop_map(Move::Ramp),
            Just(Move::Stop),
        ];
        (kind, 0.0..1.2_f64, 1..150_usize)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        #[test]
        fn limits_hold_whatever_the_target_does(
            plan in prop::collection::vec(moves(), 1..25),
            omega in 5.0..200.0_f64,
            v_max in 0.05..3.0_f64,
            a_max in 0.5..30.0_f64,
            j_max in 200.0..9000.0_f64,
        ) {
            let config = FilterConfig { omega, v_max, a_max, j_max, dt_s: 1e-3 };
            let Ok(mut f) = LimitedFilter::new(config, Vector3::zeros()) else {
                return Ok(());
            };
            for (kind, scale, ticks) in plan {
                for tick in 0..ticks {
                    let before = *f.state();
                    match &kind {
                        Move::Jump(x) => f.follow((*x).into(), scale),
                        Move::Against(x) => f.follow(before.p - before.v.normalize() * *x, scale),
                        Move::Ramp(x) => f.follow(Vector3::from(*x) * (tick as f64 * 1e-3), scale),
                        Move::Stop => f.stop(),
                    };
                    assert_within(&config, &before, f.state());
                }
            }
        }

        #[test]
        fn a_far_step_arrives_without_overshoot(
            target in prop::array::uniform3(-1.0..1.0_f64),
            omega in 15.0..90.0_f64,
        ) {
            let target = Vector3::from(target);
            let mut f = filter(FilterConfig { omega, ..CONFIG });
            let mut beyond = 0.0_f64;
            for _ in 0..3000 {
                f.follow(target, 1.0);
                beyond = beyond.max((f.state().p.dot(&target.normalize())) - target.norm());
            }
            prop_assert!((f.state().p - target).norm() < 1e-6);
            prop_assert!(beyond < 2e-3, "{beyond} m");
        }

        #[test]
        fn stopping_goes_forward_and_ends_at_rest(
            target in prop::array::uniform3(-1.0..1.0_f64),
            ticks in 1..400_usize,
        ) {
            let mut f = filter(CONFIG);
            for _ in 0..ticks {
                f.follow(target.into(), 1.0);
            }
            let start = *f.state();
            let mut back = 0.0_f64;
            for _ in 0..800 {
                let before = f.state().p;
                f.stop();
                back = back.min((f.state().p - before).dot(&start.v));
            }
            // A brake that is already at work cannot be let go at once.
            let inevitable = start.a.norm().powi(2) / (2.0 * CONFIG.j_max) + CONFIG.a_max * CONFIG.dt_s;
            let slow = start.v.norm() < 2.0 * inevitable;
            prop_assert!(slow || back > -1e-9, "{back}");
            prop_assert_eq!(*f.state(), FilterState::at_rest(f.state().p));
            let way = (f.state().p - start.p).norm();
            let v = start.v.norm() + inevitable;
            prop_assert!(way < v * v / (2.0 * CONFIG.a_max) + v * 0.02 + 1e-4, "{way} m");
        }
    }

    #[test]
    fn linear_law_is_exact() {
        let mut f = filter(CONFIG);
        f.state = FilterState {
            p: Vector3::new(0.01, 0.0, -0.02),
            v: Vector3::new(0.05, -0.02, 0.01),
            a: Vector3::new(0.3, 0.1, -0.2),
        };
        let (target, before, w) = (Vector3::new(0.012, 0.001, -0.018), f.state, CONFIG.omega);
        assert!(!f.follow(target, 1.0));
        let jerk =
            (target - before.p) * w.powi(3) - before.v * (3.0 * w * w) - before.a * (3.0 * w);
        assert!((f.state.a - before.a - jerk * CONFIG.dt_s).norm() < 1e-12);
    }

    #[test]
    fn a_ramp_is_followed_three_over_omega_late() {
        let mut f = filter(CONFIG);
        let velocity = Vector3::new(0.3, -0.2, 0.1);
        for tick in 0..2000 {
            f.follow(velocity * (f64::from(tick) * CONFIG.dt_s), 1.0);
        }
        let late = velocity * (2000.0 * CONFIG.dt_s) - f.state.p;
        assert!((late - velocity * (3.0 / CONFIG.omega)).norm() < 1e-9);
    }

    #[test]
    fn scale_fades_speed_to_nothing() {
        let mut f = filter(CONFIG);
        for _ in 0..300 {
            f.follow(Vector3::x(), 1.0);
        }
        assert!(f.state.v.norm() > 1.0);
        for _ in 0..2000 {
            f.follow(Vector3::x() * 9.0, 0.0);
        }
        assert!(f.state.v.norm() < 1e-9);
    }

    #[test]
    fn nonsense_stops() {
        let mut f = filter(CONFIG);
        for _ in 0..300 {
            f.follow(Vector3::x(), 1.0);
        }
        for _ in 0..500 {
            f.follow(Vector3::new(f64::NAN, 0.0, f64::INFINITY), 1.0);
        }
        assert_eq!(f.state.v, Vector3::zeros());
        assert!(f.state.p.iter().all(|x| x.is_finite()));
    }

    #[test]
    fn impossible_configurations_are_refused() {
        let new = |c| LimitedFilter::new(c, Vector3::zeros()).map(|_| ());
        let bad = |c| new(c).unwrap_err();
        assert!(matches!(
            bad(FilterConfig {
                omega: f64::NAN,
                ..CONFIG
            }),
            FilterError::NotPositive { what: "omega", .. }
        ));
        assert!(matches!(
            bad(FilterConfig {
                omega: 400.0,
                ..CONFIG
            }),
            FilterError::TooFast { .. }
        ));
        assert!(matches!(
            bad(FilterConfig {
                j_max: 50.0,
                ..CONFIG
            }),
            FilterError::JerkTooSmall { .. }
        ));
    }
}
