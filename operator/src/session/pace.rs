//! How often to speak, and how much of it twice: what the link lets through decides.

use telemime_endpoint::Pacer;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::{Reception, Telemetry};

use super::FutureBound;

/// Loss is remembered over about so many messages.
const MEMORY: f64 = 40.0;

/// Before anything is known: two copies of a knot. It counts as this many messages.
const EXPECTED_LOSS: f64 = 0.01;
const EXPECTED: f64 = 10.0;

/// So rarely may a knot be missing after all its copies: what is, waits for a round trip.
const MISSING: f64 = 0.005;

/// Never more copies of a knot.
const MOST_COPIES: u8 = 4;

/// From this loss on what is new is said again, until it has fallen to the lower one.
const REPEAT_FROM: f64 = 0.08;
const REPEAT_UNTIL: f64 = 0.05;

/// Losses are bursts when so many follow one another on average; of a link that loses this much at least.
const BURST: f64 = 1.5;
const BURST_LOSS: f64 = 0.01;

/// So much later, s: a burst that takes both is longer than that.
pub(super) const REPEAT_S: f64 = 0.015;

/// More loss than this is taken for a link that is too thin, whatever it is: to say the same more often would not be fair
/// to those who share it.
const CHOKED: f64 = 0.5;

/// Without news of the robot for this long nobody knows what the link lets through, s; once it has reported so often.
const DEAF_S: f64 = 0.7;
const REPORTS: u32 = 10;

/// The future's bound on a link that is starved, as a multiple.
const WIDEST: f64 = 3.0;

/// What is known of the way to the robot.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pace {
    pacer: Pacer,
    most_s: f64,
    newest_seq: u32,
    received: u32,
    loss: f64,
    lost: u32,
    loss_runs: u32,
    burst: f64,
    repeats: bool,
    reports: u32,
    /// Numbers of the robot's first report and of its newest.
    back: Option<(u32, u32)>,
    heard: Stamp,
}

impl Pace {
    /// Two messages are from `least_s` to `most_s` apart.
    pub(super) fn new(least_s: f64, most_s: f64) -> Self {
        Self {
            pacer: Pacer::new(least_s, most_s),
            most_s,
            newest_seq: 0,
            received: 0,
            loss: EXPECTED_LOSS,
            lost: 0,
            loss_runs: 0,
            burst: 1.0,
            repeats: false,
            reports: 0,
            back: None,
            heard: Stamp::ZERO,
        }
    }

    /// The robot's news.
    pub(super) fn on_telemetry(&mut self, now: Stamp, telemetry: &Telemetry) {
        (self.heard, self.reports) = (now, self.reports.saturating_add(1));
        let (first, newest) = self.back.unwrap_or((telemetry.seq, telemetry.seq));
        self.back = Some((first, newest.max(telemetry.seq)));
        let said = telemetry.newest_seq.saturating_sub(self.newest_seq);
        if said == 0 {
            if self.newest_seq == 0 {
                self.expect_as_back();
            }
            return;
        }
        let arrived = f64::from(telemetry.received) - f64::from(self.received);
        (self.newest_seq, self.received) = (telemetry.newest_seq, telemetry.received);
        let said = f64::from(said);
        // A late one makes up for what was taken for lost.
        let loss = self.loss + (said - arrived - said * self.loss) / (MEMORY + said);
        self.loss = loss.clamp(0.0, 1.0);
        self.decide();
        let delay_s = f64::from(telemetry.delay_ms) * 1e-3;
        let choked = self.loss > CHOKED;
        // 0 says that the robot does not know yet; as the least delay it would make a queue of every link's length.
        if telemetry.delay_ms > 0 {
            self.pacer.observe(now.as_secs_f64(), delay_s, choked);
        }
    }

