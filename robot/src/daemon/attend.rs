//! Who looks on while the daemon serves: a supervisor that wants signs of life, and whoever reads its metrics.

use std::collections::BTreeMap;

use telemime_endpoint::metrics::Page;
use telemime_endpoint::supervisor::Supervisor;
use telemime_endpoint::tally::{CAUSES, STATES, Tally, is_stop};
use telemime_endpoint::{Meter, Mono};
use telemime_protocol::wire::v1::{Cause, RobotState};
use tokio::sync::watch;

use super::{Active, Daemon};
use crate::refused::Reason;
use crate::servo::thread::Times;
use crate::servo::{Report, Ticket};
use crate::session::{Counters, Seen, Session};

/// A snapshot every so many drains: four a second.
const EVERY_DRAINS: u32 = 62;

/// What the metrics tell, as of one moment.
#[derive(Debug, Clone, Default)]
pub struct Snapshot {
    state: Option<RobotState>,
    connected: bool,
    sessions: u64,
    engagements: u64,
    /// By the order of [`CAUSES`].
    stops: [u64; CAUSES.len()],
    clamps: u64,
    faulty: bool,
    dropped: u64,
    tally: Tally,
    refused: BTreeMap<Reason, u64>,
    seen: Seen,
    clock_bound_s: Option<f64>,
    servo: Option<Times>,
    sent: (u64, u64),
    received: (u64, u64),
}

/// Those who look on. Without any, nothing is kept.
#[derive(Debug)]
pub struct Attendant {
    supervisor: Supervisor,
    shown: watch::Sender<Snapshot>,
    meter: Meter,
    /// Of the sessions that are over.
    past: Snapshot,
    drains: u32,
    /// What the last tick was in, and why.
    told: Option<(RobotState, Cause)>,
    transitions: Option<u32>,
    engagement: Ticket,
    clamps: u32,
}

impl Attendant {
    /// Tells `supervisor`, and shows snapshots, with the traffic that `meter` counts, to the receiver returned.
    pub fn new(supervisor: Supervisor, meter: Meter) -> (Self, watch::Receiver<Snapshot>) {
        let (shown, seen) = watch::channel(Snapshot::default());
        let attendant = Self {
            supervisor,
            shown,
            meter,
            past: Snapshot::default(),
            drains: 0,
            told: None,
            transitions: None,
            engagement: Ticket::default(),
            clamps: 0,
        };
        (attendant, seen)
    }

    /// A tick has been reported.
    pub(super) fn saw(&mut self, report: &Report) {
        let past = &mut self.past;
        past.state = Some(report.state);
        let now = (report.state, report.cause);
        let before = self.told.replace(now);
        past.faulty = report.fault.is_some();
        if self.engagement != report.engagement {
            self.engagement = report.engagement;
            self.clamps = 0;
            past.engagements += 1;
        }
        past.clamps += u64::from(report.clamps.saturating_sub(self.clamps));
        self.clamps = report.clamps;
        if self.transitions.replace(report.transitions) != Some(report.transitions)
            && is_stop(before, now)
            && let Some(i) = CAUSES.iter().position(|(cause, _)| *cause == report.cause)
        {
            past.stops[i] += 1;
        }
    }

    /// A session is over.
    pub(super) fn ended(&mut self, session: &Session, now: Mono) {
        self.past = self.with(Some(session), now);
        self.past.connected = false;
    }

    fn with(&self, session: Option<&Session>, now: Mono) -> Snapshot {
        let mut snapshot = self.past.clone();
        if let Some(session) = session {
            let Counters { dropped, .. } = session.counters();
            snapshot.connected = true;
            snapshot.sessions += 1;
            snapshot.dropped += u64::from(dropped);
            snapshot.tally = snapshot.tally.plus(session.tally());
            snapshot.seen = session.seen();
            snapshot.clock_bound_s = session.clock().uncertainty_s(now);
        }
        snapshot
    }
}

impl Daemon {
    /// The same with those who look on.
    #[must_use]
    pub fn attended(mut self, attendant: Option<Attendant>) -> Self {
        self.attendant = attendant;
        self
    }

