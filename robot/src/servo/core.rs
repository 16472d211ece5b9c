//! One tick: orders in, safety, prediction, control, arm, report out.

use nalgebra::{UnitQuaternion, Vector3};
use telemime_endpoint::Mono;
use telemime_protocol::predict::Forecast;
use telemime_protocol::spline::BSpline;
use telemime_protocol::wire::v1::{Cause, RobotState};
use telemime_sim::arm::{Joints, Plant, PlantReport};

use super::brake::Brake;
use super::mapping::{Mapping, Workspace};
use crate::control::{Clamps, Controller, Demand};
use crate::safety::{Safety, SafetyConfig};

/// A fresh engage eases the mapped displacement in over this time, s (driving.md §7).
pub const RAMP_S: f64 = 0.5;

/// Below this tip speed the arm counts as still, m/s.
const STILL_M_S: f64 = 1e-3;

/// Above this joint speed it does not, wherever its reference is, rad/s or m/s.
const STILL_RAD_S: f64 = 0.01;

/// After a plan's end the arm gets this long to arrive, s.
const SETTLE_S: f64 = 0.3;

/// From 0 at 0 to 1 at 1, smoothly.
pub fn ramp(u: f64) -> f64 {
    let u = u.clamp(0.0, 1.0);
    u * u * (3.0 - 2.0 * u)
}

/// A motion to play: hand position in m over time in s from 0.
#[derive(Debug)]
pub struct Trajectory {
    /// Position over time.
    pub spline: BSpline<3>,
    /// Its end, s.
    pub duration_s: f64,
}

/// What drives an engagement.
#[derive(Debug)]
#[expect(
    clippy::large_enum_variant,
    reason = "a box would be allocated per message and freed on the tick"
)]
pub enum Source {
    /// The hand, live: a forecast and when its state was valid on the robot's clock.
    Mirror {
        /// The prediction to start from.
        forecast: Forecast,
        /// When its newest sample was valid.
        valid_at: Mono,
    },
    /// A plan, from its beginning.
    Play(Box<Trajectory>),
}

/// Which engagement of which session.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Ticket {
    /// The session's epoch, unique for the life of the daemon; 0 is none.
    pub epoch: u32,
    /// The engagement's number within the session.
    pub number: u32,
}

/// How long a message authorises motion, on the robot's clock and fixed when it arrived: what waits in a
/// queue does not last longer for it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lease {
    /// When it arrived.
    pub from: Mono,
    /// When it ends.
    pub until: Mono,
}

/// A granted request to engage.
#[derive(Debug)]
pub struct Engagement {
    /// Whose it is.
    pub ticket: Ticket,
    /// What drives.
    pub source: Source,
    /// Tip metres per hand metre.
    pub scale: f64,
    /// Hand axes to base axes.
    pub rotation: UnitQuaternion<f64>,
    /// First lease.
    pub lease: Lease,
}

/// What the session tells the servo. Stops are not among it: a [`Brake`] needs no queue.
#[derive(Debug)]
pub enum Order {
    /// An operator has, or loses, authority.
    Operator(bool),
    /// Follow.
    Engage(Engagement),
    /// Newest prediction, and the lease that came with it.
    Track {
        /// For which engagement.
        ticket: Ticket,
        /// The prediction.
        forecast: Forecast,
        /// When its newest sample was valid.
        valid_at: Mono,
        /// For how long.
        lease: Lease,
    },
    /// Play goes on.
    Extend {
        /// For which engagement.
        ticket: Ticket,
        /// For how long.
        lease: Lease,
    },
    /// The clutch is let go.
    Release(Ticket),
    /// Leave the latched stop.
    Reset {
        /// Whether an operator has authority.
        operator: bool,
        /// The stop that is meant, by [`Report::transitions`]; `None` is whoever stands at the arm.
        stop: Option<u32>,
    },
}

/// What the servo tells the session after every tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Report {
    /// Counts ticks.
    pub tick: u64,
    /// When the tick began.
    pub at: Mono,
    /// State after it.
    pub state: RobotState,
    /// Why.
    pub cause: Cause,
    /// Counts state changes.
    pub transitions: u32,
    /// The engagement followed last; that of epoch 0 before the first.
    pub engagement: Ticket,
    /// When it began.
    pub engaged_at: Mono,
    /// The engagement declined last: the arm had begun to move, or a stop came first.
    pub declined: Ticket,
    /// Its mapping.
    pub mapping: Mapping,
    /// The arm still moves.
    pub moving: bool,
    /// Age of the newest hand state, s.
    pub age_s: f64,
    /// Where the tip is asked to go, m.
    pub target_m: Vector3<f64>,
    /// Where the filter has it, m.
    pub reference_m: Vector3<f64>,
    /// Tip, m.
    pub tip_m: Vector3<f64>,
    /// Joint positions.
    pub q: Joints,
    /// Ticks of this engagement on which a limit acted.
    pub clamps: u32,
}

/// What the core is set to.
#[derive(Debug, Clone, Copy)]
pub struct CoreConfig {
    /// The state machine's settings.
    pub safety: SafetyConfig,
    /// Period, s.
    pub tick_s: f64,
    /// From predicted target to tip, s: the filter's 3/ω, since the simulated arm has no dead time.
    pub lag_s: f64,
    /// Where the tip may be.
    pub workspace: Workspace,
}

/// The servo's ends of the rings.
#[derive(Debug)]
pub struct Rings {
    /// Orders from the session.
    pub orders: rtrb::Consumer<Order>,
    /// Reports to the session; dropped (and seen by their tick numbers) while it is full.
    pub reports: rtrb::Producer<Report>,
    /// Trajectories no longer needed, to be freed elsewhere.
    pub spent: rtrb::Producer<Box<Trajectory>>,
    /// Stops.
    pub brake: Brake,
}

