//! The report as one page: nothing is fetched, light and dark, wide and narrow.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use super::charts::Chart;
use super::group::{Group, Interval};
use super::outages::outages;
use super::view::{View, called, delay_s, one_way, value};
use crate::cli::plural;
use crate::experiment::factor::{FACTORS, UNUSED};
use crate::experiment::real::Ground;
use crate::experiment::store::Manifest;
use crate::figure::FigureError;

const STYLE: &str = include_str!("report.css");

/// More rows than this are folded away.
const OPEN_ROWS: usize = 40;

/// Writes the page.
pub(super) fn page(
    view: &View<'_>,
    manifest: &Manifest,
    plan: &str,
    charts: &[Chart],
) -> Result<String, FigureError> {
    let mut out = String::new();
    let title = escape(&manifest.title);
    let _ = write!(
        out,
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"color-scheme\" content=\"light dark\">\n<title>{title}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n<main>\n\
         <header>\n<p class=\"kicker\">Telemime · experiment</p>\n<h1>{title}</h1>\n{}</header>\n",
        summary(view, manifest)
    );
    out += &tiles(view);
    out += "<section class=\"charts\">\n";
    for chart in charts {
        // A file has a header of its own; here the page's style decides.
        let svg = chart.figure().svg()?;
        let _ = write!(
            out,
            "<figure id=\"{}\">\n{}\n<figcaption>{}</figcaption>\n</figure>\n",
            chart.name,
            svg.trim(),
            escape(&chart.caption)
        );
    }
    out += "</section>\n";
    out += &outages(view);
    out += &tables(view);
    out += &notes(view);
    out += &repeat(manifest, plan);
    out += "</main>\n</body>\n</html>\n";
    Ok(out)
}

/// With fewer, an interval of resampled people is too narrow to be believed.
const ENOUGH_PEOPLE: usize = 6;

/// With fewer, a link's luck is part of the result.
const ENOUGH_SEEDS: usize = 10;

fn people(view: &View<'_>) -> usize {
    let rows = view.groups.iter().flat_map(|g| &g.rows);
    let mut names: Vec<&str> = rows.map(|r| r.person.as_str()).collect();
    names.sort_unstable();
    names.dedup();
    names.len()
}

fn seeds(view: &View<'_>) -> usize {
    let n = FACTORS.len() - 1;
    let rows = view.groups.iter().flat_map(|g| &g.rows);
    let seeds = rows.map(|r| r.texts[n].as_str());
    let mut all: Vec<&str> = seeds.filter(|t| *t != UNUSED).collect();
    all.sort_unstable();
    all.dedup();
    all.len()
}

fn summary(view: &View<'_>, manifest: &Manifest) -> String {
    let driven = if manifest.is_of_recordings() {
        "recorded hands"
    } else {
        "generated hands"
    };
    let ground = match manifest.ground {
        Ground::Virtual => {
            "Every run is both daemons’ own sessions, predictor, servo and arm over real QUIC on a virtual clock, or a baseline through the same link and the same arm."
        }
        Ground::Loopback => {
            "Telemime’s runs are both daemons as processes, in real time, with a relay that shapes what passes between their sockets; baselines and floor are computed, over the same link model and through the same arm."
        }
        Ground::Netns => {
            "Telemime’s runs are both daemons as processes, in real time, in two network namespaces with the kernel’s netem between them; baselines and floor are computed, over our model of the same link and through the same arm."
        }
    };
    let thinned = match manifest.thinned.as_str() {
        "" => String::new(),
        flags => format!(" A part of the plan: <code>{}</code>.", escape(flags)),
    };
    let (people, seeds) = (people(view), seeds(view).max(1));
    let few = if people < ENOUGH_PEOPLE || seeds < ENOUGH_SEEDS {
        format!(
            " <strong>A first look and no evidence</strong>: below {ENOUGH_PEOPLE} people or {ENOUGH_SEEDS} seeds the intervals are too narrow."
        )
    } else {
        String::new()
    };
    format!(
        "<p class=\"lead\">{} of {}, {driven}, {} of the link’s chances. {ground}{thinned}{few}</p>\n",
        plural(manifest.runs, "run", "runs"),
        plural(people, "person", "people"),
        plural(seeds, "seed", "seeds"),
    )
}

