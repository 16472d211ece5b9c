//! The two ends of a pair, while they run.

use std::cell::RefCell;
use std::net::SocketAddr;
use std::rc::Rc;
use std::time::Duration;

use telemime_endpoint::cli::Word;
use telemime_endpoint::pairing::Own;
use telemime_endpoint::peers::Name;
use telemime_endpoint::{External, HostClock, Identity, Meter, Trust, quic};
use telemime_operator::daemon::{DaemonError, Notice as OperatorNotice, Summary};
use telemime_operator::task::Task;
use telemime_robot::blackbox::{Due, Header, Recorder, SPAN_S, taps};
use telemime_robot::daemon::{Daemon as RobotDaemon, Notice as RobotNotice};
use telemime_robot::desk::Desk;
use telemime_robot::rig::Rig;
use telemime_robot::servo::Report;
use telemime_robot::session::SessionConfig as RobotConfig;
use tokio::sync::{mpsc, watch};
use tokio::time::{MissedTickBehavior, interval};

use super::net::Network;
use super::pair::{PairError, host};
use super::tap::{Watched, Watcher};

/// What it was written for, and a black box.
type Record = (Due, Vec<u8>);

/// The robot of a [`Pair`](super::Pair): what it reports, tick by tick.
#[derive(Clone)]
pub struct Robot {
    reports: Rc<RefCell<Vec<Report>>>,
    notices: Rc<RefCell<Vec<RobotNotice>>>,
    records: Rc<RefCell<Vec<Record>>>,
    quit: watch::Sender<bool>,
    words: mpsc::UnboundedSender<Word>,
    endpoint: quinn::Endpoint,
    tasks: Rc<[tokio::task::AbortHandle; 2]>,
}

/// An operator of a [`Pair`](super::Pair), running.
pub struct Operator {
    /// The end of its task, and what it was.
    pub done: tokio::task::JoinHandle<(Result<Summary, DaemonError>, Task)>,
    /// What it notices.
    pub notices: mpsc::UnboundedReceiver<OperatorNotice>,
    /// Its address.
    pub addr: SocketAddr,
    /// Where it binds should that one vanish.
    pub spare: SocketAddr,
    pub(super) endpoint: quinn::Endpoint,
    pub(super) quit: watch::Sender<bool>,
    pub(super) words: mpsc::UnboundedSender<Word>,
}

impl Robot {
    pub(super) fn start(
        network: &Network,
        clock: HostClock,
        (rig, recorded): (&Rig, bool),
        identity: &Identity,
        trust: &Trust,
        config: RobotConfig,
        (external, watcher): (Option<External>, Option<Watcher>),
    ) -> Result<Self, PairError> {
        let mut recorder = None;
        let make = |rings| {
            let station = rig.servo(rings);
            if !recorded {
                return station;
            }
            let (tap, feed) = taps(&station.room());
            recorder = Some(Recorder::new(Header::new(rig, None), feed, SPAN_S));
            station.recorded(tap)
        };
        let (mut station, handle) = Watched::new(make, clock, watcher);
        let records: Rc<RefCell<Vec<_>>> = Rc::default();
        let kept = records.clone();
        let period = Duration::from_secs_f64(station.tick_s());
        let servo = tokio::task::spawn_local(async move {
            let mut tick = interval(period);
            tick.set_missed_tick_behavior(MissedTickBehavior::Burst);
            loop {
                tick.tick().await;
                let report = station.tick();
                // As often as the thread does it that a robot has for this.
                if let Some(recorder) = recorder.as_mut().filter(|_| report.tick % 50 == 0)
                    && let Some(due) = recorder.drain()
                    && let Some(draft) = recorder.draft(due)
                {
                    kept.borrow_mut().push((due, draft.sealed()));
                }
            }
        });
        let socket = quic::Socket::Abstract {
            socket: network.socket(host(1)),
            seed: [1; 32],
        };
        let endpoint = quic::server(identity, trust, socket, &Meter::default())?;
        let connections = endpoint.clone();
        let own = Own {
            name: Name::made_of("virtual-robot"),
            key: identity.fingerprint(),
        };
        let desk = Desk::new(own, trust.clone(), None);
        let daemon = RobotDaemon::new(endpoint, clock, rig.info(), config, handle, None, desk)
            .with_external(external)
            .showing(rig.described());
        let (quit, quit_rx) = watch::channel(false);
        let (tx, mut rx) = mpsc::unbounded_channel();
        let (words, words_rx) = mpsc::unbounded_channel();
        let serving = tokio::task::spawn_local(daemon.run(quit_rx, words_rx, tx));
        let robot = Self {
            reports: Rc::default(),
            notices: Rc::default(),
            records,
            quit,
            words,
            endpoint: connections,
            tasks: Rc::new([servo.abort_handle(), serving.abort_handle()]),
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
        Ok(robot)
    }

    /// Ends everything without a word.
    pub(super) fn kill(&self, network: &Network) {
        network.remove(host(1));
        self.tasks.iter().for_each(tokio::task::AbortHandle::abort);
    }

    /// Every tick so far.
    pub fn reports(&self) -> std::cell::Ref<'_, Vec<Report>> {
        self.reports.borrow()
    }

    /// What its black box has written so far, if the pair was [started with one](super::Pair::start_recorded).
    pub fn records(&self) -> std::cell::Ref<'_, Vec<Record>> {
        self.records.borrow()
    }

    /// Everything else it noticed so far.
    pub fn notices(&self) -> std::cell::Ref<'_, Vec<RobotNotice>> {
        self.notices.borrow()
    }

    /// Forgets every tick and notice so far, and returns the notices: hours do not fit into memory.
    pub fn forget(&self) -> Vec<RobotNotice> {
        self.reports.borrow_mut().clear();
        self.notices.take()
    }

    /// Connections its endpoint keeps anything of.
    pub fn connections(&self) -> usize {
        self.endpoint.open_connections()
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
    /// Ends it without a word, as `kill -9` does.
    pub fn kill(&self, network: &Network) {
        network.remove(self.addr);
        self.done.abort();
    }

    /// Moves it to another address of the network, as a laptop that changes from one network to another; the links
    /// there are whatever [`Network::link`] says.
    ///
    /// # Errors
    /// [`PairError::Runtime`] if QUIC does not take the socket.
    pub fn rebind(&mut self, network: &Network, to: SocketAddr) -> Result<(), PairError> {
        let socket = network.socket(to);
        network.remove(self.addr);
        self.addr = to;
        Ok(self.endpoint.rebind_abstract(socket)?)
    }

    /// Connections its endpoint keeps anything of.
    pub fn connections(&self) -> usize {
        self.endpoint.open_connections()
    }

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
