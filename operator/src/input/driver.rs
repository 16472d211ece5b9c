//! The clutch over a tracked hand, and what becomes of its samples. Sans-IO: time is an argument.

use std::collections::VecDeque;
use std::sync::atomic::Ordering;

use nalgebra::UnitQuaternion;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::{Refusal, RobotState};

use super::read::Inlet;
use super::{Arrived, Fault, Frame, Kind, Place, Tally, What};
use crate::clutch::{Clutch, Phase};
use crate::dating::Dating;
use crate::session::{Event, HandSample, LOST_S, Session};

/// The arm gets this long to come to rest before the operator leaves, s.
const LEAVE_S: f64 = 0.6;

/// How a person uses the source.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Habits {
    /// The clutch is pressed with the first sample: for a source that says nothing of a clutch.
    pub engage: bool,
    /// The task is over once the source has ended.
    pub until_end: bool,
}

/// A hand that is tracked while it drives.
///
/// The robot is engaged when the source says `engage` after it did not, or when a person types it, and released when either
/// ends it. No sample for [`LOST_S`] is a release; so is the source's end, the link's loss and an arm that stopped by itself. After
/// any of these the clutch must be let go and pressed anew.
#[derive(Debug)]
pub struct Driver {
    inlet: Inlet,
    habits: Habits,
    dating: Dating,
    newest: Option<Newest>,
    /// When the last sample arrived, unless the source is lost.
    heard: Option<Stamp>,
    /// The source said last that the clutch is held.
    down: bool,
    clutch: Option<Clutch>,
    /// There has been a link.
    linked: bool,
    ended: bool,
    leave: Option<Stamp>,
    tally: Tally,
    notes: VecDeque<String>,
}

#[derive(Debug, Clone, Copy)]
struct Newest {
    t: Stamp,
    t_s: Option<f64>,
    orientation: Option<UnitQuaternion<f64>>,
}

impl Driver {
    /// Takes what comes through `inlet`.
    pub fn new(inlet: Inlet, habits: Habits) -> Self {
        Self {
            inlet,
            habits,
            dating: Dating::new(LOST_S),
            newest: None,
            heard: None,
            down: false,
            clutch: None,
            linked: false,
            ended: false,
            leave: None,
            tally: Tally::default(),
            notes: VecDeque::new(),
        }
    }

    /// What the source says next; never ends.
    pub async fn hear(&mut self) -> Arrived {
        match self.inlet.arrived.recv().await {
            Some(arrived) => arrived,
            None => std::future::pending().await,
        }
    }

    /// Something to tell the person at the terminal.
    pub fn poll_note(&mut self) -> Option<String> {
        self.notes.pop_front()
    }

    /// What became of the frames so far.
    pub fn tally(&self) -> &Tally {
        &self.tally
    }

    /// Takes what the source said; without a `session` the hand is seen and drives nothing.
    pub fn handle(&mut self, now: Stamp, arrived: Arrived, session: Option<&mut Session>) {
        match arrived.what {
            What::Dropped(fault) => self.dropped(&fault, 1),
            What::Frame(frame) => self.frame(now, arrived.at, &frame, session),
            What::End(why) => {
                self.ended = true;
                self.heard = None;
                self.note(format!("the input has ended: {why}"));
                self.let_go(session);
                if self.habits.until_end {
                    self.leave = Some(now.offset_by_secs(LEAVE_S));
                }
            }
        }
    }

    fn frame(&mut self, now: Stamp, at: Stamp, frame: &Frame, mut session: Option<&mut Session>) {
        // Let go before the hand moves on, and take hold where it is.
        if frame.engage == Some(false) {
            self.down = false;
            self.let_go(session.as_deref_mut());
        }
        if let Some(place) = &frame.hand {
            self.sample(now, at, frame.t_s, place, session.as_deref_mut());
        }
        if frame.engage == Some(true) && !self.down {
            self.down = true;
            self.press(now, session);
        }
    }

