//! What is learned from and what is held out, round by round.

use super::TrialError;
use crate::demonstration::{Demonstration, Demonstrations, PersonPattern};

/// What is held out of learning.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Split {
    /// Demonstrations: every `folds`-th of each skill in one round. People are known, performances new.
    Demonstrations {
        /// Rounds, at least 2; fewer where a skill has fewer demonstrations.
        folds: usize,
    },
    /// Persons: all that one of them does in one round. Everybody tried is a stranger to the skills.
    Persons,
    /// Each person is learned from alone, all but one performance of each skill: an operator who has
    /// shown a few demonstrations. Whoever performs one skill only takes no part.
    Own,
}

/// (skill, demonstrations), both by index.
type Chosen = Vec<(usize, Vec<usize>)>;

/// One round.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Round {
    /// What to learn from; no list is empty.
    pub(super) train: Chosen,
    /// What to try; of skills in `train`.
    pub(super) test: Chosen,
}

pub(super) fn rounds(
    sets: &[Demonstrations],
    split: Split,
    persons: &PersonPattern,
) -> Result<Vec<Round>, TrialError> {
    if sets.len() < 2 {
        return Err(TrialError::Skills { found: sets.len() });
    }
    let few = sets.iter().find(|s| s.demonstrations.len() < 2);
    if let Some(set) = few {
        return Err(TrialError::Demonstrations {
            name: set.name.clone(),
            found: set.demonstrations.len(),
        });
    }
    match split {
        Split::Demonstrations { folds } => Ok(by_demonstration(sets, folds)),
        Split::Persons => by_person(sets, persons),
        Split::Own => each_ones_own(sets, persons),
    }
}

fn by_demonstration(sets: &[Demonstrations], folds: usize) -> Vec<Round> {
    let fewest = sets.iter().map(|s| s.demonstrations.len()).min();
    let folds = folds.max(2).min(fewest.unwrap_or(2));
    (0..folds)
        .map(|fold| divide(sets, |_, index| index % folds == fold))
        .collect()
}

fn by_person(sets: &[Demonstrations], names: &PersonPattern) -> Result<Vec<Round>, TrialError> {
    for set in sets {
        let first = names.person(&set.demonstrations[0]);
        if set.demonstrations.iter().all(|d| names.person(d) == first) {
            return Err(TrialError::Persons {
                name: set.name.clone(),
                person: first.to_owned(),
                pattern: names.to_string(),
            });
        }
    }
    let rounds = everybody(sets, names)
        .into_iter()
        .map(|who| divide(sets, |d, _| names.person(d) == who));
    Ok(rounds.collect())
}

/// All skills, what `held` picks (by demonstration and its index) to be tried and the rest to be learned from.
fn divide(sets: &[Demonstrations], held: impl Fn(&Demonstration, usize) -> bool) -> Round {
    let (mut train, mut test) = (Vec::new(), Vec::new());
    for (skill, set) in sets.iter().enumerate() {
        let (out, kept): (Vec<_>, Vec<_>) =
            (0..set.demonstrations.len()).partition(|&i| held(&set.demonstrations[i], i));
        train.push((skill, kept));
        test.push((skill, out));
    }
    Round { train, test }
}

fn each_ones_own(sets: &[Demonstrations], names: &PersonPattern) -> Result<Vec<Round>, TrialError> {
    let mut rounds = Vec::new();
    for who in everybody(sets, names) {
        let own: Chosen = sets
            .iter()
            .enumerate()
            .map(|(skill, set)| {
                let by = |i: &usize| names.person(&set.demonstrations[*i]) == who;
                (skill, (0..set.demonstrations.len()).filter(by).collect())
            })
            .filter(|(_, of): &(usize, Vec<usize>)| of.len() > 1)
            .collect();
        if own.len() < 2 {
            continue;
        }
        let most = own.iter().map(|(_, of)| of.len()).max().unwrap_or(0);
        for held in 0..most {
            let without = |of: &[usize]| {
                let kept = of.iter().enumerate().filter(|(n, _)| *n != held);
                kept.map(|(_, &i)| i).collect()
            };
            rounds.push(Round {
                train: own.iter().map(|(s, of)| (*s, without(of))).collect(),
                test: own
                    .iter()
                    .filter_map(|(s, of)| Some((*s, vec![*of.get(held)?])))
                    .collect(),
            });
        }
    }
    if rounds.is_empty() {
        return Err(TrialError::NobodysOwn {
            pattern: names.to_string(),
        });
    }
    Ok(rounds)
}

