//! A skill as a picture: what was shown, the Gaussians it became, what is inferred from them and how sure that is.
//! The publication's figures 4 to 6, of any skill.

use std::path::PathBuf;

use anyhow::Context;
use nalgebra::{Matrix2, SymmetricEigen, Vector2, Vector3};
use plotters::style::RGBColor;
use telemime_operator::demonstration::{Demonstration, Demonstrations};
use telemime_operator::learn::align::{Aligned, align};
use telemime_operator::learn::tube::{BeforeAfter, Tube, proportional};
use telemime_operator::placed::Motion;
use telemime_protocol::pose;
use telemime_protocol::skill::{Component, Gmr, Skill, chi_squared_quantile};

use crate::figure::{
    AXES, BLACK, BLUE, Figure, GREEN, GREY, Layer, ORANGE, Panel, SILVER, SKY, Shape, VERMILLION,
};

/// Curves are drawn through this many steps.
const STEPS: u32 = 240;

/// An ellipse is drawn with this many corners; one of the many that a region sweeps over, with fewer.
const CORNERS: u32 = 48;
const SWEPT_CORNERS: u32 = 24;

/// More ellipses than this hide each other where a motion returns to the same places.
const MOST_IN_PLAN: usize = 24;

/// More demonstrations than this are drawn paler: together they would hide the region.
const FEW: usize = 10;

type Points = Vec<(f64, f64)>;

/// What to draw.
pub(crate) struct Subject<'a> {
    pub(crate) skill: &'a Skill,
    /// The motion, its frames where they are to be.
    pub(crate) motion: &'a Motion<'a>,
    /// The demonstrations it was learned from, where they are at hand.
    pub(crate) demonstrations: &'a [Demonstration],
    /// Another performance to compare with.
    pub(crate) truth: Option<&'a Demonstration>,
    /// Share of performances that the region is to hold.
    pub(crate) confidence: f64,
}

/// The demonstrations of `dir` that `skill` was learned from; all of them, said so, if it was from none.
pub(crate) fn learned_from(skill: &Skill, dir: &PathBuf) -> anyhow::Result<Vec<Demonstration>> {
    let all = Demonstrations::read_dir(dir, None)?.demonstrations;
    let (known, strange): (Vec<_>, Vec<_>) = all
        .into_iter()
        .partition(|d| skill.was_trained_on(d.sha256()));
    if known.is_empty() {
        eprintln!(
            "note: {} was learned from none of the recordings in {}; all of them are drawn",
            skill.name(),
            dir.display()
        );
        return Ok(strange);
    }
    Ok(known)
}

/// The page.
pub(crate) fn figure(subject: &Subject) -> anyhow::Result<Figure> {
    let aligned = match subject.demonstrations {
        [] => None,
        some => Some(align(some).context("the demonstrations cannot be aligned")?),
    };
    let mut panels = Vec::new();
    for d in 0..3 {
        panels.push(over_time(subject, aligned.as_ref(), d)?);
    }
    for (a, b) in [(0, 1), (0, 2), (2, 1)] {
        panels.push(plan_view(subject, aligned.as_ref(), a, b)?);
    }
    if let Some(aligned) = aligned.as_ref().filter(|a| a.paths.len() > 1) {
        panels.extend(before_and_after(subject, aligned));
    }
    panels.extend(turning(subject, aligned.as_ref())?);
    panels.extend(gripping(subject)?);
    let skill = subject.skill;
    let shown = match subject.demonstrations.len() {
        0 => String::new(),
        1 => "; one demonstration".to_owned(),
        n => format!("; {n} demonstrations, aligned"),
    };
    Ok(Figure {
        title: format!("Skill: {}", skill.name()),
        note: format!(
            "{} Gaussians over (t, x, y, z), regressed on time; regions and ellipses hold {} %{shown}",
            skill.motion().components().len(),
            percent(subject.confidence)
        ),
        columns: 3,
        panels,
    })
}

/// χ with so many degrees of freedom: the radius, in deviations, of the region that holds the share.
fn radius(subject: &Subject, degrees: u32) -> anyhow::Result<f64> {
    let radius2 = chi_squared_quantile(subject.confidence, degrees);
    Ok(radius2
        .context("--confidence must be at least 0 and below 1")?
        .sqrt())
}

fn region(subject: &Subject) -> String {
    format!("{} % region", percent(subject.confidence))
}

/// A share in percent, with no more digits than it has.
fn percent(share: f64) -> f64 {
    (share * 1e6).round() / 1e4
}

