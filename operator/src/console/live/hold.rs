//! The clutch: pressed, asked for, moved, let go.

use std::sync::Arc;

use nalgebra::Vector3;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::{Refusal, RobotState};

use super::{Known, Live};
use crate::clutch::{Clutch, Phase};
use crate::console::Holding;
use crate::dating::Dating;
use crate::demonstration::{Demonstration, Sample};
use crate::lessons::{Lesson, LessonError};
use crate::session::{HandSample, Session};

/// A sample is never dated back by more than this, s.
const OLDEST_S: f64 = 0.1;

/// Strokes that are kept.
const MOST_STROKES: usize = 50;

/// Longest stroke, samples: two minutes at 125 a second.
const LONGEST_STROKE: usize = 15_000;

#[derive(Debug)]
pub(super) struct Hold {
    pub(super) page: u64,
    pub(super) what: Holding,
    pub(super) clutch: Clutch,
    pub(super) heard: Stamp,
    dating: Dating,
    pub(super) newest: Option<(Stamp, Vector3<f64>)>,
}

impl Live {
    pub(super) fn press(
        &mut self,
        now: Stamp,
        page: u64,
        (what, skill): (Holding, Option<String>),
        (t, x): (f64, [f64; 3]),
        session: &mut Session,
    ) -> Result<(), String> {
        match &self.hold {
            Some(hold) if hold.page != page => return Err("another page holds the clutch".into()),
            Some(_) => self.let_go(Some(session)),
            None => {}
        }
        if what == Holding::Play && !session.is_ready() {
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
            clutch: Clutch::pressed(),
            heard: now,
            dating: Dating::new(OLDEST_S),
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
                    known
                        .plan
                        .as_ref()
                        .ok_or_else(|| format!("{name} cannot be played"))
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

    pub(super) fn phase(&mut self, phase: Phase) {
        if let Some(hold) = &mut self.hold {
            hold.clutch.phase = phase;
        }
    }

    pub(super) fn ask(&mut self, now: Stamp, session: &mut Session) {
        if let Some(hold) = &mut self.hold {
            hold.clutch.ask(now, session);
        }
    }

    pub(super) fn moved(
        &mut self,
        now: Stamp,
        t_ms: f64,
        x: [f64; 3],
        session: Option<&mut Session>,
    ) {
        let Some(hold) = &mut self.hold else {
            return;
        };
        hold.heard = now;
        let t = hold.dating.dated(now, t_ms * 1e-3);
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
    pub(super) fn let_go(&mut self, session: Option<&mut Session>) {
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

    pub(super) fn stroke(&mut self) {
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
                self.note(format!(
                    "{MOST_STROKES} strokes are enough: learn, or discard some"
                ));
            }
            Ok(stroke) => self.strokes.push(stroke),
            Err(e) => self.note(format!("not taken: {e}")),
        }
    }

    /// The session has let go already.
    pub(super) fn drop_hold(&mut self) {
        self.let_go(None);
    }

    pub(super) fn declined(&mut self, now: Stamp, reason: Refusal) {
        let asked = |hold: &&mut Hold| hold.what == Holding::Hand;
        let hold = self.hold.as_mut().filter(asked);
        match hold.map(|hold| hold.clutch.declined(now, reason)) {
            Some(true) => {}
            _ if reason == Refusal::Diverged => {}
            _ => {
                self.drop_hold();
                self.note(format!("the robot declines: {reason:?}"));
            }
        }
    }

    /// What was learned.
    pub fn on_lesson(&mut self, lesson: &Result<Lesson, LessonError>) {
        self.learning = false;
        let skill = match lesson {
            Ok(Lesson {
                skill: Some(skill), ..
            }) => skill,
            Ok(lesson) => {
                let why = lesson.left_out.first().map_or("", |(_, why)| why.as_str());
                return self.note(format!("not learned: {why}"));
            }
            Err(e) => return self.note(e.to_string()),
        };
        let taught = lesson
            .as_ref()
            .ok()
            .and_then(|lesson| lesson.taught.as_ref());
        let before = self
            .known
            .iter()
            .position(|known| known.skill.name() == skill.name());
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

    /// The skill that was chosen is not used, but the one that was.
    pub fn on_not_used(&mut self, used: Option<String>) {
        self.using = used;
        self.note("a skill is being learned");
    }

    /// All strokes that a lesson could not even begin with are back.
    pub fn on_no_lesson(&mut self, strokes: Vec<Demonstration>, why: &LessonError) {
        self.learning = false;
        self.strokes = strokes;
        self.note(why.to_string());
    }
}
