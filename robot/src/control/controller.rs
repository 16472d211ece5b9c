//! One tick from a demanded tip position to torques.

use std::sync::Arc;

use nalgebra::Vector3;
use telemime_sim::arm::{ArmModel, Joints, PlantError, check_start};

use super::ik::DifferentialIk;
use super::{
    CartesianLimits, ComputedTorque, FilterConfig, FilterError, FilterState, IkConfig,
    LimitedFilter, joint_accelerations,
};

/// The filter's reference may lead the joints' reference by this much, m; beyond, the arm cannot follow and the filter waits for it.
const LEASH_M: f64 = 0.002;

/// Bandwidth, limits and gains of a [`Controller`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ControlConfig {
    /// The filter's poles lie at −ω, rad/s: the tip lags the demand by 3/ω.
    pub omega: f64,
    /// Largest tip speed, acceleration and jerk; lowered to what the arm allows ([`CartesianLimits::lowered`]).
    pub limits: CartesianLimits,
    /// Bandwidth of the joints' torque control, rad/s.
    pub joint_bandwidth: f64,
    /// How fast the tip's orientation returns to that at the last reset, 1/s.
    pub orientation_gain: f64,
    /// How fast idle joints return to the start posture, 1/s.
    pub posture_gain: f64,
    /// Tick, s.
    pub dt_s: f64,
}

impl Default for ControlConfig {
    /// 1 kHz, and the tip limits of a published arm.
    fn default() -> Self {
        Self {
            omega: 45.0,
            limits: CartesianLimits {
                v_max: 1.7,
                a_max: 13.0,
                j_max: 6500.0,
            },
            joint_bandwidth: 80.0,
            orientation_gain: 8.0,
            posture_gain: 1.0,
            dt_s: 1e-3,
        }
    }
}

/// Why a controller cannot be made.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ControlError {
    /// The filter's configuration is impossible.
    #[error(transparent)]
    Filter(#[from] FilterError),
    /// A gain that is not a positive number.
    #[error("{what} is {value}; it must be a positive number, and small against 1/dt")]
    Gain {
        /// Which gain.
        what: &'static str,
        /// The value.
        value: f64,
    },
    /// The start posture is not within the arm's limits.
    #[error(transparent)]
    Start(#[from] PlantError),
    /// At the start posture the tip cannot move in every direction.
    #[error(
        "the start posture is singular, or the arm has fewer than three joints that move its tip; choose another posture or --tip"
    )]
    Singular,
    /// A joint cannot carry the arm at the start posture with a fifth of its effort in reserve.
    #[error(
        "joint `{joint}` needs {needed:.2} of its effort limit {effort:.2} to carry the arm; choose another start posture or correct the limit"
    )]
    TooWeak {
        /// The joint.
        joint: String,
        /// Torque to hold, N·m or N.
        needed: f64,
        /// Effort limit, N·m or N.
        effort: f64,
    },
}

/// What the tip is to do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Demand {
    /// Be at `target` 3/ω from now.
    Follow {
        /// Tip position in the base frame, m.
        target: Vector3<f64>,
        /// Share of the speed that is allowed, 0 to 1.
        speed_scale: f64,
    },
    /// Come to rest forward, within every limit, and hold.
    Stop,
}

/// What a tick was kept from doing; joints as bits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Clamps {
    /// The filter was at a limit of speed, acceleration or jerk.
    pub filter: bool,
    /// The joints' step was slowed to the speed or acceleration limits of the joints or the tip.
    pub slowed: bool,
    /// The arm is near a singular posture.
    pub singular: bool,
    /// The filter's reference was held back because the arm cannot follow.
    pub held_back: bool,
    /// The demand or the measured state was not finite: stopped, or controlled by the reference.
    pub invalid: bool,
    /// Joints held back by their end of range.
    pub at_limit: u16,
    /// Joints whose torque was cut.
    pub torque: u16,
}

/// Ticks, and ticks on which each clamp acted, since the controller was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ClampCounts {
    /// All ticks.
    pub ticks: u64,
    /// See [`Clamps::filter`].
    pub filter: u64,
    /// See [`Clamps::slowed`].
    pub slowed: u64,
    /// See [`Clamps::singular`].
    pub singular: u64,
    /// See [`Clamps::held_back`].
    pub held_back: u64,
    /// See [`Clamps::invalid`].
    pub invalid: u64,
    /// Ticks with any joint of [`Clamps::at_limit`].
    pub at_limit: u64,
    /// Ticks with any joint of [`Clamps::torque`].
    pub torque: u64,
}

impl ClampCounts {
    fn add(&mut self, clamps: &Clamps) {
        self.ticks += 1;
        self.filter += u64::from(clamps.filter);
        self.slowed += u64::from(clamps.slowed);
        self.singular += u64::from(clamps.singular);
        self.held_back += u64::from(clamps.held_back);
        self.invalid += u64::from(clamps.invalid);
        self.at_limit += u64::from(clamps.at_limit != 0);
        self.torque += u64::from(clamps.torque != 0);
    }
}

