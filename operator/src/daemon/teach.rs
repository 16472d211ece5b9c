//! What is learned while driving.

use std::sync::Arc;

use telemime_endpoint::cli::Word;
use telemime_protocol::skill::Skill;
use tokio::sync::mpsc;

use super::Daemon;
use super::said::Notice;
use crate::console::Act;
use crate::lessons::{Lesson, LessonError, Lessons};
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
                let _ = notices.send(Notice::Saved(file.clone()));
            }
            Word::Stop | Word::Reset | Word::Engage | Word::Release => {}
            Word::BlackBox | Word::Pair(_) | Word::Yes | Word::No => {}
        }
        Ok(())
    }

    /// Tells what was learned, saves it if that is wanted, and returns the skill if it is a new one.
    pub(super) fn learned(
        &self,
        lesson: Result<Lesson, LessonError>,
        lessons: &Lessons,
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
        let folder = self.learning.save.as_deref();
        if let Some(file) = folder.and_then(|folder| lessons.file_in(folder)) {
            match lessons.save(&file) {
                Ok(()) => drop(notices.send(Notice::Saved(file))),
                Err(e) => note(e.to_string()),
            }
        }
        Some(skill)
    }
}
