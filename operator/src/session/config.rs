//! What a session is set to, and what it is fed.

use nalgebra::{UnitQuaternion, Vector3};
use telemime_protocol::skill::Stats;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::Versions;
use telemime_protocol::wire::v1::Info;

/// How far the robot's prediction may be off before the operator speaks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FutureBound {
    /// A distance, m.
    Absolute(f64),
    /// A multiple of the predicted standard deviation.
    Relative(f64),
    /// A share of the way the hand usually goes from a sample until its message takes effect, as the skill's
    /// demonstrations have it (root mean square), but at most two predicted deviations; without a skill half a metre a second
    /// along each axis is taken for usual.
    Share(f64),
}

/// Longest silence that still lets the arm follow at full speed, s: the robot coasts after 0.26 s.
pub const MAX_SILENCE_S: f64 = 0.25;

/// Longest lease the robot grants, s.
pub const MAX_LEASE_S: f64 = 1.0;

/// What a session is set to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SessionConfig {
    /// The operator speaks at least this often, s.
    pub max_silence_s: f64,
    /// Two motions are at least this far apart, s, however fast the samples come.
    pub min_interval_s: f64,
    /// For how long each message authorises motion, s.
    pub lease_s: f64,
    /// ε_future.
    pub future_bound: FutureBound,
    /// ε_path, m; `None` is 2 % of the skill's reach.
    pub path_bound_m: Option<f64>,
    /// The same for the orientation, where the hand has one, rad; 0: the path carries the place only.
    pub path_turn_bound_rad: f64,
    /// The input's own latency, s: how long after it was valid a sample is handed over. It is subtracted from the sample's time.
    pub input_latency_s: f64,
    /// What a tracker gets wrong for a frame or two is replaced by its prediction. For trackers that do: a hand that
    /// jumps farther than it ever did is believed two samples later.
    pub glitch_gate: bool,
    /// Prediction gain κ in [0, 1].
    pub gain: f64,
    /// How exactly the hand means its displacement when it corrects what is played, m: the smaller, the more it bends it.
    pub hand_sigma_m: f64,
    /// Tip metres per hand metre; `None` derives it from the demonstrations and the arm's limits.
    pub scale: Option<f64>,
    /// Hand axes to the robot's base axes.
    pub rotation: UnitQuaternion<f64>,
    /// The protocol versions this operator offers.
    pub versions: Versions,
}

impl Default for SessionConfig {
    fn default() -> Self {
        Self {
            max_silence_s: 0.2,
            min_interval_s: 0.01,
            lease_s: 0.65,
            future_bound: FutureBound::Share(0.2),
            path_bound_m: None,
            path_turn_bound_rad: 0.05,
            input_latency_s: 0.0,
            glitch_gate: false,
            gain: 1.0,
            hand_sigma_m: 0.02,
            scale: None,
            rotation: UnitQuaternion::identity(),
            versions: Versions::default(),
        }
    }
}

impl SessionConfig {
    /// The lease as it travels, ms: in steps of 10, rounded down.
    pub fn lease_ms(&self) -> u16 {
        // What is a step but for the last bit is one.
        ((self.lease_s * 1e2 + 1e-6) as u16).saturating_mul(10)
    }
}

/// The hand at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HandSample {
    /// When it is handed over: it is valid [`SessionConfig::input_latency_s`] earlier.
    pub t: Stamp,
    /// Position, m.
    pub x: Vector3<f64>,
    /// Orientation, from the hand's own axes to the tracker's, where the input has it.
    pub orientation: Option<UnitQuaternion<f64>>,
    /// How far the gripper is to be open, 0 to 1, where the input says so.
    pub grip: Option<f64>,
    /// Made up, so that a recording begins at rest: followed like any other, and counted apart.
    pub resting: bool,
}

impl HandSample {
    /// A position (m) and nothing else.
    pub fn at(t: Stamp, x: Vector3<f64>) -> Self {
        Self {
            t,
            x,
            orientation: None,
            grip: None,
            resting: false,
        }
    }
}

/// The largest scale at which the demonstrated motion stays within 0.8 of the arm's speed and
/// acceleration, and within its reach; never above 1 (driving.md §2).
pub fn default_scale(stats: &Stats, info: &Info) -> f64 {
    let within = |limit: f32, demonstrated: f64| f64::from(limit) / demonstrated.max(1e-6);
    let speed = 0.8 * within(info.speed_m_s, stats.speed95_m_s);
    let acceleration = 0.8 * within(info.accel_m_s2, stats.acceleration95_m_s2);
    let reach = within(info.radius_m, stats.reach_m);
    speed.min(acceleration).min(reach).clamp(1e-3, 1.0)
}
