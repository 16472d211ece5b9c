//! A synthetic operator: a person who waves an arm in front of a depth sensor, or reaches for something, never twice alike; a hand that pushes aside what is played, and what a depth camera sees of it.
//!
//! Written to be as fast and as varied as public Kinect recordings of waving (95 % of speeds below 4 to 5 m/s on average, half-swings of about 0.3 s that
//! differ in width, time and course), so that what is learned and predicted from it behaves as on those.

mod depth;
mod push;
mod reach;
mod tap;
mod tracker;

use core::f64::consts::PI;

use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;

pub use depth::Scene;
pub use push::push;
pub use reach::{carry, reach};
pub use tap::taps;
pub use tracker::glitched;

/// Sensor frame period, s.
const FRAME_S: f64 = 1.0 / 30.0;

/// Sensor noise of a hand at rest, m, and its growth with the way of half a frame.
const NOISE_M: f64 = 2.5e-3;
const BLUR: f64 = 0.1;

/// Standard deviations of one half-swing about the performance: width and time (shares, half of each carried over to the next), and
/// skew. Chosen, with the noise, so that the reference predictor trained on five performances has 0.3 to 0.5 of the error of holding the last sample
/// 100 ms ahead on a sixth, as on recordings (docs of [`swing`]).
const WIDTH_SD: f64 = 0.15;
const TIME_SD: f64 = 0.12;
const SKEW_SD: f64 = 0.28;

/// Seed streams: the person, and each performance, draw from their own.
const PERFORMANCE_STREAM: u64 = 0x9e37_79b9_7f4a_7c15;
const WRIST_STREAM: u64 = 0x5851_f42d_4c95_7f2d;

/// Error of a tracked orientation about each axis, rad.
const TRACKER_RAD: f64 = 5e-3;

/// One performance of an arm swing: (time s, position m), about 30 Hz, 6 to 10 s long, starting at 0 s and at rest.
///
/// Axes are a Kinect's: x to the side, y up, z away from the sensor. The same `seed` is the same person; `index` counts that person's performances, which
/// differ in tempo, width, place and every single swing, and drift slowly with the index. Times are those at which the positions hold: a frame's jitter (±1 ms)
/// is in both. Positions carry 2.5 mm of sensor noise, more while the hand is fast. The same arguments give the same bytes
/// on one platform: sine and cosine are the standard library's, whose last bits may differ on another.
///
/// Over the persons 0 to 99, the memory-feature prototype trained on the performances 0 to 4 has, on performance 5 and 100 ms ahead,
/// 0.37 (0.29 to 0.47) of the error of holding the last sample.
///
/// ```
/// let swing = telemime_sim::hand::swing(7, 0);
/// assert!(swing.last().is_some_and(|&(t_s, _)| (6.0..10.0).contains(&t_s)));
/// ```
pub fn swing(seed: u64, index: u32) -> Vec<(f64, [f64; 3])> {
    let (frames, _) = frames(seed, index);
    frames
}

/// [`swing`] with the wrist: the same times and positions, and the orientation (w, x, y, z) of the hand in the sensor's axes.
///
/// The hand rolls and turns a little as the forearm leans to the side, and pitches as it is raised: as one holds a tool that an arm
/// can turn as fast, for rotation is not scaled. The tracker errs by 0.3° about each axis.
///
/// ```
/// let poses = telemime_sim::hand::swing_with_wrist(7, 0);
/// let positions: Vec<_> = poses.iter().map(|p| (p.t_s, p.x)).collect();
/// assert_eq!(positions, telemime_sim::hand::swing(7, 0));
/// ```
pub fn swing_with_wrist(seed: u64, index: u32) -> Vec<Pose> {
    let (frames, leans) = frames(seed, index);
    let mut rng = stream(seed ^ WRIST_STREAM, u64::from(index) + 1);
    frames
        .into_iter()
        .zip(leans)
        .map(|((t_s, x), [side, up])| {
            let mut err = || TRACKER_RAD * normal(&mut rng);
            let roll = about([0.0, 0.0, 1.0], -0.2 * side + err());
            let pitch = about([1.0, 0.0, 0.0], 0.3 * (1.0 - up) + err());
            let turn = about([0.0, 1.0, 0.0], 0.1 * side + err());
            Pose {
                t_s,
                x,
                q: product(product(roll, pitch), turn),
            }
        })
        .collect()
}

/// A hand at one moment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// When, s.
    pub t_s: f64,
    /// Where, m.
    pub x: [f64; 3],
    /// How it is turned: w, x, y, z, from its own axes to the sensor's.
    pub q: [f64; 4],
}

