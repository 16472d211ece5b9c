//! The operator's shell: dials, redials, feeds the session samples and moves its bytes.

mod attend;

use std::borrow::Cow;
use std::fmt;
use std::future::Future;
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
use telemime_protocol::wire::hello::RejectCode;
use telemime_protocol::wire::{DecodeError, Version};
use tokio::sync::{mpsc, watch};
use tokio::time::{sleep_until, timeout};

use crate::console::{Act, Shape};
use crate::dial::{DialError, Dialler, Link, Seen};
use crate::input::Driver;
use crate::lessons::{Lesson, LessonError, Lessons};
use crate::recognise::Recogniser;
use crate::session::{Counters, Event, Output, Seen as LinkSeen, Session, SessionConfig};
use crate::task::{Advice, Outcome, Task};

pub use attend::Snapshot;

/// A robot that has ended its stream gets this long to say why.
const LAST_WORDS: Duration = Duration::from_millis(500);

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

/// Why the daemon ended without doing its task.
#[derive(Debug, thiserror::Error)]
pub enum DaemonError {
    /// The robot could not be reached at all.
    #[error("cannot reach the robot at {addr}: {why}")]
    Unreachable {
        /// Its address.
        addr: SocketAddr,
        /// The last attempt's error.
        why: String,
    },
    /// The robot declined the session.
    #[error("the robot at {addr} declines: {text}")]
    Rejected {
        /// Its address.
        addr: SocketAddr,
        /// Why, for machines.
        code: RejectCode,
        /// Why, for people.
        text: String,
    },
    /// Another key answers than the one that is pinned.
    #[error(
        "the robot at {addr} has another key than the one we know: it shows {}. Either it was set up anew, or somebody \
         is in between; nothing was sent. If it was on purpose, run `telemime peers remove` for the old key and pair again",
        shown.map_or_else(|| "none we can read".to_owned(), |key| key.to_string())
    )]
    KeyChanged {
        /// Its address.
        addr: SocketAddr,
        /// What it shows.
        shown: Option<Fingerprint>,
    },
    /// The robot has revoked our key.
    #[error(
        "the robot at {addr} has revoked our key: it must be removed there (`telemime peers remove`) before it can be paired again"
    )]
    Revoked {
        /// Its address.
        addr: SocketAddr,
    },
}

/// What there is to know afterwards.
#[derive(Debug, Clone)]
pub struct Summary {
    /// How the task ended.
    pub outcome: Outcome,
    /// Sums over all sessions.
    pub counters: Counters,
    /// Traffic from first packet to last.
    pub total: Counts,
    /// Traffic from the request that was granted until the release had been sent.
    pub engaged: Counts,
    /// Sessions begun.
    pub sessions: u32,
    /// What became of the datagrams of the last session in which something was driven.
    pub seen: LinkSeen,
}

/// Something for a log or a progress bar.
#[derive(Debug, Clone)]
pub enum Notice {
    /// An attempt to connect failed and will be repeated.
    Dialling {
        /// Why.
        why: String,
    },
    /// A session began.
    Connected {
        /// Its epoch.
        epoch: u32,
        /// The protocol version both speak.
        version: Version,
    },
    /// The connection was lost.
    Lost {
        /// Why.
        why: String,
    },
    /// Something happened in the session, at this time of the session clock.
    Event(Stamp, Event),
    /// How far the task has got, in [0, 1]; a few times a second.
    Progress(f64),
    /// What became of something the person at the terminal said.
    Note(Cow<'static, str>),
    /// A performance of the task is over, and its recording's time was 0 then.
    Performed {
        /// Which one, from 1 on.
        number: u32,
        /// When, on the session clock, the recording's first sample was valid.
        zero: Stamp,
    },
    /// The link is to be like that: for whoever shapes it.
    LinkAsked(Shape),
    /// A performance was kept, by this name.
    Kept(String),
    /// The skill was refined.
    Refined {
        /// It.
        skill: Arc<Skill>,
        /// The performance, and the share of it that was new to the skill.
        learned: Vec<(String, f64)>,
    },
    /// The skill was written to this file.
    Saved(PathBuf),
    /// The scale the next engagement uses, and ε_path, m.
    Mapping {
        /// Tip metres per hand metre.
        scale: f64,
        /// ε_path, m.
        path_bound_m: f64,
        /// The robot.
        robot: String,
    },
}

const NOT_HERE: &str =
    "an operator is paired by `telemime pair HOST:PORT`, a robot on its own terminal";

/// What the person at the terminal says.
struct Console<'a> {
    quit: &'a mut watch::Receiver<bool>,
    words: &'a mut mpsc::UnboundedReceiver<Word>,
    notices: &'a mpsc::UnboundedSender<Notice>,
}

