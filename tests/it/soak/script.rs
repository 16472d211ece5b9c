//! What a seed makes happen: links, hands, and what befalls them.

use nalgebra::Vector3;
use rand::{Rng, RngExt};
use telemime_sim::link::{Chance, Distribution, LinkConfig, Loss, Probability, Rate};

use crate::scene::{Samples, performance};

/// What happens next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Mischief {
    /// Nothing, for a while.
    Peace,
    /// Other links, both ways.
    Links,
    /// No link for a while.
    Outage,
    /// An outage of a link that is otherwise clean, and what is promised after it.
    Promise,
    /// `stop` at the robot, `reset` later.
    StopHere,
    /// `stop` at the operator, `reset` later.
    StopThere,
    /// Ctrl-C at the operator.
    Quit,
    /// `kill -9` of the operator.
    KillOperator,
    /// A power cut at the robot.
    RestartRobot,
    /// The operator goes to another address.
    Rebind,
    /// Somebody sets a clock.
    ClockStep,
    /// Another operator with the same key.
    Second,
    /// An operator with a key nobody knows.
    Stranger,
    /// A client with the right key that talks nonsense.
    Rogue,
    /// Datagrams from nowhere, and forged ones.
    Garbage,
    /// All that was delivered lately, once more.
    Replay,
}

const WEIGHTS: [(Mischief, u32); 16] = [
    (Mischief::Peace, 30),
    (Mischief::Links, 10),
    (Mischief::Outage, 8),
    (Mischief::Promise, 12),
    (Mischief::StopHere, 3),
    (Mischief::StopThere, 4),
    (Mischief::Quit, 3),
    (Mischief::KillOperator, 4),
    (Mischief::RestartRobot, 3),
    (Mischief::Rebind, 4),
    (Mischief::ClockStep, 4),
    (Mischief::Second, 3),
    (Mischief::Stranger, 2),
    (Mischief::Rogue, 2),
    (Mischief::Garbage, 3),
    (Mischief::Replay, 3),
];

impl Mischief {
    pub(super) fn draw(rng: &mut impl Rng) -> Self {
        let total: u32 = WEIGHTS.iter().map(|(_, weight)| weight).sum();
        let mut left = rng.random_range(0..total);
        for (mischief, weight) in WEIGHTS {
            if left < weight {
                return mischief;
            }
            left -= weight;
        }
        Self::Peace
    }
}

/// Between the two on a logarithmic scale.
pub(super) fn spread(rng: &mut impl Rng, from: f64, to: f64) -> f64 {
    (from.ln() + rng.random::<f64>() * (to / from).ln()).exp()
}

/// One direction of a link; half of them are clean, the others anything netem knows.
pub(super) fn link(rng: &mut impl Rng) -> LinkConfig {
    let delay_s = spread(rng, 1e-3, 0.2);
    let jitter_s = delay_s * rng.random_range(0.0..0.5);
    if rng.random_bool(0.5) {
        return LinkConfig {
            delay_s,
            jitter_s: 0.1 * jitter_s,
            ..LinkConfig::default()
        };
    }
    let share = spread(rng, 1e-3, 0.3);
    let mut now_and_then = |often, most| {
        let p = spread(rng, 1e-4, most);
        Chance::of(if rng.random_bool(often) { p } else { 0.0 })
    };
    let (duplicate, corrupt) = (now_and_then(0.3, 0.1), now_and_then(0.3, 0.05));
    let reorder = now_and_then(0.3, 0.3);
    let end = rng.random_range(0.1..0.6);
    let bursts = Loss::Gemodel {
        p: Probability::of(share * end),
        r: Probability::of(end),
        lost_bad: Probability::ALWAYS,
        lost_good: Probability::NEVER,
    };
    let rate = rng
        .random_bool(0.3)
        .then(|| Rate::bits(spread(rng, 2e5, 1e7) as u64));
    let distributions = Distribution::ALL;
    LinkConfig {
        delay_s,
        jitter_s,
        distribution: distributions[rng.random_range(0..distributions.len())],
        loss: if rng.random_bool(0.5) {
            bursts
        } else {
            Loss::random(share)
        },
        duplicate,
        corrupt,
        reorder,
        gap: u32::from(reorder != Chance::NEVER),
        rate,
        ..LinkConfig::default()
    }
}

/// Whether what is promised is promised of such a link.
pub(super) fn is_clean(link: &LinkConfig) -> bool {
    let wire = LinkConfig {
        delay_s: link.delay_s,
        jitter_s: link.jitter_s,
        ..LinkConfig::default()
    };
    *link == wire
}

/// Whether a session is to be had over such a link whatever happened before.
pub(super) fn is_usable(link: &LinkConfig) -> bool {
    let share = link.loss.share();
    share.is_some_and(|share| share <= 0.05) && link.corrupt.p <= Probability::of(0.05)
}

/// A hand: swings as the skill knows them, waves it does not know, rests, and goes away for a while.
pub(super) fn hand(rng: &mut impl Rng) -> Samples {
    let mut samples = match rng.random_range(0..4) {
        0 | 1 => performance(rng.random_range(5..60)),
        2 => wave(rng),
        _ => (0..150)
            .map(|i| {
                let mut noise = || rng.random_range(-3e-3..3e-3);
                (f64::from(i) / 30.0, Vector3::new(noise(), noise(), 2.0))
            })
            .collect(),
    };
    let end_s = samples[samples.len() - 1].0;
    if rng.random_bool(0.3) {
        // Out of the tracker's sight.
        let from_s = rng.random_range(0.2..end_s);
        let to_s = from_s + spread(rng, 0.1, 3.0);
        samples.retain(|(t_s, _)| !(from_s..to_s).contains(t_s) || *t_s == end_s);
    }
    if rng.random_bool(0.1) {
        // Another person's hand, as far as the tracker can tell.
        let from = rng.random_range(1..samples.len());
        let aside = Vector3::new(rng.random_range(-1.0..1.0), 0.5, 0.0);
        samples[from..].iter_mut().for_each(|(_, x)| *x += aside);
    }
    samples
}

fn wave(rng: &mut impl Rng) -> Samples {
    let (reach_m, rate) = (spread(rng, 0.02, 0.4), spread(rng, 0.5, 8.0));
    let frames_a_s = if rng.random_bool(0.2) { 120.0 } else { 30.0 };
    let frames = (rng.random_range(2.0..12.0) * frames_a_s) as u32;
    let at = |i: u32| {
        let t_s = f64::from(i) / frames_a_s;
        let out = |rate: f64| reach_m * (rate * t_s).sin();
        (t_s, Vector3::new(out(rate), 0.3 * out(1.7 * rate), 2.0))
    };
    (0..frames).map(at).collect()
}
