//! What the operator records: the hand, what was sent of it, and what the robot says. docs/recordings.md.

use std::collections::BTreeMap;
use std::fmt;
use std::net::SocketAddr;

use nalgebra::{UnitQuaternion, Vector3};
use telemime_endpoint::recording::{
    self, At, Drawn, Hand, Json, Look, OperatorState, Outcome, RecordError, Tape, To, in_base,
    info, points, poses, warning,
};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::arm::WireArm;
use telemime_protocol::wire::v1::{RobotState, Telemetry};

use crate::session::{Event, HandSample, Session};

/// State, forecast and knots are recorded this far apart, s, and whenever the state changes.
const INTERVAL_S: f64 = 0.05;

/// The scene is said again this often, s, for whoever has a part of the file only.
const SCENE_S: f64 = 5.0;

/// The forecast is recorded so far ahead, in steps, s.
const AHEAD_STEPS: usize = 8;

const AHEAD_STEP_S: f64 = 0.05;

/// The arm as it is told is another one than the arm itself, should both recordings be looked at together.
const LOOK: Look = Look {
    prefix: "told/",
    colour: [0.90, 0.60, 0.20, 0.6],
};

enum Entry {
    Hand(Hand, Stamp, Option<Placed>),
    State(Box<OperatorState>, Stamp),
    Forecast(Vec<Vector3<f64>>, Stamp),
    Knots(Vec<Placed>, Stamp),
    Arm(Box<WireArm>),
    Telemetry(Box<Telemetry>, Stamp),
    Said(String, Stamp),
    Trouble(String, Stamp),
}

/// A hand where the tip is to be, base axes.
#[derive(Clone, Copy)]
struct Placed {
    m: Vector3<f64>,
    turn: UnitQuaternion<f64>,
}

/// From the hand to the tip, as the engage settled it.
#[derive(Debug, Clone, Copy)]
struct Mapping {
    scale: f64,
    hand_m: Vector3<f64>,
    tip_m: Vector3<f64>,
    hand_q: Option<UnitQuaternion<f64>>,
    tip_q: UnitQuaternion<f64>,
}

/// A recording of what the operator does and knows.
pub struct Scribe {
    tape: recording::Recording<Entry>,
    rotation: UnitQuaternion<f64>,
    mapping: Option<Mapping>,
    session: u32,
    engagement: u32,
    state: (RobotState, String),
    telemetry: Option<Telemetry>,
    arm: Option<WireArm>,
    next: Stamp,
    seen: Stamp,
}

impl fmt::Debug for Scribe {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Scribe").finish_non_exhaustive()
    }
}

impl Scribe {
    /// Records to a new file, or for viewers; `rotation` turns the hand's axes into base axes, and `say` is told what became
    /// of the file.
    ///
    /// # Errors
    /// [`RecordError`].
    pub fn start(
        to: To<'_>,
        rotation: UnitQuaternion<f64>,
        say: impl Fn(Outcome) + Send + 'static,
    ) -> Result<Self, RecordError> {
        let about = BTreeMap::from(
            [
                ("role", "operator"),
                ("version", env!("CARGO_PKG_VERSION")),
                ("log_time", "the session clock, ns: when it was known here"),
                ("publish_time", "the session clock, ns: when it held"),
            ]
            .map(|(key, value)| (key.to_owned(), value.to_owned())),
        );
        let mut writer = Writer::default();
        let write = move |tape: &mut Tape, entry| writer.write(tape, entry);
        Ok(Self {
            tape: recording::Recording::start(to, about, write, say)?,
            rotation,
            mapping: None,
            session: 0,
            engagement: 0,
            state: (RobotState::Idle, String::new()),
            telemetry: None,
            arm: None,
            next: Stamp(i64::MIN),
            seen: Stamp::ZERO,
        })
    }

    /// Where viewers connect, if they can.
    pub fn live(&self) -> Option<SocketAddr> {
        self.tape.live()
    }

