//! The pictures of a report; one that the plan has nothing for is left out.

use super::group::Group;
use super::view::{Moment, View, called, colour, delay_s, one_way, rate_bit_s};
use crate::experiment::row::Row;
use crate::figure::{BLACK, Figure, GREY, Layer, Panel, Shape};
use crate::measure::principal_axis;

/// One picture, what it is called as a file, and what it says.
pub(super) struct Chart {
    pub(super) name: &'static str,
    pub(super) caption: String,
    pub(super) panel: Panel,
}

impl Chart {
    /// A page with this picture alone.
    pub(super) fn figure(&self) -> Figure {
        Figure {
            title: String::new(),
            note: String::new(),
            columns: 1,
            panels: vec![self.panel.clone()],
        }
    }
}

const MOTIONS: [(&str, &str); 2] = [
    ("on-model", "demonstrated motion"),
    ("off-model", "motion never demonstrated"),
];

/// All that can be drawn.
pub(super) fn charts(view: &View<'_>) -> Vec<Chart> {
    let mut all = Vec::new();
    all.extend(MOTIONS.into_iter().filter_map(|m| by_delay(view, m)));
    all.extend(MOTIONS.into_iter().filter_map(|m| by_rate(view, m)));
    all.extend(rate_distortion(view));
    all.extend(timeline(view));
    all.extend(lags(view));
    all.extend(ages(view));
    all.extend(horizons(view));
    all.extend(calibration(view));
    all
}

fn panel(title: &str, x: &str, y: &str, layers: Vec<Layer>) -> Option<Panel> {
    (!layers.is_empty()).then(|| Panel {
        title: title.into(),
        x_label: x.into(),
        y_label: y.into(),
        layers,
        ..Panel::default()
    })
}

/// (x, mean).
type Means = Vec<(f64, f64)>;

/// (x, low, high).
type Bands = Vec<(f64, f64, f64)>;