fn about(axis: [f64; 3], angle: f64) -> [f64; 4] {
    let (sine, cosine) = (0.5 * angle).sin_cos();
    [cosine, axis[0] * sine, axis[1] * sine, axis[2] * sine]
}

fn product(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

/// A time, s, and a place, m.
pub type Frame = (f64, [f64; 3]);

/// A performance as the sensor sees it, and in every frame the true way from elbow to hand, aside and up, in forearms.
fn frames(seed: u64, index: u32) -> (Vec<Frame>, Vec<[f64; 2]>) {
    let person = Person::new(seed);
    let mut rng = stream(seed, u64::from(index) + 1);
    let path = Performance::new(&person, index, &mut rng);
    let elbow: [f64; 2] = core::array::from_fn(|i| person.pivot[i] + path.offset[i]);
    let (mut out, mut leans) = (Vec::new(), Vec::new());
    let mut frame = 0_u32;
    loop {
        let nominal = f64::from(frame) * FRAME_S;
        let jitter = (0.7e-3 * normal(&mut rng)).clamp(-3e-3, 3e-3);
        let t_s = if frame == 0 { 0.0 } else { nominal + jitter };
        if t_s > path.duration_s() {
            return (out, leans);
        }
        let mut x = path.at(t_s);
        leans.push([0, 1].map(|i| (x[i] - elbow[i]) / path.radius_m));
        let before = path.at(t_s - 0.5 * FRAME_S);
        let moved: f64 = (0..3).map(|i| (x[i] - before[i]).powi(2)).sum();
        // A frame's exposure smears a fast hand: the tracker errs along with its speed.
        let sigma = NOISE_M + BLUR * moved.sqrt();
        for x in &mut x {
            *x += sigma * normal(&mut rng);
        }
        out.push((t_s, x));
        frame += 1;
    }
}

/// When the hand of [`swing`] turns, s: from the end of raising it on, every time it changes sides. Two turns are one swing to and fro.
///
/// ```
/// let turns = telemime_sim::hand::turns(7, 0);
/// assert!(turns.len() > 12 && turns.is_sorted());
/// ```
pub fn turns(seed: u64, index: u32) -> Vec<f64> {
    let mut rng = stream(seed, u64::from(index) + 1);
    let path = Performance::new(&Person::new(seed), index, &mut rng).turns;
    path.iter().map(|turn| turn.t_s).collect()
}

fn stream(seed: u64, n: u64) -> Xoshiro256PlusPlus {
    Xoshiro256PlusPlus::seed_from_u64(seed ^ n.wrapping_mul(PERFORMANCE_STREAM))
}

fn normal(rng: &mut Xoshiro256PlusPlus) -> f64 {
    StandardNormal.sample(rng)
}

/// What stays the same between one person's performances.
struct Person {
    /// Where the swinging arm's elbow is, m.
    pivot: [f64; 3],
    /// From there to the hand, m.
    radius_m: f64,
    /// Half-width of a swing, rad.
    half_width: f64,
    /// Time from one turn to the next, s.
    half_period_s: f64,
    /// How far the hand leans towards the sensor and up per rad/s: the two ways of a swing are different paths.
    lean: [f64; 2],
    /// Tilt of the swing's plane about the vertical, rad.
    tilt: f64,
    /// Where the hand hangs before and after, m.
    rest: [f64; 3],
    /// Phases of the slow drifts over performances, rad.
    drift: [f64; 5],
}

impl Person {
    fn new(seed: u64) -> Self {
        let mut rng = stream(seed, 0);
        let mut between = |low: f64, high: f64| rng.random_range(low..high);
        let radius_m = between(0.54, 0.64);
        let half_width = between(0.46, 0.58);
        // People with wide swings swing slower: top speed (here of an even swing) varies less than either.
        let even_speed = between(3.1, 3.5);
        let pivot = [between(0.05, 0.2), between(-0.1, 0.05), between(2.3, 2.7)];
        Self {
            pivot,
            radius_m,
            half_width,
            half_period_s: PI * radius_m * half_width / even_speed,
            lean: [between(-0.012, 0.012), between(-0.008, 0.008)],
            tilt: between(-0.4, 0.4),
            rest: [
                pivot[0] + between(0.05, 0.15),
                pivot[1] - between(0.35, 0.5),
                pivot[2] + between(0.1, 0.3),
            ],
            drift: core::array::from_fn(|_| between(0.0, 2.0 * PI)),
        }
    }
}

/// One turn of the hand to the next: an angle, and when.
struct Turn {
    t_s: f64,
    angle: f64,
    /// Share by which the way to the next turn is hurried at first and late after, or the reverse.
    skew: f64,
}

/// A performance without the sensor: rest, raise, swings, lower, rest.
struct Performance<'a> {
    person: &'a Person,
    offset: [f64; 3],
    radius_m: f64,
    raise_s: (f64, f64),
    turns: Vec<Turn>,
    lower_s: (f64, f64),
    /// Amplitude m, rate rad/s and phase of the body's sway along each axis.
    sway: [(f64, f64, f64); 3],
}

