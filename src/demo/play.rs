//! The publication's pipeline, run for real: inferred → checkpoints → rebuilt → tip.

use anyhow::Context;
use nalgebra::Vector3;
use serde::Serialize;
use telemime_operator::cli::{Event as Operator, PlayReport, Scores};
use telemime_operator::demonstration::Demonstrations;
use telemime_operator::learn::align::align;
use telemime_protocol::spline::{BSpline, End};
use telemime_robot::servo::Mapping;

use super::figures::{learned, load_skill, save, tube_panel};
use super::judge::{engagement, read_ticks};
use super::processes::Run;
use super::summary::{arm, deliver, servo};
use super::{Args, Material};
use crate::figure::{AXES, BLACK, BLUE, Figure, Layer, ORANGE, Panel, Shape, VERMILLION};
use crate::measure::Track;

/// Kept stable: fields are added, not changed.
#[derive(Debug, Serialize)]
struct Result {
    plan: PlayReport,
    arm: String,
    scale: f64,
    rebuilt_to_tip: Scores,
    tip_to_demonstrations: Scores,
    inferred_to_demonstrations: Scores,
    tick_mean_us: f64,
    tick_p99_us: f64,
}

/// What was sent, and what the tip made of it.
pub(super) struct Played {
    pub(super) plan: PlayReport,
    /// The plan as both ends rebuild it.
    pub(super) spline: BSpline<3>,
    pub(super) mapping: Mapping,
    pub(super) engaged_ns: i64,
    /// The tip over the time since the engage, mapped back to hand metres.
    pub(super) tip: Track,
}

pub(super) fn played(run: &Run) -> anyhow::Result<Played> {
    let plan = run.operator.iter().find_map(|e| {
        if let Operator::Plan(plan) = e {
            Some(plan)
        } else {
            None
        }
    });
    let plan = plan.context("the operator sent no plan")?.clone();
    let (mapping, engaged_ns) = engagement(run)?;
    let ticks = read_ticks(&run.ticks, engaged_ns)?;
    let tip = ticks.iter().map(|t| {
        (
            (t.mono_ns - engaged_ns) as f64 * 1e-9,
            mapping.unplace(t.tip_m),
        )
    });
    let tip = Track::new(tip.collect())?;
    let (t, x) = checkpoints(&plan);
    let spline = BSpline::<3>::interpolate(&t, &x, End::Natural)?;
    Ok(Played {
        plan,
        spline,
        mapping,
        engaged_ns,
        tip,
    })
}

fn checkpoints(plan: &PlayReport) -> (Vec<f64>, Vec<Vector3<f64>>) {
    let points = plan.points.iter();
    points.map(|(t, x)| (*t, Vector3::from(*x))).unzip()
}

