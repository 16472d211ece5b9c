//! What the operator is told: states, telemetry, receptions, the servo's times.

use telemime_endpoint::Mono;
use telemime_endpoint::reception::Quantiles;
use telemime_protocol::wire::turn::{WireRotation, quantise_grip};
use telemime_protocol::wire::v1::{self, Refusal, RobotControl, RobotState, ServoTimes, Telemetry};

use super::motion::Mirror;
use super::{Seen, Session};
use crate::servo::thread::Times;
use crate::servo::{self, Order, Report};

impl Session {
    /// The servo's report of a tick.
    pub fn handle_report(&mut self, report: &Report, timing: Times) {
        self.timing = timing;
        let changed = self.transitions != Some(report.transitions);
        self.transitions = Some(report.transitions);
        self.report = Some(*report);
        if std::mem::take(&mut self.owed) {
            self.order(Order::Operator(true));
        }
        let follows = matches!(report.state, RobotState::Engaged | RobotState::Coasting);
        if follows && self.mirror.is_some() {
            self.ages.add(report.age_s);
        }
        let pending = self.acknowledged != self.engagement;
        if pending && report.engagement == self.ticket() {
            self.acknowledged = self.engagement;
            let t_us = self
                .clock
                .to_session(report.engaged_at)
                .map_or(0, |t| t.0 / 1000);
            self.send(&RobotControl::Engaged {
                engagement: self.engagement,
                t_us,
                hand_m: report.mapping.hand_m.cast::<f32>().into(),
                tip_m: report.mapping.tip_m.cast::<f32>().into(),
                hand_q: report
                    .mapping
                    .hand_orientation
                    .map(|q| WireRotation::quantise(&q)),
                tip_q: WireRotation::quantise(&report.mapping.tip_orientation),
            });
        } else if pending && report.declined == self.ticket() {
            self.acknowledged = self.engagement;
            self.mirror = None;
            self.refuse(match report.state {
                RobotState::Stopped => Refusal::Stopped,
                _ => Refusal::Moving,
            });
        }
        if changed {
            self.send_state(report);
        }
    }

    /// What the operator is told of its motions.
    pub(super) fn told(&self) -> v1::Reception {
        let us = |s: f64| (s * 1e6).round().clamp(0.0, f64::from(u32::MAX)) as u32;
        let four = |times: Option<Quantiles>| {
            let t = times.unwrap_or_default();
            [t.mean_s, t.p50_s, t.p95_s, t.max_s].map(us)
        };
        let Seen { up, age, .. } = self.seen();
        v1::Reception {
            epoch: self.epoch,
            newest_seq: self.reception.newest(),
            received: up.received,
            duplicates: up.duplicates,
            reordered: up.reordered,
            loss_runs: up.loss_runs,
            longest_loss_run: up.longest_loss_run,
            jitter_us: us(up.jitter_s),
            delay_us: four(up.delay),
            age_us: four(age),
        }
    }

    pub(super) fn servo_times(&self) -> ServoTimes {
        let four = |q: servo::Quantiles| [q.p50_ns, q.p99_ns, q.p999_ns, q.max_ns];
        let Times {
            ticks,
            mean_ns,
            work,
            wake,
            overruns,
        } = self.timing;
        ServoTimes {
            epoch: self.epoch,
            ticks,
            overruns,
            mean_ns,
            work_ns: four(work),
            wake_ns: four(wake),
        }
    }

    pub(super) fn telemetry(&mut self, now: Mono) -> Option<Telemetry> {
        let report = self.report?;
        self.telemetry_seq += 1;
        let milliseconds = |s: f64| (s * 1e3).round().clamp(0.0, f64::from(u16::MAX)) as u16;
        let uncertainty_us = self
            .clock
            .uncertainty_s(now)
            .map_or(f64::from(u32::MAX), |s| s * 1e6);
        Some(Telemetry {
            epoch: self.epoch,
            seq: self.telemetry_seq,
            state: report.state,
            engagement: if report.engagement.epoch == self.epoch {
                report.engagement.number
            } else {
                0
            },
            t_us: self.clock.to_session(report.at).map_or(0, |t| t.0 / 1000),
            clock_uncertainty_us: uncertainty_us as u32,
            age_ms: milliseconds(report.age_s),
            // 0 is for what is not known: a delay that cannot be told from none is the least there is.
            delay_ms: self.delay_s.map_or(0, |s| milliseconds(s).max(1)),
            path_frontier: self.mirror.as_ref().map_or(0, Mirror::frontier),
            received: self.reception.received(),
            newest_seq: self.reception.newest(),
            dropped: self.dropped,
            clamps: report.clamps,
            tip_m: report.tip_m.cast::<f32>().into(),
            tip_q: WireRotation::quantise(&report.orientation),
            grip: report.opening.map(quantise_grip),
            q: report
                .q
                .iter()
                .take(usize::from(self.info.joints))
                .map(|&v| v as f32)
                .collect(),
        })
    }

    pub(super) fn send_state(&mut self, report: &Report) {
        self.send(&RobotControl::State {
            state: report.state,
            cause: report.cause,
            changes: report.transitions,
        });
    }
}
