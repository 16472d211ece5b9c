//! The report for people.

use std::fmt::Write as _;

use super::report::{Cell, DualRow, FaultyCell, Report, Row, Section};

const NAME: usize = 22;

/// The whole report.
pub(super) fn text(report: &Report) -> String {
    let mut out = String::new();
    let _ = writeln!(
        out,
        "{}: {} performances predicted by {} skills of up to {} demonstrations; persons by {}",
        report.protocol,
        report.position.performances.len(),
        report.skills,
        report.demonstrations,
        report.group_by
    );
    if report.not_predicted > 0 {
        let _ = writeln!(
            out,
            "{} of {} recordings left out: nothing to learn from for them",
            report.not_predicted, report.recordings
        );
    }
    section(&mut out, report, "position", &report.position);
    if let Some(turns) = &report.orientation {
        section(&mut out, report, "orientation", turns);
    }
    if let Some(off) = &report.off_model {
        section(&mut out, report, "off the model, position", off);
    }
    if let Some(off) = &report.off_model_orientation {
        section(&mut out, report, "off the model, orientation", off);
    }
    faults(&mut out, report);
    dual(&mut out, report);
    arm(&mut out, report);
    out
}

fn number(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| "–".to_owned(), |v| format!("{v:.decimals$}"))
}

fn section(out: &mut String, report: &Report, title: &str, section: &Section) {
    let heads = heads(report);
    let groups = section.groups.len();
    let of = if groups > 1 {
        format!(", geometric mean of {groups}")
    } else {
        String::new()
    };
    let _ = writeln!(out, "\n== {title} ==");
    let _ = writeln!(out, "RMSE over that of holding{of}");
    let _ = writeln!(out, "{:NAME$}{heads}", "");
    let block =
        |out: &mut String, rows: &mut dyn Iterator<Item = &Row>, of: &dyn Fn(&Cell) -> String| {
            for row in rows {
                let cells: String = row
                    .horizons
                    .iter()
                    .map(|c| format!("{:>8}", of(c)))
                    .collect();
                let _ = writeln!(out, "{:NAME$}{cells}", row.name);
            }
        };
    let all = || section.experts.iter();
    block(out, &mut all(), &|c| number(c.ratio, 3));
    let _ = writeln!(out, "RMSE, {}", section.unit);
    block(out, &mut all(), &|c| number(c.rmse, 1));
    let _ = writeln!(out, "effective lag, ms");
    block(out, &mut all(), &|c| number(c.lag_ms, 0));
    if all().any(|row| row.horizons.iter().any(|c| c.jerk.is_some())) {
        let _ = writeln!(out, "RMS jerk over the hand's own");
        block(out, &mut all(), &|c| number(c.jerk, 2));
    }
    let _ = writeln!(out, "worst single performance over holding");
    block(out, &mut all(), &|c| number(c.worst, 2));
    let sure = || all().filter(|row| row.horizons.iter().any(|c| c.coverage.is_some()));
    for (n, region) in ["50", "90", "95"].iter().enumerate() {
        let _ = writeln!(out, "truths within the {region} % region, %");
        block(out, &mut sure(), &|c| {
            number(c.coverage.map(|c| 100.0 * c[n]), 1)
        });
    }
    if groups > 1
        && let Some(own) = section.experts.last()
    {
        let _ = writeln!(out, "{}, of each, over holding", own.name);
        for (g, name) in section.groups.iter().enumerate() {
            let cells: String = own
                .horizons
                .iter()
                .map(|c| format!("{:>8}", number(c.of_groups[g], 3)))
                .collect();
            // Names of any length, and the figures still in their columns.
            if name.chars().count() < NAME {
                let _ = writeln!(out, "{name:NAME$}{cells}");
            } else {
                let _ = writeln!(out, "{name}\n{:NAME$}{cells}", "");
            }
        }
    }
    if let Some([median, ninety]) = section.novelty {
        let _ = writeln!(
            out,
            "novelty, in calibrated 90 % quantiles: median {median:.2}, 90 % below {ninety:.2}"
        );
    }
    if section.above.is_empty() {
        let _ = writeln!(out, "no performance is predicted worse than 1.1 × holding");
    } else {
        let _ = writeln!(out, "performances predicted worse than 1.1 × holding:");
        for own in section
            .above
            .chunk_by(|a, b| (&a.group, &a.name) == (&b.group, &b.name))
        {
            let at: Vec<String> = own
                .iter()
                .map(|a| format!("{:.2} at {} ms", a.ratio, a.horizon_ms))
                .collect();
            let _ = writeln!(
                out,
                "  {} ({}): {}",
                own[0].name,
                own[0].group,
                at.join(", ")
            );
        }
    }
}

