//! What the person at the page does, and what becomes of it. Sans-IO: time is an argument.
//!
//! The clutch is hold-to-run with a lease of its own: a page that holds it says so with every frame, and one that is silent
//! for [`LEASE_S`] has let go. One page holds it at a time; anybody may stop.

use std::collections::VecDeque;
use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};
use telemime_protocol::checkpoint::PosePlan;
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::arm::WireArm;
use telemime_protocol::wire::v1::{Cause, Refusal, RobotState, Telemetry};
use tokio::sync::{mpsc, watch};

use super::snapshot::{Arm, HandShown, Robot, Seen, Sent};
use super::{Command, Holding, Shape, Snapshot};
use crate::demonstration::{Demonstration, Sample};
use crate::lessons::{Lesson, LessonError};
use crate::recognise::{Recogniser, Verdict};
use crate::session::{Event, HandSample, Session};

/// A page that holds the clutch and is silent for this long has let go, s.
pub const LEASE_S: f64 = 0.2;

/// A sample is never dated back by more than this, s.
const OLDEST_S: f64 = 0.1;

/// Snapshots are this far apart, s.
const SNAPSHOT_S: f64 = 0.025;

/// Pause before a declined request is made again, s, and how often.
const RETRY_S: f64 = 0.05;
const RETRIES: u32 = 40;

/// Commands that wait for the daemon; what is beyond is lost, and a lost one of a page that holds the clutch lets it go.
const COMMANDS: usize = 256;

/// Strokes that are kept.
const MOST_STROKES: usize = 50;

/// Longest stroke, samples: two minutes at 125 a second.
const LONGEST_STROKE: usize = 15_000;

/// Notes a page is shown.
const NOTES: usize = 12;

/// The tube is shown so far ahead, in steps, s.
const AHEAD_STEPS: usize = 8;
const AHEAD_STEP_S: f64 = 0.05;

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

#[derive(Debug, Clone, Copy, PartialEq)]
enum Phase {
    /// To be asked again then.
    Again(Stamp),
    Asked,
    Following,
    /// Nothing is asked of the robot.
    Apart,
}

#[derive(Debug)]
struct Hold {
    page: u64,
    what: Holding,
    phase: Phase,
    tries: u32,
    heard: Stamp,
    /// The session clock less the page's at the fastest message so far, s.
    ahead_s: f64,
    newest: Option<(Stamp, Vector3<f64>)>,
}

