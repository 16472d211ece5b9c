//! The robot daemon's command line: flags over environment over a TOML file over defaults.

mod record;
mod report;
mod settings;
mod surroundings;

use std::io::IsTerminal;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, anyhow};
use telemime_endpoint::admin;
use telemime_endpoint::cli::{self, Printer};
use telemime_endpoint::config::{self, Settings};
use telemime_endpoint::pairing::Own;
use telemime_endpoint::peers::{Role, Source, Whom};
use telemime_endpoint::supervisor::Supervisor;
use telemime_endpoint::{
    External, Fingerprint, HostClock, Identity, Meter, Trust, logs, metrics, quic,
};
use telemime_sim::arm::Payload;
use telemime_sim::link::parse_duration_s;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;

use crate::blackbox::{Header, Keeper, Recorder, SPAN_S, taps};
use crate::clock::Origin;
use crate::daemon::{Attendant, Daemon, Failure, Notice};
use crate::desk::Desk;
use crate::driver::FASTEST_HZ;
use crate::driver::bridge::{Bridge, Words};
use crate::recording::Scribe;
use crate::refused::Refused;
use crate::rig::Rig;
use crate::servo::thread::Servo;
use crate::servo::{self, Priority, Ticket};
use crate::session::SessionConfig;
use record::TickRecorder;
pub use report::Event;
use report::{Log, engaged, nth};

/// Drive an arm for an operator.
///
/// Nobody is let in whose key is not known: pair an operator (--pair, or pair on the terminal, and `telemime pair`
/// at the operator), or give the fingerprint it prints with --peer. On the terminal, type stop (emergency stop,
/// latched; SIGUSR1 does the same), reset, blackbox, pair, yes, no or quit.
#[derive(clap::Args, Debug, Clone, Default)]
pub struct Args {
    /// Read settings from this TOML file; the environment (TELEMIME_ROBOT_…) overrides it, and flags both.
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
    /// What the tip carries: KG, KG@X,Y,Z (centre, m from the tip) or KG@X,Y,Z@IXX,IYY,IZZ (moments, kg·m²).
    #[arg(long, value_name = "KG[@X,Y,Z]")]
    pub payload: Option<Payload>,
    /// The tip, and the links that start there, stay above this height over the base, m.
    #[arg(long, value_name = "Z", allow_negative_numbers = true)]
    pub keep_above: Option<f64>,
    /// A surface the simulated tip may touch: all points with NX·x + NY·y + NZ·z = D, m, solid behind.
    #[arg(long, value_name = "NX,NY,NZ,D", allow_negative_numbers = true, value_parser = surroundings::four)]
    pub contact_plane: Option<[f64; 4]>,
    /// The arm obeys this much late, 0 to 50ms; the prediction makes up for it [default: 0ms].
    #[arg(long, value_name = "TIME", value_parser = parse_duration_s)]
    pub dead_time: Option<f64>,
    /// Bandwidth of the filter between prediction and arm, rad/s: less is smoother, and farther behind [default: 40].
    #[arg(long, value_name = "RAD_S")]
    pub bandwidth: Option<f64>,
    /// Joint impedance instead of computed torque: the strongest joint is a spring of this stiffness, N·m/rad, the others in
    /// proportion to their effort limits; what the arm runs into is pushed softly.
    #[arg(long, value_name = "NM_RAD")]
    pub stiffness: Option<f64>,
    /// Speak protocol versions up to this one; 2 is an experiment [default: 1].
    #[arg(long, value_name = "N")]
    pub protocol_max: Option<u16>,
    /// Record into this new file: NAME.mcap, a recording that Foxglove, Lichtblick and rerun open; any other name, every
    /// tick as CSV (into NAME-2 where NAME is there already).
    #[arg(long, value_name = "FILE")]
    pub record: Option<PathBuf>,
    /// Drive a real arm: this command (run by sh) tells its joints' state and takes setpoints, a JSON line each; docs/driver.md.
    #[arg(long, value_name = "COMMAND", conflicts_with = "start")]
    pub driver: Option<String>,
    /// The driver may be silent, or behind its setpoints, for this long before the arm is stopped: 10ms to 2s, and three of its periods [default: 100ms].
    #[arg(long, value_name = "TIME", value_parser = parse_duration_s)]
    pub driver_patience: Option<f64>,
    /// Run the servo at this real-time priority, 1 to 99 [50 if nothing is said], and lock memory, where the system allows it.
    #[arg(long, value_name = "PRIO", num_args = 0..=1, default_missing_value = "50")]
    pub realtime: Option<u8>,
    /// Keep the last two minutes of all that the servo is told and decides, and write them to this folder at stops and
    /// faults, on `blackbox` or on SIGUSR2; `telemime replay` reads them.
    #[arg(long, value_name = "DIR")]
    pub black_box: Option<PathBuf>,
    /// Serve metrics for Prometheus at http://ADDR/metrics [127.0.0.1:9433 if no address is given].
    #[arg(long, value_name = "ADDR", num_args = 0..=1, default_missing_value = METRICS)]
    pub metrics: Option<SocketAddr>,
    /// Show viewers (Foxglove, Lichtblick) at ws://ADDR what --record NAME.mcap would write, as it happens
    /// [127.0.0.1:8765 if no address is given]; only in a program built with `--features live`.
    #[arg(long, value_name = "ADDR", num_args = 0..=1, default_missing_value = FOXGLOVE)]
    pub foxglove: Option<SocketAddr>,
    /// Log to stderr what happens, each line with time and level, instead of telling it on stdout; RUST_LOG chooses what.
    #[arg(long, value_name = "FORMAT", value_enum)]
    pub log_format: Option<logs::Format>,
    /// Print an example of the configuration file, with the defaults, and end.
    #[arg(long)]
    pub print_config: bool,
    /// Print the configuration file's JSON Schema, and end.
    #[arg(long)]
    pub print_schema: bool,
    /// Print events as JSON lines on stdout.
    #[arg(long)]
    pub json: bool,
    /// What the file alone can set: planes the arm keeps clear of …
    #[arg(skip)]
    pub planes: Vec<[f64; 4]>,
    /// … whether its links are kept apart …
    #[arg(skip)]
    pub self_collision: Option<bool>,
    /// … how far, m …
    #[arg(skip)]
    pub stop_distance_m: Option<f64>,
    /// … and from how much farther on they are slowed, m.
    #[arg(skip)]
    pub slow_distance_m: Option<f64>,
    /// Stop when stdin ends: for a parent process that must not leave orphans.
    #[arg(long, hide = true)]
    pub follow_stdin: bool,
}

