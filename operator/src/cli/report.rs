//! What the operator tells: lines for people, JSON lines for machines.

use std::path::PathBuf;

use indicatif::{ProgressBar, ProgressStyle};
use serde::{Deserialize, Serialize};
use telemime_endpoint::Mono;
use telemime_endpoint::cli::Printer;
use telemime_endpoint::logs;
use telemime_endpoint::meter::Counts;
use telemime_endpoint::recording;
use tokio::sync::mpsc;

use super::played::Played;
use super::scores::{PlayReport, Scores, TurnScores};
use crate::console::Shape;
use crate::daemon::{Notice, Summary};
use crate::input::Tally;
use crate::recognise::Verdict;
use crate::session::{self, Change};
use crate::task::{Outcome, Task};

/// A motion that explains less of the tip's was not followed.
const FOLLOWED_R2: f64 = 0.9;

/// What the operator prints with `--json`; `docs/commands.md` lists the fields.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
#[expect(
    missing_docs,
    reason = "the fields are documented where users look: docs/commands.md"
)]
pub enum Event {
    Fingerprint {
        fingerprint: String,
    },
    Note {
        text: String,
    },
    Learned {
        skill: String,
        demonstrations: usize,
        motion_components: usize,
        predictor_components: usize,
        bytes: usize,
        speed95_m_s: f64,
        reach_m: f64,
    },
    Plan(PlayReport),
    Dialling {
        why: String,
    },
    Connected {
        epoch: u32,
        version: u16,
    },
    Lost {
        why: String,
    },
    Mapping {
        robot: String,
        scale: f64,
        path_bound_m: f64,
    },
    Engaged {
        engagement: u32,
        mono_ns: i64,
    },
    Refused {
        reason: String,
    },
    State {
        state: String,
        cause: String,
        mono_ns: i64,
    },
    Recognised {
        what: String,
        skill: Option<String>,
        probability: f64,
        phase: f64,
        again: bool,
        mono_ns: i64,
    },
    Correction {
        what: String,
        mono_ns: i64,
    },
    Bent {
        plan_s: f64,
        rate: f64,
        share: f64,
        hand_m: Option<[f64; 3]>,
        offset_m: [f64; 3],
        mono_ns: i64,
    },
    Progress {
        done: f64,
    },
    Telemetry {
        age_ms: u16,
        delay_ms: u16,
        clock_uncertainty_ms: f64,
        clamps: u32,
        received: u32,
        dropped: u32,
    },
    Played {
        samples: usize,
        clamps: u32,
        rebuilt_to_tip: Scores,
        demonstrations_to_tip: Option<Scores>,
        turn_to_tip: Option<TurnScores>,
    },
    Performed {
        number: u32,
        zero_mono_ns: i64,
    },
    Console {
        url: String,
    },
    Input {
        source: String,
    },
    Device {
        source: String,
        make: String,
        name: String,
    },
    Metrics {
        url: String,
    },
    Foxglove {
        url: String,
    },
    LinkAsked(Shape),
    Kept {
        name: String,
    },
    Refined {
        skill: String,
        id: String,
        demonstrations: usize,
        bytes: usize,
        learned: Vec<(String, f64)>,
    },
    Saved {
        file: PathBuf,
    },
    Recording {
        file: PathBuf,
        messages: u64,
        dropped: u64,
        error: Option<String>,
    },
    Done {
        completed: bool,
        why: Option<String>,
        zero_mono_ns: Option<i64>,
        epoch_mono_ns: i64,
        samples: u32,
        samples_at_rest: u32,
        glitches: u32,
        input: Option<Box<Tally>>,
        messages: u32,
        messages_at_rest: u32,
        knots: u32,
        knots_at_rest: u32,
        sessions: u32,
        bytes_on_wire: u64,
        packets_on_wire: u64,
        bytes_session_up: u64,
        bytes_session_down: u64,
        link: Box<session::Seen>,
    },
}

