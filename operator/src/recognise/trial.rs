//! What recognition is worth: whole demonstrations held out, whole skills held out, and strangers.
//!
//! In every round each skill is learned from some of its demonstrations and the others are performed
//! before a recogniser of all skills (is it right, does it refuse?) and before one of all skills but
//! their own (does it see that they are unknown?).

mod rounds;
mod score;

use rayon::prelude::*;
use telemime_protocol::skill::Skill;

use super::{RecogniseError, RecogniseOptions, Recogniser, Verdict};
use crate::demonstration::{Demonstration, Demonstrations, PersonPattern};
use crate::learn::align::align;
use crate::learn::predictor::states;
use crate::learn::{LearnError, LearnOptions, learn_skill};

pub use rounds::Split;
pub use score::{Operating, Report, SkillReport};

use rounds::Round;

/// A gesture has begun when the hand is this far from where the recording begins, m.
pub const ONSET_M: f64 = 0.05;

/// How to try recognition.
#[derive(Debug, Clone, PartialEq)]
pub struct TrialOptions {
    /// The recogniser.
    pub recognise: RecogniseOptions,
    /// How the skills are learned.
    pub learn: LearnOptions,
    /// What is held out.
    pub split: Split,
    /// Where file names hold the person.
    pub persons: PersonPattern,
    /// When to ask, s after the onset: what the matrix shows.
    pub at_s: f64,
    /// When else to ask.
    pub also_at_s: Vec<f64>,
}

/// Why recognition cannot be tried.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum TrialError {
    /// Nothing can be confused.
    #[error("{found} skill folders: give two or more")]
    Skills {
        /// How many.
        found: usize,
    },
    /// Two folders have the same name.
    #[error("two skills are called {name}: rename a folder")]
    SameName {
        /// The name.
        name: String,
    },
    /// A skill has too few demonstrations to learn from some and try others.
    #[error("{name}: {found} demonstrations, two at least: one to learn from, one to hold out")]
    Demonstrations {
        /// The skill.
        name: String,
        /// How many.
        found: usize,
    },
    /// Nothing can be held out in this way.
    #[error(
        "{name}: all demonstrations are by one person ({person:?}), as {pattern} finds them in the file names: \
         hold out demonstrations instead, or say with --group-by where the names hold the person"
    )]
    Persons {
        /// The skill.
        name: String,
        /// The person.
        person: String,
        /// Where persons were looked for.
        pattern: String,
    },
    /// No person performs two skills, each at least twice.
    #[error(
        "no person, as {pattern} finds them in the file names, performs two skills twice each: \
         hold out demonstrations instead, or say with --group-by where the names hold the person"
    )]
    NobodysOwn {
        /// Where persons were looked for.
        pattern: String,
    },
    /// A moment to ask is not a time.
    #[error("asked {at_s} s after the onset: 0 s or more is possible")]
    Moment {
        /// The moment, s.
        at_s: f64,
    },
    /// A skill cannot be learned from what is left.
    #[error("{name}: {source}")]
    Learn {
        /// The skill.
        name: String,
        /// Why.
        source: LearnError,
    },
    /// The skills cannot be recognised.
    #[error(transparent)]
    Recognise(#[from] RecogniseError),
}

/// The answer at one moment of an attempt.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Moment {
    /// The best skill, by its index in the trial.
    best: Option<usize>,
    /// Whether a skill was named.
    named: bool,
    /// Whether none could be, for want of a favourite.
    undecided: bool,
    novelty: f64,
}

/// One performance before one recogniser.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Attempt {
    /// The skill performed; `None`: a stranger.
    truth: Option<usize>,
    /// Whether the recogniser knew it.
    known: bool,
    /// The answers, one a moment asked for; `None` once the recording is over.
    moments: Vec<Option<Moment>>,
    /// Samples after the onset in which the hand moved, and those of them taken for a known skill.
    moving: usize,
    named: usize,
    /// Σ|phase − truth| and the samples that went into it.
    phase: (f64, usize),
}

/// The skills' demonstrations, with the phases of their samples.
struct Performances<'a> {
    sets: &'a [Demonstrations],
    phases: Vec<Vec<Vec<f64>>>,
}

/// Tries recognition of `sets`, and refusal of them and of `strangers`. `progress` hears of every round
/// done, from any thread.
///
/// The same arguments give the same report, however many threads there are.
///
/// # Errors
/// [`TrialError`].
pub fn run(
    sets: &[Demonstrations],
    strangers: &[Demonstration],
    options: &TrialOptions,
    progress: impl Fn(usize, usize) + Sync,
) -> Result<Report, TrialError> {
    for (i, set) in sets.iter().enumerate() {
        if sets[..i].iter().any(|other| other.name == set.name) {
            return Err(TrialError::SameName {
                name: set.name.clone(),
            });
        }
    }
    let mut asked_s = vec![options.at_s];
    asked_s.extend(&options.also_at_s);
    if let Some(&at_s) = asked_s.iter().find(|t| !(**t >= 0.0)) {
        return Err(TrialError::Moment { at_s });
    }
    let rounds = rounds::rounds(sets, options.split, &options.persons)?;
    // A wrong option should not be found out after minutes of learning.
    Recogniser::new([], options.recognise)?;
    let phases = sets
        .par_iter()
        .map(true_phases)
        .collect::<Result<Vec<_>, _>>()?;
    let performances = Performances { sets, phases };
    let of = rounds.len();
    let attempts = rounds
        .par_iter()
        .map(|round| {
            let attempts = performances.play(round, strangers, &asked_s, options);
            progress(1, of);
            attempts
        })
        .collect::<Result<Vec<_>, _>>()?;
    let attempts: Vec<Attempt> = attempts.into_iter().flatten().collect();
    Ok(score::report(
        sets,
        strangers.len(),
        &asked_s,
        of,
        &attempts,
    ))
}

