//! What is learned while driving.

use std::sync::Arc;

use telemime_endpoint::cli::Word;
use telemime_protocol::skill::Skill;
use tokio::sync::mpsc;

use super::Daemon;
use super::said::Notice;
use crate::console::Act;
use crate::lessons::{Lesson, LessonError, Lessons, News};
use crate::session::Session;
use crate::task::Task;

impl Daemon {
    /// What the person at the page wants, and only the daemon can do.
    pub(super) fn act(
        &self,
        act: Act,
        session: &mut Session,
        task: &mut Task,
        lessons: &mut Lessons,
        notices: &mpsc::UnboundedSender<Notice>,
    ) {
        match act {
            Act::Stop => session.stop(self.now()),
            Act::Shape(shape) => drop(notices.send(Notice::LinkAsked(shape))),
            // What is being learned on the terminal's word is of the skill in use, and would take its place again.
            Act::Use(_) if lessons.is_busy() => {
                let used = lessons.skill().map(|skill| skill.name().to_owned());
                if let Some(live) = task.person() {
                    live.on_not_used(used);
                }
            }
            Act::Use(skill) => {
                lessons.adopt(Arc::clone(&skill));
                session.replace_skill(skill);
            }
            Act::Learn {
                name,
                strokes,
                others,
            } => {
                if let Err((strokes, why)) = lessons.teach(name, strokes, others)
                    && let Some(live) = task.person()
                {
                    live.on_no_lesson(strokes, &why);
                }
            }
        }
    }

    /// What the person at the terminal says of learning.
    pub(super) fn lesson(
        &self,
        word: &Word,
        session: &Session,
        lessons: &mut Lessons,
        notices: &mpsc::UnboundedSender<Notice>,
    ) -> Result<(), LessonError> {
        match word {
            Word::Keep => {
                let _ = notices.send(Notice::Kept(lessons.keep(session.driven())?));
            }
            Word::Refine => lessons.refine()?,
            Word::Save(file) => {
                lessons.save(file)?;
            }
            Word::Stop | Word::Reset | Word::Engage | Word::Release => {}
            Word::BlackBox | Word::Pair(_) | Word::Yes | Word::No => {}
        }
        Ok(())
    }

    /// Tells what was learned or written, and returns the skill if it is a new one.
    pub(super) fn news(
        &self,
        news: News,
        lessons: &mut Lessons,
        task: &mut Task,
        notices: &mpsc::UnboundedSender<Notice>,
    ) -> Option<Arc<Skill>> {
        match news {
            News::Learned(lesson) => self.learned(*lesson, lessons, task, notices),
            News::Saved(Ok(file)) => {
                let _ = notices.send(Notice::Saved(file));
                None
            }
            News::Saved(Err(e)) => {
                let _ = notices.send(Notice::Note(e.to_string().into()));
                None
            }
        }
    }

    /// Tells what was learned, has it saved if that is wanted, and returns the skill if it is a new one.
    fn learned(
        &self,
        lesson: Result<Lesson, LessonError>,
        lessons: &mut Lessons,
        task: &mut Task,
        notices: &mpsc::UnboundedSender<Notice>,
    ) -> Option<Arc<Skill>> {
        if let Some(live) = task.person() {
            live.on_lesson(&lesson);
        }
        let note = |text: String| drop(notices.send(Notice::Note(text.into())));
        let lesson = match lesson {
            Ok(lesson) => lesson,
            Err(e) => {
                note(e.to_string());
                return None;
            }
        };
        for (name, why) in &lesson.left_out {
            note(format!("{name} is not learned from: {why}"));
        }
        for what in lesson.learned.iter().filter(|what| what.is_unlike()) {
            note(format!(
                "{} is unlike what the skill has seen: {:.0} % of it is new",
                what.name,
                what.novel * 1e2
            ));
        }
        let skill = lesson.skill?;
        let learned = lesson.learned.into_iter().map(|w| (w.name, w.novel));
        let _ = notices.send(Notice::Refined {
            skill: Arc::clone(&skill),
            learned: learned.collect(),
        });
        if let Some(folder) = self.learning.save.as_deref()
            && let Err(e) = lessons.save_in(folder)
        {
            note(e.to_string());
        }
        Some(skill)
    }
}
