//! The robot's shell: accepts one operator at a time, carries bytes to the session and reports from the servo.

use std::sync::Arc;
use std::time::Duration;

use quinn::{Connection, Endpoint, Incoming, VarInt};
use telemime_endpoint::cli::{Word, told};
use telemime_endpoint::control::{Control, ControlError, Writer};
use telemime_endpoint::{HostClock, quic};
use telemime_protocol::skill::Skill;
use telemime_protocol::wire::Version;
use telemime_protocol::wire::frame::Frame;
use telemime_protocol::wire::hello::{Answer, Hello, RejectCode};
use telemime_protocol::wire::v1::{Cause, Info, RobotState};
use tokio::sync::{mpsc, watch};
use tokio::time::{MissedTickBehavior, interval, sleep_until};

use crate::door::{self, Door, Place, Verdict};
use crate::servo::thread::Timing;
use crate::servo::{Handle, Order, Report};
use crate::session::{Counters, Output, Session, SessionConfig, TickTiming};

/// How often reports are taken from the servo's ring.
const DRAIN: Duration = Duration::from_millis(4);

/// Close codes (docs/protocol.md §1).
const CLOSED: u32 = 0;
const MALFORMED: u32 = 1;
const REJECTED: u32 = 2;
const BAD_GREETING: u32 = 3;
const FAULT: u32 = 4;

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
    /// Session settings.
    config: SessionConfig,
    /// The servo's rings.
    servo: Handle,
    /// The servo's timing, where it has a thread of its own.
    timing: Option<Arc<Timing>>,
    silent_drains: u32,
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
        /// What the session counted.
        counters: Counters,
    },
    /// Somebody was turned away.
    Refused {
        /// Why.
        why: String,
    },
    /// A servo tick, for recording.
    Report(Box<Report>),
    /// The path an engagement received, as it stands when the session ends: time (s, session clock), m, m/s, and
    /// whether it starts afresh there, not joined to the knot before.
    Path(Vec<(f64, [f64; 3], [f64; 3], bool)>),
}

struct Greeted {
    connection: Connection,
    control: Control,
    hello: Hello,
}

struct Active {
    session: Session,
    connection: Connection,
    writer: Writer,
    frames: mpsc::Receiver<Result<Frame, ControlError>>,
}

/// The servo has not reported for half a second: nothing drives the arm any more.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the servo has stopped; see above for why, and start the robot again")]
pub struct ServoDead;

impl Daemon {
    /// A daemon that serves `endpoint` and drives `servo`, whose timing is `timing` if it has a thread of its own.
    pub fn new(
        endpoint: Endpoint,
        clock: HostClock,
        info: Info,
        config: SessionConfig,
        servo: Handle,
        timing: Option<Arc<Timing>>,
    ) -> Self {
        Self {
            endpoint,
            clock,
            info,
            config,
            servo,
            timing,
            silent_drains: 0,
        }
    }

