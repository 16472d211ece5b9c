//! `telemime evaluate`: what prediction is worth on anyone's recordings.

mod arm;
mod dual;
mod experts;
mod failures;
mod faults;
mod figure;
mod kalman;
mod live;
mod protocol;
mod report;
mod score;
mod table;

use std::path::PathBuf;

use anyhow::{Context, bail};
use indicatif::{ProgressBar, ProgressStyle};
use telemime_operator::cli::Axes;
use telemime_operator::demonstration::{Demonstration, Demonstrations, PersonPattern};
use telemime_operator::session::{FutureBound, SessionConfig};
use telemime_protocol::predict::{KNOT_SPACING_S, MAX_KNOTS};

use crate::cli::Shape;
use arm::Driving;
use dual::Scheme;
pub(crate) use experts::Guess;
pub(crate) use kalman::Kalman;
pub(crate) use live::{Live, on_session_clock};
use protocol::{Plan, Protocol};
pub(crate) use score::REGION_90;

/// Bounds on the future that are tried, as shares of what holding errs by …
const BOUNDS: [f64; 6] = [0.04, 0.08, 0.16, 0.32, 0.48, 0.64];

/// … as multiples of the predicted deviation, and as shares of the way the hand usually goes.
const SIGMAS: [f64; 4] = [0.6, 1.0, 1.5, 2.0];
const SHARES: [f64; 5] = [0.15, 0.2, 0.3, 0.45, 0.6];

/// Largest silences that are tried, s.
const SILENCES_S: [Option<f64>; 3] = [Some(0.2), Some(0.3), None];

/// How well motion is predicted: every recording by skills that were learned without it.
///
/// Each folder is one skill. Beside the predictor as a session runs it: holding the newest sample, constant velocity, a Kalman filter,
/// the regression over time that play uses, and the mixture alone. Errors at the horizons asked for, what the
/// regions hold, and how few messages a link needs.
#[derive(clap::Args, Debug)]
pub(crate) struct Args {
    /// Folders of recordings (CSV: t,x,y,z[,qw,qx,qy,qz][,grip]), one a skill.
    #[arg(required = true, value_name = "DIR")]
    dirs: Vec<PathBuf>,
    /// How far ahead to predict, ms.
    #[arg(long, value_name = "MS,…", value_delimiter = ',', default_value = "33,67,100,150,200,300", value_parser = horizon_ms)]
    horizons: Vec<f64>,
    /// What is held out of learning.
    #[arg(long, value_enum, default_value_t = Protocol::SamePerson)]
    protocol: Protocol,
    /// Most demonstrations a skill is learned from [default: 3 of the same person, else all].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..))]
    demonstrations: Option<u8>,
    /// Recordings of motion that the skills do not show; may be repeated. What a skill was learned from is left
    /// out, so that each of several folders can be held against the others.
    #[arg(long, value_name = "DIR", num_args = 1..)]
    off_model: Vec<PathBuf>,
    /// Where file names hold the person: {} stands for the name, * for anything.
    #[arg(long, value_name = "PATTERN", default_value_t)]
    group_by: PersonPattern,
    /// Only the files whose names match this pattern (* stands for anything).
    #[arg(long = "match", value_name = "PATTERN")]
    matching: Option<String>,
    #[command(flatten)]
    link: Shape,
    /// Drive the arm too: both daemons and real QUIC over that link, on a virtual clock.
    #[arg(long)]
    arm: bool,
    #[command(flatten)]
    driving: Driving,
    /// The recordings' axes, as the arm is to see them.
    #[arg(long, value_enum, default_value_t = Axes::Kinect, requires = "arm")]
    axes: Axes,
    /// Sessions replace what looks like a tracker's glitch (see `telemime operator`).
    #[arg(long)]
    glitch_gate: bool,
    /// Draw what was found (.svg or .png).
    #[arg(long, value_name = "FILE")]
    figure: Option<PathBuf>,
    /// Draw where it fails: one performance, the first moments, a change of mind, size and path.
    #[arg(long, value_name = "FILE")]
    failures: Option<PathBuf>,
    /// Seed of every random choice in learning.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Print one JSON object to stdout, everything else to stderr.
    #[arg(long)]
    json: bool,
}

fn horizon_ms(text: &str) -> Result<f64, String> {
    let farthest_ms = MAX_KNOTS as f64 * KNOT_SPACING_S * 1e3;
    let text = text.strip_suffix("ms").unwrap_or(text);
    match text.trim().parse::<f64>() {
        Ok(ms) if ms > 0.0 && ms <= farthest_ms => Ok(ms),
        Ok(ms) => Err(format!(
            "{ms} ms: the predictor's knots reach from 0 to {farthest_ms} ms"
        )),
        Err(_) => Err(format!("{text:?} is not a number of milliseconds")),
    }
}

