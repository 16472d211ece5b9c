//! What the person at the page does, and what becomes of it. Sans-IO: time is an argument.
//!
//! The clutch is hold-to-run with a lease of its own: a page that holds it says so with every frame, and one that is silent
//! for [`LEASE_S`] has let go. One page holds it at a time; anybody may stop.

mod hold;
mod show;

use std::collections::VecDeque;
use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};
use telemime_protocol::checkpoint::PosePlan;
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::arm::WireArm;
use telemime_protocol::wire::v1::{Cause, RobotState, Telemetry};
use tokio::sync::{mpsc, watch};

use hold::Hold;

use super::snapshot::Seen;
use super::{Command, Holding, Shape, Snapshot};
use crate::clutch::Phase;
use crate::demonstration::{Demonstration, Sample};
use crate::recognise::{Recogniser, Verdict};
use crate::session::{Event, Session};

/// A page that holds the clutch and is silent for this long has let go, s.
pub const LEASE_S: f64 = 0.2;

/// Snapshots are this far apart, s.
const SNAPSHOT_S: f64 = 0.025;

/// Commands that wait for the daemon; what is beyond is lost, and a lost one of a page that holds the clutch lets it go.
const COMMANDS: usize = 256;

/// Notes a page is shown.
const NOTES: usize = 12;

/// Something from a page.
#[derive(Debug, Clone, PartialEq)]
pub enum Said {
    /// It looks.
    Here,
    /// A command.
    Command(Command),
    /// Something that is no command, and why.
    Wrong(String),
    /// It is gone.
    Gone,
}

/// What the server holds of it all.
#[derive(Debug, Clone)]
pub struct Port {
    /// Where commands go, each with its page's number.
    pub commands: mpsc::Sender<(u64, Said)>,
    /// The newest snapshot.
    pub snapshots: watch::Receiver<Arc<Snapshot>>,
}

/// What only the daemon can do.
#[derive(Debug)]
pub enum Act {
    /// Emergency stop.
    Stop,
    /// Learn a skill of this name.
    Learn {
        /// What it is called.
        name: String,
        /// From these.
        strokes: Vec<Demonstration>,
        /// The skills there are besides.
        others: Vec<Arc<Skill>>,
    },
    /// Go on with this skill.
    Use(Arc<Skill>),
    /// Set the link.
    Shape(Shape),
}

/// A skill and how it is played.
#[derive(Debug, Clone)]
pub struct Known {
    /// It.
    pub skill: Arc<Skill>,
    /// Its motion; `None` if it has none to play.
    pub plan: Option<PosePlan>,
}

/// The person at the page.
#[derive(Debug)]
pub struct Live {
    said: mpsc::Receiver<(u64, Said)>,
    shown: watch::Sender<Arc<Snapshot>>,
    rotation: UnitQuaternion<f64>,
    scale: f64,
    offset: Vector3<f64>,
    hold: Option<Hold>,
    gain: f64,
    known: Vec<Known>,
    using: Option<String>,
    recogniser: Option<Recogniser>,
    strokes: Vec<Demonstration>,
    taking: Vec<Sample>,
    learning: bool,
    shape: Option<Shape>,
    linked: Result<(), String>,
    state: (RobotState, Cause),
    telemetry: Option<Telemetry>,
    built: Option<Arc<WireArm>>,
    seen: Option<Seen>,
    sent_bytes: u64,
    refused: u64,
    notes: VecDeque<(u64, String)>,
    noted: u64,
    next: Stamp,
}

/// A seat for a person: what drives, and what a server needs. `rotation` turns hand axes into base axes; `shape` is
/// the link, if it can be set.
pub fn seat(
    rotation: UnitQuaternion<f64>,
    gain: f64,
    known: Vec<Known>,
    shape: Option<Shape>,
) -> (Live, Port) {
    let (commands, said) = mpsc::channel(COMMANDS);
    let (shown, snapshots) = watch::channel(Arc::default());
    let using = known.first().map(|known| known.skill.name().to_owned());
    let mut live = Live {
        said,
        shown,
        rotation,
        scale: 1.0,
        offset: Vector3::zeros(),
        hold: None,
        gain,
        known,
        using,
        recogniser: None,
        strokes: Vec::new(),
        taking: Vec::new(),
        learning: false,
        shape,
        linked: Err("calling the robot".to_owned()),
        state: (RobotState::Idle, Cause::Requested),
        telemetry: None,
        built: None,
        seen: None,
        sent_bytes: 0,
        refused: 0,
        notes: VecDeque::new(),
        noted: 0,
        next: Stamp(i64::MIN),
    };
    live.publish(None, Stamp::ZERO);
    (
        live,
        Port {
            commands,
            snapshots,
        },
    )
}

