//! Where predictions fail, drawn: one performance, the first moments, a change of mind, size and path.

use std::path::Path;

use nalgebra::{Matrix3, Vector3};

use super::experts::GUARDED;
use super::figure::colour;
use super::protocol::{Performance, Seen};
use super::report::{FaultyCell, Report, nearest};
use crate::figure::{
    BLACK, BLUE, Figure, FigureError, Layer, Panel, SILVER, SKY, Shape, VERMILLION,
};

/// The predictors worth comparing here.
const SHOWN: [&str; 4] = ["hold", "constant velocity", "mixture alone", GUARDED];

/// Draws the failures into the file.
///
/// # Errors
/// [`FigureError`].
pub(super) fn write(
    report: &Report,
    performances: &[Performance],
    path: &Path,
) -> Result<(), FigureError> {
    let near = nearest(&report.horizons_ms, 100.0);
    let mut panels = Vec::new();
    if let Some(one) = typical(performances, near) {
        panels.extend(example(one, report.horizons_ms[near]));
    }
    panels.push(since_onset(report, near));
    if report.faults.minds_changed > 0 {
        panels.push(mind(report));
    }
    panels.push(size(report));
    panels.push(off_path(report));
    Figure {
        title: format!("Where prediction fails: {}", report.position.groups.join(", ")),
        note: format!(
            "{}, up to {} demonstrations: {} performances, each predicted by a skill learned without it",
            report.protocol,
            report.demonstrations,
            report.position.performances.len()
        ),
        columns: 2,
        panels,
    }
    .write(path)
}

/// The performance whose ratio to holding is the median.
fn typical(performances: &[Performance], horizon: usize) -> Option<&Performance> {
    let mut all: Vec<_> = performances
        .iter()
        .filter(|p| p.off.is_none() && !p.seen.is_empty())
        .filter_map(|p| Some((p.places.last()?[horizon].ratio()?, p)))
        .collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0));
    all.get(all.len() / 2).map(|(_, p)| *p)
}

/// The two directions in which most happens.
fn plane(seen: &[Seen]) -> [Vector3<f64>; 2] {
    let mean = seen.iter().map(|s| s.truth).sum::<Vector3<f64>>() / seen.len() as f64;
    let scatter: Matrix3<f64> = seen
        .iter()
        .map(|s| (s.truth - mean) * (s.truth - mean).transpose())
        .sum();
    let eigen = scatter.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let [first, second, _] = order.map(|n| eigen.eigenvectors.column(n).into_owned());
    [first, second]
}

fn example(one: &Performance, horizon_ms: f64) -> [Panel; 2] {
    let [first, second] = plane(&one.seen);
    let origin = one.seen[0].truth;
    let along = |of: &dyn Fn(&Seen) -> Vector3<f64>| -> Vec<(f64, f64)> {
        let points = one
            .seen
            .iter()
            .map(|s| (s.t_s, (of(s) - origin).dot(&first)));
        points.collect()
    };
    let across = |of: &dyn Fn(&Seen) -> Vector3<f64>| -> Vec<(f64, f64)> {
        let point = |s: &Seen| ((of(s) - origin).dot(&first), (of(s) - origin).dot(&second));
        one.seen.iter().map(point).collect()
    };
    let predicted = format!("predicted {horizon_ms} ms ahead");
    [
        Panel {
            title: format!("{}: its main direction", one.name),
            x_label: "time / s".into(),
            y_label: "along / m".into(),
            layers: vec![
                Layer::new("held", SILVER, Shape::Line(along(&|s| s.from))),
                Layer::new("hand", BLACK, Shape::Line(along(&|s| s.truth))),
                Layer::new(&predicted, BLUE, Shape::Line(along(&|s| s.predicted))),
            ],
            ..Panel::default()
        },
        Panel {
            title: format!("{}: its path", one.name),
            x_label: "along / m".into(),
            y_label: "across / m".into(),
            equal_axes: true,
            layers: vec![
                Layer::new("hand", BLACK, Shape::Line(across(&|s| s.truth))),
                Layer::new(&predicted, BLUE, Shape::Dots(across(&|s| s.predicted))),
            ],
            ..Panel::default()
        },
    ]
}

