//! One tick: orders in, safety, prediction, control, arm, report out.

use nalgebra::{UnitQuaternion, Vector3};
use telemime_endpoint::Mono;
use telemime_protocol::predict::{Forecast, TurnForecast};
use telemime_protocol::wire::v1::Cause;
use telemime_sim::arm::{Gripper, Plant, PlantReport};

use super::mapping::{Mapping, Workspace};
use super::orders::{Bent, Engagement, Order, Report, Rings, Source, Ticket, Trajectory};
use crate::control::{Clamps, Controller, Demand};
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
}

#[expect(
    clippy::large_enum_variant,
    reason = "a box would be allocated per message and freed on the tick"
)]
enum Drive {
    Nothing,
    Mirror {
        forecast: Forecast,
        valid_at: Mono,
        /// With when it was valid: one that is not renewed goes on from there.
        turn: Option<(TurnForecast, Mono)>,
        grip: Option<f64>,
    },
    Play {
        trajectory: Box<Trajectory>,
        bent: Option<Bent>,
    },
}

/// The servo's state.
pub struct Core {
    config: CoreConfig,
    safety: Safety,
    controller: Controller,
    plant: Plant,
    gripper: Gripper,
    rings: Rings,
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
    /// The opening that the gripper is to go to.
    opening: f64,
    target_m: Vector3<f64>,
    reference_m: Vector3<f64>,
    acceleration: Vector3<f64>,
    jerk_m_s3: f64,
    moving: bool,
}

