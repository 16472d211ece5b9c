//! The two processes and the relay between them, from first to last.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use indicatif::{ProgressBar, ProgressStyle};
use telemime_endpoint::{HostClock, Identity};
use telemime_operator::cli::Event as Operator;
use telemime_robot::cli::Event as Robot;
use tokio::sync::watch;

use super::{Args, Material};
use crate::process::{Process, flag, listening, text, watch_robot};
use crate::relay::{Passage, Relay, RelayConfig};

/// What a run leaves behind.
pub(super) struct Run {
    pub(super) robot: Vec<Robot>,
    pub(super) operator: Vec<Operator>,
    pub(super) passages: Vec<Passage>,
    /// Every tick of the robot.
    pub(super) ticks: PathBuf,
    /// What was learned.
    pub(super) skill: PathBuf,
}

/// The run was cut short, and the operator, whose stderr is ours, has said why.
#[derive(Debug, thiserror::Error)]
#[error("the run was cut short; the operator says why")]
pub(crate) struct CutShort;

/// A robot that listens, and what an operator needs to call it.
pub(super) struct Called {
    pub(super) robot: Process,
    pub(super) events: Vec<Robot>,
    pub(super) addr: SocketAddr,
    /// The operator's flags that say who it is and whom it calls, but not where.
    pub(super) operator_args: Vec<String>,
}

/// Starts the robot that `args` ask for; it writes every tick to `ticks`, if there is such a file.
pub(super) async fn start_robot(
    args: &Args,
    scratch: &Path,
    ticks: Option<&Path>,
) -> anyhow::Result<Called> {
    let (robot_key, operator_key) = (scratch.join("robot.key"), scratch.join("operator.key"));
    let robot_is = Identity::load_or_create(&robot_key)?.fingerprint();
    let operator_is = Identity::load_or_create(&operator_key)?.fingerprint();
    let mut robot_args = vec!["--listen".to_owned(), "127.0.0.1:0".to_owned()];
    robot_args.extend([
        "--identity".to_owned(),
        text(&robot_key),
        "--peer".to_owned(),
        operator_is.to_string(),
    ]);
    if let Some(ticks) = ticks {
        // A robot writes over nothing, and this is the file that is read.
        match std::fs::remove_file(ticks) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                return Err(e).with_context(|| format!("cannot replace {}", ticks.display()));
            }
            _ => {}
        }
    }
    robot_args.extend(flag("--record", ticks.map(text)));
    robot_args.extend(flag("--urdf", args.urdf.as_deref().map(text)));
    robot_args.extend(flag("--tip", args.tip.as_ref()));
    robot_args.extend(flag(
        "--dead-time",
        (args.dead_time > 0.0).then(|| format!("{}us", args.dead_time * 1e6)),
    ));
    let mut robot = Process::start("robot", &robot_args)?;
    let mut events: Vec<Robot> = Vec::new();
    let addr = listening(&mut robot, &mut events).await?;
    Ok(Called {
        robot,
        events,
        addr,
        operator_args: vec![
            "--identity".to_owned(),
            text(&operator_key),
            "--peer".to_owned(),
            robot_is.to_string(),
        ],
    })
}