fn times_s(skill: &Skill) -> impl Iterator<Item = f64> {
    let end_s = skill.duration_s();
    (0..=STEPS).map(move |i| end_s * f64::from(i) / f64::from(STEPS))
}

/// The demonstrations on the skill's own time axis.
fn shown_layers(
    subject: &Subject,
    aligned: Option<&Aligned>,
    flat: impl Fn(f64, &Vector3<f64>) -> (f64, f64),
) -> Vec<Layer> {
    let Some(aligned) = aligned else {
        return Vec::new();
    };
    let stretch = subject.skill.duration_s() / aligned.duration_s;
    let layer = |(i, path): (usize, &Vec<Vector3<f64>>)| {
        let points = aligned.times_s.iter().zip(path);
        let points = points.map(|(t, x)| flat(t * stretch, x)).collect();
        Layer::new(
            if i == 0 { "demonstrations" } else { "" },
            shade(aligned.paths.len()),
            Shape::Thin(points),
        )
    };
    aligned.paths.iter().enumerate().map(layer).collect()
}

fn shade(demonstrations: usize) -> RGBColor {
    if demonstrations > FEW { SILVER } else { GREY }
}

fn over_time(subject: &Subject, aligned: Option<&Aligned>, d: usize) -> anyhow::Result<Panel> {
    let half = radius(subject, 1)?;
    let (mut mean, mut band) = (Points::new(), Vec::new());
    for t_s in times_s(subject.skill) {
        let at = subject.motion.at(t_s);
        let half = half * at.covariance[(d, d)].max(0.0).sqrt();
        mean.push((t_s, at.mean[d]));
        band.push((t_s, at.mean[d] - half, at.mean[d] + half));
    }
    let mut layers = vec![Layer::new(region(subject), SKY, Shape::Band(band))];
    layers.extend(shown_layers(subject, aligned, |t_s, x| (t_s, x[d])));
    if !subject.motion.is_moved() {
        layers.extend(ellipses(subject, [0, d + 1])?);
    }
    if let Some(truth) = subject.truth {
        let start_s = truth.samples()[0].t_s;
        let stretch = subject.skill.duration_s() / truth.duration_s();
        let points = truth.samples().iter();
        let points = points.map(|s| ((s.t_s - start_s) * stretch, s.position[d]));
        layers.push(Layer::new("truth", BLACK, Shape::Dashed(points.collect())));
    }
    layers.push(Layer::new("inferred", BLUE, Shape::Line(mean)));
    Ok(Panel {
        title: format!("{} over time", AXES[d]),
        x_label: "time / s".into(),
        y_label: format!("{} / m", AXES[d]),
        equal_axes: false,
        doubling: false,
        layers,
    })
}

fn plan_view(
    subject: &Subject,
    aligned: Option<&Aligned>,
    a: usize,
    b: usize,
) -> anyhow::Result<Panel> {
    let swept = Shape::Patches(swept(subject, a, b)?);
    let mut layers = vec![Layer::new(region(subject), SKY, swept)];
    layers.extend(shown_layers(subject, aligned, |_, x| (x[a], x[b])));
    let count = subject.skill.motion().components().len();
    if !subject.motion.is_moved() && count <= MOST_IN_PLAN {
        layers.extend(ellipses(subject, [a + 1, b + 1])?);
    }
    if let Some(truth) = subject.truth {
        let points = truth
            .samples()
            .iter()
            .map(|s| (s.position[a], s.position[b]));
        layers.push(Layer::new("truth", BLACK, Shape::Dashed(points.collect())));
    }
    let mean = times_s(subject.skill).map(|t_s| {
        let x = subject.motion.at(t_s).mean;
        (x[a], x[b])
    });
    layers.push(Layer::new("inferred", BLUE, Shape::Line(mean.collect())));
    Ok(Panel {
        title: format!("{}–{}", AXES[a], AXES[b]),
        x_label: format!("{} / m", AXES[a]),
        y_label: format!("{} / m", AXES[b]),
        equal_axes: true,
        doubling: false,
        layers,
    })
}

/// What the region of one moment sweeps over on its way to the next, for every moment.
fn swept(subject: &Subject, a: usize, b: usize) -> anyhow::Result<Vec<Points>> {
    let radius = radius(subject, 2)?;
    let outlines: Vec<Points> = times_s(subject.skill)
        .map(|t_s| {
            let at = subject.motion.at(t_s);
            let s = at.covariance;
            let block = Matrix2::new(s[(a, a)], s[(a, b)], s[(b, a)], s[(b, b)]);
            ellipse([at.mean[a], at.mean[b]], block, radius, SWEPT_CORNERS)
        })
        .collect();
    let pair = |w: &[Points]| hull(w.concat());
    Ok(outlines.windows(2).map(pair).collect())
}

