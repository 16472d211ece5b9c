//! The robot daemon's command line: flags over a TOML file over defaults.

use std::io::IsTerminal;
use std::io::Write as _;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};
use std::time::Duration;

use anyhow::{Context, bail};
use serde::{Deserialize, Serialize};
use telemime_endpoint::admin;
use telemime_endpoint::cli::{self, Printer};
use telemime_endpoint::pairing::{Candidate, Own};
use telemime_endpoint::peers::{Role, Source, Whom};
use telemime_endpoint::{External, Fingerprint, HostClock, Identity, Meter, Trust, quic};
use telemime_sim::arm::LoadOptions;
use telemime_sim::link::parse_duration_s;
use tokio::sync::mpsc;

use crate::clock::Origin;
use crate::control::ControlConfig;
use crate::daemon::{Daemon, Notice};
use crate::desk::{Desk, Progress};
use crate::refused::Refused;
use crate::rig::{Rig, RigOptions};
use crate::servo::{self, Report, Ticket};
use crate::session::SessionConfig;

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

/// What the robot prints with `--json`; `docs/commands.md` lists the fields.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
#[expect(
    missing_docs,
    reason = "the fields are documented where users look: docs/commands.md"
)]
pub enum Event {
    Listening {
        addr: SocketAddr,
        fingerprint: String,
        arm: String,
        joints: usize,
        lag_s: f64,
        radius_m: f64,
    },
    Connected {
        epoch: u32,
        version: u16,
        peer: SocketAddr,
    },
    Disconnected {
        why: String,
        received: u32,
        dropped: u32,
        clock_offset_s: Option<f64>,
        clock_bound_s: Option<f64>,
        clock_origin: String,
    },
    Refused {
        reason: String,
        peer: SocketAddr,
        why: String,
        times: u32,
    },
    Pairing {
        stage: String,
        seconds: Option<f64>,
        name: Option<String>,
        fingerprint: Option<String>,
        code: Option<String>,
        why: Option<String>,
    },
    State {
        state: String,
        cause: String,
        mono_ns: i64,
    },
    Engaged {
        engagement: u32,
        mono_ns: i64,
        scale: f64,
        rotation: [f64; 4],
        hand_m: [f64; 3],
        tip_m: [f64; 3],
        hand_q: Option<[f64; 4]>,
        tip_q: [f64; 4],
    },
    Path {
        knots: Vec<(f64, [f64; 3], [f64; 3], bool)>,
    },
    Servo {
        ticks: u64,
        mean_ns: u32,
        p99_ns: u32,
        overruns: u32,
    },
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
    let daemon = daemon.with_external(dispersion.map(External::host));
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

#[derive(Clone)]
struct Log {
    json: bool,
    out: Printer,
}

impl Log {
    fn say(&self, event: &Event, text: impl FnOnce() -> String) {
        if self.json {
            self.out.emit(event);
        } else {
            self.out.say(text());
        }
    }