    fn sample(
        &mut self,
        now: Stamp,
        at: Stamp,
        t_s: Option<f64>,
        place: &Place,
        mut session: Option<&mut Session>,
    ) {
        if self
            .heard
            .is_some_and(|heard| at.secs_since(heard) >= LOST_S)
        {
            self.lose(session.as_deref_mut());
        }
        if self.heard.is_none() {
            // Another sender perhaps, with a clock of its own.
            self.dating = Dating::new(LOST_S);
            if let Some(newest) = &mut self.newest {
                newest.t_s = None;
            }
        }
        let own = self.newest.and_then(|newest| newest.t_s);
        if let Some((t_s, last_s)) = t_s.zip(own).filter(|(t_s, last_s)| t_s <= last_s) {
            let why = format!("t is {t_s} s after {last_s} s");
            return self.dropped(&Fault::new(Kind::Backwards, why), 1);
        }
        let t = t_s.map_or(at, |t_s| self.dating.dated(at, t_s));
        if let Some(newest) = self.newest.filter(|newest| t <= newest.t) {
            let why = format!(
                "it is {:.1} ms older than the one before it",
                newest.t.secs_since(t) * 1e3
            );
            return self.dropped(&Fault::new(Kind::Backwards, why), 1);
        }
        let first = self.heard.replace(at).is_none();
        if first {
            self.found(session.as_deref_mut());
        }
        let before = self.newest.and_then(|newest| newest.orientation);
        let orientation = place.orientation.map(|q| near(q, before));
        self.newest = Some(Newest {
            t,
            t_s,
            orientation: orientation.or(before),
        });
        self.tally.samples += 1;
        if let Some(session) = session.as_deref_mut() {
            let sample = HandSample {
                t,
                x: place.position,
                orientation,
                grip: place.grip,
                resting: false,
            };
            session.handle_sample(now, sample);
        }
        if std::mem::take(&mut self.habits.engage) {
            self.press(now, session);
        }
    }

    /// The source is there, for the first time or again.
    fn found(&mut self, session: Option<&mut Session>) {
        if self.tally.lost > 0 {
            self.note("the input is back: let go and engage again when it is safe");
        } else if self.newest.is_none() {
            self.note("the hand is seen");
        }
        if let Some(session) = session {
            session.forget_hand();
        }
    }

    /// A word typed at the terminal: engage or release.
    pub fn word(&mut self, now: Stamp, engage: bool, session: Option<&mut Session>) {
        if engage {
            self.press(now, session);
        } else {
            self.let_go(session);
        }
    }

    fn press(&mut self, now: Stamp, session: Option<&mut Session>) {
        if self.clutch.is_some() {
            return;
        }
        let why = match &session {
            _ if self.heard.is_none() => "no hand is seen",
            None if self.linked => "there is no link",
            Some(session) if session.state() == RobotState::Stopped => {
                "the emergency stop is latched, type reset when it is safe"
            }
            _ => "",
        };
        if !why.is_empty() {
            return self.note(format!("not engaged: {why}; then let go and engage again"));
        }
        let mut clutch = Clutch::pressed();
        // Whoever holds it before the first link is there means what will be there.
        match session.filter(|session| self.linked && session.info().is_some()) {
            Some(session) => clutch.ask(now, session),
            None => clutch.phase = Phase::Again(now),
        }
        self.clutch = Some(clutch);
    }

    fn let_go(&mut self, session: Option<&mut Session>) {
        if self.clutch.take().is_some()
            && let Some(session) = session
        {
            session.release();
        }
    }

    fn lose(&mut self, session: Option<&mut Session>) {
        self.heard = None;
        self.tally.lost += 1;
        let held = if self.clutch.is_some() {
            ": the clutch is let go"
        } else {
            ""
        };
        self.note(format!("the input is lost, no sample for {LOST_S} s{held}"));
        self.let_go(session);
    }

