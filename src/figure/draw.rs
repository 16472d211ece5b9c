//! From a [`Figure`] to pixels and paths.

use std::path::Path;

use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::theme::{
    AXIS, DOT, FONT, GRID, INK, LABEL, LINE, MARGIN, NOTE, PANEL, PANEL_TITLE, SOFT_INK, THIN,
    TICK, TITLE, load_font, pale,
};
use super::{Figure, FigureError, Layer, Panel, Shape};

type Axes<'a, DB> = ChartContext<'a, DB, Cartesian2d<RangedCoordf64, RangedCoordf64>>;
type Drawn = Result<(), FigureError>;

/// SVG: the backend knows whole units only, so the page is drawn this much larger than it is shown.
const SVG_SCALE: u32 = 8;

/// PNG: drawn this many times larger than it is written, then averaged, because the bitmap backend
/// draws its lines without smoothing.
const OVERSAMPLE: u32 = 2;
const PNG_SCALE: u32 = 2;

pub(super) fn svg(figure: &Figure) -> Result<String, FigureError> {
    let mut text = String::new();
    let (w, h) = size(figure)?;
    let (large_w, large_h) = (w * SVG_SCALE, h * SVG_SCALE);
    let root = SVGBackend::with_string(&mut text, (large_w, large_h)).into_drawing_area();
    page(figure, &root, f64::from(SVG_SCALE))?;
    root.present().map_err(draw_error)?;
    drop(root);
    // Its view box stays; the size it is shown at is the page's.
    let drawn = format!("width=\"{large_w}\" height=\"{large_h}\"");
    Ok(text.replacen(&drawn, &format!("width=\"{w}\" height=\"{h}\""), 1))
}

pub(super) fn png(figure: &Figure, path: &Path) -> Drawn {
    let (w, h) = size(figure)?;
    let (w, h) = (w * PNG_SCALE, h * PNG_SCALE);
    let (large_w, large_h) = (w * OVERSAMPLE, h * OVERSAMPLE);
    let mut large = vec![0; (large_w * large_h * 3) as usize];
    {
        let root = BitMapBackend::with_buffer(&mut large, (large_w, large_h)).into_drawing_area();
        page(figure, &root, f64::from(PNG_SCALE * OVERSAMPLE))?;
        root.present().map_err(draw_error)?;
    }
    let small = averaged(&large, large_w as usize, OVERSAMPLE as usize);
    let mut file = BitMapBackend::new(path, (w, h));
    file.blit_bitmap((0, 0), (w, h), &small)
        .map_err(draw_error)?;
    // What is drawn is in memory: all that can fail now is the file.
    file.present().map_err(|e| FigureError::Write {
        path: path.to_owned(),
        source: std::io::Error::other(e),
    })
}

/// Blocks of `factor`² RGB pixels averaged.
fn averaged(large: &[u8], width: usize, factor: usize) -> Vec<u8> {
    let rows: Vec<&[u8]> = large.chunks_exact(width * 3).collect();
    let mut small = Vec::with_capacity(large.len() / (factor * factor));
    for block in rows.chunks_exact(factor) {
        for x in 0..width / factor {
            for channel in 0..3 {
                let sum: usize = block
                    .iter()
                    .flat_map(|row| (0..factor).map(move |dx| row[(x * factor + dx) * 3 + channel]))
                    .map(usize::from)
                    .sum();
                small.push(((sum + factor * factor / 2) / (factor * factor)) as u8);
            }
        }
    }
    small
}

fn header(figure: &Figure) -> i32 {
    let line = |text: &str, size: f64| {
        if text.is_empty() {
            0
        } else {
            (size * 1.45) as i32
        }
    };
    MARGIN + line(&figure.title, TITLE) + line(&figure.note, NOTE)
}

fn size(figure: &Figure) -> Result<(u32, u32), FigureError> {
    if figure.panels.is_empty() {
        return Err(FigureError::Empty(figure.title.clone()));
    }
    let columns = figure.columns.clamp(1, figure.panels.len());
    let rows = figure.panels.len().div_ceil(columns);
    let margin = MARGIN as u32;
    Ok((
        PANEL.0 * columns as u32 + 2 * margin,
        PANEL.1 * rows as u32 + header(figure) as u32 + margin,
    ))
}

