//! What the operator is to do: replay a recording as if the hand were there, or play a skill.

use std::collections::VecDeque;

use telemime_protocol::checkpoint::PosePlan;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::{Cause, Refusal, RobotState};

use crate::console::{Act, Live, Said};
use crate::demonstration::Sample;
use crate::input::{self, Driver};
use crate::recording::Scribe;
use crate::session::{Event, HandSample, LOST_S, Leeway, Session};

/// Pause before a declined request is made again, s.
const RETRY_S: f64 = 0.05;

/// Requests made before giving up.
const MAX_REQUESTS: u32 = 100;

/// The arm gets this long to come to rest before the operator leaves, s.
const LEAVE_S: f64 = 0.6;

/// How a task ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// Done.
    Completed,
    /// Not done, and why.
    Interrupted(String),
}

/// What the shell should do next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Advice {
    /// Go on.
    Continue,
    /// A performance is over; said once.
    Performed,
    /// Another may follow: [`Task::go_on`] when it may.
    Between,
    /// The task is over: leave.
    Finished,
}

/// A recording with its own time, s from 0.
#[derive(Debug, Clone)]
pub struct Recording {
    /// The hand, in order of time.
    pub samples: Vec<Sample>,
    /// The hand rests at the first position for this long before the recording begins, s: one engages at rest.
    pub rest_s: f64,
}

enum Work {
    Replay {
        recording: Recording,
        next: usize,
    },
    Play {
        plan: PosePlan,
        beside: Option<Beside>,
    },
    /// A person at the console page: no end of its own.
    Live(Box<Live>),
    /// A tracked hand.
    Input(Box<Driver>),
}

/// What a task waits for.
#[derive(Debug)]
pub enum Heard {
    /// A page, by its number, says this.
    Page(u64, Said),
    /// The input says this.
    Input(input::Arrived),
}

/// A hand beside a motion that is played.
struct Beside {
    leeway: Leeway,
    samples: Vec<Sample>,
    next: usize,
}