/// The few figures one looks for first.
fn tiles(view: &View<'_>) -> String {
    let first = |motion, method| view.shown(motion, method).next();
    let Some(ours) = first("on-model", "ours").or_else(|| first("off-model", "ours")) else {
        return String::new();
    };
    let motion = ours.text("motion");
    let link = match delay_s(ours) {
        Some(s) => format!("At {}", one_way(Some(s))),
        None => format!("Over {}", one_way(None)),
    };
    let mut out = format!(
        "<section>\n<h2>{link} <small>({}; {motion})</small></h2>\n<div class=\"tiles\">\n",
        escape(ours.text("up"))
    );
    let mut tile = |found: Option<Interval>,
                    (unit, decimals, name): (f64, usize, &str),
                    label: &str| {
        if let Some(found) = found {
            let (mean, span) = texts(found, unit, decimals);
            let span = span.map_or_else(String::new, |span| format!(" <i>{span}</i>"));
            let _ = writeln!(
                out,
                "<div><b>{mean}\u{202f}<small>{name}</small></b>{span}<span>{label}</span></div>"
            );
        }
    };
    let error = |g: Option<&Group<'_>>| g.and_then(|g| g.figure("rmse_m"));
    let mm = (1e3, 0, "mm");
    tile(error(Some(ours)), mm, "tracking error, Telemime");
    let (hold, floor) = (first(motion, "hold"), first(motion, "floor"));
    tile(error(hold), mm, "the same arm, raw samples held");
    tile(error(floor), mm, "the same arm, no network at all");
    let hidden = ours.each(|row| view.others.hidden(row));
    tile(hidden, (100.0, 0, "%"), "of the delay’s cost hidden");
    tile(ours.figure("lag_s"), (1e3, 0, "ms"), "effective lag");
    let up = ours.figure("up_bytes_per_s");
    tile(up, (8e-3, 1, "kbit/s"), "operator to robot, all headers");
    out + "</div>\n</section>\n"
}

/// A mean, and its interval where there is one.
fn texts(i: Interval, unit: f64, decimals: usize) -> (String, Option<String>) {
    let number = |v: f64| {
        let text = format!("{:.decimals$}", v * unit);
        match text.strip_prefix('-') {
            Some(digits) if digits.trim_matches(['0', '.']).is_empty() => digits.to_owned(),
            Some(digits) => format!("\u{2212}{digits}"),
            None => text,
        }
    };
    let (mean, low, high) = (number(i.mean), number(i.low), number(i.high));
    (
        mean,
        (low != high).then(|| format!("{low}\u{2009}…\u{2009}{high}")),
    )
}

/// The same in a table.
pub(super) fn scaled(i: Interval, unit: f64, decimals: usize) -> String {
    match texts(i, unit, decimals) {
        (mean, None) => mean,
        (mean, Some(span)) => format!("{mean} <i>{span}</i>"),
    }
}

/// Heading, figure, unit, decimals.
const COLUMNS: [(&str, &str, f64, usize); 16] = [
    ("error / mm", "rmse_m", 1e3, 0),
    ("p99 / mm", "error_p99_m", 1e3, 0),
    ("turn / °", "turn_rmse_rad", 57.295_779_513, 1),
    ("lag / ms", "lag_s", 1e3, 0),
    ("off the path / mm", "spatial_mean_m", 1e3, 0),
    ("size", "amplitude_gain", 1.0, 2),
    ("overshoot / mm", "overshoot_m", 1e3, 0),
    ("jerk, hand = 1", "jerk_ratio", 1.0, 2),
    ("limited / ms", "clamps", 1.0, 0),
    ("age p50 / ms", "age_p50_s", 1e3, 0),
    ("up / kbit/s", "up_bytes_per_s", 8e-3, 1),
    ("down / kbit/s", "down_bytes_per_s", 8e-3, 1),
    ("followed / %", "followed", 100.0, 0),
    ("stop / s", "stop_s", 1.0, 2),
    ("operator CPU / %", "operator_cpu", 100.0, 1),
    ("robot CPU / %", "robot_cpu", 100.0, 1),
];