    fn pairing(&self, progress: &Progress) {
        let (stage, candidate) = match progress {
            Progress::Open(_) => ("open", None),
            Progress::TooSoon(_) => ("too_soon", None),
            Progress::Code(candidate) => ("code", Some(candidate)),
            Progress::Paired(candidate) => ("paired", Some(candidate)),
            Progress::Ended(_) => ("ended", None),
            Progress::Nothing => ("nothing", None),
        };
        let (seconds, why) = match progress {
            Progress::Open(span) | Progress::TooSoon(span) => (Some(span.as_secs_f64()), None),
            Progress::Ended(why) => (None, Some(why.to_string())),
            _ => (None, None),
        };
        let text = || match progress {
            Progress::Open(span) => format!(
                "pairing: the window is open for {:.0} s and one attempt; at the operator, run telemime pair HOST:PORT",
                span.as_secs_f64()
            ),
            Progress::TooSoon(span) => {
                format!(
                    "pairing: too soon after the last window; wait {:.0} s",
                    span.as_secs_f64().ceil()
                )
            }
            Progress::Code(Candidate { name, key, code }) => format!(
                "pairing: operator {name}, key {}\n\n    {code}\n\nDoes the operator show the same? Type yes or no.",
                key.short()
            ),
            Progress::Paired(Candidate { name, key, .. }) => {
                format!("pairing: operator {name} is trusted from now on\nfingerprint {key}")
            }
            Progress::Ended(why) => format!("pairing: ended without one: {why}"),
            Progress::Nothing => "pairing: there is nothing to say yes or no to".to_owned(),
        };
        let event = Event::Pairing {
            stage: stage.to_owned(),
            seconds,
            name: candidate.map(|c| c.name.to_string()),
            fingerprint: candidate.map(|c| c.key.to_string()),
            code: candidate.map(|c| c.code.to_string()),
            why,
        };
        self.say(&event, text);
    }
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

/// How often somebody was turned away, if not for the first time.
fn nth(times: u32) -> String {
    if times > 1 {
        format!(" (for the {times}th time)")
    } else {
        String::new()
    }
}

fn engaged(report: &Report) -> Event {
    let scalar_first = |q: &nalgebra::UnitQuaternion<f64>| [q.w, q.i, q.j, q.k];
    Event::Engaged {
        engagement: report.engagement.number,
        mono_ns: report.engaged_at.0,
        scale: report.mapping.scale,
        rotation: scalar_first(&report.mapping.rotation),
        hand_m: report.mapping.hand_m.into(),
        tip_m: report.mapping.tip_m.into(),
        hand_q: report.mapping.hand_orientation.as_ref().map(scalar_first),
        tip_q: scalar_first(&report.mapping.tip_orientation),
    }
}

/// Ticks on their way to the disk; a slow disk loses ticks, never the servo's time.
const QUEUE: usize = 8192;

/// Writes ticks to a CSV file from a thread of its own.
struct Recorder {
    path: PathBuf,
    queue: SyncSender<Report>,
    thread: std::thread::JoinHandle<std::io::Result<()>>,
    lost: u64,
}

impl Recorder {
    fn start(path: &Path, dof: usize) -> anyhow::Result<Self> {
        let file = std::fs::File::create(path)
            .with_context(|| format!("cannot write {}", path.display()))?;
        let (queue, reports) = sync_channel::<Report>(QUEUE);
        let thread = std::thread::Builder::new().name("recorder".into()).spawn(move || {
            let mut out = std::io::BufWriter::new(file);
            write!(out, "tick,mono_ns,state,engagement,age_s,clamps,tip_x,tip_y,tip_z,target_x,target_y,target_z,tip_qw,tip_qx,tip_qy,tip_qz,opening,jerk")?;
            (0..dof).try_for_each(|i| write!(out, ",q{i}"))?;
            writeln!(out)?;
            for r in reports {
                write!(out, "{},{},{:?},{},{:.6},{}", r.tick, r.at.0, r.state, r.engagement.number, r.age_s, r.clamps)?;
                let q = &r.orientation;
                let turn = [q.w, q.i, q.j, q.k, r.opening, r.jerk_m_s3];
                r.tip_m.iter().chain(&r.target_m).chain(&turn).try_for_each(|v| write!(out, ",{v:.6}"))?;
                r.q.iter().take(dof).try_for_each(|v| write!(out, ",{v:.6}"))?;
                writeln!(out)?;
            }
            out.flush()
        })?;
        Ok(Self {
            path: path.to_owned(),
            queue,
            thread,
            lost: 0,
        })
    }

    fn take(&mut self, report: &Report) {
        if let Err(TrySendError::Full(_)) = self.queue.try_send(*report) {
            self.lost += 1;
        }
    }

    fn finish(self) -> anyhow::Result<()> {
        let Self {
            path,
            queue,
            thread,
            lost,
        } = self;
        drop(queue);
        match thread.join() {
            Ok(written) => written.with_context(|| format!("cannot write {}", path.display()))?,
            Err(_) => bail!("the recorder of {} failed", path.display()),
        }
        if lost > 0 {
            eprintln!(
                "note: {lost} ticks are missing in {}: the disk was too slow",
                path.display()
            );
        }
        Ok(())
    }
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
