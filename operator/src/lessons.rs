//! What is learned while driving: performances that were kept, and the skill refined by them.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use telemime_protocol::checkpoint::PosePlan;
use telemime_protocol::skill::Skill;
use tokio::task::{JoinHandle, JoinSet};

use crate::cli::{Bounds, infer};
use crate::demonstration::{Demonstration, DemonstrationError, Sample};
use crate::learn::{LearnError, LearnOptions, Refinement, learn_skill, refine};
use crate::recognise::{RecogniseOptions, Recogniser};
use crate::session::HandSample;
use crate::skill_file::{self, SkillFileError};

/// Why nothing was learned.
#[derive(Debug, thiserror::Error)]
pub enum LessonError {
    /// Without a skill.
    #[error("there is no skill to refine: start with --learn DIR or --skill FILE")]
    NoSkill,
    /// Without an engagement.
    #[error("nothing was driven yet: keep takes the engagement that ended last")]
    NothingDriven,
    /// The same engagement.
    #[error("this engagement is kept already")]
    KeptAlready,
    /// Without a performance.
    #[error("no performance is kept: say keep after one that is to be learned from")]
    NothingKept,
    /// While refining.
    #[error("the skill is being refined: say it again in a moment")]
    Busy,
    /// The performance is no demonstration.
    #[error("the engagement is no demonstration: {0}")]
    Demonstration(#[from] DemonstrationError),
    /// It cannot be learned.
    #[error("not learned: {0}")]
    Learn(#[from] LearnError),
    /// The skill cannot be written.
    #[error(transparent)]
    Save(#[from] SkillFileError),
    /// Its name is none for a file.
    #[error(
        "the skill is called {0:?}, which is no name for a file: save it by a path of your own"
    )]
    Name(String),
    /// The thread died.
    #[error("refining ended early; the skill is as it was")]
    Died,
}

/// What refining came to.
#[derive(Debug)]
pub struct Lesson {
    /// The skill as it is now; `None` if nothing could be learned.
    pub skill: Option<Arc<Skill>>,
    /// What each performance was to it.
    pub learned: Vec<Refinement>,
    /// Those left out, with the reason.
    pub left_out: Vec<(String, String)>,
    /// Of a skill that was learned anew: what else goes with it.
    pub taught: Option<Taught>,
}

/// What goes with a skill that was learned anew.
#[derive(Debug)]
pub struct Taught {
    /// Its motion; `None` if it has none to play.
    pub plan: Option<PosePlan>,
    /// What tells it from the others; `None` if nothing does.
    pub recogniser: Option<Recogniser>,
}

/// Performances kept in this run, and the skill that learns from them, on a thread of its own.
#[derive(Debug, Default)]
pub struct Lessons {
    skill: Option<Arc<Skill>>,
    kept: Vec<Demonstration>,
    hashes: Vec<[u8; 32]>,
    work: Option<JoinHandle<Lesson>>,
    writing: JoinSet<Result<PathBuf, SkillFileError>>,
}

/// What has come of work on another thread.
#[derive(Debug)]
pub enum News {
    /// Of learning.
    Learned(Box<Result<Lesson, LessonError>>),
    /// Of writing: the file.
    Saved(Result<PathBuf, LessonError>),
}

impl Lessons {
    /// Begins with `skill`.
    pub fn new(skill: Option<Arc<Skill>>) -> Self {
        Self {
            skill,
            ..Self::default()
        }
    }

    /// The skill, refined by all that was learned so far.
    pub fn skill(&self) -> Option<Arc<Skill>> {
        self.skill.clone()
    }

    /// Takes what was driven as a demonstration; returns its name.
    ///
    /// # Errors
    /// [`LessonError`]: nothing was driven, it is kept already, or it is no demonstration.
    pub fn keep(&mut self, driven: &[HandSample]) -> Result<String, LessonError> {
        let skill = self.skill.as_ref().ok_or(LessonError::NoSkill)?;
        let first = driven.first().ok_or(LessonError::NothingDriven)?;
        let samples: Vec<_> = driven
            .iter()
            .map(|sample| Sample {
                t_s: sample.t.secs_since(first.t),
                position: sample.x,
                orientation: sample.orientation,
                grip: sample.grip,
            })
            .collect();
        let name = format!("{} driven {}", skill.name(), self.hashes.len() + 1);
        let demonstration = Demonstration::from_samples(&name, &samples)?;
        if self.hashes.contains(demonstration.sha256()) {
            return Err(LessonError::KeptAlready);
        }
        self.hashes.push(*demonstration.sha256());
        self.kept.push(demonstration);
        Ok(name)
    }

    /// Begins to refine the skill with what was kept.
    ///
    /// # Errors
    /// [`LessonError`]: there is no skill, nothing was kept, or it is being refined already.
    pub fn refine(&mut self) -> Result<(), LessonError> {
        let skill = self.skill.clone().ok_or(LessonError::NoSkill)?;
        if self.is_busy() {
            return Err(LessonError::Busy);
        }
        if self.kept.is_empty() {
            return Err(LessonError::NothingKept);
        }
        let kept = std::mem::take(&mut self.kept);
        self.work = Some(tokio::task::spawn_blocking(move || {
            learn_from(&skill, &kept)
        }));
        Ok(())
    }

