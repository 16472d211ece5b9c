//! What the robot records of itself, on the session clock: docs/recordings.md.

use std::collections::BTreeMap;
use std::net::SocketAddr;

use telemime_endpoint::Mono;
use telemime_endpoint::recording::{
    self, At, Drawn, Json, Look, Outcome, RecordError, RobotState, Tape, To, in_base, info, warning,
};
use telemime_protocol::time::Stamp;

use crate::rig::Rig;
use crate::servo::{ArmFault, Report, Ticket};
use crate::session::Session;

/// Ticks recorded are this far apart, s; one on which anything changes is always recorded.
const INTERVAL_S: f64 = 0.01;

/// The scene is said again this often, s, for whoever has a part of the file only.
const SCENE_S: f64 = 5.0;

/// A session clock that differs by this much from what the last one would say now is another one, s.
const SAME_CLOCK_S: f64 = 1.0;

const LOOK: Look = Look {
    prefix: "",
    colour: [0.70, 0.74, 0.80, 1.0],
};

#[derive(Debug)]
enum Entry {
    /// What comes now is on another session clock.
    Another,
    Tick(Box<Ticked>),
}

#[derive(Debug)]
struct Ticked {
    t: Stamp,
    report: Report,
    knots: u32,
    received: u32,
    lost: u32,
    clock_bound_s: Option<f64>,
    /// The state is another one than before.
    changed: bool,
    /// An engagement began.
    engaged: bool,
    /// It is new.
    fault: Option<ArmFault>,
}

/// A recording of the robot's ticks. It begins with the first session whose clock is known: before, nothing moves that
/// anybody asked for, and there is no clock to share with the operator's recording.
#[derive(Debug)]
pub struct Scribe {
    tape: recording::Recording<Entry>,
    /// From the robot's monotonic clock to the session's, ns.
    offset_ns: Option<i64>,
    next: Mono,
    transitions: Option<u32>,
    engagement: Ticket,
    faulty: bool,
}

impl Scribe {
    /// Records what `rig` does to a new file, or for viewers; `say` is told what became of each file.
    ///
    /// # Errors
    /// [`RecordError`].
    pub fn start(
        to: To<'_>,
        rig: &Rig,
        say: impl Fn(Outcome) + Send + 'static,
    ) -> Result<Self, RecordError> {
        let joints = rig.arm.joints();
        let names: Vec<_> = joints.iter().map(|joint| joint.name.as_str()).collect();
        let about = BTreeMap::from(
            [
                ("role", "robot"),
                ("version", env!("CARGO_PKG_VERSION")),
                ("arm", rig.arm.name()),
                ("log_time", "the operator's session clock, ns"),
                ("publish_time", "the same: when what is said held"),
            ]
            .map(|(key, value)| (key.to_owned(), value.to_owned())),
        );
        let mut writer = Writer {
            drawn: Drawn::new(rig.described(), LOOK, &names),
            dof: names.len(),
            lag_s: rig.lag_s(),
            scene: None,
        };
        let write = move |tape: &mut Tape, entry| writer.write(tape, entry);
        Ok(Self {
            tape: recording::Recording::start(to, about, write, say)?,
            offset_ns: None,
            next: Mono(i64::MIN),
            transitions: None,
            engagement: Ticket::default(),
            faulty: false,
        })
    }

    /// Where viewers connect, if they can.
    pub fn live(&self) -> Option<SocketAddr> {
        self.tape.live()
    }

    /// Takes the report of a tick, and what the session that is under way knows.
    pub fn take(&mut self, report: &Report, session: Option<&Session>) {
        let changed = self.transitions.replace(report.transitions) != Some(report.transitions);
        let engaged =
            std::mem::replace(&mut self.engagement, report.engagement) != report.engagement;
        let fault = report.fault.filter(|_| !self.faulty);
        self.faulty |= report.fault.is_some();
        if let Some(t) = session.and_then(|session| session.clock().to_session(report.at)) {
            let offset_ns = t.0 - report.at.0;
            let apart_ns = self.offset_ns.map_or(0, |known| (offset_ns - known).abs());
            self.offset_ns = Some(offset_ns);
            if apart_ns as f64 * 1e-9 > SAME_CLOCK_S {
                self.tape.push(Entry::Another);
            }
        }
        let Some(offset_ns) = self.offset_ns else {
            return;
        };
        if report.at < self.next && !changed && !engaged && fault.is_none() {
            return;
        }
        self.next = report.at.offset_by_secs(INTERVAL_S);
        let seen = session.map(Session::seen);
        self.tape.push(Entry::Tick(Box::new(Ticked {
            t: Stamp(report.at.0 + offset_ns),
            report: *report,
            knots: session
                .and_then(Session::mirror)
                .map_or(0, |mirror| mirror.frontier()),
            received: seen.map_or(0, |seen| seen.up.received),
            lost: seen.map_or(0, |seen| seen.up.lost),
            clock_bound_s: session.and_then(|session| session.clock().uncertainty_s(report.at)),
            changed,
            engaged,
            fault,
        })));
    }
}

/// Makes messages, on the recording's thread.
struct Writer {
    drawn: Drawn,
    dof: usize,
    lag_s: f64,
    scene: Option<Stamp>,
}

impl Writer {
    fn write(&mut self, tape: &mut Tape, entry: Entry) -> Result<(), RecordError> {
        let Entry::Tick(ticked) = entry else {
            self.scene = None;
            return tape.another();
        };
        let Ticked { t, report, .. } = *ticked;
        let at = At::once(t);
        if self.scene.is_none_or(|last| t.secs_since(last) >= SCENE_S) {
            self.scene = Some(t);
            tape.message("/robot/arm", at, &self.drawn.scene(t))?;
        }
        if ticked.engaged {
            let text = format!(
                "engagement {} at scale {:.3}",
                report.engagement.number, report.mapping.scale
            );
            tape.message("/robot/log", at, &info(t, &text))?;
        }
        if ticked.changed {
            let text = format!("{:?} ({:?})", report.state, report.cause);
            tape.message("/robot/log", at, &info(t, &text))?;
        }
        if let Some(fault) = ticked.fault {
            tape.message("/robot/log", at, &warning(t, &format!("the arm: {fault}")))?;
        }
        let q: Vec<f64> = report.q.iter().take(self.dof).copied().collect();
        tape.message("/robot/transforms", at, &self.drawn.transforms(t, &q))?;
        tape.message("/robot/joints", at, &self.drawn.joints(t, &q))?;
        let tip = in_base(t, &report.tip_m, &report.orientation);
        tape.message("/robot/tip", at, &tip)?;
        let target = in_base(t, &report.target_m, &report.orientation);
        tape.message("/robot/target", at, &target)?;
        let state = RobotState {
            tick: report.tick,
            mono_ns: report.at.0,
            state: format!("{:?}", report.state),
            cause: format!("{:?}", report.cause),
            session: report.engagement.epoch,
            engagement: report.engagement.number,
            moving: report.moving,
            age_s: report.age_s,
            lag_s: self.lag_s,
            clamps: report.clamps,
            knots: ticked.knots,
            received: ticked.received,
            lost: ticked.lost,
            clock_bound_s: ticked.clock_bound_s,
            plan_s: report.plan_s,
            jerk_m_s3: report.jerk_m_s3,
            orientation_error_rad: report.orientation_error_rad,
            opening: report.opening,
            fault: report.fault.map(|fault| fault.to_string()),
        };
        tape.message("/robot/state", at, &Json(state))
    }
}
