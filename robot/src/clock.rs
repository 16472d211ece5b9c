//! The robot's estimate of the session clock, from four-timestamp exchanges (RFC 5905 §8).

use std::collections::VecDeque;

use telemime_endpoint::Mono;
use telemime_protocol::time::Stamp;

/// Exchanges remembered; at four a second, half a minute.
const WINDOW: usize = 128;

/// Exchanges before the estimate counts.
const ENOUGH: usize = 4;

/// How far two crystals may drift apart, s per s.
const DRIFT: f64 = 50e-6;

/// How fast the applied offset follows the estimate, s per s.
const SLEW: f64 = 5e-3;

/// What lies this far beyond the bounds of both estimate and applied offset is a step, not drift, s.
const STEP_S: f64 = 0.05;

#[derive(Debug, Clone, Copy)]
struct Exchange {
    at: Mono,
    rtt_s: f64,
    offset_ns: i64,
}

/// So many exchanges in a row that no jitter explains are a step of a clock.
const STEP_EXCHANGES: usize = ENOUGH;

/// What disciplined clocks at both ends say.
#[derive(Debug, Clone, Copy)]
struct Outside {
    at: Mono,
    offset_ns: i64,
    bound_s: f64,
}

/// Where the estimate comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// Round trips alone: an asymmetry of the path is in the bound.
    RoundTrips,
    /// Disciplined clocks at both ends, within what the round trips allow.
    Disciplined,
    /// Disciplined clocks at both ends that no round trip can explain: they are wrong by more than their users
    /// say, and not gone by.
    Contradicted,
}

impl Origin {
    /// One word, for machines.
    pub fn word(self) -> &'static str {
        match self {
            Self::RoundTrips => "round_trips",
            Self::Disciplined => "disciplined",
            Self::Contradicted => "contradicted",
        }
    }
}

/// What applying the estimate did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Slew {
    /// The applied offset follows within its rate.
    Smooth,
    /// The estimate lies so far off that following it smoothly would take seconds: a stop and a fresh reference.
    Step,
}

/// The offset in use.
#[derive(Debug, Clone, Copy)]
struct Applied {
    since: Mono,
    offset_ns: f64,
    /// How wrong it may be, s.
    bound_s: f64,
}

/// Offset of the session clock to the robot's own, with the bound of its error.
///
/// The exchange with the shortest round trip tells the offset best; an older one loses by what the
/// crystals may have drifted since. An asymmetry of the path cannot be seen from inside: the error is
/// bounded by half the round trip and no better.
#[derive(Debug, Default)]
pub struct SessionClock {
    exchanges: VecDeque<Exchange>,
    applied: Option<Applied>,
    /// The newest exchanges that disagree with what is applied by more than the bounds of both.
    strangers: usize,
    outside: Option<Outside>,
    /// A disciplined clock was set, and nothing has been done about it yet.
    was_set: bool,
}

impl SessionClock {
    /// Takes an exchange: ping sent `t1` (robot), received `t2` and answered `t3` (session), received `t4` (robot).
    ///
    /// Nonsense (a negative round trip) is ignored.
    pub fn observe(&mut self, t1: Mono, t2: Stamp, t3: Stamp, t4: Mono) {
        let rtt_ns = (t4.0.saturating_sub(t1.0)).saturating_sub(t3.0.saturating_sub(t2.0));
        if rtt_ns < 0 || t3 < t2 {
            return;
        }
        let offset_ns =
            (t2.0.saturating_sub(t1.0) / 2).saturating_add(t3.0.saturating_sub(t4.0) / 2);
        let exchange = Exchange {
            at: t4,
            rtt_s: rtt_ns as f64 * 1e-9,
            offset_ns,
        };
        self.strangers = if self.disagrees(&exchange) {
            self.strangers + 1
        } else {
            0
        };
        if self.strangers >= STEP_EXCHANGES {
            // A short round trip from before the step would outvote everything since for half a minute.
            let old = self.exchanges.len().saturating_sub(STEP_EXCHANGES - 1);
            self.exchanges.drain(..old);
            self.strangers = 0;
        }
        if self.exchanges.len() == WINDOW {
            self.exchanges.pop_front();
        }
        self.exchanges.push_back(exchange);
    }

