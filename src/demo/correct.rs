//! Play with corrections: a generated hand beside a played motion, and what the arm made of both.

use std::path::PathBuf;

use anyhow::Context;
use nalgebra::{SVector, Vector3};
use serde::Serialize;
use telemime_operator::cli::{Event as Operator, PlayReport, Scores};
use telemime_operator::demonstration::{Demonstration, Sample};
use telemime_operator::session::{Bent, LOST_S};
use telemime_protocol::skill::{Gmr, chi_squared_quantile};
use telemime_protocol::time::Stamp;
use telemime_sim::hand::{carry, push};

use super::figures::{load_skill, save};
use super::play::{Played, played};
use super::processes::Run;
use super::summary::{arm, deliver, servo};
use super::{Args, Material};
use crate::figure::{
    AXES, BLACK, BLUE, Figure, GREEN, GREY, Layer, ORANGE, Panel, SKY, Shape, VERMILLION,
};

/// Where something is carried to, m, and how long that takes, s.
const GOAL_M: [f64; 3] = [0.35, -0.1, 2.0];
const CARRY_S: f64 = 5.0;

/// How far the hand pushes aside, and how far against the motion, m.
const ASIDE_M: f64 = 0.06;
const AGAINST_M: f64 = 0.3;

/// How long it takes to push aside, and how long it stays there, s.
const RISE_S: f64 = 0.4;
const HOLD_S: f64 = 0.8;

/// Share of performances that the region drawn is to hold.
const SHARE: f64 = 0.9;

/// Kept stable: fields are added, not changed.
#[derive(Debug, Serialize)]
struct Result {
    plan: PlayReport,
    arm: String,
    scale: f64,
    corrections: Vec<Correction>,
    /// The plan as bent by what the robot was told, against the tip.
    told_to_tip: Scores,
    /// How much later than uncorrected the plan was played to its end, s.
    late_s: f64,
    messages: u32,
    tick_mean_us: f64,
    tick_p99_us: f64,
}

/// One hold of the hand; times in s since the robot engaged.
#[derive(Debug, Clone, Serialize)]
struct Correction {
    grabbed_s: f64,
    taken_over_s: Option<f64>,
    released_s: f64,
    /// The hand from where it took hold to where it let go, m.
    hand_m: f64,
    /// The tip beside the plan when it let go, hand metres.
    tip_m: f64,
    /// The hand's share then, averaged over the axes.
    share: f64,
    /// Least plan seconds per second meanwhile.
    slowest: f64,
}

/// A performance to learn from.
pub(super) fn demonstration(seed: u64, index: u32) -> Vec<Sample> {
    let path = carry(seed, index, GOAL_M, CARRY_S).into_iter();
    path.map(|(t_s, x)| Sample::at(t_s, Vector3::from(x)))
        .collect()
}

/// Writes what the hand does while a skill like this is played: aside early on, against it in the middle until it drives
/// alone, aside again before the end.
pub(super) fn hand(args: &Args, material: &Material) -> anyhow::Result<PathBuf> {
    let recording = &material.recording;
    let span_s = recording.duration_s();
    let velocity = |t_s: f64| {
        let x = |t_s| recording.position_at(t_s);
        (x(t_s + 0.1) - x(t_s - 0.1)) / 0.2
    };
    // To the side: at right angles to where the motion leads while it is pushed, first and then.
    let aside = |t_s: f64| -> [f64; 3] {
        let [a, b, c] = [0.0, 0.5, 1.0].map(|u| recording.position_at(t_s + u * (RISE_S + HOLD_S)));
        let side = (b - a).cross(&(c - b)).try_normalize(1e-9);
        (side.unwrap_or_else(Vector3::y) * ASIDE_M).into()
    };
    let against = |t_s: f64| -> [f64; 3] {
        let direction = velocity(t_s).try_normalize(1e-6);
        (direction.unwrap_or_else(Vector3::x) * -AGAINST_M).into()
    };
    let (early_s, middle_s) = (0.1 * span_s, 0.45 * span_s);
    // The plan has waited for a while by then.
    let late_s = 0.62 * span_s + 2.0;
    let pushes = [
        push(args.seed, early_s, aside(early_s), RISE_S, HOLD_S),
        push(args.seed, middle_s, against(middle_s), 0.8, 1.2),
        push(args.seed, late_s, aside(0.62 * span_s), RISE_S, HOLD_S),
    ];
    let samples: Vec<_> = pushes
        .iter()
        .flatten()
        .map(|(t_s, x)| Sample::at(*t_s, Vector3::from(*x)))
        .collect();
    let path = args.out.join("corrections.csv");
    let mut text = "t,x,y,z\n".to_owned();
    for s in &samples {
        let p = s.position;
        text += &format!("{},{},{},{}\n", s.t_s, p.x, p.y, p.z);
    }
    std::fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(path)
}

