//! What of a daemon's work is kept for whoever reads its metrics.

use telemime_endpoint::meter::Counts;
use telemime_endpoint::metrics::Page;
use telemime_endpoint::tally::{CAUSES, STATES, Tally, is_stop};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::{Cause, RobotState};

use super::Daemon;
use crate::session::{Counters, Event, Seen, Session};

/// A snapshot is no younger than this, s, when the next one is taken.
const EVERY_S: f64 = 0.25;

/// Sums over sessions.
#[derive(Debug, Clone, Default)]
struct Sums {
    counters: Counters,
    tally: Tally,
}

impl Sums {
    fn with(&self, session: &Session) -> Self {
        let mut sums = self.clone();
        sums.counters.add(session.counters());
        sums.tally = sums.tally.plus(session.tally());
        sums
    }

    /// What was counted for a request that was then declined is taken back; a metric cannot be.
    fn no_less_than(mut self, shown: &Self) -> Self {
        let (ours, shown) = (&mut self.counters, &shown.counters);
        ours.samples = ours.samples.max(shown.samples);
        ours.rest_samples = ours.rest_samples.max(shown.rest_samples);
        ours.knots = ours.knots.max(shown.knots);
        ours.glitches = ours.glitches.max(shown.glitches);
        self
    }
}

/// What the metrics tell, as of one moment.
#[derive(Debug, Clone, Default)]
pub struct Snapshot {
    taken: Option<Stamp>,
    connected: bool,
    sessions: u64,
    engagements: u64,
    state: Option<RobotState>,
    /// What the stream said last.
    told: Option<(RobotState, Cause)>,
    /// By the order of [`CAUSES`].
    stops: [u64; CAUSES.len()],
    past: Sums,
    sums: Sums,
    seen: Seen,
    counts: Counts,
    clamps: u32,
}

impl Daemon {
    fn show(&self, change: impl FnOnce(&mut Snapshot) -> bool) {
        if let Some(shown) = &self.shown {
            shown.send_if_modified(change);
        }
    }

    /// A session begins.
    pub(super) fn begun(&self) {
        self.show(|snapshot| {
            snapshot.connected = true;
            snapshot.sessions += 1;
            true
        });
    }

    /// Something happened in it.
    pub(super) fn saw(&self, event: &Event) {
        self.show(|snapshot| {
            match event {
                Event::Engaged { .. } => snapshot.engagements += 1,
                Event::State(state, cause) => {
                    snapshot.state = Some(*state);
                    // Telemetry may be ahead of the stream, and tells of no cause.
                    let now = (*state, *cause);
                    let stops = is_stop(snapshot.told.replace(now), now);
                    let which = CAUSES.iter().position(|(known, _)| known == cause);
                    if let Some(i) = which.filter(|_| stops) {
                        snapshot.stops[i] += 1;
                    }
                }
                Event::Telemetry(telemetry) => {
                    snapshot.state = Some(telemetry.state);
                    snapshot.clamps = telemetry.clamps;
                }
                _ => {}
            }
            false
        });
    }

    /// It goes on.
    pub(super) fn goes_on(&self, session: &Session) {
        let now = self.now();
        self.show(|snapshot| {
            if snapshot
                .taken
                .is_some_and(|at| now.secs_since(at) < EVERY_S)
            {
                return false;
            }
            snapshot.taken = Some(now);
            snapshot.sums = snapshot.past.with(session).no_less_than(&snapshot.sums);
            snapshot.seen = session.seen();
            snapshot.counts = self.meter.counts();
            true
        });
    }

    /// It is over.
    pub(super) fn ended(&self, session: &Session) {
        self.show(|snapshot| {
            snapshot.connected = false;
            (snapshot.state, snapshot.told) = (None, None);
            snapshot.past = snapshot.past.with(session).no_less_than(&snapshot.sums);
            snapshot.sums = snapshot.past.clone();
            snapshot.seen = session.seen();
            snapshot.counts = self.meter.counts();
            true
        });
    }
}

impl Snapshot {
    /// As Prometheus reads it.
    pub fn page(&self) -> String {
        let mut page = Page::new("telemime_operator_");
        page.info(
            "info",
            "What runs: always 1.",
            &[("version", env!("CARGO_PKG_VERSION"))],
        );
        let connected = u8::from(self.connected);
        page.gauge(
            "connected",
            "Whether there is a session with a robot.",
            connected,
        );
        page.counter("sessions_total", "Sessions begun.", self.sessions);
        page.counter(
            "engagements_total",
            "Engagements that the robot granted.",
            self.engagements,
        );
        let states = STATES.map(|(state, word)| (word, u8::from(self.state == Some(state))));
        page.each(
            ("robot_state", "gauge"),
            "The robot's state as last heard: 1, the others 0; all 0 without a session.",
            "state",
            states,
        );
        let stops = CAUSES.iter().zip(self.stops);
        page.each(
            ("robot_stops_total", "counter"),
            "Ends of following, and emergency stops, that were heard of, by cause.",
            "cause",
            stops.map(|((_, word), times)| (word, times)),
        );
        let Counters {
            samples,
            rest_samples,
            knots,
            glitches,
            dropped,
            ..
        } = self.sums.counters;
        page.counter(
            "samples_total",
            "Samples of the hand taken while driving.",
            u64::from(samples) + u64::from(rest_samples),
        );
        page.counter("path_knots_total", "Path knots made.", knots);
        page.counter(
            "glitches_total",
            "Samples replaced by their prediction.",
            glitches,
        );
        page.counter(
            "datagrams_dropped_total",
            "Datagrams from the robot that were malformed, foreign or late.",
            dropped,
        );
        self.sums.tally.show(&mut page, false);
        let Counts {
            sent,
            received,
            motion,
        } = self.counts;
        for (what, traffic) in [("sent", sent), ("received", received), ("motion", motion)] {
            let which = match what {
                "motion" => "sent that carried motion".to_owned(),
                what => what.to_owned(),
            };
            let help = format!("Packets {which}.");
            page.counter(&format!("packets_{what}_total"), &help, traffic.packets);
            let help = format!("Bytes of packets {which}, with all headers down to IP.");
            page.counter(&format!("bytes_{what}_total"), &help, traffic.bytes);
        }
        let up = self.seen.up.unwrap_or_default();
        page.flow("uplink", "our motions, as the robot says,", &up);
        page.flow("downlink", "the robot's telemetry", &self.seen.down);
        page.times(
            "hand_age_seconds",
            "Age of the hand state that the robot followed, in seconds: of the present or last session.",
            self.seen.age,
        );
        page.gauge(
            "clock_uncertainty_seconds",
            "How wrong the robot's estimate of the session clock may be, in seconds; NaN while unknown.",
            self.seen.clock_bound_s.unwrap_or(f64::NAN),
        );
        page.gauge(
            "robot_clamped_ticks",
            "Ticks of the present or last engagement on which a limit held the arm back.",
            self.clamps,
        );
        page.gauge(
            "robot_tick_overruns",
            "The robot's ticks that began more than a period late, as it says.",
            self.seen.servo.map_or(0, |servo| servo.overruns),
        );
        page.text()
    }
}
