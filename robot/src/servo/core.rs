//! What a tick decides: safety, prediction, control. A pure function of what it was told before and is told now.

use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use telemime_endpoint::Mono;
use telemime_protocol::predict::{Forecast, TurnForecast};
use telemime_protocol::wire::v1::Cause;
use telemime_sim::arm::PlantReport;

use super::arm::{ArmFault, ArmState, Setpoint};
use super::brake::Pulled;
use super::mapping::{Mapping, Workspace};
use super::orders::{Bent, Engagement, Order, Report, Source, Ticket, Trajectory};
use crate::control::{Clamps, Controller, ControllerState, Demand, ForeignState};
use crate::safety::{Safety, SafetyConfig};

/// A fresh engage eases the mapped displacement in over this time, s (driving.md §7).
pub const RAMP_S: f64 = 0.5;

/// Below this tip speed the arm counts as still, m/s.
const STILL_M_S: f64 = 1e-3;

/// Above this speed of turning it does not, rad/s.
const STILL_TURN_RAD_S: f64 = 1e-2;

/// Above this joint speed it does not, wherever its reference is, rad/s or m/s.
const STILL_RAD_S: f64 = 0.01;

/// After a plan's end the arm gets this long to arrive, s.
const SETTLE_S: f64 = 0.3;

/// From 0 at 0 to 1 at 1, smoothly.
pub fn ramp(u: f64) -> f64 {
    let u = u.clamp(0.0, 1.0);
    u * u * (3.0 - 2.0 * u)
}

/// What the core is set to.
#[derive(Debug, Clone, Copy)]
pub struct CoreConfig {
    /// The state machine's settings.
    pub safety: SafetyConfig,
    /// Period, s.
    pub tick_s: f64,
    /// From predicted target to tip, s: the filter's 3/ω and the arm's dead time.
    pub lag_s: f64,
    /// Where the tip may be.
    pub workspace: Workspace,
    /// What is held is the setpoint, not what was measured. An engage begins at the setpoint that the arm holds: one that sags under its own weight
    /// would be told to sag more. And a gripper keeps the opening it was sent last: at what it grips it has stopped earlier, and told to stay
    /// there it would let go.
    pub from_setpoint: bool,
}

#[expect(
    clippy::large_enum_variant,
    reason = "a box would be allocated per message and freed on the tick"
)]
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
enum Drive {
    #[default]
    Nothing,
    Mirror {
        forecast: Forecast,
        valid_at: Mono,
        /// With when it was valid: one that is not renewed goes on from there.
        turn: Option<(TurnForecast, Mono)>,
        grip: Option<f64>,
    },
    Play {
        #[serde(with = "super::played")]
        trajectory: Arc<Trajectory>,
        bent: Option<Bent>,
    },
}

/// The servo's state, all but its controller's.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct State {
    safety: Safety,
    drive: Drive,
    mapping: Mapping,
    engagement: Ticket,
    engaged_at: Mono,
    declined: Ticket,
    clamps: u32,
    out_of_reach: bool,
    tick: u64,
    tip_m: Vector3<f64>,
    orientation: UnitQuaternion<f64>,
    orientation_error_rad: f64,
    /// Where the tip was last asked to be turned to.
    turned_to: Option<UnitQuaternion<f64>>,
    /// The opening that the gripper is to go to, if any has been asked for or told.
    opening: Option<f64>,
    target_m: Vector3<f64>,
    reference_m: Vector3<f64>,
    acceleration: Vector3<f64>,
    jerk_m_s3: f64,
    moving: bool,
    fault: Option<ArmFault>,
}

/// All that a later tick depends on, besides configuration and model.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct CoreState {
    state: State,
    controller: ControllerState,
}

impl CoreState {
    /// Ticks before this state.
    pub fn tick(&self) -> u64 {
        self.state.tick
    }

    /// A copy with as much room.
    pub(crate) fn roomy_clone(&self) -> Self {
        Self {
            state: self.state.clone(),
            controller: self.controller.roomy_clone(),
        }
    }

    /// Drops what only this state may hold of a played trajectory.
    pub(crate) fn let_go(&mut self) {
        self.state.drive = Drive::Nothing;
    }

    /// Whether every forecast in it can be read.
    pub(crate) fn is_sound(&self) -> bool {
        match &self.state.drive {
            Drive::Nothing => true,
            Drive::Mirror { forecast, turn, .. } => {
                forecast.ahead.is_sound() && turn.is_none_or(|(turn, _)| turn.ahead.is_sound())
            }
            Drive::Play { bent, .. } => bent.is_none_or(|bent| bent.is_sound()),
        }
    }
}