impl Live {
    /// What a page says next; never ends.
    pub async fn hear(&mut self) -> (u64, Said) {
        match self.said.recv().await {
            Some(said) => said,
            None => std::future::pending().await,
        }
    }

    /// Which skill the hand performs, if any was learned here.
    pub fn recogniser(&self) -> Option<Recogniser> {
        self.recogniser.clone()
    }

    /// Commands that were not obeyed.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Obeys, or refuses and says why. Without a `session` there is little to obey.
    pub fn handle(
        &mut self,
        now: Stamp,
        page: u64,
        said: Said,
        session: Option<&mut Session>,
    ) -> Option<Act> {
        let moves = matches!(
            said,
            Said::Command(Command::Hand { .. } | Command::Alive {})
        );
        let linked = session.is_some();
        let done = match said {
            Said::Here => Ok(None),
            Said::Gone => {
                if self.hold.as_ref().is_some_and(|hold| hold.page == page) {
                    self.note("the page that drove is gone: the clutch is let go");
                    self.let_go(session);
                }
                Ok(None)
            }
            Said::Wrong(why) => Err(why),
            Said::Command(command) => self.obey(now, page, command, session),
        };
        if !moves {
            self.next = now;
        }
        let act = done.unwrap_or_else(|why| {
            self.refused += 1;
            if self.notes.back().is_none_or(|(_, last)| *last != why) {
                self.note(why);
            }
            None
        });
        if !linked {
            self.publish(None, now);
        }
        act
    }

    fn obey(
        &mut self,
        now: Stamp,
        page: u64,
        command: Command,
        session: Option<&mut Session>,
    ) -> Result<Option<Act>, String> {
        let holds = self.hold.as_ref().is_some_and(|hold| hold.page == page);
        match command {
            Command::Stop {} => {
                // The session's stop ends what it drives.
                self.let_go(None);
                self.note("emergency stop");
                return Ok(Some(Act::Stop));
            }
            Command::Predict { .. } | Command::Discard {} | Command::Use { .. }
                if self.hold.is_some() && !holds =>
            {
                return Err("another page holds the clutch".into());
            }
            Command::Predict { gain } => {
                self.gain = gain;
                if let Some(session) = session {
                    session.set_gain(gain);
                }
            }
            Command::Discard {} => {
                self.strokes.pop().ok_or("there is no stroke to discard")?;
            }
            Command::Link(shape) => {
                self.shape
                    .as_mut()
                    .map(|known| *known = shape)
                    .ok_or("this link is what it is: only a demonstration's can be set")?;
                return Ok(Some(Act::Shape(shape)));
            }
            Command::Release {} if holds => self.let_go(session),
            // Whoever has lost the clutch may not know it yet.
            Command::Release {} | Command::Alive {} | Command::Hand { .. } if !holds => {}
            Command::Release {} => {}
            Command::Alive {} => {
                if let Some(hold) = &mut self.hold {
                    hold.heard = now;
                }
            }
            Command::Hand { t, x } => self.moved(now, t, x, session),
            Command::Reset { changes } => {
                let session = session.ok_or("there is no link: reset again when it is back")?;
                // A stop that the page has not seen is not for it to leave.
                if changes != session.changes() {
                    return Err("the robot's state is not the one that was to be reset: look, and reset again".into());
                }
                if !session.reset() {
                    return Err("the robot has not confirmed the stop yet".into());
                }
            }
            Command::Hold { what, skill, t, x } => {
                let session = session.ok_or("there is no link")?;
                self.press(now, page, (what, skill), (t, x), session)?;
            }
            Command::Learn { name } => {
                session.ok_or("there is no link: learn when it is back")?;
                if self.learning {
                    return Err("a skill is being learned".into());
                }
                if self.strokes.len() < 2 {
                    return Err("at least two strokes are needed to learn from".into());
                }
                self.learning = true;
                let others = self.known.iter().map(|known| Arc::clone(&known.skill));
                return Ok(Some(Act::Learn {
                    others: others.filter(|skill| skill.name() != name).collect(),
                    name,
                    strokes: std::mem::take(&mut self.strokes),
                }));
            }
            Command::Use { skill } => {
                session.ok_or("there is no link: choose when it is back")?;
                if self.learning {
                    return Err("a skill is being learned".into());
                }
                let known = self.named(&skill)?.skill.clone();
                self.using = Some(skill);
                return Ok(Some(Act::Use(known)));
            }
        }
        Ok(None)
    }