pub(super) fn report(args: &Args, material: &Material, run: &Run) -> anyhow::Result<()> {
    let played = played(run)?;
    let path = material.correction.as_ref().context("no hand to correct")?;
    let hand = Demonstration::read_beside(path)?;
    let holds: Vec<&[Sample]> = hand
        .samples()
        .chunk_by(|a, b| b.t_s - a.t_s <= LOST_S)
        .collect();
    let told = told(run, played.engaged_ns);
    let marks = marks(run, played.engaged_ns);
    let (plan_end_s, tip_end_s) = (played.spline.span_s().1, played.tip.span_s().1);
    let grid: Vec<f64> = (0..=900)
        .map(|i| tip_end_s * f64::from(i) / 900.0)
        .filter(|&t_s| at(&told, t_s).plan_s <= plan_end_s)
        .collect();
    let plan_at = |t_s: f64| plan(&played, at(&told, t_s).plan_s);
    let meant: Vec<_> = grid
        .iter()
        .map(|&t_s| plan_at(t_s) + at(&told, t_s).offset_m)
        .collect();
    let followed: Vec<_> = grid.iter().map(|&t_s| played.tip.at(t_s)).collect();
    let mut corrections = Vec::new();
    for hold in &holds {
        let (first, last) = (&hold[0], &hold[hold.len() - 1]);
        let within = |t_s: f64| (first.t_s..=last.t_s + 0.1).contains(&t_s);
        let meanwhile = || told.iter().filter(|told| within(told.at.as_secs_f64()));
        let Some(newest) = meanwhile().next_back() else {
            continue;
        };
        let taken = marks
            .iter()
            .find(|(what, t_s)| what == "taken over" && within(*t_s));
        corrections.push(Correction {
            grabbed_s: first.t_s,
            taken_over_s: taken.map(|(_, t_s)| *t_s),
            released_s: last.t_s,
            hand_m: (last.position - first.position).norm(),
            tip_m: (played.tip.at(last.t_s) - plan_at(last.t_s)).norm(),
            share: newest.share,
            slowest: meanwhile().map(|told| told.rate).fold(f64::MAX, f64::min),
        });
    }
    let finished_s = grid.last().copied().unwrap_or_default();
    let messages = run.operator.iter().find_map(|e| match e {
        Operator::Done { messages, .. } => Some(*messages),
        _ => None,
    });
    let (tick_mean_us, tick_p99_us, _) = servo(run);
    let result = Result {
        arm: arm(run),
        scale: played.mapping.scale,
        told_to_tip: Scores::of(&meant, &followed),
        late_s: finished_s - plan_end_s,
        messages: messages.unwrap_or_default(),
        corrections,
        tick_mean_us,
        tick_p99_us,
        plan: played.plan.clone(),
    };
    let figure = figure(run, &played, &holds, &told, &marks, &grid, &result)?;
    let shown = save(args, &figure, "correct")?;
    deliver(args, table(&result), &result, &shown)
}

/// What the robot was told, at the arm's time since the engage; first of all to play the plan as it is.
fn told(run: &Run, engaged_ns: i64) -> Vec<Bent> {
    let unbent = Bent {
        at: Stamp::ZERO,
        plan_s: 0.0,
        rate: 1.0,
        hand_m: None,
        offset_m: Vector3::zeros(),
        share: 0.0,
    };
    let told = run.operator.iter().filter_map(|e| match e {
        Operator::Bent {
            plan_s,
            rate,
            share,
            hand_m,
            offset_m,
            mono_ns,
        } => Some(Bent {
            at: Stamp(mono_ns - engaged_ns),
            plan_s: *plan_s,
            rate: *rate,
            hand_m: hand_m.map(Vector3::from),
            offset_m: Vector3::from(*offset_m),
            share: *share,
        }),
        _ => None,
    });
    std::iter::once(unbent).chain(told).collect()
}

/// What the hand did, and when it did.
fn marks(run: &Run, engaged_ns: i64) -> Vec<(String, f64)> {
    let marks = run.operator.iter().filter_map(|e| match e {
        Operator::Correction { what, mono_ns } => {
            Some((what.clone(), (mono_ns - engaged_ns) as f64 * 1e-9))
        }
        _ => None,
    });
    marks.collect()
}

fn at(told: &[Bent], t_s: f64) -> Bent {
    Bent::among(told, Stamp::from_secs_f64(t_s)).unwrap_or(told[0])
}

fn plan(played: &Played, plan_s: f64) -> Vector3<f64> {
    let (start_s, end_s) = played.spline.span_s();
    let jet = played.spline.eval(plan_s.clamp(start_s, end_s));
    jet.map_or_else(|_| Vector3::zeros(), |jet| jet.x)
}