    fn dropped(&mut self, fault: &Fault, n: u64) {
        if self.tally.drop(fault.kind, n) {
            self.note(format!(
                "a frame of the input is dropped ({fault}); others like it will only be counted"
            ));
        }
    }

    /// The session reports.
    pub fn on_event(&mut self, now: Stamp, event: &Event) {
        match event {
            Event::Ready => self.linked = true,
            Event::Engaged { .. } => {
                if let Some(clutch) = &mut self.clutch {
                    clutch.phase = Phase::Following;
                }
            }
            Event::Refused(Refusal::Diverged) => {}
            Event::Refused(reason) => {
                let clutch = self.clutch.as_mut();
                if clutch.is_some_and(|clutch| !clutch.declined(now, *reason)) {
                    self.clutch = None;
                    self.note(format!(
                        "the robot declines: {reason:?}; let go and engage again"
                    ));
                }
            }
            // What began before this engagement is no news.
            Event::State(RobotState::Holding, cause) => {
                let following = |clutch: &Clutch| clutch.phase == Phase::Following;
                if self.clutch.as_ref().is_some_and(following) {
                    self.clutch = None;
                    self.note(format!(
                        "the arm stopped by itself ({cause:?}) and holds; let go and engage again when it is safe"
                    ));
                }
            }
            Event::State(RobotState::Stopped, _) => {
                self.clutch = None;
                self.note(
                    "the emergency stop is latched; type reset at either end when it is safe",
                );
            }
            Event::State(..)
            | Event::Recognised { .. }
            | Event::Correction(_)
            | Event::Bent(_)
            | Event::Telemetry(_) => {}
        }
    }

    /// The connection was lost: the arm holds, and nothing here engages it again.
    pub fn on_lost(&mut self) {
        if self.clutch.take().is_some() {
            self.note("the arm holds; let go and engage again when the link is back");
        }
    }

    /// Does what is due at `now`; whether the task is over.
    pub fn advise(&mut self, now: Stamp, session: &mut Session) -> bool {
        let overflow = self.inlet.overflow.swap(0, Ordering::Relaxed);
        if overflow > 0 {
            let why = "they come faster than they can be taken";
            self.dropped(&Fault::new(Kind::Flood, why), overflow);
        }
        self.linked |= session.info().is_some();
        if session.is_ready() {
            self.inlet.go = None;
        }
        if self
            .heard
            .is_some_and(|heard| now.secs_since(heard) >= LOST_S)
        {
            self.lose(Some(session));
        }
        if let Some(clutch) = &mut self.clutch
            && clutch.again().is_some_and(|at| now >= at)
        {
            clutch.ask(now, session);
        }
        // Whatever took the clutch out of the hand: what nobody holds is not driven.
        if self.clutch.is_none() && session.is_driving() {
            session.release();
        }
        self.is_over(now)
    }

    /// Whether nothing more can come, at `now`.
    pub fn is_over(&self, now: Stamp) -> bool {
        self.leave.is_some_and(|at| now >= at)
    }

    /// When [`Driver::advise`] has something to do next.
    pub fn poll_timeout(&self) -> Option<Stamp> {
        let lost = self.heard.map(|heard| heard.offset_by_secs(LOST_S));
        let again = self.clutch.as_ref().and_then(Clutch::again);
        [lost, again, self.leave].into_iter().flatten().min()
    }

    fn note(&mut self, text: impl Into<String>) {
        self.notes.push_back(text.into());
    }
}

/// Of q and −q, which are the same, the one nearer to the one before.
fn near(q: UnitQuaternion<f64>, before: Option<UnitQuaternion<f64>>) -> UnitQuaternion<f64> {
    match before {
        Some(before) if before.coords.dot(&q.coords) < 0.0 => {
            UnitQuaternion::new_unchecked(-q.into_inner())
        }
        _ => q,
    }
}
