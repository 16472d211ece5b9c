//! The skills an operator has, learned now or loaded, and what to do with them.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, bail};
use telemime_protocol::skill::{MAX_COMPONENTS, MAX_NAME_BYTES, Skill};

use super::Args;
use super::report::{Event, Log};
use crate::demonstration::{Demonstration, Demonstrations};
use crate::learn::align::{Aligned, align};
use crate::learn::frames::{GOAL, START};
use crate::learn::{LearnOptions, Progress, learn_skill};
use crate::recognise::{RecogniseOptions, Recogniser};
use crate::skill_file;

/// Components of one mixture per skill when several share it (prediction.md §1).
const SHARED_COMPONENTS: usize = 7;

/// Skills by name, and the one mixture that mirrors them all.
#[derive(Debug)]
pub struct Skills {
    all: Vec<Arc<Skill>>,
    /// What was learned just now was learned from these, by name.
    aligned: Vec<(String, Aligned)>,
    mirror: Option<Arc<Skill>>,
}

impl Skills {
    pub(super) fn gather(args: &Args, log: &Log) -> anyhow::Result<Self> {
        let mut skills = Self {
            all: Vec::new(),
            aligned: Vec::new(),
            mirror: None,
        };
        let mut pooled: Vec<Demonstration> = Vec::new();
        let options = LearnOptions {
            seed: args.seed.unwrap_or(0),
            frames: frames_asked(args),
            ..LearnOptions::default()
        };
        for dir in &args.learn {
            let found = Demonstrations::read_dir(dir, args.matching.as_deref())?;
            found.notices.iter().for_each(|notice| log.note(notice));
            let kept = keep_unseen(found.demonstrations, &args.replay, log)?;
            if kept.is_empty() {
                bail!(
                    "{}: nothing is left to learn from without the replayed recording",
                    dir.display()
                );
            }
            let skill = learn(&found.name, &kept, &options, log)?;
            if let Some(folder) = &args.save {
                std::fs::create_dir_all(folder)
                    .with_context(|| format!("cannot make {}", folder.display()))?;
                skill_file::save(&skill, folder.join(format!("{}.skill", skill.name())))?;
            }
            skills
                .aligned
                .push((skill.name().to_owned(), align(&kept)?));
            skills.push(Arc::new(skill))?;
            pooled.extend(kept);
        }
        for path in &args.skill {
            skills.push(Arc::new(skill_file::load(path)?))?;
        }
        skills.mirror = skills.all.first().cloned();
        if args.learn.len() > 1 && args.play.is_none() {
            let mut shared = options;
            shared.predictor.components =
                (SHARED_COMPONENTS * args.learn.len()).min(MAX_COMPONENTS);
            // Only its predictor is used: one time axis for different motions means nothing.
            shared.motion_components = 1..=1;
            shared.frames.clear();
            let name: Vec<_> = skills
                .all
                .iter()
                .take(args.learn.len())
                .map(|s| s.name())
                .collect();
            let mut name = name.join("+");
            while name.len() > MAX_NAME_BYTES {
                name.pop();
            }
            skills.mirror = Some(Arc::new(learn(&name, &pooled, &shared, log)?));
        } else if skills.all.len() > 1 && args.play.is_none() {
            log.note(&format!(
                "mirroring with {} alone: saved skills cannot be pooled; give their folders with --learn",
                skills.all[0].name()
            ));
        }
        Ok(skills)
    }

    fn push(&mut self, skill: Arc<Skill>) -> anyhow::Result<()> {
        if self.all.iter().any(|s| s.name() == skill.name()) {
            bail!("two skills are called {}: rename a folder", skill.name());
        }
        self.all.push(skill);
        Ok(())
    }

    /// All of them.
    pub fn all(&self) -> &[Arc<Skill>] {
        &self.all
    }

    /// The model to mirror with, if there is any.
    pub fn mirror(&self) -> Option<Arc<Skill>> {
        self.mirror.clone()
    }

