//! The operator's shell: dials, redials, feeds the session samples and moves its bytes.

mod attend;
mod console;
mod redial;
mod said;
mod teach;

use std::fmt;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use quinn::{Connection, Endpoint, VarInt};
use telemime_endpoint::cli::{Word, told};
use telemime_endpoint::control::ControlError;
use telemime_endpoint::meter::Counts;
use telemime_endpoint::quic::EndpointError;
use telemime_endpoint::{
    External, Fingerprint, HostClock, Meter, Mono, Standing, Trust, quic, trust,
};
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::DecodeError;
use tokio::sync::{mpsc, watch};
use tokio::time::{sleep_until, timeout};

use crate::console::Act;
use crate::dial::{Link, Seen};
use crate::lessons::Lessons;
use crate::recognise::Recogniser;
use crate::session::{Counters, Event, Output, Seen as LinkSeen, Session, SessionConfig};
use crate::task::{Advice, Outcome, Task};
use console::{Console, NOT_HERE};
use said::Marks;

pub use attend::Snapshot;
pub use said::{DaemonError, Notice, Summary};

/// A robot that has ended its stream gets this long to say why.
const LAST_WORDS: Duration = Duration::from_millis(500);

/// Whoever leaves waits this long for the robot to have all that was said, the end of the path among it: four of QUIC's
/// retransmissions, each after twice the time of the one before, at a round trip of 0.2 s. A dead link ends it sooner.
const GOODBYE: Duration = Duration::from_secs(5);

/// The same where the robot's key is not trusted any more: nothing is owed to it.
const SHORT_GOODBYE: Duration = Duration::from_secs(1);

/// Nobody answered for so long: the socket itself may be what is wrong.
const SOCKET_PATIENCE_S: f64 = 5.0;

/// Makes another endpoint like the first, on a socket of its own.
#[derive(Clone)]
pub struct Reopen(Arc<dyn Fn() -> Result<Endpoint, EndpointError> + Send + Sync>);

impl Reopen {
    /// By calling `open`.
    pub fn new(open: impl Fn() -> Result<Endpoint, EndpointError> + Send + Sync + 'static) -> Self {
        Self(Arc::new(open))
    }
}

impl fmt::Debug for Reopen {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Reopen")
    }
}

/// What the daemon needs.
#[derive(Debug)]
pub struct Daemon {
    /// A client endpoint whose default settings trust whom `trust` does.
    pub endpoint: Endpoint,
    /// How to get another, should its socket fail or its address vanish, as it may when a laptop changes networks.
    pub reopen: Option<Reopen>,
    /// The robot's key, and whether it still is trusted.
    pub trust: Trust,
    /// Counts the endpoint's traffic.
    pub meter: Meter,
    /// The robot.
    pub robot: SocketAddr,
    /// Mono clock of the host; the session clock counts from `epoch` on it.
    pub clock: HostClock,
    /// Zero of the session clock.
    pub epoch: Mono,
    /// A clock that is kept right from outside, if there is one.
    pub external: Option<External>,
    /// What to predict with.
    pub skill: Option<Arc<Skill>>,
    /// Says which skill the hand performs, if anybody wants to know.
    pub recogniser: Option<Recogniser>,
    /// Session settings.
    pub config: SessionConfig,
    /// What is learned from while driving, unasked.
    pub learning: Learning,
    /// Give up if the first connection takes longer than this.
    pub patience: Duration,
    /// Where metrics go, if anybody wants them.
    pub shown: Option<watch::Sender<Snapshot>>,
}

/// What a daemon learns from while driving without being told to.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Learning {
    /// Refines the skill with every performance of the task, before the next one.
    pub refine: bool,
    /// Saves the refined skill into this folder.
    pub save: Option<PathBuf>,
}

enum End {
    Finished,
    Quit,
    Lost(String),
}

