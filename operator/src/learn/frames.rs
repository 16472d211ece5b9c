//! A motion relative to frames: each frame's mixture of the demonstrations as seen from there.
//! Calinon 2016, "A tutorial on task-parameterized movement learning and retrieval", §5.1.

use nalgebra::{Matrix4, UnitQuaternion, Vector3};
use telemime_protocol::pose;
use telemime_protocol::skill::{Gmm, Placement, TaskFrame, TaskModel};

use super::align::Aligned;
use super::{LearnError, LearnOptions, Progress, motion};
use crate::demonstration::Demonstration;

/// The frame where a demonstration begins.
pub const START: &str = "start";

/// The frame where it ends.
pub const GOAL: &str = "goal";

/// How unsure the start (the goal) is of the other end of the motion before anything was seen: deviation
/// as a share of the reach.
const DOUBT: f64 = 0.3;

/// Demonstrations that this doubt counts for.
const DOUBT_COUNTS: f64 = 0.5;

/// Where the frame `name` is in a demonstration.
///
/// A comment line of the recording decides. Otherwise `start` and `goal` are at the first and last sample, with the
/// hand's axes there if the recording has an orientation, the tracker's if not.
///
/// # Errors
/// [`LearnError::Frame`].
pub fn placement(d: &Demonstration, name: &str) -> Result<Placement, LearnError> {
    if let Some((_, placement)) = d.frames().iter().find(|(known, _)| known == name) {
        return Ok(*placement);
    }
    let sample = match name {
        START => &d.samples()[0],
        GOAL => d.last(),
        _ => {
            return Err(LearnError::Frame {
                name: name.to_owned(),
                path: d.path().to_owned(),
            });
        }
    };
    Ok(Placement {
        origin: sample.position,
        turn: sample.orientation.unwrap_or_else(UnitQuaternion::identity),
    })
}

/// A position as the frame sees it.
pub(super) fn seen(from: &Placement, x: &Vector3<f64>) -> Vector3<f64> {
    from.turn.inverse() * (x - from.origin)
}

/// Learns one mixture a frame, from the aligned demonstrations as seen from there.
///
/// Where a frame's axes differ between demonstrations, either the motion follows them (a cup lifted by its handle) or
/// they are an accident (a wrist that is never twice alike turns half a metre of path by centimetres). Both views are
/// fitted, from its own axes in each demonstration and from its usual ones in all, and the better explanation
/// stays. A frame that is placed turned turns the motion in either case.
///
/// What only the variation between demonstrations can show, a handful shows badly: how little the
/// start knows of the end. Each of the two ends therefore begins with a doubt that grows with the time from its own
/// moment, and that demonstrations outvote; with it, a goal can be moved after a single demonstration. An object's frame
/// has no moment of its own and needs at least two demonstrations.
///
/// # Errors
/// [`LearnError::Frame`], [`LearnError::FrameAlone`], or as [`motion::fit`].
pub fn fit(
    aligned: &Aligned,
    demonstrations: &[Demonstration],
    options: &LearnOptions,
    progress: &mut impl FnMut(Progress),
) -> Result<TaskModel, LearnError> {
    let mut frames = Vec::with_capacity(options.frames.len());
    for name in &options.frames {
        let moment = match name.as_str() {
            START => Some(0.0),
            GOAL => Some(aligned.duration_s),
            _ if demonstrations.len() < 2 => {
                return Err(LearnError::FrameAlone { name: name.clone() });
            }
            _ => None,
        };
        let placements = demonstrations
            .iter()
            .map(|d| placement(d, name))
            .collect::<Result<Vec<_>, _>>()?;
        let usual = usual(&placements);
        let mut fitted = view(aligned, &placements, options)?;
        if placements.iter().any(|p| p.turn != usual.turn) {
            let level: Vec<_> = placements.iter().map(|p| levelled(p, &usual)).collect();
            let other = view(aligned, &level, options)?;
            if other.bic < fitted.bic {
                fitted = other;
            }
        }
        let fitted = match moment {
            Some(moment_s) => doubted(&fitted.motion, moment_s, aligned)?,
            None => fitted.motion,
        };
        let square = |p: &Placement| (p.origin - usual.origin).norm_squared();
        progress(Progress::Frame {
            name: name.clone(),
            components: fitted.components().len(),
            spread_m: (placements.iter().map(square).sum::<f64>() / placements.len() as f64).sqrt(),
        });
        frames.push(TaskFrame {
            name: name.clone(),
            motion: fitted,
            usual,
        });
    }
    TaskModel::new(frames).map_err(|e| LearnError::Skill(e.into()))
}

/// The placement with the axes a frame usually has.
pub(super) fn levelled(at: &Placement, usual: &Placement) -> Placement {
    Placement {
        origin: at.origin,
        turn: usual.turn,
    }
}

/// The demonstrations as seen from somewhere.
struct View {
    motion: Gmm<4>,
    /// Of the regression chosen: lower explains them better.
    bic: f64,
}

fn view(
    aligned: &Aligned,
    placements: &[Placement],
    options: &LearnOptions,
) -> Result<View, LearnError> {
    let mut local = aligned.clone();
    for (path, from) in local.paths.iter_mut().zip(placements) {
        path.iter_mut().for_each(|x| *x = seen(from, x));
    }
    let mut bic = f64::INFINITY;
    let motion = motion::fit(&local, options, &mut |p| {
        if let Progress::Candidate(candidate) = p {
            bic = bic.min(candidate.bic);
        }
    })?;
    Ok(View { motion, bic })
}

/// The mean of placements.
fn usual(placements: &[Placement]) -> Placement {
    let n = placements.len() as f64;
    Placement {
        origin: placements.iter().map(|p| p.origin).sum::<Vector3<f64>>() / n,
        turn: pose::mean(placements.iter().map(|p| (1.0, p.turn))).unwrap_or_default(),
    }
}

/// The doubt of an end that lies at `moment_s`, as [`DOUBT_COUNTS`] demonstrations would have shown it beside
/// those there are (of which one is needed for the mean).
fn doubted(gmm: &Gmm<4>, moment_s: f64, aligned: &Aligned) -> Result<Gmm<4>, LearnError> {
    let shown = aligned.paths.len() as f64 - 1.0;
    let reach = |path: &Vec<Vector3<f64>>| {
        let far = |x: &Vector3<f64>| (x - path[0]).norm();
        path.iter().map(far).fold(0.0, f64::max)
    };
    let reach_m = aligned.paths.iter().map(reach).fold(0.0, f64::max);
    let share = DOUBT_COUNTS / (shown + DOUBT_COUNTS);
    Gmm::new(gmm.components().iter().map(|c| {
        let away = (c.mean()[0] - moment_s).abs() / aligned.duration_s;
        let deviation_m = DOUBT * reach_m * away.min(1.0);
        let mut doubt = Matrix4::zeros();
        for d in 1..4 {
            doubt[(d, d)] = share * deviation_m * deviation_m;
        }
        (c.weight(), *c.mean(), c.covariance() + doubt)
    }))
    .map_err(|_| LearnError::Singular)
}
