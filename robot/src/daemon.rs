//! The robot's shell: accepts one operator at a time, carries bytes to the session and reports from the servo.

mod arrive;
mod attend;

use std::sync::Arc;
use std::time::Duration;

use quinn::{Connection, Endpoint, VarInt};
use telemime_endpoint::cli::{Word, told};
use telemime_endpoint::control::{ControlError, Writer};
use telemime_endpoint::{External, Fingerprint, HostClock, Mono, Trust, logs, quic};
use telemime_protocol::checkpoint::path::{DecodedKnot, POSE, pose as on_path};
use telemime_protocol::skill::Skill;
use telemime_protocol::wire::Version;
use telemime_protocol::wire::arm::WireArm;
use telemime_protocol::wire::frame::Frame;
use telemime_protocol::wire::v1::{Cause, Info, RobotState};
use tokio::sync::{mpsc, watch};
use tokio::time::{MissedTickBehavior, interval, sleep_until};

use crate::blackbox::Asker;
use crate::clock::Origin;
use crate::desk::{Desk, Progress};
use crate::door::{self, Door, Verdict};
use crate::recording::Scribe;
use crate::refused::{Reason, Refused, Tally};
use crate::servo::thread::{Times, Timing};
use crate::servo::{ArmFault, Handle, Order, Report};
use crate::session::{Counters, Output, Seen, Session, SessionConfig};

use arrive::{Arrival, arrive, distrust};

pub use attend::{Attendant, Snapshot};

/// How often reports are taken from the servo's ring.
const DRAIN: Duration = Duration::from_millis(4);

/// Close codes (docs/protocol.md §1).
const CLOSED: u32 = 0;
const MALFORMED: u32 = 1;
const FAULT: u32 = 4;
const NOT_TRUSTED: u32 = 5;

/// What is still to be said when a session ends gets this long.
const LAST_WORDS: Duration = Duration::from_millis(500);

/// Drains (0.5 s) without a word from the servo.
const MAX_SILENT_DRAINS: u32 = 125;

/// A stop takes a fraction of a second; after this many drains (2 s) the servo itself must be dead.
const MAX_STOP_DRAINS: u32 = 500;

/// What the daemon needs.
#[derive(Debug)]
pub struct Daemon {
    /// A server endpoint that knows which keys to accept.
    endpoint: Endpoint,
    /// The host's clock.
    clock: HostClock,
    /// What operators are told of the arm.
    info: Info,
    /// How it is built, if operators are to know.
    arm: Option<WireArm>,
    /// Session settings.
    config: SessionConfig,
    /// The servo's rings.
    servo: Handle,
    /// The servo's timing, where it has a thread of its own.
    timing: Option<Arc<Timing>>,
    /// Whom it trusts, and how that grows.
    desk: Desk,
    external: Option<External>,
    refused: Tally,
    silent_drains: u32,
    asker: Option<Asker>,
    scribe: Option<Scribe>,
    fault: Option<ArmFault>,
    attendant: Option<Attendant>,
}

/// Something for a log.
#[derive(Debug, Clone)]
pub enum Notice {
    /// An operator has authority.
    Connected {
        /// The session's epoch.
        epoch: u32,
        /// The protocol version both speak.
        version: Version,
        /// Its address.
        peer: std::net::SocketAddr,
    },
    /// It has no authority any more.
    Disconnected {
        /// Why.
        why: String,
        /// The clock's offset estimate, s, and the bound of its error, s.
        clock: Option<(f64, f64)>,
        /// Where that came from.
        origin: Origin,
        /// What the session counted.
        counters: Counters,
        /// What became of its datagrams.
        seen: Box<Seen>,
    },
    /// Somebody was turned away: told the first time, and then ever more rarely.
    Refused(Refused),
    /// A pairing makes progress.
    Pairing(Progress),
    /// A servo tick, for recording.
    Report(Box<Report>),
    /// The path an engagement received, as it stands when the session ends.
    Path(Vec<PathPoint>),
}

/// A knot of a path: time (s, session clock), m, m/s, whether it starts afresh there, not joined to the knot before,
/// and, if the path carries the hand's orientation, that as a point of ℝ⁴ (w, x, y, z) and what it changes by in a
/// second.
pub type PathPoint = (f64, [f64; 3], [f64; 3], bool, Option<[[f64; 4]; 2]>);

