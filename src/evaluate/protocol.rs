//! Who is learned from and who is predicted, round by round.

use std::sync::Arc;

use clap::ValueEnum;
use nalgebra::Vector3;
use rayon::prelude::*;
use telemime_operator::demonstration::{Demonstration, Demonstrations, PersonPattern};
use telemime_operator::learn::{LearnError, LearnOptions, learn_skill};
use telemime_operator::session::SessionConfig;
use telemime_protocol::skill::{MAX_SOURCES, Skill};
use telemime_sim::link::LinkConfig;

use super::arm::{self, ArmError, Drive, Driven};
use super::dual::{self, Outcome, Scheme};
use super::experts::{Side, experts};
use super::faults::{self, Bin, Faults, Shape};
use super::kalman::Kalman;
use super::report::nearest;
use super::score::{Course, Tally, perform, tally};

/// Where a change of mind is looked at, s ahead.
pub(super) const MIND_AT_S: f64 = 0.1;

/// What is held out of learning.
#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Protocol {
    /// One performance; learned from are others of the same person.
    SamePerson,
    /// One performance; learned from are all others, whoever performs.
    LeaveOneOut,
    /// All that a person does; learned from are the others.
    Cross,
}

impl Protocol {
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::SamePerson => "same-person",
            Self::LeaveOneOut => "leave-one-out",
            Self::Cross => "cross",
        }
    }

    /// Demonstrations learned from unless told otherwise: what an operator may be asked for, or all.
    pub(super) fn usual(self) -> usize {
        match self {
            Self::SamePerson => 3,
            Self::LeaveOneOut | Self::Cross => MAX_SOURCES,
        }
    }
}

/// Why recordings cannot be evaluated.
#[derive(Debug, thiserror::Error)]
pub(super) enum EvaluateError {
    #[error(
        "{0}: nothing can be held out: one recording. Record the skill again: two are enough to try, three or more to trust"
    )]
    One(String),
    #[error(
        "{name}: {found} recordings, but nobody performed twice, as {pattern} finds persons in the file names: \
         try --protocol leave-one-out, or say with --group-by where the names hold the person"
    )]
    Once {
        name: String,
        found: usize,
        pattern: String,
    },
    #[error(
        "{name}: all recordings are by one person ({person:?}), as {pattern} finds persons in the file names: \
         use --protocol same-person, or say with --group-by where the names hold the person"
    )]
    OnePerson {
        name: String,
        person: String,
        pattern: String,
    },
    #[error("{name}, learned for {held}: {source}")]
    Learn {
        name: String,
        held: String,
        source: LearnError,
    },
    #[error(transparent)]
    Arm(#[from] ArmError),
}

/// One skill to learn and what it then predicts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Round {
    /// The folder.
    pub(super) set: usize,
    /// Of it: what is learned from, never empty.
    learn: Vec<usize>,
    /// Of it: what is predicted.
    test: Vec<usize>,
    /// (off-model folder, recording): what else is predicted.
    off: Vec<(usize, usize)>,
}

/// Everything there is to try.
pub(super) struct Plan<'a> {
    pub(super) sets: &'a [Demonstrations],
    pub(super) off_model: &'a [Demonstrations],
    pub(super) protocol: Protocol,
    pub(super) persons: &'a PersonPattern,
    /// Most demonstrations a skill is learned from.
    pub(super) most: usize,
    pub(super) horizons_s: &'a [f64],
    /// What sessions are set to, but for their bounds and silences.
    pub(super) session: &'a SessionConfig,
    pub(super) schemes: &'a [Scheme],
    pub(super) link: &'a LinkConfig,
    /// The arm to drive, too.
    pub(super) arm: Option<&'a Drive>,
    pub(super) seed: u64,
    /// From 1 on, which of the link's chances.
    pub(super) link_seed: u64,
}

/// One moment of the guarded predictor, at the horizon nearest to 100 ms.
pub(super) struct Seen {
    /// When what was predicted came, s.
    pub(super) t_s: f64,
    /// Predicted from here.
    pub(super) from: Vector3<f64>,
    pub(super) predicted: Vector3<f64>,
    pub(super) truth: Vector3<f64>,
}