fn since_onset(report: &Report, horizon: usize) -> Panel {
    let faulty = &report.faults;
    // The middle of each time; of the first and the last some time that shows them apart.
    let ends = &faulty.since_onset_ms;
    let middle = |n: usize| match (n.checked_sub(1).and_then(|n| ends[n]), ends[n]) {
        (Some(from), Some(to)) => 0.5 * (from + to),
        (Some(from), None) => from + 200.0,
        _ => -100.0,
    };
    let layers = faulty
        .experts
        .iter()
        .filter(|row| SHOWN.contains(&row.name));
    let layers = layers.flat_map(|row| {
        let mm = row.horizons[horizon].since_onset_mm.iter().enumerate();
        let points: Vec<_> = mm.filter_map(|(n, mm)| Some((middle(n), (*mm)?))).collect();
        let colour = colour(row.name);
        [
            Layer::new(row.name, colour, Shape::Line(points.clone())),
            Layer::new("", colour, Shape::Dots(points)),
        ]
    });
    Panel {
        title: format!(
            "The first moments, {} ms ahead",
            report.horizons_ms[horizon]
        ),
        x_label: "time since the hand began to move / ms (left: at rest)".into(),
        y_label: "RMSE / mm".into(),
        layers: layers.collect(),
        ..Panel::default()
    }
}

fn mind(report: &Report) -> Panel {
    let faulty = &report.faults;
    let rows = faulty.experts.iter().zip(&faulty.mind_mm);
    let layers = rows
        .filter(|(row, _)| SHOWN.contains(&row.name))
        .map(|(row, mm)| {
            let points = faulty.mind_ms.iter().zip(mm);
            let points = points.filter_map(|(t, mm)| Some((*t, (*mm)?))).collect();
            Layer::new(row.name, colour(row.name), Shape::Line(points))
        });
    Panel {
        title: format!("A change of mind, {} ms ahead", faulty.mind_at_ms),
        x_label: "time since the hand turned back at full speed / ms".into(),
        y_label: "RMSE / mm".into(),
        layers: layers.collect(),
        ..Panel::default()
    }
}

fn curve(report: &Report, of: impl Fn(&FaultyCell) -> Option<f64>) -> Vec<(f64, f64)> {
    let Some(own) = report.faults.experts.last() else {
        return Vec::new();
    };
    let points = report.horizons_ms.iter().zip(&own.horizons);
    points.filter_map(|(h, c)| Some((*h, of(c)?))).collect()
}

fn size(report: &Report) -> Panel {
    let percent = |share: Option<f64>| share.map(|s| 100.0 * s);
    Panel {
        title: "Size, and how far it goes beyond turns".into(),
        x_label: "horizon / ms".into(),
        y_label: "%".into(),
        layers: vec![
            Layer::new(
                "amplitude over the hand's",
                BLUE,
                Shape::Line(curve(report, |c| percent(c.amplitude))),
            ),
            Layer::new(
                "beyond turns, of the range: mean",
                SKY,
                Shape::Line(curve(report, |c| percent(c.overshoot))),
            ),
            Layer::new(
                "95 % below",
                VERMILLION,
                Shape::Dashed(curve(report, |c| percent(c.overshoot_95))),
            ),
        ],
        ..Panel::default()
    }
}

fn off_path(report: &Report) -> Panel {
    Panel {
        title: "Off the hand's path".into(),
        x_label: "horizon / ms".into(),
        y_label: "distance / mm".into(),
        layers: vec![
            Layer::new(
                "root mean square",
                BLUE,
                Shape::Line(curve(report, |c| c.off_path_mm)),
            ),
            Layer::new(
                "95 % below",
                VERMILLION,
                Shape::Dashed(curve(report, |c| c.off_path_95_mm)),
            ),
        ],
        ..Panel::default()
    }
}