    /// Something happened in the session.
    pub fn hear(&mut self, now: Stamp, event: &Event) {
        match event {
            Event::Engaged {
                engagement,
                hand_m,
                tip_m,
                hand_q,
                tip_q,
                ..
            } => {
                self.engagement = *engagement;
                let [hand_m, tip_m] = [hand_m, tip_m].map(|m| Vector3::from(m.map(f64::from)));
                self.mapping = Some(Mapping {
                    // Known with the next look at the session.
                    scale: 0.0,
                    hand_m,
                    tip_m,
                    hand_q: *hand_q,
                    tip_q: *tip_q,
                });
                self.next = now;
                self.say(now, format!("engagement {engagement}"));
            }
            Event::State(state, cause) => {
                self.state = (*state, format!("{cause:?}"));
                self.next = now;
                if !matches!(state, RobotState::Engaged | RobotState::Coasting) {
                    self.mapping = None;
                }
                self.say(now, format!("the robot: {state:?} ({cause:?})"));
            }
            Event::Refused(reason) => {
                let text = format!("the robot declines: {reason:?}");
                self.tape.push(Entry::Trouble(text, now));
            }
            Event::Recognised {
                skill: Some(skill),
                again: false,
                ..
            } => self.say(now, format!("the hand does: {skill}")),
            Event::Correction(change) => self.say(now, format!("the hand: {change:?}")),
            Event::Telemetry(telemetry) => {
                // Of before its clock was known nobody can say when it held.
                if telemetry.t_us != 0 {
                    self.tape.push(Entry::Telemetry(telemetry.clone(), now));
                }
                self.telemetry = Some((**telemetry).clone());
            }
            Event::Ready | Event::Recognised { .. } | Event::Bent(_) => {}
        }
    }

    /// The link is lost.
    pub fn lost(&mut self, why: &str) {
        self.mapping = None;
        let text = format!("the link is lost: {why}");
        self.tape.push(Entry::Trouble(text, self.seen));
    }

    fn say(&self, now: Stamp, text: String) {
        self.tape.push(Entry::Said(text, now));
    }

    /// Looks at the session: the samples taken since the last time, and how everything stands.
    pub fn see(&mut self, now: Stamp, session: &mut Session) {
        self.seen = now;
        self.session = session.epoch();
        if let Some(arm) = session.arm().filter(|arm| Some(*arm) != self.arm.as_ref()) {
            self.arm = Some(arm.clone());
            self.tape.push(Entry::Arm(Box::new(arm.clone())));
        }
        if let (Some(mapping), Some(scale)) = (&mut self.mapping, session.scale()) {
            mapping.scale = scale;
        }
        for (engagement, sample) in session.heard() {
            let placed = self.mapping.map(|m| self.placed(&m, &sample));
            let hand = Hand {
                t_ns: sample.t.0,
                x: sample.x.into(),
                orientation: sample.orientation.map(|q| [q.w, q.i, q.j, q.k]),
                grip: sample.grip,
                resting: sample.resting,
                session: self.session,
                engagement: engagement.unwrap_or(0),
            };
            self.tape.push(Entry::Hand(hand, now, placed));
        }
        if now >= self.next {
            self.next = now.offset_by_secs(INTERVAL_S);
            self.look(now, session);
        }
    }

    fn look(&self, now: Stamp, session: &Session) {
        let counters = session.counters();
        let told = self.telemetry.as_ref();
        let state = OperatorState {
            robot: format!("{:?}", self.state.0),
            cause: self.state.1.clone(),
            session: self.session,
            engagement: self.engagement,
            scale: session.scale(),
            messages: counters.messages,
            knots: counters.knots,
            samples: counters.samples,
            glitches: counters.glitches,
            age_s: told.map(|t| f64::from(t.age_ms) * 1e-3),
            delay_s: told.map(|t| f64::from(t.delay_ms) * 1e-3),
            clock_bound_s: told
                .filter(|t| t.clock_uncertainty_us != u32::MAX)
                .map(|t| f64::from(t.clock_uncertainty_us) * 1e-6),
            lag_s: session.info().map(|info| f64::from(info.lag_s)),
            clamps: told.map(|t| t.clamps),
            lost: told.map(|t| t.newest_seq.saturating_sub(t.received)),
            knots_held: told.map(|t| t.path_frontier),
        };
        self.tape.push(Entry::State(Box::new(state), now));
        let Some(mapping) = self.mapping else {
            return;
        };
        let placed = |m: &Vector3<f64>| self.place(&mapping, m);
        if let Some(told) = session.told() {
            let from_s = now.secs_since(told.t);
            let ahead = (0..=AHEAD_STEPS).map(|i| told.at(from_s + i as f64 * AHEAD_STEP_S));
            let ahead = ahead.map(|p| placed(&p.position)).collect();
            self.tape.push(Entry::Forecast(ahead, now));
        }
        let turned = |q: UnitQuaternion<f64>| self.turned(&mapping, q);
        let knots: Vec<_> = session
            .recent_knots()
            .map(|knot| Placed {
                m: placed(&knot.x),
                turn: knot.orientation.and_then(turned).unwrap_or_default(),
            })
            .collect();
        if !knots.is_empty() {
            self.tape.push(Entry::Knots(knots, now));
        }
    }

