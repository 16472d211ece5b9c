//! What of an experiment goes into which picture.

use std::path::Path;

use nalgebra::Vector3;
use telemime_sim::link::LinkConfig;

use super::group::{Group, Others, groups, varying};
use crate::experiment::factor::{FACTORS, UNUSED, link};
use crate::experiment::method::Method;
use crate::experiment::row::Row;
use crate::experiment::store::series_path;
use crate::figure::{BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION};
use plotters::style::RGBColor;

/// Pictures of one delay are of the one nearest to this, s.
const USUAL_DELAY_S: f64 = 0.1;

/// An experiment, sorted.
pub(super) struct View<'a> {
    pub(super) groups: Vec<Group<'a>>,
    pub(super) others: Others<'a>,
    /// Indices of the factors that vary.
    pub(super) varying: Vec<usize>,
    dir: &'a Path,
}

/// One moment of a course: time (s), hand and tip (m), age (s).
pub(super) type Moment = (f64, Vector3<f64>, Vector3<f64>, Option<f64>);

impl<'a> View<'a> {
    pub(super) fn new(dir: &'a Path, rows: &'a [Row]) -> Self {
        let groups = groups(rows);
        Self {
            varying: varying(&groups),
            groups,
            others: Others::new(rows),
            dir,
        }
    }

    /// What a factor mostly is: the first value it has.
    fn usual(&self, n: usize) -> &str {
        let texts = self.groups.iter().map(|g| g.texts[n].as_str());
        texts.into_iter().find(|t| *t != UNUSED).unwrap_or(UNUSED)
    }

    /// Nothing is particular about a group but its motion, its method, its link and these factors.
    pub(super) fn plain(&self, group: &Group<'_>, but: &[&str]) -> bool {
        let links = ["up", "down"].map(|way| group.text(way));
        let symmetric = links.contains(&UNUSED) || links[0] == links[1];
        symmetric
            && (0..FACTORS.len()).all(|n| {
                let name = FACTORS[n].name;
                let free = ["motion", "method", "up", "down", "link_seed"].contains(&name);
                let text = group.texts[n].as_str();
                free || but.contains(&name) || text == UNUSED || text == self.usual(n)
            })
    }

    /// The methods there are, floor last.
    pub(super) fn methods(&self) -> Vec<&str> {
        let mut all: Vec<&str> = Vec::new();
        for group in &self.groups {
            let name = group.text("method");
            if !all.contains(&name) {
                all.push(name);
            }
        }
        // Of one with several settings the usual one speaks for it.
        if all.contains(&"deadband") {
            all.retain(|name| !name.starts_with("deadband "));
        }
        all.sort_by_key(|name| *name == "floor");
        all
    }