    /// What tells the skills apart, for display; `None` where there is nothing to tell.
    pub(super) fn recogniser(&self, log: &Log) -> Option<Recogniser> {
        if self.all.is_empty() {
            return None;
        }
        let skills = self.all.iter().map(AsRef::as_ref);
        match Recogniser::new(skills, RecogniseOptions::default()) {
            Ok(recogniser) => Some(recogniser),
            Err(e) => {
                log.note(&format!("skills are not recognised: {e}"));
                None
            }
        }
    }

    /// The demonstrations a skill was learned from just now, on one time axis.
    pub(super) fn aligned(&self, name: &str) -> Option<Aligned> {
        let found = self.aligned.iter().find(|(known, _)| known == name);
        found.map(|(_, aligned)| aligned.clone())
    }

    /// The skill of this name.
    ///
    /// # Errors
    /// One line that lists the names there are.
    pub fn named(&self, name: &str) -> anyhow::Result<Arc<Skill>> {
        let found = self.all.iter().find(|s| s.name() == name).cloned();
        found.with_context(|| {
            let known: Vec<_> = self.all.iter().map(|s| s.name()).collect();
            if known.is_empty() {
                "no skill is known: give --learn DIR or --skill FILE".to_owned()
            } else {
                format!("no skill `{name}`; known: {}", known.join(", "))
            }
        })
    }

    /// Reads the recording to be replayed, and refuses one a loaded skill was trained on.
    ///
    /// # Errors
    /// One line that names the file.
    pub fn unseen(&self, path: &Path) -> anyhow::Result<Demonstration> {
        let recording = Demonstration::read_csv(path)?;
        if let Some(skill) = self
            .all
            .iter()
            .find(|s| s.was_trained_on(recording.sha256()))
        {
            bail!(
                "{}: the skill {} was trained on this very recording; replay another one",
                path.display(),
                skill.name()
            );
        }
        Ok(recording)
    }
}

/// What is to be placed must be learned: both ends, and every object that is named.
fn frames_asked(args: &Args) -> Vec<String> {
    if args.frame.is_empty() {
        return Vec::new();
    }
    let mut frames = vec![START.to_owned(), GOAL.to_owned()];
    for placed in &args.frame {
        if !frames.contains(&placed.name) {
            frames.push(placed.name.clone());
        }
    }
    frames
}

/// Leaves out the recordings that will be replayed, by path and by content.
fn keep_unseen(
    all: Vec<Demonstration>,
    replay: &[PathBuf],
    log: &Log,
) -> anyhow::Result<Vec<Demonstration>> {
    let replayed = replay.iter().map(Demonstration::read_csv);
    let replayed = replayed.collect::<Result<Vec<_>, _>>()?;
    let place = |p: &Path| std::fs::canonicalize(p).unwrap_or_else(|_| p.to_owned());
    let (same, kept): (Vec<_>, Vec<_>) = all.into_iter().partition(|d| {
        let is = |r: &Demonstration| d.sha256() == r.sha256() || place(d.path()) == place(r.path());
        replayed.iter().any(is)
    });
    for demonstration in same {
        log.note(&format!(
            "{} is replayed: it is not learned from",
            demonstration.path().display()
        ));
    }
    Ok(kept)
}

fn learn(
    name: &str,
    demonstrations: &[Demonstration],
    options: &LearnOptions,
    log: &Log,
) -> anyhow::Result<Skill> {
    let skill = learn_skill(name, demonstrations, options, |progress| {
        if let Progress::Motion { degenerate, .. } = &progress {
            degenerate.iter().for_each(|d| {
                log.note(&format!(
                    "{name}: the motion's mixture over (t, x, y, z): {d}"
                ))
            });
        }
    })
    .with_context(|| format!("cannot learn {name}"))?;
    log.say(&Event::Learned {
        skill: skill.name().to_owned(),
        demonstrations: demonstrations.len(),
        motion_components: skill.motion().components().len(),
        predictor_components: skill.predictor().components().len(),
        bytes: skill.to_bytes().len(),
        speed95_m_s: skill.stats().speed95_m_s,
        reach_m: skill.stats().reach_m,
    });
    Ok(skill)
}
