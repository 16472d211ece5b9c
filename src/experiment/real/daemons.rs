//! The two processes, from first to last.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use telemime_endpoint::{HostClock, Identity, Mono};
use telemime_operator::cli::{Axes, Event as Operator};
use telemime_operator::session::FutureBound;
use telemime_operator::skill_file;
use telemime_robot::cli::Event as Robot;
use telemime_sim::link::{LinkConfig, Outage};
use tokio::sync::watch;
use tokio::time::timeout;

use super::super::drive::{REST_S, driven};
use super::super::factor::Settings;
use super::super::subject::Subject;
use super::netns::Namespaces;
use crate::ground::PATIENCE;
use crate::process::{Process, flag, listening, text, watch_robot};
use crate::relay::{Passage, Relay, RelayConfig};

/// Longer than its recording and this a run does not take, s: reaching the robot, the model, the rest, the end.
const MOST_BESIDE_S: f64 = 120.0;

/// What is driven, and how.
pub(super) struct Driven<'a> {
    pub(super) settings: &'a Settings,
    pub(super) subject: &'a Subject,
    pub(super) axes: Axes,
    pub(super) seed: u64,
    pub(super) scratch: &'a Path,
}

/// What a run leaves behind.
pub(super) struct Left {
    pub(super) robot: Vec<Robot>,
    pub(super) operator: Vec<Operator>,
    /// Every packet, where the link is ours.
    pub(super) passages: Option<Vec<Passage>>,
    /// Every tick.
    pub(super) ticks: PathBuf,
    /// Seconds of CPU per second, of operator and robot, from the mapping's agreement to the operator's result; none without
    /// the latter.
    pub(super) cpu: Option<(f64, f64)>,
    pub(super) took_s: f64,
}

/// CPU time of operator and robot at two moments.
#[derive(Default)]
struct Usage {
    begun: Option<(Instant, Duration, Duration)>,
    done: Option<(Instant, Duration, Duration)>,
}

impl Usage {
    fn shares(&self) -> Option<(f64, f64)> {
        let ((from, operator_0, robot_0), (to, operator, robot)) = (self.begun?, self.done?);
        let wall_s = (to - from).as_secs_f64();
        let share = |before, after: Duration| after.saturating_sub(before).as_secs_f64() / wall_s;
        (wall_s > 0.0).then(|| (share(operator_0, operator), share(robot_0, robot)))
    }
}

/// A robot that listens.
struct Called {
    robot: Process,
    events: Vec<Robot>,
    addr: SocketAddr,
    /// The operator's flags that say who it is and whom it calls.
    who: Vec<String>,
}

