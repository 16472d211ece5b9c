//! Both daemons, real QUIC and the arm, on a virtual clock: what is left of the delay at the tip.

use std::path::PathBuf;
use std::sync::Arc;

use nalgebra::Vector3;
use telemime_operator::cli::parse_future_bound;
use telemime_operator::demonstration::Demonstration;
use telemime_operator::session::{FutureBound, MAX_SILENCE_S, SessionConfig};
use telemime_operator::task::{Outcome, Recording, Task};
use telemime_protocol::skill::Skill;
use telemime_robot::control::ControlConfig;
use telemime_robot::rig::{Rig, RigError, RigOptions};
use telemime_robot::servo::{Mapping, RAMP_S, Report};
use telemime_sim::link::{Link, LinkConfig};

use crate::ground::{Pair, PairError, run_virtual};
use crate::measure::{
    Hand, Track, follow, is_edge, rms, rmse_m, sample_and_hold, smooth_jerk_m_s3,
};

/// What a raw sample takes on the wire, headers included, bytes.
const RAW_BYTES: usize = 74;

/// The lag is looked for at these intervals, s.
const LAG_GRID: usize = 8;

/// Why an arm could not be driven.
#[derive(Debug, thiserror::Error)]
pub(super) enum ArmError {
    #[error(transparent)]
    Ground(#[from] PairError),
    #[error("{0}: the arm never followed; {1}")]
    NotDriven(String, String),
}

/// Which arm, and how it is driven.
#[derive(clap::Args, Debug)]
pub(super) struct Driving {
    /// The arm [default: a 7-axis arm of our own].
    #[arg(long, value_name = "FILE", requires = "arm")]
    urdf: Option<PathBuf>,
    /// The hand is seen to rest at the first position for this long before a recording begins, s. What is judged begins half a
    /// second after the robot has engaged, and not before the recording: without a rest its first 0.6 s are not.
    #[arg(long, value_name = "S", requires = "arm", default_value_t = 1.0, value_parser = within(0.0, 60.0))]
    rest: f64,
    /// Tip metres per hand metre [default: from the demonstrations and the arm's limits].
    #[arg(long, value_name = "S", requires = "arm", value_parser = within(1e-3, 10.0))]
    scale: Option<f64>,
    /// How fast the arm's reference follows, rad/s [default: 40].
    #[arg(long, value_name = "RAD/S", requires = "arm", value_parser = within(1.0, 200.0))]
    bandwidth: Option<f64>,
    /// As for the operator, and of the arm's sessions only [default: 0.2way].
    #[arg(long, value_name = "BOUND", requires = "arm", value_parser = parse_future_bound)]
    future_bound: Option<FutureBound>,
    /// As for the operator, s, and of the arm's sessions only [default: 0.2].
    #[arg(long, value_name = "S", requires = "arm", value_parser = within(5e-3, MAX_SILENCE_S))]
    max_silence: Option<f64>,
}

fn within(least: f64, most: f64) -> impl Fn(&str) -> Result<f64, String> + Clone {
    move |text| {
        let value = text.trim().parse::<f64>().ok();
        value
            .filter(|value| (least..=most).contains(value))
            .ok_or_else(|| format!("write a number from {least} to {most}"))
    }
}

impl Driving {
    /// An arm over `link`, driven by sessions that are else as `session` says.
    pub(super) fn drive(
        &self,
        session: &SessionConfig,
        link: &LinkConfig,
    ) -> Result<Drive, RigError> {
        let default = ControlConfig::default();
        let rig = Rig::load(&RigOptions {
            urdf: self.urdf.clone(),
            control: ControlConfig {
                omega: self.bandwidth.unwrap_or(default.omega),
                ..default
            },
            ..RigOptions::default()
        })?;
        let config = SessionConfig {
            scale: self.scale,
            future_bound: self.future_bound.unwrap_or(session.future_bound),
            max_silence_s: self.max_silence.unwrap_or(session.max_silence_s),
            ..*session
        };
        Ok(Drive {
            rig,
            config,
            link: link.clone(),
            rest_s: self.rest,
        })
    }
}

/// The link and the arm.
pub(super) struct Drive {
    rig: Rig,
    config: SessionConfig,
    link: LinkConfig,
    rest_s: f64,
}

/// A hand this far from where it rested has begun to move, m: more than a tracker errs by.
const BEGUN_M: f64 = 0.02;

/// Ways to follow the hand, in the order of [`Driven::error_2`]. The last but one knows everything from when the hand, seen over
/// the link, has begun to move: nobody who begins nothing by himself can be better.
pub(super) const WAYS: [&str; 5] = [
    "delayed, ideal tip",
    "delayed, same arm",
    "guarded, same arm",
    "once begun, same arm",
    "known ahead, same arm",
];

/// One performance, driven.
#[derive(Debug, Clone)]
pub(super) struct Driven {
    /// Moments judged, 1 ms apart.
    pub(super) moments: usize,
    /// Σ of squared distances from the hand, in its metres, of each of [`WAYS`], m².
    pub(super) error_2: [f64; WAYS.len()],
    /// How late, s; `None` if it may be more than was tried.
    pub(super) lag_s: [Option<f64>; WAYS.len()],
    pub(super) scale: f64,
    /// Ticks on which a limit acted.
    pub(super) clamps: u32,
    /// Σ of the command's squared jerk over the moments, and of the scaled hand's through the filter, (m/s³)².
    pub(super) jerk_2: [f64; 2],
    pub(super) messages: u32,
    pub(super) duration_s: f64,
}

/// Drives the arm through one performance; the link's chances follow from `seed`.
pub(super) fn drive(
    d: &Demonstration,
    skill: &Arc<Skill>,
    drive: &Drive,
    seed: u64,
) -> Result<Driven, ArmError> {
    let first_s = d.samples()[0].t_s;
    let task = || {
        let samples = d.samples().iter();
        Task::replay(Recording {
            samples: samples
                .map(|s| telemime_operator::demonstration::Sample {
                    t_s: s.t_s - first_s,
                    ..*s
                })
                .collect(),
            rest_s: drive.rest_s,
        })
    };
    let (reports, zero_ns, summary) = run_virtual(async {
        let mut pair = Pair::start(&drive.rig)?;
        let skill = Some(Arc::clone(skill));
        let mut operator = pair.operator(task(), skill, drive.config, &drive.link, seed)?;
        let (summary, task) = (&mut operator.done)
            .await
            .expect("the operator's task does not panic");
        let zero_ns = task.zero().map(|zero| pair.to_mono(zero).0);
        let reports = pair.robot.reports().clone();
        Ok::<_, PairError>((reports, zero_ns, summary?))
    })??;
    let failed = |why: &str| ArmError::NotDriven(d.name().to_owned(), why.to_owned());
    if let Outcome::Interrupted(why) = &summary.outcome {
        return Err(failed(why));
    }
    let zero_ns = zero_ns.ok_or_else(|| failed("the recording never began"))?;
    let engaged: Vec<&Report> = reports
        .iter()
        .filter(|r| r.engagement.number != 0)
        .collect();
    let (Some(last), Some(begin)) = (engaged.last(), engaged.first()) else {
        return Err(failed("it was not granted"));
    };
    let time_s = |r: &Report| (r.at.0 - zero_ns) as f64 * 1e-9;
    let mapping = last.mapping;
    let tip = engaged
        .iter()
        .map(|r| (time_s(r), mapping.unplace(r.tip_m)))
        .collect();
    let truth = d
        .samples()
        .iter()
        .map(|s| (s.t_s - first_s, s.position))
        .collect();
    let track = |points| Track::new(points).map_err(|e| failed(&e.to_string()));
    let (tip, truth) = (track(tip)?, track(truth)?);
    let from_s = (time_s(begin) + RAMP_S).max(0.0);
    let counters = summary.counters;
    let mut driven = judge(&truth, &tip, from_s, &mapping, drive, seed);
    let judged = |r: &&&Report| (from_s..=d.duration_s()).contains(&time_s(r));
    driven.clamps = engaged.iter().rfind(judged).map_or(0, |r| r.clamps);
    let jerks = engaged.iter().filter(judged).map(|r| r.jerk_m_s3);
    let hand_jerk = mapping.scale * smooth_jerk_m_s3(&truth, from_s, d.duration_s());
    let ticks = driven.moments as f64;
    driven.jerk_2 = [rms(jerks), hand_jerk].map(|jerk| jerk * jerk * ticks);
    driven.messages = counters.messages;
    driven.duration_s = d.duration_s() - time_s(begin);
    Ok(driven)
}

fn judge(
    truth: &Track,
    tip: &Track,
    from_s: f64,
    mapping: &Mapping,
    drive: &Drive,
    seed: u64,
) -> Driven {
    let end_s = truth.span_s().1;
    let grid_s: Vec<f64> = (0..((end_s - from_s) * 1e3).max(0.0) as u32)
        .map(|i| from_s + f64::from(i) * 1e-3)
        .collect();
    // Every raw sample over a link of the same kind.
    let mut link = Link::new(drive.link.clone(), seed);
    let arrivals: Vec<_> = truth
        .points()
        .iter()
        .filter_map(|(t_s, x)| {
            let at_ns = link.send((t_s * 1e9) as i64, RAW_BYTES).arrival_ns()?;
            Some((at_ns as f64 * 1e-9, *t_s, *x))
        })
        .collect();
    let start = truth.points()[0].1;
    let held = |t_s: f64| sample_and_hold(&arrivals, t_s).unwrap_or(start);
    let ideal = Track::new(grid_s.iter().map(|&t| (t, held(t))).collect());
    let rig = &drive.rig;
    let begin_s = tip.span_s().0.min(0.0);
    let delayed = follow(rig, mapping, begin_s, end_s, |t| Some(Hand::from(held(t))));
    let away = |(_, x): &&(f64, Vector3<f64>)| (x - start).norm() > BEGUN_M;
    let begun = truth.points().iter().find(away);
    let seen_s = begun.map_or(end_s, |(t_s, _)| t_s + drive.link.delay_s);
    let known = |from_s: f64| {
        follow(rig, mapping, begin_s, end_s, |t| {
            let knows = t >= from_s;
            Some(Hand::from(if knows {
                truth.at(t + rig.lag_s())
            } else {
                start
            }))
        })
    };
    let (once_begun, known) = (known(seen_s), known(f64::NEG_INFINITY));
    let ways = [
        ideal.ok(),
        Some(delayed.tip),
        Some(tip.clone()),
        Some(once_begun.tip),
        Some(known.tip),
    ];
    let coarse: Vec<f64> = grid_s.iter().copied().step_by(LAG_GRID).collect();
    let error_2 = |way: &Option<Track>| {
        way.as_ref().map_or(0.0, |w| {
            rmse_m(w, truth, &grid_s).powi(2) * grid_s.len() as f64
        })
    };
    let lag_s = |way: &Option<Track>| {
        let lag_s = way.as_ref()?.lag_behind(truth, &coarse).0;
        Some(lag_s).filter(|lag_s| !is_edge(*lag_s))
    };
    Driven {
        moments: grid_s.len(),
        error_2: std::array::from_fn(|n| error_2(&ways[n])),
        lag_s: std::array::from_fn(|n| lag_s(&ways[n])),
        scale: mapping.scale,
        clamps: 0,
        jerk_2: [0.0; 2],
        messages: 0,
        duration_s: 0.0,
    }
}
