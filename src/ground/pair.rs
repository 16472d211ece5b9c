//! Both daemons on one virtual clock.

use std::cell::RefCell;
use std::future::Future;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

use telemime_endpoint::cli::Word;
use telemime_endpoint::quic::EndpointError;
use telemime_endpoint::{HostClock, Identity, IdentityError, Meter, Mono, quic};
use telemime_operator::daemon::{
    Daemon as OperatorDaemon, DaemonError, Learning, Notice as OperatorNotice, Summary,
};
use telemime_operator::session::SessionConfig;
use telemime_operator::task::Task;
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;
use telemime_robot::daemon::{Daemon as RobotDaemon, Notice as RobotNotice};
use telemime_robot::rig::Rig;
use telemime_robot::servo::{self, Report};
use telemime_robot::session::SessionConfig as RobotConfig;
use telemime_sim::link::LinkConfig;
use tokio::sync::{mpsc, watch};
use tokio::time::{MissedTickBehavior, interval};

use super::net::Network;

/// Why a pair could not run.
#[derive(Debug, thiserror::Error)]
pub enum PairError {
    /// Keys.
    #[error(transparent)]
    Identity(#[from] IdentityError),
    /// Endpoints.
    #[error(transparent)]
    Endpoint(#[from] EndpointError),
    /// The runtime.
    #[error("runtime: {0}")]
    Runtime(#[from] std::io::Error),
    /// The operator.
    #[error(transparent)]
    Operator(#[from] DaemonError),
}

/// Not the robot's clock: the operators' session clock is an hour and a half off.
const SESSION_ZERO: Mono = Mono(-5_400_000_000_000);

fn host(n: u8) -> SocketAddr {
    SocketAddr::new(IpAddr::V4(Ipv4Addr::new(192, 0, 2, n)), 4433)
}

/// Runs `scenario` on a single thread under a paused clock.
///
/// # Errors
/// [`PairError::Runtime`] if there is no runtime to be had.
pub fn run_virtual<T>(scenario: impl Future<Output = T>) -> Result<T, PairError> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_time()
        .start_paused(true)
        .build()?;
    Ok(tokio::task::LocalSet::new().block_on(&runtime, scenario))
}

/// A network with a robot on it, on which operators can be started.
pub struct Pair {
    /// The network between them.
    pub network: Network,
    /// The robot.
    pub robot: Robot,
    clock: HostClock,
    robot_identity: Identity,
    operator_identity: Identity,
    operators: u8,
    /// What operators started from now on learn from while driving.
    pub learning: Learning,
}

/// The robot of a [`Pair`]: what it reports, tick by tick.
#[derive(Clone)]
pub struct Robot {
    reports: Rc<RefCell<Vec<Report>>>,
    notices: Rc<RefCell<Vec<RobotNotice>>>,
    quit: watch::Sender<bool>,
    words: mpsc::UnboundedSender<Word>,
}

/// An operator of a [`Pair`], running.
pub struct Operator {
    /// The end of its task, and what it was.
    pub done: tokio::task::JoinHandle<(Result<Summary, DaemonError>, Task)>,
    /// What it notices.
    pub notices: mpsc::UnboundedReceiver<OperatorNotice>,
    quit: watch::Sender<bool>,
    words: mpsc::UnboundedSender<Word>,
}

impl Robot {
    /// Every tick so far.
    pub fn reports(&self) -> std::cell::Ref<'_, Vec<Report>> {
        self.reports.borrow()
    }

    /// Everything else it noticed so far.
    pub fn notices(&self) -> std::cell::Ref<'_, Vec<RobotNotice>> {
        self.notices.borrow()
    }

    /// A word at the robot's own terminal.
    pub fn say(&self, word: Word) {
        // The daemon has ended if nobody hears it.
        let _ = self.words.send(word);
    }

    /// Stops the daemon, as Ctrl-C does.
    pub fn quit(&self) {
        self.quit.send_replace(true);
    }
}

impl Operator {
    /// A word at the operator's own terminal.
    pub fn say(&self, word: Word) {
        // The daemon has ended if nobody hears it.
        let _ = self.words.send(word);
    }

    /// Stops the daemon, as Ctrl-C does.
    pub fn quit(&self) {
        self.quit.send_replace(true);
    }
}

impl Pair {
    /// Starts a robot with `rig`. Inside [`run_virtual`] only.
    ///
    /// # Errors
    /// [`PairError`].
    pub fn start(rig: &Rig) -> Result<Self, PairError> {
        Self::start_with(rig, Default::default())
    }

