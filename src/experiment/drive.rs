//! Ours: both daemons, real QUIC, the servo and the arm, on a virtual clock.

use std::cell::RefCell;
use std::rc::Rc;

use telemime_endpoint::Mono;
use telemime_operator::cli::Axes;
use telemime_operator::daemon::{DaemonError, Notice};
use telemime_operator::demonstration::{Demonstration, Sample};
use telemime_operator::session::{Counters, Event, SessionConfig};
use telemime_operator::task::{self, Recording, Task};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::RobotState;
use telemime_robot::rig::Rig;
use telemime_robot::servo::Report;

use super::factor::Settings;
use super::subject::Subject;
use super::trace::{Outcome, Packet, Tick, Trace};
use crate::ground::{Operator, Pair, PairError, Passage, run_virtual};

/// The hand rests this long before a recording begins, s: enough for an engage over any link of the plans.
pub(super) const REST_S: f64 = 3.0;

/// Why nothing was driven over a link that not even the handshake gets through.
pub(super) const UNREACHED: &str = "the robot was not reached";

/// The other way's chances.
const DOWN_STREAM: u64 = 0x9e37_79b9_7f4a_7c15;

/// The recording a run drives.
pub(super) fn driven<'a>(settings: &Settings, subject: &'a Subject) -> &'a Demonstration {
    if settings.on_model {
        &subject.on_model
    } else {
        &subject.off_model
    }
}

/// A recording's samples from time 0 on.
pub(super) fn from_zero(d: &Demonstration) -> Vec<Sample> {
    let first_s = d.samples()[0].t_s;
    let samples = d.samples().iter();
    samples
        .map(|s| Sample {
            t_s: s.t_s - first_s,
            ..*s
        })
        .collect()
}

/// The operator's session.
pub(super) fn session(settings: &Settings, axes: Axes) -> SessionConfig {
    SessionConfig {
        max_silence_s: settings.silence_s,
        lease_s: settings.lease_s,
        future_bound: settings.future,
        path_bound_m: settings.path_m,
        input_latency_s: settings.input_latency_s,
        gain: settings.gain,
        scale: settings.scale,
        rotation: axes.rotation(),
        ..SessionConfig::default()
    }
}

#[derive(Default)]
struct Heard {
    ready: Option<Stamp>,
    /// When it came, and when it was true by the robot's clock, if that was known.
    telemetry: Vec<(Stamp, Option<Stamp>)>,
}

/// What is known when it is over.
struct Raw {
    reports: Vec<Report>,
    passages: Vec<Passage>,
    heard_ns: Vec<(i64, Option<i64>)>,
    zero_ns: Option<i64>,
    up_from: std::net::SocketAddr,
    /// When the common clock showed 0.
    origin: tokio::time::Instant,
    counters: Counters,
    outcome: task::Outcome,
    simulated_s: f64,
}

/// Drives the arm through one recording; the link's chances follow from `seed`.
pub(super) fn drive(
    settings: &Settings,
    subject: &Subject,
    rig: &Rig,
    axes: Axes,
    seed: u64,
) -> Result<Trace, PairError> {
    let samples = from_zero(driven(settings, subject));
    let end_s = samples.last().map_or(0.0, |s| s.t_s);
    let raw = run_virtual(scenario(settings, subject, rig, axes, seed, samples))??;
    let trace = |ticks, outcome, scale| Trace {
        ticks,
        packets: None,
        outcome,
        messages: raw.counters.messages - raw.counters.rest_messages,
        knots: raw.counters.knots - raw.counters.rest_knots,
        scale,
        heard_s: None,
        cpu: None,
        simulated_s: raw.simulated_s,
    };
    let why = match &raw.outcome {
        task::Outcome::Completed => "no reason given".to_owned(),
        task::Outcome::Interrupted(why) => why.clone(),
    };
    let Some(zero_ns) = raw.zero_ns else {
        return Ok(trace(Vec::new(), Outcome::NotDriven(why), f64::NAN));
    };
    // A sample is handed over later than it is valid.
    let zero_ns = zero_ns - (settings.input_latency_s * 1e9).round() as i64;
    let time_s = |ns: i64| (ns - zero_ns) as f64 * 1e-9;
    let instant_s = |at: tokio::time::Instant| time_s((at - raw.origin).as_nanos() as i64);
    let packets = raw.passages.iter().map(|p| Packet {
        up: p.from == raw.up_from,
        sent_s: instant_s(p.sent),
        bytes: p.len_bytes,
        arrived_s: p.arrives.map(instant_s),
    });
    let packets = Some(packets.collect());
    let heard = raw.heard_ns.iter();
    let heard_s = heard.map(|&(at, of)| (time_s(at), of.map(time_s)));
    let heard_s = Some(heard_s.collect());
    let Some(engaged) = raw.reports.iter().position(|r| r.engagement.number > 0) else {
        let trace = trace(Vec::new(), Outcome::NotDriven(why), f64::NAN);
        return Ok(Trace {
            packets,
            heard_s,
            ..trace
        });
    };
    let follows = |r: &Report| matches!(r.state, RobotState::Engaged | RobotState::Coasting);
    let mapping = raw.reports[engaged].mapping;
    let mut clamps = 0;
    // An arm that waits to be engaged while the recording runs errs like any other.
    let begun = raw.reports.iter().position(|r| time_s(r.at.0) >= 0.0);
    let from = begun.map_or(engaged, |begun| begun.min(engaged));
    let ticks = raw.reports[from..].iter().map(|r| {
        let limited = r.clamps > std::mem::replace(&mut clamps, r.clamps);
        Tick {
            t_s: time_s(r.at.0),
            tip_m: mapping.unplace(r.tip_m),
            turn: mapping.unorient(&r.orientation),
            jerk_m_s3: r.jerk_m_s3,
            limited,
            follows: follows(r),
            age_s: follows(r).then_some(r.age_s),
        }
    });
    let ticks: Vec<_> = ticks.collect();
    let stopped = raw.reports[engaged..].iter().find(|r| !follows(r));
    let outcome = match stopped {
        Some(r) if time_s(r.at.0) < end_s => {
            Outcome::Stopped(time_s(r.at.0), format!("{:?}", r.cause))
        }
        _ => Outcome::Followed,
    };
    Ok(Trace {
        packets,
        heard_s,
        ..trace(ticks, outcome, mapping.scale)
    })
}