impl<'a> Performance<'a> {
    fn new(person: &'a Person, index: u32, rng: &mut Xoshiro256PlusPlus) -> Self {
        let drift = |i: usize| (0.9 * f64::from(index) + person.drift[i]).sin();
        let tempo = 1.0 + 0.04 * drift(0) + 0.05 * normal(rng);
        let width = 1.0 + 0.04 * drift(1) + 0.06 * normal(rng);
        let offset = core::array::from_fn(|i| 0.02 * drift(2 + i) + 0.03 * normal(rng));
        let sway = core::array::from_fn(|_| {
            (
                0.008 * normal(rng),
                rng.random_range(1.0..2.5),
                rng.random_range(0.0..2.0 * PI),
            )
        });
        let begin = rng.random_range(0.3..0.6);
        let raised = begin + 0.55 * (1.0 + 0.08 * normal(rng)).clamp(0.7, 1.3);
        let swinging_s = rng.random_range(5.2..6.4);
        let mut turns = Vec::new();
        let (mut t_s, mut side) = (raised, 1.0);
        // A swing resembles the one before it more than the average one.
        let (mut wide, mut slow) = (0.0, 0.0);
        while t_s < raised + swinging_s {
            wide = 0.5 * wide + WIDTH_SD * normal(rng);
            slow = 0.5 * slow + TIME_SD * normal(rng);
            let angle = side * person.half_width * (width + wide).clamp(0.6, 1.4);
            let skew = (SKEW_SD * normal(rng)).clamp(-0.4, 0.4);
            turns.push(Turn { t_s, angle, skew });
            t_s += person.half_period_s * (tempo + slow).clamp(0.75, 1.35);
            side = -side;
        }
        let angle = side * person.half_width * (width + wide).clamp(0.6, 1.4);
        turns.push(Turn {
            t_s,
            angle,
            skew: 0.0,
        });
        let lowered = t_s + 0.6 * (1.0 + 0.08 * normal(rng)).clamp(0.7, 1.3);
        Self {
            person,
            offset,
            radius_m: person.radius_m * (1.0 + 0.015 * normal(rng)),
            raise_s: (begin, raised),
            turns,
            lower_s: (t_s, lowered),
            sway,
        }
    }

    fn duration_s(&self) -> f64 {
        self.lower_s.1 + 0.3
    }

    fn at(&self, t_s: f64) -> [f64; 3] {
        let (from, to) = if t_s < self.raise_s.1 {
            (self.rest(), self.swung(self.raise_s.1))
        } else if t_s < self.lower_s.0 {
            let x = self.swung(t_s);
            return self.swayed(x, t_s);
        } else {
            (self.swung(self.lower_s.0), self.rest())
        };
        let (begin, end) = if t_s < self.raise_s.1 {
            self.raise_s
        } else {
            self.lower_s
        };
        let u = ((t_s - begin) / (end - begin)).clamp(0.0, 1.0);
        // Minimum jerk (Flash & Hogan 1985).
        let s = u * u * u * (10.0 - 15.0 * u + 6.0 * u * u);
        let bulge = 0.06 * (PI * s).sin();
        let mut x: [f64; 3] = core::array::from_fn(|i| from[i] + (to[i] - from[i]) * s);
        x[0] += bulge;
        x[2] -= bulge;
        self.swayed(x, t_s)
    }

    fn rest(&self) -> [f64; 3] {
        core::array::from_fn(|i| self.person.rest[i] + self.offset[i])
    }