/// Mean and interval of `figure` over x, of one method; groups with the same x are pooled.
fn course_over(
    groups: &[&Group<'_>],
    x: impl Fn(&Group<'_>) -> Option<f64>,
    figure: &str,
    unit: f64,
) -> (Means, Bands) {
    let mut places: Vec<f64> = groups.iter().filter_map(|g| x(g)).collect();
    places.sort_by(f64::total_cmp);
    places.dedup();
    let (mut line, mut band) = (Vec::new(), Vec::new());
    for place in places {
        let here = groups.iter().filter(|g| x(g) == Some(place));
        let runs = here.flat_map(|g| g.rows.iter());
        let values = runs.filter_map(|row| {
            Some((
                row.person.as_str(),
                row.subject.as_str(),
                row.figures.get(figure)? * unit,
            ))
        });
        if let Some(found) = super::group::interval(values) {
            line.push((place, found.mean));
            band.push((place, found.low, found.high));
        }
    }
    (line, band)
}

fn by_delay(view: &View<'_>, (motion, words): (&str, &str)) -> Option<Chart> {
    if view.delays().len() < 2 || !view.differ_by_delay() {
        return None;
    }
    let ms = |g: &Group<'_>| delay_s(g).map(|s| s * 1e3);
    let ends = view.delays();
    let layers = over(
        view,
        motion,
        ms,
        (ends[0] * 1e3, ends[ends.len() - 1] * 1e3),
    );
    let name = if motion == "on-model" {
        "delay-on-model"
    } else {
        "delay-off-model"
    };
    Some(Chart {
        name,
        caption: format!(
            "RMS distance of tip and hand at the same moment, {words}, over the link's one-way delay. Bands: 95 % bootstrap over people and their recordings; links of one delay are pooled."
        ),
        panel: panel(
            &format!("Error against delay: {words}"),
            "one-way delay / ms",
            "tracking error / mm",
            layers,
        )?,
    })
}

fn by_rate(view: &View<'_>, (motion, words): (&str, &str)) -> Option<Chart> {
    let kbit = |g: &Group<'_>| rate_bit_s(g).map(|r| (r * 1e-3).log2());
    let mut rates: Vec<f64> = view.groups.iter().filter_map(kbit).collect();
    rates.sort_by(f64::total_cmp);
    rates.dedup();
    let (Some(first), Some(last)) = (rates.first(), rates.last()) else {
        return None;
    };
    if rates.len() < 2 {
        return None;
    }
    let mut layers = over(view, motion, kbit, (*first, *last));
    for layer in &mut layers {
        match &mut layer.shape {
            Shape::Line(p) | Shape::Dashed(p) => p.iter_mut().for_each(|p| p.1 = p.1.log2()),
            Shape::Band(p) => p
                .iter_mut()
                .for_each(|p| (p.1, p.2) = (p.1.log2(), p.2.log2())),
            _ => {}
        }
    }
    let mut panel = panel(
        &format!("Error on thin links: {words}"),
        "rate of the link / kbit/s",
        "tracking error / mm",
        layers,
    )?;
    panel.doubling = true;
    let missing = |row: &&Row| row.outcome.starts_with("not driven");
    let undriven = view
        .at(motion, "ours", None, &[])
        .filter(|g| g.rows.iter().all(missing));
    let undriven: Vec<_> = undriven
        .filter_map(|g| Some(format!("{:.0}", rate_bit_s(g)? * 1e-3)))
        .collect();
    let undriven = match undriven.join(", ") {
        none if none.is_empty() => none,
        rates => {
            format!(
                " At {rates} kbit/s Telemime drives nothing: its connection does not come about."
            )
        }
    };
    Some(Chart {
        name: if motion == "on-model" {
            "rate-on-model"
        } else {
            "rate-off-model"
        },
        caption: format!(
            "The same over the rate of the bottleneck, {words}; both axes double. Where a method's packets do not fit, they queue, and the tip falls behind without end.{undriven}"
        ),
        panel,
    })
}

/// Bands, then lines, of every method; the floor, which no link concerns, from end to end.
fn over(
    view: &View<'_>,
    motion: &str,
    x: impl Fn(&Group<'_>) -> Option<f64> + Copy,
    (first, last): (f64, f64),
) -> Vec<Layer> {
    let (mut bands, mut lines) = (Vec::new(), Vec::new());
    for method in view.methods() {
        let groups: Vec<_> = view.at(motion, method, None, &[]).collect();
        let (name, colour) = (called(method), colour(method));
        if method == "floor" {
            let floor = groups.first().and_then(|g| g.figure("rmse_m"));
            if let Some(floor) = floor {
                let y = floor.mean * 1e3;
                lines.push(Layer::new(
                    name,
                    colour,
                    Shape::Dashed(vec![(first, y), (last, y)]),
                ));
            }
            continue;
        }
        let (line, band) = course_over(&groups, x, "rmse_m", 1e3);
        if !line.is_empty() {
            bands.push(Layer::new("", colour, Shape::Band(band)));
            lines.push(Layer::new(name, colour, Shape::Line(line)));
        }
    }
    bands.extend(lines);
    bands
}

fn rate_distortion(view: &View<'_>) -> Option<Chart> {
    let delay = view.shown_delay_s();
    let free = ["future", "path", "silence", "prediction"];
    let (mut lines, mut dots) = (Vec::new(), Vec::new());
    let mut methods = view.methods();
    methods.retain(|m| *m != "floor" && *m != "playback");
    for method in methods {
        let point = |g: &Group<'_>| {
            let up = g.figure("up_bytes_per_s")?.mean * 8e-3;
            let rmse = g.figure("rmse_m")?.mean * 1e3;
            (up > 0.0 && rmse > 0.0).then_some((up, rmse))
        };
        let family = |g: &&Group<'_>| {
            let text = g.text("method");
            text == method || method == "deadband" && text.starts_with("deadband ")
        };
        let groups = view.groups.iter().filter(family);
        let fits =
            groups.filter(|g| view.is_at(g, "on-model", delay, &free) && rate_bit_s(g).is_none());
        let mut points: Vec<_> = fits.filter_map(point).collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        if points.is_empty() {
            continue;
        }
        if points.len() > 1 {
            lines.push(Layer::new("", colour(method), Shape::Thin(points.clone())));
        }
        dots.push(Layer::new(
            called(method),
            colour(method),
            Shape::Dots(points),
        ));
    }
    if dots.len() < 2 {
        return None;
    }
    lines.extend(dots);
    let all = || {
        lines
            .iter()
            .flat_map(|layer| points_of(layer).iter().copied())
    };
    let widest = |of: fn((f64, f64)) -> f64| {
        let values = all().map(of);
        let (low, high) = values.fold((f64::MAX, 0.0), |(l, h), v| (v.min(l), v.max(h)));
        high / low
    };
    // Doubling axes name powers of two only: they need a few of them.
    let doubling = widest(|p| p.0).max(widest(|p| p.1)) > 8.0;
    if doubling {
        for layer in &mut lines {
            if let Shape::Thin(p) | Shape::Dots(p) = &mut layer.shape {
                p.iter_mut().for_each(|p| *p = (p.0.log2(), p.1.log2()));
            }
        }
    }
    let mut panel = panel(
        &format!("What an error costs, {:.0} ms one way", delay? * 1e3),
        "operator to robot / kbit/s, all headers",
        "tracking error / mm",
        lines,
    )?;
    panel.doubling = doubling;
    Some(Chart {
        name: "rate-distortion",
        caption: "Tracking error over what goes from operator to robot, with every header, acknowledgement and clock exchange of ours. Left and low is better.".into(),
        panel,
    })
}

fn points_of(layer: &Layer) -> &[(f64, f64)] {
    match &layer.shape {
        Shape::Thin(points) | Shape::Dots(points) => points,
        _ => &[],
    }
}

fn lags(view: &View<'_>) -> Option<Chart> {
    let delay = view.shown_delay_s();
    let link = view.shown_link()?;
    let mut layers = Vec::new();
    for method in view.methods() {
        let rows = view.shown("on-model", method).flat_map(|g| &g.rows);
        let lags = rows.filter_map(|row| Some(row.figures.lag_s? * 1e3));
        layers.extend(cdf(method, lags.collect()));
    }
    Some(Chart {
        name: "lag",
        caption: format!(
            "How many runs lag by no more than that, over {link}: the shift at which tip and hand agree best. Below zero the tip is early."
        ),
        panel: panel(
            &format!("Lag, {}", one_way(delay)),
            "lag / ms",
            "share of the runs",
            layers,
        )?,
    })
}

fn ages(view: &View<'_>) -> Option<Chart> {
    let delay = view.shown_delay_s();
    let link = view.shown_link()?;
    let mut layers = Vec::new();
    for method in view.methods() {
        let mut ages = Vec::new();
        for group in view.shown("on-model", method) {
            let course = view.course(group).unwrap_or_default();
            ages.extend(course.iter().filter_map(|m| Some(m.3? * 1e3)));
        }
        layers.extend(cdf(method, ages));
    }
    Some(Chart {
        name: "age",
        caption: format!(
            "How old what the arm follows is, of one person's runs over {link}. Telemime speaks only when it has to, so its news is older, and yet its error smaller."
        ),
        panel: panel(
            &format!("Age of information, {}", one_way(delay)),
            "age / ms",
            "share of the time",
            layers,
        )?,
    })
}

fn cdf(method: &str, mut values: Vec<f64>) -> Option<Layer> {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    // Enough for the eye.
    let step = n.div_ceil(300).max(1);
    let mut points = Vec::new();
    for (i, v) in values.iter().enumerate() {
        if i % step == 0 || i + 1 == n {
            points.push((*v, i as f64 / n as f64));
            points.push((*v, (i + 1) as f64 / n as f64));
        }
    }
    let shape = if method == "floor" {
        Shape::Dashed(points)
    } else {
        Shape::Line(points)
    };
    (n > 0).then(|| Layer::new(called(method), colour(method), shape))
}

/// Seconds around an outage, or in the middle of a run.
fn timeline(view: &View<'_>) -> Option<Chart> {
    let delay = view.shown_delay_s();
    let outages = view.groups.iter().filter_map(|g| {
        let text = g.text("outage");
        let settings = text.split_once("..")?;
        let seconds = |t: &str| telemime_sim::link::parse_duration_s(t).ok();
        Some((text.to_owned(), seconds(settings.0)?, seconds(settings.1)?))
    });
    // The longest that ends: what it does and what becomes of it both show.
    let outage = outages
        .filter(|(_, from, to)| to - from < 5.0)
        .max_by(|a, b| (a.2 - a.1).total_cmp(&(b.2 - b.1)));
    let of = |method: &'static str| {
        let groups = view.at("on-model", method, delay, &["outage"]);
        let wanted = |g: &&Group<'_>| match &outage {
            Some((text, ..)) => g.text("outage") == text,
            None => true,
        };
        groups
            .into_iter()
            .filter(wanted)
            .find_map(|g| view.course(g))
    };
    let (ours, hold) = (of("ours")?, of("hold"));
    let middle = ours[ours.len() / 2].0;
    let (from_s, to_s) = match &outage {
        Some((_, from, to)) => (from - 1.0, to + 1.2),
        None => (middle - 1.5, middle + 1.5),
    };
    let hand: Vec<_> = ours.iter().map(|m| m.1).collect();
    let (axis, mean) = principal_axis(&hand);
    let along = |course: &[Moment], tip: bool| -> Vec<(f64, f64)> {
        let seen = course.iter().filter(|m| (from_s..=to_s).contains(&m.0));
        seen.map(|m| {
            let x = if tip { m.2 } else { m.1 };
            (m.0, (x - mean).dot(&axis) * 1e3)
        })
        .collect()
    };
    let mut layers = Vec::new();
    let lines = [
        Some(Layer::new(
            "hand",
            BLACK,
            Shape::Dashed(along(&ours, false)),
        )),
        hold.map(|hold| {
            Layer::new(
                called("hold"),
                colour("hold"),
                Shape::Line(along(&hold, true)),
            )
        }),
        Some(Layer::new(
            called("ours"),
            colour("ours"),
            Shape::Line(along(&ours, true)),
        )),
    ];
    let lines: Vec<Layer> = lines.into_iter().flatten().collect();
    if let Some((_, from, to)) = &outage {
        let heights = lines.iter().flat_map(|l| match &l.shape {
            Shape::Line(p) | Shape::Dashed(p) => p.iter().map(|p| p.1).collect::<Vec<_>>(),
            _ => Vec::new(),
        });
        let (low, high) = heights.fold((f64::MAX, f64::MIN), |(l, h), y| (l.min(y), h.max(y)));
        layers.push(Layer::new(
            "link gone",
            GREY,
            Shape::Band(vec![(*from, low, high), (*to, low, high)]),
        ));
    }
    layers.extend(lines);
    let (title, caption) = match &outage {
        Some(_) => (
            "Around an outage",
            "Hand and tip along the motion's main axis. Without news the arm goes on as predicted, slower and slower, until its lease is over; then it holds, and never engages again by itself. Raw samples resume as if nothing had been.",
        ),
        None => (
            "Hand and tip",
            "Along the motion's main axis, three seconds of one run.",
        ),
    };
    Some(Chart {
        name: "timeline",
        caption: caption.into(),
        panel: panel(title, "time / s", "along the main axis / mm", layers)?,
    })
}