fn faults(out: &mut String, report: &Report) {
    let faulty = &report.faults;
    let Some(own) = faulty.experts.last() else {
        return;
    };
    let _ = writeln!(out, "\n== where it fails: {} ==", own.name);
    let _ = writeln!(out, "{:NAME$}{}", "", heads(report));
    let mut row = |name: &str, of: &dyn Fn(&FaultyCell) -> String| {
        let cells: String = own
            .horizons
            .iter()
            .map(|c| format!("{:>8}", of(c)))
            .collect();
        let _ = writeln!(out, "{name:NAME$}{cells}");
    };
    let percent = |share: Option<f64>, decimals| number(share.map(|s| 100.0 * s), decimals);
    for (n, end) in faulty.since_onset_ms.iter().enumerate() {
        let name = match (n, end) {
            (0, _) => "at rest".to_owned(),
            (_, Some(end)) => format!("to {end} ms of motion"),
            (_, None) => "later".to_owned(),
        };
        row(&format!("{name}, mm"), &|c| number(c.since_onset_mm[n], 1));
    }
    for (n, end) in faulty.since_onset_ms.iter().enumerate() {
        let name = match (n, end) {
            (0, _) => "share, at rest".to_owned(),
            (_, Some(end)) => format!("  to {end} ms"),
            (_, None) => "  later".to_owned(),
        };
        row(&format!("{name}, %"), &|c| {
            percent(c.since_onset_share[n], 1)
        });
    }
    row("turning back / hold", &|c| number(c.turning_back, 3));
    row("off the path, mm", &|c| number(c.off_path_mm, 1));
    row("  95 % below, mm", &|c| number(c.off_path_95_mm, 1));
    row("amplitude", &|c| number(c.amplitude, 3));
    row("beyond turns, %", &|c| percent(c.overshoot, 1));
    row("  95 % below, %", &|c| percent(c.overshoot_95, 1));
    let _ = writeln!(
        out,
        "{} performances turned back at their fastest moment, {} ms ahead: RMSE, mm",
        faulty.minds_changed, faulty.mind_at_ms
    );
    let shown = || (0..faulty.mind_ms.len()).step_by(3);
    let times: String = shown()
        .map(|n| format!("{:>8.0}", faulty.mind_ms[n]))
        .collect();
    let _ = writeln!(out, "{:NAME$}{times} ms", "");
    for (row, mm) in faulty.experts.iter().zip(&faulty.mind_mm) {
        let cells: String = shown()
            .map(|n| format!("{:>8}", number(mm[n], 0)))
            .collect();
        let _ = writeln!(out, "{:NAME$}{cells}", row.name);
    }
}

fn heads(report: &Report) -> String {
    let heads = report.horizons_ms.iter();
    heads.map(|h| format!("{:>8}", format!("{h} ms"))).collect()
}

fn dual(out: &mut String, report: &Report) {
    let dual = &report.dual;
    let _ = writeln!(
        out,
        "\n== messages against error, {} ± {} ms one way, {} % lost ==\n\
         over {} mm, the RMSE at the same wall time of sending every sample and holding it\n\
         {:NAME$}{:>12}{:>12}{:>9}{:>9}{:>9}{:>8}",
        dual.delay_ms,
        dual.jitter_ms,
        100.0 * dual.loss,
        number(dual.hold_rmse_mm, 0),
        "",
        "bound",
        "silence",
        "msg/s",
        "B/s",
        "RMSE/mm",
        "ratio"
    );
    for row in &dual.rows {
        let _ = writeln!(
            out,
            "{:NAME$}{:>12}{:>12}{:>9.1}{:>9}{:>9}{:>8}",
            row.name,
            bound(row),
            row.silence_ms
                .map_or_else(String::new, |s| format!("{s} ms")),
            row.messages_per_s,
            number(row.bytes_per_s, 0),
            number(row.rmse_mm, 1),
            number(row.ratio, 3)
        );
    }
}

fn bound(row: &DualRow) -> String {
    let mm = row.bound_mm.map(|mm| format!("{mm} mm"));
    let sigmas = row.bound_sigmas.map(|n| format!("{n} σ"));
    let share = row.bound_share.map(|n| format!("{n} way"));
    mm.or(sigmas).or(share).unwrap_or_default()
}

fn arm(out: &mut String, report: &Report) {
    let Some(arm) = &report.arm else {
        return;
    };
    let [least, most] = arm.scale;
    let _ = writeln!(
        out,
        "\n== through the arm: {} performances at scales {least:.3} to {most:.3} ==\n\
         {:NAME$}{:>9}{:>26}",
        arm.driven, "", "RMSE/mm", "lag/ms 10 %, median, 90 %"
    );
    for way in &arm.ways {
        let lags = way.lag_ms.map_or_else(String::new, |lags| {
            lags.iter().map(|lag| format!("{lag:>8.0}")).collect()
        });
        let _ = writeln!(
            out,
            "{:NAME$}{:>9}  {lags:>24}",
            way.name,
            number(way.rmse_mm, 1)
        );
    }
    let _ = writeln!(
        out,
        "{} over delayed, same arm; {} over delayed, ideal tip; fraction hidden {}, {} of what is left once it has begun; lag within 10 ms in {:.0} %\n\
         {:.1} messages/s; jerk of the command over the hand's {}; a limit acted on {:.1} % of the ticks",
        number(arm.over_delayed_same_arm, 3),
        number(arm.over_delayed_ideal, 3),
        number(arm.fraction_hidden, 3),
        number(arm.fraction_hidden_once_begun, 3),
        100.0 * arm.lag_within_10_ms,
        arm.messages_per_s,
        number(arm.jerk, 2),
        100.0 * arm.clamped
    );
    if arm.of_groups.len() > 1 {
        for (name, [ideal, same]) in report.position.groups.iter().zip(&arm.of_groups) {
            let _ = writeln!(
                out,
                "{name:NAME$} {} over delayed, same arm; {} over ideal tip",
                number(*same, 3),
                number(*ideal, 3)
            );
        }
    }
}
