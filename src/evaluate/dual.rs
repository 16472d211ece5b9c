//! Dual prediction: how few messages keep the robot's prediction how good.

use std::sync::Arc;

use nalgebra::Vector3;
use telemime_operator::demonstration::Demonstration;
use telemime_operator::session::{FutureBound, SessionConfig};
use telemime_protocol::predict::{Forecast, HandState};
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;
use telemime_sim::link::{Link, LinkConfig};

use super::live::{Live, Said, on_session_clock};

/// What QUIC, UDP and IP add to a datagram, bytes (driving.md §4 of the design's notes).
const HEADERS: usize = 58;

/// Longer than any recording: no heartbeat.
const NEVER_S: f64 = 1e4;

/// When to speak, and what the robot makes of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Scheme {
    /// Every sample is sent, and held.
    Everything,
    /// A sample is sent when the robot's hand is off by more than this, m, and held.
    DeadbandHold(f64),
    /// The same, extrapolated at constant velocity: dead reckoning.
    DeadbandStraight(f64),
    /// The operator's session: its bound on the future and its largest silence, s, if there is one.
    Session(FutureBound, Option<f64>),
}

/// What came of a scheme on one performance, or several.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Outcome {
    pub(super) messages: usize,
    /// With headers; of sessions only.
    pub(super) bytes: usize,
    pub(super) duration_s: f64,
    error_2: f64,
    moments: usize,
}

impl Outcome {
    pub(super) fn add(&mut self, other: &Self) {
        self.messages += other.messages;
        self.bytes += other.bytes;
        self.duration_s += other.duration_s;
        self.error_2 += other.error_2;
        self.moments += other.moments;
    }

    /// RMSE at the same wall time, m.
    pub(super) fn rmse_m(&self) -> Option<f64> {
        Some((self.error_2 / self.moments as f64).sqrt()).filter(|r| r.is_finite())
    }
}

/// What the robot makes of a message.
#[derive(Clone, Copy)]
#[expect(
    clippy::large_enum_variant,
    reason = "one lives at a time, on the stack"
)]
enum Told {
    /// The hand was there, and may move on at this velocity (m/s).
    Straight(Stamp, Vector3<f64>, Vector3<f64>),
    /// As the session has it.
    Guarded(Forecast),
}

impl Told {
    /// When what was told was valid.
    fn t(&self) -> Stamp {
        match self {
            Self::Straight(t, ..) => *t,
            Self::Guarded(forecast) => forecast.t,
        }
    }

    /// The hand at `t`, m.
    fn at(&self, t: Stamp) -> Vector3<f64> {
        let ahead_s = t.secs_since(self.t());
        match self {
            Self::Straight(_, x, v) => x + v * ahead_s,
            Self::Guarded(forecast) => forecast.at(ahead_s).position,
        }
    }
}

/// What the robot knows from when on.
struct Arrival {
    at_s: f64,
    told: Told,
}

/// Something happens at the robot, or the operator hears of it.
enum News {
    Arrival(std::ops::Range<u32>),
    Telemetry(u32),
}