fn page<DB: DrawingBackend>(figure: &Figure, root: &DrawingArea<DB, Shift>, k: f64) -> Drawn
where
    DB::ErrorType: 'static,
{
    if !load_font() {
        return Err(FigureError::Draw("the embedded font cannot be read".into()));
    }
    let px = |units: f64| (units * k).round() as i32;
    root.fill(&WHITE).map_err(draw_error)?;
    let left = px(f64::from(MARGIN));
    root.draw_text(
        &figure.title,
        &text(TITLE * k, INK),
        (left, px(f64::from(MARGIN) * 0.8)),
    )
    .map_err(draw_error)?;
    let note_y = f64::from(header(figure)) - NOTE * 1.7;
    root.draw_text(&figure.note, &text(NOTE * k, SOFT_INK), (left, px(note_y)))
        .map_err(draw_error)?;
    let columns = figure.columns.clamp(1, figure.panels.len());
    let (w, h) = (f64::from(PANEL.0), f64::from(PANEL.1));
    for (i, one) in figure.panels.iter().enumerate() {
        let x = f64::from(MARGIN) + w * (i % columns) as f64;
        let y = f64::from(header(figure)) + h * (i / columns) as f64;
        panel(one, &root.clone().shrink((px(x), px(y)), (px(w), px(h))), k)?;
    }
    Ok(())
}

fn panel<DB: DrawingBackend>(panel: &Panel, area: &DrawingArea<DB, Shift>, k: f64) -> Drawn
where
    DB::ErrorType: 'static,
{
    let px = |units: f64| (units * k).round() as i32;
    let (label_w, label_h, right, bottom) = (px(54.0), px(38.0), px(16.0), px(10.0));
    let mut top = px(10.0);
    if !panel.title.is_empty() {
        area.draw_text(&panel.title, &text(PANEL_TITLE * k, INK), (label_w, top))
            .map_err(draw_error)?;
        top += px(PANEL_TITLE * 1.5);
    }
    top = legend(panel, area, (label_w, top), k)? + px(4.0);
    let (w, h) = area.dim_in_pixel();
    let plot = (
        w as i32 - label_w - right,
        h as i32 - top - label_h - bottom,
    );
    let (x, y) = ranges(panel, f64::from(plot.0) / f64::from(plot.1))?;
    let decimals = |r: &std::ops::Range<f64>| {
        (-((r.end - r.start) / 6.0).log10().floor()).clamp(0.0, 9.0) as usize
    };
    let (x_decimals, y_decimals) = (decimals(&x), decimals(&y));
    let mut axes: Axes<'_, DB> = ChartBuilder::on(area)
        .margin_top(top)
        .margin_bottom(bottom)
        .margin_right(right)
        .x_label_area_size(label_h)
        .y_label_area_size(label_w)
        .build_cartesian_2d(x, y)
        .map_err(draw_error)?;
    axes.configure_mesh()
        .max_light_lines(0)
        .bold_line_style(GRID.stroke_width(px(1.0) as u32))
        .axis_style(AXIS.stroke_width(px(1.0) as u32))
        .x_labels(7)
        .y_labels(6)
        .x_label_formatter(&|v| tick(*v, x_decimals, panel.doubling))
        .y_label_formatter(&|v| tick(*v, y_decimals, panel.doubling))
        .label_style(text(TICK * k, SOFT_INK))
        .axis_desc_style(text(LABEL * k, INK))
        .x_desc(&panel.x_label)
        .y_desc(&panel.y_label)
        .set_all_tick_mark_size(px(4.0))
        .draw()
        .map_err(draw_error)?;
    for one in &panel.layers {
        layer(one, panel.equal_axes, &mut axes, k)?;
    }
    Ok(())
}

