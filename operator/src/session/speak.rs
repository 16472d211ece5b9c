//! When something is said, and what.

use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::{Message, OperatorControl, OperatorDatagram, PathTail};

use super::pace::REPEAT_S;
use super::{Activity, Event, GO_S, Output, Session};

/// While an emergency stop is not confirmed, it is repeated at this interval, s.
const STOP_REPEAT_S: f64 = 0.01;

impl Session {
    /// Something is due.
    pub fn handle_timeout(&mut self, now: Stamp) {
        if self.next_stop.is_some_and(|due| now >= due) {
            self.next_stop = Some(now.offset_by_secs(STOP_REPEAT_S));
            self.datagram(&OperatorDatagram::Stop { epoch: self.epoch });
        }
        if self.next_word().is_some_and(|due| now >= due) {
            self.news = true;
            self.speak(now);
        } else if self.repeat.is_some_and(|due| now >= due) {
            self.speak(now);
        }
        if self.next_look().is_some_and(|due| now >= due) {
            self.look_after(now);
        }
    }

    /// When to call [`Session::handle_timeout`], and for what.
    pub fn poll_timeout(&self) -> Option<(Stamp, &'static str)> {
        let stop = self.next_stop.map(|due| (due, "repeat the emergency stop"));
        let word = self
            .next_word()
            .map(|due| (due, "confirm before the silence grows too long"));
        let look = self
            .next_look()
            .map(|due| (due, "see what the hand makes of the plan"));
        let repeat = self.repeat.map(|due| (due, "say again what may be lost"));
        [stop, word, look, repeat]
            .into_iter()
            .flatten()
            .min_by_key(|w| w.0)
    }

    pub(super) fn next_look(&self) -> Option<Stamp> {
        match &self.activity {
            Activity::Play { correction, .. } => correction.as_ref()?.due(),
            _ => None,
        }
    }

    pub(super) fn next_word(&self) -> Option<Stamp> {
        match self.activity {
            Activity::Nothing | Activity::Play { engaged: false, .. } => None,
            Activity::Mirror(_) => Some(self.last_sent.offset_by_secs(if self.urgent {
                self.interval_s
            } else {
                self.config.max_silence_s
            })),
            Activity::Play { engaged: true, .. } => Some(self.last_sent.offset_by_secs(
                self.config.max_silence_s.min(if self.urgent {
                    self.interval_s
                } else {
                    self.interval_s.max(GO_S)
                }),
            )),
        }
    }

    /// Sends the newest there is, whatever drives.
    pub(super) fn speak(&mut self, now: Stamp) {
        self.last_sent = now;
        self.urgent = false;
        self.interval_s = self.pace.interval_s(now);
        let again = std::mem::take(&mut self.news) && self.pace.repeats();
        self.repeat = again.then(|| now.offset_by_secs(REPEAT_S));
        self.seq += 1;
        let lease_ms = self.config.lease_ms();
        let network_s = self.network_delay_s();
        let ahead = self.ahead(now);
        let datagram = match &mut self.activity {
            Activity::Nothing => return,
            Activity::Play { correction, .. } => {
                let told = correction.as_mut().and_then(|c| c.tell(now, ahead));
                if let Some((_, bent)) = told {
                    self.events.push_back(Event::Bent(bent));
                }
                OperatorDatagram::Go {
                    epoch: self.epoch,
                    engagement: self.engagement,
                    seq: self.seq,
                    t_us: now.0 / 1000,
                    lease_ms,
                    bend: told.map(|(wire, _)| wire),
                }
            }
            Activity::Mirror(mirror) => {
                let skill = self.skill.as_deref().filter(|_| self.model_stored);
                let Some(mut motion) = mirror.motion(skill, (now, network_s), self.pace.copies())
                else {
                    return;
                };
                motion.epoch = self.epoch;
                motion.engagement = self.engagement;
                motion.seq = self.seq;
                motion.lease_ms = lease_ms;
                OperatorDatagram::Motion(motion)
            }
        };
        self.counters.messages += 1;
        self.say(&datagram, true);
    }

    /// Within the shortest interval the news waits, and what is then said is the newest.
    pub(super) fn speak_soon(&mut self, now: Stamp) {
        self.news = true;
        self.urgent = now.secs_since(self.last_sent) < self.interval_s;
        if !self.urgent {
            self.speak(now);
        }
    }

    pub(super) fn path(&mut self, tail: PathTail) {
        let engagement = self.engagement;
        self.control(&OperatorControl::Path(PathTail { engagement, ..tail }));
    }

    pub(super) fn control(&mut self, message: &OperatorControl) {
        let bytes = message.encode();
        self.tally.operator_control(Some(message), bytes.len());
        self.outputs.push_back(Output::Control(bytes));
    }

    pub(super) fn datagram(&mut self, message: &OperatorDatagram) {
        self.say(message, false);
    }

    pub(super) fn say(&mut self, message: &OperatorDatagram, motion: bool) {
        let bytes = self.version.encode_operator_datagram(message);
        self.tally.operator_datagram(Some(message), bytes.len());
        self.outputs.push_back(Output::Datagram { bytes, motion });
    }
}