fn path_point(knot: &DecodedKnot<POSE>, start: bool, turns: bool) -> PathPoint {
    let turn = turns.then(|| [&knot.x, &knot.v].map(|p| on_path::turn_point(p).into()));
    let (x, v) = (on_path::place(&knot.x), on_path::place(&knot.v));
    (knot.t.as_secs_f64(), x.into(), v.into(), start, turn)
}

struct Active {
    session: Session,
    connection: Connection,
    key: Fingerprint,
    began: Mono,
    /// Packets received, and when that last changed.
    heard: (u64, Mono),
    writer: Writer,
    frames: mpsc::Receiver<Result<Frame, ControlError>>,
}

/// Why a robot cannot serve any more.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum Failure {
    /// The servo has not reported for half a second: nothing drives the arm any more.
    #[error("the servo has stopped; see above for why, and start the robot again")]
    Servo,
    /// The arm failed, or what drives it; it was stopped as far as it could be.
    #[error("the arm was stopped: {0}")]
    Arm(#[from] ArmFault),
}

impl Daemon {
    /// A daemon that serves `endpoint` and drives `servo`, whose timing is `timing` if it has a thread of its own.
    /// The endpoint trusts whom the `desk` trusts.
    pub fn new(
        endpoint: Endpoint,
        clock: HostClock,
        info: Info,
        config: SessionConfig,
        servo: Handle,
        timing: Option<Arc<Timing>>,
        desk: Desk,
    ) -> Self {
        Self {
            endpoint,
            clock,
            info,
            arm: None,
            config,
            servo,
            timing,
            desk,
            external: None,
            refused: Tally::default(),
            silent_drains: 0,
            asker: None,
            scribe: None,
            fault: None,
            attendant: None,
        }
    }

    /// The same with a clock that is kept right from outside.
    #[must_use]
    pub fn with_external(mut self, external: Option<External>) -> Self {
        self.external = external;
        self
    }

    /// The same, telling operators how the arm is built.
    #[must_use]
    pub fn showing(mut self, arm: WireArm) -> Self {
        self.arm = Some(arm);
        self
    }

    /// The same with a black box, to be asked for its record.
    #[must_use]
    pub fn with_black_box(mut self, asker: Option<Asker>) -> Self {
        self.asker = asker;
        self
    }

    /// The same, recorded.
    #[must_use]
    pub fn recorded(mut self, scribe: Option<Scribe>) -> Self {
        self.scribe = scribe;
        self
    }