    fn place(&self, mapping: &Mapping, hand_m: &Vector3<f64>) -> Vector3<f64> {
        mapping.tip_m + mapping.scale * (self.rotation * (hand_m - mapping.hand_m))
    }

    /// How the tip is to be turned when the hand is turned so, if it follows that.
    fn turned(&self, mapping: &Mapping, q: UnitQuaternion<f64>) -> Option<UnitQuaternion<f64>> {
        let since = q * mapping.hand_q?.inverse();
        Some(self.rotation * since * self.rotation.inverse() * mapping.tip_q)
    }

    fn placed(&self, mapping: &Mapping, sample: &HandSample) -> Placed {
        let turn = sample.orientation.and_then(|q| self.turned(mapping, q));
        Placed {
            m: self.place(mapping, &sample.x),
            turn: turn.unwrap_or(mapping.tip_q),
        }
    }
}

/// Makes messages, on the recording's thread.
#[derive(Default)]
struct Writer {
    drawn: Option<Drawn>,
    scene: Option<Stamp>,
}

impl Writer {
    fn write(&mut self, tape: &mut Tape, entry: Entry) -> Result<(), RecordError> {
        match entry {
            Entry::Hand(hand, now, placed) => {
                let publish = Stamp(hand.t_ns);
                let at = At { log: now, publish };
                if let Some(Placed { m, turn }) = placed {
                    tape.message("/operator/hand/pose", at, &in_base(publish, &m, &turn))?;
                }
                tape.message("/operator/hand", at, &Json(hand))
            }
            Entry::State(state, now) => {
                tape.message("/operator/state", At::once(now), &Json(*state))
            }
            Entry::Forecast(ahead, now) => {
                let ahead = points(now, ahead.into_iter());
                tape.message("/operator/forecast", At::once(now), &ahead)
            }
            Entry::Knots(knots, now) => {
                let knots = poses(now, knots.iter().map(|at| (at.m, at.turn)));
                tape.message("/operator/knots", At::once(now), &knots)
            }
            Entry::Arm(arm) => {
                (self.drawn, self.scene) = (Some(Drawn::new(*arm, LOOK, &[])), None);
                Ok(())
            }
            Entry::Telemetry(telemetry, now) => self.telemetry(tape, &telemetry, now),
            Entry::Said(text, now) => {
                tape.message("/operator/log", At::once(now), &info(now, &text))
            }
            Entry::Trouble(text, now) => {
                tape.message("/operator/log", At::once(now), &warning(now, &text))
            }
        }
    }

    fn telemetry(
        &mut self,
        tape: &mut Tape,
        telemetry: &Telemetry,
        now: Stamp,
    ) -> Result<(), RecordError> {
        let publish = Stamp(telemetry.t_us.saturating_mul(1000));
        let at = At { log: now, publish };
        if let Some(drawn) = &self.drawn {
            if self
                .scene
                .is_none_or(|last| now.secs_since(last) >= SCENE_S)
            {
                self.scene = Some(now);
                tape.message("/operator/arm", at, &drawn.scene(publish))?;
            }
            let q: Vec<f64> = telemetry.q.iter().map(|q| f64::from(*q)).collect();
            tape.message("/operator/transforms", at, &drawn.transforms(publish, &q))?;
            tape.message("/operator/joints", at, &drawn.joints(publish, &q))?;
        }
        let tip_m = Vector3::from(telemetry.tip_m.map(f64::from));
        let turn = telemetry.tip_q.dequantise();
        tape.message("/operator/tip", at, &in_base(publish, &tip_m, &turn))
    }
}
