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
    /// Share of gestures for which their own skill was named, at each moment asked.
    pub recognised: Vec<(f64, Option<f64>)>,
    /// Share of known gestures for which no skill was named, at each moment asked.
    pub refused_known: Vec<(f64, Option<f64>)>,
    /// Share of gestures for which those who do not know them named no skill, at each moment asked.
    pub refused_left_out: Vec<(f64, Option<f64>)>,
    /// Share of strangers for which no skill was named, at each moment asked.
    pub refused_strangers: Vec<(f64, Option<f64>)>,
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
    /// For how many none was named.
    pub refused: usize,
    /// Share of its gestures for which those who do not know it named no skill.
    pub refused_left_out: Option<f64>,
    /// Mean |phase − true phase| where it is the best skill.
    pub phase_error: Option<f64>,
}

/// What one threshold would do.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Operating {
    /// The novelty above which nothing known is seen.
    pub reject_above: f64,
    /// Share of known gestures for which no skill would be named.
    pub refused_known: f64,
    /// Share of gestures left out of learning for which none would be named.
    pub refused_left_out: Option<f64>,
    /// Share of strangers for which none would be named.
    pub refused_strangers: Option<f64>,
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
    let refused = |_: &Attempt, m: &Moment| !m.named;
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
                Some(best) if m.named => taken_for[best] += 1,
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
    let (moving, accepted) = strange().fold((0, 0), |(m, k), a| (m + a.moving, k + a.named));
    Report {
        rounds,
        at_s: asked_s[0],
        skills: sets.iter().enumerate().map(skill).collect(),
        judged,
        not_judged: known().count() - judged,
        best_right: each(&|n| rate(known(), n, right)),
        recognised: each(&|n| rate(known(), n, |a, m| right(a, m) && m.named)),
        refused_known: each(&|n| rate(known(), n, refused)),
        refused_left_out: each(&|n| rate(left_out(), n, refused)),
        refused_strangers: each(&|n| rate(strange(), n, refused)),
        strangers,
        strangers_time_accepted: share(accepted, moving),
        roc: roc(attempts),
        phase_error: phase_error(known()),
    }
}

/// For each share of known gestures refused the lowest threshold that refuses no more of them.
fn roc(attempts: &[Attempt]) -> Vec<Operating> {
    // Who has no favourite names none at any threshold.
    let strangeness = |m: &Moment| {
        if m.undecided {
            f64::INFINITY
        } else {
            m.novelty
        }
    };
    let known = || attempts.iter().filter(|a| a.known);
    let mut sorted: Vec<f64> = known()
        .filter_map(|a| a.moments[0].as_ref().map(strangeness))
        .collect();
    sorted.sort_by(f64::total_cmp);
    let Some(last) = sorted.len().checked_sub(1) else {
        return Vec::new();
    };
    let operating = |wanted: &f64| {
        let refused = (wanted * sorted.len() as f64) as usize;
        let reject_above = sorted[last - refused.min(last)];
        let above = |_: &Attempt, m: &Moment| strangeness(m) > reject_above;
        let unknown = |left_out: bool| {
            let some = attempts.iter().filter(move |a| !a.known);
            some.filter(move |a| a.truth.is_some() == left_out)
        };
        reject_above.is_finite().then(|| Operating {
            reject_above,
            refused_known: rate(known(), 0, above).unwrap_or(0.0),
            refused_left_out: rate(unknown(true), 0, above),
            refused_strangers: rate(unknown(false), 0, above),
        })
    };
    OPERATING.iter().filter_map(operating).collect()
}
