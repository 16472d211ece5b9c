//! `telemime import`: raw recordings to a folder of demonstrations.

mod figure;
mod recorded;
mod write;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use serde_json::json;
use telemime_endpoint::cli::one_line;
use telemime_endpoint::recording;
use telemime_operator::depth::Intrinsics;
use telemime_operator::ingest::segment::Method;
use telemime_operator::ingest::{
    Axes, Columns, Cut, Fault, Format, Imported, IngestError, LengthUnit, MAX_GAP_S, Options,
    Report, TimeUnit, grip_range, import, import_depth,
};

/// Make demonstrations of raw recordings: Kinect or OpenNI skeletons, tables of a hand's path, depth frames, or what the
/// operator daemon recorded (--record), of which every engagement is one.
///
/// Each RAW file is read, cleaned and written to DIR as CSV (t,x,y,z, in s and m; orientation and gripper come along),
/// so that `telemime learn DIR` can follow at once. What was changed is counted and said. A file that cannot be
/// used is named, the others are converted all the same, and the exit code is 1.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  telemime import kard/*.txt --joint right_hand -o wave
  telemime import swings.csv --format kinect --segment -o swing --figure swing.svg
  telemime import monday.mcap -o screw
  telemime import mocap.tsv --columns t=Time,x=RH_X,y=RH_Y,z=RH_Z --unit mm --axes x,z,-y -o reach")]
pub(crate) struct Args {
    /// Raw recordings; of a folder, every .txt, .csv, .tsv and .mcap in it (depth: the folder is one recording).
    #[arg(value_name = "RAW", required = true)]
    raw: Vec<PathBuf>,
    /// The folder to write to, made if need be; its name becomes the skill's.
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Write to DIR/NAME instead.
    #[arg(long, value_name = "NAME", value_parser = folder_name)]
    skill: Option<String>,
    /// kard (a joint a line, 15 a frame), kinect (a frame a line, 20 joints), csv (a sample a line) or depth (a folder
    /// of 16-bit PNG, a frame each, in which the hand is looked for) [default: by the first line].
    #[arg(long, value_name = "FORMAT")]
    format: Option<Format>,
    /// The joint of a skeleton to take.
    #[arg(long, value_name = "JOINT", default_value = "right_hand")]
    joint: String,
    /// Which column of a table is what, by name or number from 1: t=…,x=…,y=…,z=…[,qw=…,qx=…,qy=…,qz=…][,grip=…]
    /// [default: by these names].
    #[arg(long, value_name = "MAP")]
    columns: Option<Columns>,
    /// Frames come evenly at this rate, whatever times the file states [default: its times; kard and depth have none: 30].
    #[arg(long, value_name = "HZ", value_parser = positive)]
    fps: Option<f64>,
    /// Unit of lengths: m, cm or mm [default: kard and depth mm, else m].
    #[arg(long, value_name = "UNIT")]
    unit: Option<LengthUnit>,
    /// Unit of times: s, ms, us or ns [default: by the usual step].
    #[arg(long, value_name = "UNIT")]
    time_unit: Option<TimeUnit>,
    /// Which source axis, signed, our x, y and z each are, as x,-z,y [default: x,y,z].
    #[arg(long, value_name = "AXES", allow_hyphen_values = true)]
    axes: Option<Axes>,
    /// Readings of the gripper when it is closed and when it is open.
    #[arg(long, value_name = "CLOSED,OPEN", default_value = "0,1", value_parser = grip_range, allow_hyphen_values = true)]
    grip_range: (f64, f64),
    /// Depth: the camera's focal lengths and principal point, pixels [default: a Kinect's, for the frames' size].
    #[arg(long, value_name = "FX,FY,CX,CY")]
    camera: Option<Intrinsics>,
    /// Depth: left and right are turned around: for a camera in whose picture the person's right hand is on the left.
    #[arg(long)]
    mirror: bool,
    /// Smooth without shifting in time, −3 dB at this frequency [default: no smoothing].
    #[arg(long, value_name = "HZ", value_parser = positive)]
    smooth: Option<f64>,
    /// A hole longer than this splits the recording, s.
    #[arg(long, value_name = "S", default_value_t = MAX_GAP_S, value_parser = positive)]
    max_gap: f64,
    /// Leave samples in that are far off the path of their neighbours.
    #[arg(long)]
    keep_glitches: bool,
    /// Cut each recording into the repetitions in it: at rests, else where the motion returns.
    #[arg(long, conflicts_with = "at")]
    segment: bool,
    /// Cut at these times, s since the first sample.
    #[arg(long, value_name = "T1,T2,…", value_delimiter = ',', value_parser = positive)]
    at: Vec<f64>,
    /// Overwrite demonstrations that are there already.
    #[arg(long)]
    force: bool,
    /// One JSON object on stdout.
    #[arg(long)]
    json: bool,
    /// Draw speed and cuts into this file (.svg or .png).
    #[arg(long, value_name = "FILE")]
    figure: Option<PathBuf>,
}