/// The result of a tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Output {
    /// Joint torques to apply until the next tick, N·m or N.
    pub tau: Joints,
    /// The filter's output at this tick.
    pub reference: FilterState,
    /// Where the measured joints put the tip, m.
    pub tip: Vector3<f64>,
    /// The joints' reference at this tick, rad or m.
    pub q_ref: Joints,
    /// What was clamped.
    pub clamps: Clamps,
}

/// Filter, inverse kinematics and computed torque in one fixed tick.
#[derive(Clone, Debug)]
pub struct Controller {
    arm: Arc<ArmModel>,
    limits: CartesianLimits,
    filter: LimitedFilter,
    ik: DifferentialIk,
    torque: ComputedTorque,
    counts: ClampCounts,
}

impl Controller {
    /// A controller at rest at `q0`, the posture that idle joints return to.
    ///
    /// # Errors
    /// [`ControlError`]: an impossible configuration, or a posture the arm cannot start from.
    pub fn new(
        arm: Arc<ArmModel>,
        config: &ControlConfig,
        q0: &Joints,
    ) -> Result<Self, ControlError> {
        check_start(&arm, q0)?;
        for (what, value) in [
            ("joint_bandwidth", config.joint_bandwidth),
            ("orientation_gain", config.orientation_gain),
            ("posture_gain", config.posture_gain),
        ] {
            if !(value > 0.0 && value * config.dt_s <= 0.25) {
                return Err(ControlError::Gain { what, value });
            }
        }
        let mut q = Joints::zeros();
        q.as_mut_slice()[..arm.dof()].copy_from_slice(&q0.as_slice()[..arm.dof()]);
        let limits = config.limits.lowered(&arm, &q, config.dt_s)?;
        let accelerations = joint_accelerations(&arm, &q)?;
        let ik_config = IkConfig {
            position_gain: 0.1 / config.dt_s,
            v_max: limits.v_max,
            a_max: limits.a_max,
            orientation_gain: config.orientation_gain,
            posture_gain: config.posture_gain,
            dt_s: config.dt_s,
        };
        let mut ik = DifferentialIk::new(Arc::clone(&arm), ik_config, accelerations, &q);
        let filter_config = FilterConfig {
            omega: config.omega,
            v_max: limits.v_max,
            a_max: limits.a_max,
            j_max: limits.j_max,
            dt_s: config.dt_s,
        };
        let filter = LimitedFilter::new(filter_config, ik.reset(&q))?;
        Ok(Self {
            arm,
            limits,
            filter,
            ik,
            torque: ComputedTorque::new(config.joint_bandwidth),
            counts: ClampCounts::default(),
        })
    }

    /// The tip limits in force.
    pub fn limits(&self) -> &CartesianLimits {
        &self.limits
    }

    /// The time by which the tip lags its demand, 3/ω, s.
    pub fn lag_s(&self) -> f64 {
        3.0 / self.filter.config().omega
    }

    /// What has been clamped since the controller was made.
    pub fn counts(&self) -> &ClampCounts {
        &self.counts
    }

    /// Where the filter's output is.
    pub fn reference(&self) -> &FilterState {
        self.filter.state()
    }

    /// Starts afresh, at rest at the measured joints `q`; the tip's orientation there is kept from now on. Returns the tip's place, m.
    /// Joints that are not finite leave the reference where it is, at rest.
    pub fn reset_reference(&mut self, q: &Joints) -> Vector3<f64> {
        let q = if q.iter().all(|x| x.is_finite()) {
            *q
        } else {
            self.ik.reference().q
        };
        let tip = self.ik.reset(&q);
        self.filter.reset(tip);
        tip
    }

    /// One tick at the measured `q` (rad, m) and `qd` (rad/s, m/s).
    pub fn tick(&mut self, demand: Demand, q: &Joints, qd: &Joints) -> Output {
        let now = (*self.filter.state(), *self.ik.reference());
        let mut clamps = Clamps::default();
        let moving = match demand {
            Demand::Follow {
                target,
                speed_scale,
            } => {
                clamps.invalid = !(target.iter().all(|x| x.is_finite()) && speed_scale.is_finite());
                clamps.filter = self.filter.follow(target, speed_scale);
                !clamps.invalid && speed_scale > 0.0
            }
            Demand::Stop => {
                clamps.filter = self.filter.stop();
                false
            }
        };
        let FilterState { p, v, .. } = *self.filter.state();
        let step = self.ik.step(&p, &v, moving);
        clamps.slowed = step.slowed;
        clamps.singular = step.singular;
        clamps.at_limit = step.at_limit;
        let lead = step.error_m.norm();
        if lead > LEASH_M {
            let back = step.error_m * (LEASH_M / lead - 1.0);
            self.filter.hold_back(back, step.tip_velocity);
            clamps.held_back = true;
        }

        let (reference, mut joints) = now;
        joints.qdd = self.ik.reference().qdd;
        let measured = q.iter().chain(qd.iter()).all(|x| x.is_finite());
        clamps.invalid |= !measured;
        let (q, qd) = if measured {
            (q, qd)
        } else {
            (&joints.q, &joints.qd)
        };
        let (tau, cut) = self.torque.torque(&self.arm, &joints, q, qd);
        clamps.torque = cut;
        self.counts.add(&clamps);
        Output {
            tau,
            reference,
            tip: self.torque.dynamics().kinematics().tip(),
            q_ref: joints.q,
            clamps,
        }
    }
}