    /// After a drain: a sign of life if the servo gave one, and a snapshot now and then.
    pub(super) fn attend(&mut self, active: Option<&Active>) {
        let now = self.clock.now();
        let Some(attendant) = &mut self.attendant else {
            return;
        };
        if self.silent_drains == 0 {
            attendant.supervisor.alive(now);
        }
        attendant.drains += 1;
        if attendant.drains % EVERY_DRAINS != 1 {
            return;
        }
        let mut snapshot = attendant.with(active.map(|active| &active.session), now);
        snapshot.refused = self.refused.totals().clone();
        snapshot.servo = self
            .timing
            .as_deref()
            .map(crate::servo::thread::Timing::read);
        let counts = attendant.meter.counts();
        snapshot.sent = (counts.sent.packets, counts.sent.bytes);
        snapshot.received = (counts.received.packets, counts.received.bytes);
        attendant.shown.send_replace(snapshot);
    }

    /// The daemon ends.
    pub(super) fn dismiss(&self) {
        if let Some(attendant) = &self.attendant {
            attendant.supervisor.stopping();
        }
    }
}

impl Snapshot {
    /// As Prometheus reads it.
    pub fn page(&self, arm: &str) -> String {
        let mut page = Page::new("telemime_robot_");
        let labels = [("version", env!("CARGO_PKG_VERSION")), ("arm", arm)];
        page.info("info", "What runs: always 1.", &labels);
        let states = STATES.map(|(state, word)| (word, u8::from(self.state == Some(state))));
        page.each(
            ("state", "gauge"),
            "The state the robot is in: 1, the others 0.",
            "state",
            states,
        );
        let connected = u8::from(self.connected);
        page.gauge("connected", "Whether an operator has authority.", connected);
        page.counter("sessions_total", "Sessions begun.", self.sessions);
        let help = "Engagements begun.";
        page.counter("engagements_total", help, self.engagements);
        let stops = CAUSES.iter().zip(self.stops);
        page.each(
            ("stops_total", "counter"),
            "Ends of following, and emergency stops, by cause; requested is the operator's letting go.",
            "cause",
            stops.map(|((_, word), times)| (word, times)),
        );
        let refused = Reason::ALL.map(|reason| {
            let times = self.refused.get(&reason).copied().unwrap_or_default();
            (reason.word(), times)
        });
        page.each(
            ("operators_refused_total", "counter"),
            "Connections turned away, by reason.",
            "reason",
            refused,
        );
        self.tally.show(&mut page, true);
        page.counter(
            "datagrams_dropped_total",
            "Datagrams that were malformed, foreign, late or impossible.",
            self.dropped,
        );
        for (what, (packets, bytes)) in [("sent", self.sent), ("received", self.received)] {
            let help = format!("Packets {what}.");
            page.counter(&format!("packets_{what}_total"), &help, packets);
            let help = format!("Bytes {what}, with all headers down to IP.");
            page.counter(&format!("bytes_{what}_total"), &help, bytes);
        }
        page.flow("uplink", "the operator's motions", &self.seen.up);
        page.times(
            "downlink_delay_seconds",
            "One-way delay of the pings to the operator, in seconds.",
            self.seen.down,
        );
        page.times(
            "hand_age_seconds",
            "Age of the hand state that was followed, in seconds: of the present or last session.",
            self.seen.age,
        );
        let bound_s = self.clock_bound_s.unwrap_or(f64::NAN);
        page.gauge(
            "clock_uncertainty_seconds",
            "How wrong the estimate of the session clock may be, in seconds; NaN while unknown.",
            bound_s,
        );
        page.counter(
            "clamped_ticks_total",
            "Ticks of engagements on which a limit held the arm back.",
            self.clamps,
        );
        let faulty = u8::from(self.faulty);
        page.gauge(
            "arm_fault",
            "Whether the arm, or its driver, has failed.",
            faulty,
        );
        if let Some(servo) = &self.servo {
            page.counter("ticks_total", "Servo ticks.", servo.ticks);
            page.counter(
                "tick_overruns_total",
                "Ticks that began more than a period late.",
                servo.overruns,
            );
            let s = |ns: u32| f64::from(ns) * 1e-9;
            let of = |q: crate::servo::Quantiles| {
                [
                    ("p50", s(q.p50_ns)),
                    ("p99", s(q.p99_ns)),
                    ("p999", s(q.p999_ns)),
                    ("max", s(q.max_ns)),
                ]
            };
            page.each(
                ("tick_work_seconds", "gauge"),
                "Work of a servo tick since the start, in seconds.",
                "stat",
                of(servo.work),
            );
            page.each(
                ("tick_late_seconds", "gauge"),
                "How late after its deadline a servo tick began, since the start, in seconds.",
                "stat",
                of(servo.wake),
            );
        }
        page.text()
    }
}