impl Core {
    /// A servo at rest.
    pub fn new(
        config: CoreConfig,
        controller: Controller,
        plant: Plant,
        gripper: Gripper,
        rings: Rings,
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
            safety: Safety::new(config.safety),
            config,
            controller,
            plant,
            opening: gripper.opening(),
            gripper,
            rings,
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
            target_m: tip_m,
            reference_m: tip_m,
            acceleration: Vector3::zeros(),
            jerk_m_s3: 0.0,
            moving: false,
        }
    }

    /// The period, s.
    pub fn tick_s(&self) -> f64 {
        self.config.tick_s
    }

    /// One period of work, at `now` on the robot's clock.
    pub fn tick(&mut self, now: Mono) -> Report {
        // A lease that ran out while orders waited is over before they are read.
        self.safety.tick(now);
        while let Ok(order) = self.rings.orders.pop() {
            self.obey(order, now);
        }
        let pulled = self.rings.brake.take();
        if let Some(cause) = pulled.hold() {
            self.safety.hold(cause);
        }
        if let Some(cause) = pulled.stop() {
            self.safety.stop(cause);
        }
        self.safety.tick(now);
        let demand = self.demand(now);
        let output = self
            .controller
            .tick(demand, self.plant.q(), self.plant.qd());
        let strain = self.plant.step(&output.tau, self.config.tick_s);
        let limited = output.clamps != Clamps::default() || strain != PlantReport::default();
        if self.safety.is_following() && (limited || self.out_of_reach) {
            self.clamps += 1;
        }
        self.gripper.step(self.opening, self.config.tick_s);
        self.orientation = output.orientation;
        self.orientation_error_rad = output.orientation_error_rad;
        self.tip_m = output.tip;
        self.reference_m = output.reference.p;
        self.jerk_m_s3 = (output.reference.a - self.acceleration).norm() / self.config.tick_s;
        self.acceleration = output.reference.a;
        self.moving = output.reference.v.norm() > STILL_M_S
            || output.turn.angular_velocity.norm() > STILL_TURN_RAD_S
            || self.plant.qd().amax() > STILL_RAD_S
            || self.controller.fastest_on_its_way() > STILL_RAD_S;
        self.tick += 1;
        let report = self.report(now);
        // A full ring means a stalled session; the servo does not wait for it.
        let _ = self.rings.reports.push(report);
        report
    }

    fn obey(&mut self, order: Order, now: Mono) {
        match order {
            Order::Operator(present) => self.safety.set_operator(present),
            Order::Engage(engagement) => self.engage(engagement, now),
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
                } = &mut self.drive
                    && ticket == self.engagement
                {
                    *held = forecast;
                    *held_at = valid_at;
                    // One that appears only now has no reference at the engage to be seen from.
                    *held_turn = held_turn.map(|held| turn.map_or(held, |turn| (turn, valid_at)));
                    *held_grip = grip.or(*held_grip);
                    self.safety.news(lease);
                }
            }
            Order::Extend {
                ticket,
                lease,
                bent,
            } => {
                if let Drive::Play { bent: held, .. } = &mut self.drive
                    && ticket == self.engagement
                {
                    *held = bent.or(*held);
                    self.safety.news(lease);
                }
            }
            Order::Release(ticket) => {
                if ticket == self.engagement {
                    self.safety.release(Cause::Requested);
                }
            }
            Order::Reset { operator, stop } => self.safety.reset(operator, stop),
        }
    }

    fn engage(&mut self, engagement: Engagement, now: Mono) {
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
            || self.moving
            || !self.safety.engage(now, engagement.lease)
        {
            self.declined = engagement.ticket;
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
        let old = std::mem::replace(&mut self.drive, drive);
        self.discard(old);
        let tip_m = self.controller.reset_reference(self.plant.q());
        self.mapping = Mapping {
            scale: engagement.scale,
            rotation: engagement.rotation,
            hand_m,
            tip_m,
            hand_orientation: hand_orientation.flatten(),
            tip_orientation: self.controller.turn_reference().orientation,
        };
        self.turned_to = None;
        self.engagement = engagement.ticket;
        self.engaged_at = now;
        self.clamps = 0;
    }

    fn discard(&mut self, drive: Drive) {
        if let Drive::Play { trajectory, .. } = drive {
            // Only a session that never frees anything fills this ring; then the plan is leaked, not freed here.
            if let Err(rtrb::PushError::Full(trajectory)) = self.rings.spent.push(trajectory) {
                std::mem::forget(trajectory);
            }
        }
    }

    fn demand(&mut self, now: Mono) -> Demand {
        self.out_of_reach = false;
        // When the motion ends, the gripper stays as it is.
        self.opening = self.gripper.opening();
        if !self.safety.is_following() {
            return Demand::Stop;
        }
        let since_s = now.secs_since(self.engaged_at);
        // A hand is in the middle of a motion; a plan begins where the tip is.
        let (hand_m, hand_orientation, grip, eased) = match &self.drive {
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
                    self.safety.release(Cause::PlanFinished);
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
        (self.target_m, self.out_of_reach) =
            self.mapping.place(hand_m, &self.config.workspace, eased);
        if let Some(hand) = hand_orientation {
            // Where a plan's curve is no orientation the last one holds, and the tick counts as clamped.
            self.out_of_reach |= hand.is_none();
            self.turned_to = hand
                .map(|hand| self.mapping.orient(&hand, eased))
                .or(self.turned_to);
        }
        if let Some(grip) = grip {
            self.out_of_reach |= !grip.is_finite();
            self.opening = grip;
        }
        Demand::Follow {
            target: self.target_m,
            orientation: self.turned_to,
            speed_scale: self.safety.speed_scale(now),
        }
    }

    fn report(&self, now: Mono) -> Report {
        let age_s = match &self.drive {
            Drive::Mirror { valid_at, .. } => now.secs_since(*valid_at),
            Drive::Play {
                bent: Some(bent), ..
            } if bent.bend.held.is_some() => now.secs_since(bent.sampled_at),
            Drive::Play { .. } | Drive::Nothing => 0.0,
        };
        let plan_s = match &self.drive {
            Drive::Play { bent, .. } if self.safety.is_following() => {
                Some(bent.map_or_else(|| now.secs_since(self.engaged_at), |bent| bent.plan_s(now)))
            }
            _ => None,
        };
        Report {
            tick: self.tick,
            at: now,
            state: self.safety.state(),
            cause: self.safety.cause(),
            transitions: self.safety.transitions(),
            engagement: self.engagement,
            engaged_at: self.engaged_at,
            declined: self.declined,
            mapping: self.mapping,
            moving: self.moving,
            age_s,
            plan_s,
            target_m: self.target_m,
            reference_m: self.reference_m,
            jerk_m_s3: self.jerk_m_s3,
            tip_m: self.tip_m,
            orientation: self.orientation,
            orientation_error_rad: self.orientation_error_rad,
            opening: self.gripper.opening(),
            q: *self.plant.q(),
            clamps: self.clamps,
        }
    }
}