impl Hold {
    /// When a sample of the page's time `t_ms` was valid: jitter of the browser is taken out of it.
    fn dated(&mut self, now: Stamp, t_ms: f64) -> Stamp {
        let page_s = t_ms * 1e-3;
        let ahead_s = now.0 as f64 * 1e-9 - page_s;
        // A page's clock may drift: what was fastest once is not for ever.
        self.ahead_s = ahead_s.min(self.ahead_s + 1e-4);
        let late_s = (ahead_s - self.ahead_s).clamp(0.0, OLDEST_S);
        now.offset_by_secs(-late_s)
    }
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
    let live = Live {
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
    (live, Port { commands, snapshots })
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
    pub fn handle(&mut self, now: Stamp, page: u64, said: Said, session: Option<&mut Session>) -> Option<Act> {
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
        self.next = now;
        done.unwrap_or_else(|why| {
            self.refused += 1;
            if self.notes.back().is_none_or(|(_, last)| *last != why) {
                self.note(why);
            }
            None
        })
    }

    fn obey(&mut self, now: Stamp, page: u64, command: Command, session: Option<&mut Session>) -> Result<Option<Act>, String> {
        let holds = self.hold.as_ref().is_some_and(|hold| hold.page == page);
        match command {
            Command::Stop {} => {
                self.let_go(session);
                self.note("emergency stop");
                return Ok(Some(Act::Stop));
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
                self.shape.as_mut().map(|known| *known = shape).ok_or("this link is what it is: only a demonstration's can be set")?;
                return Ok(Some(Act::Shape(shape)));
            }
            Command::Release {} if holds => self.let_go(session),
            // Whoever has lost the clutch may not know it yet.
            Command::Release {} | Command::Alive {} | Command::Hand { .. } if !holds => {}
            Command::Release {} => {}
            Command::Alive {} => self.hold.as_mut().into_iter().for_each(|hold| hold.heard = now),
            Command::Hand { t, x } => self.moved(now, t, x, session),
            Command::Reset {} => {
                let session = session.ok_or("there is no link: reset again when it is back")?;
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

    fn press(&mut self, now: Stamp, page: u64, (what, skill): (Holding, Option<String>), (t, x): (f64, [f64; 3]), session: &mut Session) -> Result<(), String> {
        match &self.hold {
            Some(hold) if hold.page != page => return Err("another page holds the clutch".into()),
            Some(_) => self.let_go(Some(session)),
            None => {}
        }
        if what != Holding::Record && !session.is_ready() {
            return Err("the robot is not ready yet: it is still told of the skill".into());
        }
        if what != Holding::Record && session.state() == RobotState::Stopped {
            return Err("the emergency stop is latched: reset it first".into());
        }
        self.scale = session.scale().unwrap_or(1.0);
        self.offset = Vector3::zeros();
        self.taking.clear();
        self.hold = Some(Hold {
            page,
            what,
            phase: Phase::Apart,
            tries: 0,
            heard: now,
            ahead_s: f64::INFINITY,
            newest: None,
        });
        match what {
            Holding::Hand => {
                session.forget_hand();
                self.moved(now, t, x, Some(session));
                self.ask(now, session);
            }
            Holding::Record => self.moved(now, t, x, None),
            Holding::Play => {
                let name = skill.or_else(|| self.using.clone()).unwrap_or_default();
                let plan = self.named(&name).and_then(|known| {
                    known.plan.as_ref().ok_or_else(|| format!("{name} cannot be played"))
                });
                match plan {
                    Ok(plan) => session.play(plan, None),
                    Err(why) => {
                        self.hold = None;
                        return Err(why);
                    }
                }
                self.phase(Phase::Asked);
            }
        }
        Ok(())
    }

    fn phase(&mut self, phase: Phase) {
        if let Some(hold) = &mut self.hold {
            hold.phase = phase;
        }
    }

    fn ask(&mut self, now: Stamp, session: &mut Session) {
        if let Some(hold) = &mut self.hold {
            hold.phase = Phase::Asked;
            hold.tries += 1;
            session.engage(now);
        }
    }

    fn moved(&mut self, now: Stamp, t_ms: f64, x: [f64; 3], session: Option<&mut Session>) {
        let Some(hold) = &mut self.hold else {
            return;
        };
        hold.heard = now;
        let t = hold.dated(now, t_ms);
        if hold.what == Holding::Play || hold.newest.is_some_and(|(last, _)| t <= last) {
            return;
        }
        let place = self.rotation.inverse() * Vector3::from(x) / self.scale;
        hold.newest = Some((t, place));
        if hold.what == Holding::Record {
            if self.taking.len() < LONGEST_STROKE {
                self.taking.push(Sample::at(t.0 as f64 * 1e-9, place));
            }
        } else if let Some(session) = session {
            session.handle_sample(now, HandSample::at(t, place));
        }
    }

    /// Lets go of the clutch, whoever holds it and whatever for.
    fn let_go(&mut self, session: Option<&mut Session>) {
        let Some(hold) = self.hold.take() else {
            return;
        };
        match hold.what {
            Holding::Record => self.stroke(),
            Holding::Hand | Holding::Play => {
                if let Some(session) = session {
                    session.release();
                }
            }
        }
    }

    fn stroke(&mut self) {
        let taken = std::mem::take(&mut self.taking);
        let zero_s = taken.first().map_or(0.0, |first| first.t_s);
        let samples: Vec<_> = taken
            .into_iter()
            .map(|sample| Sample {
                t_s: sample.t_s - zero_s,
                ..sample
            })
            .collect();
        let name = format!("stroke {}", self.strokes.len() + 1);
        match Demonstration::from_samples(&name, &samples) {
            Ok(_) if self.strokes.len() >= MOST_STROKES => {
                self.note(format!("{MOST_STROKES} strokes are enough: learn, or discard some"));
            }
            Ok(stroke) => self.strokes.push(stroke),
            Err(e) => self.note(format!("not taken: {e}")),
        }
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
                let finished = *cause == Cause::PlanFinished;
                if let RobotState::Holding | RobotState::Stopped = state {
                    self.drop_hold();
                } else if *state == RobotState::Ready && finished {
                    self.drop_hold();
                    self.note("played to its end");
                }
            }
            Event::Recognised {
                verdict,
                skill,
                probability,
                phase,
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

    /// The session has let go already.
    fn drop_hold(&mut self) {
        self.let_go(None);
    }

    fn declined(&mut self, now: Stamp, reason: Refusal) {
        let passes = matches!(
            reason,
            Refusal::ClockUnknown | Refusal::Moving | Refusal::StaleReference
        );
        match &mut self.hold {
            Some(hold) if passes && hold.what == Holding::Hand && hold.tries < RETRIES => {
                hold.phase = Phase::Again(now.offset_by_secs(RETRY_S));
            }
            _ if reason == Refusal::Diverged => {}
            _ => {
                self.drop_hold();
                self.note(format!("the robot declines: {reason:?}"));
            }
        }
    }

    /// The connection was lost.
    pub fn on_lost(&mut self, why: &str) {
        self.drop_hold();
        self.linked = Err(why.to_owned());
        self.note(format!("the link is lost: {why}"));
        self.publish(None, Stamp::ZERO);
    }

    /// What was learned.
    pub fn on_lesson(&mut self, lesson: &Result<Lesson, LessonError>) {
        self.learning = false;
        let skill = match lesson {
            Ok(Lesson { skill: Some(skill), .. }) => skill,
            Ok(lesson) => {
                let why = lesson.left_out.first().map_or("", |(_, why)| why.as_str());
                return self.note(format!("not learned: {why}"));
            }
            Err(e) => return self.note(e.to_string()),
        };
        let taught = lesson.as_ref().ok().and_then(|lesson| lesson.taught.as_ref());
        let before = self.known.iter().position(|known| known.skill.name() == skill.name());
        let before = before.map(|at| self.known.remove(at));
        let plan = match taught {
            Some(taught) => taught.plan.clone(),
            None => before.and_then(|before| before.plan),
        };
        self.known.push(Known {
            skill: Arc::clone(skill),
            plan,
        });
        self.using = Some(skill.name().to_owned());
        if let Some(taught) = taught {
            self.recogniser.clone_from(&taught.recogniser);
        }
        self.note(format!("{} is learned", skill.name()));
    }

    /// All strokes that a lesson could not even begin with are back.
    pub fn on_no_lesson(&mut self, strokes: Vec<Demonstration>, why: &LessonError) {
        self.learning = false;
        self.strokes = strokes;
        self.note(why.to_string());
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
            Some(Hold { phase: Phase::Again(at), .. }) if now >= *at => self.ask(now, session),
            _ => {}
        }
        if now >= self.next {
            self.next = now.offset_by_secs(SNAPSHOT_S);
            self.publish(Some(session), now);
        }
    }

    /// When [`Live::advise`] has something to do next.
    pub fn poll_timeout(&self) -> Option<Stamp> {
        let lease = self.hold.as_ref().map(|hold| hold.heard.offset_by_secs(LEASE_S));
        let again = self.hold.as_ref().and_then(|hold| match hold.phase {
            Phase::Again(at) => Some(at),
            _ => None,
        });
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

    fn publish(&mut self, session: Option<&Session>, now: Stamp) {
        if let Some(arm) = session.and_then(Session::arm)
            && self.built.as_deref() != Some(arm)
        {
            self.built = Some(Arc::new(arm.clone()));
        }
        self.shown.send_replace(Arc::new(self.snapshot(session, now)));
    }

    fn snapshot(&self, session: Option<&Session>, now: Stamp) -> Snapshot {
        let ms = |t: Stamp| t.0 as f64 * 1e-6;
        let shown = |hand: &Vector3<f64>| self.offset + self.scale * (self.rotation * hand);
        let point = |hand: &Vector3<f64>, w: f64| {
            let p = shown(hand);
            [p.x, p.y, p.z, w]
        };
        let following = self.hold.as_ref().filter(|hold| hold.phase == Phase::Following);
        let told = following.and_then(|_| session?.told());
        let path = told.map_or_else(Vec::new, |told| {
            let from_s = now.secs_since(told.t);
            let ahead = (0..=AHEAD_STEPS).map(|i| told.at(from_s + i as f64 * AHEAD_STEP_S));
            ahead.map(|p| point(&p.position, self.scale * p.sigma_m)).collect()
        });
        let knots = following.and_then(|_| session).map_or_else(Vec::new, |session| {
            let knots = session.recent_knots();
            knots.map(|(x, held)| point(&x, f64::from(u8::from(held)))).collect()
        });
        Snapshot {
            t: ms(now),
            linked: self.linked.is_ok(),
            why: self.linked.clone().err().unwrap_or_default(),
            built: self.built.clone(),
            holder: self.hold.as_ref().map(|hold| hold.page),
            driving: self.hold.as_ref().map(|hold| match hold.what {
                Holding::Hand => "hand",
                Holding::Record => "record",
                Holding::Play => "play",
            }),
            robot: session.and_then(Session::info).map(|info| Robot {
                name: info.name.clone(),
                state: format!("{:?}", self.state.0),
                cause: format!("{:?}", self.state.1),
                speed_m_s: info.speed_m_s,
                radius_m: info.radius_m,
                lag_ms: f64::from(info.lag_s) * 1e3,
            }),
            arm: self.telemetry.as_ref().map(|telemetry| Arm {
                t: telemetry.t_us as f64 * 1e-3,
                q: telemetry.q.clone(),
                tip: telemetry.tip_m,
                age_ms: telemetry.age_ms,
                delay_ms: telemetry.delay_ms,
                uncertainty_us: telemetry.clock_uncertainty_us,
                clamps: telemetry.clamps,
                lost: telemetry.newest_seq.saturating_sub(telemetry.received),
            }),
            hand: self.hold.as_ref().and_then(|hold| hold.newest).map(|(t, x)| HandShown {
                t: ms(t),
                p: shown(&x).into(),
            }),
            offset: self.offset.into(),
            path,
            knots,
            sent: Sent {
                bytes: self.sent_bytes,
                messages: session.map_or(0, |session| session.counters().messages),
            },
            seen: self.seen.clone(),
            gain: self.gain,
            strokes: self.strokes.iter().map(Demonstration::duration_s).collect(),
            learning: self.learning,
            skills: self.known.iter().map(|known| known.skill.name().to_owned()).collect(),
            using: self.using.clone(),
            shape: self.shape,
            refused: self.refused,
            notes: self.notes.iter().cloned().collect(),
        }
    }
}
