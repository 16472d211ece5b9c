//! Version 1: every message, never edited once released (a change is a new version).
//!
//! Control messages ride in frames on the control stream; what must be fresh rides in datagrams.
//! Times in datagrams are µs on the session clock unless the field says otherwise.

use serde::{Deserialize, Serialize};

use super::arm::WireArm;
use super::bend::WireBend;
use super::codec::{self, DecodeError};
use super::frame::MAX_FRAME_LEN;
use super::knots::KnotBlock;
pub use super::params::WireParams;
use super::state::WireState;
use super::turn::{WirePose, WireRotation};
use crate::checkpoint::path::{MAX_TURN_URAD, PathBounds};

mod motion;
mod reports;
pub use motion::Motion;
pub use reports::{Reception, RobotDatagram, ServoTimes, Telemetry};

/// The version this module speaks.
pub const VERSION: u16 = 1;

/// Whether this version is released: from then on its bytes never change, and a test holds `tests/vectors/wire_v1.json` to that.
pub const RELEASED: bool = false;

/// The ALPN identifier that goes with it; it freezes the framing.
pub const ALPN: &[u8] = b"telemime/1";

/// Longest datagram either end accepts, bytes.
pub const MAX_DATAGRAM_LEN: usize = 1100;

/// Most path knots in one [`Motion`].
pub const MAX_KNOTS: usize = 32;

/// Most path knots in one [`PathTail`].
pub const MAX_TAIL_KNOTS: usize = 1024;

/// Longest interval of samples in an [`Engage`], µs.
pub const MAX_SAMPLE_US: u32 = 1_000_000;

/// Most joints in a [`Telemetry`].
pub const MAX_JOINTS: usize = 10;

/// Longest skill model, bytes.
pub const MAX_MODEL_LEN: usize = 512 * 1024;

/// Longest motion plan, bytes.
pub const MAX_PLAN_LEN: usize = 128 * 1024;

/// A skill model's identity: the head of its SHA-256.
pub type ModelId = [u8; 16];

/// The part of a [`ModelId`] that every motion carries.
pub fn model_tag(id: &ModelId) -> u16 {
    // 0 is that of no skill.
    u16::from_le_bytes([id[0], id[1]]).max(1)
}

/// Operator → robot, on the control stream.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum OperatorControl {
    /// The skill model, once a session unless the robot already holds it.
    Model {
        /// Hash of `bytes`, to be verified.
        id: ModelId,
        /// `Skill::to_bytes`.
        bytes: Vec<u8>,
    },
    /// A motion to be played.
    Plan {
        /// Names the plan in `Engage`.
        id: u32,
        /// `checkpoint::PosePlan` in its encoding.
        bytes: Vec<u8>,
    },
    /// Asks for motion. The robot takes its reference at the instant it engages.
    Engage(Engage),
    /// Path knots by the stream: what datagrams have not delivered, before a release or a backlog.
    Path(PathTail),
    /// The clutch is let go: stop and hold.
    Release {
        /// Which engagement ends.
        engagement: u32,
    },
    /// Emergency stop, latched until [`OperatorControl::Reset`].
    EmergencyStop,
    /// Leaves the latched stop, on purpose.
    Reset {
        /// `changes` of the [`RobotControl::State`] that told of the stop: a stop nobody has seen is not left.
        changes: u32,
    },
    /// The operator ends the session.
    Goodbye,
}

/// How to engage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Engage {
    /// Counts up within the session; motions of another engagement are dropped.
    pub engagement: u32,
    /// When this was asked, µs: an old request is no longer meant.
    pub t_us: i64,
    /// What drives.
    pub drive: Drive,
    /// Tip metres per hand metre, in (0, 10].
    pub scale: f32,
    /// Unit quaternion w, x, y, z that turns hand axes into the robot's base axes.
    pub rotation: [f32; 4],
    /// Bound of the path, µm: its knots' quantisation steps follow from it.
    pub path_bound_um: u32,
    /// The same of the hand's orientation, µrad, at most [`MAX_TURN_URAD`]; 0: the path carries none.
    pub path_turn_bound_urad: u32,
    /// Interval of the hand's samples, µs, in 1 ..= 10⁶: the knots' times are counted in it. A guess is enough.
    pub sample_us: u32,
    /// First lease, ms.
    pub lease_ms: u16,
}