impl Driven<'_> {
    /// Over the relay, on the loopback interface.
    pub(super) async fn by_relay(&self) -> anyhow::Result<Left> {
        let local = SocketAddr::from(([127, 0, 0, 1], 0));
        let called = self.robot(&[], local).await?;
        let config = RelayConfig {
            listen: local,
            to: called.addr,
            up: self.with_outage(&self.settings.up),
            down: self.with_outage(&self.settings.down),
            seed: self.seed,
        };
        let (begin, beginnings) = watch::channel(None);
        let relay = Relay::bind(config, HostClock::new()).context("no port for the relay")?;
        let relay = relay.begun_by(beginnings);
        let via = relay.local_addr()?;
        let (quit, quit_rx) = watch::channel(false);
        let relaying = tokio::spawn(async move {
            let mut passages = Vec::new();
            relay.run(quit_rx, |passage| passages.push(passage)).await;
            passages
        });
        let left = self.operate(&[], called, via, |zero| {
            begin.send_replace(Some(zero));
        });
        let left = left.await;
        quit.send_replace(true);
        let passages = relaying.await.context("the relay ended early")?;
        Ok(Left {
            passages: Some(passages),
            ..left?
        })
    }

    /// Over a pair of virtual Ethernet devices that the kernel shapes.
    pub(super) async fn by_kernel(&self, spaces: &Namespaces) -> anyhow::Result<Left> {
        let called = self.robot(&spaces.robot(), spaces.robot_addr()).await?;
        let addr = called.addr;
        self.operate(&spaces.operator(), called, addr, |_| ()).await
    }

    /// The outage is part of the link, whose time is the recording's.
    fn with_outage(&self, link: &LinkConfig) -> LinkConfig {
        let mut link = link.clone();
        if let Some((from_s, to_s)) = self.settings.outage_s {
            link.outages.push(Outage {
                from_s,
                to_s,
                every_s: None,
            });
        }
        link
    }

    async fn robot(&self, by: &[String], listen: SocketAddr) -> anyhow::Result<Called> {
        let settings = self.settings;
        let key = |name: &str| self.scratch.join(name);
        let (robot_key, operator_key) = (key("robot.key"), key("operator.key"));
        let robot_is = Identity::load_or_create(&robot_key)?.fingerprint();
        let operator_is = Identity::load_or_create(&operator_key)?.fingerprint();
        let peers = text(&key("peers"));
        let words = |words: &[(&str, String)]| -> Vec<String> {
            let each = words.iter();
            each.flat_map(|(flag, value)| [(*flag).to_owned(), value.clone()])
                .collect()
        };
        let mut args = words(&[
            ("--listen", listen.to_string()),
            ("--identity", text(&robot_key)),
            ("--peer", operator_is.to_string()),
            ("--peer-file", peers.clone()),
            ("--record", text(&self.ticks())),
            ("--bandwidth", settings.omega.to_string()),
            ("--dead-time", format!("{}us", settings.dead_time_s * 1e6)),
        ]);
        args.extend(flag("--urdf", settings.arm.as_deref().map(text)));
        let mut robot = Process::start_by(by, "robot", &args)?;
        let mut events = Vec::new();
        let addr = listening(&mut robot, &mut events).await?;
        Ok(Called {
            robot,
            events,
            addr,
            who: words(&[
                ("--identity", text(&operator_key)),
                ("--peer", robot_is.to_string()),
                ("--peer-file", peers),
            ]),
        })
    }

    fn ticks(&self) -> PathBuf {
        self.scratch.join("ticks.csv")
    }

    /// What the operator is told to do; writes what it needs.
    fn task(&self) -> anyhow::Result<Vec<String>> {
        let settings = self.settings;
        let skill = self.scratch.join("driven.skill");
        skill_file::save(&self.subject.skill, &skill)?;
        let recording = self.scratch.join("driven.csv");
        std::fs::write(&recording, driven(settings, self.subject).to_csv())?;
        let bound = match settings.future {
            FutureBound::Share(share) => format!("{share}way"),
            FutureBound::Relative(sigmas) => format!("{sigmas}sigma"),
            FutureBound::Absolute(m) => format!("{m}m"),
        };
        let mut args = Vec::new();
        for (name, value) in [
            ("--skill", text(&skill)),
            ("--replay", text(&recording)),
            ("--rest", REST_S.to_string()),
            ("--patience", PATIENCE.as_secs_f64().to_string()),
            ("--axes", format!("{:?}", self.axes).to_lowercase()),
            ("--future-bound", bound),
            ("--max-silence", settings.silence_s.to_string()),
            ("--lease", settings.lease_s.to_string()),
            ("--gain", settings.gain.to_string()),
            (
                "--input-latency",
                format!("{}ms", settings.input_latency_s * 1e3),
            ),
        ] {
            args.extend([name.to_owned(), value]);
        }
        args.extend(flag("--path-bound", settings.path_m));
        args.extend(flag("--scale", settings.scale));
        Ok(args)
    }

    /// The operator, from its start until both are gone; `begin` hears when the recording's time will be 0.
    async fn operate(
        &self,
        by: &[String],
        called: Called,
        connect: SocketAddr,
        begin: impl Fn(Mono),
    ) -> anyhow::Result<Left> {
        let began = Instant::now();
        let Called {
            mut robot,
            events: mut robot_events,
            who,
            ..
        } = called;
        let mut args = vec!["--connect".to_owned(), connect.to_string()];
        args.extend(who);
        args.extend(self.task()?);
        let mut operator = Process::start_by(by, "operator", &args)?;
        let mut operator_events = Vec::new();
        let samples = driven(self.settings, self.subject).samples();
        let length_s = samples[samples.len() - 1].t_s - samples[0].t_s;
        let most = Duration::from_secs_f64(length_s + MOST_BESIDE_S);
        let clock = HostClock::new();
        let zero_s = REST_S - self.settings.input_latency_s;
        let mut used = Usage::default();
        let (operator_used, robot_used) = (operator.cpu_time(), robot.cpu_time());
        let read = || Some((Instant::now(), operator_used.read()?, robot_used.read()?));
        let driving = async {
            let mut known = false;
            while let Some(event) = operator.next().await? {
                // Said when the robot is ready, which is when the rest begins.
                if matches!(event, Operator::Mapping { .. }) && !std::mem::replace(&mut known, true)
                {
                    begin(clock.now().offset_by_secs(zero_s));
                    used.begun = read();
                }
                if matches!(event, Operator::Done { .. }) {
                    used.done = read();
                }
                operator_events.push(event);
            }
            anyhow::Ok(())
        };
        let watched = tokio::select! {
            biased;
            _ = tokio::signal::ctrl_c() => Err(anyhow::anyhow!("stopped by hand; what is done is kept")),
            end = watch_robot(&mut robot, &mut robot_events) => end,
            done = timeout(most, driving) => match done {
                Ok(done) => done,
                Err(_) => Err(anyhow::anyhow!("the operator came to no end")),
            },
        };
        // Whatever happened, nobody is left behind: first the hand, then the arm.
        let left = operator.finish(&mut operator_events).await;
        let stopped = robot.finish(&mut robot_events).await;
        watched?;
        left?;
        stopped?;
        let told = |e: &Operator| matches!(e, Operator::Done { .. } | Operator::Dialling { .. });
        if !operator_events.iter().any(told) {
            bail!("the operator ended without a result; it says why above");
        }
        Ok(Left {
            robot: robot_events,
            operator: operator_events,
            passages: None,
            ticks: self.ticks(),
            cpu: used.shares(),
            took_s: began.elapsed().as_secs_f64(),
        })
    }
}
