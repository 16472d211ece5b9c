//! The operator daemon's command line: flags over environment over a TOML file over defaults.

mod args;
mod infer;
mod input;
mod known;
mod pair;
mod played;
mod report;
mod scores;
mod settings;
mod skills;

use std::io::IsTerminal;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use nalgebra::UnitQuaternion;
use telemime_endpoint::admin;
use telemime_endpoint::cli::{self, Printer};
use telemime_endpoint::config::{self, Settings};
use telemime_endpoint::peers::{Peers, Role, Source, Whom};
use telemime_endpoint::recording::To;
use telemime_endpoint::supervisor::Supervisor;
use telemime_endpoint::{External, HostClock, Identity, Meter, Mono, Trust, logs, metrics, quic};
use tokio::sync::{mpsc, watch};

use crate::console::{self, Known, Live};
use crate::daemon::{Daemon, Learning, Reopen, Snapshot};
use crate::demonstration::{Demonstration, Sample};
use crate::input::read::Clock;
use crate::placed::Motion;
use crate::recording::Scribe;
use crate::session::Leeway;
use crate::task::{Outcome, Recording, Task};
pub use args::{Args, Axes, parse_future_bound};
pub use infer::{Bounds, infer};
pub use input::InputArgs;
use known::Known as KnownRobot;
pub use pair::{PairArgs, pair};
use played::Played;
pub use report::Event;
pub use scores::{PlayReport, Scores, TurnScores};
pub use skills::Skills;

/// Runs the daemon until its task is done.
///
/// # Errors
/// One line that says what to do; also if the task was interrupted.
pub fn run(args: &Args) -> anyhow::Result<()> {
    if args.print_config {
        return cli::say(config::example::<Args>().trim_end());
    }
    if args.print_schema {
        return cli::say(&serde_json::to_string_pretty(&config::schema::<Args>())?);
    }
    let args = args.settled(args.config.as_deref())?;
    if args.input.input == Some(crate::input::Source::Evdev(None)) {
        return input::list_devices(args.json);
    }
    let logging = logs::start(args.log_format)?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("no runtime")?;
    let done = runtime.block_on(operate(args));
    if let Some(logging) = logging {
        logging.finish();
    }
    done
}

async fn operate(args: Args) -> anyhow::Result<()> {
    let config = args.session()?;
    let Some(connect) = &args.connect else {
        bail!("which robot? Give --connect HOST:PORT (or connect = \"…\" in the configuration)");
    };
    let peer_file = args.peer_file.clone().unwrap_or_else(admin::peer_file);
    let known = KnownRobot::find(&Peers::load(&peer_file)?, connect, args.peer.as_deref())?;
    let robot: SocketAddr = cli::resolve(&known.address).map_err(anyhow::Error::msg)?;
    let key = args
        .identity
        .clone()
        .unwrap_or_else(|| admin::key_file(Role::Operator));
    let identity = Identity::load_or_create(&key)?;
    let (out, printing) = Printer::start().context("no thread to print from")?;
    let log = report::Log {
        json: args.json,
        out,
    };
    log.say(&Event::Fingerprint {
        fingerprint: identity.fingerprint().to_string(),
    });
    let Some(key) = known.key else {
        bail!(
            "whose robot? It is not known yet: run `telemime pair {connect}` while it has a pairing window open, or give its \
             fingerprint with --peer; ours is {} (for the robot's --peer)",
            identity.fingerprint()
        );
    };
    let source = Source {
        path: peer_file,
        whom: Whom::Robot {
            key,
            given: args.peer.is_some(),
        },
    };
    let trust = Trust::new([]);
    source.read(&trust)?;
    let skills = Skills::gather(&args, &log)?;
    let clock = HostClock::new();
    // A second before now, so that a sensor's latency may be subtracted from the first sample.
    let epoch = Mono(clock.now().0 - 1_000_000_000);
    let (task, played) = match &args.input.input {
        Some(source) => (
            args.input
                .task(source, Clock { host: clock, epoch }, config.rotation, &log)?,
            None,
        ),
        None => make_task(&args, &skills, config.rotation, &log)?,
    };
    let to = To {
        file: args.record.as_deref(),
        live: args.foxglove,
    };
    let scribe = (!to.is_nowhere()).then(|| {
        let say = {
            let log = log.clone();
            move |outcome| log.say(&Event::recording(&outcome))
        };
        Scribe::start(to, config.rotation, say)
    });
    let scribe = scribe.transpose()?;
    if let Some(addr) = scribe.as_ref().and_then(Scribe::live) {
        let url = format!("ws://{addr}");
        log.say(&Event::Foxglove { url });
    }
    let mut task = task.recorded(scribe);

    let (quit, words) = cli::listen(args.follow_stdin, cli::OPERATOR_WORDS, || {})?;
    let meter = Meter::default();
    let socket = quic::Socket::bind(any_port(robot))?;
    let endpoint = quic::client(&identity, &trust, socket, &meter)?;
    let reopen = {
        let (trust, meter) = (trust.clone(), meter.clone());
        Reopen::new(move || {
            let socket = quic::Socket::bind(any_port(robot))?;
            quic::client(&identity, &trust, socket, &meter)
        })
    };
    let shown = args
        .metrics
        .map(|addr| serve_metrics(addr, &log))
        .transpose()?;
    supervised(&format!("reaches for {}", known.address));
    let daemon = Daemon {
        endpoint,
        reopen: Some(reopen),
        trust: trust.clone(),
        meter,
        robot,
        clock,
        epoch,
        external: args.clock_dispersion.map(External::host),
        skill: skills.mirror(),
        recogniser: skills.recogniser(&log),
        config,
        learning: Learning {
            refine: args.refine,
            save: args.save.clone(),
        },
        shown,
        patience: Duration::from_secs_f64(args.patience.unwrap_or(settings::PATIENCE_S)),
    };
    let (notices, heard) = mpsc::unbounded_channel();
    let progress = std::io::stderr().is_terminal() && !args.json;
    let listener = tokio::spawn(report::listen_to(
        heard,
        log.clone(),
        epoch,
        progress,
        played,
    ));
    let complain = |e| log.note(&format!("{e}; the robot is trusted as before"));
    let done = tokio::select! {
        done = daemon.run(&mut task, quit, words, &notices) => Some(done),
        () = source.follow(&trust, complain) => None,
    };
    Supervisor::from_environment().stopping();
    drop(notices);
    let played = listener.await.context("the log ended early")?;
    let summary = done.context("the peer file is not followed any more")??;
    if let Some(scores) = played.and_then(|played| played.scores()) {
        log.say(&scores);
    }
    log.say(&Event::done(&summary, &task, epoch, config.input_latency_s));
    // Its recording says what became of it.
    drop(task);
    drop(log);
    printing.finish();
    match summary.outcome {
        Outcome::Completed => Ok(()),
        Outcome::Interrupted(why) => bail!("{why}"),
    }
}