    /// Serves operators until `quit` turns true; then the arm is stopped (latched) and the endpoint closed.
    ///
    /// # Errors
    /// [`ServoDead`].
    pub async fn run(
        mut self,
        mut quit: watch::Receiver<bool>,
        mut words: mpsc::UnboundedReceiver<Word>,
        notices: mpsc::UnboundedSender<Notice>,
    ) -> Result<(), ServoDead> {
        let (greeted_tx, mut greeted) = mpsc::channel::<Greeted>(door::PLACES);
        let mut drain = interval(DRAIN);
        drain.set_missed_tick_behavior(MissedTickBehavior::Delay);
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
                    Word::Reset => self.order(Order::Reset { operator: active.is_some(), stop: None }),
                    // What an operator says; a robot's terminal does not know them.
                    Word::Keep | Word::Refine | Word::Save(_) => {}
                },
                _ = drain.tick() => {
                    self.drain(active.as_mut(), &notices);
                    if self.silent_drains > MAX_SILENT_DRAINS {
                        self.end(&mut active, &mut skill, (FAULT, "the servo has stopped"), &notices);
                        self.endpoint.close(VarInt::from_u32(FAULT), b"the servo has stopped");
                        return Err(ServoDead);
                    }
                }
                why = receive(active.as_mut(), &self.clock) => if let Some(why) = why {
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
                                let greeting = greet(incoming, place, greeted_tx.clone(), notices.clone());
                                tokio::spawn(tokio::time::timeout(door::STAY, greeting));
                            }
                            // It may not be asked twice: then it knows a token already.
                            Verdict::Prove => drop(incoming.retry().map_err(|e| e.into_incoming().refuse())),
                            Verdict::Refuse => incoming.refuse(),
                        }
                    }
                    None => break,
                },
                Some(next) = greeted.recv() => {
                    if let Some(why) = self.admit(next, &mut active, &skill, &mut epoch, &notices) {
                        let _ = notices.send(Notice::Refused { why });
                    }
                }
            }
        }
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
        self.end(
            &mut active,
            &mut skill,
            (CLOSED, "the robot daemon stops"),
            &notices,
        );
        // The last words are written by their own task; a peer that does not take them is not waited for.
        let _ = tokio::time::timeout(LAST_WORDS, self.endpoint.wait_idle()).await;
        self.endpoint
            .close(VarInt::from_u32(CLOSED), b"the robot daemon stops");
        self.endpoint.wait_idle().await;
        Ok(())
    }

    /// Gives authority, or says why not.
    fn admit(
        &mut self,
        greeted: Greeted,
        active: &mut Option<Active>,
        skill: &Option<Arc<Skill>>,
        epoch: &mut u32,
        notices: &mpsc::UnboundedSender<Notice>,
    ) -> Option<String> {
        let Greeted {
            connection,
            control,
            hello,
        } = greeted;
        let versions = self.config.versions;
        let agreed = match versions.choose(&hello) {
            None => Err((
                RejectCode::Version,
                format!(
                    "this robot speaks {versions}, you offer {} to {}",
                    hello.min, hello.max
                ),
            )),
            Some(_) if active.is_some() => Err((
                RejectCode::Busy,
                "another operator has authority".to_owned(),
            )),
            Some(version) => Ok(version),
        };
        let peer = connection.remote_address();
        let version = match agreed {
            Ok(version) => version,
            Err((code, text)) => {
                let why = format!("{peer}: {text}");
                tokio::spawn(turn_away(connection, control, code, text));
                return Some(why);
            }
        };
        *epoch += 1;
        let ack = Answer::Ack {
            version: version.number(),
            features: 0,
            epoch: *epoch,
        };
        let (writer, frames) = control.into_frames();
        // The first of an empty queue.
        let _ = writer.raw(ack.encode());
        let session = Session::new(
            self.config,
            self.info.clone(),
            *epoch,
            skill.clone(),
            self.clock.now(),
        )
        .speaking(version);
        *active = Some(Active {
            session,
            connection,
            writer,
            frames,
        });
        let _ = notices.send(Notice::Connected {
            epoch: *epoch,
            version,
            peer,
        });
        None
    }

    fn order(&mut self, order: Order) {
        // 64 orders are more than a second's worth. What does not fit is not forgotten but a reason to stop.
        if self.servo.orders.push(order).is_err() {
            self.servo.brake.pull(Cause::Fault);
        }
    }

    /// Takes the servo's reports; says whether the newest is of an arm stopped and at rest.
    fn drain(
        &mut self,
        mut active: Option<&mut Active>,
        notices: &mpsc::UnboundedSender<Notice>,
    ) -> bool {
        let mut at_rest = false;
        self.silent_drains += 1;
        let timing = self
            .timing
            .as_deref()
            .map_or_else(TickTiming::default, |timing| {
                let (_, mean_ns, p99_ns, overruns) = timing.read();
                TickTiming {
                    mean_ns,
                    p99_ns,
                    overruns,
                }
            });
        while let Ok(report) = self.servo.reports.pop() {
            self.silent_drains = 0;
            self.info.state = report.state;
            at_rest = report.state == RobotState::Stopped && !report.moving;
            if let Some(active) = active.as_deref_mut() {
                active.session.handle_report(&report, timing);
            }
            let _ = notices.send(Notice::Report(Box::new(report)));
        }
        while self.servo.spent.pop().is_ok() {}
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
                Output::Order(order) => self.order(order),
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
                self.order(order);
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
            let knots = knots.map(|(k, start)| (k.t.as_secs_f64(), k.x.into(), k.v.into(), start));
            let _ = notices.send(Notice::Path(knots.collect()));
        }
        let now = self.clock.now();
        let clock = ended.clock();
        let clock = clock
            .to_session(now)
            .zip(clock.uncertainty_s(now))
            .map(|(t, bound_s)| ((t.0 - now.0) as f64 * 1e-9, bound_s));
        let counters = ended.counters();
        let _ = notices.send(Notice::Disconnected {
            why: why.to_owned(),
            clock,
            counters,
        });
    }
}

/// The next thing the operator sends; a reason if it is the last. Never resolves without an operator.
async fn receive(active: Option<&mut Active>, clock: &HostClock) -> Option<(u32, String)> {
    let Some(active) = active else {
        return std::future::pending().await;
    };
    tokio::select! {
        biased;
        frame = active.frames.recv() => match frame {
            Some(Ok(frame)) => {
                active.session.handle_control(clock.now(), &frame).err().map(|e| (MALFORMED, format!("control message: {e}")))
            }
            Some(Err(e)) => Some((CLOSED, e.to_string())),
            None => Some((CLOSED, "control stream ended".into())),
        },
        datagram = active.connection.read_datagram() => match datagram {
            Ok(bytes) => {
                active.session.handle_datagram(clock.now(), &bytes);
                None
            }
            Err(e) => Some((CLOSED, quic::explain(&e))),
        },
    }
}

/// Handshake and greeting, beside the running session.
async fn greet(
    incoming: Incoming,
    _place: Place,
    greeted: mpsc::Sender<Greeted>,
    notices: mpsc::UnboundedSender<Notice>,
) {
    let peer = incoming.remote_address();
    let refused = |why: String| {
        let _ = notices.send(Notice::Refused {
            why: format!("{peer}: {why}"),
        });
    };
    let connection = match incoming.await {
        Ok(connection) => connection,
        Err(e) => return refused(quic::explain(&e)),
    };
    let mut control = match Control::accept(&connection).await {
        Ok(control) => control,
        Err(e) => return refused(e.to_string()),
    };
    match control.hello().await {
        Ok(hello) => {
            // The daemon has stopped if nobody receives.
            let _ = greeted
                .send(Greeted {
                    connection,
                    control,
                    hello,
                })
                .await;
        }
        Err(e) => {
            let text = e.to_string();
            turn_away(connection, control, RejectCode::Malformed, text.clone()).await;
            refused(text);
        }
    }
}

/// Says why there is no session, and closes once that has been read.
async fn turn_away(connection: Connection, mut control: Control, code: RejectCode, text: String) {
    let close = match code {
        RejectCode::Malformed => BAD_GREETING,
        _ => REJECTED,
    };
    let say = async {
        // The peer may be gone already; there is nobody else to tell.
        let _ = control.write(&Answer::Reject { code, text }.encode()).await;
        let _ = control.send.finish();
        let _ = control.send.stopped().await;
    };
    let _ = tokio::time::timeout(Duration::from_secs(2), say).await;
    connection.close(VarInt::from_u32(close), b"rejected");
}