/// What decides. What it no longer needs, and may be freed elsewhere only, goes into `spent`.
pub struct Core {
    config: CoreConfig,
    controller: Controller,
    state: State,
    spent: rtrb::Producer<Arc<Trajectory>>,
    /// Between [`Core::decide`] and [`Core::conclude`].
    limited: bool,
}

impl Core {
    /// A servo at rest, before an arm whose gripper is open as far as `opening`, if that is known.
    pub fn new(
        config: CoreConfig,
        controller: Controller,
        opening: Option<f64>,
        spent: rtrb::Producer<Arc<Trajectory>>,
    ) -> Self {
        let tip_m = controller.reference().p;
        let orientation = controller.turn_reference().orientation;
        let mapping = Mapping {
            scale: 1.0,
            rotation: UnitQuaternion::identity(),
            hand_m: Vector3::zeros(),
            tip_m,
            hand_orientation: None,
            tip_orientation: orientation,
        };
        Self {
            config,
            controller,
            state: State {
                safety: Safety::new(config.safety),
                drive: Drive::Nothing,
                mapping,
                engagement: Ticket::default(),
                engaged_at: Mono(0),
                declined: Ticket::default(),
                clamps: 0,
                out_of_reach: false,
                tick: 0,
                tip_m,
                orientation,
                orientation_error_rad: 0.0,
                turned_to: None,
                opening,
                target_m: tip_m,
                reference_m: tip_m,
                acceleration: Vector3::zeros(),
                jerk_m_s3: 0.0,
                moving: false,
                fault: None,
            },
            spent,
            limited: false,
        }
    }

    /// The configuration.
    pub fn config(&self) -> &CoreConfig {
        &self.config
    }

    /// Ticks so far.
    pub fn ticks(&self) -> u64 {
        self.state.tick
    }

    /// A state with room for every state of this core: saving into it allocates nothing.
    pub fn room(&self) -> CoreState {
        CoreState {
            state: self.state.clone(),
            controller: ControllerState::with_room(self.config.tick_s),
        }
    }

    /// All that a later tick depends on, between two ticks, into `state`. What `state` held of a played trajectory must be held elsewhere too, or
    /// it is freed here.
    pub fn save(&self, state: &mut CoreState) {
        state.state = self.state.clone();
        self.controller.save(&mut state.controller);
    }

    /// Goes on from `state`.
    ///
    /// # Errors
    /// [`ForeignState`] for that of a core of another configuration.
    pub fn restore(&mut self, state: &CoreState) -> Result<(), ForeignState> {
        self.controller.restore(&state.controller)?;
        self.state = state.state.clone();
        Ok(())
    }

    /// A tick begins, at `now` on the robot's clock; then come its orders. A lease that ran out while they waited is over before they are read.
    pub fn begin(&mut self, now: Mono) {
        self.state.safety.tick(now);
    }

    /// The rest of a tick: the arm is as `arm` says, `fault` is wrong with it, and the brake has been `pulled`.
    pub fn decide(
        &mut self,
        now: Mono,
        pulled: Pulled,
        arm: &ArmState,
        fault: Option<ArmFault>,
    ) -> Setpoint {
        if let Some(cause) = pulled.hold() {
            self.state.safety.hold(cause);
        }
        // The first reason is the one to keep.
        self.state.fault = self.state.fault.or(fault);
        if self.state.fault.is_some() {
            self.state.safety.stop(Cause::ArmFault);
        }
        if let Some(cause) = pulled.stop() {
            self.state.safety.stop(cause);
        }
        self.state.safety.tick(now);
        let demand = self.demand(now, arm);
        let output = self.controller.tick(demand, &arm.q, &arm.qd);
        self.limited = output.clamps != Clamps::default();
        let state = &mut self.state;
        state.orientation = output.orientation;
        state.orientation_error_rad = output.orientation_error_rad;
        state.tip_m = output.tip;
        state.reference_m = output.reference.p;
        state.jerk_m_s3 = (output.reference.a - state.acceleration).norm() / self.config.tick_s;
        state.acceleration = output.reference.a;
        state.moving = output.reference.v.norm() > STILL_M_S
            || output.turn.angular_velocity.norm() > STILL_TURN_RAD_S;
        Setpoint {
            reference: output.setpoint,
            tau: output.tau,
            opening: state.opening,
        }
    }

