//! Counts of a trial, and the rates that follow.

use serde::Serialize;

use super::{Attempt, Moment};
use crate::demonstration::Demonstrations;

/// The share of known gestures refused at which refusal of unknown ones is compared.
const OPERATING: [f64; 5] = [0.01, 0.02, 0.05, 0.1, 0.2];

/// What a trial has shown. Rates are shares in [0, 1], null where nothing was there to count.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// Rounds of learning.
    pub rounds: usize,
    /// When the matrix was asked for, s after the onset.
    pub at_s: f64,
    /// One a skill, in the order given.
    pub skills: Vec<SkillReport>,
    /// Gestures judged at `at_s`.
    pub judged: usize,
    /// Gestures not judged: over before, or the hand never left its place.
    pub not_judged: usize,
    /// Share of gestures whose best skill is right, at each moment asked, by (s, share).
    pub best_right: Vec<(f64, Option<f64>)>,
    /// Share of gestures recognised as what they are (right and not refused), at each moment asked.
    pub recognised: Vec<(f64, Option<f64>)>,
    /// Share of known gestures refused, at each moment asked.
    pub refused_known: Vec<(f64, Option<f64>)>,
    /// Share of gestures refused by those who do not know them, at each moment asked.
    pub refused_left_out: Vec<(f64, Option<f64>)>,
    /// Share of strangers refused, at each moment asked.
    pub refused_strangers: Vec<(f64, Option<f64>)>,
    /// Share of gestures left out and strangers together refused, at each moment asked.
    pub refused_unknown: Vec<(f64, Option<f64>)>,
    /// Recordings of strangers.
    pub strangers: usize,
    /// Share of the samples of strangers that were taken for a known skill, of those in which the hand moved.
    pub strangers_time_accepted: Option<f64>,
    /// What other thresholds would do, at `at_s`.
    pub roc: Vec<Operating>,
    /// Mean |phase − true phase| where the best skill is right, as a share of the skill.
    pub phase_error: Option<f64>,
}

/// One skill of a trial.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SkillReport {
    /// Its name.
    pub name: String,
    /// Its demonstrations.
    pub demonstrations: usize,
    /// How many of its gestures were recognised as each skill, at `at_s`.
    pub taken_for: Vec<usize>,
    /// How many were refused.
    pub refused: usize,
    /// Share of its gestures refused by those who do not know it.
    pub refused_left_out: Option<f64>,
    /// Mean |phase − true phase| where it is the best skill.
    pub phase_error: Option<f64>,
}

/// What one threshold would do.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Operating {
    /// The novelty above which nothing known is seen.
    pub reject_above: f64,
    /// Share of known gestures it refuses.
    pub refused_known: f64,
    /// Share of gestures left out and strangers it refuses.
    pub refused_unknown: Option<f64>,
}

fn share(part: usize, of: usize) -> Option<f64> {
    (of > 0).then(|| part as f64 / of as f64)
}

/// Share of the attempts answered at a moment that fulfil `test`.
fn rate<'a>(
    attempts: impl Iterator<Item = &'a Attempt>,
    moment: usize,
    test: impl Fn(&Attempt, &Moment) -> bool,
) -> Option<f64> {
    let (mut part, mut of) = (0, 0);
    for attempt in attempts {
        if let Some(m) = &attempt.moments[moment] {
            of += 1;
            part += usize::from(test(attempt, m));
        }
    }
    share(part, of)
}

fn phase_error<'a>(attempts: impl Iterator<Item = &'a Attempt>) -> Option<f64> {
    let (sum, n) = attempts.fold((0.0, 0), |(sum, n), a| (sum + a.phase.0, n + a.phase.1));
    (n > 0).then(|| sum / n as f64)
}

pub(super) fn report(
    sets: &[Demonstrations],
    strangers: usize,
    asked_s: &[f64],
    rounds: usize,
    attempts: &[Attempt],
) -> Report {
    let known = || attempts.iter().filter(|a| a.known);
    let left_out = || attempts.iter().filter(|a| !a.known && a.truth.is_some());
    let strange = || attempts.iter().filter(|a| a.truth.is_none());
    let right = |a: &Attempt, m: &Moment| m.best == a.truth;
    let refused = |_: &Attempt, m: &Moment| !m.accepted;
    let each = |rate: &dyn Fn(usize) -> Option<f64>| {
        let moments = asked_s.iter().enumerate();
        moments.map(|(n, at_s)| (*at_s, rate(n))).collect()
    };
    let skill = |(i, set): (usize, &Demonstrations)| {
        let own = || known().filter(|a| a.truth == Some(i));
        let mut taken_for = vec![0; sets.len()];
        let mut refused_own = 0;
        for m in own().filter_map(|a| a.moments.first()?.as_ref()) {
            match m.best {
                Some(best) if m.accepted => taken_for[best] += 1,
                _ => refused_own += 1,
            }
        }
        SkillReport {
            name: set.name.clone(),
            demonstrations: set.demonstrations.len(),
            taken_for,
            refused: refused_own,
            refused_left_out: rate(left_out().filter(|a| a.truth == Some(i)), 0, refused),
            phase_error: phase_error(own()),
        }
    };
    let judged = known().filter(|a| a.moments[0].is_some()).count();
    let (moving, accepted) =
        strange().fold((0, 0), |(m, k), a| (m + a.moving, k + a.accepted));
    Report {
        rounds,
        at_s: asked_s[0],
        skills: sets.iter().enumerate().map(skill).collect(),
        judged,
        not_judged: known().count() - judged,
        best_right: each(&|n| rate(known(), n, right)),
        recognised: each(&|n| rate(known(), n, |a, m| right(a, m) && m.accepted)),
        refused_known: each(&|n| rate(known(), n, refused)),
        refused_left_out: each(&|n| rate(left_out(), n, refused)),
        refused_strangers: each(&|n| rate(strange(), n, refused)),
        refused_unknown: each(&|n| rate(attempts.iter().filter(|a| !a.known), n, refused)),
        strangers,
        strangers_time_accepted: share(accepted, moving),
        roc: roc(attempts),
        phase_error: phase_error(known()),
    }
}

/// For each share of known gestures refused the lowest threshold that refuses no more of them.
fn roc(attempts: &[Attempt]) -> Vec<Operating> {
    let novelties = |known: bool| {
        let some = attempts.iter().filter(move |a| a.known == known);
        some.filter_map(|a| Some(a.moments[0]?.novelty))
    };
    let mut of_known: Vec<f64> = novelties(true).collect();
    of_known.sort_by(f64::total_cmp);
    if of_known.is_empty() {
        return Vec::new();
    }
    let n = of_known.len();
    let above = |all: &mut dyn Iterator<Item = f64>, threshold: f64| {
        let (mut part, mut of) = (0, 0);
        for novelty in all {
            of += 1;
            part += usize::from(novelty > threshold);
        }
        share(part, of)
    };
    OPERATING
        .iter()
        .map(|wanted| {
            let refused = (wanted * n as f64) as usize;
            let reject_above = of_known[n - 1 - refused.min(n - 1)];
            Operating {
                reject_above,
                refused_known: above(&mut novelties(true), reject_above).unwrap_or(0.0),
                refused_unknown: above(&mut novelties(false), reject_above),
            }
        })
        .collect()
}
