//! What the pages are shown.

use std::sync::Arc;

use nalgebra::Vector3;
use telemime_protocol::time::Stamp;

use super::Live;
use crate::clutch::Phase;
use crate::console::Holding;
use crate::console::snapshot::{Arm, HandShown, Robot, Sent, Snapshot};
use crate::demonstration::Demonstration;
use crate::session::Session;

/// The tube is shown so far ahead, in steps, s.
const AHEAD_STEPS: usize = 8;

const AHEAD_STEP_S: f64 = 0.05;

impl Live {
    pub(super) fn publish(&mut self, session: Option<&Session>, now: Stamp) {
        if let Some(arm) = session.and_then(Session::arm)
            && self.built.as_deref() != Some(arm)
        {
            self.built = Some(Arc::new(arm.clone()));
        }
        self.shown
            .send_replace(Arc::new(self.snapshot(session, now)));
    }

    pub(super) fn snapshot(&self, session: Option<&Session>, now: Stamp) -> Snapshot {
        let ms = |t: Stamp| t.0 as f64 * 1e-6;
        let shown = |hand: &Vector3<f64>| self.offset + self.scale * (self.rotation * hand);
        let point = |hand: &Vector3<f64>, w: f64| {
            let p = shown(hand);
            [p.x, p.y, p.z, w]
        };
        let following = self
            .hold
            .as_ref()
            .filter(|hold| hold.clutch.phase == Phase::Following);
        let told = following.and_then(|_| session?.told());
        let path = told.map_or_else(Vec::new, |told| {
            let from_s = now.secs_since(told.t);
            let ahead = (0..=AHEAD_STEPS).map(|i| told.at(from_s + i as f64 * AHEAD_STEP_S));
            ahead
                .map(|p| point(&p.position, self.scale * p.sigma_m))
                .collect()
        });
        let knots = following.and(session).map_or_else(Vec::new, |session| {
            let knots = session.recent_knots();
            knots
                .map(|knot| point(&knot.x, f64::from(u8::from(knot.held))))
                .collect()
        });
        Snapshot {
            t: ms(now),
            linked: self.linked.is_ok(),
            why: self.linked.clone().err().unwrap_or_default(),
            built: self.built.clone(),
            holder: self.hold.as_ref().map(|hold| hold.page),
            driving: self.hold.as_ref().map(|hold| match hold.what {
                Holding::Hand => "hand",
                Holding::Record => "record",
                Holding::Play => "play",
            }),
            robot: session
                .and_then(|session| Some((session.info()?, session)))
                .map(|(info, session)| Robot {
                    name: info.name.clone(),
                    state: format!("{:?}", self.state.0),
                    cause: format!("{:?}", self.state.1),
                    changes: session.changes(),
                    speed_m_s: info.speed_m_s,
                    radius_m: info.radius_m,
                    lag_ms: f64::from(info.lag_s) * 1e3,
                }),
            arm: self.telemetry.as_ref().map(|telemetry| Arm {
                t: telemetry.t_us as f64 * 1e-3,
                q: telemetry.q.clone(),
                tip: telemetry.tip_m,
                age_ms: telemetry.age_ms,
                delay_ms: telemetry.delay_ms,
                uncertainty_us: telemetry.clock_uncertainty_us,
                clamps: telemetry.clamps,
                lost: telemetry.newest_seq.saturating_sub(telemetry.received),
            }),
            hand: self
                .hold
                .as_ref()
                .and_then(|hold| hold.newest)
                .map(|(t, x)| HandShown {
                    t: ms(t),
                    p: shown(&x).into(),
                }),
            offset: self.offset.into(),
            path,
            knots,
            sent: Sent {
                bytes: self.sent_bytes,
                messages: session.map_or(0, |session| session.counters().messages),
            },
            seen: self.seen.clone(),
            gain: self.gain,
            strokes: self.strokes.iter().map(Demonstration::duration_s).collect(),
            learning: self.learning,
            skills: self
                .known
                .iter()
                .map(|known| known.skill.name().to_owned())
                .collect(),
            using: self.using.clone(),
            shape: self.shape,
            refused: self.refused,
            notes: self.notes.iter().cloned().collect(),
        }
    }
}
