//! A hand beside what is played: its samples in, what that changes out.

use telemime_protocol::time::Stamp;

use super::correct::{Change, Correction};
use super::{Activity, Event, HandSample, Session};

impl Session {
    pub(super) fn correct(&mut self, now: Stamp, sample: &HandSample) {
        let ahead = self.ahead(now);
        let Some(correction) = self.correction() else {
            return;
        };
        let (taken, change) = correction.take(now, ahead, sample);
        let changed = correction.has_changed(now, ahead);
        if !taken {
            self.counters.dropped += 1;
            return;
        }
        self.counters.samples += 1;
        if let Some(change) = change {
            self.tell_of(change, now);
        } else if changed {
            self.speak_soon(now);
        }
    }

    /// The hand that corrects what is played lets go of it: the skill goes on.
    pub fn let_go(&mut self, now: Stamp) {
        self.loose(now, Change::Released);
    }

    fn loose(&mut self, now: Stamp, change: Change) {
        let ahead = self.ahead(now);
        if self
            .correction()
            .is_some_and(|correction| correction.let_go(now, ahead))
        {
            self.tell_of(change, now);
        }
    }

    /// What a hand does to a plan cannot wait for the shortest interval.
    fn tell_of(&mut self, change: Change, now: Stamp) {
        self.events.push_back(Event::Correction(change));
        self.news = true;
        self.speak(now);
    }

    /// Looks whether time alone has changed what the robot should know.
    pub(super) fn look_after(&mut self, now: Stamp) {
        let ahead = self.ahead(now);
        let Some(correction) = self.correction() else {
            return;
        };
        if correction.is_lost(now) {
            return self.loose(now, Change::Lost);
        }
        correction.look(now, ahead);
        if correction.has_changed(now, ahead) {
            self.speak_soon(now);
        }
    }

    pub(super) fn correction(&mut self) -> Option<&mut Correction> {
        match &mut self.activity {
            Activity::Play { correction, .. } => correction.as_deref_mut(),
            _ => None,
        }
    }
}
