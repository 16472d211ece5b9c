//! The speed of each recording, and where it was cut.

use std::path::Path;

use telemime_operator::ingest::{Imported, Pose};

use crate::cli::plural;
use crate::figure::{BLACK, Figure, Layer, ORANGE, Panel, SKY, Shape, VERMILLION};

/// More recordings than this are not drawn: nobody would look.
const MOST: usize = 12;

pub(super) fn figure(recordings: &[(&Path, &Imported)]) -> Figure {
    let shown = &recordings[..recordings.len().min(MOST)];
    let takes: usize = recordings.iter().map(|(_, i)| i.takes.len()).sum();
    let beyond = match recordings.len() - shown.len() {
        0 => String::new(),
        n => format!("; {n} more recordings are not shown"),
    };
    Figure {
        title: "Demonstrations in raw recordings".into(),
        note: format!(
            "{} from {}{beyond}",
            plural(takes, "demonstration", "demonstrations"),
            plural(recordings.len(), "recording", "recordings")
        ),
        columns: if shown.len() > 3 { 2 } else { 1 },
        panels: shown.iter().map(|(p, i)| panel(p, i)).collect(),
    }
}

fn panel(raw: &Path, imported: &Imported) -> Panel {
    let speeds: Vec<Vec<(f64, f64)>> = imported.stretches.iter().map(|s| speed(s)).collect();
    let top = 1.05 * speeds.iter().flatten().map(|(_, v)| *v).fold(0.1, f64::max);
    let report = &imported.report;
    let mut layers = Vec::new();
    // A sliver stays white between neighbours.
    let sliver_s = 0.002 * report.takes.last().map_or(0.0, |t| t.to_s);
    for (i, take) in report.takes.iter().enumerate() {
        let (from, to) = (take.from_s + sliver_s, take.to_s - sliver_s);
        let shape = Shape::Band(vec![(from, 0.0, top), (to, 0.0, top)]);
        layers.push(Layer::new(only(i, "demonstration"), SKY, shape));
    }
    for (i, speed) in speeds.into_iter().enumerate() {
        layers.push(Layer::new(only(i, "speed"), BLACK, Shape::Line(speed)));
    }
    let cuts = report.cuts.iter().flat_map(|c| &c.at_s);
    for (i, t) in cuts.enumerate() {
        let shape = Shape::Dashed(vec![(*t, 0.0), (*t, top)]);
        layers.push(Layer::new(only(i, "cut"), VERMILLION, shape));
    }
    if !report.glitches_s.is_empty() {
        let dots = report.glitches_s.iter().map(|t| (*t, 0.0)).collect();
        layers.push(Layer::new("glitch removed", ORANGE, Shape::Dots(dots)));
    }
    Panel {
        title: raw
            .file_name()
            .map_or_else(String::new, |n| n.to_string_lossy().into_owned()),
        x_label: "time / s".into(),
        y_label: "speed / (m/s)".into(),
        equal_axes: false,
        doubling: false,
        layers,
    }
}

/// The legend names one of many alike.
fn only(i: usize, label: &str) -> &str {
    if i == 0 { label } else { "" }
}

fn speed(stretch: &[Pose]) -> Vec<(f64, f64)> {
    stretch
        .windows(2)
        .map(|w| {
            let dt = w[1].t_s - w[0].t_s;
            (
                w[0].t_s + 0.5 * dt,
                (w[1].position - w[0].position).norm() / dt,
            )
        })
        .collect()
}
