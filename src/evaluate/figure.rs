//! Error over horizon, messages over error, what the regions hold, and every performance.

use std::path::Path;

use telemime_operator::session::FutureBound;

use super::dual::Scheme;
use super::experts::GUARDED;
use super::report::{Report, Section, nearest};
use crate::figure::{
    BLACK, BLUE, Figure, FigureError, GREEN, GREY, Layer, ORANGE, PURPLE, Panel, SILVER, SKY,
    Shape, VERMILLION,
};
use plotters::style::RGBColor;

/// Draws the report into the file.
///
/// # Errors
/// [`FigureError`].
pub(super) fn write(report: &Report, path: &Path) -> Result<(), FigureError> {
    let mut panels = vec![errors("Prediction error", report, &report.position)];
    if let Some(turns) = &report.orientation {
        panels.push(errors("Prediction error, orientation", report, turns));
    }
    if let Some(off) = &report.off_model {
        panels.push(errors("Motion that was not learned", report, off));
    }
    panels.push(messages(report));
    panels.push(coverage(report));
    panels.push(performances(report));
    Figure {
        title: report.position.groups.join(", "),
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

pub(super) fn colour(name: &str) -> RGBColor {
    match name {
        "hold" => BLACK,
        "constant velocity" => ORANGE,
        "damped velocity ×0.5" => VERMILLION,
        "generic" => PURPLE,
        "Kalman" => SILVER,
        "clock-indexed GMR" => GREY,
        "mixture alone" => GREEN,
        "guard alone" => SKY,
        _ => BLUE,
    }
}

/// Nothing above is worth the room.
const TOP: f64 = 1.6;

fn errors(title: &str, report: &Report, section: &Section) -> Panel {
    let layers = section.experts.iter().map(|row| {
        let points = report.horizons_ms.iter().zip(&row.horizons);
        let points = points.filter_map(|(h, c)| Some((*h, c.ratio.filter(|r| *r <= TOP)?)));
        let points = points.collect();
        let shape = if row.name == GUARDED {
            Shape::Line(points)
        } else {
            Shape::Dashed(points)
        };
        Layer::new(row.name, colour(row.name), shape)
    });
    Panel {
        title: title.into(),
        x_label: "horizon / ms".into(),
        y_label: "RMSE over that of holding".into(),
        layers: layers.collect(),
        ..Panel::default()
    }
}

fn messages(report: &Report) -> Panel {
    let dual = &report.dual;
    let series = |label: &str, colour, of: &dyn Fn(&Scheme) -> bool| {
        let rows = dual
            .rows
            .iter()
            .filter(|r| r.scheme.as_ref().is_some_and(of));
        let points: Vec<_> = rows
            .filter_map(|r| Some((r.messages_per_s, r.ratio.filter(|r| *r <= TOP)?)))
            .collect();
        [
            Layer::new(label, colour, Shape::Line(points.clone())),
            Layer::new("", colour, Shape::Dots(points)),
        ]
    };
    let session = |silence: Option<f64>| move |s: &Scheme| matches!(s, Scheme::Session(FutureBound::Share(_), own) if *own == silence);
    let mut layers = Vec::new();
    layers.extend(series("deadband, held", BLACK, &|s| {
        matches!(s, Scheme::DeadbandHold(_))
    }));
    layers.extend(series("deadband, velocity", ORANGE, &|s| {
        matches!(s, Scheme::DeadbandStraight(_))
    }));
    layers.extend(series(
        "guarded, silence ≤ 200 ms",
        BLUE,
        &session(Some(0.2)),
    ));
    layers.extend(series("≤ 300 ms", SKY, &session(Some(0.3))));
    layers.extend(series("no limit", GREEN, &session(None)));
    Panel {
        title: format!(
            "Messages against error, {} ± {} ms, {} % lost",
            dual.delay_ms,
            dual.jitter_ms,
            100.0 * dual.loss
        ),
        x_label: "messages a second".into(),
        y_label: "RMSE over every sample, held".into(),
        layers,
        ..Panel::default()
    }
}

fn coverage(report: &Report) -> Panel {
    let series = |label: &str, colour, section: &Section, region: usize, dashed: bool| {
        let own = section.experts.iter().find(|row| row.name == GUARDED)?;
        let points = report.horizons_ms.iter().zip(&own.horizons);
        let points = points
            .filter_map(|(h, c)| Some((*h, 100.0 * c.coverage?[region])))
            .collect();
        let shape = if dashed {
            Shape::Dashed(points)
        } else {
            Shape::Line(points)
        };
        Some(Layer::new(label, colour, shape))
    };
    let ends = [report.horizons_ms.first(), report.horizons_ms.last()];
    let aim = |percent: f64| {
        let points = ends.iter().flatten().map(|h| (**h, percent)).collect();
        Layer::new("", SILVER, Shape::Thin(points))
    };
    let mut layers = vec![aim(50.0), aim(90.0), aim(95.0)];
    for (n, (label, colour)) in [("50 %", SKY), ("90 %", BLUE), ("95 %", GREEN)]
        .iter()
        .enumerate()
    {
        layers.extend(series(label, *colour, &report.position, n, false));
    }
    if let Some(off) = &report.off_model {
        layers.extend(series("90 %, not learned", VERMILLION, off, 1, true));
    }
    Panel {
        title: "Truths within the predicted regions".into(),
        x_label: "horizon / ms".into(),
        y_label: "share / %".into(),
        layers,
        ..Panel::default()
    }
}

fn performances(report: &Report) -> Panel {
    let mut layers = Vec::new();
    let mut rank = |label: String, colour, section: &Section, h: usize| {
        let mut ratios: Vec<f64> = section
            .performances
            .iter()
            .filter_map(|p| p.ratio[h])
            .collect();
        ratios.sort_by(f64::total_cmp);
        let last = (ratios.len().max(2) - 1) as f64;
        let points = ratios
            .iter()
            .enumerate()
            .map(|(n, r)| (100.0 * n as f64 / last, *r));
        layers.push(Layer::new(label, colour, Shape::Line(points.collect())));
    };
    let (near, far) = (
        nearest(&report.horizons_ms, 100.0),
        report.horizons_ms.len() - 1,
    );
    rank(
        format!("{} ms", report.horizons_ms[near]),
        SKY,
        &report.position,
        near,
    );
    if far != near {
        rank(
            format!("{} ms", report.horizons_ms[far]),
            BLUE,
            &report.position,
            far,
        );
    }
    if let Some(off) = &report.off_model {
        rank(
            format!("{} ms, not learned", report.horizons_ms[near]),
            VERMILLION,
            off,
            near,
        );
    }
    layers.push(Layer::new(
        "hold",
        BLACK,
        Shape::Dashed(vec![(0.0, 1.0), (100.0, 1.0)]),
    ));
    Panel {
        title: "Every performance, sorted".into(),
        x_label: "share of the performances / %".into(),
        y_label: "guarded, RMSE over that of holding".into(),
        layers,
        ..Panel::default()
    }
}