/// One recording, predicted by a skill that was learned without it.
pub(super) struct Performance {
    /// The folder learned from.
    pub(super) set: usize,
    /// The off-model folder performed, if it is not the same.
    pub(super) off: Option<usize>,
    pub(super) name: String,
    /// [expert][horizon].
    pub(super) places: Vec<Vec<Tally>>,
    /// The same of orientations, where there are any.
    pub(super) turns: Option<Vec<Vec<Tally>>>,
    /// Of the mixture, moment by moment, in multiples of the calibrated 90 % quantile.
    pub(super) novelty: Vec<f64>,
    /// None off the model.
    pub(super) seen: Vec<Seen>,
    /// Of positions, [expert][horizon]; none off the model.
    pub(super) faults: Vec<Vec<Faults>>,
    /// Of each expert, around a change of mind; none off the model, or where the recording is too short for one.
    pub(super) mind: Vec<Vec<Bin>>,
    /// One a scheme; none off the model.
    pub(super) dual: Vec<Outcome>,
    /// What the arm did; none off the model.
    pub(super) driven: Option<Driven>,
}

impl Plan<'_> {
    /// The rounds on the model, then those off it.
    pub(super) fn rounds(&self) -> Result<Vec<Round>, EvaluateError> {
        let mut all = Vec::new();
        for (set, recordings) in self.sets.iter().enumerate() {
            let here = self.rounds_of(set);
            if here.is_empty() {
                let name = recordings.name.clone();
                let found = recordings.demonstrations.len();
                let pattern = self.persons.to_string();
                return Err(match self.protocol {
                    _ if found == 1 => EvaluateError::One(name),
                    Protocol::Cross => EvaluateError::OnePerson {
                        person: self
                            .persons
                            .person(&recordings.demonstrations[0])
                            .to_owned(),
                        name,
                        pattern,
                    },
                    _ => EvaluateError::Once {
                        name,
                        found,
                        pattern,
                    },
                });
            }
            all.extend(here);
        }
        for set in 0..self.sets.len() {
            all.extend(self.off_rounds(set));
        }
        Ok(all)
    }

    /// (person, recordings), in order of first appearance.
    fn groups(&self, set: usize) -> Vec<(&str, Vec<usize>)> {
        let mut groups: Vec<(&str, Vec<usize>)> = Vec::new();
        for (n, d) in self.sets[set].demonstrations.iter().enumerate() {
            let who = self.persons.person(d);
            match groups.iter_mut().find(|(w, _)| *w == who) {
                Some((_, of)) => of.push(n),
                None => groups.push((who, vec![n])),
            }
        }
        groups
    }

    fn rounds_of(&self, set: usize) -> Vec<Round> {
        let recordings = &self.sets[set].demonstrations;
        let all: Vec<usize> = (0..recordings.len()).collect();
        let round = |test: Vec<usize>, from: &[usize]| {
            // Nor a copy of what it is tried on.
            let tried = |n: usize| {
                let hash = recordings[n].sha256();
                test.iter().any(|t| recordings[*t].sha256() == hash)
            };
            let others = from.iter().filter(|n| !tried(**n));
            let learn: Vec<usize> = others.take(self.most).copied().collect();
            (!learn.is_empty()).then_some(Round {
                set,
                learn,
                test,
                off: Vec::new(),
            })
        };
        let groups = self.groups(set);
        let rounds: Vec<_> = match self.protocol {
            Protocol::SamePerson => groups
                .iter()
                .flat_map(|(_, of)| of.iter().map(|n| round(vec![*n], of)))
                .collect(),
            Protocol::LeaveOneOut => all.iter().map(|n| round(vec![*n], &all)).collect(),
            Protocol::Cross => groups.into_iter().map(|(_, of)| round(of, &all)).collect(),
        };
        rounds.into_iter().flatten().collect()
    }

    /// A skill of each person (of all together, unless persons are told apart) before what it has never seen:
    /// that person's off-model recordings, or everybody's if there are none.
    fn off_rounds(&self, set: usize) -> Vec<Round> {
        let groups = match self.protocol {
            Protocol::SamePerson => self.groups(set),
            Protocol::LeaveOneOut | Protocol::Cross => {
                vec![("", (0..self.sets[set].demonstrations.len()).collect())]
            }
        };
        let known: Vec<_> = self.sets[set]
            .demonstrations
            .iter()
            .map(|d| d.sha256())
            .collect();
        let strange: Vec<(usize, usize)> = (0..self.off_model.len())
            .flat_map(|dir| (0..self.off_model[dir].demonstrations.len()).map(move |n| (dir, n)))
            // A folder may be given as both, so that each of several is off the others' model.
            .filter(|(dir, n)| !known.contains(&self.off_model[*dir].demonstrations[*n].sha256()))
            .collect();
        let round = |(who, of): (&str, Vec<usize>)| {
            let by = |at: &&(usize, usize)| {
                self.persons
                    .person(&self.off_model[at.0].demonstrations[at.1])
                    == who
            };
            let own: Vec<_> = strange.iter().filter(by).copied().collect();
            Round {
                set,
                learn: of.into_iter().take(self.most).collect(),
                test: Vec::new(),
                off: if own.is_empty() { strange.clone() } else { own },
            }
        };
        let rounds = groups.into_iter().map(round);
        rounds.filter(|round| !round.off.is_empty()).collect()
    }

    /// Runs the rounds on all cores; the result does not depend on how many there are. `progress` hears of every
    /// round done, from any thread.
    pub(super) fn run(
        &self,
        rounds: &[Round],
        progress: impl Fn() + Sync,
    ) -> Result<Vec<Performance>, EvaluateError> {
        let done = rounds
            .par_iter()
            .map(|round| {
                let performances = self.play(round);
                progress();
                performances
            })
            .collect::<Result<Vec<_>, _>>()?;
        Ok(done.into_iter().flatten().collect())
    }

    fn play(&self, round: &Round) -> Result<Vec<Performance>, EvaluateError> {
        let set = &self.sets[round.set];
        let some: Vec<_> = round
            .learn
            .iter()
            .map(|&n| set.demonstrations[n].clone())
            .collect();
        let options = LearnOptions {
            seed: self.seed,
            ..LearnOptions::default()
        };
        let tests = round.test.iter().map(|&n| (None, &set.demonstrations[n]));
        let off = round
            .off
            .iter()
            .map(|&(dir, n)| (Some(dir), &self.off_model[dir].demonstrations[n]));
        let tests: Vec<_> = tests.chain(off).collect();
        let learned = learn_skill(&set.name, &some, &options, |_| ());
        let skill = Arc::new(learned.map_err(|source| EvaluateError::Learn {
            name: set.name.clone(),
            held: tests[0].1.name().to_owned(),
            source,
        })?);
        let kalman = Kalman::tuned(&some);
        tests
            .into_iter()
            .map(|(off, d)| self.predict(round.set, off, d, &skill, &kalman))
            .collect()
    }

    fn predict(
        &self,
        set: usize,
        off: Option<usize>,
        d: &Demonstration,
        skill: &Arc<Skill>,
        kalman: &Kalman,
    ) -> Result<Performance, EvaluateError> {
        let mut novelty = Vec::new();
        let mut perform = |side: Side| {
            let mut experts = experts(side, skill, kalman, self.session);
            perform(side, d, &mut experts, self.horizons_s, |expert| {
                if side == Side::Place {
                    novelty.extend(expert.novelty());
                }
            })
        };
        let places = perform(Side::Place);
        let turned = d.has_orientation() && skill.turn().is_some();
        let turns = turned.then(|| perform(Side::Turn));
        let faults = if off.is_none() {
            let shape = Shape::of(d);
            self.each(&places, |course, h_s| {
                faults::faults(d, &shape, course, h_s)
            })
        } else {
            Vec::new()
        };
        let changed = faults::change_of_mind(d).filter(|_| off.is_none());
        let mind = changed.map(|(changed, turn_s)| {
            let mut experts = experts(Side::Place, skill, kalman, self.session);
            faults::around(&changed, turn_s, &mut experts, MIND_AT_S)
        });
        let tallies = |side, courses: &[Vec<Course>]| {
            self.each(courses, |course, h_s| tally(side, d, course, h_s))
        };
        let schemes = if off.is_none() { self.schemes } else { &[] };
        // The head of a hash: chances of their own for every recording.
        let head = u64::from_le_bytes(*d.sha256().first_chunk().expect("32 bytes"));
        let seed = self.seed ^ head ^ self.link_seed.wrapping_sub(1);
        let arm = self.arm.filter(|_| off.is_none());
        let driven = arm.map(|arm| arm::drive(d, skill, arm, seed)).transpose()?;
        Ok(Performance {
            set,
            off,
            name: d.name().to_owned(),
            places: tallies(Side::Place, &places),
            turns: turns.map(|turns| tallies(Side::Turn, &turns)),
            novelty,
            seen: if off.is_none() {
                self.seen(d, &places)
            } else {
                Vec::new()
            },
            faults,
            mind: mind.unwrap_or_default(),
            dual: schemes
                .iter()
                .map(|scheme| dual::run(*scheme, d, skill, self.session, self.link, seed))
                .collect(),
            driven,
        })
    }

    fn seen(&self, d: &Demonstration, places: &[Vec<Course>]) -> Vec<Seen> {
        let near = nearest(self.horizons_s, MIND_AT_S);
        let course = places.last().map_or(&[][..], |courses| &courses[near]);
        let seen = course.iter().map(|m| {
            let now = &d.samples()[m.sample];
            Seen {
                t_s: now.t_s + self.horizons_s[near],
                from: now.position,
                predicted: now.position + m.guess.way,
                truth: now.position + m.truth,
            }
        });
        seen.collect()
    }

    /// Of every [expert][horizon].
    fn each<T>(&self, courses: &[Vec<Course>], of: impl Fn(&Course, f64) -> T) -> Vec<Vec<T>> {
        let row = |courses: &Vec<Course>| {
            let each = courses.iter().zip(self.horizons_s);
            each.map(|(course, h_s)| of(course, *h_s)).collect()
        };
        courses.iter().map(row).collect()
    }
}

