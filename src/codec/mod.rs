//! `telemime codec`: what an error bound costs in bytes, ours beside others'.

mod coders;
mod compare;
mod figure;
mod turns;

use std::path::PathBuf;

use anyhow::{Context, bail};
use serde::Serialize;
use telemime_operator::demonstration::{Demonstration, Demonstrations};
use telemime_protocol::checkpoint::path::PathBounds;

use coders::Recording;
use compare::Row;
use turns::{PoseRow, TurnRow};

/// Compress recordings within an error bound, and compare: checkpoints, bytes, errors, R².
///
/// Our two codecs (a finished motion for play, knots as they come for mirror) beside the source publication's
/// rule, uniform decimation, Ramer-Douglas-Peucker, and deadbands, each tuned for every recording: first to the
/// fewest bytes within the bound at every sample, then to the smallest error with the bytes ours takes.
#[derive(clap::Args, Debug)]
pub(crate) struct Args {
    /// Recordings (CSV: t,x,y,z[,qw,qx,qy,qz][,grip]), or folders of them, taken together.
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Largest error at any sample, m.
    #[arg(long, value_name = "M", default_value_t = 0.002)]
    bound: f64,
    /// Largest error of the orientation, rad, where the recordings have one.
    #[arg(long, value_name = "RAD", default_value_t = 0.02)]
    turn_bound: f64,
    /// Compare with so many checkpoints for each recording, too.
    #[arg(long, value_name = "N")]
    points: Option<usize>,
    /// Draw bytes a second over the largest error, from a quarter of the bound to four bounds (SVG or PNG).
    #[arg(long, value_name = "FILE")]
    figure: Option<PathBuf>,
    /// Print one JSON object to stdout, everything else to stderr.
    #[arg(long)]
    json: bool,
}

/// The JSON object.
#[derive(Debug, Serialize)]
struct Study {
    name: String,
    recordings: usize,
    samples: usize,
    duration_s: f64,
    bound_m: f64,
    /// What the samples take as four `f32` each.
    raw_bytes: usize,
    same_error: Vec<Row>,
    same_bytes: Vec<Row>,
    #[serde(skip_serializing_if = "Option::is_none")]
    points: Option<usize>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    same_points: Vec<Row>,
    orientation: Option<TurnRow>,
    pose_live: Option<PoseRow>,
    /// Each bound of the figure, m, with its rows.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    sweep: Vec<(f64, Vec<Row>)>,
}

/// Runs `telemime codec`.
pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    if !(args.bound > 0.0 && args.bound.is_finite()) {
        bail!("--bound {}: it must be a positive length, m", args.bound);
    }
    if !(args.turn_bound > 0.0 && args.turn_bound <= 1.0) {
        bail!("--turn-bound {}: it must be in (0, 1] rad", args.turn_bound);
    }
    let (name, demonstrations) = read(&args.files)?;
    let recordings: Vec<_> = demonstrations
        .iter()
        .map(|d| Recording {
            t: d.samples().iter().map(|s| s.t_s).collect(),
            x: d.samples().iter().map(|s| s.position).collect(),
        })
        .collect();
    let samples = recordings.iter().map(|r| r.t.len()).sum();
    let at = |bound_m: f64| {
        compare::at_error(&recordings, bound_m).with_context(|| format!("at {bound_m} m"))
    };
    let mut study = Study {
        name,
        recordings: recordings.len(),
        samples,
        duration_s: recordings.iter().map(Recording::duration_s).sum(),
        bound_m: args.bound,
        raw_bytes: 16 * samples,
        same_error: at(args.bound)?,
        same_bytes: compare::at_bytes(&recordings, args.bound)?,
        points: args.points,
        same_points: match args.points {
            Some(n) => compare::with_points(&recordings, n)
                .with_context(|| format!("with --points {n}"))?,
            None => Vec::new(),
        },
        orientation: turns::code(&demonstrations, args.turn_bound)?,
        pose_live: turns::live(
            &demonstrations,
            PathBounds::new(args.bound, Some(args.turn_bound)),
        )?,
        sweep: Vec::new(),
    };
    if let Some(path) = &args.figure {
        for factor in [0.25, 0.5, 1.0, 2.0, 4.0] {
            let bound_m = args.bound * factor;
            study.sweep.push((bound_m, at(bound_m)?));
        }
        figure::write(&study, path)?;
        eprintln!("wrote {}", path.display());
    }
    let text = text(&study);
    if args.json {
        eprint!("{text}");
        say!("{}", serde_json::to_string(&study)?);
    } else {
        say!("{}", text.trim_end());
    }
    Ok(())
}