fn tables(view: &View<'_>) -> String {
    let mut out = String::from(
        "<section>\n<h2>Every setting</h2>\n<p>Means over people and link seeds, with 95 % intervals of a bootstrap over people and their recordings. <em>Hidden</em> is (E<sub>held</sub> − E)/(E<sub>held</sub> − E<sub>floor</sub>), run by run.</p>\n",
    );
    for (motion, words) in [
        ("on-model", "Demonstrated motion"),
        ("off-model", "Motion never demonstrated"),
    ] {
        let groups: Vec<_> = view
            .groups
            .iter()
            .filter(|g| g.text("motion") == motion)
            .collect();
        if groups.is_empty() {
            continue;
        }
        let open = if groups.len() <= OPEN_ROWS {
            " open"
        } else {
            ""
        };
        let _ = write!(
            out,
            "<details{open}>\n<summary>{words}: {}</summary>\n<div class=\"scroll\">\n{}</div>\n</details>\n",
            plural(groups.len(), "setting", "settings"),
            table(view, &groups)
        );
    }
    out + "</section>\n"
}

fn table(view: &View<'_>, groups: &[&Group<'_>]) -> String {
    let has = |name: &str| groups.iter().any(|g| g.figure(name).is_some());
    let columns: Vec<_> = COLUMNS.into_iter().filter(|c| has(c.1)).collect();
    // The way back is not worth a column of its own where it is the same.
    let same = groups.iter().all(|g| {
        let down = g.text("down");
        down == UNUSED || down == g.text("up")
    });
    let varying: Vec<usize> = view
        .varying
        .iter()
        .copied()
        .filter(|n| !(same && FACTORS[*n].name == "down"))
        .collect();
    let mut out = String::from("<table>\n<thead><tr><th>method</th>");
    for n in &varying {
        let name = FACTORS[*n].name;
        let name = if same && name == "up" { "link" } else { name };
        let _ = write!(out, "<th class=\"text\">{}</th>", name.replace('_', " "));
    }
    out += "<th>runs</th><th>hidden / %</th><th>of held</th>";
    for (heading, ..) in &columns {
        let _ = write!(out, "<th>{heading}</th>");
    }
    out += "</tr></thead>\n<tbody>\n";
    for group in groups {
        let method = group.text("method");
        let class = if method == "ours" {
            " class=\"ours\""
        } else {
            ""
        };
        let _ = write!(out, "<tr{class}><th>{}</th>", escape(&called(method)));
        for n in &varying {
            let text = value(group, *n);
            let text = if text == UNUSED { "" } else { text };
            let _ = write!(out, "<td class=\"text\">{}</td>", escape(text));
        }
        let _ = write!(out, "<td>{}</td>", group.rows.len());
        let mut cell = |found: Option<Interval>, unit, decimals| {
            let text = found.map_or_else(String::new, |i| scaled(i, unit, decimals));
            let _ = write!(out, "<td>{text}</td>");
        };
        let reference = method == "hold" || method == "floor";
        let hidden = group.each(|row| view.others.hidden(row));
        cell(hidden.filter(|_| !reference), 100.0, 0);
        let ratio = group.each(|row| view.others.ratio(row));
        cell(ratio.filter(|_| method != "hold"), 1.0, 2);
        for (_, name, unit, decimals) in &columns {
            cell(group.figure(name), *unit, *decimals);
        }
        out += "</tr>\n";
    }
    out + "</tbody>\n</table>\n"
}