/// Everybody, in order of first appearance.
fn everybody<'a>(sets: &'a [Demonstrations], names: &PersonPattern) -> Vec<&'a str> {
    let mut all: Vec<&str> = Vec::new();
    for d in sets.iter().flat_map(|s| &s.demonstrations) {
        let who = names.person(d);
        if !all.contains(&who) {
            all.push(who);
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::demonstration::Sample;

    fn set(name: &str, files: &[&str]) -> Demonstrations {
        let samples: Vec<_> = (0..8)
            .map(|i| Sample::at(f64::from(i), Vector3::zeros()))
            .collect();
        Demonstrations {
            name: name.to_owned(),
            demonstrations: files
                .iter()
                .map(|f| Demonstration::from_samples(f, &samples).unwrap())
                .collect(),
            notices: Vec::new(),
        }
    }

    fn two() -> [Demonstrations; 2] {
        [
            set("a", &["a_s1_t1", "a_s1_t2", "a_s2_t1"]),
            set("b", &["b_s1_t1", "b_s1_t2", "b_s3_t1", "b_s3_t2"]),
        ]
    }

    /// No demonstration is ever learned from in the round that tries it, and all are tried once.
    #[test]
    fn what_is_tried_is_never_learned_from() {
        let sets = two();
        for split in [Split::Demonstrations { folds: 4 }, Split::Persons] {
            let mut tried = Vec::new();
            for round in rounds(&sets, split, &PersonPattern::default()).unwrap() {
                for ((skill, train), (_, test)) in round.train.iter().zip(&round.test) {
                    assert!(!train.is_empty(), "{split:?}");
                    assert!(test.iter().all(|i| !train.contains(i)), "{split:?}");
                    tried.extend(test.iter().map(|i| (*skill, *i)));
                }
            }
            tried.sort_unstable();
            let all = [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (1, 3)];
            assert_eq!(tried, all, "{split:?}");
        }
    }

    #[test]
    fn an_operator_is_learned_from_alone() {
        let own = rounds(&two(), Split::Own, &PersonPattern::default()).unwrap();
        // s2 and s3 perform one skill each.
        assert_eq!(own.len(), 2);
        assert_eq!(own[0].train, [(0, vec![1]), (1, vec![1])]);
        assert_eq!(own[0].test, [(0, vec![0]), (1, vec![0])]);
    }

    #[test]
    fn what_cannot_be_split_is_refused() {
        let [a, b] = two();
        let refused = |sets: &[Demonstrations], split| {
            rounds(sets, split, &PersonPattern::default()).unwrap_err()
        };
        let folds = Split::Demonstrations { folds: 4 };
        assert!(matches!(
            refused(std::slice::from_ref(&a), folds),
            TrialError::Skills { found: 1 }
        ));
        let one = set("c", &["c_s1_t1"]);
        assert!(matches!(
            refused(&[a.clone(), one], folds),
            TrialError::Demonstrations { found: 1, .. }
        ));
        let alone = set("c", &["c1", "c2"]);
        assert!(matches!(
            refused(&[b, alone.clone()], Split::Persons),
            TrialError::Persons { .. }
        ));
        assert!(matches!(
            refused(&[a, alone], Split::Own),
            TrialError::NobodysOwn { .. }
        ));
    }
}