fn figure(
    run: &Run,
    played: &Played,
    holds: &[&[Sample]],
    told: &[Bent],
    marks: &[(String, f64)],
    grid: &[f64],
    result: &Result,
) -> anyhow::Result<Figure> {
    let skill = load_skill(run)?;
    let gmr = Gmr::<1, 3>::new(skill.motion())?;
    let radius = chi_squared_quantile(SHARE, 1).unwrap_or_default().sqrt();
    let over = |title: String, y_label: String, mut layers: Vec<Layer>| {
        let heights = layers.iter().flat_map(|layer| heights(&layer.shape));
        let (low, high) = heights.fold((f64::MAX, f64::MIN), |(l, h), y| (l.min(y), h.max(y)));
        for (what, colour) in [
            ("grabbed", GREEN),
            ("taken over", VERMILLION),
            ("released", GREY),
        ] {
            let at = marks.iter().filter(|(w, _)| w == what);
            for (i, (_, t_s)) in at.enumerate() {
                let label = if i == 0 { what } else { "" };
                let line = vec![(*t_s, low), (*t_s, high)];
                layers.push(Layer::new(label, colour, Shape::Thin(line)));
            }
        }
        Panel {
            title,
            x_label: "time since the engage / s".into(),
            y_label,
            layers,
            ..Panel::default()
        }
    };
    let axis = |d: usize| {
        let series = |f: &dyn Fn(f64) -> f64| grid.iter().map(|&t_s| (t_s, f(t_s))).collect();
        let plan_at = |t_s: f64| plan(played, at(told, t_s).plan_s)[d];
        let band = grid.iter().map(|&t_s| {
            let open = gmr.query(&SVector::from([at(told, t_s).plan_s]));
            let half = radius * open.covariance[(d, d)].max(0.0).sqrt();
            (t_s, plan_at(t_s) - half, plan_at(t_s) + half)
        });
        let mut layers = vec![
            Layer::new("90 % of performances", SKY, Shape::Band(band.collect())),
            Layer::new("plan", BLACK, Shape::Line(series(&plan_at))),
        ];
        for (i, hold) in holds.iter().enumerate() {
            let moved = |s: &Sample| (s.t_s, plan_at(s.t_s) + (s.position - hold[0].position)[d]);
            let label = if i == 0 { "hand" } else { "" };
            let line = Shape::Line(hold.iter().map(moved).collect());
            layers.push(Layer::new(label, ORANGE, line));
        }
        let tip = series(&|t_s| played.tip.at(t_s)[d]);
        layers.push(Layer::new("tip", BLUE, Shape::Line(tip)));
        over(
            format!("{} over time", AXES[d]),
            format!("{} / m", AXES[d]),
            layers,
        )
    };
    let end_s = grid.last().copied().unwrap_or_default();
    let all = || told.iter().map(|told| (told.at.as_secs_f64(), told));
    let within = || all().filter(move |(t_s, _)| *t_s <= end_s);
    let share = within().map(|(t_s, told)| (t_s, told.share));
    let rate = within().map(|(t_s, told)| (t_s, told.rate));
    let ratios = over(
        "what the robot is told".into(),
        "share, rate".into(),
        vec![
            Layer::new("the hand's share", ORANGE, Shape::Line(share.collect())),
            Layer::new("rate of the plan", BLACK, Shape::Line(rate.collect())),
        ],
    );
    Ok(Figure {
        title: format!("{}: played, and corrected by hand", result.plan.skill),
        note: format!(
            "A hand pushes {:.0} cm aside, holds against the motion until it drives alone, pushes aside again; {} at scale {:.3}, in hand metres.",
            ASIDE_M * 1e2,
            result.arm,
            result.scale
        ),
        columns: 2,
        panels: vec![axis(0), axis(1), axis(2), ratios],
    })
}

fn heights(shape: &Shape) -> Vec<f64> {
    match shape {
        Shape::Line(points) => points.iter().map(|p| p.1).collect(),
        Shape::Band(points) => points.iter().flat_map(|p| [p.1, p.2]).collect(),
        _ => Vec::new(),
    }
}

fn table(r: &Result) -> String {
    let p = &r.plan;
    let mut text = format!(
        "\n{}: {:.2} s in {} checkpoints ({} B), corrected by hand; {} at scale {:.3}\n\n",
        p.skill, p.duration_s, p.checkpoints, p.bytes, r.arm, r.scale
    );
    for c in &r.corrections {
        let taken = match c.taken_over_s {
            Some(t_s) => format!(", took over at {t_s:.2} s"),
            None => String::new(),
        };
        text.push_str(&format!(
            "hand          from {:.2} to {:.2} s: {:.0} mm, the tip {:.0} mm beside the plan (share {:.2}, slowest rate {:.2}){taken}\n",
            c.grabbed_s,
            c.released_s,
            c.hand_m * 1e3,
            c.tip_m * 1e3,
            c.share,
            c.slowest
        ));
    }
    let s = &r.told_to_tip;
    text.push_str(&format!(
        "told → tip    R² {:.5}, MAE {:.2} mm, max {:.1} mm (hand)\n\
         finished      {:.2} s later than uncorrected, {} messages\n\
         servo         {:.1} µs a tick, {:.1} µs p99\n",
        s.r2,
        s.mae_m * 1e3,
        s.max_m * 1e3,
        r.late_s,
        r.messages,
        r.tick_mean_us,
        r.tick_p99_us
    ));
    text
}