/// Draws the legend from `corner` on, as many entries to a line as fit; the y below it.
fn legend<DB: DrawingBackend>(
    panel: &Panel,
    area: &DrawingArea<DB, Shift>,
    corner: (i32, i32),
    k: f64,
) -> Result<i32, FigureError>
where
    DB::ErrorType: 'static,
{
    let px = |units: f64| (units * k).round() as i32;
    let style = text(TICK * k, INK).pos(Pos::new(HPos::Left, VPos::Center));
    let (line_h, swatch, right) = (px(17.0), px(22.0), area.dim_in_pixel().0 as i32);
    let (mut x, mut y) = (corner.0, corner.1 + line_h / 2);
    let mut drawn = false;
    for one in panel.layers.iter().filter(|l| !l.label.is_empty()) {
        let (w, _) = area
            .estimate_text_size(&one.label, &style)
            .map_err(draw_error)?;
        let end = x + swatch + px(6.0) + w as i32;
        if end > right && x > corner.0 {
            (x, y) = (corner.0, y + line_h);
        }
        let line = stroke(one, k);
        // The middle of a line of text lies below that of its letters.
        let (middle, y) = (y, y - px(1.0));
        let (a, b) = ((x, y), (x + swatch, y));
        let centre = (x + swatch / 2, y);
        match &one.shape {
            Shape::Line(_) | Shape::Thin(_) => area.draw(&PathElement::new([a, b], line)),
            Shape::Dashed(_) => {
                let gap = swatch / 7;
                (0..3).try_for_each(|i| {
                    let from = x + gap * (3 * i - i / 2);
                    area.draw(&PathElement::new([(from, y), (from + 2 * gap, y)], line))
                })
            }
            Shape::Band(_) | Shape::Patches(_) | Shape::Tube(..) => area.draw(&Rectangle::new(
                [(x, y - px(5.0)), (x + swatch, y + px(5.0))],
                pale(one.colour).filled(),
            )),
            Shape::Dots(_) => area.draw(&Circle::new(centre, px(DOT), one.colour.filled())),
            Shape::Rings(_) => area.draw(&Circle::new(centre, px(DOT), line)),
        }
        .map_err(draw_error)?;
        area.draw_text(&one.label, &style, (x + swatch + px(6.0), middle))
            .map_err(draw_error)?;
        x += swatch + px(22.0) + w as i32;
        drawn = true;
    }
    Ok(if drawn { y + line_h / 2 } else { corner.1 })
}

fn layer<DB: DrawingBackend>(
    layer: &Layer,
    equal_axes: bool,
    axes: &mut Axes<'_, DB>,
    k: f64,
) -> Drawn
where
    DB::ErrorType: 'static,
{
    let px = |units: f64| (units * k).round() as i32;
    let line = stroke(layer, k);
    let fill = pale(layer.colour).filled();
    match &layer.shape {
        // A path turns back on itself, and a mitred join of such a turn is a spike.
        Shape::Line(p) | Shape::Thin(p) if equal_axes => {
            let p: Vec<_> = finite(p).collect();
            axes.draw_series(p.windows(2).map(|w| PathElement::new(w.to_vec(), line)))
                .map(|_| ())
        }
        Shape::Line(p) | Shape::Thin(p) => axes
            .draw_series(LineSeries::new(finite(p), line))
            .map(|_| ()),
        Shape::Dashed(p) => axes
            .draw_series(DashedLineSeries::new(finite(p), px(6.0), px(4.0), line))
            .map(|_| ()),
        Shape::Band(p) => {
            let p = p
                .iter()
                .filter(|p| p.0.is_finite() && p.1.is_finite() && p.2.is_finite());
            let mut outline: Vec<_> = p.clone().map(|p| (p.0, p.1)).collect();
            outline.extend(p.rev().map(|p| (p.0, p.2)));
            axes.draw_series([Polygon::new(outline, fill)]).map(|_| ())
        }
        Shape::Patches(patches) => axes
            .draw_series(
                patches
                    .iter()
                    .map(|p| Polygon::new(finite(p).collect::<Vec<_>>(), fill)),
            )
            .map(|_| ()),
        Shape::Tube(p, radius) => tube(&finite(p).collect::<Vec<_>>(), *radius, axes, fill),
        Shape::Dots(p) => axes
            .draw_series(finite(p).flat_map(|p| {
                [
                    Circle::new(p, px(DOT + 0.9), WHITE.filled()),
                    Circle::new(p, px(DOT), layer.colour.filled()),
                ]
            }))
            .map(|_| ()),
        Shape::Rings(p) => axes
            .draw_series(finite(p).map(|p| Circle::new(p, px(DOT), line)))
            .map(|_| ()),
    }
    .map_err(draw_error)
}