impl Beside {
    /// Sample `i` of a play that began at `zero`, and whether the hand lets go after it.
    fn at(&self, i: usize, zero: Stamp) -> Option<(HandSample, bool)> {
        let sample = self.samples.get(i)?;
        let on = self.samples.get(i + 1);
        let last = on.is_none_or(|next| next.t_s - sample.t_s > LOST_S);
        let t = zero.offset_by_secs(sample.t_s);
        Some((HandSample::at(t, sample.position), last))
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Phase {
    /// Not yet asked, or to be asked again at this time.
    Waiting(Option<Stamp>),
    Asked,
    Engaged,
    /// Released; leave at this time.
    Leaving(Stamp),
    /// At rest after a performance.
    Between,
    Over,
}

/// A task in progress.
pub struct Task {
    work: Work,
    /// Recordings to replay after this one.
    then: VecDeque<Recording>,
    phase: Phase,
    /// When the recording's rest began.
    started: Option<Stamp>,
    engaged_at: Option<Stamp>,
    /// When the robot engaged, as it says.
    begun: Option<Stamp>,
    requests: u32,
    /// Why the robot would not engage, the last time it was asked.
    put_off: Option<Refusal>,
    trouble: Option<String>,
    scribe: Option<Scribe>,
}

impl Task {
    /// Replays `recording` at its own speed.
    pub fn replay(recording: Recording) -> Self {
        Self::new(Work::Replay { recording, next: 0 })
    }

    /// And then another one: an engagement of its own, in the same session.
    #[must_use]
    pub fn and_then(mut self, recording: Recording) -> Self {
        self.then.push_back(recording);
        self
    }

    /// Plays `plan`.
    pub fn play(plan: impl Into<PosePlan>) -> Self {
        Self::new(Work::Play {
            plan: plan.into(),
            beside: None,
        })
    }

    /// Plays `plan`, of a skill of this `leeway`, while a hand corrects it: `samples` in order of time, s from when the
    /// robot begins. Where they leave a hole of more than [`LOST_S`] the hand lets go, and takes hold anew after it.
    pub fn play_corrected(plan: impl Into<PosePlan>, leeway: Leeway, samples: Vec<Sample>) -> Self {
        Self::new(Work::Play {
            plan: plan.into(),
            beside: Some(Beside {
                leeway,
                samples,
                next: 0,
            }),
        })
    }

    /// Does what the person at the page does, until it is told to quit.
    pub fn live(live: Live) -> Self {
        Self::new(Work::Live(Box::new(live)))
    }

    /// The same, recorded.
    #[must_use]
    pub fn recorded(mut self, scribe: Option<Scribe>) -> Self {
        self.scribe = scribe;
        self
    }

    /// The person at the page, if that is the task.
    pub fn person(&mut self) -> Option<&mut Live> {
        match &mut self.work {
            Work::Live(live) => Some(live),
            Work::Replay { .. } | Work::Play { .. } | Work::Input(_) => None,
        }
    }

    /// Follows a tracked hand, until it is told to quit.
    pub fn input(driver: Driver) -> Self {
        Self::new(Work::Input(Box::new(driver)))
    }

    /// The tracked hand, if that is the task.
    pub fn driver(&mut self) -> Option<&mut Driver> {
        match &mut self.work {
            Work::Input(driver) => Some(driver),
            Work::Replay { .. } | Work::Play { .. } | Work::Live(_) => None,
        }
    }

    /// What became of the input's frames, if there is one.
    pub fn tally(&self) -> Option<&input::Tally> {
        match &self.work {
            Work::Input(driver) => Some(driver.tally()),
            Work::Replay { .. } | Work::Play { .. } | Work::Live(_) => None,
        }
    }

    /// What a page or the input says next; never ends without one.
    pub async fn hear(&mut self) -> Heard {
        match &mut self.work {
            Work::Live(live) => {
                let (page, said) = live.hear().await;
                Heard::Page(page, said)
            }
            Work::Input(driver) => Heard::Input(driver.hear().await),
            Work::Replay { .. } | Work::Play { .. } => std::future::pending().await,
        }
    }

    /// Takes what was heard, and returns what only the daemon can do of it.
    pub fn handle(
        &mut self,
        now: Stamp,
        heard: Heard,
        session: Option<&mut Session>,
    ) -> Option<Act> {
        match (&mut self.work, heard) {
            (Work::Live(live), Heard::Page(page, said)) => live.handle(now, page, said, session),
            (Work::Input(driver), Heard::Input(arrived)) => {
                driver.handle(now, arrived, session);
                None
            }
            _ => None,
        }
    }

    fn new(work: Work) -> Self {
        Self {
            work,
            then: VecDeque::new(),
            phase: Phase::Waiting(None),
            started: None,
            engaged_at: None,
            begun: None,
            requests: 0,
            put_off: None,
            trouble: None,
            scribe: None,
        }
    }

    /// When the recording's own time was 0 on the session clock, once known.
    pub fn zero(&self) -> Option<Stamp> {
        match &self.work {
            Work::Replay { recording, .. } => {
                self.started.map(|t| t.offset_by_secs(recording.rest_s))
            }
            Work::Play { .. } => self.engaged_at,
            Work::Live(_) | Work::Input(_) => None,
        }
    }

    /// How far the task has got, in [0, 1].
    pub fn progress(&self) -> f64 {
        match &self.work {
            Work::Replay { recording, next } => *next as f64 / self.count(recording) as f64,
            Work::Play { .. } => f64::from(u8::from(self.phase == Phase::Over)),
            Work::Live(_) | Work::Input(_) => 0.0,
        }
    }

    /// Whether nothing more can come of it, at `now`.
    pub fn is_over(&self, now: Stamp) -> bool {
        self.phase == Phase::Over
            || self.then.is_empty()
                && match &self.work {
                    Work::Replay { recording, .. } => {
                        let end_s = recording.samples.last().map_or(0.0, |s| s.t_s);
                        self.zero()
                            .is_some_and(|zero| now.secs_since(zero) > end_s + LEAVE_S)
                    }
                    Work::Play { .. } => self.trouble.is_some(),
                    Work::Live(_) => false,
                    Work::Input(driver) => driver.is_over(now),
                }
    }

    /// Whether the clutch has been let go after an engagement.
    pub fn has_released(&self) -> bool {
        matches!(self.phase, Phase::Leaving(_) | Phase::Between | Phase::Over)
    }

    /// How it ended; `quit` says that it was cut short from outside.
    pub fn outcome(&self, quit: bool) -> Outcome {
        match &self.trouble {
            None if quit && matches!(self.work, Work::Live(_) | Work::Input(_)) => {
                Outcome::Completed
            }
            Some(why) => Outcome::Interrupted(why.clone()),
            None if quit => Outcome::Interrupted("stopped by hand".into()),
            None if self.phase == Phase::Over => Outcome::Completed,
            None => Outcome::Interrupted("the link was not back before the recording ended".into()),
        }
    }

    /// The connection was lost: the arm holds, and nothing here engages it again.
    pub fn on_lost(&mut self, why: &str) {
        if let Some(scribe) = &mut self.scribe {
            scribe.lost(why);
        }
        if let Some(live) = self.person() {
            return live.on_lost(why);
        }
        if let Some(driver) = self.driver() {
            return driver.on_lost();
        }
        match self.phase {
            Phase::Asked | Phase::Engaged => self.give_up(format!(
                "the link was lost ({why}); the arm holds and is not engaged again by itself"
            )),
            // The next session is asked as soon as it is there.
            Phase::Waiting(_) => self.phase = Phase::Waiting(None),
            // Nothing is left to do that would need a link.
            Phase::Leaving(_) if matches!(self.work, Work::Play { .. }) => self.phase = Phase::Over,
            Phase::Leaving(_) | Phase::Between | Phase::Over => {}
        }
    }

    /// The session reports.
    pub fn on_event(&mut self, now: Stamp, event: &Event) {
        if let Some(scribe) = &mut self.scribe {
            scribe.hear(now, event);
        }
        if let Some(live) = self.person() {
            return live.on_event(now, event);
        }
        if let Some(driver) = self.driver() {
            return driver.on_event(now, event);
        }
        match event {
            Event::Engaged { t_us, .. } => {
                self.phase = Phase::Engaged;
                self.begun = Some(Stamp(t_us.saturating_mul(1000)));
                self.engaged_at = Some(now);
            }
            Event::Refused(
                reason @ (Refusal::ClockUnknown | Refusal::Moving | Refusal::StaleReference),
            ) => {
                self.put_off = Some(*reason);
                self.phase = Phase::Waiting(Some(now.offset_by_secs(RETRY_S)));
            }
            Event::Refused(Refusal::Diverged) => {}
            Event::Refused(reason) => self.give_up(format!("the robot declines: {reason:?}")),
            // A former operator's stop is not ours.
            Event::State(RobotState::Holding, cause) if self.phase == Phase::Engaged => {
                self.give_up(format!(
                    "the arm stopped by itself ({cause:?}) and holds; engage again on purpose"
                ));
            }
            Event::State(RobotState::Stopped, _) => self.give_up(
                "the emergency stop is latched; type reset at either end when it is safe".into(),
            ),
            // A former operator's motion is not ours either.
            Event::State(RobotState::Ready, Cause::PlanFinished)
                if self.phase == Phase::Engaged =>
            {
                self.phase = Phase::Leaving(now.offset_by_secs(LEAVE_S));
            }
            Event::Ready
            | Event::State(..)
            | Event::Recognised { .. }
            | Event::Correction(_)
            | Event::Bent(_)
            | Event::Telemetry(_) => {}
        }
    }

    /// Feeds the session what is due at `now`.
    pub fn advise(&mut self, now: Stamp, session: &mut Session) -> Advice {
        if let Some(scribe) = &mut self.scribe {
            scribe.see(now, session);
        }
        if let Some(live) = self.person() {
            live.advise(now, session);
            return Advice::Continue;
        }
        if let Some(driver) = self.driver() {
            if driver.advise(now, session) {
                self.phase = Phase::Over;
                return Advice::Finished;
            }
            return Advice::Continue;
        }
        match self.phase {
            Phase::Over => return Advice::Finished,
            Phase::Between => return Advice::Between,
            Phase::Leaving(at) if now >= at => {
                let performed = matches!(self.work, Work::Replay { .. }) && self.trouble.is_none();
                if performed {
                    self.phase = Phase::Between;
                    return Advice::Performed;
                }
                self.phase = Phase::Over;
                return Advice::Finished;
            }
            _ => {}
        }
        if session.info().is_none() || (self.started.is_none() && !session.is_ready()) {
            return Advice::Continue;
        }
        let started = *self.started.get_or_insert(now);
        let may_ask = self.trouble.is_none()
            && matches!(self.phase, Phase::Waiting(at) if at.is_none_or(|at| now >= at));
        match &mut self.work {
            Work::Live(_) | Work::Input(_) => {}
            Work::Play { plan, beside } if may_ask => {
                session.play(plan, beside.as_ref().map(|beside| &beside.leeway));
                self.asked();
            }
            Work::Play { beside, .. } => {
                let Some((beside, zero)) = beside.as_mut().zip(self.begun) else {
                    return Advice::Continue;
                };
                while self.phase == Phase::Engaged
                    && let Some((sample, last)) =
                        beside.at(beside.next, zero).filter(|(s, _)| s.t <= now)
                {
                    session.handle_sample(now, sample);
                    if last {
                        session.let_go(now);
                    }
                    beside.next += 1;
                }
            }
            Work::Replay { recording, next } => {
                let mut fresh = false;
                while let Some(sample) = sample_at(recording, *next, started).filter(|s| s.t <= now)
                {
                    session.handle_sample(now, sample);
                    fresh = true;
                    *next += 1;
                }
                let done = sample_at(recording, *next, started).is_none();
                if fresh && may_ask && !done {
                    session.engage(now);
                    self.asked();
                }
                if done && !self.has_released() {
                    session.release();
                    self.phase = Phase::Leaving(now.offset_by_secs(LEAVE_S));
                    if self.engaged_at.is_none() && self.trouble.is_none() {
                        self.trouble = Some(match self.put_off {
                            Some(Refusal::StaleReference) => "the robot never engaged: what it was asked came too late, more than half a second after it was true (protocol.md §4)".into(),
                            Some(Refusal::ClockUnknown) => "the robot never engaged: it has not found out our clock; do its datagrams arrive?".into(),
                            Some(reason) => format!("the robot never engaged: {reason:?}, to the last"),
                            None => "the robot never engaged: it did not answer while the recording lasted".into(),
                        });
                    }
                }
            }
        }
        Advice::Continue
    }

    /// Whether something happened after which nothing more is driven.
    pub fn is_in_trouble(&self) -> bool {
        self.trouble.is_some()
    }

    /// After [`Advice::Between`]: begins the next performance, or ends the task if there is none.
    pub fn go_on(&mut self) {
        if self.phase != Phase::Between {
            return;
        }
        let next = self.then.pop_front().filter(|_| self.trouble.is_none());
        self.phase = match next {
            None => Phase::Over,
            Some(recording) => {
                self.work = Work::Replay { recording, next: 0 };
                (self.started, self.engaged_at, self.requests) = (None, None, 0);
                Phase::Waiting(None)
            }
        };
    }

    /// When [`Task::advise`] has something to do next.
    pub fn poll_timeout(&self) -> Option<Stamp> {
        if let Work::Live(live) = &self.work {
            return live.poll_timeout();
        }
        if let Work::Input(driver) = &self.work {
            return driver.poll_timeout();
        }
        if matches!(self.phase, Phase::Between | Phase::Over) {
            return None;
        }
        // A replay asks with its next sample; only a plan is asked for by the clock.
        let retry = match (&self.work, self.phase) {
            (Work::Play { .. }, Phase::Waiting(at)) => at,
            _ => None,
        };
        let leave = if let Phase::Leaving(at) = self.phase {
            Some(at)
        } else {
            None
        };
        let sample = match (&self.work, self.started) {
            (Work::Replay { recording, next }, Some(started)) => {
                sample_at(recording, *next, started).map(|s| s.t)
            }
            (
                Work::Play {
                    beside: Some(beside),
                    ..
                },
                _,
            ) if self.phase == Phase::Engaged => self
                .begun
                .and_then(|zero| Some(beside.at(beside.next, zero)?.0.t)),
            _ => None,
        };
        [retry.filter(|_| self.started.is_some()), leave, sample]
            .into_iter()
            .flatten()
            .min()
    }

    fn asked(&mut self) {
        self.requests += 1;
        self.phase = Phase::Asked;
        if self.requests > MAX_REQUESTS {
            self.give_up("the robot does not engage".into());
        }
    }

    fn give_up(&mut self, why: String) {
        self.trouble.get_or_insert(why);
        if matches!(self.work, Work::Play { .. }) || self.requests > MAX_REQUESTS {
            self.phase = Phase::Over;
        } else if !self.has_released() {
            self.phase = Phase::Waiting(None);
        }
    }

    fn count(&self, recording: &Recording) -> usize {
        recording.samples.len() + rest_samples(recording)
    }
}

/// Interval of the samples at rest, s.
const REST_INTERVAL_S: f64 = 1.0 / 30.0;

fn rest_samples(recording: &Recording) -> usize {
    (recording.rest_s / REST_INTERVAL_S) as usize
}

/// Sample `i`, those at rest first.
fn sample_at(recording: &Recording, i: usize, started: Stamp) -> Option<HandSample> {
    let resting = rest_samples(recording);
    let first = recording.samples.first()?;
    let (sample, t) = if i < resting {
        (first, started.offset_by_secs(i as f64 * REST_INTERVAL_S))
    } else {
        let sample = recording.samples.get(i - resting)?;
        let since_s = recording.rest_s + sample.t_s - first.t_s;
        (sample, started.offset_by_secs(since_s))
    };
    Some(HandSample {
        t,
        x: sample.position,
        orientation: sample.orientation,
        grip: sample.grip,
        resting: i < resting,
    })
}

#[cfg(test)]
pub(crate) mod tests;