/// The convex hull of points, by Andrew's monotone chain: the corners, counter-clockwise.
fn hull(mut points: Points) -> Points {
    points.sort_by(|p, q| p.0.total_cmp(&q.0).then(p.1.total_cmp(&q.1)));
    let half = |points: &mut dyn Iterator<Item = (f64, f64)>| {
        let mut chain = Points::new();
        for p in points {
            while let [.., o, q] = chain[..]
                && (q.0 - o.0) * (p.1 - o.1) <= (q.1 - o.1) * (p.0 - o.0)
            {
                chain.pop();
            }
            chain.push(p);
        }
        chain.pop();
        chain
    };
    let mut corners = half(&mut points.iter().copied());
    corners.extend(half(&mut points.iter().rev().copied()));
    corners
}

/// The points so many deviations from the mean, the first again at the end.
fn ellipse(mean: [f64; 2], covariance: Matrix2<f64>, radius: f64, corners: u32) -> Points {
    let eigen = SymmetricEigen::new(covariance);
    let reach = eigen.eigenvalues.map(|v| v.max(0.0).sqrt()) * radius;
    let corner = |i: u32| {
        let angle = std::f64::consts::TAU * f64::from(i) / f64::from(corners);
        let on_axes = Vector2::new(angle.cos(), angle.sin()).component_mul(&reach);
        let at = eigen.eigenvectors * on_axes;
        (mean[0] + at.x, mean[1] + at.y)
    };
    (0..=corners).map(corner).collect()
}

/// The mixture's components in two of its coordinates.
fn ellipses(subject: &Subject, of: [usize; 2]) -> anyhow::Result<Vec<Layer>> {
    let radius = radius(subject, 2)?;
    let layer = |(i, c): (usize, &Component<4>)| {
        let s = c.covariance();
        let block = Matrix2::from_fn(|a, b| s[(of[a], of[b])]);
        let outline = ellipse([c.mean()[of[0]], c.mean()[of[1]]], block, radius, CORNERS);
        let label = if i == 0 { "Gaussians" } else { "" };
        Layer::new(label, ORANGE, Shape::Thin(outline))
    };
    let components = subject.skill.motion().components();
    Ok(components.iter().enumerate().map(layer).collect())
}

/// The axis that differences of pace spread most, before and after alignment, at one standard deviation of the demonstrations.
fn before_and_after(subject: &Subject, aligned: &Aligned) -> [Panel; 2] {
    let tubes = BeforeAfter::of(subject.demonstrations, aligned);
    let points = aligned.times_s.len();
    let even = proportional(subject.demonstrations, points);
    let spread = |tube: &Tube| -> Vector3<f64> {
        let deviations = tube.covariance.iter().map(|c| c.diagonal().map(f64::sqrt));
        deviations.sum()
    };
    let d = (spread(&tubes.before) - spread(&tubes.after)).imax();
    let panel = |what: &str, tube: &Tube, paths: &[Vec<Vector3<f64>>]| {
        let last = (points - 1).max(1) as f64;
        let share = |i: usize| i as f64 / last;
        let band = tube.mean.iter().zip(&tube.covariance).enumerate();
        let band = band.map(|(i, (mean, covariance))| {
            let half = covariance[(d, d)].max(0.0).sqrt();
            (share(i), mean[d] - half, mean[d] + half)
        });
        let mut layers = vec![Layer::new(
            "one deviation",
            SKY,
            Shape::Band(band.collect()),
        )];
        for (n, path) in paths.iter().enumerate() {
            let points = path.iter().enumerate().map(|(i, x)| (share(i), x[d]));
            let label = if n == 0 { "demonstrations" } else { "" };
            layers.push(Layer::new(
                label,
                shade(paths.len()),
                Shape::Thin(points.collect()),
            ));
        }
        Panel {
            title: format!("{what}: {:.1} mm from their mean", tube.deviation_m() * 1e3),
            x_label: "share of the performance".into(),
            y_label: format!("{} / m", AXES[d]),
            equal_axes: false,
            doubling: false,
            layers,
        }
    };
    [
        panel("in proportional time", &tubes.before, &even),
        panel("aligned", &tubes.after, &aligned.paths),
    ]
}