#[cfg(test)]
mod tests {
    use telemime_operator::demonstration::Sample;

    use super::*;

    fn set(name: &str, files: &[&str]) -> Demonstrations {
        let recording = |file: &&str| {
            // Every name another recording: what was learned is known by its content.
            let number = file
                .bytes()
                .fold(0, |n, byte| (n * 7 + u32::from(byte)) % 4099);
            let offset = f64::from(number) * 1e-3 + name.len() as f64;
            let at = |i: i32| Sample::at(f64::from(i) * 0.1, Vector3::repeat(offset));
            let samples: Vec<_> = (0..8).map(at).collect();
            Demonstration::from_samples(file, &samples).unwrap()
        };
        Demonstrations {
            name: name.to_owned(),
            demonstrations: files.iter().map(recording).collect(),
            notices: Vec::new(),
        }
    }

    fn rounds(
        sets: &[Demonstrations],
        off_model: &[Demonstrations],
        protocol: Protocol,
        most: usize,
    ) -> Result<Vec<Round>, EvaluateError> {
        let plan = Plan {
            sets,
            off_model,
            protocol,
            persons: &PersonPattern::default(),
            most,
            horizons_s: &[0.1],
            session: &SessionConfig::default(),
            schemes: &[],
            link: &LinkConfig::default(),
            arm: None,
            seed: 0,
            link_seed: 1,
        };
        plan.rounds()
    }