    /// Plain groups of ours, or of everybody where there is none.
    fn leading(&self) -> Vec<&Group<'a>> {
        let plain = || self.groups.iter().filter(|g| self.plain(g, &[]));
        let ours: Vec<_> = plain().filter(|g| g.text("method") == "ours").collect();
        if ours.is_empty() {
            plain().collect()
        } else {
            ours
        }
    }

    /// Whether links differ in delay, jitter and loss only: then an error may be drawn over the delay.
    pub(super) fn differ_by_delay(&self) -> bool {
        let rest = |g: &Group<'_>| {
            Some(LinkConfig {
                delay_s: 0.0,
                jitter_s: 0.0,
                loss: LinkConfig::default().loss,
                ..nominal(g)?
            })
        };
        let all: Option<Vec<_>> = self.leading().into_iter().map(rest).collect();
        all.is_some_and(|all| all.windows(2).all(|w| w[0] == w[1]))
    }

    /// Delays of those groups' links, s, ascending.
    pub(super) fn delays(&self) -> Vec<f64> {
        let mut all: Vec<f64> = self.leading().into_iter().filter_map(delay_s).collect();
        all.sort_by(f64::total_cmp);
        all.dedup();
        all
    }

    /// The one that pictures of a single delay show, s.
    pub(super) fn shown_delay_s(&self) -> Option<f64> {
        let off = |d: &f64| (d - USUAL_DELAY_S).abs();
        let delays = self.delays().into_iter();
        delays.min_by(|a, b| off(a).total_cmp(&off(b)))
    }

    /// The link that pictures of a single one show, as it is written: the first of that delay over which ours was driven.
    pub(super) fn shown_link(&self) -> Option<&str> {
        let delay = self.shown_delay_s();
        let mut ours = ["on-model", "off-model"]
            .into_iter()
            .flat_map(|motion| self.at(motion, "ours", delay, &[]));
        let driven = ours.find(|g| g.figure("rmse_m").is_some());
        driven.map(|g| g.text("up"))
    }

    /// Plain groups of this motion and method over [`View::shown_link`], or over none.
    pub(super) fn shown<'v>(
        &'v self,
        motion: &'v str,
        method: &'v str,
    ) -> impl Iterator<Item = &'v Group<'a>> {
        let link = self.shown_link();
        let all = self.at(motion, method, None, &[]);
        all.filter(move |g| g.text("up") == UNUSED || Some(g.text("up")) == link)
    }

    /// Plain groups of this motion and method at that delay; the floor has none.
    pub(super) fn at<'v>(
        &'v self,
        motion: &'v str,
        method: &'v str,
        delay: Option<f64>,
        but: &'v [&'v str],
    ) -> impl Iterator<Item = &'v Group<'a>> {
        let fits =
            move |g: &&Group<'_>| g.text("method") == method && self.is_at(g, motion, delay, but);
        self.groups.iter().filter(fits)
    }

    /// Whether a group is plain, of this motion, and at that delay if a link concerns it.
    pub(super) fn is_at(
        &self,
        group: &Group<'_>,
        motion: &str,
        delay: Option<f64>,
        but: &[&str],
    ) -> bool {
        let off = || delay.is_some() && group.text("up") != UNUSED && delay_s(group) != delay;
        group.text("motion") == motion && !off() && self.plain(group, but)
    }

    /// The course of a group, if it was kept.
    pub(super) fn course(&self, group: &Group<'_>) -> Option<Vec<Moment>> {
        let paths = group.rows.iter().map(|row| series_path(self.dir, &row.id));
        let path = paths.into_iter().find(|path| path.exists())?;
        let mut reader = csv::Reader::from_path(path).ok()?;
        let mut course = Vec::new();
        for record in reader.records() {
            let record = record.ok()?;
            let number = |n: usize| record.get(n)?.parse::<f64>().ok();
            let place = |n| Some(Vector3::new(number(n)?, number(n + 1)?, number(n + 2)?));
            course.push((number(0)?, place(1)?, place(4)?, number(7)));
        }
        (!course.is_empty()).then_some(course)
    }
}

/// A group's link as it is set; `None` where it is a recorded one, whose files need not be here, or concerns nobody.
fn nominal(group: &Group<'_>) -> Option<LinkConfig> {
    let text = group.text("up");
    let recorded = |word: &str| word.len() >= 3 && "trace".starts_with(word);
    if text == UNUSED || text.split_whitespace().any(recorded) {
        return None;
    }
    link(text, Path::new("")).ok()
}

/// The delay a group's link is set to, s.
pub(super) fn delay_s(group: &Group<'_>) -> Option<f64> {
    Some(nominal(group)?.delay_s)
}

/// The rate a group's link is set to, bit/s.
pub(super) fn rate_bit_s(group: &Group<'_>) -> Option<f64> {
    Some(nominal(group)?.rate?.bit_s as f64)
}

/// What heads pictures of one delay.
pub(super) fn one_way(delay_s: Option<f64>) -> String {
    delay_s.map_or_else(
        || "a recorded link".into(),
        |s| format!("{:.0} ms one way", s * 1e3),
    )
}

/// A method's colour, everywhere.
pub(super) fn colour(method: &str) -> RGBColor {
    match method.parse() {
        Ok(Method::Ours) => BLUE,
        Ok(Method::Hold) => VERMILLION,
        Ok(Method::Deadband(_)) => ORANGE,
        Ok(Method::Velocity(1.0)) => GREEN,
        Ok(Method::Velocity(_)) => SKY,
        Ok(Method::Kalman) => PURPLE,
        Ok(Method::Playback) => GREY,
        Ok(Method::Floor) | Err(_) => BLACK,
    }
}

/// What a reader calls it.
pub(super) fn called(method: &str) -> String {
    match method.parse() {
        Ok(Method::Ours) => "Telemime".into(),
        Ok(Method::Hold) => "raw, held".into(),
        Ok(Method::Deadband(_) | Method::Velocity(_)) => method.into(),
        Ok(Method::Kalman) => "Kalman".into(),
        Ok(Method::Playback) => "play-back".into(),
        Ok(Method::Floor) => "floor: no network".into(),
        Err(_) => method.into(),
    }
}

/// The value of a factor in a group.
pub(super) fn value<'g>(group: &'g Group<'_>, n: usize) -> &'g str {
    &group.texts[n]
}
