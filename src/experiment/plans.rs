//! Plans that need no file.

use super::factor::{FACTORS, LINK};
use super::plan::Plan;

/// Names and texts.
pub(super) const READY: [(&str, &str); 7] = [
    ("quick", include_str!("plans/quick.toml")),
    ("latency", include_str!("plans/latency.toml")),
    ("bandwidth", include_str!("plans/bandwidth.toml")),
    ("outages", include_str!("plans/outages.toml")),
    ("traces", include_str!("plans/traces.toml")),
    ("paper", include_str!("plans/paper.toml")),
    ("off-model", include_str!("plans/off-model.toml")),
];

/// The text of a ready plan.
pub(super) fn ready(name: &str) -> Option<&'static str> {
    let found = READY.iter().find(|(known, _)| *known == name);
    found.map(|(_, text)| *text)
}

/// Every ready plan and every factor, a line each.
pub(super) fn listed() -> String {
    let mut out = String::from("ready plans (--print NAME shows one):\n");
    for (name, text) in READY {
        let plan = Plan::parse(name, text, std::path::Path::new("."));
        let title = plan.map_or_else(|e| e.to_string(), |plan| plan.title);
        out += &format!("  {name:<12} {title}\n");
    }
    out += "\nfactors, with what they are unless a plan says otherwise:\n";
    out += &format!("  {LINK:<14} up and down at once\n");
    for factor in &FACTORS {
        let default = factor.default.join(", ");
        out += &format!("  {:<14} {} [{default}]\n", factor.name, factor.meaning);
    }
    out.trim_end().to_owned()
}