/// Serves metrics from now on; they are to be sent here.
fn serve_metrics(addr: SocketAddr, log: &report::Log) -> anyhow::Result<watch::Sender<Snapshot>> {
    let (shown, seen) = watch::channel(Snapshot::default());
    let addr = metrics::serve(addr, move || seen.borrow().page())?;
    let url = format!("http://{addr}/metrics");
    log.say(&Event::Metrics { url });
    Ok(shown)
}

/// Tells a supervisor that we are ready and, for as long as this thread goes round, alive.
fn supervised(status: &str) {
    let mut supervisor = Supervisor::from_environment();
    supervisor.ready(status);
    if let Some(every) = supervisor.every() {
        tokio::spawn(async move {
            let clock = HostClock::new();
            let mut due = tokio::time::interval(every / 2);
            loop {
                due.tick().await;
                supervisor.alive(clock.now());
            }
        });
    }
}

/// An address of ours from which `to` can be reached.
fn any_port(to: SocketAddr) -> SocketAddr {
    SocketAddr::from(if to.is_ipv4() {
        (std::net::IpAddr::from([0; 4]), 0)
    } else {
        (std::net::IpAddr::from([0; 16]), 0)
    })
}

fn make_task(
    args: &Args,
    skills: &Skills,
    rotation: UnitQuaternion<f64>,
    log: &report::Log,
) -> anyhow::Result<(Task, Option<Played>)> {
    match (&args.replay[..], &args.play) {
        ([first, then @ ..], None) => {
            let rest_s = args.rest.unwrap_or(settings::REST_S);
            let recording = |path: &PathBuf| -> anyhow::Result<Recording> {
                let samples = skills.unseen(path)?.samples().to_vec();
                Ok(Recording { samples, rest_s })
            };
            let mut task = Task::replay(recording(first)?);
            for path in then {
                task = task.and_then(recording(path)?);
            }
            Ok((task, None))
        }
        ([], Some(name)) => {
            let skill = skills.named(name)?;
            let derived = Bounds::of(&skill);
            let bounds = Bounds {
                place_m: args.bound.unwrap_or(derived.place_m),
                turn_rad: args.turn_bound.unwrap_or(derived.turn_rad),
            };
            let (plan, report) = infer(&skill, bounds, &args.frame)?;
            log.say(&Event::Plan(report));
            // Demonstrations that went elsewhere are no measure of a motion with its frames moved.
            let shown = skills.aligned(name).filter(|_| args.frame.is_empty());
            let curve = plan.curve()?;
            let task = match &args.correct {
                Some(path) => {
                    let samples = correction(path, curve.end_s())?;
                    let motion = Motion::new(&skill, &args.frame)?;
                    let leeway = Leeway::of(&motion, skill.duration_s());
                    Task::play_corrected(plan, leeway, samples)
                }
                None => Task::play(plan),
            };
            Ok((task, Some(Played::new(curve, shown, rotation))))
        }
        ([_, ..], _) if args.correct.is_some() => {
            bail!("--correct bends a skill that is played; a replay is the hand itself")
        }
        _ => match args.console {
            Some(addr) => Ok((Task::live(person(args, addr, skills, log)?), None)),
            None => {
                bail!("what to do? Give --input SOURCE, --replay FILE, --play SKILL or --console")
            }
        },
    }
}

/// A person at the page, which is served from now on.
fn person(
    args: &Args,
    addr: SocketAddr,
    skills: &Skills,
    log: &report::Log,
) -> anyhow::Result<Live> {
    let config = args.session()?;
    let known = skills.all().iter().map(|skill| Known {
        skill: Arc::clone(skill),
        plan: infer(skill, Bounds::of(skill), &[])
            .ok()
            .map(|(plan, _)| plan),
    });
    let (live, port) = console::seat(
        config.rotation,
        config.gain,
        known.collect(),
        args.console_link,
    );
    let url = console::serve(addr, cli::secret()?, port)?;
    log.say(&Event::Console { url });
    Ok(live)
}

/// The hand that corrects a play of `end_s`.
fn correction(path: &Path, end_s: f64) -> anyhow::Result<Vec<Sample>> {
    let recording = Demonstration::read_beside(path)?;
    let first_s = recording.samples()[0].t_s;
    if !(0.0..end_s).contains(&first_s) {
        bail!(
            "{}: the first sample is at {first_s:.2} s, but its times count from when the robot begins a motion of {end_s:.2} s",
            path.display()
        );
    }
    Ok(recording.samples().to_vec())
}
