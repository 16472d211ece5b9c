//! Runs put together: people and link seeds averaged, with what the mean might as well be.

use std::collections::BTreeMap;

use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;

use crate::experiment::factor::{FACTORS, Texts, UNUSED, index, of, seen_by};
use crate::experiment::method::Method;
use crate::experiment::row::Row;
use crate::measure::quantile;

/// Resamples of an interval.
const RESAMPLES: usize = 1000;

/// A mean, and the middle 95 % of those of resampled people.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Interval {
    pub(super) mean: f64,
    pub(super) low: f64,
    pub(super) high: f64,
}

/// The mean over people of the means of their recordings, of `(person, recording, value)`; the interval by drawing people with
/// replacement, and of each the recordings (the percentile bootstrap over clusters: runs of one recording over other links are
/// no independent evidence). `None` of nothing.
pub(super) fn interval<'a>(
    values: impl IntoIterator<Item = (&'a str, &'a str, f64)>,
) -> Option<Interval> {
    let mut people: BTreeMap<&str, BTreeMap<&str, (f64, f64)>> = BTreeMap::new();
    for (person, recording, value) in values {
        let (sum, n) = people
            .entry(person)
            .or_default()
            .entry(recording)
            .or_default();
        *sum += value;
        *n += 1.0;
    }
    let people: Vec<Vec<f64>> = people
        .into_values()
        .map(|recordings| recordings.into_values().map(|(sum, n)| sum / n).collect())
        .collect();
    if people.is_empty() {
        return None;
    }
    let of = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let mean = of(&people.iter().map(|own| of(own)).collect::<Vec<_>>());
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(people.len() as u64);
    let mut resampled: Vec<f64> = (0..RESAMPLES)
        .map(|_| {
            let person = |_| {
                let own = &people[rng.random_range(0..people.len())];
                match own[..] {
                    [only] => only,
                    _ => {
                        let draw = |_| own[rng.random_range(0..own.len())];
                        of(&(0..own.len()).map(draw).collect::<Vec<_>>())
                    }
                }
            };
            of(&(0..people.len()).map(person).collect::<Vec<_>>())
        })
        .collect();
    Some(Interval {
        mean,
        low: quantile(&mut resampled, 0.025)?,
        high: quantile(&mut resampled, 0.975)?,
    })
}

/// All runs of one setting: people and link seeds are what differs.
pub(super) struct Group<'a> {
    /// The link's seed left out.
    pub(super) texts: Texts,
    pub(super) rows: Vec<&'a Row>,
}

impl<'a> Group<'a> {
    pub(super) fn text(&self, factor: &str) -> &str {
        of(&self.texts, factor)
    }

    /// Of one figure over the runs.
    pub(super) fn figure(&self, name: &str) -> Option<Interval> {
        self.each(|row| row.figures.get(name))
    }

    /// Of anything a run has.
    pub(super) fn each(&self, of: impl Fn(&Row) -> Option<f64>) -> Option<Interval> {
        let values = self.rows.iter();
        interval(
            values.filter_map(|row| Some((row.person.as_str(), row.subject.as_str(), of(row)?))),
        )
    }
}

/// Groups in the order of the plan.
pub(super) fn groups(rows: &[Row]) -> Vec<Group<'_>> {
    let seed = index("link_seed").expect("a factor");
    let mut places: BTreeMap<Texts, usize> = BTreeMap::new();
    let mut groups: Vec<Group<'_>> = Vec::new();
    for row in rows {
        let mut texts = row.texts.clone();
        texts[seed].clear();
        let place = *places.entry(texts.clone()).or_insert_with(|| {
            let rows = Vec::new();
            groups.push(Group { texts, rows });
            groups.len() - 1
        });
        groups[place].rows.push(row);
    }
    groups
}

/// What a run is held against: the same person, link and chances, held or known ahead.
pub(super) struct Others<'a> {
    rows: BTreeMap<(&'a str, Texts), &'a Row>,
}

impl<'a> Others<'a> {
    pub(super) fn new(rows: &'a [Row]) -> Self {
        let of = |row: &'a Row| ((row.subject.as_str(), row.texts.clone()), row);
        let kept = rows.iter().filter(|row| {
            let method = row.texts[index("method").expect("a factor")].as_str();
            method == "hold" || method == "floor"
        });
        Self {
            rows: kept.map(of).collect(),
        }
    }

    fn rmse_m(&self, row: &Row, method: Method) -> Option<f64> {
        let texts = seen_by(&row.texts, method);
        let other = self.rows.get(&(row.subject.as_str(), texts))?;
        other.figures.rmse_m
    }

    /// The error over that of holding delayed samples.
    pub(super) fn ratio(&self, row: &Row) -> Option<f64> {
        let ratio = row.figures.rmse_m? / self.rmse_m(row, Method::Hold)?;
        ratio.is_finite().then_some(ratio)
    }

    /// (E_delay − E)/(E_delay − E_floor); `None` where the delay costs less than a millimetre.
    pub(super) fn hidden(&self, row: &Row) -> Option<f64> {
        let delayed = self.rmse_m(row, Method::Hold)?;
        let cost = delayed - self.rmse_m(row, Method::Floor)?;
        (cost > 1e-3).then_some((delayed - row.figures.rmse_m?) / cost)
    }
}

/// Factors with more than one value among the groups, the method, the motion and the seed aside.
pub(super) fn varying(groups: &[Group<'_>]) -> Vec<usize> {
    let aside = ["method", "motion", "link_seed"];
    let varies = |n: &usize| {
        let mut texts = groups.iter().map(|g| g.texts[*n].as_str());
        let mut first = None;
        !aside.contains(&FACTORS[*n].name)
            && texts.any(|text| text != UNUSED && *first.get_or_insert(text) != text)
    };
    (0..FACTORS.len()).filter(varies).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_interval_is_over_people_and_not_over_runs() {
        // Ten runs of one person and one of another weigh the same.
        let mut runs: Vec<(&str, &str, f64)> = vec![("a", "a1", 1.0); 10];
        runs.push(("b", "b1", 3.0));
        let both = interval(runs.clone()).unwrap();
        assert_eq!((both.mean, both.low, both.high), (2.0, 1.0, 3.0));
        assert_eq!(interval(runs), Some(both), "the same draws every time");
        assert_eq!(interval([]), None);
        // Of many people it is about 1.96 standard errors either way: here of ±1 by a fair coin, 1/√400.
        let names: Vec<String> = (0..400).map(|n| format!("{n:03}")).collect();
        let coin =
            |(n, name): (usize, &'static str)| (name, "1", if n % 2 == 0 { 1.0 } else { -1.0 });
        let leaked: Vec<&'static str> = names.iter().map(|n| &*n.clone().leak()).collect();
        let many = interval(leaked.into_iter().enumerate().map(coin)).unwrap();
        assert!((many.high - 1.96 / 20.0).abs() < 0.02, "{many:?}");
        assert!((many.low + 1.96 / 20.0).abs() < 0.02, "{many:?}");
        // One person's recordings differ, and each weighs the same however often it was run.
        let own = [("a", "1", 1.0), ("a", "1", 1.0), ("a", "2", 3.0)];
        let own = interval(own).unwrap();
        assert_eq!((own.mean, own.low, own.high), (2.0, 1.0, 3.0));
    }
}