fn positive(text: &str) -> Result<f64, String> {
    text.parse()
        .ok()
        .filter(|v: &f64| *v > 0.0 && v.is_finite())
        .ok_or_else(|| format!("{text:?} is not a number above 0"))
}

fn folder_name(text: &str) -> Result<String, String> {
    let plain = !text.contains(['/', '\\']) && !text.starts_with('.');
    if plain && (1..=64).contains(&text.len()) {
        Ok(text.to_owned())
    } else {
        Err("a name of 1 to 64 bytes without slashes, not beginning with a dot".to_owned())
    }
}

/// One recording, and what became of it.
struct Done {
    raw: PathBuf,
    result: anyhow::Result<(Imported, Vec<PathBuf>)>,
}

pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    if !args.at.is_empty() && args.raw.len() != 1 {
        bail!("--at cuts one recording; import the others by themselves");
    }
    let depth = args.format == Some(Format::Depth);
    if !depth && (args.mirror || args.camera.is_some()) {
        bail!("--camera and --mirror are for --format depth; --axes turns other recordings");
    }
    if let Some(path) = &args.figure {
        crate::figure::check(path)?;
    }
    let raws = expanded(&args.raw, depth)?;
    let options = Options {
        format: args.format,
        joint: args.joint.clone(),
        columns: args.columns.clone().unwrap_or_default(),
        fps: args.fps,
        time: args.time_unit,
        length: args.unit,
        axes: args.axes.unwrap_or_default(),
        grip_range: args.grip_range,
        camera: args.camera,
        mirror: args.mirror,
        max_gap_s: args.max_gap,
        keep_glitches: args.keep_glitches,
        smooth_hz: args.smooth,
        cut: match (args.segment, args.at.as_slice()) {
            (true, _) => Cut::Repetitions,
            (false, []) => Cut::Whole,
            (false, at) => Cut::At(at.to_vec()),
        },
    };
    let dir = match &args.skill {
        Some(name) => args.output.join(name),
        None => args.output.clone(),
    };
    let mut folder = write::Folder::open(&dir, &raws, args.force)?;
    let mut done: Vec<Done> = Vec::new();
    let open = |raw| match depth {
        true => vec![(raw, Ok(Vec::new()))],
        false => opened(raw),
    };
    for (raw, bytes) in raws.into_iter().flat_map(open) {
        let result = bytes.and_then(|bytes| {
            let imported = convert(&raw, &bytes, &options)?;
            let paths = folder.write(&raw, &imported.takes)?;
            Ok((imported, paths))
        });
        let one = Done { raw, result };
        if !args.json {
            tell(&one);
        }
        if let Err(e) = &one.result {
            eprintln!("telemime: {}", one_line(e.chain()));
        }
        done.push(one);
    }
    for stale in folder.stale() {
        eprintln!(
            "note: {} is left from an earlier import of the same recording",
            stale.display()
        );
    }
    if args.json {
        say!("{}", summary(&done));
    }
    let good: Vec<(&Path, &Imported)> = done
        .iter()
        .filter_map(|d| Some((d.raw.as_path(), &d.result.as_ref().ok()?.0)))
        .collect();
    if let (Some(path), false) = (&args.figure, good.is_empty()) {
        figure::figure(&good).write(path)?;
    }
    match done.len() - good.len() {
        0 => Ok(()),
        failed => bail!(
            "{failed} of {} recordings could not be converted: see above",
            done.len()
        ),
    }
}

fn convert(raw: &Path, bytes: &[u8], options: &Options) -> anyhow::Result<Imported> {
    let imported = match options.format {
        Some(Format::Depth) => import_depth(raw, options),
        _ => import(bytes, options),
    };
    Ok(imported.map_err(|fault| of(raw, fault))?)
}

