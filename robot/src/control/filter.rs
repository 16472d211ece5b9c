//! The third-order limited filter between the prediction and the arm.

use nalgebra::Vector3;

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
#[derive(Clone, Copy, Debug, PartialEq)]
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
/// With e = target − p it is a cascade of saturations (`notes` on driving: one filter, no double compensation):
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

    /// Rest at `p`.
    pub fn reset(&mut self, p: Vector3<f64>) {
        self.state = FilterState::at_rest(p);
    }

    /// Moves the output by `by` metres without touching its velocity: used where the arm cannot follow.
    pub(super) fn shift(&mut self, by: Vector3<f64>) {
        self.state.p += by;
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
fn limited(x: Vector3<f64>, max: f64) -> (Vector3<f64>, bool) {
    let norm = x.norm();
    if norm > max {
        (x * (max / norm), true)
    } else {
        (x, false)
    }
}
