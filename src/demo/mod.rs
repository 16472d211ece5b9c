//! `telemime demo`: a robot and an operator as two processes, a bad link between them, and what is left
//! of the delay.

mod correct;
mod figures;
mod judge;
mod page;
mod play;
mod processes;
mod summary;

use std::net::SocketAddr;
use std::path::PathBuf;

use anyhow::{Context, bail};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use telemime_operator::cli::Axes;
use telemime_operator::demonstration::{Demonstration, Demonstrations, Sample};
use telemime_sim::hand::swing_with_wrist;
use telemime_sim::link::parse_duration_s;

use crate::cli::Ways;
pub(crate) use processes::CutShort;

/// Performances the demo learns from; one more is driven.
const PERFORMANCES: u32 = 5;

/// Both daemons as two processes over a shaped link, and what became of the delay.
///
/// Learns a skill from five performances of an arm swing (generated, or your own with --demos), then
/// teleoperates a sixth one, never learned from, across a link of 100 ms ± 10 ms and 1 % loss each way.
#[derive(clap::Args, Debug, Clone)]
pub(crate) struct Args {
    /// Play the learned skill instead of mirroring a live hand.
    #[arg(long)]
    play: bool,
    /// Play, and let a generated hand correct the motion: it pushes aside, resists until it has taken over, lets go.
    #[arg(long, requires = "play", conflicts_with = "wrist")]
    correct: bool,
    /// Serve a page to teach and drive from a browser, across the link, which the page can set [default:
    /// 127.0.0.1:8723]. Nothing is learned before.
    #[arg(
        long,
        value_name = "ADDR",
        num_args = 0..=1,
        default_missing_value = "127.0.0.1:8723",
        conflicts_with_all = ["play", "demos", "replay", "axes", "scale", "input_latency", "seed", "wrist"]
    )]
    console: Option<SocketAddr>,
    /// Learn from this folder of recordings (CSV: t,x,y,z) instead.
    #[arg(long, value_name = "DIR")]
    demos: Option<PathBuf>,
    /// Of that folder, only the files whose names match this pattern (* stands for anything).
    #[arg(long = "match", value_name = "PATTERN", requires = "demos")]
    matching: Option<String>,
    /// Drive this recording; it is never learned from [default: the last one of --demos].
    #[arg(long, value_name = "FILE")]
    replay: Option<PathBuf>,
    /// The arm [default: a 7-axis arm of our own].
    #[arg(long, value_name = "FILE")]
    urdf: Option<PathBuf>,
    /// The link that follows the hand.
    #[arg(long, value_name = "LINK")]
    tip: Option<String>,
    /// The arm obeys this much late, 0 to 50ms.
    #[arg(long, value_name = "TIME", default_value = "0ms", value_parser = parse_duration_s)]
    dead_time: f64,
    /// The recordings' axes.
    #[arg(long, value_enum, default_value_t = Axes::Kinect)]
    axes: Axes,
    /// Tip metres per hand metre [default: from the demonstrations and the arm's limits].
    #[arg(long)]
    scale: Option<f64>,
    /// Play the sensor: hand every sample over this late, and tell the operator so.
    #[arg(long, value_name = "TIME", default_value = "0ms", value_parser = parse_duration_s)]
    input_latency: f64,
    /// Which person performs, and how.
    #[arg(long, default_value_t = 7)]
    seed: u64,
    /// The generated performances have the hand's orientation too.
    #[arg(long, conflicts_with = "demos")]
    wrist: bool,
    #[command(flatten)]
    link: Ways,
    /// Where figures and logs go.
    #[arg(long, value_name = "DIR", default_value = "runs/demo")]
    out: PathBuf,
    /// Print one JSON object to stdout and everything else to stderr.
    #[arg(long)]
    json: bool,
}

/// What is learned and what is driven.
struct Material {
    demos: PathBuf,
    matching: Option<String>,
    replay: PathBuf,
    recording: Demonstration,
    /// What the hand does beside the motion that is played.
    correction: Option<PathBuf>,
    what: String,
}

/// Runs `telemime demo`.
pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let scratch = tempfile::tempdir().context("no temporary folder")?;
    std::fs::create_dir_all(&args.out)
        .with_context(|| format!("cannot make {}", args.out.display()))?;
    if let Some(addr) = args.console {
        return page::run(args, addr, scratch.path());
    }
    let mut material = material(args)?;
    if args.correct {
        material.correction = Some(correct::hand(args, &material)?);
    }
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let run = runtime.block_on(processes::run(args, &material, scratch.path()))?;
    if args.correct {
        correct::report(args, &material, &run)
    } else if args.play {
        play::report(args, &material, &run)
    } else {
        let verdict = judge::judge(args, &material, &run)?;
        let shown = figures::mirror(args, &material, &run, &verdict)?;
        summary::print(args, &material, &run, &verdict, &shown)
    }
}

fn material(args: &Args) -> anyhow::Result<Material> {
    let Some(demos) = args.demos.clone() else {
        if args.replay.is_some() {
            bail!("--replay needs --demos: which recordings is the skill learned from?");
        }
        return generated(args);
    };
    let found = Demonstrations::read_dir(&demos, args.matching.as_deref())?;
    let (replay, recording) = match &args.replay {
        Some(path) => (path.clone(), Demonstration::read_csv(path)?),
        None => match found.demonstrations.as_slice() {
            [_, .., last] => (last.path().to_owned(), last.clone()),
            // Playing learns from all there is and drives none.
            [only] if args.play => (only.path().to_owned(), only.clone()),
            _ => bail!(
                "{}: one recording to learn from and another to drive are needed",
                demos.display()
            ),
        },
    };
    let what = format!(
        "{} (your recordings), driving {}",
        found.name,
        recording.name()
    );
    Ok(Material {
        demos,
        matching: args.matching.clone(),
        replay,
        recording,
        correction: None,
        what,
    })
}

/// A synthetic person waving, or carrying something if that is to be corrected: performances 0 to 4 to learn from, 5 to drive.
/// They are left beside the figures, as examples of what a recording is.
fn generated(args: &Args) -> anyhow::Result<Material> {
    let recordings = args.out.join("recordings");
    let demos = recordings.join(if args.correct { "carry" } else { "swing" });
    std::fs::create_dir_all(&demos).with_context(|| format!("cannot make {}", demos.display()))?;
    let replay = recordings.join("unseen.csv");
    for index in 0..=PERFORMANCES {
        let samples: Vec<_> = if args.correct {
            correct::demonstration(args.seed, index)
        } else {
            swing_with_wrist(args.seed, index)
                .into_iter()
                .map(|pose| {
                    let [w, x, y, z] = pose.q;
                    let q = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
                    Sample {
                        orientation: args.wrist.then_some(q),
                        ..Sample::at(pose.t_s, Vector3::from(pose.x))
                    }
                })
                .collect()
        };
        let path = if index < PERFORMANCES {
            demos.join(format!("{index}.csv"))
        } else {
            replay.clone()
        };
        std::fs::write(
            &path,
            Demonstration::from_samples(&path, &samples)?.to_csv(),
        )?;
    }
    let recording = Demonstration::read_csv(&replay)?;
    let deed = if args.correct {
        "carrying something"
    } else {
        "an arm swing"
    };
    let what = format!("{deed}, {PERFORMANCES} generated performances, driving one more");
    Ok(Material {
        demos,
        matching: None,
        replay,
        recording,
        correction: None,
        what,
    })
}
