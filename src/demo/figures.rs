//! The demo's pictures.

use std::path::PathBuf;

use anyhow::Context;
use nalgebra::{SVector, Vector3};
use telemime_operator::cli::Event as Operator;
use telemime_operator::demonstration::Demonstrations;
use telemime_operator::learn::align::align;
use telemime_operator::placed::Motion;
use telemime_operator::skill_file;
use telemime_protocol::skill::{Gmr, Skill, chi_squared_quantile};

use super::judge::{Verdict, joined};
use super::processes::Run;
use super::{Args, Material};
use crate::figure::{
    AXES, BLACK, BLUE, Figure, GREEN, GREY, Layer, ORANGE, Panel, SKY, Shape, VERMILLION,
};
use crate::measure::Track;
use crate::picture::{self, Subject};

/// Share of performances that the region drawn is to hold.
const SHARE: f64 = 0.9;

/// Curves are drawn through this many points.
const POINTS: usize = 700;

type Points = Vec<(f64, f64)>;

fn axis_label(d: usize) -> String {
    format!("{} / m", AXES[d])
}

fn along(track: &Track, grid_s: &[f64], d: usize) -> Points {
    let step = (grid_s.len() / POINTS).max(1);
    grid_s
        .iter()
        .step_by(step)
        .map(|&t| (t, track.at(t)[d]))
        .collect()
}

/// The two axes with the most motion, the wider first.
fn widest(truth: &Track) -> (usize, usize) {
    let first = truth.points()[0].1;
    let (low, high) = truth
        .points()
        .iter()
        .fold((first, first), |(l, h), (_, x)| (l.inf(x), h.sup(x)));
    let span = high - low;
    let mut order = [0, 1, 2];
    order.sort_by(|a, b| span[*b].total_cmp(&span[*a]));
    (order[0], order[1])
}

/// The axis along which the hand travels farthest, to and fro.
fn busiest(truth: &Track) -> usize {
    let travel = truth
        .points()
        .windows(2)
        .map(|w| (w[1].1 - w[0].1).abs())
        .fold(Vector3::zeros(), |sum: Vector3<f64>, step| sum + step);
    travel.imax()
}

pub(super) fn load_skill(run: &Run) -> anyhow::Result<Skill> {
    skill_file::load(&run.skill).with_context(|| "the learned skill".to_owned())
}

/// What was learned: the mean, the region that should hold 90 % of performances, the demonstrations.
pub(super) fn tube_panel(material: &Material, skill: &Skill, d: usize) -> anyhow::Result<Panel> {
    let gmr = Gmr::<1, 3>::new(skill.motion())?;
    let found = Demonstrations::read_dir(&material.demos, material.matching.as_deref())?;
    let mut learned = found.demonstrations;
    learned.retain(|demo| skill.was_trained_on(demo.sha256()));
    let aligned = align(&learned)?;
    let times = (0..=200).map(|i| skill.duration_s() * f64::from(i) / 200.0);
    let radius = chi_squared_quantile(SHARE, 1).unwrap_or_default().sqrt();
    let (mut mean, mut band) = (Vec::new(), Vec::new());
    for t in times {
        let at = gmr.query(&SVector::from([t]));
        let half = radius * at.covariance[(d, d)].max(0.0).sqrt();
        mean.push((t, at.mean[d]));
        band.push((t, at.mean[d] - half, at.mean[d] + half));
    }
    let mut layers = vec![Layer::new("90 % region", SKY, Shape::Band(band))];
    for (i, path) in aligned.paths.iter().enumerate() {
        let points = aligned
            .times_s
            .iter()
            .zip(path)
            .map(|(t, x)| (*t, x[d]))
            .collect();
        let label = if i == 0 {
            format!("{} demonstrations", aligned.paths.len())
        } else {
            String::new()
        };
        layers.push(Layer::new(label, GREY, Shape::Line(points)));
    }
    layers.push(Layer::new("inferred motion", BLUE, Shape::Line(mean)));
    Ok(Panel {
        title: "what was learned".into(),
        x_label: "time / s".into(),
        y_label: axis_label(d),
        equal_axes: false,
        doubling: false,
        layers,
    })
}