    /// Takes what disciplined clocks at both ends say: the session clock less the robot's, and a bound of its error.
    ///
    /// Each of them is within its own bound of the truth, so that what they say together moves by no more than the
    /// bounds; more than that means that one was set.
    pub fn observe_outside(&mut self, at: Mono, offset_ns: i64, bound_s: f64) {
        if let Some(before) = self.outside {
            let moved_s = offset_ns.abs_diff(before.offset_ns) as f64 * 1e-9;
            self.was_set |= moved_s > before.bound_s + bound_s;
        }
        self.outside = Some(Outside {
            at,
            offset_ns,
            bound_s,
        });
    }

    /// Where the estimate comes from.
    pub fn origin(&self, now: Mono) -> Origin {
        match (self.best(now), self.outside(now)) {
            (Some(best), Some((offset_ns, bound_s))) => {
                let apart_s = (best.offset_ns as f64 - offset_ns).abs() * 1e-9;
                if apart_s <= badness_s(best, now) + bound_s {
                    Origin::Disciplined
                } else {
                    Origin::Contradicted
                }
            }
            _ => Origin::RoundTrips,
        }
    }

    /// Moves the applied offset towards the estimate; at once while `following` is false.
    pub fn slew(&mut self, now: Mono, following: bool) -> Slew {
        let Some((target_ns, best_s)) = self.estimate(now) else {
            return Slew::Smooth;
        };
        if std::mem::take(&mut self.was_set) && following {
            return Slew::Step;
        }
        match self.applied {
            Some(applied) if following => {
                let error_ns = target_ns - applied.offset_ns;
                let most_ns = SLEW * now.secs_since(applied.since).max(0.0) * 1e9;
                let moved_ns = error_ns.clamp(-most_ns, most_ns);
                self.applied = Some(Applied {
                    since: now,
                    offset_ns: applied.offset_ns + moved_ns,
                    bound_s: best_s + (error_ns - moved_ns).abs() * 1e-9,
                });
                // A better estimate may lie anywhere within the worse one's bound; only beyond is a step.
                if error_ns.abs() * 1e-9 > STEP_S + best_s + applied.bound_s {
                    Slew::Step
                } else {
                    Slew::Smooth
                }
            }
            _ => {
                self.applied = Some(Applied {
                    since: now,
                    offset_ns: target_ns,
                    bound_s: best_s,
                });
                Slew::Smooth
            }
        }
    }

    /// Whether enough is known to convert stamps.
    pub fn is_known(&self) -> bool {
        self.applied.is_some()
    }

    /// When `stamp` was, or will be, on the robot's clock.
    pub fn to_mono(&self, stamp: Stamp) -> Option<Mono> {
        self.applied
            .map(|a| Mono(stamp.0.saturating_sub(a.offset_ns.round() as i64)))
    }

    /// What the session clock shows at `mono`.
    pub fn to_session(&self, mono: Mono) -> Option<Stamp> {
        self.applied
            .map(|a| Stamp(mono.0.saturating_add(a.offset_ns.round() as i64)))
    }

    /// Bound of the applied offset's error, s: half the best round trip and the drift since, whatever the path's asymmetry,
    /// or the dispersions of both disciplined clocks; and how far what is applied has yet to follow.
    pub fn uncertainty_s(&self, now: Mono) -> Option<f64> {
        let (target_ns, bound_s) = self.estimate(now)?;
        let behind_ns = self.applied.map_or(0.0, |a| target_ns - a.offset_ns);
        Some(bound_s + behind_ns.abs() * 1e-9)
    }

    /// The shortest round trip seen lately, s.
    pub fn rtt_s(&self) -> Option<f64> {
        self.exchanges.iter().map(|e| e.rtt_s).reduce(f64::min)
    }

    /// Whether neither the exchange's round trip nor the bound of what is applied explains what it says.
    fn disagrees(&self, exchange: &Exchange) -> bool {
        self.applied.is_some_and(|applied| {
            let error_s = (exchange.offset_ns as f64 - applied.offset_ns).abs() * 1e-9;
            error_s > STEP_S + exchange.rtt_s / 2.0 + applied.bound_s
        })
    }