async fn scenario(
    settings: &Settings,
    subject: &Subject,
    rig: &Rig,
    axes: Axes,
    seed: u64,
    samples: Vec<Sample>,
) -> Result<Raw, PairError> {
    let began = tokio::time::Instant::now();
    let mut pair = Pair::start(rig)?;
    let clock = pair.clock();
    let origin = clock.instant(Mono(0));
    pair.network.log();
    let task = Task::replay(Recording {
        samples,
        rest_s: REST_S,
    });
    let config = session(settings, axes);
    let skill = Some(subject.skill.clone());
    let operator = pair.operator(task, skill, config, &settings.up, seed)?;
    let (robot, own) = (pair.robot_addr(), operator.addr);
    pair.network
        .link(robot, own, settings.down.clone(), seed ^ DOWN_STREAM);
    let Operator {
        mut done,
        mut notices,
        ..
    } = operator;
    let heard: Rc<RefCell<Heard>> = Rc::default();
    let log = heard.clone();
    let (latency_s, session_zero) = (settings.input_latency_s, pair.to_mono(Stamp::ZERO));
    // When the recording's time is 0, known from when the robot is ready.
    let zero =
        move |ready: Stamp| Mono(ready.0 + session_zero.0).offset_by_secs(REST_S - latency_s);
    let network = pair.network.clone();
    let listening = tokio::task::spawn_local(async move {
        while let Some(notice) = notices.recv().await {
            let mut heard = log.borrow_mut();
            match notice {
                Notice::Event(at, Event::Ready) if heard.ready.is_none() => {
                    heard.ready = Some(at);
                    network.begin(clock.instant(zero(at)));
                }
                Notice::Event(at, Event::Telemetry(told)) => {
                    let of = (told.t_us != 0).then(|| Stamp(told.t_us.saturating_mul(1000)));
                    heard.telemetry.push((at, of));
                }
                _ => {}
            }
        }
    });
    let cut = settings.outage_s.map(|(from_s, to_s)| {
        let (network, heard) = (pair.network.clone(), heard.clone());
        let zero = move || heard.borrow().ready.map(zero);
        async move {
            let mut tick = tokio::time::interval(std::time::Duration::from_millis(1));
            for (at_s, down) in [(from_s, true), (to_s, false)] {
                while zero().is_none_or(|zero| clock.now().secs_since(zero) < at_s) {
                    tick.tick().await;
                }
                network.set_down(down);
            }
        }
    });
    let cutting = cut.map(tokio::task::spawn_local);
    let (summary, task) = (&mut done)
        .await
        .expect("the operator's task does not panic");
    let (counters, outcome) = match summary {
        Ok(summary) => (summary.counters, summary.outcome),
        Err(DaemonError::Unreachable { .. }) => {
            let outcome = task::Outcome::Interrupted(UNREACHED.to_owned());
            (Counters::default(), outcome)
        }
        Err(e) => return Err(e.into()),
    };
    if let Some(cutting) = cutting {
        cutting.abort();
    }
    listening.abort();
    let heard = heard.borrow();
    let mono_ns = |at: Stamp| pair.to_mono(at).0;
    let heard_ns = heard.telemetry.iter();
    let heard_ns = heard_ns.map(|&(at, of)| (mono_ns(at), of.map(mono_ns)));
    Ok(Raw {
        reports: pair.robot.reports().clone(),
        passages: pair.network.logged(),
        heard_ns: heard_ns.collect(),
        zero_ns: task.zero().map(|zero| pair.to_mono(zero).0),
        up_from: own,
        origin,
        counters,
        outcome,
        simulated_s: began.elapsed().as_secs_f64(),
    })
}
