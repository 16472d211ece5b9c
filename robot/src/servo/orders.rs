//! What the session tells the servo, what it is told, and the rings between them.

use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use telemime_endpoint::Mono;
use telemime_protocol::checkpoint::PoseCurve;
use telemime_protocol::predict::{Bend, Forecast, TurnForecast};
use telemime_protocol::wire::v1::{Cause, RobotState};
use telemime_sim::arm::Joints;

use super::arm::ArmFault;
use super::brake::Brake;
use super::mapping::Mapping;

/// A motion to play: the hand over time in s from 0.
#[derive(Debug)]
pub struct Trajectory {
    /// Position, and orientation and gripper where the plan has them.
    pub curve: PoseCurve,
    /// Its end, s.
    pub duration_s: f64,
}

/// What drives an engagement.
#[derive(Debug, Clone, Serialize, Deserialize)]
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
        /// The hand's orientation, valid at the same moment: without one the tip keeps its own for the whole engagement.
        turn: Option<TurnForecast>,
        /// How far the gripper is to be open, from 0 to 1.
        grip: Option<f64>,
    },
    /// A plan, from its beginning.
    Play(#[serde(with = "super::played")] Arc<Trajectory>),
}

/// What the operator's hand makes of a plan, on the robot's clock.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Bent {
    /// When of the plan it is, and how far beside it.
    pub bend: Bend,
    /// The moment that is stated for.
    pub at: Mono,
    /// When the hand's newest sample was valid, while it holds on.
    pub sampled_at: Mono,
}

impl Bent {
    /// The plan's time at `now`, s.
    pub fn plan_s(&self, now: Mono) -> f64 {
        self.bend.plan_at(now.secs_since(self.at))
    }

    /// How far beside the plan the hand belongs at `now`, m.
    pub fn offset(&self, now: Mono) -> Vector3<f64> {
        self.bend
            .offset_at(now.secs_since(self.at), now.secs_since(self.sampled_at))
    }

    /// Whether its forecast can be read.
    pub(crate) fn is_sound(&self) -> bool {
        self.bend.held.is_none_or(|held| held.push.ahead.is_sound())
    }

    /// Whether nothing bends the plan any more at `now`.
    pub fn is_over(&self, now: Mono) -> bool {
        self.bend.is_over(now.secs_since(self.at))
    }
}

/// Which engagement of which session.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ticket {
    /// The session's epoch, unique for the life of the daemon; 0 is none.
    pub epoch: u32,
    /// The engagement's number within the session.
    pub number: u32,
}

/// How long a message authorises motion, on the robot's clock and fixed when it arrived: what waits in a
/// queue does not last longer for it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Lease {
    /// When it arrived.
    pub from: Mono,
    /// When it ends.
    pub until: Mono,
}

/// A granted request to engage.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Engagement {
    /// Whose it is.
    pub ticket: Ticket,
    /// The hash of the skill that the session holds, if it holds one.
    pub model: Option<[u8; 16]>,
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
#[derive(Debug, Clone, Serialize, Deserialize)]
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
        /// The hand's orientation, valid at the same moment; without news of it the last forecast goes on.
        turn: Option<TurnForecast>,
        /// How far the gripper is to be open, from 0 to 1; without news of it the last one holds.
        grip: Option<f64>,
        /// For how long.
        lease: Lease,
    },
    /// Play goes on.
    Extend {
        /// For which engagement.
        ticket: Ticket,
        /// For how long.
        lease: Lease,
        /// What the operator's hand makes of the plan; without news of it the last one goes on.
        bent: Option<Bent>,
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

impl Order {
    /// Whether every forecast in it can be read: those of a session can, those of a file may be anything.
    pub(crate) fn is_sound(&self) -> bool {
        let turned = |turn: &Option<TurnForecast>| turn.is_none_or(|turn| turn.ahead.is_sound());
        match self {
            Self::Engage(engagement) => match &engagement.source {
                Source::Mirror { forecast, turn, .. } => forecast.ahead.is_sound() && turned(turn),
                Source::Play(_) => true,
            },
            Self::Track { forecast, turn, .. } => forecast.ahead.is_sound() && turned(turn),
            Self::Extend { bent, .. } => bent.is_none_or(|bent| bent.is_sound()),
            Self::Operator(_) | Self::Release(_) | Self::Reset { .. } => true,
        }
    }
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
    /// The plan's time while one is played, s; it has reached the tip when the tip's lag is over.
    pub plan_s: Option<f64>,
    /// Where the tip is asked to go, m.
    pub target_m: Vector3<f64>,
    /// Where the filter has it, m.
    pub reference_m: Vector3<f64>,
    /// How fast the filter's acceleration changes, m/s³.
    pub jerk_m_s3: f64,
    /// Tip, m.
    pub tip_m: Vector3<f64>,
    /// How it is oriented: tip axes to base axes.
    pub orientation: UnitQuaternion<f64>,
    /// The angle from there to the orientation asked for, or to the one being kept, rad.
    pub orientation_error_rad: f64,
    /// How far the gripper is open: 0 is closed, 1 is open.
    pub opening: Option<f64>,
    /// Joint positions.
    pub q: Joints,
    /// What is wrong with the arm, or with what drives it.
    pub fault: Option<ArmFault>,
    /// Ticks of this engagement on which a limit acted.
    pub clamps: u32,
}

/// The servo's ends of the rings.
#[derive(Debug)]
pub struct Rings {
    /// Orders from the session.
    pub orders: rtrb::Consumer<Order>,
    /// Reports to the session; dropped (and seen by their tick numbers) while it is full.
    pub reports: rtrb::Producer<Report>,
    /// Trajectories no longer needed, to be freed elsewhere.
    pub spent: rtrb::Producer<Arc<Trajectory>>,
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
    pub spent: rtrb::Consumer<Arc<Trajectory>>,
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