impl Console<'_> {
    /// Does `work` while nobody can be told: a stop is kept in `stop`, a reset is not.
    async fn beside<T>(
        &mut self,
        now: impl Fn() -> Stamp,
        task: &mut Task,
        stop: &mut bool,
        work: impl Future<Output = T>,
    ) -> T {
        let mut work = pin!(work);
        loop {
            tokio::select! {
                biased;
                heard = task.hear() => {
                    match task.handle(now(), heard, None) {
                        Some(Act::Stop) => *stop = true,
                        Some(Act::Shape(shape)) => drop(self.notices.send(Notice::LinkAsked(shape))),
                        // Refused without a session.
                        Some(Act::Learn { .. } | Act::Use(_)) | None => {}
                    }
                    self.tell(task);
                }
                Some(word) = self.words.recv() => self.note(match word {
                    Word::Stop => {
                        *stop = true;
                        "there is no link: the emergency stop is the first thing the robot will hear"
                    }
                    Word::Reset => "there is no link: the reset is discarded",
                    Word::BlackBox | Word::Pair(_) | Word::Yes | Word::No => NOT_HERE,
                    Word::Engage | Word::Release | Word::Keep | Word::Refine | Word::Save(_) => {
                        "there is no link: say it again when it is back"
                    }
                }),
                done = &mut work => return done,
            }
        }
    }

    /// What the input has to tell.
    fn tell(&self, task: &mut Task) {
        while let Some(note) = task.driver().and_then(Driver::poll_note) {
            self.note(note);
        }
    }

    fn note(&self, text: impl Into<Cow<'static, str>>) {
        let _ = self.notices.send(Notice::Note(text.into()));
    }
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
            let mut last = link.seen();
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
            seen = Some(last);
            stop = session.stop_is_unconfirmed();
            summary.counters.add(session.counters());
            let of_link = session.seen();
            if of_link.up.is_some() || summary.seen.up.is_none() {
                summary.seen = of_link;
            }
            match end {
                End::Finished | End::Quit => break,
                End::Lost(why) => {
                    task.on_lost(&why);
                    let _ = notices.send(Notice::Lost { why });
                }
            }
        }
        if lessons.is_busy() {
            let lesson = lessons.finished().await;
            self.learned(lesson, &lessons, task, notices);
        }
        endpoint.wait_idle().await;
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

    /// Dials until there is a session; `None` once the task is over anyway and no `stop` has to be delivered.
    /// `seen` is what the last session's link was like, if there was one.
    async fn dial(
        &self,
        endpoint: &mut Endpoint,
        seen: Option<Seen>,
        task: &mut Task,
        console: &mut Console<'_>,
        stop: &mut bool,
    ) -> Result<Option<Link>, DaemonError> {
        let (begun, first, addr) = (self.now(), seen.is_none(), self.robot);
        let mut dialler = Dialler::new(endpoint, addr, self.config.versions, seen);
        let (mut said, mut bound) = (None, begun);
        loop {
            let outcome = console
                .beside(|| self.now(), task, stop, dialler.next())
                .await;
            let patient = self.now().secs_since(begun) <= self.patience.as_secs_f64();
            let why = match outcome {
                Some(Ok(link)) => return Ok(Some(link)),
                None => None,
                Some(Err(DialError::Again(why))) => Some(why),
                Some(Err(DialError::NoSocket)) => {
                    bound = Stamp(i64::MIN);
                    Some("our socket has failed".into())
                }
                // An operator that lost its link, or comes back, may find its own old session still in authority.
                Some(Err(DialError::Rejected {
                    code: RejectCode::Busy,
                    text,
                })) if !first || patient => Some(text),
                Some(Err(DialError::Rejected { code, text })) => {
                    return Err(DaemonError::Rejected { addr, code, text });
                }
                Some(Err(DialError::KeyChanged)) => {
                    let shown = self.trust.turned_away();
                    let changed = DaemonError::KeyChanged { addr, shown };
                    if first {
                        return Err(changed);
                    }
                    // Whoever answers in its place now need not be there for long.
                    Some(changed.to_string())
                }
                Some(Err(DialError::Revoked)) => return Err(DaemonError::Revoked { addr }),
            };
            if self.now().secs_since(bound) > SOCKET_PATIENCE_S
                && (!first || bound.0 == i64::MIN)
                && let Some(reopen) = &self.reopen
            {
                bound = self.now();
                match (reopen.0)() {
                    Ok(other) => {
                        *endpoint = other;
                        dialler.move_to(endpoint);
                    }
                    Err(e) => console.note(format!("no other socket to be had: {e}")),
                }
            }
            if first && !patient {
                let why = why.or(said);
                let why = why.unwrap_or_else(|| "no answer".into());
                return Err(DaemonError::Unreachable { addr, why });
            }
            if task.is_over(self.now()) && !*stop {
                return Ok(None);
            }
            if why.is_some() && why != said {
                said.clone_from(&why);
                let why = why.unwrap_or_default();
                let _ = console.notices.send(Notice::Dialling { why });
            }
        }
    }

    async fn drive(
        &self,
        (session, seen): (&mut Session, &mut Seen),
        mut link: Link,
        task: &mut Task,
        console: Console<'_>,
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
                return self.leave(session, link, marks).await;
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
                    let _ = self.leave(session, link, marks).await;
                    return End::Quit;
                }
                standing = self.withdrawn(key) => {
                    let _ = self.leave(session, link, marks).await;
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
                lesson = lessons.finished() => {
                    if let Some(skill) = self.learned(lesson, lessons, task, notices) {
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

    /// What the person at the page wants, and only the daemon can do.
    fn act(
        &self,
        act: Act,
        session: &mut Session,
        task: &mut Task,
        lessons: &mut Lessons,
        notices: &mpsc::UnboundedSender<Notice>,
    ) {
        match act {
            Act::Stop => session.stop(self.now()),
            Act::Shape(shape) => drop(notices.send(Notice::LinkAsked(shape))),
            Act::Use(skill) => {
                lessons.adopt(Arc::clone(&skill));
                session.replace_skill(skill);
            }
            Act::Learn {
                name,
                strokes,
                others,
            } => {
                if let Err((strokes, why)) = lessons.teach(name, strokes, others)
                    && let Some(live) = task.person()
                {
                    live.on_no_lesson(strokes, &why);
                }
            }
        }
    }

    /// What the person at the terminal says of learning.
    fn lesson(
        &self,
        word: &Word,
        session: &Session,
        lessons: &mut Lessons,
        notices: &mpsc::UnboundedSender<Notice>,
    ) -> Result<(), LessonError> {
        match word {
            Word::Keep => {
                let _ = notices.send(Notice::Kept(lessons.keep(session.driven())?));
            }
            Word::Refine => lessons.refine()?,
            Word::Save(file) => {
                lessons.save(file)?;
                let _ = notices.send(Notice::Saved(file.clone()));
            }
            Word::Stop | Word::Reset | Word::Engage | Word::Release => {}
            Word::BlackBox | Word::Pair(_) | Word::Yes | Word::No => {}
        }
        Ok(())
    }

    /// Tells what was learned, saves it if that is wanted, and returns the skill if it is a new one.
    fn learned(
        &self,
        lesson: Result<Lesson, LessonError>,
        lessons: &Lessons,
        task: &mut Task,
        notices: &mpsc::UnboundedSender<Notice>,
    ) -> Option<Arc<Skill>> {
        if let Some(live) = task.person() {
            live.on_lesson(&lesson);
        }
        let note = |text: String| drop(notices.send(Notice::Note(text.into())));
        let lesson = match lesson {
            Ok(lesson) => lesson,
            Err(e) => {
                note(e.to_string());
                return None;
            }
        };
        for (name, why) in &lesson.left_out {
            note(format!("{name} is not learned from: {why}"));
        }
        for what in lesson.learned.iter().filter(|what| what.is_unlike()) {
            note(format!(
                "{} is unlike what the skill has seen: {:.0} % of it is new",
                what.name,
                what.novel * 1e2
            ));
        }
        let skill = lesson.skill?;
        let learned = lesson.learned.into_iter().map(|w| (w.name, w.novel));
        let _ = notices.send(Notice::Refined {
            skill: Arc::clone(&skill),
            learned: learned.collect(),
        });
        let folder = self.learning.save.as_deref();
        if let Some(file) = folder.and_then(|folder| lessons.file_in(folder)) {
            match lessons.save(&file) {
                Ok(()) => drop(notices.send(Notice::Saved(file))),
                Err(e) => note(e.to_string()),
            }
        }
        Some(skill)
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

    /// Releases, says goodbye, and waits until the robot has read it.
    async fn leave(&self, session: &mut Session, link: Link, marks: &mut Marks) -> End {
        session.goodbye();
        let said = self.flush(session, &link, marks);
        let Link {
            connection, writer, ..
        } = link;
        if said.is_ok() {
            writer.finish(Duration::from_secs(1)).await;
        }
        // Only now has QUIC sent what it was given; after the release that is no motion any more.
        marks.released = Some(self.meter.counts());
        connection.close(VarInt::from_u32(0), b"goodbye");
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

/// Traffic at the request that was granted and after the release.
#[derive(Debug, Default)]
struct Marks {
    requests: u32,
    requested: Counts,
    granted: Option<Counts>,
    released: Option<Counts>,
    progress: f64,
    performances: u32,
}

impl Marks {
    /// Before anything that follows the newest request is handed to QUIC.
    fn on_request(&mut self, requests: u32, counts: Counts) {
        if self.requests != requests {
            self.requests = requests;
            self.requested = counts;
        }
    }

    fn span(&self, total: Counts) -> Counts {
        let Some(from) = self.granted else {
            return Counts::default();
        };
        self.released.unwrap_or(total).since(from)
    }
}