fn read(files: &[PathBuf]) -> anyhow::Result<(String, Vec<Demonstration>)> {
    let mut all = Vec::new();
    let mut names = Vec::new();
    for path in files {
        if path.is_dir() {
            let found = Demonstrations::read_dir(path, None)?;
            found
                .notices
                .iter()
                .for_each(|notice| eprintln!("note: {notice}"));
            names.push(found.name);
            all.extend(found.demonstrations);
        } else {
            let one = Demonstration::read_csv(path)?;
            one.notices()
                .iter()
                .for_each(|notice| eprintln!("note: {notice}"));
            names.push(one.name().to_owned());
            all.push(one);
        }
    }
    let name = match names.as_slice() {
        [one] => one.clone(),
        [first, rest @ ..] => format!("{first} and {} more", rest.len()),
        [] => String::new(),
    };
    Ok((name, all))
}

fn text(study: &Study) -> String {
    use std::fmt::Write as _;
    let mut out = String::new();
    let mut line = |text: String| {
        let _ = writeln!(out, "{text}");
    };
    line(format!(
        "{}: {} recordings, {} samples, {:.1} s; {} bytes as four f32 a sample",
        study.name, study.recordings, study.samples, study.duration_s, study.raw_bytes
    ));
    let bound_mm = study.bound_m * 1e3;
    let sections = [
        (
            format!("fewest bytes within {bound_mm} mm at every sample"),
            &study.same_error,
        ),
        (
            "smallest error with the bytes of ours, finished".to_owned(),
            &study.same_bytes,
        ),
        (
            format!("with {} checkpoints a recording", study.points.unwrap_or(0)),
            &study.same_points,
        ),
    ];
    for (title, rows) in sections.iter().filter(|(_, rows)| !rows.is_empty()) {
        line(format!(
            "\n{title}\n{:30}{:>7}{:>9}{:>9}{:>9}{:>10}{:>9}  R² x, y, z",
            "", "points", "bytes", "bytes/s", "varints", "max/mm", "rms/mm"
        ));
        for row in *rows {
            let r2 = row.r_squared.map(|r| match r {
                Some(r) => format!("{r:.6}"),
                None => "–".into(),
            });
            let part = if row.recordings < study.recordings {
                format!("  ({} of {} recordings)", row.recordings, study.recordings)
            } else {
                String::new()
            };
            line(format!(
                "{:30}{:>7}{:>9}{:>9.1}{:>9}{:>10.3}{:>9.3}  {}{part}",
                row.coder.name(),
                row.points,
                row.bytes,
                row.bytes_per_s,
                row.whole_bytes,
                row.largest_error_m * 1e3,
                row.rms_error_m * 1e3,
                r2.join(" ")
            ));
        }
    }
    line(
        "\nbytes: bit codes of one order a column, the same for all (the live knots: in one block, as by the stream);\n\
         varints: the same differences in whole bytes (the live knots: in a block for every two, as motions bring them)."
            .into(),
    );
    if let Some(turn) = &study.orientation {
        line(format!(
            "\norientation within {} rad: {} checkpoints, {} bytes, {:.1} bytes/s, max {:.5} rad, rms {:.5} rad ({} recordings)",
            turn.bound_rad,
            turn.points,
            turn.bytes,
            turn.bytes_per_s,
            turn.largest_error_rad,
            turn.rms_error_rad,
            turn.recordings
        ));
    }
    if let Some(pose) = &study.pose_live {
        line(format!(
            "place and orientation together, live: {} knots, {} bytes in one block, {} in twos, {:.1} bytes/s, 1/{:.1} of eight f32 a sample, max {:.3} mm and {:.5} rad",
            pose.knots,
            pose.bytes,
            pose.bytes_in_twos,
            pose.bytes as f64 / pose.duration_s,
            pose.raw_bytes as f64 / pose.bytes as f64,
            pose.largest_error_m * 1e3,
            pose.largest_error_rad
        ));
    }
    out
}
