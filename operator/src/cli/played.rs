//! What became of a played skill: where the tip was, by the robot's telemetry, against where it was sent.

use nalgebra::{UnitQuaternion, Vector3};
use telemime_protocol::checkpoint::PoseCurve;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::{RobotState, Telemetry};

use super::report::Event;
use super::scores::{Scores, TurnScores};
use crate::learn::align::Aligned;
use crate::session;

/// A skill being played, and the tip as heard of.
pub(super) struct Played {
    curve: PoseCurve,
    demonstrations: Option<Aligned>,
    rotation: UnitQuaternion<f64>,
    scale: f64,
    engaged: Option<Engaged>,
    /// Time since the engage (s) and the tip mapped back to the hand (m).
    tip: Vec<(f64, Vector3<f64>)>,
    /// The same for its orientation, where that is followed.
    turn: Vec<(f64, UnitQuaternion<f64>)>,
    /// What the robot was told to make of the plan, if a hand corrected it.
    bends: Vec<session::Bent>,
    /// Ticks on which a limit held the arm back.
    clamps: u32,
}

struct Engaged {
    number: u32,
    t_us: i64,
    hand_m: Vector3<f64>,
    tip_m: Vector3<f64>,
    hand_q: Option<UnitQuaternion<f64>>,
    tip_q: UnitQuaternion<f64>,
}

impl Played {
    pub(super) fn new(
        curve: PoseCurve,
        demonstrations: Option<Aligned>,
        rotation: UnitQuaternion<f64>,
    ) -> Self {
        Self {
            curve,
            demonstrations,
            rotation,
            scale: 1.0,
            engaged: None,
            tip: Vec::new(),
            turn: Vec::new(),
            bends: Vec::new(),
            clamps: 0,
        }
    }

    /// The scale the engagement will use.
    pub(super) fn mapped(&mut self, scale: f64) {
        self.scale = scale;
    }

    pub(super) fn hear(&mut self, event: &session::Event) {
        let metres = |x: &[f32; 3]| Vector3::from(*x).cast::<f64>();
        match event {
            session::Event::Engaged {
                engagement,
                t_us,
                hand_m,
                tip_m,
                hand_q,
                tip_q,
            } => {
                self.engaged = Some(Engaged {
                    number: *engagement,
                    t_us: *t_us,
                    hand_m: metres(hand_m),
                    tip_m: metres(tip_m),
                    hand_q: *hand_q,
                    tip_q: *tip_q,
                });
            }
            session::Event::Telemetry(telemetry) => self.take(telemetry),
            session::Event::Bent(bent) => self.bends.push(*bent),
            _ => {}
        }
    }

    fn take(&mut self, telemetry: &Telemetry) {
        let Some(engaged) = &self.engaged else { return };
        let following = matches!(telemetry.state, RobotState::Engaged | RobotState::Coasting);
        let t_s = (telemetry.t_us - engaged.t_us) as f64 * 1e-6;
        let newer = self.tip.last().is_none_or(|(last_s, _)| t_s > *last_s);
        if following && newer && t_s >= 0.0 && telemetry.engagement == engaged.number {
            let tip_m = Vector3::from(telemetry.tip_m).cast::<f64>();
            let moved = self.rotation.inverse() * (tip_m - engaged.tip_m) / self.scale;
            self.tip.push((t_s, engaged.hand_m + moved));
            self.clamps = telemetry.clamps;
            if let Some(hand_q) = engaged.hand_q {
                let turned = telemetry.tip_q.dequantise() * engaged.tip_q.inverse();
                let turned = self.rotation.inverse() * turned * self.rotation;
                self.turn.push((t_s, turned * hand_q));
            }
        }
    }

    /// The scores, if the robot was heard of while it played.
    pub(super) fn scores(&self) -> Option<Event> {
        let end_s = self.curve.end_s();
        let (sent, followed): (Vec<_>, Vec<_>) = self
            .tip
            .iter()
            .map(|(t_s, tip)| (self.meant_at(*t_s), *tip))
            .filter(|((plan_s, _), _)| *plan_s <= end_s)
            .map(|((_, meant), tip)| (meant, tip))
            .unzip();
        if sent.len() < 2 {
            return None;
        }
        let uncorrected = self
            .demonstrations
            .as_ref()
            .filter(|_| self.bends.is_empty());
        let demonstrations = uncorrected.map(|aligned| {
            Scores::of_demonstrations(aligned, |t_s| self.tip_at(t_s.clamp(0.0, end_s)))
        });
        Some(Event::Played {
            samples: sent.len(),
            clamps: self.clamps,
            rebuilt_to_tip: Scores::of(&sent, &followed),
            demonstrations_to_tip: demonstrations,
            turn_to_tip: (!self.turn.is_empty()).then(|| {
                TurnScores::of(self.turn.iter().filter_map(|(t_s, q)| {
                    let plan_s = self.meant_at(*t_s).0;
                    Some(self.curve.orientation_at(plan_s)?.angle_to(q))
                }))
            }),
        })
    }

