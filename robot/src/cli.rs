//! The robot daemon's command line: flags over a TOML file over defaults.

mod record;
mod report;

use std::io::IsTerminal;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Context;
use serde::Deserialize;
use telemime_endpoint::admin;
use telemime_endpoint::cli::{self, Printer};
use telemime_endpoint::pairing::Own;
use telemime_endpoint::peers::{Role, Source, Whom};
use telemime_endpoint::{External, Fingerprint, HostClock, Identity, Meter, Trust, quic};
use telemime_sim::arm::LoadOptions;
use telemime_sim::link::parse_duration_s;
use tokio::sync::mpsc;

use crate::clock::Origin;
use crate::control::ControlConfig;
use crate::daemon::{Daemon, Notice};
use crate::desk::Desk;
use crate::refused::Refused;
use crate::rig::{Rig, RigOptions};
use crate::servo::{self, Ticket};
use crate::session::SessionConfig;
use record::Recorder;
pub use report::Event;
use report::{Log, engaged, nth};

/// Drive an arm for an operator.
///
/// Nobody is let in whose key is not known: pair an operator (--pair, or pair on the terminal, and `telemime pair`
/// at the operator), or give the fingerprint it prints with --peer. On the terminal, type stop (emergency stop,
/// latched), reset, pair, yes, no or quit.
#[derive(clap::Args, Debug, Clone, Default)]
pub struct Args {
    /// Read settings from this TOML file; flags override it.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Listen for the operator on this UDP address [default: 0.0.0.0:4433].
    #[arg(long, value_name = "ADDR")]
    pub listen: Option<SocketAddr>,
    /// This robot's private key, made if missing [default: ~/.config/telemime/robot.key].
    #[arg(long, value_name = "FILE")]
    pub identity: Option<PathBuf>,
    /// Fingerprint of an operator to let in, besides those in the peer file; may be repeated.
    #[arg(long, value_name = "FINGERPRINT")]
    pub peer: Vec<String>,
    /// The operators that were paired; changes are noticed [default: ~/.config/telemime/peers].
    #[arg(long, value_name = "FILE")]
    pub peer_file: Option<PathBuf>,
    /// Open a pairing window at the start, for this long [60s if nothing is said].
    #[arg(long, value_name = "TIME", num_args = 0..=1, default_missing_value = "60s", value_parser = cli::seconds)]
    pub pair: Option<Duration>,
    /// Pair only with the key of this fingerprint, and without asking.
    #[arg(long, value_name = "FINGERPRINT")]
    pub pair_expect: Option<String>,
    /// The system clock is kept right (by PTP, chrony or the like) to within this, 50us for example; if the operator's
    /// is too, a path slower one way than the other is seen [default: round trips alone].
    #[arg(long, value_name = "TIME", value_parser = cli::dispersion)]
    pub clock_dispersion: Option<Duration>,
    /// What this robot calls itself to operators that pair [default: the host's name].
    #[arg(long, value_name = "NAME")]
    pub name: Option<String>,
    /// The arm [default: a 7-axis arm of our own].
    #[arg(long, value_name = "FILE")]
    pub urdf: Option<PathBuf>,
    /// The link that follows the hand [default: tool0, tcp, or the deepest link].
    #[arg(long, value_name = "LINK")]
    pub tip: Option<String>,
    /// Fix a joint that is not on the way to the tip (a finger); may be repeated.
    #[arg(long, value_name = "JOINT=VALUE", value_parser = parse_fixed)]
    pub fixed: Vec<(String, f64)>,
    /// Start posture, one value per joint, rad or m [default: searched].
    #[arg(
        long,
        value_name = "Q1,Q2,…",
        value_delimiter = ',',
        allow_negative_numbers = true
    )]
    pub start: Option<Vec<f64>>,
    /// The arm obeys this much late, 0 to 50ms; the prediction makes up for it [default: 0ms].
    #[arg(long, value_name = "TIME", value_parser = parse_duration_s)]
    pub dead_time: Option<f64>,
    /// Bandwidth of the filter between prediction and arm, rad/s: less is smoother, and farther behind [default: 45].
    #[arg(long, value_name = "RAD_S")]
    pub bandwidth: Option<f64>,
    /// Speak protocol versions up to this one; 2 is an experiment [default: 1].
    #[arg(long, value_name = "N")]
    pub protocol_max: Option<u16>,
    /// Write every tick to this CSV file.
    #[arg(long, value_name = "FILE")]
    pub record: Option<PathBuf>,
    /// Print events as JSON lines on stdout.
    #[arg(long)]
    pub json: bool,
    /// Stop when stdin ends: for a parent process that must not leave orphans.
    #[arg(long, hide = true)]
    pub follow_stdin: bool,
}

/// The TOML file; every key may be left out.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    listen: Option<SocketAddr>,
    identity: Option<PathBuf>,
    #[serde(default)]
    peers: Vec<String>,
    peer_file: Option<PathBuf>,
    name: Option<String>,
    clock_dispersion: Option<String>,
    urdf: Option<PathBuf>,
    tip: Option<String>,
    #[serde(default)]
    fixed: std::collections::BTreeMap<String, f64>,
    start: Option<Vec<f64>>,
    dead_time_s: Option<f64>,
    bandwidth_rad_s: Option<f64>,
    protocol_max: Option<u16>,
    record: Option<PathBuf>,
}