    /// Begins to learn a skill of this name from `strokes`; `others` are those it is to be told from.
    ///
    /// # Errors
    /// [`LessonError::Busy`], with the strokes.
    pub fn teach(
        &mut self,
        name: String,
        strokes: Vec<Demonstration>,
        others: Vec<Arc<Skill>>,
    ) -> Result<(), (Vec<Demonstration>, LessonError)> {
        if self.is_busy() {
            return Err((strokes, LessonError::Busy));
        }
        let work = move || taught(&name, &strokes, &others);
        self.work = Some(tokio::task::spawn_blocking(work));
        Ok(())
    }

    /// Goes on with `skill`; nothing happens while another is being learned.
    pub fn adopt(&mut self, skill: Arc<Skill>) {
        if !self.is_busy() {
            self.skill = Some(skill);
            self.kept.clear();
        }
    }

    /// Whether the skill is being refined.
    pub fn is_busy(&self) -> bool {
        self.work.is_some()
    }

    /// Whether something is still being learned or written.
    pub fn is_at_work(&self) -> bool {
        self.is_busy() || !self.writing.is_empty()
    }

    /// Waits until something is learned or written; for ever if nothing is under way. May be dropped and called again.
    pub async fn news(&mut self) -> News {
        let learned = async {
            match &mut self.work {
                Some(work) => work.await,
                None => std::future::pending().await,
            }
        };
        let written = async {
            match self.writing.join_next().await {
                Some(done) => done,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            biased;
            done = learned => {
                self.work = None;
                let lesson = done.map_err(|_| LessonError::Died);
                if let Ok(Lesson { skill: Some(skill), .. }) = &lesson {
                    self.skill = Some(Arc::clone(skill));
                }
                News::Learned(Box::new(lesson))
            }
            done = written => {
                let done = done.map_err(|_| LessonError::Died);
                News::Saved(done.and_then(|file| Ok(file?)))
            }
        }
    }

    /// Begins to write the skill to a file: a slow disk holds up nobody.
    ///
    /// # Errors
    /// [`LessonError`]: there is none, or it is being refined.
    pub fn save(&mut self, path: &Path) -> Result<(), LessonError> {
        let skill = self.skill.clone().ok_or(LessonError::NoSkill)?;
        if self.is_busy() {
            return Err(LessonError::Busy);
        }
        let path = path.to_owned();
        self.writing.spawn_blocking(move || {
            skill_file::save(&skill, &path)?;
            Ok(path)
        });
        Ok(())
    }

    /// Begins to write the skill to a file of its name in `folder`.
    ///
    /// # Errors
    /// As [`Lessons::save`], and [`LessonError::Name`] if that would not be a file of the folder.
    pub fn save_in(&mut self, folder: &Path) -> Result<(), LessonError> {
        let name = self.skill.as_ref().ok_or(LessonError::NoSkill)?.name();
        if name.starts_with('.') || name.contains(|c: char| "/\\".contains(c) || c.is_control()) {
            return Err(LessonError::Name(name.to_owned()));
        }
        self.save(&folder.join(format!("{name}.skill")))
    }
}

fn learn_from(skill: &Arc<Skill>, kept: &[Demonstration]) -> Lesson {
    let mut newest: Option<Skill> = None;
    let (mut learned, mut left_out) = (Vec::new(), Vec::new());
    for performance in kept {
        let from = newest.as_ref().unwrap_or(skill);
        match refine(from, performance) {
            Ok((refined, what)) => {
                newest = Some(refined);
                learned.push(what);
            }
            Err(e) => left_out.push((performance.name().to_owned(), e.to_string())),
        }
    }
    Lesson {
        skill: newest.map(Arc::new),
        learned,
        left_out,
        taught: None,
    }
}

fn taught(name: &str, strokes: &[Demonstration], others: &[Arc<Skill>]) -> Lesson {
    match learn_skill(name, strokes, &LearnOptions::default(), |_| {}) {
        Ok(skill) => {
            let plan = infer(&skill, Bounds::of(&skill), &[]);
            let all = others.iter().map(AsRef::as_ref).chain([&skill]);
            let recogniser = Recogniser::new(all, RecogniseOptions::default());
            Lesson {
                taught: Some(Taught {
                    plan: plan.ok().map(|(plan, _)| plan),
                    recogniser: recogniser.ok(),
                }),
                skill: Some(Arc::new(skill)),
                learned: Vec::new(),
                left_out: Vec::new(),
            }
        }
        Err(e) => Lesson {
            skill: None,
            learned: Vec::new(),
            left_out: vec![(name.to_owned(), e.to_string())],
            taught: None,
        },
    }
}