fn path_panel(run: &Run, verdict: &Verdict, (a, b): (usize, usize)) -> Panel {
    let flat = |x: &Vector3<f64>| (x[a], x[b]);
    let mut curve = Vec::new();
    for pair in verdict.path.windows(2) {
        let span_s = pair[1].0.t.secs_since(pair[0].0.t);
        let Some(span) = joined(&pair[0], &pair[1]) else {
            continue;
        };
        curve.extend(
            (0..8)
                .filter_map(|i| span.eval(span_s * f64::from(i) / 8.0))
                .map(|jet| flat(&jet.x)),
        );
    }
    let bound_m = run.operator.iter().find_map(|e| match e {
        Operator::Mapping { path_bound_m, .. } => Some(*path_bound_m),
        _ => None,
    });
    let hand = verdict
        .truth
        .points()
        .iter()
        .map(|(_, x)| flat(x))
        .collect();
    let dots = verdict.path.iter().map(|(k, _)| flat(&k.x)).collect();
    let bound_m = bound_m.unwrap_or(0.0);
    Panel {
        title: "the path, as the robot holds it".into(),
        x_label: axis_label(a),
        y_label: axis_label(b),
        equal_axes: true,
        doubling: false,
        layers: vec![
            Layer::new(
                format!("± {:.0} mm promised", bound_m * 1e3),
                SKY,
                Shape::Tube(curve, bound_m),
            ),
            Layer::new("hand", GREY, Shape::Line(hand)),
            Layer::new(
                format!("{} checkpoints", verdict.path.len()),
                ORANGE,
                Shape::Dots(dots),
            ),
        ],
    }
}

/// Draws the mirror's page as PNG and SVG; returns where.
pub(super) fn mirror(
    args: &Args,
    material: &Material,
    run: &Run,
    verdict: &Verdict,
) -> anyhow::Result<Vec<PathBuf>> {
    let over_time = |d: usize| Panel {
        title: format!("{}: hand, and tip mapped back to it", AXES[d]),
        x_label: "time / s".into(),
        y_label: axis_label(d),
        equal_axes: false,
        doubling: false,
        layers: vec![
            Layer::new(
                "delayed",
                VERMILLION,
                Shape::Dashed(along(&verdict.delayed_arm.track, &verdict.grid_s, d)),
            ),
            Layer::new(
                "hand",
                BLACK,
                Shape::Line(along(&verdict.truth, &verdict.grid_s, d)),
            ),
            Layer::new(
                "predicted",
                BLUE,
                Shape::Line(along(&verdict.predicted.track, &verdict.grid_s, d)),
            ),
        ],
    };
    let error = |track: &Track| -> Points {
        let step = (verdict.grid_s.len() / POINTS).max(1);
        let times = verdict.grid_s.iter().step_by(step);
        times
            .map(|&t| (t, (track.at(t) - verdict.truth.at(t)).norm()))
            .collect()
    };
    let errors = Panel {
        title: "distance from the hand".into(),
        x_label: "time / s".into(),
        y_label: "distance / m".into(),
        equal_axes: false,
        doubling: false,
        layers: vec![
            Layer::new(
                "delayed",
                VERMILLION,
                Shape::Line(error(&verdict.delayed_arm.track)),
            ),
            Layer::new(
                "predicted",
                BLUE,
                Shape::Line(error(&verdict.predicted.track)),
            ),
            Layer::new(
                "perfect knowledge",
                GREEN,
                Shape::Line(error(&verdict.floor.track)),
            ),
        ],
    };
    let plane = widest(&verdict.truth);
    let skill = load_skill(run)?;
    let link = args.link.describe();
    let figure = Figure {
        title: format!(
            "The tip is {:.0} mm off the hand; without prediction it is {:.0} mm",
            verdict.predicted.rmse_m * 1e3,
            verdict.delayed_arm.rmse_m * 1e3
        ),
        note: format!(
            "{}; {link}. All through the same arm at scale {:.3}; distances in hand metres, RMS.",
            material.what, verdict.mapping.scale
        ),
        columns: 3,
        panels: vec![
            over_time(0),
            over_time(1),
            over_time(2),
            path_panel(run, verdict, plane),
            errors,
            tube_panel(material, &skill, busiest(&verdict.truth))?,
        ],
    };
    let mut shown = save(args, &figure, "mirror")?;
    shown.extend(learned(args, material, &skill)?);
    Ok(shown)
}

/// The picture of what was learned.
pub(super) fn learned(
    args: &Args,
    material: &Material,
    skill: &Skill,
) -> anyhow::Result<Vec<PathBuf>> {
    let subject = Subject {
        skill,
        motion: &Motion::new(skill, &[])?,
        demonstrations: &picture::learned_from(skill, &material.demos)?,
        truth: None,
        confidence: 0.95,
    };
    save(args, &picture::figure(&subject)?, "skill")
}

/// Writes a figure under the output folder as PNG and SVG.
pub(super) fn save(args: &Args, figure: &Figure, name: &str) -> anyhow::Result<Vec<PathBuf>> {
    let paths: Vec<_> = ["png", "svg"]
        .iter()
        .map(|end| args.out.join(format!("{name}.{end}")))
        .collect();
    for path in &paths {
        figure.write(path)?;
    }
    Ok(paths)
}