fn parse_fixed(text: &str) -> Result<(String, f64), String> {
    let (joint, value) = text.split_once('=').ok_or("write JOINT=VALUE")?;
    let value = value
        .parse::<f64>()
        .map_err(|e| format!("`{value}`: {e}"))?;
    Ok((joint.to_owned(), value))
}

/// Runs the daemon until it is told to stop.
///
/// # Errors
/// One line that says what to do.
pub fn run(args: &Args) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("no runtime")?;
    runtime.block_on(serve(args))
}

async fn serve(args: &Args) -> anyhow::Result<()> {
    let file = match &args.config {
        Some(path) => read_config(path)?,
        None => File::default(),
    };
    let identity = args.identity.clone().or(file.identity);
    let key_file = identity.unwrap_or_else(|| admin::key_file(Role::Robot));
    let identity = Identity::load_or_create(&key_file)?;
    let given = if args.peer.is_empty() {
        file.peers
    } else {
        args.peer.clone()
    };
    let given = given
        .iter()
        .map(|p| p.parse())
        .collect::<Result<Vec<Fingerprint>, _>>()?;
    let expected = args.pair_expect.as_ref().map(|text| text.parse());
    let expected: Option<Fingerprint> = expected.transpose()?;
    let dispersion = file.clock_dispersion.as_deref().map(cli::dispersion);
    let dispersion = dispersion.transpose().map_err(anyhow::Error::msg)?;
    let dispersion = args.clock_dispersion.or(dispersion);
    let peer_file = args.peer_file.clone().or(file.peer_file);
    let source = Source {
        path: peer_file.unwrap_or_else(admin::peer_file),
        whom: Whom::Operators(given),
    };
    let trust = Trust::new([]);
    source.read(&trust)?;
    let own = Own {
        name: admin::own_name(args.name.as_deref().or(file.name.as_deref()))?,
        key: identity.fingerprint(),
    };
    let mut desk = Desk::new(own, trust.clone(), Some(source.path.clone())).expecting(expected);
    let mut fixed = file.fixed;
    fixed.extend(args.fixed.iter().cloned());
    let options = RigOptions {
        urdf: args.urdf.clone().or(file.urdf),
        load: LoadOptions {
            tip: args.tip.clone().or(file.tip),
            fixed,
        },
        start: args.start.clone().or(file.start),
        control: ControlConfig {
            dead_time_s: args.dead_time.or(file.dead_time_s).unwrap_or(0.0),
            omega: args
                .bandwidth
                .or(file.bandwidth_rad_s)
                .unwrap_or(ControlConfig::default().omega),
            ..ControlConfig::default()
        },
        ..RigOptions::default()
    };
    let rig = Rig::load(&options)?;
    // Of our own arm there is nothing to tell.
    if options.urdf.is_some() {
        for notice in rig.arm.notices() {
            eprintln!("note: {notice}");
        }
    }
    let recorder = args
        .record
        .clone()
        .or(file.record)
        .map(|path| Recorder::start(&path, rig.arm.dof()))
        .transpose()?;
    let listen = args
        .listen
        .or(file.listen)
        .unwrap_or_else(|| SocketAddr::from(([0, 0, 0, 0], 4433)));
    let socket = quic::Socket::bind(listen).with_context(|| {
        format!("cannot listen on {listen}: choose another --listen, or stop what uses it")
    })?;
    let deaf = !args.follow_stdin && !std::io::stdin().is_terminal();
    if trust.is_empty() && args.pair.is_none() && !args.json {
        eprintln!(
            "note: no operator is known, so nobody will be let in: pair one (pair, or --pair), or give --peer"
        );
    }
    if args.pair.is_some() && expected.is_none() && deaf {
        eprintln!(
            "note: stdin is no terminal, so nobody can say yes to a code: give --pair-expect FINGERPRINT"
        );
    }
    let endpoint = quic::server(&identity, &trust, socket, &Meter::default())?;
    let addr = endpoint.local_addr()?;
    let (rings, handle) = servo::rings();
    let running = servo::thread::Servo::start(rig.servo(rings)).context("no servo thread")?;
    let brake = handle.brake.clone();
    let (quit, words) = cli::listen(args.follow_stdin, cli::ROBOT_WORDS, move || {
        brake.stop_here()
    })?;
    let (out, printing) = Printer::start().context("no thread to print from")?;
    let log = Log {
        json: args.json,
        out,
    };
    log.say(
        &Event::Listening {
            addr,
            fingerprint: identity.fingerprint().to_string(),
            arm: rig.arm.name().to_owned(),
            joints: rig.arm.dof(),
            lag_s: rig.lag_s(),
            radius_m: rig.workspace.radius_m,
        },
        || {
            format!(
                "{} ({} joints) listens on {addr}\nfingerprint {}\nin short    {}",
                rig.arm.name(),
                rig.arm.dof(),
                identity.fingerprint(),
                identity.fingerprint().short()
            )
        },
    );
    if let Some(span) = args.pair {
        log.pairing(&desk.open(span));
    }
    let daemon = Daemon::new(
        endpoint,
        HostClock::new(),
        rig.info(),
        SessionConfig {
            versions: cli::versions(args.protocol_max.or(file.protocol_max))?,
            ..SessionConfig::default()
        },
        handle,
        Some(running.timing.clone()),
        desk,
    );
    let daemon = daemon
        .with_external(dispersion.map(External::host))
        .showing(rig.described());
    let (notices, heard) = mpsc::unbounded_channel();
    let listener = tokio::spawn(listen_to(heard, log.clone(), recorder));
    let served = tokio::select! {
        served = daemon.run(quit, words, notices) => served,
        () = source.follow(&trust, |e| eprintln!("note: {e}; whoever was trusted still is")) => Ok(()),
    };
    let recorder = listener.await.context("the log ended early")?;
    let (ticks, mean_ns, p99_ns, overruns) = running.timing.read();
    // The servo outlives everything that could still ask for motion; it ends at rest.
    drop(running);
    log.say(
        &Event::Servo {
            ticks,
            mean_ns,
            p99_ns,
            overruns,
        },
        || {
            format!(
                "servo: {ticks} ticks, {:.1} µs mean, {:.1} µs p99, {overruns} late",
                f64::from(mean_ns) * 1e-3,
                f64::from(p99_ns) * 1e-3
            )
        },
    );
    drop(log);
    printing.finish();
    if let Some(recorder) = recorder {
        recorder.finish()?;
    }
    Ok(served?)
}