    /// The hand on its arc at a time within the swings.
    fn swung(&self, t_s: f64) -> [f64; 3] {
        let next = self
            .turns
            .partition_point(|turn| turn.t_s <= t_s)
            .clamp(1, self.turns.len() - 1);
        let (a, b) = (&self.turns[next - 1], &self.turns[next]);
        let span = b.t_s - a.t_s;
        let u = ((t_s - a.t_s) / span).clamp(0.0, 1.0);
        // The skew leaves both ends and their rates alone.
        let phase = PI * u + a.skew * (1.0 - (2.0 * PI * u).cos());
        let phase_rate = (PI + 2.0 * PI * a.skew * (2.0 * PI * u).sin()) / span;
        let angle = a.angle + (b.angle - a.angle) * 0.5 * (1.0 - phase.cos());
        let rate = (b.angle - a.angle) * 0.5 * phase.sin() * phase_rate;
        let p = self.person;
        let (side, up) = (self.radius_m * angle.sin(), self.radius_m * angle.cos());
        let local = [
            side * p.tilt.cos(),
            up + p.lean[1] * rate,
            side * p.tilt.sin() - p.lean[0] * rate - 0.1,
        ];
        core::array::from_fn(|i| p.pivot[i] + self.offset[i] + local[i])
    }

    fn swayed(&self, x: [f64; 3], t_s: f64) -> [f64; 3] {
        core::array::from_fn(|i| {
            let (amplitude, rate, phase) = self.sway[i];
            x[i] + amplitude * (rate * t_s + phase).sin()
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn speeds(swing: &[(f64, [f64; 3])]) -> Vec<f64> {
        let mut speeds: Vec<f64> = swing
            .windows(2)
            .map(|w| {
                let d: f64 = (0..3).map(|i| (w[1].1[i] - w[0].1[i]).powi(2)).sum();
                d.sqrt() / (w[1].0 - w[0].0)
            })
            .collect();
        speeds.sort_by(f64::total_cmp);
        speeds
    }

    #[test]
    fn same_arguments_same_bytes_and_others_differ() {
        assert_eq!(swing(3, 1), swing(3, 1));
        assert_ne!(swing(3, 1), swing(3, 2));
        assert_ne!(swing(3, 1), swing(4, 1));
    }

    #[test]
    fn the_wrist_turns_smoothly_and_by_a_lot() {
        for seed in 0..10 {
            let poses = swing_with_wrist(seed, 2);
            assert_eq!(poses, swing_with_wrist(seed, 2));
            let apart = |a: &Pose, b: &Pose| {
                let dot: f64 = a.q.iter().zip(b.q).map(|(a, b)| a * b).sum();
                2.0 * dot.abs().min(1.0).acos()
            };
            let norm = |p: &Pose| p.q.iter().map(|v| v * v).sum::<f64>();
            assert!(poses.iter().all(|p| (norm(p) - 1.0).abs() < 1e-12));
            let step = poses
                .windows(2)
                .map(|w| apart(&w[0], &w[1]))
                .fold(0.0, f64::max);
            let range = poses
                .iter()
                .map(|p| apart(p, &poses[0]))
                .fold(0.0, f64::max);
            assert!(step < 0.2 && range > 0.4, "{step} {range}");
        }
    }

    #[test]
    fn as_fast_and_as_long_as_the_recordings() {
        let mut mean = 0.0;
        for seed in 0..40 {
            for index in 0..6 {
                let s = swing(seed, index);
                let (first, last) = (s[0].0, s[s.len() - 1].0);
                assert_eq!(first, 0.0);
                assert!((6.0..10.0).contains(&last), "{last} s");
                assert!(s.windows(2).all(|w| w[1].0 - w[0].0 > 0.025));
                assert!(s.iter().flat_map(|(_, x)| x).all(|x| x.is_finite()));
                let speeds = speeds(&s);
                let v95 = speeds[speeds.len() * 95 / 100];
                assert!((2.8..7.8).contains(&v95), "{v95} m/s");
                mean += v95 / 240.0;
            }
        }
        assert!((4.0..5.0).contains(&mean), "{mean} m/s");
    }

    #[test]
    fn begins_and_ends_at_rest_with_several_reversals() {
        let s = swing(11, 4);
        let sideways: Vec<f64> = s.iter().map(|(_, x)| x[0]).collect();
        let still = |w: &[f64]| w.iter().all(|x| (x - w[0]).abs() < 0.025);
        assert!(still(&sideways[..8]) && still(&sideways[sideways.len() - 8..]));
        let mid = 0.5
            * (sideways.iter().copied().fold(f64::MIN, f64::max)
                + sideways.iter().copied().fold(f64::MAX, f64::min));
        let crossings = sideways
            .windows(2)
            .filter(|w| (w[0] - mid) * (w[1] - mid) < 0.0)
            .count();
        assert!(crossings >= 12, "{crossings}");
    }
}