pub(super) fn report(args: &Args, material: &Material, run: &Run) -> anyhow::Result<()> {
    let Played {
        plan,
        spline,
        mapping,
        tip,
        ..
    } = played(run)?;
    let (t, x) = checkpoints(&plan);
    let (start_s, end_s) = spline.span_s();
    let grid: Vec<f64> = (0..=400)
        .map(|i| start_s + (end_s - start_s) * f64::from(i) / 400.0)
        .collect();
    let rebuilt = grid
        .iter()
        .map(|&t| spline.eval(t).map(|jet| jet.x))
        .collect::<std::result::Result<Vec<_>, _>>()?;
    let followed: Vec<_> = grid.iter().map(|&t| tip.at(t)).collect();

    let skill = load_skill(run)?;
    let found = Demonstrations::read_dir(&material.demos, material.matching.as_deref())?;
    let aligned = align(&found.demonstrations)?;
    let of_demonstrations = |motion: &dyn Fn(f64) -> Vector3<f64>| {
        Scores::of_demonstrations(&aligned, |t_s| motion(t_s.clamp(start_s, end_s)))
    };
    let (tick_mean_us, tick_p99_us, _) = servo(run);
    let result = Result {
        arm: arm(run),
        scale: mapping.scale,
        rebuilt_to_tip: Scores::of(&rebuilt, &followed),
        tip_to_demonstrations: of_demonstrations(&|t| tip.at(t)),
        inferred_to_demonstrations: of_demonstrations(&|t| {
            spline.eval(t).map_or(x[0], |jet| jet.x)
        }),
        tick_mean_us,
        tick_p99_us,
        plan,
    };
    let panel = |d: usize| Panel {
        title: format!("{} over time", AXES[d]),
        x_label: "time / s".into(),
        y_label: format!("{} / m", AXES[d]),
        equal_axes: false,
        doubling: false,
        layers: vec![
            Layer::new(
                "rebuilt from the checkpoints",
                BLACK,
                Shape::Line(pairs(&grid, &rebuilt, d)),
            ),
            Layer::new("tip", BLUE, Shape::Dashed(pairs(&grid, &followed, d))),
            Layer::new(
                format!("{} checkpoints", x.len()),
                ORANGE,
                Shape::Dots(t.iter().zip(&x).map(|(t, x)| (*t, x[d])).collect()),
            ),
        ],
    };
    let error = grid
        .iter()
        .zip(rebuilt.iter().zip(&followed))
        .map(|(t, (a, b))| (*t, (a - b).norm() * 1e3));
    let error = Panel {
        title: "rebuilt motion to tip".into(),
        x_label: "time / s".into(),
        y_label: "distance / mm".into(),
        equal_axes: false,
        doubling: false,
        layers: vec![Layer::new("", VERMILLION, Shape::Line(error.collect()))],
    };
    let figure = Figure {
        title: format!(
            "{}: learned, inferred, compressed, played",
            result.plan.skill
        ),
        note: format!(
            "{} checkpoints ({} B) stand for {} samples; {} at scale {:.3}, mapped back to hand metres.",
            result.plan.checkpoints,
            result.plan.bytes,
            result.plan.samples,
            result.arm,
            result.scale
        ),
        columns: 3,
        panels: vec![
            panel(0),
            panel(1),
            panel(2),
            tube_panel(material, &skill, 0)?,
            tube_panel(material, &skill, 1)?,
            error,
        ],
    };
    let mut shown = save(args, &figure, "play")?;
    shown.extend(learned(args, material, &skill)?);
    deliver(args, table(&result), &result, &shown)
}

fn pairs(t: &[f64], x: &[Vector3<f64>], d: usize) -> Vec<(f64, f64)> {
    t.iter().zip(x).map(|(t, x)| (*t, x[d])).collect()
}

fn table(r: &Result) -> String {
    let row = |what: &str, s: &Scores| {
        format!(
            "{what:42} R² {:.6}   MAE {:7.3} mm   MSE {:10.4} mm²   max {:7.2} mm\n",
            s.r2,
            s.mae_m * 1e3,
            s.mse_m2 * 1e6,
            s.max_m * 1e3
        )
    };
    let p = &r.plan;
    let mut text = format!(
        "\n{}: {:.2} s, {} checkpoints ({} B) for {} samples, within {:.1} mm; {} at scale {:.3}\n\n",
        p.skill,
        p.duration_s,
        p.checkpoints,
        p.bytes,
        p.samples,
        p.bound_m * 1e3,
        r.arm,
        r.scale
    );
    text.push_str(&row("inferred → rebuilt", &p.rebuilt));
    text.push_str(&row("rebuilt → tip", &r.rebuilt_to_tip));
    text.push_str(&row(
        "aligned demonstrations → tip (mean)",
        &r.tip_to_demonstrations,
    ));
    text.push_str(&row(
        "aligned demonstrations → inferred (mean)",
        &r.inferred_to_demonstrations,
    ));
    text.push_str(&format!(
        "\nservo {:.1} µs a tick, {:.1} µs p99\n",
        r.tick_mean_us, r.tick_p99_us
    ));
    text
}