    /// Serves operators until `quit` turns true, or the arm fails; then the arm is stopped (latched) and the endpoint closed.
    ///
    /// # Errors
    /// [`Failure`].
    pub async fn run(
        mut self,
        mut quit: watch::Receiver<bool>,
        mut words: mpsc::UnboundedReceiver<Word>,
        notices: mpsc::UnboundedSender<Notice>,
    ) -> Result<(), Failure> {
        let (arrivals_tx, mut arrivals) = mpsc::channel::<Arrival>(door::PLACES);
        let mut drain = interval(DRAIN);
        drain.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let trust = self.desk.trust().clone();
        let mut active: Option<Active> = None;
        let mut skill: Option<Arc<Skill>> = None;
        let mut epoch = 0;
        let door = Door::default();
        loop {
            let ended = self.flush(active.as_mut());
            if let Some(why) = ended {
                self.end(&mut active, &mut skill, (why.0, &why.1), &notices);
            }
            let due = active
                .as_ref()
                .map(|a| self.clock.instant(a.session.poll_timeout().0));
            tokio::select! {
                biased;
                () = told(&mut quit) => break,
                Some(word) = words.recv() => match word {
                    Word::Stop => self.servo.brake.stop_here(),
                    Word::Reset => {
                        let reset = Order::Reset { operator: active.is_some(), stop: None };
                        if self.order(reset).is_some() {
                            logs::note("the servo was too busy to hear of the reset: type it again");
                        }
                    }
                    Word::BlackBox => match &self.asker {
                        Some(asker) => asker.ask(),
                        None => logs::note("there is no black box: start the robot with --black-box DIR"),
                    },
                    Word::Pair(span) => {
                        let _ = notices.send(Notice::Pairing(self.desk.open(span)));
                    }
                    Word::Yes | Word::No => {
                        if let Some(progress) = self.desk.word(word == Word::Yes) {
                            let _ = notices.send(Notice::Pairing(progress));
                        }
                    }
                    // What an operator says; a robot's terminal does not know them.
                    Word::Engage | Word::Release | Word::Keep | Word::Refine | Word::Save(_) => {}
                },
                _ = drain.tick() => {
                    self.drain(active.as_mut(), &notices);
                    if self.silent_drains > MAX_SILENT_DRAINS {
                        self.end(&mut active, &mut skill, (FAULT, "the servo has stopped"), &notices);
                        self.endpoint.close(VarInt::from_u32(FAULT), b"the servo has stopped");
                        return Err(Failure::Servo);
                    }
                    if self.fault.is_some() {
                        break;
                    }
                }
                why = receive(active.as_mut(), &self.clock, self.external.as_ref(), &trust) => if let Some(why) = why {
                    self.end(&mut active, &mut skill, (why.0, &why.1), &notices);
                },
                () = sleep_until(due.unwrap_or_else(tokio::time::Instant::now)), if due.is_some() => {
                    if let Some(active) = &mut active {
                        active.session.handle_timeout(self.clock.now());
                    }
                }
                incoming = self.endpoint.accept() => match incoming {
                    Some(incoming) => {
                        let from = incoming.remote_address().ip();
                        match door.knock(from, incoming.remote_address_validated()) {
                            Verdict::Enter(place) => {
                                let arriving = arrive(incoming, place, trust.clone(), arrivals_tx.clone());
                                tokio::spawn(tokio::time::timeout(door::STAY, arriving));
                            }
                            // It may not be asked twice: then it knows a token already.
                            Verdict::Prove => drop(incoming.retry().map_err(|e| e.into_incoming().refuse())),
                            Verdict::Refuse => incoming.refuse(),
                        }
                    }
                    None => break,
                },
                progress = self.desk.next() => {
                    let _ = notices.send(Notice::Pairing(progress));
                }
                Some(arrival) = arrivals.recv() => {
                    let refused = match arrival {
                        Arrival::Greeted(next) => self.admit(*next, &mut active, &mut skill, &mut epoch, &notices),
                        Arrival::Pairing(connection) => {
                            let peer = connection.remote_address();
                            let taken = self.desk.receive(connection);
                            (!taken).then(|| (peer, Reason::NoWindow, "no pairing window is open for it".to_owned()))
                        }
                        Arrival::Refused(peer, reason, why) => Some((peer, reason, why)),
                        Arrival::Gone => None,
                    };
                    let told = refused.and_then(|(peer, reason, why)| self.refused.count(peer, reason, why));
                    if let Some(refused) = told {
                        let _ = notices.send(Notice::Refused(refused));
                    }
                }
            }
        }
        self.dismiss();
        // Nobody leaves before the arm is at rest; the operator hears of the stop at once.
        for _ in 0..MAX_STOP_DRAINS {
            self.servo.brake.stop_here();
            drain.tick().await;
            let at_rest = self.drain(active.as_mut(), &notices);
            let _ = self.flush(active.as_mut());
            if at_rest {
                break;
            }
        }
        let why = match self.fault {
            Some(fault) => (FAULT, format!("the arm was stopped: {fault}")),
            None => (CLOSED, "the robot daemon stops".to_owned()),
        };
        self.end(&mut active, &mut skill, (why.0, &why.1), &notices);
        // The last words are written by their own task; a peer that does not take them is not waited for.
        let _ = tokio::time::timeout(LAST_WORDS, self.endpoint.wait_idle()).await;
        self.endpoint
            .close(VarInt::from_u32(CLOSED), b"the robot daemon stops");
        self.endpoint.wait_idle().await;
        self.fault.map_or(Ok(()), |fault| Err(fault.into()))
    }

    /// Hands an order on; it comes back if there is no place for it.
    fn order(&mut self, order: Order) -> Option<Order> {
        // 64 orders are more than a second's worth. What does not fit is not forgotten but a reason to stop.
        let rtrb::PushError::Full(order) = self.servo.orders.push(order).err()?;
        self.servo.brake.pull(Cause::Fault);
        Some(order)
    }

    /// Takes the servo's reports; says whether the newest is of an arm stopped and at rest.
    fn drain(
        &mut self,
        mut active: Option<&mut Active>,
        notices: &mpsc::UnboundedSender<Notice>,
    ) -> bool {
        let mut at_rest = false;
        self.silent_drains += 1;
        if let Some(active) = active.as_deref_mut() {
            active.listen(self.clock.now());
        }
        let timing = self
            .timing
            .as_deref()
            .map_or_else(Times::default, |timing| timing.read());
        while let Ok(report) = self.servo.reports.pop() {
            self.silent_drains = 0;
            self.info.state = report.state;
            self.fault = report.fault;
            at_rest = report.state == RobotState::Stopped && !report.moving;
            if let Some(active) = active.as_deref_mut() {
                active.session.handle_report(&report, timing);
            }
            if let Some(attendant) = &mut self.attendant {
                attendant.saw(&report);
            }
            if let Some(scribe) = &mut self.scribe {
                scribe.take(&report, active.as_deref().map(|active| &active.session));
            }
            let _ = notices.send(Notice::Report(Box::new(report)));
        }
        while self.servo.spent.pop().is_ok() {}
        self.attend(active.as_deref());
        at_rest
    }