    /// As [`Pair::start`], with the sessions set to `config`.
    ///
    /// # Errors
    /// [`PairError`].
    pub fn start_with(rig: &Rig, config: RobotConfig) -> Result<Self, PairError> {
        let network = Network::new();
        let clock = HostClock::from_zero();
        let robot_identity = Identity::ephemeral()?;
        let operator_identity = Identity::ephemeral()?;
        let (rings, handle) = servo::rings();
        let mut core = rig.servo(rings);
        let period = Duration::from_secs_f64(core.tick_s());
        tokio::task::spawn_local(async move {
            let mut tick = interval(period);
            tick.set_missed_tick_behavior(MissedTickBehavior::Burst);
            loop {
                tick.tick().await;
                core.tick(clock.now());
            }
        });
        let socket = quic::Socket::Abstract {
            socket: network.socket(host(1)),
            seed: [1; 32],
        };
        let endpoint = quic::server(
            &robot_identity,
            vec![operator_identity.fingerprint()],
            socket,
            &Meter::default(),
        )?;
        let daemon = RobotDaemon::new(endpoint, clock, rig.info(), config, handle, None);
        let (quit, quit_rx) = watch::channel(false);
        let (tx, mut rx) = mpsc::unbounded_channel();
        let (words, words_rx) = mpsc::unbounded_channel();
        tokio::task::spawn_local(daemon.run(quit_rx, words_rx, tx));
        let robot = Robot {
            reports: Rc::default(),
            notices: Rc::default(),
            quit,
            words,
        };
        let log = robot.clone();
        tokio::task::spawn_local(async move {
            while let Some(notice) = rx.recv().await {
                match notice {
                    RobotNotice::Report(report) => log.reports.borrow_mut().push(*report),
                    other => log.notices.borrow_mut().push(other),
                }
            }
        });
        Ok(Self {
            network,
            robot,
            clock,
            robot_identity,
            operator_identity,
            operators: 0,
            learning: Learning::default(),
        })
    }

    /// Now on the common clock.
    pub fn now(&self) -> Mono {
        self.clock.now()
    }

    /// When, on the common clock, the operators' session clock shows `stamp`.
    pub fn to_mono(&self, stamp: Stamp) -> Mono {
        Mono(stamp.0 + SESSION_ZERO.0)
    }

    /// Waits until `predicate` holds for the newest tick; false if it does not within `within_s` virtual seconds.
    pub async fn wait_for(&self, within_s: f64, predicate: impl Fn(&Report) -> bool) -> bool {
        let deadline = self.now().offset_by_secs(within_s);
        let mut tick = interval(Duration::from_millis(1));
        while self.now() < deadline {
            tick.tick().await;
            if self.robot.reports().last().is_some_and(&predicate) {
                return true;
            }
        }
        false
    }

    /// Lets virtual time pass.
    pub async fn run_for(&self, span_s: f64) {
        tokio::time::sleep_until(self.clock.instant(self.now().offset_by_secs(span_s))).await;
    }

    /// Starts an operator behind links of this kind, one per direction, with the key the robot has pinned.
    ///
    /// # Errors
    /// [`PairError`].
    pub fn operator(
        &mut self,
        task: Task,
        skill: Option<Arc<Skill>>,
        config: SessionConfig,
        link: &LinkConfig,
        seed: u64,
    ) -> Result<Operator, PairError> {
        let identity = self.operator_identity_copy()?;
        self.operator_as(&identity, task, skill, config, link, seed)
    }

    /// As [`Pair::operator`], with any key.
    ///
    /// # Errors
    /// [`PairError`].
    pub fn operator_as(
        &mut self,
        identity: &Identity,
        mut task: Task,
        skill: Option<Arc<Skill>>,
        config: SessionConfig,
        link: &LinkConfig,
        seed: u64,
    ) -> Result<Operator, PairError> {
        let (endpoint, meter) = self.client(identity, link, seed)?;
        let daemon = OperatorDaemon {
            endpoint,
            meter,
            robot: host(1),
            clock: self.clock,
            epoch: SESSION_ZERO,
            skill,
            recogniser: None,
            config,
            learning: self.learning.clone(),
            patience: Duration::from_secs(5),
        };
        let (quit, quit_rx) = watch::channel(false);
        let (words, words_rx) = mpsc::unbounded_channel();
        let (tx, notices) = mpsc::unbounded_channel();
        let done = tokio::task::spawn_local(async move {
            let result = daemon.run(&mut task, quit_rx, words_rx, &tx).await;
            (result, task)
        });
        Ok(Operator {
            done,
            notices,
            quit,
            words,
        })
    }

    /// A bare QUIC client where an operator would be, to say to [`Pair::robot_addr`] what no operator says.
    ///
    /// # Errors
    /// [`PairError`].
    pub fn stranger(&mut self, link: &LinkConfig, seed: u64) -> Result<quinn::Endpoint, PairError> {
        let identity = self.operator_identity_copy()?;
        Ok(self.client(&identity, link, seed)?.0)
    }

    /// Where the robot listens.
    pub fn robot_addr(&self) -> SocketAddr {
        host(1)
    }

    /// Changes the links of the `operator`th operator, the first being 1, both ways.
    pub fn set_link(&self, operator: u8, link: &LinkConfig, seed: u64) {
        let own = host(1 + operator);
        self.network.link(own, host(1), link.clone(), seed);
        self.network
            .link(host(1), own, link.clone(), seed ^ 0x9e37_79b9_7f4a_7c15);
    }

    fn client(
        &mut self,
        identity: &Identity,
        link: &LinkConfig,
        seed: u64,
    ) -> Result<(quinn::Endpoint, Meter), PairError> {
        self.operators += 1;
        let own = host(1 + self.operators);
        self.set_link(self.operators, link, seed);
        let meter = Meter::default();
        let socket = quic::Socket::Abstract {
            socket: self.network.socket(own),
            seed: [self.operators + 1; 32],
        };
        let endpoint = quic::client(identity, self.robot_identity.fingerprint(), socket, &meter)?;
        Ok((endpoint, meter))
    }

    fn operator_identity_copy(&self) -> Result<Identity, IdentityError> {
        Identity::from_pem(&self.operator_identity.to_pem())
    }
}