impl Event {
    pub(super) fn done(summary: &Summary, task: &Task, epoch: Mono, latency_s: f64) -> Self {
        let why = match &summary.outcome {
            Outcome::Completed => None,
            Outcome::Interrupted(why) => Some(why.clone()),
        };
        let Counts { sent, received, .. } = summary.total;
        let motion = summary.engaged.motion;
        Self::Done {
            completed: why.is_none(),
            why,
            zero_mono_ns: task
                .zero()
                .map(|t| t.offset_by_secs(-latency_s).0 + epoch.0),
            epoch_mono_ns: epoch.0,
            samples: summary.counters.samples,
            samples_at_rest: summary.counters.rest_samples,
            glitches: summary.counters.glitches,
            input: task.tally().cloned().map(Box::new),
            messages: summary.counters.messages,
            messages_at_rest: summary.counters.rest_messages,
            knots: summary.counters.knots,
            knots_at_rest: summary.counters.rest_knots,
            sessions: summary.sessions,
            bytes_on_wire: motion.bytes,
            packets_on_wire: motion.packets,
            bytes_session_up: sent.bytes - motion.bytes,
            bytes_session_down: received.bytes,
            link: Box::new(summary.seen),
        }
    }

    pub(super) fn text(&self) -> Option<String> {
        Some(match self {
            Self::Fingerprint { fingerprint } => format!("fingerprint {fingerprint}"),
            Self::Note { text } => format!("note: {text}"),
            Self::Learned {
                skill,
                demonstrations,
                motion_components,
                predictor_components,
                bytes,
                speed95_m_s,
                reach_m,
            } => {
                format!(
                    "learned {skill} from {demonstrations} demonstrations: {motion_components} components over time, \
                     {predictor_components} over state, {:.0} kB; 95 % of speeds below {speed95_m_s:.2} m/s, reach {reach_m:.2} m",
                    *bytes as f64 / 1e3
                )
            }
            Self::Plan(p) => format!(
                "{}: {:.2} s in {} checkpoints{}{} ({} B) for {} samples; rebuilt within {:.2} mm of {:.2} mm allowed, R² {:.6}{}",
                p.skill,
                p.duration_s,
                p.checkpoints,
                p.turn_checkpoints
                    .map_or(String::new(), |n| format!(", {n} of orientation")),
                p.grip_checkpoints
                    .map_or(String::new(), |n| format!(", {n} of the gripper")),
                p.bytes,
                p.samples,
                p.rebuilt.max_m * 1e3,
                p.bound_m * 1e3,
                p.rebuilt.r2,
                p.rebuilt_turn.map_or(String::new(), |turn| format!(
                    ", orientation within {:.2}°",
                    turn.max_rad.to_degrees()
                ))
            ),
            Self::Dialling { why } => format!("dialling: {why}"),
            Self::Connected { epoch, .. } => format!("connected (session {epoch})"),
            Self::Lost { why } => format!("link lost: {why}"),
            Self::Mapping {
                robot,
                scale,
                path_bound_m,
            } => {
                format!(
                    "{robot} follows at scale {scale:.3}; path within {:.1} mm of the hand",
                    path_bound_m * 1e3
                )
            }
            Self::Engaged { engagement, .. } => format!("engaged #{engagement}"),
            // It passes within a few exchanges, and is asked again.
            Self::Refused { reason } if reason == "ClockUnknown" => return None,
            Self::Refused { reason } => format!("the robot declines: {reason}"),
            Self::State { state, cause, .. } => format!("robot: {state} ({cause})"),
            Self::Recognised { again: true, .. } => return None,
            Self::Recognised {
                skill: Some(skill),
                probability,
                phase,
                ..
            } => format!(
                "hand: {skill} ({:.0} %), {:.0} % of the way",
                probability * 1e2,
                phase * 1e2
            ),
            Self::Recognised { what, .. } if what == "none of these" => format!("hand: {what}"),
            Self::Recognised { .. } => return None,
            Self::Correction { what, .. } => format!("hand: {what}"),
            Self::Progress { .. } | Self::Telemetry { .. } | Self::Bent { .. } => return None,
            Self::Played {
                samples,
                clamps,
                rebuilt_to_tip,
                demonstrations_to_tip,
                turn_to_tip,
            } => {
                let line = |s: &Scores| {
                    format!(
                        "R² {:.5}, MAE {:.2} mm, MSE {:.2} mm²",
                        s.r2,
                        s.mae_m * 1e3,
                        s.mse_m2 * 1e6
                    )
                };
                let mut text = format!(
                    "tip against the rebuilt motion, by {samples} telemetry samples: {}",
                    line(rebuilt_to_tip)
                );
                if let Some(scores) = demonstrations_to_tip {
                    text.push_str(&format!(
                        "; against the aligned demonstrations: {}",
                        line(scores)
                    ));
                }
                if let Some(turn) = turn_to_tip {
                    text.push_str(&format!(
                        "; orientation {:.2}° RMS, {:.2}° at most",
                        turn.rms_rad.to_degrees(),
                        turn.max_rad.to_degrees()
                    ));
                }
                if *clamps > 0 && rebuilt_to_tip.r2 < FOLLOWED_R2 {
                    text.push_str(&format!(
                        "\nlimits held the arm back on {clamps} ticks: a motion begins wherever the arm is, and from here it \
                         leads out of reach; start the robot again, which takes it to its start posture, or lower --scale"
                    ));
                }
                text
            }
            // With one performance, the line at the end says all.
            Self::Performed { .. } => return None,
            Self::Input { source } => format!("the hand comes from {source}"),
            Self::Device { source, make, name } => format!("{source}  {make:10}  {name}"),
            Self::Metrics { url } => format!("metrics {url}"),
            Self::Foxglove { url } => format!("viewers {url}"),
            Self::Console { url } => format!("the page is at {url}"),
            Self::LinkAsked(_) => return None,
            Self::Kept { name } => format!("kept as {name}"),
            Self::Refined {
                skill,
                id,
                demonstrations,
                learned,
                ..
            } if learned.is_empty() => {
                format!("learned {skill} from {demonstrations} strokes, id {id}")
            }
            Self::Refined {
                skill,
                id,
                demonstrations,
                learned,
                ..
            } => {
                let novel: Vec<_> = learned
                    .iter()
                    .map(|(name, novel)| format!("{name} ({:.0} % new)", novel * 1e2))
                    .collect();
                format!(
                    "refined {skill} with {}: {demonstrations} demonstrations now, id {id}",
                    novel.join(", ")
                )
            }
            Self::Recording {
                file,
                messages,
                dropped,
                error,
            } => recording::told(file, *messages, *dropped, error.as_deref()),
            Self::Saved { file } => format!("saved {}", file.display()),
            Self::Done {
                samples,
                glitches,
                messages,
                knots,
                bytes_on_wire,
                bytes_session_up,
                bytes_session_down,
                link,
                ..
            } => format!(
                "{samples} samples in {messages} messages with {knots} path knots: {bytes_on_wire} B on the wire \
                 (and {bytes_session_up} B up, {bytes_session_down} B down for the session){}\n{link}",
                if *glitches > 0 {
                    format!("; {glitches} glitches replaced")
                } else {
                    String::new()
                }
            ),
        })
    }
}