impl Daemon {
    /// Runs `task` to its end, or until `quit` turns true. The arm is released in every case.
    ///
    /// # Errors
    /// [`DaemonError`] if there was no session at all.
    pub async fn run(
        &self,
        task: &mut Task,
        mut quit: watch::Receiver<bool>,
        mut words: mpsc::UnboundedReceiver<Word>,
        notices: &mpsc::UnboundedSender<Notice>,
    ) -> Result<Summary, DaemonError> {
        let mut summary = Summary {
            outcome: Outcome::Interrupted("never connected".into()),
            counters: Counters::default(),
            total: Counts::default(),
            engaged: Counts::default(),
            sessions: 0,
            seen: LinkSeen::default(),
        };
        let mut marks = Marks::default();
        let mut lessons = Lessons::new(self.skill.clone());
        // Demanded, and not confirmed by the robot: outlives the session it was demanded in.
        let mut stop = false;
        let mut seen = None;
        let mut took_leave = false;
        let mut endpoint = self.endpoint.clone();
        loop {
            let mut hung_up = quit.clone();
            let mut console = Console {
                quit: &mut quit,
                words: &mut words,
                notices,
            };
            let link = tokio::select! {
                biased;
                () = told(&mut hung_up) => break,
                link = self.dial(&mut endpoint, seen, &mut *task, &mut console, &mut stop) => link?,
            };
            let Some(link) = link else { break };
            let mut last = link.seen(seen);
            summary.sessions += 1;
            self.begun();
            let _ = notices.send(Notice::Connected {
                epoch: link.epoch,
                version: link.version,
            });
            let mut session = Session::new(self.config, lessons.skill(), link.epoch)
                .speaking(link.version)
                .watched_by(
                    task.person()
                        .and_then(|live| live.recogniser())
                        .or_else(|| self.recogniser.clone()),
                );
            marks.requests = 0;
            if stop {
                session.stop(self.now());
            }
            let connection = link.connection.clone();
            let end = self
                .drive(
                    (&mut session, &mut last),
                    link,
                    task,
                    console,
                    &mut marks,
                    &mut lessons,
                )
                .await;
            self.ended(&session);
            let of_link = session.seen();
            last.jittered(of_link.up.as_ref(), &of_link.down);
            seen = Some(last);
            stop = session.stop_is_unconfirmed();
            summary.counters.add(session.counters());
            if of_link.up.is_some() || summary.seen.up.is_none() {
                summary.seen = of_link;
            }
            match end {
                End::Finished | End::Quit => {
                    took_leave = true;
                    break;
                }
                End::Lost(why) => {
                    // Or what the writer has yet to say would keep the robot busy with a session that nobody drives.
                    connection.close(VarInt::from_u32(0), why.as_bytes());
                    task.on_lost(&why);
                    let _ = notices.send(Notice::Lost { why });
                }
            }
        }
        while lessons.is_at_work() {
            let news = lessons.news().await;
            self.news(news, &mut lessons, task, notices);
        }
        // Attempts that nobody has answered need no farewell; QUIC would wait three seconds for theirs.
        if took_leave {
            endpoint.wait_idle().await;
        }
        summary.outcome = task.outcome(*quit.borrow());
        if stop {
            summary.outcome = Outcome::Interrupted(
                "the robot never confirmed the emergency stop; what stops its arm then is its lease"
                    .into(),
            );
        }
        summary.total = self.meter.counts();
        summary.engaged = marks.span(summary.total);
        Ok(summary)
    }

    fn now(&self) -> Stamp {
        Stamp(self.clock.now().0 - self.epoch.0)
    }

    fn instant(&self, at: Stamp) -> tokio::time::Instant {
        self.clock.instant(Mono(at.0.saturating_add(self.epoch.0)))
    }