    /// The end of a tick, with what the arm made of the setpoint.
    pub fn conclude(&mut self, now: Mono, strain: &PlantReport, arm: &ArmState) -> Report {
        let limited = self.limited || *strain != PlantReport::default();
        let state = &mut self.state;
        if state.safety.is_following() && (limited || state.out_of_reach) {
            state.clamps += 1;
        }
        state.moving |=
            arm.qd.amax() > STILL_RAD_S || self.controller.fastest_on_its_way() > STILL_RAD_S;
        state.tick += 1;
        self.report(now, arm)
    }

    /// An order, at `now`, before the rest of the tick.
    pub fn obey(&mut self, order: Order, now: Mono, arm: &ArmState) {
        match order {
            Order::Operator(present) => self.state.safety.set_operator(present),
            Order::Engage(engagement) => self.engage(engagement, now, arm),
            Order::Track {
                ticket,
                forecast,
                valid_at,
                turn,
                grip,
                lease,
            } => {
                if let Drive::Mirror {
                    forecast: held,
                    valid_at: held_at,
                    turn: held_turn,
                    grip: held_grip,
                } = &mut self.state.drive
                    && ticket == self.state.engagement
                {
                    *held = forecast;
                    *held_at = valid_at;
                    // One that appears only now has no reference at the engage to be seen from.
                    *held_turn = held_turn.map(|held| turn.map_or(held, |turn| (turn, valid_at)));
                    *held_grip = grip.or(*held_grip);
                    self.state.safety.news(lease);
                }
            }
            Order::Extend {
                ticket,
                lease,
                bent,
            } => {
                if let Drive::Play { bent: held, .. } = &mut self.state.drive
                    && ticket == self.state.engagement
                {
                    *held = bent.or(*held);
                    self.state.safety.news(lease);
                }
            }
            Order::Release(ticket) => {
                if ticket == self.state.engagement {
                    self.state.safety.release(Cause::Requested);
                }
            }
            Order::Reset { operator, stop } => self.state.safety.reset(operator, stop),
        }
    }

    fn engage(&mut self, engagement: Engagement, now: Mono, arm: &ArmState) {
        let drive = match engagement.source {
            Source::Mirror {
                forecast,
                valid_at,
                turn,
                grip,
            } => Drive::Mirror {
                forecast,
                valid_at,
                turn: turn.map(|turn| (turn, valid_at)),
                grip,
            },
            Source::Play(trajectory) => Drive::Play {
                trajectory,
                bent: None,
            },
        };
        // An orientation that is none would be the reference for all that follows.
        let hand_orientation = match &drive {
            Drive::Mirror { turn, .. } => turn.map(|(turn, valid_at)| {
                let q = turn.at(now.secs_since(valid_at)).orientation;
                q.coords.iter().all(|v| v.is_finite()).then_some(q)
            }),
            Drive::Play { trajectory, .. } => trajectory
                .curve
                .orientation
                .is_some()
                .then(|| trajectory.curve.orientation_at(0.0)),
            Drive::Nothing => None,
        };
        if hand_orientation == Some(None)
            || self.state.moving
            || !self.state.safety.engage(now, engagement.lease)
        {
            self.state.declined = engagement.ticket;
            self.discard(drive);
            return;
        }
        let hand_m = match &drive {
            Drive::Mirror {
                forecast, valid_at, ..
            } => forecast.at(now.secs_since(*valid_at)).position,
            Drive::Play { trajectory, .. } => trajectory.curve.position_at(0.0),
            Drive::Nothing => Vector3::zeros(),
        };
        let old = std::mem::replace(&mut self.state.drive, drive);
        self.discard(old);
        let from = if self.config.from_setpoint {
            self.controller.joint_reference().q
        } else {
            arm.q
        };
        let tip_m = self.controller.reset_reference(&from);
        self.state.mapping = Mapping {
            scale: engagement.scale,
            rotation: engagement.rotation,
            hand_m,
            tip_m,
            hand_orientation: hand_orientation.flatten(),
            tip_orientation: self.controller.turn_reference().orientation,
        };
        self.state.turned_to = None;
        self.state.engagement = engagement.ticket;
        self.state.engaged_at = now;
        self.state.clamps = 0;
    }

