//! One tick from a demanded tip position and orientation to torques.

use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use telemime_sim::arm::{
    ArmModel, DeadTime, DeadTimeError, Dynamics, Joints, MAX_DEAD_TIME_S, PlantError, check_start,
};

use super::barrier::Barrier;
use super::clamps::{ClampCounts, Clamps};
use super::ik::{DifferentialIk, IkState};
use super::resolve::quaternion;
use super::turn::checked;
use super::{
    BarrierConfig, BarrierError, CartesianLimits, CloseAtStart, FilterConfig, FilterError,
    FilterState, IkConfig, JointReference, Law, LimitedFilter, TorqueControl, TurnFilter,
    TurnLimits, TurnState, joint_accelerations,
};

/// The filter's reference may lead the joints' reference by this much, m; beyond, the arm cannot follow and the filter waits for it.
const LEASH_M: f64 = 0.002;

/// A joint's natural frequency is at most this share of the tick rate.
const QUICKEST: f64 = 0.2;

/// The same for the orientation, rad. Longer: what an arm with too few axes lacks must not hold up the rest.
const LEASH_RAD: f64 = 0.05;

/// Bandwidth, limits and gains of a [`Controller`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ControlConfig {
    /// The filter's poles lie at −ω, rad/s: the tip lags the demand by 3/ω.
    pub omega: f64,
    /// Largest tip speed, acceleration and jerk; lowered to what the arm allows ([`CartesianLimits::lowered`]).
    pub limits: CartesianLimits,
    /// Largest speed, acceleration and jerk of the tip's rotation; lowered to what the arm allows ([`TurnLimits::lowered`]).
    pub turn_limits: TurnLimits,
    /// Bandwidth of the joints' torque control, rad/s.
    pub joint_bandwidth: f64,
    /// Joint impedance instead: the stiffness of the joint of the largest effort limit, N·m/rad or N/m; of the others in proportion to theirs,
    /// less where that is too quick for the tick.
    #[serde(default)]
    pub stiffness: Option<f64>,
    /// How fast an error of the tip's orientation is closed, 1/s: against the one followed, or else the one at the last reset.
    pub orientation_gain: f64,
    /// How fast idle joints return to the start posture, 1/s.
    pub posture_gain: f64,
    /// The arm obeys its setpoints this much later, s, at most [`MAX_DEAD_TIME_S`](telemime_sim::arm::MAX_DEAD_TIME_S).
    pub dead_time_s: f64,
    /// What the arm is kept from: itself, and planes.
    pub barrier: BarrierConfig,
    /// Tick, s.
    pub dt_s: f64,
}

impl Default for ControlConfig {
    /// 1 kHz, and the tip limits of a published arm.
    fn default() -> Self {
        Self {
            // 3/ω is part of the horizon, and ω³ of the jerk: the fastest that is no rougher than the hand itself on recorded gestures.
            omega: 40.0,
            limits: CartesianLimits {
                v_max: 1.7,
                a_max: 13.0,
                j_max: 6500.0,
            },
            turn_limits: TurnLimits {
                v_max: 2.5,
                a_max: 25.0,
                j_max: 12_500.0,
            },
            joint_bandwidth: 80.0,
            stiffness: None,
            orientation_gain: 8.0,
            posture_gain: 1.0,
            dead_time_s: 0.0,
            barrier: BarrierConfig::default(),
            dt_s: 1e-3,
        }
    }
}

impl ControlConfig {
    /// Whether `arm` states what this needs, wherever it stands.
    ///
    /// # Errors
    /// [`ControlError::NoEffort`] for a stiffness, of the first joint without an effort limit.
    pub fn fits(&self, arm: &ArmModel) -> Result<(), ControlError> {
        let unlimited = arm.joints().iter().find(|j| !j.effort.is_finite());
        match unlimited.filter(|_| self.stiffness.is_some()) {
            None => Ok(()),
            Some(joint) => Err(ControlError::NoEffort {
                joint: joint.name.clone(),
            }),
        }
    }
}