/// A rectangle along every step and a disc at every point.
fn tube<DB: DrawingBackend>(
    path: &[(f64, f64)],
    radius: f64,
    axes: &mut Axes<'_, DB>,
    fill: ShapeStyle,
) -> Result<(), DrawingAreaErrorKind<DB::ErrorType>> {
    let r_px = {
        let at = |x| axes.backend_coord(&(x, 0.0)).0;
        (at(radius) - at(0.0)).max(1)
    };
    axes.draw_series(path.windows(2).filter_map(|w| {
        let (a, b) = (w[0], w[1]);
        let (dx, dy) = (b.0 - a.0, b.1 - a.1);
        let length = dx.hypot(dy);
        let (nx, ny) = (-dy / length * radius, dx / length * radius);
        (length > 0.0).then(|| {
            let corners = vec![
                (a.0 + nx, a.1 + ny),
                (b.0 + nx, b.1 + ny),
                (b.0 - nx, b.1 - ny),
                (a.0 - nx, a.1 - ny),
            ];
            Polygon::new(corners, fill)
        })
    }))?;
    axes.draw_series(path.iter().map(|&p| Circle::new(p, r_px, fill)))?;
    Ok(())
}

/// The ranges of both axes, with a little air; `aspect` is width over height.
fn ranges(
    panel: &Panel,
    aspect: f64,
) -> Result<(std::ops::Range<f64>, std::ops::Range<f64>), FigureError> {
    let (mut x, mut y) = ([f64::MAX, f64::MIN], [f64::MAX, f64::MIN]);
    let mut reach = |px: f64, py: f64, r: f64| {
        if px.is_finite() && py.is_finite() {
            x = [x[0].min(px - r), x[1].max(px + r)];
            y = [y[0].min(py - r), y[1].max(py + r)];
        }
    };
    for layer in &panel.layers {
        match &layer.shape {
            Shape::Line(p)
            | Shape::Thin(p)
            | Shape::Dashed(p)
            | Shape::Dots(p)
            | Shape::Rings(p) => {
                p.iter().for_each(|p| reach(p.0, p.1, 0.0));
            }
            Shape::Patches(patches) => {
                patches.iter().flatten().for_each(|p| reach(p.0, p.1, 0.0));
            }
            Shape::Tube(p, radius) => p.iter().for_each(|p| reach(p.0, p.1, *radius)),
            Shape::Band(p) => p.iter().for_each(|p| {
                reach(p.0, p.1, 0.0);
                reach(p.0, p.2, 0.0);
            }),
        }
    }
    if x[0] > x[1] {
        return Err(FigureError::Empty(panel.title.clone()));
    }
    let widen = |[low, high]: [f64; 2], share: f64| {
        let air = ((high - low) * share).max(1e-6 * low.abs().max(1e-3));
        [low - air, high + air]
    };
    let (mut x, mut y) = (widen(x, 0.02), widen(y, 0.06));
    if panel.equal_axes {
        let (w, h) = (x[1] - x[0], y[1] - y[0]);
        let add = |[low, high]: [f64; 2], extra: f64| [low - extra / 2.0, high + extra / 2.0];
        if w < h * aspect {
            x = add(x, h * aspect - w);
        } else {
            y = add(y, w / aspect - h);
        }
    }
    Ok((x[0]..x[1], y[0]..y[1]))
}

fn finite(points: &[(f64, f64)]) -> impl Iterator<Item = (f64, f64)> + Clone + '_ {
    let finite = |p: &&(f64, f64)| p.0.is_finite() && p.1.is_finite();
    points.iter().filter(finite).copied()
}

fn stroke(layer: &Layer, k: f64) -> ShapeStyle {
    let width = match layer.shape {
        Shape::Thin(_) => THIN,
        _ => LINE,
    };
    layer
        .colour
        .stroke_width((width * k).round().max(1.0) as u32)
}

fn text(size: f64, colour: RGBColor) -> TextStyle<'static> {
    (FONT, size).into_font().color(&colour)
}

/// On a doubling scale, powers of two where there is one; else the number.
fn tick(v: f64, decimals: usize, doubling: bool) -> String {
    if !doubling {
        return number(v, decimals);
    }
    if (v - v.round()).abs() > 1e-9 {
        return String::new();
    }
    let decimals = (-v.round()).max(0.0) as usize;
    number(v.round().exp2(), decimals)
}

fn number(v: f64, decimals: usize) -> String {
    let text = format!("{v:.decimals$}");
    let zero = text
        .trim_start_matches('-')
        .trim_matches(['0', '.'])
        .is_empty();
    match text.strip_prefix('-') {
        Some(digits) if zero => digits.to_owned(),
        Some(digits) => format!("\u{2212}{digits}"),
        None => text,
    }
}

fn draw_error<E: std::error::Error + Send + Sync + 'static>(e: E) -> FigureError {
    FigureError::Draw(Box::new(e))
}
