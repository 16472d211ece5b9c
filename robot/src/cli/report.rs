//! What the robot says: lines to read, or events for machines.

use std::net::SocketAddr;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use telemime_endpoint::cli::Printer;
use telemime_endpoint::logs;
use telemime_endpoint::pairing::Candidate;
use telemime_endpoint::reception::{Quantiles, Received};
use telemime_endpoint::recording::{self, Outcome};

use crate::blackbox::News;
use crate::daemon::PathPoint;
use crate::desk::Progress;
use crate::servo::thread::Times;
use crate::servo::{ArmFault, Locked, Realtime, Report};

/// What the robot prints with `--json`; `docs/commands.md` lists the fields.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
#[expect(
    missing_docs,
    reason = "the fields are documented where users look: docs/commands.md"
)]
pub enum Event {
    Listening {
        addr: SocketAddr,
        fingerprint: String,
        arm: String,
        joints: usize,
        lag_s: f64,
        radius_m: f64,
    },
    Metrics {
        url: String,
    },
    Foxglove {
        url: String,
    },
    Connected {
        epoch: u32,
        version: u16,
        peer: SocketAddr,
    },
    Disconnected {
        why: String,
        received: u32,
        dropped: u32,
        clock_offset_s: Option<f64>,
        clock_bound_s: Option<f64>,
        clock_origin: String,
        up: Received,
        down_delay: Option<Quantiles>,
        age: Option<Quantiles>,
    },
    Recording {
        file: PathBuf,
        messages: u64,
        dropped: u64,
        error: Option<String>,
    },
    Refused {
        reason: String,
        peer: SocketAddr,
        why: String,
        times: u32,
    },
    Pairing {
        stage: String,
        seconds: Option<f64>,
        name: Option<String>,
        fingerprint: Option<String>,
        code: Option<String>,
        why: Option<String>,
    },
    State {
        state: String,
        cause: String,
        mono_ns: i64,
    },
    Engaged {
        engagement: u32,
        mono_ns: i64,
        scale: f64,
        rotation: [f64; 4],
        hand_m: [f64; 3],
        tip_m: [f64; 3],
        hand_q: Option<[f64; 4]>,
        tip_q: [f64; 4],
    },
    Path {
        knots: Vec<PathPoint>,
    },
    Driver {
        command: String,
        joints: Vec<String>,
        rate_hz: f64,
    },
    Realtime {
        priority: Option<u8>,
        memory: Option<String>,
        why: Option<String>,
    },
    ArmFault {
        fault: ArmFault,
        why: String,
    },
    BlackBox {
        why: String,
        file: Option<PathBuf>,
        error: Option<String>,
    },
    Servo {
        ticks: u64,
        mean_ns: u32,
        p50_ns: u32,
        p99_ns: u32,
        p999_ns: u32,
        max_ns: u32,
        wake_p50_ns: u32,
        wake_p99_ns: u32,
        wake_p999_ns: u32,
        wake_max_ns: u32,
        overruns: u32,
    },
}

#[derive(Clone)]
pub(super) struct Log {
    pub(super) json: bool,
    pub(super) out: Printer,
}

impl Log {
    pub(super) fn say(&self, event: &Event, text: impl FnOnce() -> String) {
        if self.json {
            self.out.emit(event);
        }
        if logs::is_on() {
            logs::event(event, &text(), false);
        } else if !self.json {
            self.out.say(text());
        }
    }

    pub(super) fn pairing(&self, progress: &Progress) {
        let (stage, candidate) = match progress {
            Progress::Open(_) => ("open", None),
            Progress::TooSoon(_) => ("too_soon", None),
            Progress::Code(candidate) => ("code", Some(candidate)),
            Progress::Paired(candidate) => ("paired", Some(candidate)),
            Progress::Ended(_) => ("ended", None),
            Progress::Nothing => ("nothing", None),
        };
        let (seconds, why) = match progress {
            Progress::Open(span) | Progress::TooSoon(span) => (Some(span.as_secs_f64()), None),
            Progress::Ended(why) => (None, Some(why.to_string())),
            _ => (None, None),
        };
        let text = || match progress {
            Progress::Open(span) => format!(
                "pairing: the window is open for {:.0} s and one attempt; at the operator, run telemime pair HOST:PORT",
                span.as_secs_f64()
            ),
            Progress::TooSoon(span) => {
                format!(
                    "pairing: too soon after the last window; wait {:.0} s",
                    span.as_secs_f64().ceil()
                )
            }
            Progress::Code(Candidate { name, key, code }) => format!(
                "pairing: operator {name}, key {}\n\n    {code}\n\nDoes the operator show the same? Type yes or no.",
                key.short()
            ),
            Progress::Paired(Candidate { name, key, .. }) => {
                format!("pairing: operator {name} is trusted from now on\nfingerprint {key}")
            }
            Progress::Ended(why) => format!("pairing: ended without one: {why}"),
            Progress::Nothing => "pairing: there is nothing to say yes or no to".to_owned(),
        };
        let event = Event::Pairing {
            stage: stage.to_owned(),
            seconds,
            name: candidate.map(|c| c.name.to_string()),
            fingerprint: candidate.map(|c| c.key.to_string()),
            code: candidate.map(|c| c.code.to_string()),
            why,
        };
        self.say(&event, text);
    }
}

