//! What a session shows of itself: for display, and to be changed while it drives.

use std::collections::VecDeque;

use telemime_protocol::predict::Forecast;
use telemime_protocol::wire::arm::WireArm;

use super::gate::Gate;
use super::{Activity, HandSample, Session, ShownKnot};
use crate::recognise::Recogniser;

/// Samples kept for a listener that is slow: it looks many times a second.
const MAX_HEARD: usize = 4096;

impl Session {
    /// How the arm is built, if the robot has said so.
    pub fn arm(&self) -> Option<&WireArm> {
        self.arm.as_ref()
    }

    /// What the robot predicts of the hand from what it was told last, in the hand's axes, m; `None` unless mirroring.
    pub fn told(&self) -> Option<Forecast> {
        match &self.activity {
            Activity::Mirror(mirror) => mirror.told(),
            Activity::Nothing | Activity::Play { .. } => None,
        }
    }

    /// The newest path knots.
    pub fn recent_knots(&self) -> impl Iterator<Item = ShownKnot> {
        let mirror = match &self.activity {
            Activity::Mirror(mirror) => Some(mirror),
            Activity::Nothing | Activity::Play { .. } => None,
        };
        mirror.into_iter().flat_map(|mirror| mirror.recent_knots())
    }

    /// The session's epoch.
    pub fn epoch(&self) -> u32 {
        self.epoch
    }

    /// The samples handed over since the last call, as they came, each with the engagement that was asked to follow it; for
    /// a recording. The first call begins to listen.
    pub fn heard(&mut self) -> VecDeque<(Option<u32>, HandSample)> {
        self.heard.replace(VecDeque::new()).unwrap_or_default()
    }

    pub(super) fn listen(&mut self, sample: &HandSample) {
        let Some(heard) = &mut self.heard else {
            return;
        };
        if heard.len() == MAX_HEARD {
            heard.pop_front();
        }
        let followed = matches!(self.activity, Activity::Mirror(_));
        heard.push_back((followed.then_some(self.engagement), *sample));
    }

    /// Predicts with this gain κ from now on, clamped to [0, 1]; what is being driven too.
    pub fn set_gain(&mut self, gain: f64) {
        self.config.gain = gain.clamp(0.0, 1.0);
        if let Activity::Mirror(mirror) = &mut self.activity {
            mirror.set_gain(self.config.gain);
        }
    }

    /// The next sample begins anew: it is another hand, or one that was carried elsewhere. Not while it drives.
    pub fn forget_hand(&mut self) {
        if matches!(self.activity, Activity::Nothing) {
            self.hand = None;
            self.gate = Gate::default();
        }
    }

    /// As [`Session::watched_by`], from now on.
    pub fn watch_by(&mut self, recogniser: Option<Recogniser>) {
        self.recogniser = recogniser;
        self.recognised = None;
    }
}
