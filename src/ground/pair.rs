//! Both daemons on one virtual clock.

use std::future::Future;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use telemime_endpoint::quic::EndpointError;
use telemime_endpoint::{
    External, Fingerprint, HostClock, Identity, IdentityError, Meter, Mono, Trust, quic,
};
use telemime_operator::daemon::{Daemon as OperatorDaemon, DaemonError, Learning, Reopen};
use telemime_operator::session::SessionConfig;
use telemime_operator::task::Task;
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;
use telemime_robot::rig::Rig;
use telemime_robot::servo::Report;
use telemime_robot::session::SessionConfig as RobotConfig;
use telemime_sim::link::LinkConfig;
use tokio::sync::{mpsc, watch};
use tokio::time::interval;

use super::ends::{Operator, Robot};
use super::net::Network;
use super::tap::Watcher;

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

/// Operators give up when they have not reached the robot within this time.
pub const PATIENCE: Duration = Duration::from_secs(5);

/// Hosts from here on are where operators go whose address has vanished.
const SPARE: u8 = 128;

pub(super) fn host(n: u8) -> SocketAddr {
    SocketAddr::new(IpAddr::V4(Ipv4Addr::new(192, 0, 2, n)), 4433)
}

/// The key whose 32 bytes are all `n` (RFC 8410 §7): a certificate's length depends on its key, and on a thin link
/// every byte shows. Nothing but this ground ever trusts it.
fn identity(n: u8) -> Result<Identity, IdentityError> {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut der = vec![
        0x30, 0x2e, 2, 1, 0, 0x30, 5, 6, 3, 0x2b, 0x65, 0x70, 4, 0x22, 4, 0x20,
    ];
    der.extend([n; 32]);
    let base64: String = der
        .chunks_exact(3)
        .flat_map(|b| {
            let bits = u32::from(b[0]) << 16 | u32::from(b[1]) << 8 | u32::from(b[2]);
            [18, 12, 6, 0].map(|shift| char::from(DIGITS[(bits >> shift) as usize & 63]))
        })
        .collect();
    Identity::from_pem(&format!(
        "-----BEGIN PRIVATE KEY-----\n{base64}\n-----END PRIVATE KEY-----\n"
    ))
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
    /// Whom the robot trusts.
    pub trust: Trust,
    clock: HostClock,
    config: RobotConfig,
    external: Option<(External, External)>,
    watcher: Option<Watcher>,
    robot_identity: Identity,
    operator_identity: Identity,
    operators: u8,
    /// What operators started from now on learn from while driving.
    pub learning: Learning,
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
        Self::start_as((rig, false), config, None, None)
    }

    /// As [`Pair::start`], with a black box at the robot.
    ///
    /// # Errors
    /// [`PairError`].
    pub fn start_recorded(rig: &Rig) -> Result<Self, PairError> {
        Self::start_as((rig, true), Default::default(), None, None)
    }

    /// As [`Pair::start`], with disciplined clocks at the robot and at the operators.
    ///
    /// # Errors
    /// [`PairError`].
    pub fn start_disciplined(
        rig: &Rig,
        robot: External,
        operators: External,
    ) -> Result<Self, PairError> {
        Self::start_as(
            (rig, false),
            Default::default(),
            Some((robot, operators)),
            None,
        )
    }

    /// As [`Pair::start`], under the eyes of `watcher`; with disciplined clocks, the robot's and the operators', if there
    /// are any.
    ///
    /// # Errors
    /// [`PairError`].
    pub fn start_watched(
        rig: &Rig,
        watcher: Watcher,
        external: Option<(External, External)>,
    ) -> Result<Self, PairError> {
        Self::start_as((rig, false), Default::default(), external, Some(watcher))
    }

    fn start_as(
        rig: (&Rig, bool),
        config: RobotConfig,
        external: Option<(External, External)>,
        watcher: Option<Watcher>,
    ) -> Result<Self, PairError> {
        let network = Network::new();
        let clock = HostClock::from_zero();
        let [robot_identity, operator_identity] = [identity(1)?, identity(2)?];
        let trust = Trust::new([operator_identity.fingerprint()]);
        let robots = external.as_ref().map(|(robot, _)| robot.clone());
        let robot = Robot::start(
            &network,
            clock,
            rig,
            &robot_identity,
            &trust,
            config,
            (robots, watcher.clone()),
        )?;
        Ok(Self {
            network,
            robot,
            trust,
            clock,
            config,
            external,
            watcher,
            robot_identity,
            operator_identity,
            operators: 0,
            learning: Learning::default(),
        })
    }

    /// Kills the robot, as a power cut does, and starts it again at once: the same key, the same address, the arm in its
    /// start posture, no session, no model.
    ///
    /// # Errors
    /// [`PairError`].
    pub fn restart_robot(&mut self, rig: &Rig) -> Result<(), PairError> {
        self.robot.kill(&self.network);
        let identity = &self.robot_identity;
        let external = self.external.as_ref().map(|(robot, _)| robot.clone());
        let (network, clock) = (&self.network, self.clock);
        self.robot = Robot::start(
            network,
            clock,
            (rig, false),
            identity,
            &self.trust,
            self.config,
            (external, self.watcher.clone()),
        )?;
        Ok(())
    }

    /// Now on the common clock.
    pub fn now(&self) -> Mono {
        self.clock.now()
    }

    /// The common clock itself.
    pub fn clock(&self) -> HostClock {
        self.clock
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
        task: Task,
        skill: Option<Arc<Skill>>,
        config: SessionConfig,
        link: &LinkConfig,
        seed: u64,
    ) -> Result<Operator, PairError> {
        let trust = Trust::new([self.robot_identity.fingerprint()]);
        self.operator_with(identity, trust, task, (skill, config), link, seed)
    }

    /// As [`Pair::operator`], without a skill, for a robot with the key `robot`.
    ///
    /// # Errors
    /// [`PairError`].
    pub fn operator_that_expects(
        &mut self,
        robot: Fingerprint,
        task: Task,
        link: &LinkConfig,
        seed: u64,
    ) -> Result<Operator, PairError> {
        let identity = self.operator_identity_copy()?;
        let driving = (None, SessionConfig::default());
        self.operator_with(&identity, Trust::new([robot]), task, driving, link, seed)
    }

    fn operator_with(
        &mut self,
        identity: &Identity,
        trust: Trust,
        mut task: Task,
        (skill, config): (Option<Arc<Skill>>, SessionConfig),
        link: &LinkConfig,
        seed: u64,
    ) -> Result<Operator, PairError> {
        let (endpoint, meter) = self.client(identity, &trust, link, seed)?;
        let (endpoint_copy, addr) = (endpoint.clone(), host(1 + self.operators));
        let spare = host(SPARE + self.operators);
        let reopen = {
            let (network, trust, meter) = (self.network.clone(), trust.clone(), meter.clone());
            let identity = Identity::from_pem(&identity.to_pem())?;
            Reopen::new(move || {
                let socket = quic::Socket::Abstract {
                    socket: network.socket(spare),
                    seed: [SPARE; 32],
                };
                quic::client(&identity, &trust, socket, &meter)
            })
        };
        let daemon = OperatorDaemon {
            endpoint,
            reopen: Some(reopen),
            trust,
            meter,
            robot: host(1),
            clock: self.clock,
            epoch: SESSION_ZERO,
            external: self.external.as_ref().map(|(_, operator)| operator.clone()),
            skill,
            recogniser: None,
            config,
            learning: self.learning.clone(),
            patience: PATIENCE,
            shown: None,
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
            addr,
            spare,
            endpoint: endpoint_copy,
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
        let trust = Trust::new([self.robot_identity.fingerprint()]);
        Ok(self.client(&identity, &trust, link, seed)?.0)
    }

    /// A client that wants to be paired, on this link.
    ///
    /// # Errors
    /// [`PairError`].
    pub fn suitor(
        &mut self,
        identity: &Identity,
        link: &LinkConfig,
        seed: u64,
    ) -> Result<quinn::Endpoint, PairError> {
        let socket = self.place(link, seed);
        Ok(quic::pairing_client(identity, socket)?)
    }

    /// The robot's key.
    pub fn robot_key(&self) -> Fingerprint {
        self.robot_identity.fingerprint()
    }

    /// The operator's, which the robot trusts from the start.
    pub fn operator_key(&self) -> Fingerprint {
        self.operator_identity.fingerprint()
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
        trust: &Trust,
        link: &LinkConfig,
        seed: u64,
    ) -> Result<(quinn::Endpoint, Meter), PairError> {
        let (socket, meter) = (self.place(link, seed), Meter::default());
        Ok((quic::client(identity, trust, socket, &meter)?, meter))
    }

    /// The socket of one more client.
    fn place(&mut self, link: &LinkConfig, seed: u64) -> quic::Socket {
        self.operators += 1;
        self.set_link(self.operators, link, seed);
        quic::Socket::Abstract {
            socket: self.network.socket(host(1 + self.operators)),
            seed: [self.operators + 1; 32],
        }
    }

    fn operator_identity_copy(&self) -> Result<Identity, IdentityError> {
        Identity::from_pem(&self.operator_identity.to_pem())
    }
}