    async fn drive(
        &self,
        (session, seen): (&mut Session, &mut Seen),
        mut link: Link,
        task: &mut Task,
        mut console: Console<'_>,
        marks: &mut Marks,
        lessons: &mut Lessons,
    ) -> End {
        let notices = console.notices;
        let key = trust::key_of(&link.connection);
        loop {
            if let Err(e) = self.flush(session, &link, marks) {
                return End::Lost(e.to_string());
            }
            let now = self.now();
            while let Some(event) = session.poll_event() {
                if matches!(event, Event::Ready) {
                    let robot = session
                        .info()
                        .map_or_else(String::new, |info| info.name.clone());
                    let scale = session.scale().unwrap_or_default();
                    let path_bound_m = session.path_bound_m();
                    let _ = notices.send(Notice::Mapping {
                        scale,
                        path_bound_m,
                        robot,
                    });
                }
                if matches!(event, Event::Engaged { .. }) {
                    marks.granted.get_or_insert(marks.requested);
                }
                self.saw(&event);
                task.on_event(now, &event);
                let _ = notices.send(Notice::Event(now, event));
            }
            self.goes_on(session);
            if let Some(live) = task.person() {
                live.sent(self.meter.counts().sent.bytes);
            }
            let advice = task.advise(now, session);
            console.tell(task);
            if advice == Advice::Performed {
                marks.performances += 1;
                let zero = task.zero().unwrap_or(now);
                let _ = notices.send(Notice::Performed {
                    number: marks.performances,
                    zero: zero.offset_by_secs(-self.config.input_latency_s),
                });
                if self.learning.refine {
                    let taken = lessons.keep(session.driven());
                    match taken.and_then(|name| lessons.refine().map(|()| name)) {
                        Ok(name) => drop(notices.send(Notice::Kept(name))),
                        Err(e) => console.note(e.to_string()),
                    }
                }
            }
            let between = matches!(advice, Advice::Performed | Advice::Between);
            if between && !lessons.is_busy() && (session.is_ready() || task.is_in_trouble()) {
                task.go_on();
                continue;
            }
            // Whoever says stop is not left before the robot says it has.
            if advice == Advice::Finished && !session.stop_is_unconfirmed() {
                return self
                    .leave((session, task), link, marks, (&mut console, GOODBYE))
                    .await;
            }
            if (task.progress() - marks.progress).abs() >= 0.01 {
                marks.progress = task.progress();
                let _ = notices.send(Notice::Progress(marks.progress));
            }
            if let Err(e) = self.flush(session, &link, marks) {
                return End::Lost(e.to_string());
            }
            let due = [
                session.poll_timeout().map(|(at, _)| at),
                task.poll_timeout(),
            ];
            let due = due.into_iter().flatten().min();
            tokio::select! {
                biased;
                () = told(console.quit) => {
                    // Both may have been said at once.
                    while let Ok(word) = console.words.try_recv() {
                        if word == Word::Stop {
                            session.stop(self.now());
                        }
                    }
                    let _ = self.leave((session, task), link, marks, (&mut console, GOODBYE)).await;
                    return End::Quit;
                }
                standing = self.withdrawn(key) => {
                    let _ = self.leave((session, task), link, marks, (&mut console, SHORT_GOODBYE)).await;
                    return End::Lost(match standing {
                        Standing::Revoked => "the robot's key was revoked".into(),
                        Standing::Trusted | Standing::Unknown => "the robot's key is not trusted any more".into(),
                    });
                }
                Some(word) = console.words.recv() => match word {
                    Word::Stop => session.stop(self.now()),
                    Word::Reset if session.reset() => {}
                    Word::Reset => console.note("the reset is discarded: the robot has not confirmed the stop yet"),
                    Word::BlackBox | Word::Pair(_) | Word::Yes | Word::No => console.note(NOT_HERE),
                    word @ (Word::Engage | Word::Release) => match task.driver() {
                        Some(driver) => driver.word(self.now(), word == Word::Engage, Some(session)),
                        None => console.note("engage and release are for --input: this task has a clutch of its own"),
                    },
                    word @ (Word::Keep | Word::Refine | Word::Save(_)) => {
                        let said = self.lesson(&word, session, lessons, notices);
                        if let Err(e) = said {
                            console.note(e.to_string());
                        }
                    }
                },
                heard = task.hear() => {
                    let act = task.handle(self.now(), heard, Some(session));
                    if let Some(act) = act {
                        self.act(act, session, task, lessons, notices);
                    }
                }
                news = lessons.news() => {
                    if let Some(skill) = self.news(news, lessons, task, notices) {
                        session.replace_skill(skill);
                        if let Some(recogniser) = task.person().and_then(|live| live.recogniser()) {
                            session.watch_by(Some(recogniser));
                        }
                    }
                }
                frame = link.frames.recv() => match frame {
                    Some(Ok(frame)) => {
                        if let Err(e) = session.handle_control(self.now(), &frame) {
                            return End::Lost(malformed(&link.connection, &e));
                        }
                    }
                    Some(Err(e)) => return End::Lost(last_words(&link.connection, e.to_string()).await),
                    None => return End::Lost(last_words(&link.connection, "control stream ended".into()).await),
                },
                datagram = link.connection.read_datagram() => match datagram {
                    Ok(bytes) => {
                        seen.learn(&link.connection);
                        session.set_external(self.external.as_ref().map(|e| e.message(self.epoch)));
                        session.handle_datagram(self.now(), &bytes);
                    }
                    Err(e) => return End::Lost(quic::explain(&e)),
                },
                () = sleep_until(self.instant(due.unwrap_or(now))), if due.is_some() => {
                    let now = self.now();
                    session.handle_timeout(now);
                }
            }
        }
    }