fn notes(view: &View<'_>) -> String {
    let mut notes = vec![
        "Recordings are open loop: the hand is replayed and does not react to the arm, as a person who watches it would.".to_owned(),
        "Baselines are given what ours has to earn: a clock that is exactly right, no handshake, no acknowledgements, no telemetry, no lease. They go on after any outage; Telemime’s arm holds once its lease is over, stays there, and what the hand does afterwards counts as error.".to_owned(),
        "Distances are in metres of the hand: the tip, mapped back through the scale.".to_owned(),
    ];
    let n = people(view);
    if n < 5 {
        notes.push(format!(
            "{}: the intervals say how those differ, and little about others.",
            plural(n, "person", "people")
        ));
    }
    if view.groups.iter().any(|g| g.text("motion") == "off-model") {
        notes.push("Motion never demonstrated: of generated hands, a wave turned into a chop, by somebody else; of recordings, another gesture of the same person where there is one.".to_owned());
    }
    let mut undriven: BTreeMap<(&str, &str), usize> = BTreeMap::new();
    let mut stopped: BTreeMap<&str, usize> = BTreeMap::new();
    for group in &view.groups {
        for row in &group.rows {
            if let Some(why) = row.outcome.strip_prefix("not driven: ") {
                *undriven.entry((group.text("up"), why)).or_default() += 1;
            }
            if row.outcome.starts_with("stopped") && group.text("outage") == "none" {
                *stopped.entry(group.text("up")).or_default() += 1;
            }
        }
    }
    for (link, n) in stopped {
        notes.push(format!(
            "Over <code>{}</code> Telemime’s arm stopped by itself in {}, before or while the hand moved, and stayed where it was; that is in the means.",
            escape(link),
            plural(n, "run", "runs")
        ));
    }
    for ((link, why), n) in undriven {
        notes.push(format!(
            "Over <code>{}</code> the arm never engaged in {}: {}. Their errors are blank, not zero.",
            escape(link),
            plural(n, "run", "runs"),
            escape(why)
        ));
    }
    let items: String = notes.iter().map(|n| format!("<li>{n}</li>\n")).collect();
    format!("<section>\n<h2>How to read it</h2>\n<ul>\n{items}</ul>\n</section>\n")
}

fn repeat(manifest: &Manifest, plan: &str) -> String {
    let mut flags = String::new();
    if !manifest.thinned.is_empty() {
        flags = format!(" {}", manifest.thinned);
    }
    let again = match manifest.ground {
        Ground::Virtual => {
            "The same plan gives the same bytes, with any number of threads or shards."
        }
        ground @ (Ground::Loopback | Ground::Netns) => {
            flags += &format!(" --ground {ground}");
            "In real time no two runs are quite the same: what the scheduler does is in the last digits. The plan, the link’s chances and all that is computed are."
        }
    };
    let mut out = format!(
        "<section>\n<h2>To repeat it</h2>\n<pre>telemime experiment {plan}{flags} -o DIR\ntelemime report DIR</pre>\n\
         <p>{again} Version {}, seed {}, {} on {}; SHA-256 of the plan <code>{}</code>.</p>\n",
        escape(&manifest.version),
        manifest.seed,
        escape(&manifest.host.os),
        escape(&manifest.host.arch),
        escape(&manifest.plan_sha256),
        plan = escape(&manifest.plan),
    );
    if !manifest.inputs.is_empty() {
        out += "<details>\n<summary>Files it depends on</summary>\n<div class=\"scroll\">\n<table>\n<tbody>\n";
        for (path, hash) in &manifest.inputs {
            let _ = writeln!(
                out,
                "<tr><td class=\"text\">{}</td><td class=\"text\"><code>{hash}</code></td></tr>",
                escape(path)
            );
        }
        out += "</tbody>\n</table>\n</div>\n</details>\n";
    }
    let _ = write!(
        out,
        "<details>\n<summary>The plan</summary>\n<pre>{}</pre>\n</details>\n</section>\n",
        escape(plan.trim_end())
    );
    out
}

pub(super) fn escape(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}