/// The session's ends of the rings.
#[derive(Debug)]
pub struct Handle {
    /// Orders to the servo.
    pub orders: rtrb::Producer<Order>,
    /// Reports from it.
    pub reports: rtrb::Consumer<Report>,
    /// Trajectories to free.
    pub spent: rtrb::Consumer<Box<Trajectory>>,
    /// Stops.
    pub brake: Brake,
}

/// A pair of ring ends: 64 orders, 4096 reports (four seconds).
pub fn rings() -> (Rings, Handle) {
    let (order_in, orders) = rtrb::RingBuffer::new(64);
    let (reports, report_out) = rtrb::RingBuffer::new(4096);
    let (spent, spent_out) = rtrb::RingBuffer::new(64);
    let brake = Brake::default();
    let servo = Rings {
        orders,
        reports,
        spent,
        brake: brake.clone(),
    };
    let session = Handle {
        orders: order_in,
        reports: report_out,
        spent: spent_out,
        brake,
    };
    (servo, session)
}

#[expect(
    clippy::large_enum_variant,
    reason = "a box would be allocated per message and freed on the tick"
)]
enum Drive {
    Nothing,
    Mirror { forecast: Forecast, valid_at: Mono },
    Play(Box<Trajectory>),
}

/// The servo's state.
pub struct Core {
    config: CoreConfig,
    safety: Safety,
    controller: Controller,
    plant: Plant,
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
    target_m: Vector3<f64>,
    reference_m: Vector3<f64>,
    moving: bool,
}

impl Core {
    /// A servo at rest.
    pub fn new(config: CoreConfig, controller: Controller, plant: Plant, rings: Rings) -> Self {
        let tip_m = controller.reference().p;
        let mapping = Mapping {
            scale: 1.0,
            rotation: UnitQuaternion::identity(),
            hand_m: Vector3::zeros(),
            tip_m,
        };
        Self {
            safety: Safety::new(config.safety),
            config,
            controller,
            plant,
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
            target_m: tip_m,
            reference_m: tip_m,
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
        self.tip_m = output.tip;
        self.reference_m = output.reference.p;
        self.moving = output.reference.v.norm() > STILL_M_S || self.plant.qd().amax() > STILL_RAD_S;
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
                lease,
            } => {
                if let Drive::Mirror {
                    forecast: held,
                    valid_at: held_at,
                } = &mut self.drive
                    && ticket == self.engagement
                {
                    *held = forecast;
                    *held_at = valid_at;
                    self.safety.news(lease);
                }
            }
            Order::Extend { ticket, lease } => {
                if matches!(self.drive, Drive::Play(_)) && ticket == self.engagement {
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
            Source::Mirror { forecast, valid_at } => Drive::Mirror { forecast, valid_at },
            Source::Play(trajectory) => Drive::Play(trajectory),
        };
        if self.moving || !self.safety.engage(now, engagement.lease) {
            self.declined = engagement.ticket;
            self.discard(drive);
            return;
        }
        let hand_m = match &drive {
            Drive::Mirror { forecast, valid_at } => forecast.at(now.secs_since(*valid_at)).position,
            Drive::Play(trajectory) => trajectory
                .spline
                .eval(0.0)
                .map_or(Vector3::zeros(), |jet| jet.x),
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
        };
        self.engagement = engagement.ticket;
        self.engaged_at = now;
        self.clamps = 0;
    }

    fn discard(&mut self, drive: Drive) {
        if let Drive::Play(trajectory) = drive {
            // Only a session that never frees anything fills this ring; then the plan is leaked, not freed here.
            if let Err(rtrb::PushError::Full(trajectory)) = self.rings.spent.push(trajectory) {
                std::mem::forget(trajectory);
            }
        }
    }

    fn demand(&mut self, now: Mono) -> Demand {
        self.out_of_reach = false;
        if !self.safety.is_following() {
            return Demand::Stop;
        }
        let since_s = now.secs_since(self.engaged_at);
        // A hand is in the middle of a motion; a plan begins where the tip is.
        let (hand_m, eased) = match &self.drive {
            Drive::Nothing => return Demand::Stop,
            Drive::Mirror { forecast, valid_at } => {
                let horizon_s = now.secs_since(*valid_at) + self.config.lag_s;
                (forecast.at(horizon_s).position, ramp(since_s / RAMP_S))
            }
            Drive::Play(trajectory) => {
                if since_s > trajectory.duration_s + SETTLE_S {
                    self.safety.release(Cause::PlanFinished);
                    return Demand::Stop;
                }
                let t_s = (since_s + self.config.lag_s).min(trajectory.duration_s);
                let jet = trajectory.spline.eval(t_s);
                (jet.map_or(self.mapping.hand_m, |jet| jet.x), 1.0)
            }
        };
        (self.target_m, self.out_of_reach) =
            self.mapping.place(hand_m, &self.config.workspace, eased);
        Demand::Follow {
            target: self.target_m,
            orientation: None,
            speed_scale: self.safety.speed_scale(now),
        }
    }

    fn report(&self, now: Mono) -> Report {
        let age_s = match &self.drive {
            Drive::Mirror { valid_at, .. } => now.secs_since(*valid_at),
            Drive::Play(_) | Drive::Nothing => 0.0,
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
            target_m: self.target_m,
            reference_m: self.reference_m,
            tip_m: self.tip_m,
            q: *self.plant.q(),
            clamps: self.clamps,
        }
    }
}