    /// Resolves once the robot's key is not trusted any more.
    async fn withdrawn(&self, key: Option<Fingerprint>) -> Standing {
        match key {
            Some(key) => self.trust.withdrawn(key).await,
            None => Standing::Unknown,
        }
    }

    fn flush(
        &self,
        session: &mut Session,
        link: &Link,
        marks: &mut Marks,
    ) -> Result<(), ControlError> {
        marks.on_request(session.requests(), self.meter.counts());
        while let Some(output) = session.poll_output() {
            match output {
                Output::Control(payload) => link.writer.message(&payload)?,
                Output::Datagram { bytes, motion } => {
                    if motion {
                        self.meter.mark_motion(bytes.len());
                    }
                    // Too large or unsupported cannot happen (1100 B); a lost connection shows up elsewhere.
                    let _ = link.connection.send_datagram(bytes.into());
                }
            }
        }
        Ok(())
    }

    /// Releases, says goodbye, and waits until the robot has it, but no longer than `within`, nor once the user wants to quit
    /// again. A stop is heard meanwhile, too: what is said last on the stream is the goodbye, so it goes by datagram.
    async fn leave(
        &self,
        (session, task): (&mut Session, &mut Task),
        link: Link,
        marks: &mut Marks,
        (console, within): (&mut Console<'_>, Duration),
    ) -> End {
        session.goodbye();
        let said = self.flush(session, &link, marks);
        let Link {
            connection,
            writer,
            mut frames,
            ..
        } = link;
        let mut finish = pin!(writer.finish(within));
        console.quit.mark_unchanged();
        let mut hears = true;
        let held = loop {
            while let Some(output) = session.poll_output() {
                if let Output::Datagram { bytes, .. } = output {
                    let _ = connection.send_datagram(bytes.into());
                }
            }
            let due = session.poll_timeout().map(|(at, _)| at);
            tokio::select! {
                biased;
                held = &mut finish => break held,
                Ok(()) = console.quit.changed() => break false,
                Some(word) = console.words.recv() => if word == Word::Stop {
                    session.stop(self.now());
                },
                heard = task.hear() => {
                    if let Some(Act::Stop) = task.handle(self.now(), heard, None) {
                        session.stop(self.now());
                    }
                }
                frame = frames.recv(), if hears => match frame {
                    Some(Ok(frame)) => hears = session.handle_control(self.now(), &frame).is_ok(),
                    _ => hears = false,
                },
                () = sleep_until(self.instant(due.unwrap_or_else(|| self.now()))), if due.is_some() => {
                    session.handle_timeout(self.now());
                }
            }
        };
        if said.is_err() || !held {
            console
                .note("the robot has not confirmed the goodbye: it may lack the end of the path");
        }
        // Only now has QUIC sent what it was given; after the release that is no motion any more.
        marks.released = Some(self.meter.counts());
        connection.close(VarInt::from_u32(0), b"goodbye");
        if session.stop_is_unconfirmed() {
            return End::Lost("a stop was given while it said goodbye".into());
        }
        End::Finished
    }
}

/// A robot that ends a session ends its stream first, and says why when it closes.
async fn last_words(connection: &Connection, otherwise: String) -> String {
    let closed = timeout(LAST_WORDS, connection.closed()).await;
    closed.map_or(otherwise, |why| quic::explain(&why))
}

fn malformed(connection: &Connection, error: &DecodeError) -> String {
    connection.close(VarInt::from_u32(1), b"malformed control message");
    format!("the robot sent a malformed message: {error}")
}
