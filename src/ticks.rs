//! What a robot process leaves behind: every tick in a file, and the engagement in its events.

use std::path::Path;

use anyhow::Context;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use serde::Deserialize;
use telemime_robot::cli::Event as Robot;
use telemime_robot::servo::Mapping;

/// One tick of the robot's record.
#[derive(Debug, Clone)]
pub(crate) struct Tick {
    pub(crate) tick: u64,
    /// On the host's monotonic clock.
    pub(crate) mono_ns: i64,
    /// The engagement followed last; 0 before the first.
    pub(crate) engagement: u32,
    /// Whether the arm follows now.
    pub(crate) follows: bool,
    /// Of the newest hand state, s.
    pub(crate) age_s: f64,
    /// Ticks of the engagement on which a limit acted.
    pub(crate) clamps: u32,
    pub(crate) tip_m: Vector3<f64>,
    pub(crate) tip_q: UnitQuaternion<f64>,
    pub(crate) jerk_m_s3: f64,
}

/// A line of the file; columns not named here are not needed.
#[derive(Deserialize)]
struct Line {
    tick: u64,
    mono_ns: i64,
    state: String,
    engagement: u32,
    age_s: f64,
    clamps: u32,
    tip_x: f64,
    tip_y: f64,
    tip_z: f64,
    tip_qw: f64,
    tip_qx: f64,
    tip_qy: f64,
    tip_qz: f64,
    jerk: f64,
}

/// Reads what `telemime robot --record` wrote, in order.
///
/// # Errors
/// The file cannot be read, or was not written by a robot.
pub(crate) fn read(path: &Path) -> anyhow::Result<Vec<Tick>> {
    let wrong = || format!("cannot read {}", path.display());
    let mut reader = csv::Reader::from_path(path).with_context(wrong)?;
    let ticks = reader.deserialize().map(|line| {
        let l: Line = line?;
        let q = Quaternion::new(l.tip_qw, l.tip_qx, l.tip_qy, l.tip_qz);
        Ok(Tick {
            tick: l.tick,
            mono_ns: l.mono_ns,
            engagement: l.engagement,
            follows: matches!(l.state.as_str(), "Engaged" | "Coasting"),
            age_s: l.age_s,
            clamps: l.clamps,
            tip_m: Vector3::new(l.tip_x, l.tip_y, l.tip_z),
            tip_q: UnitQuaternion::from_quaternion(q),
            jerk_m_s3: l.jerk,
        })
    });
    ticks.collect::<Result<_, csv::Error>>().with_context(wrong)
}

/// The mapping and the instant (monotonic, ns) of the first engagement, if there was one.
pub(crate) fn engagement(events: &[Robot]) -> Option<(Mapping, i64)> {
    events.iter().find_map(|e| match e {
        Robot::Engaged {
            mono_ns,
            scale,
            rotation,
            hand_m,
            tip_m,
            hand_q,
            tip_q,
            ..
        } => {
            let unit = |[w, x, y, z]: [f64; 4]| {
                UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z))
            };
            let rotation = unit(*rotation);
            let (hand_m, tip_m) = (Vector3::from(*hand_m), Vector3::from(*tip_m));
            let mapping = Mapping {
                scale: *scale,
                rotation,
                hand_m,
                tip_m,
                hand_orientation: hand_q.map(unit),
                tip_orientation: unit(*tip_q),
            };
            Some((mapping, *mono_ns))
        }
        _ => None,
    })
}