    fn discard(&mut self, drive: Drive) {
        if let Drive::Play { trajectory, .. } = drive {
            // Only a session that never frees anything fills this ring; then the plan is leaked, not freed here.
            if let Err(rtrb::PushError::Full(trajectory)) = self.spent.push(trajectory) {
                std::mem::forget(trajectory);
            }
        }
    }

    fn demand(&mut self, now: Mono, arm: &ArmState) -> Demand {
        self.state.out_of_reach = false;
        // When the motion ends, the gripper stays as it is.
        if !self.config.from_setpoint {
            self.state.opening = arm.opening;
        }
        if !self.state.safety.is_following() {
            return Demand::Stop;
        }
        let since_s = now.secs_since(self.state.engaged_at);
        // A hand is in the middle of a motion; a plan begins where the tip is.
        let (hand_m, hand_orientation, grip, eased) = match &self.state.drive {
            Drive::Nothing => return Demand::Stop,
            Drive::Mirror {
                forecast,
                valid_at,
                turn,
                grip,
            } => {
                let horizon_s = |valid_at| now.secs_since(valid_at) + self.config.lag_s;
                (
                    forecast.at(horizon_s(*valid_at)).position,
                    turn.map(|(turn, valid_at)| Some(turn.at(horizon_s(valid_at)).orientation)),
                    *grip,
                    ramp(since_s / RAMP_S),
                )
            }
            Drive::Play { trajectory, bent } => {
                let plan_s = bent.map_or(since_s, |bent| bent.plan_s(now));
                let over = bent.is_none_or(|bent| bent.is_over(now));
                if over && plan_s > trajectory.duration_s + SETTLE_S {
                    self.state.safety.release(Cause::PlanFinished);
                    return Demand::Stop;
                }
                let ahead = now.offset_by_secs(self.config.lag_s);
                let (t_s, offset) = match bent {
                    Some(bent) => (bent.plan_s(ahead), bent.offset(ahead)),
                    None => (since_s + self.config.lag_s, Vector3::zeros()),
                };
                let curve = &trajectory.curve;
                (
                    curve.position_at(t_s) + offset,
                    curve
                        .orientation
                        .is_some()
                        .then(|| curve.orientation_at(t_s)),
                    curve.grip_at(t_s),
                    1.0,
                )
            }
        };
        (self.state.target_m, self.state.out_of_reach) =
            self.state
                .mapping
                .place(hand_m, &self.config.workspace, eased);
        if let Some(hand) = hand_orientation {
            // Where a plan's curve is no orientation the last one holds, and the tick counts as clamped.
            self.state.out_of_reach |= hand.is_none();
            self.state.turned_to = hand
                .map(|hand| self.state.mapping.orient(&hand, eased))
                .or(self.state.turned_to);
        }
        if let Some(grip) = grip {
            self.state.out_of_reach |= !grip.is_finite();
            if grip.is_finite() {
                self.state.opening = Some(grip);
            }
        }
        Demand::Follow {
            target: self.state.target_m,
            orientation: self.state.turned_to,
            speed_scale: self.state.safety.speed_scale(now),
        }
    }

    fn report(&self, now: Mono, arm: &ArmState) -> Report {
        let age_s = match &self.state.drive {
            Drive::Mirror { valid_at, .. } => now.secs_since(*valid_at),
            Drive::Play {
                bent: Some(bent), ..
            } if bent.bend.held.is_some() => now.secs_since(bent.sampled_at),
            Drive::Play { .. } | Drive::Nothing => 0.0,
        };
        let plan_s = match &self.state.drive {
            Drive::Play { bent, .. } if self.state.safety.is_following() => Some(bent.map_or_else(
                || now.secs_since(self.state.engaged_at),
                |bent| bent.plan_s(now),
            )),
            _ => None,
        };
        Report {
            tick: self.state.tick,
            at: now,
            state: self.state.safety.state(),
            cause: self.state.safety.cause(),
            transitions: self.state.safety.transitions(),
            engagement: self.state.engagement,
            engaged_at: self.state.engaged_at,
            declined: self.state.declined,
            mapping: self.state.mapping,
            moving: self.state.moving,
            age_s,
            plan_s,
            target_m: self.state.target_m,
            reference_m: self.state.reference_m,
            jerk_m_s3: self.state.jerk_m_s3,
            tip_m: self.state.tip_m,
            orientation: self.state.orientation,
            orientation_error_rad: self.state.orientation_error_rad,
            opening: arm.opening,
            q: arm.q,
            clamps: self.state.clamps,
            fault: self.state.fault,
        }
    }
}