impl Engage {
    /// How exact the path is.
    pub fn path_bounds(&self) -> PathBounds {
        PathBounds::of_wire(self.path_bound_um, self.path_turn_bound_urad)
    }
}

/// What drives the arm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Drive {
    /// The operator's hand, live.
    Mirror {
        /// The newest hand state; the reference is its prediction for the instant of engaging.
        state: WireState,
        /// As in [`Motion::model`].
        model: u16,
        /// As in [`Motion::params`].
        params: WireParams,
        /// As in [`Motion::pose`].
        pose: WirePose,
    },
    /// A plan sent before.
    Play {
        /// Its id.
        plan: u32,
    },
}

/// Robot → operator, on the control stream.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum RobotControl {
    /// The first message of a session.
    Info(Info),
    /// The model is stored and will be used.
    ModelStored {
        /// Its hash.
        id: ModelId,
    },
    /// The plan is stored.
    PlanStored {
        /// Its id.
        id: u32,
    },
    /// The arm follows from now on.
    Engaged {
        /// Which request is granted.
        engagement: u32,
        /// When, µs on the session clock as the robot estimates it.
        t_us: i64,
        /// The hand position that corresponds to the tip's position at that instant, m.
        hand_m: [f32; 3],
        /// The tip's position then, m in base axes.
        tip_m: [f32; 3],
        /// The hand's orientation that corresponds to the tip's, where it is followed.
        hand_q: Option<WireRotation>,
        /// The tip's orientation then, to base axes.
        tip_q: WireRotation,
    },
    /// A request is declined.
    Refused {
        /// Why.
        reason: Refusal,
    },
    /// The state has changed.
    State {
        /// The new state.
        state: RobotState,
        /// Why.
        cause: Cause,
        /// Counts the changes since the robot daemon began.
        changes: u32,
    },
    /// How the arm is built, once a session, after [`RobotControl::Info`]; for display, and not every robot says it.
    Arm(WireArm),
}

/// What the operator needs to know of the arm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Info {
    /// The robot's name, at most 64 bytes.
    pub name: String,
    /// Movable joints.
    pub joints: u8,
    /// Largest tip speed, m/s.
    pub speed_m_s: f32,
    /// Largest tip acceleration, m/s².
    pub accel_m_s2: f32,
    /// The tip may go this far from its place in the robot's start posture, m.
    pub radius_m: f32,
    /// From predicted target to tip, s: what the horizon adds to the age of the information.
    pub lag_s: f32,
    /// The model the robot still holds.
    pub model: Option<ModelId>,
    /// The state at the start of the session.
    pub state: RobotState,
}

/// The robot's state (DESIGN §5).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum RobotState {
    /// No operator.
    #[default]
    Idle,
    /// An operator has authority; the arm holds.
    Ready,
    /// Following.
    Engaged,
    /// Following the prediction alone, fading.
    Coasting,
    /// Stopped by itself; a fresh engage is needed.
    Holding,
    /// Emergency stop, latched.
    Stopped,
}

/// Why the state changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Cause {
    /// The operator asked.
    Requested,
    /// News arrived again within the lease.
    NewsArrived,
    /// No news for a while; the lease still runs.
    NewsLate,
    /// The motion lease ran out.
    LeaseExpired,
    /// The plan has been played to its end.
    PlanFinished,
    /// The connection ended.
    ConnectionLost,
    /// Emergency stop by the operator.
    OperatorStop,
    /// Emergency stop at the robot.
    LocalStop,
    /// The robot's estimate of the session clock stepped.
    ClockStep,
    /// The robot fell behind its own work.
    Fault,
    /// What drives the arm failed, or says what cannot be.
    ArmFault,
}