/// Runs one performance; the link's chances follow from `seed`.
pub(super) fn run(
    scheme: Scheme,
    d: &Demonstration,
    skill: &Arc<Skill>,
    session: &SessionConfig,
    link: &LinkConfig,
    seed: u64,
) -> Outcome {
    let mut wire = Link::new(link.clone(), seed);
    let mut outcome = Outcome {
        duration_s: d.duration_s(),
        ..Outcome::default()
    };
    let arrivals = match scheme {
        Scheme::Everything => by_rule(d, &mut wire, &mut outcome, 0.0, 0.0),
        Scheme::DeadbandHold(bound_m) => by_rule(d, &mut wire, &mut outcome, 0.0, bound_m),
        Scheme::DeadbandStraight(bound_m) => by_rule(d, &mut wire, &mut outcome, 1.0, bound_m),
        Scheme::Session(future_bound, silence_s) => {
            let config = SessionConfig {
                future_bound,
                max_silence_s: silence_s.unwrap_or(NEVER_S),
                ..*session
            };
            by_session(d, skill, &mut wire, &mut outcome, config)
        }
    };
    // Before the first message can have come there is nothing to be judged.
    let from_s = d.samples()[0].t_s + link.delay_s + link.jitter_s - 1e-6;
    let first = d.samples()[0].position;
    let start = Told::Straight(on_session_clock(0.0), first, Vector3::zeros());
    for now in d.samples().iter().filter(|s| s.t_s >= from_s) {
        let newest = arrivals
            .iter()
            .filter(|a| a.at_s <= now.t_s + 1e-6)
            .max_by_key(|a| a.told.t())
            .map_or(start, |a| a.told);
        let known = newest.at(on_session_clock(now.t_s));
        outcome.error_2 += (known - now.position).norm_squared();
        outcome.moments += 1;
    }
    outcome
}

/// Deadbands: the sender looks at the present; the robot goes on at `factor` of the velocity. A bound of 0
/// sends everything.
fn by_rule(
    d: &Demonstration,
    wire: &mut Link,
    outcome: &mut Outcome,
    factor: f64,
    bound_m: f64,
) -> Vec<Arrival> {
    let mut arrivals = Vec::new();
    let mut state: Option<HandState> = None;
    let mut sent: Option<Told> = None;
    for s in d.samples() {
        let t = on_session_clock(s.t_s);
        let hand = state.get_or_insert_with(|| HandState::first(t, s.position));
        hand.advance(t, s.position);
        let off = |told: &Told| (told.at(t) - s.position).norm() > bound_m;
        if bound_m > 0.0 && sent.as_ref().is_some_and(|told| !off(told)) {
            continue;
        }
        let told = Told::Straight(t, s.position, hand.motion().0 * factor);
        sent = Some(told);
        outcome.messages += 1;
        if let Some(at_ns) = wire.send(ns(s.t_s), HEADERS).arrival_ns() {
            let at_s = at_ns as f64 * 1e-9;
            arrivals.push(Arrival { at_s, told });
        }
    }
    arrivals
}

fn by_session(
    d: &Demonstration,
    skill: &Arc<Skill>,
    wire: &mut Link,
    outcome: &mut Outcome,
    config: SessionConfig,
) -> Vec<Arrival> {
    let delay_s = wire.config().delay_s;
    let mut live = Live::new(skill, config, delay_s);
    let mut arrivals = Vec::new();
    let mut news: Vec<(f64, News)> = Vec::new();
    let mut frontier = 0;
    for s in d.samples() {
        let mut said = Vec::new();
        // The robot answers every message; the way back loses nothing.
        while let Some(next) = next_before(&news, s.t_s) {
            let (at_s, what) = news.swap_remove(next);
            said.extend(live.wait(at_s));
            match what {
                News::Arrival(knots) => {
                    if knots.start <= frontier {
                        frontier = frontier.max(knots.end);
                    }
                    news.push((at_s + delay_s, News::Telemetry(frontier)));
                }
                News::Telemetry(frontier) => live.telemetry(at_s, frontier),
            }
            send(&mut said, wire, outcome, &mut arrivals, &mut news);
        }
        said.extend(live.wait(s.t_s));
        said.extend(live.take(s));
        send(&mut said, wire, outcome, &mut arrivals, &mut news);
    }
    arrivals
}

fn next_before(news: &[(f64, News)], t_s: f64) -> Option<usize> {
    let due = news.iter().enumerate().filter(|(_, (at, _))| *at < t_s);
    due.min_by(|a, b| a.1.0.total_cmp(&b.1.0)).map(|(n, _)| n)
}