    /// The plan's time (s) and where the hand belongs (m), `t_s` after the engage.
    fn meant_at(&self, t_s: f64) -> (f64, Vector3<f64>) {
        let engaged_us = self.engaged.as_ref().map_or(0, |engaged| engaged.t_us);
        let t = Stamp(engaged_us.saturating_mul(1000)).offset_by_secs(t_s);
        let bent = session::Bent::among(&self.bends, t);
        let (plan_s, offset) = bent.map_or((t_s, Vector3::zeros()), |b| (b.plan_s, b.offset_m));
        (plan_s, self.curve.position_at(plan_s) + offset)
    }

    /// Linear between what was heard.
    fn tip_at(&self, t_s: f64) -> Vector3<f64> {
        let after = self.tip.partition_point(|(t, _)| *t <= t_s);
        let before = self.tip[after.saturating_sub(1)];
        match self.tip.get(after) {
            Some(next) if next.0 > before.0 => {
                let u = ((t_s - before.0) / (next.0 - before.0)).clamp(0.0, 1.0);
                before.1.lerp(&next.1, u)
            }
            _ => before.1,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use telemime_protocol::checkpoint::select;

    #[test]
    fn a_tip_that_does_as_it_is_told_scores_one() {
        let t = [0.0, 0.5, 1.0];
        let x = [
            Vector3::new(0.1, 0.0, 2.0),
            Vector3::new(0.4, 0.3, 2.2),
            Vector3::new(0.2, 0.5, 2.1),
        ];
        let plan = select::bounded(&t, &x, 1e-6).unwrap();
        let curve = telemime_protocol::checkpoint::PosePlan::from(plan)
            .curve()
            .unwrap();
        let rotation = UnitQuaternion::from_euler_angles(0.1, 0.2, 0.3);
        let mut played = Played::new(curve.clone(), None, rotation);
        assert_eq!(played.scores(), None);
        played.mapped(0.25);
        played.hear(&session::Event::Engaged {
            engagement: 3,
            t_us: 1_000_000,
            hand_m: [0.1, 0.0, 2.0],
            tip_m: [0.5, 0.0, 0.4],
            hand_q: None,
            tip_q: UnitQuaternion::identity(),
        });
        for i in 0..=20 {
            let t_s = f64::from(i) * 0.05;
            let hand = curve.position_at(t_s) - x[0];
            let tip = Vector3::new(0.5, 0.0, 0.4) + rotation * hand * 0.25;
            let telemetry = Telemetry {
                epoch: 1,
                seq: i as u32,
                state: RobotState::Engaged,
                engagement: 3,
                t_us: 1_000_000 + i64::from(i) * 50_000,
                clamps: i as u32 * 7,
                tip_m: tip.cast::<f32>().into(),
                ..Telemetry::default()
            };
            played.hear(&session::Event::Telemetry(Box::new(telemetry)));
        }
        let event = played.scores().unwrap();
        let Event::Played {
            samples,
            clamps,
            rebuilt_to_tip,
            ..
        } = &event
        else {
            panic!("no scores")
        };
        assert_eq!((*samples, *clamps), (21, 140));
        // Limits that did not matter are no news.
        assert!(!event.text().unwrap().contains("140 ticks"));
        assert!(
            rebuilt_to_tip.r2 > 0.999_999 && rebuilt_to_tip.max_m < 1e-5,
            "{rebuilt_to_tip:?}"
        );
        let missed = Event::Played {
            samples: 21,
            clamps: 140,
            rebuilt_to_tip: Scores {
                r2: -2.0,
                ..*rebuilt_to_tip
            },
            demonstrations_to_tip: None,
            turn_to_tip: None,
        };
        let text = missed.text().unwrap();
        assert!(
            text.contains("limits held the arm back on 140 ticks"),
            "{text}"
        );
    }
}