/// Why a controller cannot be made.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ControlError {
    /// The filter's configuration is impossible.
    #[error(transparent)]
    Filter(#[from] FilterError),
    /// The limits of turning are impossible.
    #[error("limits of the tip's rotation, in rad instead of m: {0}")]
    Turn(#[source] FilterError),
    /// The arm's dead time is out of range.
    #[error(transparent)]
    DeadTime(#[from] DeadTimeError),
    /// The barrier's distances or planes are impossible.
    #[error(transparent)]
    Barrier(#[from] BarrierError),
    /// A gain that is not a positive number.
    #[error("{what} is {value}; it must be a positive number, and small against 1/dt")]
    Gain {
        /// Which gain.
        what: &'static str,
        /// The value.
        value: f64,
    },
    /// A stiffness that is none, or that the tick is too slow for.
    #[error(
        "stiffness {value} N·m/rad: more than 0, and at most {most:.0} for this arm at its start posture and this tick"
    )]
    Stiffness {
        /// The value.
        value: f64,
        /// The most that is stable.
        most: f64,
    },
    /// A joint without a share of the stiffness.
    #[error(
        "a stiffness is shared in proportion to the joints' effort limits, and joint `{joint}` states none; give it one in the URDF, or leave the stiffness out"
    )]
    NoEffort {
        /// The joint.
        joint: String,
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
    /// Be at `target`, and in `orientation` as far as the arm can be at once, 3/ω and the dead time from now.
    Follow {
        /// Tip position in the base frame, m.
        target: Vector3<f64>,
        /// Tip axes to base axes; `None` keeps the orientation there is.
        orientation: Option<UnitQuaternion<f64>>,
        /// Share of the speed that is allowed, 0 to 1.
        speed_scale: f64,
    },
    /// Come to rest forward, within every limit, and hold.
    Stop,
}

/// The result of a tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Output {
    /// Joint torques to apply until the next tick, N·m or N.
    pub tau: Joints,
    /// The filter's output at this tick.
    pub reference: FilterState,
    /// The orientation filter's output at this tick.
    pub turn: TurnState,
    /// Where the measured joints put the tip, m.
    pub tip: Vector3<f64>,
    /// How they orient it: tip axes to base axes.
    pub orientation: UnitQuaternion<f64>,
    /// The angle from there to the orientation demanded, or to the one being kept, rad: of a demand that turns, what is due only [`Controller::lag_s`] later is part of it.
    pub orientation_error_rad: f64,
    /// The setpoint that the joints' drives follow at this tick: the reference of the dead time ago.
    pub setpoint: JointReference,
    /// What was clamped.
    pub clamps: Clamps,
}

/// All of a [`Controller`] that a later tick depends on.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct ControllerState {
    filter: FilterState,
    turn: TurnState,
    turns: bool,
    ik: IkState,
    /// On their way, the next one due first.
    setpoints: Vec<JointReference>,
}

impl ControllerState {
    /// One that any controller can be saved into without an allocation.
    pub fn with_room(dt_s: f64) -> Self {
        let most = (MAX_DEAD_TIME_S / dt_s).round() as usize;
        Self {
            setpoints: Vec::with_capacity(most),
            ..Self::default()
        }
    }

    /// A copy with as much room for setpoints.
    pub(crate) fn roomy_clone(&self) -> Self {
        let mut setpoints = Vec::with_capacity(self.setpoints.capacity());
        setpoints.extend_from_slice(&self.setpoints);
        Self {
            setpoints,
            ..self.clone()
        }
    }
}

/// A state that another kind of controller has saved.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the state is that of a controller with another dead time")]
pub struct ForeignState;