fn send(
    said: &mut Vec<Said>,
    wire: &mut Link,
    outcome: &mut Outcome,
    arrivals: &mut Vec<Arrival>,
    news: &mut Vec<(f64, News)>,
) {
    for said in said.drain(..) {
        let bytes = HEADERS + said.bytes;
        outcome.messages += 1;
        outcome.bytes += bytes;
        if let Some(at_ns) = wire.send(ns(said.at_s), bytes).arrival_ns() {
            let at_s = at_ns as f64 * 1e-9;
            news.push((at_s, News::Arrival(said.knots)));
            arrivals.push(Arrival {
                at_s,
                told: Told::Guarded(said.place),
            });
        }
    }
}

fn ns(t_s: f64) -> i64 {
    (t_s * 1e9).round() as i64
}

#[cfg(test)]
mod tests {
    use telemime_operator::demonstration::Sample;
    use telemime_operator::learn::{LearnOptions, learn_skill};
    use telemime_sim::link::Loss;

    use super::*;

    fn straight_on() -> Demonstration {
        let at = |i: i32| f64::from(i) / 30.0;
        let samples: Vec<_> = (0..90)
            .map(|i| Sample::at(at(i), Vector3::new(2.0 * at(i), 0.0, 1.0)))
            .collect();
        Demonstration::from_samples("straight", &samples).unwrap()
    }

    fn skill() -> Arc<Skill> {
        let options = LearnOptions {
            motion_components: 2..=2,
            ..LearnOptions::default()
        };
        Arc::new(learn_skill("straight", &[straight_on()], &options, |_| ()).unwrap())
    }

    fn slow(loss: f64) -> LinkConfig {
        LinkConfig {
            delay_s: 0.1,
            loss: Loss::random(loss),
            ..LinkConfig::default()
        }
    }

    #[test]
    fn holding_over_a_link_errs_by_the_way_of_its_delay() {
        let (d, skill) = (straight_on(), skill());
        let held = run(
            Scheme::Everything,
            &d,
            &skill,
            &SessionConfig::default(),
            &slow(0.0),
            1,
        );
        assert_eq!(held.messages, 90);
        assert!((held.rmse_m().unwrap() - 0.2).abs() < 1e-6);
        // Half of the samples are late by one more interval, or by several.
        let lossy = run(
            Scheme::Everything,
            &d,
            &skill,
            &SessionConfig::default(),
            &slow(0.5),
            1,
        );
        assert!(lossy.rmse_m().unwrap() > 0.22);
        assert_eq!(lossy.messages, 90, "what is lost was sent");
    }

    #[test]
    fn a_deadband_sends_what_it_must_and_dead_reckoning_less() {
        let (d, skill) = (straight_on(), skill());
        let send = |scheme| run(scheme, &d, &skill, &SessionConfig::default(), &slow(0.0), 1);
        // 6.7 cm from sample to sample: every third is more than 15 cm on.
        assert_eq!(send(Scheme::DeadbandHold(0.15)).messages, 30);
        let reckoned = send(Scheme::DeadbandStraight(0.01));
        assert!(reckoned.messages < 15, "{}", reckoned.messages);
        assert!(reckoned.rmse_m() < send(Scheme::DeadbandHold(0.01)).rmse_m());
    }

    #[test]
    fn a_session_speaks_when_silence_grows_too_long_and_its_knots_are_acknowledged() {
        let (d, skill) = (straight_on(), skill());
        let session = |silence_s| {
            let never = FutureBound::Absolute(1e3);
            run(
                Scheme::Session(never, silence_s),
                &d,
                &skill,
                &SessionConfig::default(),
                &slow(0.0),
                1,
            )
        };
        // The first sample, and then a word every 0.2 s of 2.97 s.
        assert_eq!(session(Some(0.2)).messages, 15);
        assert_eq!(session(None).messages, 1);
        let everything = FutureBound::Absolute(1e-9);
        let all = run(
            Scheme::Session(everything, None),
            &d,
            &skill,
            &SessionConfig::default(),
            &slow(0.0),
            1,
        );
        assert!(all.bytes > all.messages * HEADERS);
        assert!(all.bytes < all.messages * (HEADERS + 90), "{} B", all.bytes);
    }
}