fn read_config(path: &Path) -> anyhow::Result<File> {
    let text =
        std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    toml::from_str(&text).map_err(|e| anyhow::anyhow!("{}: {e}", path.display()))
}

async fn listen_to(
    mut heard: mpsc::UnboundedReceiver<Notice>,
    log: Log,
    mut recorder: Option<Recorder>,
) -> Option<Recorder> {
    let (mut transitions, mut engagement) = (None, Ticket::default());
    while let Some(notice) = heard.recv().await {
        match notice {
            Notice::Report(report) => {
                if let Some(recorder) = &mut recorder {
                    recorder.take(&report);
                }
                if transitions != Some(report.transitions) {
                    transitions = Some(report.transitions);
                    let (state, cause) =
                        (format!("{:?}", report.state), format!("{:?}", report.cause));
                    let text = format!("{state} ({cause})");
                    log.say(
                        &Event::State {
                            state,
                            cause,
                            mono_ns: report.at.0,
                        },
                        || text,
                    );
                }
                if report.engagement != engagement {
                    engagement = report.engagement;
                    log.say(&engaged(&report), || {
                        format!(
                            "engaged #{} at scale {:.3}",
                            engagement.number, report.mapping.scale
                        )
                    });
                }
            }
            Notice::Connected {
                epoch,
                version,
                peer,
            } => {
                let connected = Event::Connected {
                    epoch,
                    version: version.number(),
                    peer,
                };
                log.say(&connected, || format!("operator {peer} (session {epoch})"));
            }
            Notice::Disconnected {
                why,
                clock,
                origin,
                counters,
            } => {
                let event = Event::Disconnected {
                    why: why.clone(),
                    received: counters.received,
                    dropped: counters.dropped,
                    clock_offset_s: clock.map(|c| c.0),
                    clock_bound_s: clock.map(|c| c.1),
                    clock_origin: origin.word().to_owned(),
                };
                log.say(&event, || {
                    let clock = clock.map_or_else(String::new, |(_, bound_s)| {
                        let how = match origin {
                            Origin::RoundTrips => "",
                            Origin::Disciplined => " by the disciplined clocks",
                            Origin::Contradicted => {
                                " (the disciplined clocks are wrong by more than --clock-dispersion says: no round trip explains them)"
                            }
                        };
                        format!("; session clock known to ±{:.2} ms{how}", bound_s * 1e3)
                    });
                    format!(
                        "session ended: {why}; {} motions, {} dropped{clock}",
                        counters.received, counters.dropped
                    )
                });
            }
            Notice::Refused(refused) => {
                let Refused {
                    peer,
                    reason,
                    why,
                    times,
                } = refused;
                let text = format!("refused {peer}: {why}{}", nth(times));
                let event = Event::Refused {
                    reason: reason.word().to_owned(),
                    peer,
                    why,
                    times,
                };
                log.say(&event, || text);
            }
            Notice::Pairing(progress) => log.pairing(&progress),
            Notice::Path(knots) if log.json => log.say(&Event::Path { knots }, String::new),
            Notice::Path(_) => {}
        }
    }
    recorder
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_documented_configuration_is_understood_and_complete() {
        let text = include_str!("../../docs/commands.md");
        let example = text
            .split("```toml robot\n")
            .nth(1)
            .and_then(|rest| rest.split("```").next())
            .unwrap();
        let file: File = toml::from_str(example).unwrap();
        assert!(!format!("{file:?}").contains("None"), "a key is missing");
        assert_eq!((file.peers.len(), file.fixed["finger_joint"]), (1, 0.02));
    }
}