pub(super) async fn run(args: &Args, material: &Material, scratch: &Path) -> anyhow::Result<Run> {
    let ticks = args.out.join("robot.csv");
    let skills = args.out.join("skills");
    let Called {
        mut robot,
        events: mut robot_events,
        addr,
        operator_args: who,
    } = start_robot(args, scratch, Some(&ticks)).await?;

    let clock = HostClock::new();
    let config = RelayConfig {
        listen: SocketAddr::from(([127, 0, 0, 1], 0)),
        to: addr,
        up: args.link.up(),
        down: args.link.down(),
        seed: args.link.shape.link_seed,
    };
    let relay = Relay::bind(config, clock).context("no port for the relay")?;
    let via = relay.local_addr()?;
    let (quit, quit_rx) = watch::channel(false);
    let relaying = tokio::spawn(async move {
        let mut passages = Vec::new();
        relay.run(quit_rx, |passage| passages.push(passage)).await;
        passages
    });

    let mut operator_args = vec!["--connect".to_owned(), via.to_string()];
    operator_args.extend(who);
    operator_args.extend([
        "--learn".to_owned(),
        text(&material.demos),
        "--save".to_owned(),
        text(&skills),
    ]);
    operator_args.extend(flag("--match", material.matching.as_ref()));
    operator_args.extend(flag("--scale", args.scale));
    operator_args.extend(flag(
        "--input-latency",
        (args.input_latency > 0.0).then(|| format!("{}ms", args.input_latency * 1e3)),
    ));
    operator_args.extend([
        "--axes".to_owned(),
        format!("{:?}", args.axes).to_lowercase(),
    ]);
    let name = std::fs::canonicalize(&material.demos)?;
    let name = name
        .file_name()
        .map(|n| n.to_string_lossy().into_owned())
        .unwrap_or_default();
    if args.play {
        operator_args.extend(["--play".to_owned(), name.clone()]);
        let correction = material.correction.as_deref();
        operator_args.extend(flag("--correct", correction.map(text)));
    } else {
        operator_args.extend(["--replay".to_owned(), text(&material.replay)]);
    }
    let mut operator = Process::start("operator", &operator_args)?;
    let mut operator_events: Vec<Operator> = Vec::new();
    let watched = tokio::select! {
        biased;
        _ = tokio::signal::ctrl_c() => Err(anyhow::anyhow!("stopped by hand")),
        end = watch_robot(&mut robot, &mut robot_events) => end,
        done = watch_operator(&mut operator, &mut operator_events, args) => done,
    };
    // Whatever happened, nobody is left behind: first the hand, then the arm, then the link.
    let left = operator.finish(&mut operator_events).await;
    let stopped = robot.finish(&mut robot_events).await;
    quit.send_replace(true);
    let passages = relaying.await.context("the relay ended early")?;
    let why = operator_events.iter().find_map(|e| match e {
        Operator::Done { why, .. } => Some(why.clone()),
        _ => None,
    });
    if matches!(why, Some(Some(_))) {
        return Err(CutShort.into());
    }
    watched?;
    left?;
    stopped?;
    if why.is_none() {
        bail!("the operator ended without a result");
    }
    let skill = skills.join(format!("{name}.skill"));
    Ok(Run {
        robot: robot_events,
        operator: operator_events,
        passages,
        ticks,
        skill,
    })
}

async fn watch_operator(
    operator: &mut Process,
    events: &mut Vec<Operator>,
    args: &Args,
) -> anyhow::Result<()> {
    let bar = ProgressBar::new(1000);
    if let Ok(style) = ProgressStyle::with_template("{msg:28} {bar:40} {percent:>3} %") {
        bar.set_style(style);
    }
    bar.set_message("learning");
    bar.tick();
    while let Some(event) = operator.next().await? {
        match &event {
            Operator::Note { text } => bar.suspend(|| eprintln!("note: {text}")),
            Operator::Learned { .. } => bar.set_message("learned; connecting"),
            Operator::Connected { .. } => bar.set_message("connected"),
            Operator::Engaged { .. } if args.play => bar.set_message("playing"),
            Operator::Engaged { .. } => bar.set_message("driving"),
            Operator::State { state, cause, .. } if state == "Coasting" || state == "Holding" => {
                bar.suspend(|| eprintln!("robot: {state} ({cause})"));
            }
            Operator::Correction { what, .. } => {
                bar.set_message(format!("playing; the hand: {what}"))
            }
            Operator::Progress { done } => bar.set_position((done * 1e3) as u64),
            _ => {}
        }
        events.push(event);
    }
    bar.finish_and_clear();
    Ok(())
}