    fn named(&self, name: &str) -> Result<&Known, String> {
        let found = self.known.iter().find(|known| known.skill.name() == name);
        found.ok_or_else(|| format!("no skill is called {name}"))
    }

    /// The session reports.
    pub fn on_event(&mut self, now: Stamp, event: &Event) {
        match event {
            Event::Ready => self.linked = Ok(()),
            Event::Engaged { hand_m, tip_m, .. } => {
                let [hand, tip] = [hand_m, tip_m].map(|m| Vector3::from(m.map(f64::from)));
                self.offset = tip - self.scale * (self.rotation * hand);
                self.phase(Phase::Following);
            }
            Event::Refused(reason) => self.declined(now, *reason),
            Event::State(state, cause) => {
                self.state = (*state, *cause);
                let follows = self
                    .hold
                    .as_ref()
                    .is_some_and(|hold| hold.clutch.phase == Phase::Following);
                match state {
                    RobotState::Stopped => self.drop_hold(),
                    // What has not been granted yet the robot cannot have let go of.
                    RobotState::Holding if follows => self.drop_hold(),
                    RobotState::Ready if follows && *cause == Cause::PlanFinished => {
                        self.drop_hold();
                        self.note("played to its end");
                    }
                    _ => {}
                }
            }
            Event::Recognised {
                verdict,
                skill,
                probability,
                phase,
                again: _,
            } => {
                let what = match verdict {
                    Verdict::Resting => "resting",
                    Verdict::Unknown => "none of these",
                    Verdict::Undecided => "undecided",
                    Verdict::Skill(_) => "",
                };
                self.seen = Some(Seen {
                    what: what.to_owned(),
                    skill: skill.clone(),
                    probability: *probability,
                    phase: *phase,
                });
            }
            Event::Telemetry(telemetry) => {
                if telemetry.t_us != 0 {
                    self.telemetry = Some((**telemetry).clone());
                }
            }
            Event::Correction(_) | Event::Bent(_) => {}
        }
    }

    /// The connection was lost.
    pub fn on_lost(&mut self, why: &str) {
        self.drop_hold();
        self.linked = Err(why.to_owned());
        self.note(format!("the link is lost: {why}"));
        self.publish(None, Stamp::ZERO);
    }

    /// Feeds the session what is due at `now`, lets go for a page that is silent, and shows what there is.
    pub fn advise(&mut self, now: Stamp, session: &mut Session) {
        session.set_gain(self.gain);
        if self.linked.is_err() && session.info().is_some() {
            self.linked = Ok(());
            self.state = (session.state(), Cause::Requested);
        }
        match &self.hold {
            Some(hold) if now.secs_since(hold.heard) >= LEASE_S => {
                self.note("the page that drove fell silent: the clutch is let go");
                self.let_go(Some(session));
            }
            Some(hold) if hold.clutch.again().is_some_and(|at| now >= at) => {
                self.ask(now, session);
            }
            _ => {}
        }
        // Whatever took the clutch out of the hand: what nobody holds is not driven.
        let driven = |hold: &Hold| hold.what != Holding::Record;
        if session.is_driving() && !self.hold.as_ref().is_some_and(driven) {
            session.release();
        }
        if now >= self.next {
            self.next = now.offset_by_secs(SNAPSHOT_S);
            self.publish(Some(session), now);
        }
    }

    /// When [`Live::advise`] has something to do next.
    pub fn poll_timeout(&self) -> Option<Stamp> {
        let lease = self
            .hold
            .as_ref()
            .map(|hold| hold.heard.offset_by_secs(LEASE_S));
        let again = self.hold.as_ref().and_then(|hold| hold.clutch.again());
        // The server keeps one receiver; the others are pages that look.
        let snapshot = (self.shown.receiver_count() > 1).then_some(self.next);
        [lease, again, snapshot].into_iter().flatten().min()
    }

    /// So much was sent to the robot so far, bytes with all headers.
    pub fn sent(&mut self, bytes: u64) {
        self.sent_bytes = bytes;
    }

    /// Says something to every page.
    pub fn note(&mut self, text: impl Into<String>) {
        self.notes.push_back((self.noted, text.into()));
        self.noted += 1;
        if self.notes.len() > NOTES {
            self.notes.pop_front();
        }
    }
}