/// Filter, inverse kinematics and computed torque in one fixed tick.
#[derive(Clone, Debug)]
pub struct Controller {
    arm: Arc<ArmModel>,
    limits: CartesianLimits,
    turn_limits: TurnLimits,
    filter: LimitedFilter,
    turn: TurnFilter,
    /// An orientation has been demanded since the last reset.
    turns: bool,
    ik: DifferentialIk,
    setpoints: DeadTime<JointReference>,
    torque: TorqueControl,
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
        config.fits(&arm)?;
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
        let turn_limits = config.turn_limits.lowered(&arm, &q, config.dt_s)?;
        let accelerations = joint_accelerations(&arm, &q)?;
        let ik_config = IkConfig {
            position_gain: 0.1 / config.dt_s,
            v_max: limits.v_max,
            a_max: limits.a_max,
            turn_v_max: turn_limits.v_max,
            turn_a_max: turn_limits.a_max,
            orientation_gain: config.orientation_gain,
            posture_gain: config.posture_gain,
            dt_s: config.dt_s,
        };
        let barrier = Barrier::new(
            Arc::clone(&arm),
            &config.barrier,
            accelerations,
            &q,
            config.dt_s,
        )?;
        let mut ik = DifferentialIk::new(Arc::clone(&arm), ik_config, accelerations, barrier, &q);
        let filter_config = FilterConfig {
            omega: config.omega,
            v_max: limits.v_max,
            a_max: limits.a_max,
            j_max: limits.j_max,
            dt_s: config.dt_s,
        };
        let filter = LimitedFilter::new(filter_config, ik.reset(&q))?;
        let turn_config = FilterConfig {
            v_max: turn_limits.v_max,
            a_max: turn_limits.a_max,
            j_max: turn_limits.j_max,
            ..filter_config
        };
        let turn = TurnFilter::new(turn_config, ik.orientation()).map_err(ControlError::Turn)?;
        let law = match config.stiffness {
            None => Law::Computed {
                bandwidth: config.joint_bandwidth,
            },
            Some(value) => Law::Impedance {
                stiffness: springs(&arm, &q, value, config.dt_s)?,
            },
        };
        let setpoints = DeadTime::new(config.dead_time_s, config.dt_s, *ik.reference())?;
        Ok(Self {
            arm,
            limits,
            turn_limits,
            filter,
            turn,
            turns: false,
            ik,
            setpoints,
            torque: TorqueControl::new(law),
            counts: ClampCounts::default(),
        })
    }

    /// The tip limits in force.
    pub fn limits(&self) -> &CartesianLimits {
        &self.limits
    }

    /// The limits of the tip's rotation in force.
    pub fn turn_limits(&self) -> &TurnLimits {
        &self.turn_limits
    }

    /// The links that are not kept apart because they begin too near each other, if links are kept apart at all.
    pub fn close_at_start(&self) -> Vec<CloseAtStart> {
        self.ik.barrier().close_at_start()
    }

    /// The time by which the tip lags its demand in position and orientation, s: 3/ω and the arm's dead time.
    pub fn lag_s(&self) -> f64 {
        3.0 / self.filter.config().omega + self.setpoints.seconds()
    }

    /// The largest joint speed of the reference, and of the setpoints that the arm has not obeyed yet, rad/s or m/s.
    pub fn fastest_on_its_way(&self) -> f64 {
        let waiting = self.setpoints.on_its_way().iter();
        let all = waiting.chain([self.ik.reference()]);
        all.map(|r| r.qd.amax()).fold(0.0, f64::max)
    }

    /// What has been clamped since the controller was made.
    pub fn counts(&self) -> &ClampCounts {
        &self.counts
    }

    /// Where the filter's output is.
    pub fn reference(&self) -> &FilterState {
        self.filter.state()
    }

    /// Where the orientation filter's output is.
    pub fn turn_reference(&self) -> TurnState {
        self.turn.state()
    }

    /// Starts afresh, at rest at the measured joints `q`; the tip's orientation there is kept until another is demanded. Returns the tip's place, m.
    /// Joints that are not finite leave the reference where it is, at rest.
    pub fn reset_reference(&mut self, q: &Joints) -> Vector3<f64> {
        let q = if q.iter().all(|x| x.is_finite()) {
            *q
        } else {
            self.ik.reference().q
        };
        let tip = self.ik.reset(&q);
        self.filter.reset(tip);
        self.turn.reset(self.ik.orientation());
        self.turns = false;
        self.setpoints.fill(*self.ik.reference());
        tip
    }

    /// Where the joints' reference is.
    pub fn joint_reference(&self) -> &JointReference {
        self.ik.reference()
    }

    /// All that a later tick depends on, into `state`; allocates nothing if that has held the state of this controller before, or room for it.
    pub fn save(&self, state: &mut ControllerState) {
        state.filter = *self.filter.state();
        state.turn = self.turn.state();
        state.turns = self.turns;
        state.ik = self.ik.save();
        self.setpoints.save(&mut state.setpoints);
    }

    /// Goes on from `state`, which a controller of the same arm and configuration has saved.
    ///
    /// # Errors
    /// [`ForeignState`] for one of another dead time.
    pub fn restore(&mut self, state: &ControllerState) -> Result<(), ForeignState> {
        if !self.setpoints.restore(&state.setpoints) {
            return Err(ForeignState);
        }
        self.filter.restore(state.filter);
        self.turn.restore(state.turn);
        self.turns = state.turns;
        self.ik.restore(&state.ik);
        Ok(())
    }

    /// One tick at the measured `q` (rad, m) and `qd` (rad/s, m/s).
    pub fn tick(&mut self, demand: Demand, q: &Joints, qd: &Joints) -> Output {
        let now = (*self.filter.state(), *self.ik.reference());
        let turn_now = self.turn.state();
        let mut clamps = Clamps::default();
        let (moving, demanded) = self.filtered(demand, &mut clamps);
        let FilterState { p, v, .. } = *self.filter.state();
        let turn = self.turns.then(|| self.turn.state());
        // A turn that has begun is braked by its filter, not let go.
        let secondary = moving || !self.turn.at_rest();
        let step = self.ik.step(&p, &v, turn.as_ref(), secondary);
        clamps.slowed = step.slowed;
        clamps.turning |= step.turn_slowed;
        clamps.singular = step.singular;
        clamps.near_itself = step.near_itself;
        clamps.near_plane |= step.near_plane;
        clamps.at_limit = step.at_limit;
        let lead = step.error_m.norm();
        if lead > LEASH_M {
            let back = step.error_m * (LEASH_M / lead - 1.0);
            self.filter.hold_back(back, step.tip_velocity);
            clamps.held_back = true;
        }
        let lead = step.turn_error_rad.norm();
        if self.turns && lead > LEASH_RAD {
            let back = step.turn_error_rad * (LEASH_RAD / lead - 1.0);
            self.turn.hold_back(back, step.angular_velocity);
            clamps.turn_held_back = true;
        }

        let (reference, mut joints) = now;
        joints.qdd = self.ik.reference().qdd;
        let joints = self.setpoints.pass(joints);
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
        let kinematics = self.torque.dynamics().kinematics();
        let orientation = quaternion(kinematics.tip_rotation());
        let asked = demanded.unwrap_or(self.turn.state().orientation);
        Output {
            tau,
            reference,
            turn: turn_now,
            tip: kinematics.tip(),
            orientation,
            orientation_error_rad: orientation.angle_to(&asked),
            setpoint: joints,
            clamps,
        }
    }

    /// Both filters' tick. Returns whether the tip is to go anywhere, and the orientation demanded.
    fn filtered(
        &mut self,
        demand: Demand,
        clamps: &mut Clamps,
    ) -> (bool, Option<UnitQuaternion<f64>>) {
        let Demand::Follow {
            target,
            orientation,
            speed_scale,
        } = demand
        else {
            clamps.filter = self.filter.stop();
            clamps.turning = self.turn.stop();
            return (false, None);
        };
        let unit = orientation.as_ref().and_then(checked);
        clamps.invalid = !(target.iter().all(|x| x.is_finite()) && speed_scale.is_finite())
            || orientation.is_some() != unit.is_some();
        if clamps.invalid {
            clamps.filter = self.filter.stop();
            clamps.turning = self.turn.stop();
            return (false, None);
        }
        let (target, clipped) = self.ik.clip(target);
        clamps.near_plane = clipped;
        clamps.filter = self.filter.follow(target, speed_scale);
        clamps.turning = match unit {
            Some(unit) => {
                self.turns = true;
                self.turn.follow(unit, speed_scale)
            }
            None => self.turn.stop(),
        };
        (speed_scale > 0.0, unit)
    }
}

/// Springs of this stiffness at the strongest joint, of each joint in N·m/rad: softer where so little inertia hangs on one that the tick
/// would be too slow for its share.
pub(super) fn springs(
    arm: &ArmModel,
    q: &Joints,
    value: f64,
    dt_s: f64,
) -> Result<Joints, ControlError> {
    let effort = arm.per_joint(|j| j.effort);
    let strongest = effort.imax();
    let mut dynamics = Dynamics::new();
    dynamics.update(arm, q);
    let n = arm.dof();
    let inertia = dynamics.mass_matrix();
    let inverse = inertia.view((0, 0), (n, n)).clone_owned().try_inverse();
    let mut most = Joints::zeros();
    if let Some(inverse) = inverse {
        for i in 0..n {
            // The least inertia a joint shows: that of a push against it while all others are free.
            most[i] = (QUICKEST / dt_s).powi(2) / inverse[(i, i)];
        }
    }
    let shares = effort * (value / effort[strongest]);
    let most_there = most[strongest];
    if !(value > 0.0 && value <= most_there) {
        return Err(ControlError::Stiffness {
            value,
            most: most_there,
        });
    }
    Ok(shares.zip_map(&most, f64::min))
}