impl Log {
    /// What became of a record, or is missing in it.
    pub(super) fn black_box(&self, news: &News) {
        let (why, file, error) = match news {
            News::Saved(due, Ok(path)) => (due.words(), Some(path.clone()), None),
            News::Saved(due, Err(e)) => (due.words(), None, Some(e.to_string())),
            News::Missing(ticks) => {
                let missing = format!(
                    "{ticks} ticks are missing in the record: this computer was too slow for it, or too many orders came at once"
                );
                ("gap".to_owned(), None, Some(missing))
            }
        };
        let what = file.as_ref().map(|path| path.display().to_string());
        let text = format!(
            "black box ({why}): {}",
            what.or(error.clone()).unwrap_or_default()
        );
        self.say(&Event::BlackBox { why, file, error }, || text);
    }

    pub(super) fn recording(&self, outcome: &Outcome) {
        let Outcome {
            path,
            messages,
            dropped,
            error,
        } = outcome;
        let error = error.as_ref().map(ToString::to_string);
        let text = recording::told(path, *messages, *dropped, error.as_deref());
        let event = Event::Recording {
            file: path.clone(),
            messages: *messages,
            dropped: *dropped,
            error,
        };
        self.say(&event, || text);
    }

    /// What of a real-time priority was to be had.
    pub(super) fn realtime(&self, granted: &Realtime) {
        let Realtime { priority, locked } = granted;
        let memory = locked.as_ref().ok().map(|locked| match locked {
            Locked::All => "all",
            Locked::Present => "present",
        });
        let refused = [
            priority.as_ref().err().map(|e| {
                format!("no real-time priority ({e}): allow it by ulimit -r or CAP_SYS_NICE")
            }),
            locked.as_ref().err().map(|e| {
                format!("memory is not locked ({e}): allow it by ulimit -l or CAP_IPC_LOCK")
            }),
        ];
        let refused: Vec<_> = refused.into_iter().flatten().collect();
        let why = (!refused.is_empty()).then(|| refused.join("; "));
        let event = Event::Realtime {
            priority: priority.as_ref().ok().copied(),
            memory: memory.map(str::to_owned),
            why: why.clone(),
        };
        self.say(&event, || match why {
            Some(why) => format!("servo: {why}"),
            None => format!(
                "servo: SCHED_FIFO, {}; {} memory locked",
                priority.as_ref().map_or(0, |p| *p),
                memory.unwrap_or("no")
            ),
        });
    }

    /// How long ticks took, and how late they began.
    pub(super) fn servo(&self, times: &Times) {
        let Times {
            ticks,
            mean_ns,
            work,
            wake,
            overruns,
        } = *times;
        let event = Event::Servo {
            ticks,
            mean_ns,
            p50_ns: work.p50_ns,
            p99_ns: work.p99_ns,
            p999_ns: work.p999_ns,
            max_ns: work.max_ns,
            wake_p50_ns: wake.p50_ns,
            wake_p99_ns: wake.p99_ns,
            wake_p999_ns: wake.p999_ns,
            wake_max_ns: wake.max_ns,
            overruns,
        };
        let us = |ns: u32| f64::from(ns) * 1e-3;
        self.say(&event, || {
            format!(
                "servo: {ticks} ticks, {overruns} late\n  work    {:.1} µs mean; {:.1} p50, {:.1} p99, {:.1} p99.9, {:.1} max\n  wake-up {:.1} µs p50, {:.1} p99, {:.1} p99.9, {:.1} max",
                us(mean_ns),
                us(work.p50_ns),
                us(work.p99_ns),
                us(work.p999_ns),
                us(work.max_ns),
                us(wake.p50_ns),
                us(wake.p99_ns),
                us(wake.p999_ns),
                us(wake.max_ns),
            )
        });
    }
}

/// How often somebody was turned away, if not for the first time.
pub(super) fn nth(times: u32) -> String {
    if times > 1 {
        format!(" (for the {times}th time)")
    } else {
        String::new()
    }
}

pub(super) fn engaged(report: &Report) -> Event {
    let scalar_first = |q: &nalgebra::UnitQuaternion<f64>| [q.w, q.i, q.j, q.k];
    Event::Engaged {
        engagement: report.engagement.number,
        mono_ns: report.engaged_at.0,
        scale: report.mapping.scale,
        rotation: scalar_first(&report.mapping.rotation),
        hand_m: report.mapping.hand_m.into(),
        tip_m: report.mapping.tip_m.into(),
        hand_q: report.mapping.hand_orientation.as_ref().map(scalar_first),
        tip_q: scalar_first(&report.mapping.tip_orientation),
    }
}