    /// Does what the session wants; a reason if the session is over.
    fn flush(&mut self, active: Option<&mut Active>) -> Option<(u32, String)> {
        let active = active?;
        while let Some(output) = active.session.poll_output() {
            match output {
                Output::Control(payload) => {
                    if let Err(e) = active.writer.message(&payload) {
                        return Some((CLOSED, e.to_string()));
                    }
                }
                Output::Brake(cause) => self.servo.brake.pull(cause),
                // Too large or unsupported cannot happen (1100 B); a lost connection shows up in `receive`.
                Output::Datagram(bytes) => drop(active.connection.send_datagram(bytes.into())),
                Output::Order(order) => {
                    if let Some(order) = self.order(order) {
                        active.session.handle_lost(&order);
                    }
                }
                Output::Goodbye => return Some((CLOSED, "the operator said goodbye".into())),
            }
        }
        None
    }

    fn end(
        &mut self,
        active: &mut Option<Active>,
        skill: &mut Option<Arc<Skill>>,
        (code, why): (u32, &str),
        notices: &mpsc::UnboundedSender<Notice>,
    ) {
        let Some(mut ended) = active.take() else {
            return;
        };
        ended.session.handle_closed();
        while let Some(output) = ended.session.poll_output() {
            if let Output::Order(order) = output {
                // The brake has been pulled for one that is lost, and there is nobody to tell.
                let _ = self.order(order);
            }
        }
        let Active {
            connection, writer, ..
        } = ended;
        let ended = ended.session;
        let reason = why.as_bytes().to_vec();
        tokio::spawn(async move {
            writer.finish(LAST_WORDS).await;
            connection.close(VarInt::from_u32(code), &reason);
        });
        if let Some(held) = ended.skill() {
            *skill = Some(held);
        }
        if let Some(mirror) = ended.mirror() {
            let knots = mirror.path().marked();
            let knots = knots.map(|(k, start)| path_point(k, start, mirror.turns()));
            let _ = notices.send(Notice::Path(knots.collect()));
        }
        let now = self.clock.now();
        if let Some(attendant) = &mut self.attendant {
            attendant.ended(&ended, now);
        }
        let (clock, origin) = (ended.clock(), ended.clock().origin(now));
        let clock = clock
            .to_session(now)
            .zip(clock.uncertainty_s(now))
            .map(|(t, bound_s)| ((t.0 - now.0) as f64 * 1e-9, bound_s));
        let (counters, seen) = (ended.counters(), Box::new(ended.seen()));
        let _ = notices.send(Notice::Disconnected {
            why: why.to_owned(),
            clock,
            origin,
            counters,
            seen,
        });
    }
}

/// The next thing the operator sends; a reason if it is the last. Never resolves without an operator.
async fn receive(
    active: Option<&mut Active>,
    clock: &HostClock,
    external: Option<&External>,
    trust: &Trust,
) -> Option<(u32, String)> {
    let Some(active) = active else {
        return std::future::pending().await;
    };
    tokio::select! {
        biased;
        standing = trust.withdrawn(active.key) => Some((NOT_TRUSTED, distrust(standing).1.to_owned())),
        frame = active.frames.recv() => match frame {
            Some(Ok(frame)) => {
                active.session.handle_control(clock.now(), &frame).err().map(|e| (MALFORMED, format!("control message: {e}")))
            }
            Some(Err(e)) => Some((CLOSED, e.to_string())),
            None => Some((CLOSED, "control stream ended".into())),
        },
        datagram = active.connection.read_datagram() => match datagram {
            Ok(bytes) => {
                active.session.set_external(external.map(|e| e.message(Mono(0))));
                active.session.handle_datagram(clock.now(), &bytes);
                None
            }
            Err(e) => Some((CLOSED, quic::explain(&e))),
        },
    }
}

impl Active {
    fn listen(&mut self, now: Mono) {
        let received = self.connection.stats().udp_rx.datagrams;
        if received != self.heard.0 {
            self.heard = (received, now);
        }
    }
}