impl Performances<'_> {
    fn play(
        &self,
        round: &Round,
        strangers: &[Demonstration],
        asked_s: &[f64],
        options: &TrialOptions,
    ) -> Result<Vec<Attempt>, TrialError> {
        let mut taught: Vec<(usize, Skill)> = Vec::new();
        for (skill, train) in &round.train {
            let set = &self.sets[*skill];
            let some: Vec<_> = train
                .iter()
                .map(|&d| set.demonstrations[d].clone())
                .collect();
            let learned = learn_skill(&set.name, &some, &options.learn, |_| ());
            let learned = learned.map_err(|source| TrialError::Learn {
                name: set.name.clone(),
                source,
            })?;
            taught.push((*skill, learned));
        }
        let without = |left_out: Option<usize>| -> Result<_, RecogniseError> {
            let there = || taught.iter().filter(|(i, _)| Some(*i) != left_out);
            Ok(Audience {
                recogniser: Recogniser::new(there().map(|(_, s)| s), options.recognise)?,
                skills: there().map(|(i, _)| *i).collect(),
            })
        };
        let mut all = without(None)?;
        let mut attempts = Vec::new();
        for (skill, test) in &round.test {
            let mut others = without(Some(*skill))?;
            for &d in test {
                let demonstration = &self.sets[*skill].demonstrations[d];
                for audience in [&mut all, &mut others] {
                    attempts.push(audience.watch(
                        demonstration,
                        Some((*skill, &self.phases[*skill][d])),
                        asked_s,
                    ));
                }
            }
        }
        for stranger in strangers {
            attempts.push(all.watch(stranger, None, asked_s));
        }
        Ok(attempts)
    }
}

/// A recogniser, and which skills of the trial its own are.
struct Audience {
    recogniser: Recogniser,
    skills: Vec<usize>,
}

impl Audience {
    fn watch(
        &mut self,
        d: &Demonstration,
        truth: Option<(usize, &Vec<f64>)>,
        asked_s: &[f64],
    ) -> Attempt {
        let samples = d.samples();
        let skill = truth.map(|(skill, _)| skill);
        let known = skill.is_some_and(|s| self.skills.contains(&s));
        let mut attempt = Attempt {
            truth: skill,
            known,
            moments: vec![None; asked_s.len()],
            moving: 0,
            named: 0,
            phase: (0.0, 0),
        };
        let away = |i: usize, from: usize| (samples[i].position - samples[from].position).norm();
        let last = samples.len() - 1;
        let Some(onset) = (0..=last).find(|&i| away(i, 0) > ONSET_M) else {
            return attempt;
        };
        let end = (0..=last)
            .rfind(|&i| away(i, last) > ONSET_M)
            .unwrap_or(last);
        self.recogniser.reset();
        for (i, state) in states(d).enumerate() {
            let Some(r) = self.recogniser.take(&state) else {
                continue;
            };
            if i < onset {
                continue;
            }
            let best = r.best.map(|b| self.skills[b]);
            let named = matches!(r.verdict, Verdict::Skill(_));
            let since_s = samples[i].t_s - samples[onset].t_s;
            for (moment, at_s) in attempt.moments.iter_mut().zip(asked_s) {
                // Rounding of the recording's times must not cost a frame.
                if moment.is_none() && since_s >= at_s - 1e-6 {
                    *moment = Some(Moment {
                        best,
                        named,
                        undecided: r.verdict == Verdict::Undecided,
                        novelty: r.novelty,
                    });
                }
            }
            if r.verdict != Verdict::Resting {
                attempt.moving += 1;
                attempt.named += usize::from(named);
            }
            if let Some((skill, phases)) = truth
                && best == Some(skill)
                && i <= end
            {
                attempt.phase.0 += (r.phase - phases[i]).abs();
                attempt.phase.1 += 1;
            }
        }
        attempt
    }
}

/// The phase of every sample of every demonstration, in [0, 1], as alignment of all of them has it.
fn true_phases(set: &Demonstrations) -> Result<Vec<Vec<f64>>, TrialError> {
    let aligned = align(&set.demonstrations).map_err(|source| TrialError::Learn {
        name: set.name.clone(),
        source,
    })?;
    let last = (aligned.times_s.len() - 1) as f64;
    let phases = |(d, warp_s): (&Demonstration, &Vec<f64>)| {
        let start_s = d.samples()[0].t_s;
        d.samples()
            .iter()
            .map(|s| {
                let t_s = s.t_s - start_s;
                let after = warp_s.partition_point(|w| *w <= t_s);
                match (after, warp_s.get(after)) {
                    (0, _) => 0.0,
                    (_, None) => 1.0,
                    (_, Some(b)) => {
                        let a = warp_s[after - 1];
                        ((after - 1) as f64 + (t_s - a) / (b - a)) / last
                    }
                }
            })
            .collect()
    };
    let each = set.demonstrations.iter().zip(&aligned.warps_s);
    Ok(each.map(phases).collect())
}