/// Why a request is declined.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Refusal {
    /// The emergency stop is latched: reset first.
    Stopped,
    /// Already engaged.
    AlreadyEngaged,
    /// The engagement number is not above the last one.
    OldEngagement,
    /// The request, or the hand state to take a reference from, is too old.
    StaleReference,
    /// The session clock is not known yet.
    ClockUnknown,
    /// The model's bytes do not match its hash, or are not a model.
    BadModel,
    /// The plan does not decode, or is not known.
    BadPlan,
    /// Scale, rotation or bound outside what the message allows.
    BadMapping,
    /// The arm still moves.
    Moving,
    /// The two ends compute different predictions; the robot goes on with constant velocity.
    Diverged,
    /// The stop was made at the robot, or is not the one the reset means: only those who see it may leave it.
    NotYours,
}

/// A [`Motion`] is bits of its own; every other datagram of the operator begins with its index, from 1 to this.
const LAST_OPERATOR_DATAGRAM: u8 = 4;

/// Operator → robot, datagrams.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum OperatorDatagram {
    /// Mirror: the future and the path.
    Motion(Motion),
    /// Play: go on.
    Go {
        /// The session's epoch.
        epoch: u32,
        /// The engagement that goes on.
        engagement: u32,
        /// Counts up with every motion or go of the session.
        seq: u32,
        /// When it was sent, µs.
        t_us: i64,
        /// For how long motion is authorised, ms.
        lease_ms: u16,
        /// What the operator's hand makes of the plan, stated for `t_us`; without it the plan is played as it is, from
        /// the instant of engaging.
        bend: Option<WireBend>,
    },
    /// Answer to [`RobotDatagram::Ping`].
    Pong {
        /// The session's epoch.
        epoch: u32,
        /// `t1_us` of the ping.
        t1_us: i64,
        /// When the ping arrived, µs on the session clock.
        t2_us: i64,
        /// When this left.
        t3_us: i64,
    },
    /// Emergency stop, repeated until the robot reports [`RobotState::Stopped`].
    Stop {
        /// The session's epoch.
        epoch: u32,
    },
    /// What a disciplined clock at the operator says; with every [`OperatorDatagram::Pong`], if it has one.
    Clock {
        /// The session's epoch.
        epoch: u32,
        /// What it says.
        clock: ExternalClock,
    },
}

/// How the session clock lies to one that is kept right from outside (PTP, chrony).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ExternalClock {
    /// Time since 1970 on that clock (as `CLOCK_REALTIME` counts it) less the session clock, µs.
    pub ahead_us: i64,
    /// How wrong that clock may be, µs.
    pub dispersion_us: u32,
}

/// Knots of the path that ride on the control stream.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PathTail {
    /// The engagement whose path this is.
    pub engagement: u32,
    /// What the path's first knot is relative to.
    pub state: WireState,
    /// Number of the first of `knots` in the engagement's path.
    pub first_knot: u32,
    /// Knots in order, at most [`MAX_TAIL_KNOTS`].
    pub knots: KnotBlock,
}

/// A message of this version that can be decoded from untrusted bytes.
pub trait Message: Sized {
    /// The canonical bytes.
    fn encode(&self) -> Vec<u8>;

    /// From exactly these bytes.
    ///
    /// # Errors
    /// [`DecodeError`]: malformed, not canonical, or a field outside its range.
    fn decode(bytes: &[u8]) -> Result<Self, DecodeError>;
}

macro_rules! message {
    ($type:ty, $limit:expr) => {
        impl Message for $type {
            fn encode(&self) -> Vec<u8> {
                codec::encode(self)
            }

            fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
                let message = codec::decode::<Self, { $limit }>(bytes)?;
                message.check()?;
                Ok(message)
            }
        }
    };
}

message!(OperatorControl, MAX_FRAME_LEN);
message!(RobotControl, MAX_FRAME_LEN);
message!(RobotDatagram, MAX_DATAGRAM_LEN);

impl Message for OperatorDatagram {
    fn encode(&self) -> Vec<u8> {
        match self {
            Self::Motion(motion) => motion.pack(),
            _ => codec::encode(self),
        }
    }

    fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        let message = match bytes.first() {
            Some(_) if Motion::begins(bytes) => Self::Motion(Motion::unpack(bytes)?),
            None | Some(1..=LAST_OPERATOR_DATAGRAM) => {
                codec::decode::<Self, MAX_DATAGRAM_LEN>(bytes)?
            }
            Some(kind) => return Err(DecodeError::Malformed(format!("no message {kind}"))),
        };
        message.check()?;
        Ok(message)
    }
}

fn require(ok: bool, field: &'static str, why: &'static str) -> Result<(), DecodeError> {
    if ok {
        Ok(())
    } else {
        Err(DecodeError::Invalid { field, why })
    }
}

fn finite(values: &[f32]) -> bool {
    values.iter().all(|v| v.is_finite())
}

impl OperatorControl {
    fn check(&self) -> Result<(), DecodeError> {
        match self {
            Self::Model { bytes, .. } => {
                require(bytes.len() <= MAX_MODEL_LEN, "model.bytes", "too long")
            }
            Self::Plan { bytes, .. } => {
                require(bytes.len() <= MAX_PLAN_LEN, "plan.bytes", "too long")
            }
            Self::Engage(engage) => {
                require(
                    engage.scale > 0.0 && engage.scale <= 10.0,
                    "engage.scale",
                    "outside (0, 10]",
                )?;
                let norm: f32 = engage.rotation.iter().map(|v| v * v).sum();
                require(
                    (norm - 1.0).abs() < 1e-3,
                    "engage.rotation",
                    "not a unit quaternion",
                )?;
                require(engage.path_bound_um > 0, "engage.path_bound_um", "zero")?;
                require(
                    engage.path_turn_bound_urad <= MAX_TURN_URAD,
                    "engage.path_turn_bound_urad",
                    "above half a turn",
                )?;
                require(
                    (1..=MAX_SAMPLE_US).contains(&engage.sample_us),
                    "engage.sample_us",
                    "outside 1 to 1000000",
                )?;
                match &engage.drive {
                    Drive::Mirror {
                        state,
                        params,
                        pose,
                        ..
                    } => {
                        state.check()?;
                        params.check("engage.params")?;
                        pose.check()
                    }
                    Drive::Play { .. } => Ok(()),
                }
            }
            Self::Path(tail) => {
                tail.knots.check("path.knots", MAX_TAIL_KNOTS)?;
                tail.state.check()
            }
            Self::Release { .. } | Self::EmergencyStop | Self::Reset { .. } | Self::Goodbye => {
                Ok(())
            }
        }
    }
}

impl RobotControl {
    fn check(&self) -> Result<(), DecodeError> {
        match self {
            Self::Info(info) => {
                require(info.name.len() <= 64, "info.name", "longer than 64 bytes")?;
                let limits = [info.speed_m_s, info.accel_m_s2, info.radius_m];
                require(
                    limits.iter().all(|v| v.is_finite() && *v > 0.0),
                    "info",
                    "limits must be positive",
                )?;
                require(
                    (0.0..=2.0).contains(&info.lag_s),
                    "info.lag_s",
                    "outside 0 to 2 s",
                )
            }
            Self::Engaged {
                hand_m,
                tip_m,
                hand_q,
                tip_q,
                ..
            } => {
                require(finite(hand_m) && finite(tip_m), "engaged", "not finite")?;
                hand_q.map_or(Ok(()), |q| q.check("engaged.hand_q"))?;
                tip_q.check("engaged.tip_q")
            }
            Self::Arm(arm) => arm.check(),
            Self::ModelStored { .. }
            | Self::PlanStored { .. }
            | Self::Refused { .. }
            | Self::State { .. } => Ok(()),
        }
    }
}

impl OperatorDatagram {
    fn check(&self) -> Result<(), DecodeError> {
        match self {
            Self::Motion(motion) => motion.check(),
            Self::Go { bend, .. } => bend.as_ref().map_or(Ok(()), WireBend::check),
            Self::Pong { .. } | Self::Stop { .. } | Self::Clock { .. } => Ok(()),
        }
    }
}