    /// Nothing has arrived there yet, but the robot's reports have here: on most links one way loses as the other does, and
    /// three messages in a row must not be lost before that is known.
    fn expect_as_back(&mut self) {
        let (first, newest) = self.back.unwrap_or_default();
        let said = f64::from(newest - first) + 1.0;
        let lost = (said - f64::from(self.reports)).max(0.0);
        self.loss = (lost + EXPECTED * EXPECTED_LOSS) / (said + EXPECTED);
        self.decide();
    }

    fn decide(&mut self) {
        self.repeats = self.loss > REPEAT_FROM
            || self.is_bursty()
            || (self.repeats && self.loss > REPEAT_UNTIL);
    }

    /// What has become of everything said so far.
    pub(super) fn on_reception(&mut self, reception: &Reception) {
        let lost = reception.newest_seq.saturating_sub(reception.received);
        let (before, runs) = (self.lost, self.loss_runs);
        (self.lost, self.loss_runs) = (lost, reception.loss_runs);
        let lost = lost.saturating_sub(before);
        let runs = self.loss_runs.saturating_sub(runs);
        if runs > 0 {
            let burst = f64::from(lost) / f64::from(runs);
            self.burst += 0.3 * (burst.max(1.0) - self.burst);
        }
    }

    fn is_bursty(&self) -> bool {
        self.burst > BURST && self.loss > BURST_LOSS
    }

    /// How far apart messages have to be, s.
    pub(super) fn interval_s(&self, now: Stamp) -> f64 {
        if self.reports >= REPORTS && now.secs_since(self.heard) > DEAF_S {
            self.most_s
        } else {
            self.pacer.interval_s()
        }
    }

    /// `bound`, wider the more the link is starved.
    pub(super) fn widen(&self, bound: FutureBound) -> FutureBound {
        let factor = 1.0 + (WIDEST - 1.0) * self.pacer.starved();
        match bound {
            FutureBound::Absolute(bound_m) => FutureBound::Absolute(factor * bound_m),
            FutureBound::Relative(sigmas) => FutureBound::Relative(factor * sigmas),
            FutureBound::Share(share) => FutureBound::Share(factor * share),
        }
    }

    /// In how many messages a knot travels before it waits for its acknowledgement.
    pub(super) fn copies(&self) -> u8 {
        if self.pacer.starved() > 0.1 {
            return 1;
        }
        let (mut copies, mut missing) = (1, self.loss);
        while missing > MISSING && copies < MOST_COPIES {
            missing *= self.loss;
            copies += 1;
        }
        // A burst takes the copies that follow one another.
        let in_a_row = if self.is_bursty() {
            (self.burst - 1.0).round() as u8
        } else {
            0
        };
        copies.saturating_add(in_a_row).min(MOST_COPIES)
    }