    /// Offset, ns, and the bound of its error, s.
    fn estimate(&self, now: Mono) -> Option<(f64, f64)> {
        let best = self.best(now)?;
        let outside = self.outside(now);
        let outside = outside.filter(|_| self.origin(now) == Origin::Disciplined);
        Some(outside.unwrap_or_else(|| (best.offset_ns as f64, badness_s(best, now))))
    }

    fn outside(&self, now: Mono) -> Option<(f64, f64)> {
        self.outside.map(|o| {
            let drift_s = DRIFT * now.secs_since(o.at).max(0.0);
            (o.offset_ns as f64, o.bound_s + drift_s)
        })
    }

    fn best(&self, now: Mono) -> Option<&Exchange> {
        if self.exchanges.len() < ENOUGH {
            return None;
        }
        self.exchanges
            .iter()
            .min_by(|a, b| badness_s(a, now).total_cmp(&badness_s(b, now)))
    }
}

fn badness_s(exchange: &Exchange, now: Mono) -> f64 {
    exchange.rtt_s / 2.0 + DRIFT * now.secs_since(exchange.at).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_xoshiro::Xoshiro256PlusPlus;

    const MS: i64 = 1_000_000;

    fn exchange(clock: &mut SessionClock, at: i64, offset: i64, up: i64, down: i64) {
        let (t1, t2) = (at, at + up + offset);
        clock.observe(
            Mono(t1),
            Stamp(t2),
            Stamp(t2 + MS),
            Mono(at + up + MS + down),
        );
    }

    #[test]
    fn jitter_is_filtered_by_the_shortest_round_trip_and_the_error_stays_within_the_bound() {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(5);
        let offset = -7_000 * MS;
        let mut clock = SessionClock::default();
        for i in 0..40 {
            let mut delay = || rng.random_range(90 * MS..110 * MS);
            exchange(&mut clock, i * 250 * MS, offset, delay(), delay());
        }
        let now = Mono(40 * 250 * MS);
        assert_eq!(clock.slew(now, false), Slew::Smooth);
        let error_s = clock.to_session(now).unwrap().0 - (now.0 + offset);
        assert!(error_s.abs() < 6 * MS, "{error_s} ns");
        let bound_s = clock.uncertainty_s(now).unwrap();
        assert!(
            (error_s as f64 * 1e-9).abs() < bound_s && bound_s < 0.101,
            "{bound_s}"
        );
    }

    #[test]
    fn an_asymmetry_is_invisible_and_within_the_bound() {
        let mut clock = SessionClock::default();
        for i in 0..8 {
            exchange(&mut clock, i * 250 * MS, 0, 140 * MS, 60 * MS);
        }
        let now = Mono(8 * 250 * MS);
        clock.slew(now, false);
        let error_s = (clock.to_session(now).unwrap().0 - now.0) as f64 * 1e-9;
        assert!(
            (error_s - 0.04).abs() < 1e-6,
            "half the asymmetry: {error_s}"
        );
        assert!(error_s < clock.uncertainty_s(now).unwrap());
    }

    #[test]
    fn the_applied_offset_follows_slowly_and_reports_a_step() {
        let mut clock = SessionClock::default();
        for i in 0..4 {
            exchange(&mut clock, i * 10 * MS, 0, 2 * MS, 2 * MS);
        }
        assert!(!clock.is_known());
        clock.slew(Mono(50 * MS), true);
        assert!(clock.is_known());
        exchange(&mut clock, 60 * MS, 10 * MS, MS, MS);
        assert_eq!(clock.slew(Mono(1050 * MS), true), Slew::Smooth);
        let moved = clock.to_session(Mono(0)).unwrap().0;
        assert_eq!(moved, 5 * MS, "5 ms in a second, no more");
        let bound_s = clock.uncertainty_s(Mono(1050 * MS)).unwrap();
        assert!(bound_s > 5e-3, "5 ms are yet to follow: {bound_s} s");
        exchange(&mut clock, 70 * MS, 500 * MS, 0, 0);
        assert_eq!(clock.slew(Mono(1051 * MS), true), Slew::Step);
        clock.observe(Mono(100), Stamp(0), Stamp(500), Mono(200));
        assert_eq!(
            clock.exchanges.len(),
            6,
            "a negative round trip is no exchange"
        );
    }

    #[test]
    fn a_step_is_noticed_within_a_second_whatever_the_jitter() {
        for seed in 0..20 {
            let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
            let mut delay = || rng.random_range(90 * MS..110 * MS);
            let mut clock = SessionClock::default();
            for i in 0..100 {
                exchange(&mut clock, i * 250 * MS, 0, delay(), delay());
                assert_eq!(clock.slew(Mono((i * 250 + 240) * MS), true), Slew::Smooth);
            }
            let stepped = (100..).find(|&i| {
                exchange(&mut clock, i * 250 * MS, 400 * MS, delay(), delay());
                clock.slew(Mono((i * 250 + 240) * MS), true) == Slew::Step
            });
            assert!(
                stepped.is_some_and(|i| i <= 104),
                "seed {seed}: {stepped:?}"
            );
        }
    }

    /// A path 80 ms slower one way, and clocks at both ends that know.
    fn disciplined() -> (SessionClock, Mono) {
        let mut clock = SessionClock::default();
        for i in 0..8 {
            exchange(&mut clock, i * 250 * MS, 0, 140 * MS, 60 * MS);
            clock.observe_outside(Mono(i * 250 * MS + 201 * MS), 20_000, 100e-6);
        }
        (clock, Mono(8 * 250 * MS))
    }

    #[test]
    fn disciplined_clocks_see_the_asymmetry_that_round_trips_cannot() {
        let (mut clock, now) = disciplined();
        clock.slew(now, false);
        assert_eq!(clock.origin(now), Origin::Disciplined);
        assert_eq!(clock.to_session(now).unwrap().0 - now.0, 20_000);
        let bound_s = clock.uncertainty_s(now).unwrap();
        assert!((100e-6..150e-6).contains(&bound_s), "{bound_s}");
    }

    #[test]
    fn disciplined_clocks_that_no_round_trip_explains_are_not_gone_by() {
        let (mut clock, now) = disciplined();
        clock.slew(now, false);
        // Somebody sets one of them by half a second: the exchanges go on as before.
        clock.observe_outside(now, 500 * MS, 100e-6);
        assert_eq!(clock.origin(now), Origin::Contradicted);
        assert!(clock.uncertainty_s(now).unwrap() > 0.1);
        assert_eq!(
            clock.slew(now, true),
            Slew::Step,
            "it is noticed as what it is"
        );
        assert_eq!(clock.slew(now, true), Slew::Smooth, "once");
    }

    #[test]
    fn a_small_step_of_a_disciplined_clock_stops_what_follows_too() {
        let (mut clock, now) = disciplined();
        clock.slew(now, false);
        // 5 ms are within what round trips allow, and far beyond the dispersions.
        clock.observe_outside(now, 5 * MS, 100e-6);
        assert_eq!(clock.origin(now), Origin::Disciplined);
        assert_eq!(clock.slew(now, true), Slew::Step);
        // What moves within the dispersions is followed, no faster than 5 ms/s.
        let (mut clock, now) = disciplined();
        clock.slew(now, false);
        clock.observe_outside(now, 180_000, 100e-6);
        assert_eq!(clock.slew(now.offset_by_secs(0.01), true), Slew::Smooth);
        assert_eq!(clock.to_session(now).unwrap().0 - now.0, 70_000);
        // At rest it is simply applied.
        clock.observe_outside(now, 9 * MS, 100e-6);
        assert_eq!(clock.slew(now.offset_by_secs(0.02), false), Slew::Smooth);
        assert_eq!(clock.to_session(now).unwrap().0 - now.0, 9 * MS);
    }

    #[test]
    fn a_better_estimate_after_a_queue_is_no_step() {
        let mut clock = SessionClock::default();
        for i in 0..4 {
            exchange(&mut clock, i * 20 * MS, 0, 1500 * MS, 100 * MS);
        }
        clock.slew(Mono(2000 * MS), false);
        for i in 8..20 {
            exchange(&mut clock, i * 250 * MS, 0, 100 * MS, 100 * MS);
            assert_eq!(clock.slew(Mono((i * 250 + 240) * MS), true), Slew::Smooth);
        }
    }
}
