//! What the link's absence does, in one table.

use std::fmt::Write as _;

use super::group::Group;
use super::page::{escape, scaled};
use super::view::View;
use crate::cli::plural;
use crate::experiment::factor::UNUSED;

/// Figure, unit, decimals.
const COLUMNS: [(&str, f64, usize); 4] = [
    ("stop_s", 1.0, 2),
    ("stop_m", 1e3, 0),
    ("reconnect_s", 1.0, 2),
    ("rmse_m", 1e3, 0),
];

/// Ours, outage by outage; nothing of a plan without any.
pub(super) fn outages(view: &View<'_>) -> String {
    let cut = |g: &&Group<'_>| {
        g.text("method") == "ours" && !["none", UNUSED].contains(&g.text("outage"))
    };
    let groups: Vec<_> = view.groups.iter().filter(cut).collect();
    let Some(first) = groups.first() else {
        return String::new();
    };
    // What is the same everywhere needs no column.
    let named = [("motion", "motion"), ("up", "link"), ("lease", "lease")];
    let varies = |name: &str| groups.iter().any(|g| g.text(name) != first.text(name));
    let named: Vec<_> = named.into_iter().filter(|(name, _)| varies(name)).collect();
    let mut out = String::from(
        "<section>\n<h2>Outages</h2>\n<p>Telemime while the link is gone. Where the lease ends before the link is back the arm stops, and waits for a person to engage it again: what the hand does meanwhile is error.</p>\n\
         <div class=\"scroll\">\n<table>\n<thead><tr><th>gone</th>",
    );
    for (_, heading) in &named {
        let _ = write!(out, "<th class=\"text\">{heading}</th>");
    }
    out += "<th>stopped</th><th>at rest after / s</th><th>until then / mm</th><th>heard again after / s</th><th>error / mm</th></tr></thead>\n<tbody>\n";
    for group in &groups {
        let _ = write!(out, "<tr><th>{}</th>", escape(group.text("outage")));
        for (name, _) in &named {
            let _ = write!(out, "<td class=\"text\">{}</td>", escape(group.text(name)));
        }
        let stopped = |outcome: &str| outcome.starts_with("stopped");
        let stopped = group.rows.iter().filter(|r| stopped(&r.outcome)).count();
        let runs = plural(group.rows.len(), "run", "runs");
        let _ = write!(out, "<td>{stopped} of {runs}</td>");
        for (name, unit, decimals) in COLUMNS {
            let found = group.figure(name);
            let text = found.map_or_else(String::new, |i| scaled(i, unit, decimals));
            let _ = write!(out, "<td>{text}</td>");
        }
        out += "</tr>\n";
    }
    out + "</tbody>\n</table>\n</div>\n</section>\n"
}