impl Event {
    /// What became of a recording.
    pub(super) fn recording(outcome: &recording::Outcome) -> Self {
        Self::Recording {
            file: outcome.path.clone(),
            messages: outcome.messages,
            dropped: outcome.dropped,
            error: outcome.error.as_ref().map(ToString::to_string),
        }
    }
}

/// Where events go.
#[derive(Debug, Clone)]
pub(super) struct Log {
    pub(super) json: bool,
    pub(super) out: Printer,
}

impl Log {
    pub(super) fn say(&self, event: &Event) {
        if self.json {
            self.out.emit(event);
        }
        if logs::is_on() {
            let often = matches!(
                event,
                Event::Progress { .. } | Event::Telemetry { .. } | Event::Bent { .. }
            );
            logs::event(event, &event.text().unwrap_or_default(), often);
        } else if let Some(text) = event.text().filter(|_| !self.json) {
            self.out.say(text);
        }
    }

    pub(super) fn note(&self, text: &impl ToString) {
        self.say(&Event::Note {
            text: text.to_string(),
        });
    }
}

/// Turns notices into events until the daemon ends; draws a progress bar if asked to.
pub(super) async fn listen_to(
    mut heard: mpsc::UnboundedReceiver<Notice>,
    log: Log,
    epoch: Mono,
    progress: bool,
    mut played: Option<Played>,
) -> Option<Played> {
    let bar = if progress {
        ProgressBar::new(1000)
    } else {
        ProgressBar::hidden()
    };
    if let Ok(style) = ProgressStyle::with_template("{bar:40} {percent:>3} %  {msg}") {
        bar.set_style(style);
    }
    while let Some(notice) = heard.recv().await {
        if let Some(played) = &mut played {
            match &notice {
                Notice::Mapping { scale, .. } => played.mapped(*scale),
                Notice::Event(_, event) => played.hear(event),
                _ => {}
            }
        }
        let event = match notice {
            Notice::Dialling { why } => Event::Dialling { why },
            Notice::Connected { epoch, version } => Event::Connected {
                epoch,
                version: version.number(),
            },
            Notice::Lost { why } => Event::Lost { why },
            Notice::Mapping {
                scale,
                path_bound_m,
                robot,
            } => Event::Mapping {
                robot,
                scale,
                path_bound_m,
            },
            Notice::Progress(done) => {
                bar.set_position((done * 1e3) as u64);
                Event::Progress { done }
            }
            Notice::Note(text) => Event::Note { text: text.into() },
            Notice::Performed { number, zero } => Event::Performed {
                number,
                zero_mono_ns: zero.0 + epoch.0,
            },
            Notice::LinkAsked(shape) => Event::LinkAsked(shape),
            Notice::Kept(name) => Event::Kept { name },
            Notice::Refined { skill, learned } => Event::Refined {
                skill: skill.name().to_owned(),
                id: skill.id().to_string(),
                demonstrations: skill.parts().provenance.sources.len(),
                bytes: skill.to_bytes().len(),
                learned,
            },
            Notice::Saved(file) => Event::Saved { file },
            Notice::Event(at, event) => match event {
                session::Event::Ready => continue,
                session::Event::Engaged { engagement, .. } => Event::Engaged {
                    engagement,
                    mono_ns: at.0 + epoch.0,
                },
                session::Event::Refused(reason) => Event::Refused {
                    reason: format!("{reason:?}"),
                },
                session::Event::State(state, cause) => Event::State {
                    state: format!("{state:?}"),
                    cause: format!("{cause:?}"),
                    mono_ns: at.0 + epoch.0,
                },
                session::Event::Recognised {
                    verdict,
                    skill,
                    probability,
                    phase,
                    again,
                } => {
                    let what = match verdict {
                        Verdict::Resting => "resting",
                        Verdict::Unknown => "none of these",
                        Verdict::Undecided => "undecided",
                        Verdict::Skill(_) => "skill",
                    };
                    Event::Recognised {
                        what: what.to_owned(),
                        skill,
                        probability,
                        phase,
                        again,
                        mono_ns: at.0 + epoch.0,
                    }
                }
                session::Event::Correction(change) => Event::Correction {
                    what: match change {
                        Change::Grabbed => "grabbed",
                        Change::TakenOver => "taken over",
                        Change::Released => "released",
                        Change::Lost => "lost",
                    }
                    .to_owned(),
                    mono_ns: at.0 + epoch.0,
                },
                session::Event::Bent(bent) => Event::Bent {
                    plan_s: bent.plan_s,
                    rate: bent.rate,
                    share: bent.share,
                    hand_m: bent.hand_m.map(Into::into),
                    offset_m: bent.offset_m.into(),
                    mono_ns: bent.at.0 + epoch.0,
                },
                session::Event::Telemetry(t) => {
                    let uncertainty_ms = f64::from(t.clock_uncertainty_us) * 1e-3;
                    bar.set_message(format!(
                        "age {} ms, clock ±{uncertainty_ms:.0} ms, {} clamps",
                        t.age_ms, t.clamps
                    ));
                    Event::Telemetry {
                        age_ms: t.age_ms,
                        delay_ms: t.delay_ms,
                        clock_uncertainty_ms: uncertainty_ms,
                        clamps: t.clamps,
                        received: t.received,
                        dropped: t.dropped,
                    }
                }
            },
        };
        bar.suspend(|| log.say(&event));
    }
    bar.finish_and_clear();
    played
}