/// Runs `telemime evaluate`.
pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    for path in args.figure.iter().chain(&args.failures) {
        crate::figure::check(path)?;
    }
    let mut horizons_s: Vec<f64> = args.horizons.iter().map(|ms| ms * 1e-3).collect();
    horizons_s.sort_by(f64::total_cmp);
    horizons_s.dedup();
    let sets = read(&args.dirs, args.matching.as_deref())?;
    let off_model = read(&args.off_model, None)?;
    let link = args.link.config();
    if link.rate.is_some() {
        bail!("--rate: the study's link has no bottleneck; telemime demo shows one");
    }
    let schemes = schemes(&sets, link.delay_s);
    let session = SessionConfig {
        glitch_gate: args.glitch_gate,
        rotation: args.axes.rotation(),
        ..SessionConfig::default()
    };
    let arm = args.arm.then(|| args.driving.drive(&session, &link));
    let arm = arm.transpose()?;
    let plan = Plan {
        sets: &sets,
        off_model: &off_model,
        protocol: args.protocol,
        persons: &args.group_by,
        most: args
            .demonstrations
            .map_or(args.protocol.usual(), usize::from),
        horizons_s: &horizons_s,
        session: &session,
        schemes: &schemes,
        link: &link,
        arm: arm.as_ref(),
        seed: args.seed,
        link_seed: args.link.link_seed,
    };
    let rounds = plan.rounds()?;
    let bar = ProgressBar::new(rounds.len() as u64);
    if let Ok(style) = ProgressStyle::with_template("{bar:30} {pos}/{len} skills, {eta} left") {
        bar.set_style(style);
    }
    bar.tick();
    let performances = plan.run(&rounds, || bar.inc(1));
    bar.finish_and_clear();
    let performances = performances?;
    let report = report::report(&plan, &rounds, &performances);
    let text = table::text(&report);
    if args.json {
        eprint!("{text}");
        say!("{}", serde_json::to_string(&report)?);
    } else {
        say!("{}", text.trim_end());
    }
    if let Some(path) = &args.figure {
        figure::write(&report, path).context("no figure")?;
        eprintln!("wrote {}", path.display());
    }
    if let Some(path) = &args.failures {
        failures::write(&report, &performances, path).context("no figure of failures")?;
        eprintln!("wrote {}", path.display());
    }
    Ok(())
}

fn read(dirs: &[PathBuf], pattern: Option<&str>) -> anyhow::Result<Vec<Demonstrations>> {
    let mut sets: Vec<Demonstrations> = Vec::new();
    for dir in dirs {
        let set = Demonstrations::read_dir(dir, pattern)?;
        if sets.iter().any(|other| other.name == set.name) {
            bail!(
                "{}: two folders are called {}; rename one",
                dir.display(),
                set.name
            );
        }
        set.notices
            .iter()
            .for_each(|notice| eprintln!("note: {notice}"));
        sets.push(set);
    }
    Ok(sets)
}

/// Everything and deadbands, then the session with every bound and silence.
fn schemes(sets: &[Demonstrations], delay_s: f64) -> Vec<Scheme> {
    let recordings = sets.iter().flat_map(|s| &s.demonstrations);
    let (sum, n) = recordings.fold((0.0, 0), |(sum, n), d| {
        (sum + moved_2(d, delay_s), n + d.samples().len())
    });
    let hold_m = (sum / n as f64).sqrt();
    let bounds_m = BOUNDS.map(|share| two_digits(share * hold_m));
    let mut all = vec![Scheme::Everything];
    all.extend(bounds_m.map(Scheme::DeadbandHold));
    all.extend(bounds_m.map(Scheme::DeadbandStraight));
    for silence_s in SILENCES_S {
        all.extend(bounds_m.map(|m| Scheme::Session(FutureBound::Absolute(m), silence_s)));
        all.extend(SIGMAS.map(|n| Scheme::Session(FutureBound::Relative(n), silence_s)));
        all.extend(SHARES.map(|n| Scheme::Session(FutureBound::Share(n), silence_s)));
    }
    all
}

/// Σ|x(t + h) − x(t)|² over the samples.
fn moved_2(d: &Demonstration, h_s: f64) -> f64 {
    let samples = d.samples().iter();
    let moved = samples.map(|s| (d.position_at(s.t_s + h_s) - s.position).norm_squared());
    moved.sum()
}

/// Rounded to two digits, at least 0.1 mm.
fn two_digits(m: f64) -> f64 {
    let step = 10_f64.powf(m.max(1e-4).log10().floor() - 1.0);
    (m.max(1e-4) / step).round() * step
}