/// The orientation as rotation vectors from where it begins.
fn turning(subject: &Subject, aligned: Option<&Aligned>) -> anyhow::Result<Option<Panel>> {
    let Some(turn) = subject.skill.turn() else {
        return Ok(None);
    };
    let half = radius(subject, 1)?;
    let start = turn.motion.query(0.0).mean;
    let degrees = |v: f64| v.to_degrees();
    let mut layers = Vec::new();
    let mut means = [Points::new(), Points::new(), Points::new()];
    let mut bands = [Vec::new(), Vec::new(), Vec::new()];
    for t_s in times_s(subject.skill) {
        let at = turn.motion.query(t_s);
        let mean = subject.motion.turn_at(t_s).unwrap_or(at.mean);
        let v = pose::between(&start, &mean);
        for d in 0..3 {
            let half = half * at.covariance[(d, d)].max(0.0).sqrt();
            means[d].push((t_s, degrees(v[d])));
            bands[d].push((t_s, degrees(v[d] - half), degrees(v[d] + half)));
        }
    }
    for (d, band) in bands.into_iter().enumerate() {
        let label = if d == 0 {
            region(subject)
        } else {
            String::new()
        };
        layers.push(Layer::new(label, SKY, Shape::Band(band)));
    }
    if let Some(aligned) = aligned {
        let stretch = subject.skill.duration_s() / aligned.duration_s;
        for (demo, warp_s) in subject.demonstrations.iter().zip(&aligned.warps_s) {
            let start_s = demo.samples()[0].t_s;
            for d in 0..3 {
                let points = aligned.times_s.iter().zip(warp_s).filter_map(|(t, own_s)| {
                    let q = demo.orientation_at(start_s + own_s)?;
                    Some((t * stretch, degrees(pose::between(&start, &q)[d])))
                });
                layers.push(Layer::new(
                    "",
                    shade(aligned.paths.len()),
                    Shape::Thin(points.collect()),
                ));
            }
        }
    }
    for ((d, mean), colour) in means.into_iter().enumerate().zip([BLUE, GREEN, VERMILLION]) {
        layers.push(Layer::new(
            format!("about {}", AXES[d]),
            colour,
            Shape::Line(mean),
        ));
    }
    Ok(Some(Panel {
        title: "orientation from where it begins".into(),
        x_label: "time / s".into(),
        y_label: "rotation vector / °".into(),
        equal_axes: false,
        doubling: false,
        layers,
    }))
}

fn gripping(subject: &Subject) -> anyhow::Result<Option<Panel>> {
    let Some(grip) = subject.skill.grip() else {
        return Ok(None);
    };
    let gmr = Gmr::<1, 1>::new(grip)?;
    let mean = times_s(subject.skill)
        .map(|t_s| (t_s, gmr.query(&[t_s].into()).mean[0].clamp(0.0, 1.0)))
        .collect();
    Ok(Some(Panel {
        title: "gripper".into(),
        x_label: "time / s".into(),
        y_label: "opening".into(),
        equal_axes: false,
        doubling: false,
        layers: vec![Layer::new("inferred", BLUE, Shape::Line(mean))],
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_ellipse_is_where_the_density_says() {
        let covariance = Matrix2::new(2.0, 0.9, 0.9, 0.5);
        let inverse = covariance.try_inverse().unwrap();
        let outline = ellipse([1.0, -2.0], covariance, 1.5, 48);
        assert_eq!(outline.first(), outline.last());
        for (x, y) in outline {
            let e = Vector2::new(x - 1.0, y + 2.0);
            assert!(((e.transpose() * inverse * e)[0].sqrt() - 1.5).abs() < 1e-9);
        }
        // Of no spread across, a line.
        let flat = ellipse([0.0, 0.0], Matrix2::new(4.0, 0.0, 0.0, 0.0), 1.0, 48);
        assert!(
            flat.iter()
                .all(|p| p.1.abs() < 1e-12 && p.0.abs() < 2.0 + 1e-12)
        );
    }

    #[test]
    fn a_hull_has_the_outer_points_and_no_others() {
        let square = [(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0)];
        let mut points: Points = square.to_vec();
        points.extend([(1.0, 1.0), (1.0, 0.0), (0.5, 1.5), (2.0, 2.0)]);
        assert_eq!(hull(points), square);
        assert!(hull(vec![(1.0, 1.0)]).len() <= 1);
        assert_eq!(hull(vec![(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)]).len(), 2);
    }
}