    /// Whether what is new is said a second time, [`REPEAT_S`] later.
    pub(super) fn repeats(&self) -> bool {
        self.repeats && self.pacer.starved() == 0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use telemime_protocol::wire::v1::RobotState;

    fn heard(newest_seq: u32, received: u32, delay_ms: u16) -> Telemetry {
        Telemetry {
            epoch: 1,
            seq: newest_seq,
            state: RobotState::Engaged,
            engagement: 1,
            delay_ms,
            received,
            newest_seq,
            ..Telemetry::default()
        }
    }

    /// Ten messages a second for 30 s, of which those that `lost` names do not arrive, in `runs` runs; each takes 50 ms.
    fn after(lost: impl Fn(u32) -> bool) -> Pace {
        let mut pace = Pace::new(0.01, 0.2);
        let (mut received, mut runs, mut open) = (0, 0, false);
        let mut newest_seq = 0;
        for seq in 1..=300 {
            runs += u32::from(lost(seq) && !open);
            open = lost(seq);
            if !open {
                (newest_seq, received) = (seq, received + 1);
            }
            let now = Stamp::from_secs_f64(0.1 * f64::from(seq));
            pace.on_telemetry(now, &heard(newest_seq, received, 50));
            if seq % 10 == 0 {
                pace.on_reception(&Reception {
                    newest_seq,
                    received,
                    loss_runs: runs,
                    ..Reception::default()
                });
            }
        }
        pace
    }

    #[test]
    fn copies_and_repetition_follow_the_loss() {
        let mixed = |seq: u32| seq.wrapping_mul(0x9e37_79b9) >> 16 & 0xffff;
        let random = |loss: f64| after(move |seq| f64::from(mixed(seq)) < 65536.0 * loss);
        let seen = [0.0, 0.02, 0.1, 0.25].map(|loss| {
            let pace = random(loss);
            (pace.copies(), pace.repeats())
        });
        assert_eq!(seen, [(1, false), (2, false), (3, true), (4, true)]);
        // 4 %, but three in a row.
        let bursts = after(|seq| seq % 75 < 3);
        assert!(bursts.copies() > 2 && bursts.repeats(), "{bursts:?}");
        let start = Pace::new(0.01, 0.2);
        assert_eq!((start.copies(), start.repeats()), (2, false));
    }

    #[test]
    fn a_long_link_is_no_queue() {
        let mut pace = Pace::new(0.01, 0.2);
        for i in 1..40 {
            let delay_ms = if i < 3 { 0 } else { 250 };
            pace.on_telemetry(
                Stamp::from_secs_f64(0.05 * f64::from(i)),
                &heard(i, i, delay_ms),
            );
        }
        assert_eq!(pace.pacer.interval_s(), 0.01);
    }

    #[test]
    fn before_anything_was_said_the_way_back_is_what_is_known() {
        let after = |lost: fn(u32) -> bool| {
            let mut pace = Pace::new(0.01, 0.2);
            for seq in (1..=40).filter(|seq| !lost(*seq)) {
                let telemetry = Telemetry {
                    seq,
                    ..heard(0, 0, 50)
                };
                pace.on_telemetry(Stamp::from_secs_f64(0.05 * f64::from(seq)), &telemetry);
            }
            (pace.copies(), pace.repeats())
        };
        assert_eq!(after(|_| false), (1, false));
        assert_eq!(after(|seq| seq % 5 == 2), (3, true));
    }

    #[test]
    fn a_queue_slows_it_down_widens_the_bound_and_ends_all_repetition() {
        let mut pace = after(|seq| seq % 8 == 0);
        assert!(pace.repeats() && pace.copies() > 2);
        let at = |i: u32| Stamp::from_secs_f64(30.0 + 0.1 * f64::from(i));
        for i in 1..50 {
            pace.on_telemetry(at(i), &heard(300 + i, 260 + i, 500));
        }
        assert_eq!(pace.interval_s(at(50)), 0.2);
        assert_eq!((pace.copies(), pace.repeats()), (1, false));
        assert_eq!(
            pace.widen(FutureBound::Relative(1.0)),
            FutureBound::Relative(WIDEST)
        );
        for i in 50..150 {
            pace.on_telemetry(at(i), &heard(300 + i, 260 + i, 55));
        }
        assert_eq!(pace.interval_s(at(150)), 0.01);
        assert_eq!(
            pace.widen(FutureBound::Absolute(0.1)),
            FutureBound::Absolute(0.1)
        );
        assert_eq!(pace.interval_s(at(160)), 0.2, "without news it is careful");
    }

    #[test]
    fn a_queue_on_the_shortest_of_links_is_forgotten() {
        let mut pace = Pace::new(0.01, 0.2);
        let at = |i: u32| Stamp::from_secs_f64(0.1 * f64::from(i));
        // 1 is the least that a robot says that knows it.
        for i in 1..220 {
            let delay_ms = if (20..70).contains(&i) { 500 } else { 1 };
            pace.on_telemetry(at(i), &heard(i, i, delay_ms));
            if i == 69 {
                assert_eq!(pace.interval_s(at(i)), 0.2);
            }
        }
        assert_eq!(pace.interval_s(at(219)), 0.01);
    }
}