/// Where metrics are served unless said otherwise.
const METRICS: &str = "127.0.0.1:9433";

/// Where viewers connect unless said otherwise.
const FOXGLOVE: &str = "127.0.0.1:8765";

/// `JOINT=VALUE` as a joint's name and its value, rad or m.
///
/// # Errors
/// What is wrong with the text.
pub fn parse_fixed(text: &str) -> Result<(String, f64), String> {
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
    if args.print_config {
        return cli::say(config::example::<Args>().trim_end());
    }
    if args.print_schema {
        return cli::say(&serde_json::to_string_pretty(&config::schema::<Args>())?);
    }
    let args = args.settled(args.config.as_deref())?;
    let logging = logs::start(args.log_format)?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("no runtime")?;
    let served = runtime.block_on(serve(&args));
    if let Some(logging) = logging {
        logging.finish();
    }
    served
}

async fn serve(args: &Args) -> anyhow::Result<()> {
    let key_file = args.identity.clone();
    let key_file = key_file.unwrap_or_else(|| admin::key_file(Role::Robot));
    let identity = Identity::load_or_create(&key_file)?;
    let given = args.fingerprints()?;
    let expected = args.pair_expect.as_ref().map(|text| text.parse());
    let expected: Option<Fingerprint> = expected.transpose()?;
    let source = Source {
        path: args.peer_file.clone().unwrap_or_else(admin::peer_file),
        whom: Whom::Operators(given),
    };
    let trust = Trust::new([]);
    source.read(&trust)?;
    let own = Own {
        name: admin::own_name(args.name.as_deref())?,
        key: identity.fingerprint(),
    };
    let mut desk = Desk::new(own, trust.clone(), Some(source.path.clone())).expecting(expected);
    let mut bridge = args.driver.as_deref().map(Bridge::start).transpose()?;
    let rate_hz = bridge
        .as_ref()
        .map_or(FASTEST_HZ, |bridge| bridge.hello.rate_hz);
    let driving = args.driving(rate_hz)?;
    let priority = args.realtime.map(Priority::new).transpose()?;
    let mut options = args.rig_options()?;
    if let Some(bridge) = &bridge {
        options.start = Some(bridge.posture());
    }
    let (urdf, text) = Rig::text(options.urdf.as_deref())?;
    if let Some(bridge) = &bridge {
        // Before the posture is looked at: it is one of the driver's joints.
        bridge.fits(&Rig::arm(&urdf, &text, &options)?)?;
    }
    let rig = Rig::read(urdf, &text, &options).map_err(settings::unusable)?;
    // Of our own arm there is nothing to tell.
    if options.urdf.is_some() {
        for notice in rig.arm.notices() {
            logs::note(&notice.to_string());
        }
    }
    for pair in rig.close_at_start() {
        logs::note(&pair.to_string());
    }
    let recorder = record::ticks(args.record.as_deref(), &rig)?;
    let listen = match args.listen {
        Some(addr) => addr,
        None => settings::LISTEN.parse().context("the usual address")?,
    };
    let socket = quic::Socket::bind(listen).with_context(|| {
        format!("cannot listen on {listen}: choose another --listen, or stop what uses it")
    })?;
    let deaf = !args.follow_stdin && !std::io::stdin().is_terminal();
    if trust.is_empty() && args.pair.is_none() && !args.json {
        logs::note(
            "no operator is known, so nobody will be let in: pair one (pair, or --pair), or give --peer",
        );
    }
    if args.pair.is_some() && expected.is_none() && deaf {
        logs::note(
            "stdin is no terminal, so nobody can say yes to a code: give --pair-expect FINGERPRINT",
        );
    }
    let meter = Meter::default();
    let endpoint = quic::server(&identity, &trust, socket, &meter)?;
    let addr = endpoint.local_addr()?;
    let (rings, handle) = servo::rings();
    let mut station = match &mut bridge {
        Some(bridge) => {
            let arm = bridge.arm(rig.arm.clone(), driving)?;
            rig.servo_before(Box::new(arm), bridge.state.opening, rings)
        }
        None => rig.servo(rings),
    };
    let (out, printing) = Printer::start().context("no thread to print from")?;
    let log = Log {
        json: args.json,
        out,
    };
    let scribe = record::scribe(args.record.as_deref(), args.foxglove, &rig, &log)?;
    let live = scribe.as_ref().and_then(Scribe::live);
    let keeper = match args.black_box.clone() {
        Some(dir) => {
            // Better now than after the stop that it was for.
            std::fs::create_dir_all(&dir)
                .and_then(|()| tempfile::tempfile_in(&dir))
                .with_context(|| format!("--black-box {} cannot be written", dir.display()))?;
            let (tap, feed) = taps(&station.room());
            station = station.recorded(tap);
            let recorder = Recorder::new(Header::new(&rig, args.driver.clone()), feed, SPAN_S);
            let log = log.clone();
            let say = move |news| log.black_box(&news);
            Some(Keeper::start(recorder, &dir, say).context("no thread for the black box")?)
        }
        None => None,
    };
    let asker = keeper.as_ref().map(Keeper::asker);
    let running = Servo::start(station, priority).context("no servo thread")?;
    let (brake, by_signal) = (handle.brake.clone(), handle.brake.clone());
    on_signal(SignalKind::user_defined1(), move || by_signal.stop_here())?;
    let by_signal = asker.clone();
    on_signal(SignalKind::user_defined2(), move || match &by_signal {
        Some(asker) => asker.ask(),
        None => logs::note("SIGUSR2, but there is no black box: give --black-box DIR"),
    })?;
    let (quit, words) = cli::listen(args.follow_stdin, cli::ROBOT_WORDS, move || {
        brake.stop_here()
    })?;
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
    if let Some(Bridge { command, hello, .. }) = &bridge {
        let event = Event::Driver {
            command: command.clone(),
            joints: hello.joints.clone(),
            rate_hz: hello.rate_hz,
        };
        log.say(&event, || format!("driver {command}, {} Hz", hello.rate_hz));
    }
    if let Some(granted) = &running.realtime {
        log.realtime(granted);
    }
    if let Some(span) = args.pair {
        log.pairing(&desk.open(span));
    }
    let daemon = Daemon::new(
        endpoint,
        HostClock::new(),
        rig.info(),
        SessionConfig {
            versions: cli::versions(args.protocol_max)?,
            ..SessionConfig::default()
        },
        handle,
        Some(running.timing.clone()),
        desk,
    );
    let supervisor = Supervisor::from_environment();
    supervisor.ready(&format!("{} listens on {addr}", rig.arm.name()));
    let (attendant, shown) = Attendant::new(supervisor, meter);
    if let Some(addr) = args.metrics {
        let arm = rig.arm.name().to_owned();
        let addr = metrics::serve(addr, move || shown.borrow().page(&arm))?;
        let url = format!("http://{addr}/metrics");
        log.say(&Event::Metrics { url: url.clone() }, || {
            format!("metrics {url}")
        });
    }
    let daemon = daemon
        .attended(Some(attendant))
        .with_external(args.clock_dispersion.map(External::host))
        .showing(rig.described())
        .with_black_box(asker)
        .recorded(scribe);
    if let Some(addr) = live {
        let url = format!("ws://{addr}");
        log.say(&Event::Foxglove { url: url.clone() }, || {
            format!("viewers {url}")
        });
    }
    let (notices, heard) = mpsc::unbounded_channel();
    let listener = tokio::spawn(listen_to(
        heard,
        log.clone(),
        recorder,
        bridge.as_ref().map(Bridge::words),
    ));
    let served = tokio::select! {
        served = daemon.run(quit, words, notices) => served,
        () = source.follow(&trust, |e| logs::note(&format!("{e}; whoever was trusted still is"))) => Ok(()),
    };
    let recorder = listener.await.context("the log ended early")?;
    let timing = running.timing.clone();
    // The servo outlives everything that could still ask for motion; it ends at rest, and after it its driver and its record.
    drop(running);
    let words = bridge.as_ref().map(Bridge::words);
    drop(bridge);
    drop(keeper);
    log.servo(&timing.read());
    drop(log);
    printing.finish();
    let recorded = recorder.map_or(Ok(()), TickRecorder::finish);
    let served = match (served, words.and_then(|words| words.get())) {
        (Err(failure @ Failure::Arm(_)), Some(words)) => Err(anyhow!("{failure}: {words}")),
        (served, _) => served.map_err(anyhow::Error::from),
    };
    outcome(served, recorded)
}