fn of(raw: &Path, fault: impl Into<Fault>) -> IngestError {
    IngestError {
        path: raw.to_owned(),
        fault: fault.into(),
    }
}

/// A file's bytes; of a recording, every engagement's as a table, under a name of its own.
fn opened(raw: PathBuf) -> Vec<(PathBuf, anyhow::Result<Vec<u8>>)> {
    if !recording::is_named(&raw) {
        let bytes = std::fs::read(&raw).map_err(|e| of(&raw, e).into());
        return vec![(raw, bytes)];
    }
    match recorded::engagements(&raw, |note| eprintln!("note: {note}")) {
        Ok(all) => all
            .into_iter()
            .map(|one| (one.raw, Ok(one.table.into_bytes())))
            .collect(),
        Err(e) => vec![(raw, Err(e.into()))],
    }
}

/// Files as given; folders by what is in them, unless each is a recording. None twice.
fn expanded(given: &[PathBuf], folders: bool) -> anyhow::Result<Vec<PathBuf>> {
    let mut all = Vec::new();
    for path in given {
        if folders || !path.is_dir() {
            all.push(path.clone());
            continue;
        }
        let cannot = || format!("cannot read {}", path.display());
        let mut inside = Vec::new();
        for entry in std::fs::read_dir(path).with_context(cannot)? {
            let file = entry.with_context(cannot)?.path();
            let ending = file.extension().and_then(|e| e.to_str()).unwrap_or("");
            if ["txt", "csv", "tsv", "mcap"].contains(&ending.to_ascii_lowercase().as_str()) {
                inside.push(file);
            }
        }
        if inside.is_empty() {
            bail!(
                "{}: no .txt, .csv, .tsv or .mcap in this folder",
                path.display()
            );
        }
        inside.sort();
        all.append(&mut inside);
    }
    let mut seen = BTreeMap::new();
    for path in &all {
        let real = path.canonicalize().unwrap_or_else(|_| path.clone());
        if seen.insert(real, ()).is_some() {
            bail!("{} is given twice", path.display());
        }
    }
    Ok(all)
}

fn tell(done: &Done) {
    let Ok((imported, paths)) = &done.result else {
        return;
    };
    let report = &imported.report;
    let n = paths.len();
    say!(
        "{}: {}; {} frames, {n} demonstration{}",
        done.raw.display(),
        read_as(report),
        report.frames,
        if n == 1 { "" } else { "s" }
    );
    for change in report.changes() {
        say!("  {change}");
    }
    for cuts in &report.cuts {
        let at: Vec<_> = cuts.at_s.iter().map(|t| format!("{t:.2}")).collect();
        let at = at.join(", ");
        let (from, to) = cuts.stretch_s;
        let stretch = format!("  {from:.2} s to {to:.2} s");
        match cuts.method {
            Method::Whole => say!("{stretch}: nothing to cut by; one piece"),
            Method::ByHand => say!("{stretch}: cut by hand at {at} s"),
            Method::Rests => say!("{stretch}: cut amid rests, at {at} s"),
            Method::Returns => say!(
                "{stretch}: cut where the motion returns, about every {:.2} s: {at} s",
                cuts.period_s.unwrap_or_default()
            ),
        }
    }
    for (take, path) in report.takes.iter().zip(paths) {
        say!(
            "  {} ({:.2} s, {} samples)",
            path.display(),
            take.to_s - take.from_s,
            take.samples
        );
    }
}

/// Format, joint and units.
fn read_as(report: &Report) -> String {
    let mut words = vec![report.format.to_string()];
    words.extend(report.joint.clone());
    words.push(report.length_unit.to_string());
    words.extend(report.fps.map(|fps| format!("{fps} Hz")));
    words.extend(report.time_unit.map(|unit| format!("times in {unit}")));
    words.extend(report.orientation.then(|| "orientation".to_owned()));
    words.extend(report.grip.then(|| "grip".to_owned()));
    words.join(", ")
}

fn summary(done: &[Done]) -> serde_json::Value {
    let files: Vec<_> = done
        .iter()
        .map(|d| match &d.result {
            Ok((imported, paths)) => {
                json!({"raw": d.raw, "written": paths, "error": null, "report": imported.report})
            }
            Err(e) => {
                json!({"raw": d.raw, "written": [], "error": one_line(e.chain()), "report": null})
            }
        })
        .collect();
    let failed = done.iter().filter(|d| d.result.is_err()).count();
    json!({"files": files, "failed": failed})
}
