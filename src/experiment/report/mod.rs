//! `telemime report`: the results of an experiment as one page, and as figures.

mod charts;
mod group;
mod outages;
mod page;
mod view;

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

use super::factor::FACTORS;
use super::figures::Figures;
use super::row::line;
use super::store;
use charts::Chart;
use view::View;

/// The results of an experiment as one HTML page: pictures, tables with intervals, the plan and how to repeat it.
///
/// The page fetches nothing, and the same results give the same bytes.
#[derive(clap::Args, Debug)]
pub(crate) struct Args {
    /// The folder that `telemime experiment` wrote.
    dir: PathBuf,
    /// Where the page goes [default: DIR/report.html].
    #[arg(short, long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// The same pictures as SVG and PNG here, and what they show as CSV.
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
}

/// Runs `telemime report`.
pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let out = args.out.clone();
    let out = out.unwrap_or_else(|| args.dir.join("report.html"));
    write(&args.dir, &out, args.figures.as_deref())?;
    say!("{}", out.display());
    Ok(())
}

/// Writes the page of the experiment in `dir`, and its figures where wanted.
pub(super) fn write(dir: &Path, out: &Path, figures_in: Option<&Path>) -> anyhow::Result<()> {
    let (manifest, plan, rows) = store::read(dir)?;
    if manifest.shard != "1/1" {
        bail!(
            "{}: part {} of the runs; put the parts together with `telemime experiment merge`",
            dir.display(),
            manifest.shard
        );
    }
    if rows.is_empty() {
        bail!("{}: no runs", dir.display());
    }
    let view = View::new(dir, &rows);
    let charts = charts::charts(&view);
    let html = page::page(&view, &manifest, &plan, &charts)?;
    store::write_whole(out, html.as_bytes())?;
    if let Some(dir) = figures_in {
        figures(dir, &view, &charts)?;
        eprintln!("{} figures in {}", charts.len(), dir.display());
    }
    Ok(())
}

fn figures(dir: &Path, view: &View<'_>, charts: &[Chart]) -> anyhow::Result<()> {
    std::fs::create_dir_all(dir).with_context(|| format!("cannot make {}", dir.display()))?;
    for chart in charts {
        for ending in ["svg", "png"] {
            let path = dir.join(chart.name).with_extension(ending);
            chart.figure().write(&path)?;
        }
        let path = dir.join(chart.name).with_extension("csv");
        store::write_whole(&path, &points(chart))?;
    }
    store::write_whole(&dir.join("settings.csv"), &settings(view))?;
    Ok(())
}

/// A picture's points: layer by layer, as drawn.
fn points(chart: &Chart) -> Vec<u8> {
    use crate::figure::Shape;
    let mut out = line(["layer", "x", "y", "y_high"]);
    let back = |v: f64| {
        let v = if chart.panel.doubling { v.exp2() } else { v };
        format!("{v:.6}")
    };
    let mut name = String::new();
    for layer in &chart.panel.layers {
        if !layer.label.is_empty() {
            name.clone_from(&layer.label);
        }
        match &layer.shape {
            Shape::Band(points) => points.iter().for_each(|(x, low, high)| {
                out.extend(line(["band", &back(*x), &back(*low), &back(*high)]));
            }),
            Shape::Line(points)
            | Shape::Thin(points)
            | Shape::Dashed(points)
            | Shape::Dots(points)
            | Shape::Rings(points) => points.iter().for_each(|(x, y)| {
                out.extend(line([name.as_str(), &back(*x), &back(*y), ""]));
            }),
            Shape::Patches(_) | Shape::Tube(..) => {}
        }
    }
    out
}

/// Every setting with the mean and the interval of every figure.
fn settings(view: &View<'_>) -> Vec<u8> {
    let mut header: Vec<String> = FACTORS.iter().map(|f| f.name.to_owned()).collect();
    header.retain(|name| name != "link_seed");
    header.push("runs".into());
    let derived = ["hidden", "of_hold"];
    let names = || derived.iter().chain(Figures::NAMES);
    for name in names() {
        header.extend(["", "_low", "_high"].map(|end| format!("{name}{end}")));
    }
    let mut out = line(header);
    for group in &view.groups {
        let seedless = FACTORS.iter().zip(&group.texts);
        let mut fields: Vec<String> = seedless
            .filter(|(f, _)| f.name != "link_seed")
            .map(|(_, text)| text.clone())
            .collect();
        fields.push(group.rows.len().to_string());
        for name in names() {
            let found = match *name {
                "hidden" => group.each(|row| view.others.hidden(row)),
                "of_hold" => group.each(|row| view.others.ratio(row)),
                name => group.figure(name),
            };
            let of = |v: fn(&group::Interval) -> f64| {
                found.as_ref().map_or(String::new(), |i| v(i).to_string())
            };
            fields.extend([of(|i| i.mean), of(|i| i.low), of(|i| i.high)]);
        }
        out.extend(line(fields));
    }
    out
}