/// Why the robot ended comes before what was not recorded of it, which is noted then.
fn outcome(served: anyhow::Result<()>, recorded: anyhow::Result<()>) -> anyhow::Result<()> {
    match (served, recorded) {
        (Err(failure), Err(unrecorded)) => {
            logs::note(&format!("{unrecorded:#}"));
            Err(failure)
        }
        (served, recorded) => served.and(recorded),
    }
}

/// Calls `then` on every signal of that kind.
fn on_signal(kind: SignalKind, then: impl Fn() + Send + 'static) -> anyhow::Result<()> {
    let mut signals = signal(kind).context("signals cannot be caught")?;
    tokio::spawn(async move {
        while signals.recv().await.is_some() {
            then();
        }
    });
    Ok(())
}

async fn listen_to(
    mut heard: mpsc::UnboundedReceiver<Notice>,
    log: Log,
    mut recorder: Option<TickRecorder>,
    words: Option<Words>,
) -> Option<TickRecorder> {
    let (mut transitions, mut engagement) = (None, Ticket::default());
    let mut faulty = false;
    while let Some(notice) = heard.recv().await {
        match notice {
            Notice::Report(report) => {
                if let Some(recorder) = &mut recorder {
                    recorder.take(&report);
                }
                if let Some(fault) = report.fault.filter(|_| !faulty) {
                    faulty = true;
                    let words = words.as_ref().and_then(Words::get);
                    let why = words.map_or_else(|| fault.to_string(), |w| format!("{fault}: {w}"));
                    let text = format!("the arm: {why}");
                    log.say(&Event::ArmFault { fault, why }, || text);
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
                seen,
            } => {
                let event = Event::Disconnected {
                    why: why.clone(),
                    received: counters.received,
                    dropped: counters.dropped,
                    clock_offset_s: clock.map(|c| c.0),
                    clock_bound_s: clock.map(|c| c.1),
                    clock_origin: origin.word().to_owned(),
                    up: seen.up,
                    down_delay: seen.down,
                    age: seen.age,
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
                    let age = seen
                        .age
                        .map_or_else(String::new, |age| format!("; what was followed was {age} old"));
                    format!(
                        "session ended: {why}; motions: {}, {} dropped{age}{clock}",
                        seen.up, counters.dropped
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
    fn what_stopped_the_robot_is_told_before_what_was_not_recorded() {
        let failed = || Err(anyhow!("the arm was stopped"));
        let unrecorded = || Err(anyhow!("cannot write ticks.csv"));
        for (served, recorded, told) in [
            (Ok(()), Ok(()), None),
            (Ok(()), unrecorded(), Some("cannot write ticks.csv")),
            (failed(), Ok(()), Some("the arm was stopped")),
            (failed(), unrecorded(), Some("the arm was stopped")),
        ] {
            let error = outcome(served, recorded).err().map(|e| e.to_string());
            assert_eq!(error.as_deref(), told);
        }
    }
}