const AHEAD: [(f64, &str, &str); 4] = [
    (100.0 / 3.0, "predicted_33ms_m", "held_33ms"),
    (100.0, "predicted_100ms_m", "held_100ms"),
    (200.0, "predicted_200ms_m", "held_200ms"),
    (300.0, "predicted_300ms_m", "held_300ms"),
];

fn horizons(view: &View<'_>) -> Option<Chart> {
    let delay = view.shown_delay_s();
    let mut layers = Vec::new();
    for method in view.methods() {
        let groups: Vec<_> = view.at("on-model", method, delay, &[]).collect();
        let Some(group) = groups.first() else {
            continue;
        };
        let at = |(ms, name, _): (f64, &str, &str)| Some((ms, group.figure(name)?.mean * 1e3));
        let points: Vec<_> = AHEAD.into_iter().filter_map(at).collect();
        if !points.is_empty() {
            layers.push(Layer::new(
                called(method),
                colour(method),
                Shape::Line(points),
            ));
        }
    }
    Some(Chart {
        name: "horizon",
        caption: "How far off predictions are, without network and arm: each from every sample."
            .into(),
        panel: panel(
            "Prediction error by horizon",
            "ahead / ms",
            "RMS error / mm",
            layers,
        )?,
    })
}

fn calibration(view: &View<'_>) -> Option<Chart> {
    let delay = view.shown_delay_s();
    let mut layers = vec![Layer::new(
        "promised",
        BLACK,
        Shape::Dashed(vec![(AHEAD[0].0, 90.0), (AHEAD[3].0, 90.0)]),
    )];
    for ((motion, words), colour) in MOTIONS.into_iter().zip([colour("ours"), GREY]) {
        let groups: Vec<_> = view.at(motion, "ours", delay, &[]).collect();
        let Some(group) = groups.first() else {
            continue;
        };
        let points = AHEAD
            .into_iter()
            .filter_map(|(ms, _, name)| Some((ms, group.figure(name)?)));
        let points: Vec<_> = points.collect();
        if points.is_empty() {
            continue;
        }
        let band = points
            .iter()
            .map(|(ms, i)| (*ms, i.low * 100.0, i.high * 100.0));
        layers.push(Layer::new("", colour, Shape::Band(band.collect())));
        let line = points.iter().map(|(ms, i)| (*ms, i.mean * 100.0)).collect();
        layers.push(Layer::new(words, colour, Shape::Line(line)));
    }
    (layers.len() > 1).then_some(())?;
    Some(Chart {
        name: "calibration",
        caption:
            "Of what came, the share within the region that the predictor said would hold 90 %."
                .into(),
        panel: panel(
            "Calibration of Telemime's 90 % region",
            "ahead / ms",
            "held / %",
            layers,
        )?,
    })
}
