//! The figure: right path, wrong time.

use nalgebra::Vector2;

use super::Series;
use super::codec::Coded;
use super::task::times;
use crate::figure::{BLACK, BLUE, Figure, GREY, Layer, Panel, SKY, Shape, VERMILLION};

type Points = Vec<(f64, f64)>;
/// A checkpoint: when, and where.
type Mark = (f64, Vector2<f64>);

/// What the figure shows of one task.
pub(super) struct Shown {
    pub(super) name: &'static str,
    /// Empty where only the series are known.
    pub(super) demonstrations: Vec<Series>,
    pub(super) truth: Series,
    /// The publication's method.
    pub(super) reproduced: Coded,
    /// Ours.
    pub(super) ours: Coded,
}

/// A row of panels for each task: the path, and both coordinates over time.
pub(super) fn figure(tasks: &[Shown]) -> Figure {
    Figure {
        title: "The publication's checkpoints: the path is right, the time is not".into(),
        note: "Its decoder takes checkpoints as control points over a uniform parameter; ours \
               interpolates them in time, within 0.5 % of the range of x₂ at every sample."
            .into(),
        columns: 3,
        panels: tasks.iter().flat_map(row).collect(),
    }
}

fn row(task: &Shown) -> [Panel; 3] {
    let t = times(task.truth.len());
    let over = |x: &[Vector2<f64>], d: usize| -> Points {
        t.iter().zip(x).map(|(t, x)| (*t, x[d])).collect()
    };
    let path = |x: &[Vector2<f64>]| -> Points { x.iter().map(|x| (x.x, x.y)).collect() };
    let curves = |view: &dyn Fn(&[Vector2<f64>]) -> Points| {
        vec![
            Layer::new(
                "published method",
                VERMILLION,
                Shape::Line(view(&task.reproduced.decoded)),
            ),
            Layer::new("truth", BLACK, Shape::Line(view(&task.truth))),
            Layer::new("ours", SKY, Shape::Dashed(view(&task.ours.decoded))),
        ]
    };
    let dots = |view: &dyn Fn(&Mark) -> (f64, f64)| {
        let points: Vec<_> = task.ours.checkpoints.iter().map(view).collect();
        let label = format!("our {} checkpoints", points.len());
        Layer::new(label, BLUE, Shape::Dots(points))
    };
    let rings = |view: &dyn Fn(&Mark) -> (f64, f64)| {
        let points: Vec<_> = task.reproduced.checkpoints.iter().map(view).collect();
        let label = format!("its {} checkpoints", points.len());
        Layer::new(label, VERMILLION, Shape::Rings(points))
    };
    let panel = |what: &str, x_label: &str, y_label: &str, layers| Panel {
        title: format!("{}: {what}", task.name.replace("task", "task ")),
        x_label: x_label.into(),
        y_label: y_label.into(),
        equal_axes: false,
        doubling: false,
        layers,
    };
    let mut in_time = curves(&|x| over(x, 1));
    if !task.demonstrations.is_empty() {
        let band = (0..t.len()).map(|i| {
            let at = task.demonstrations.iter().map(|d| d[i].y);
            let (low, high) = at.fold((f64::MAX, f64::MIN), |(l, h), y| (l.min(y), h.max(y)));
            (t[i], low, high)
        });
        let shape = Shape::Band(band.collect());
        in_time.insert(0, Layer::new("ten demonstrations", GREY, shape));
    }
    let mut as_path = curves(&path);
    as_path.push(rings(&|(_, x)| (x.x, x.y)));
    in_time.push(dots(&|(t, x)| (*t, x.y)));
    [
        panel("the path", "x₁", "x₂", as_path),
        panel(
            "x₁ over time",
            "time, run = 1",
            "x₁",
            curves(&|x| over(x, 0)),
        ),
        panel("x₂ over time", "time, run = 1", "x₂", in_time),
    ]
}