    #[test]
    fn what_is_predicted_was_never_learned_from_and_is_predicted_once() {
        let sets = [
            set(
                "a",
                &["a_s1_t1", "a_s1_t2", "a_s2_t1", "a_s2_t2", "a_s3_t1"],
            ),
            set("b", &["b_s1_t1", "b_s2_t1", "b_s2_t2"]),
        ];
        for (protocol, predicted) in [
            // Those whose person performed once have nobody to learn from.
            (Protocol::SamePerson, 6),
            (Protocol::LeaveOneOut, 8),
            (Protocol::Cross, 8),
        ] {
            let rounds = rounds(&sets, &[], protocol, 2).unwrap();
            let mut tried: Vec<_> = rounds
                .iter()
                .flat_map(|r| r.test.iter().map(|n| (r.set, *n)))
                .collect();
            for r in &rounds {
                assert!((1..=2).contains(&r.learn.len()), "{r:?}");
                assert!(r.test.iter().all(|n| !r.learn.contains(n)), "{r:?}");
            }
            let count = tried.len();
            tried.sort_unstable();
            tried.dedup();
            assert_eq!((count, tried.len()), (predicted, predicted), "{protocol:?}");
        }
        let cross = rounds(&sets, &[], Protocol::Cross, 9).unwrap();
        assert_eq!(cross[0].test, [0, 1]);
        assert_eq!(cross[0].learn, [2, 3, 4]);
    }

    #[test]
    fn a_copy_of_what_is_predicted_is_not_learned_from() {
        let mut twice = set("a", &["a_s1_t1", "a_s1_t2", "a_s1_t3"]);
        twice.demonstrations[1] = twice.demonstrations[0].clone();
        let rounds = rounds(&[twice], &[], Protocol::LeaveOneOut, 9).unwrap();
        let learned: Vec<_> = rounds.iter().map(|r| r.learn.clone()).collect();
        assert_eq!(learned, [vec![2], vec![2], vec![0, 1]]);
    }

    #[test]
    fn off_the_model_is_the_same_person_with_another_gesture() {
        let sets = [
            set("a", &["a_s1_t1", "a_s1_t2"]),
            set("bb", &["b_s1_t1", "b_s1_t2", "b_s9_t1"]),
        ];
        let all = rounds(&sets[..1], &sets, Protocol::SamePerson, 3).unwrap();
        let [.., off] = all.as_slice() else {
            panic!("{all:?}");
        };
        assert!(off.test.is_empty());
        assert_eq!(off.learn, [0, 1]);
        // Neither what was learned from, nor who else is there.
        assert_eq!(off.off, [(1, 0), (1, 1)]);
    }
}
