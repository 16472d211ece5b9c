//! A hand that reaches for something: back and up from where it rests, across, and down onto it.

use core::f64::consts::PI;

use super::{FRAME_S, NOISE_M, normal, stream};

/// Streams of their own: a person who swings is not repeated by the one who reaches.
const REACH_STREAM: u64 = 0x007e_3ac4;

/// How long the hand rests before and after, s.
const REST_S: f64 = 0.2;

/// How long it moves, on average, s.
const REACH_S: f64 = 1.5;

/// One reach for `goal` (m): (time s, position m), about 30 Hz, 1.5 to 2.5 s long, starting and ending at rest.
///
/// Axes are a Kinect's: x to the side, y up, z away from the sensor. The same `seed` is the same person at the same table; `index` counts
/// performances, which differ in where they begin (5 cm), tempo, how high the hand is lifted and how far it draws
/// back first. The hand comes down on the goal from above, within the 2.5 mm of the sensor's noise. The same arguments
/// give the same bytes on one platform.
///
/// ```
/// let goal = [0.3, -0.1, 2.1];
/// let reach = telemime_sim::hand::reach(7, 0, goal);
/// assert!(reach.last().is_some_and(|&(_, x)| (x[0] - goal[0]).abs() < 0.02));
/// ```
pub fn reach(seed: u64, index: u32, goal: [f64; 3]) -> Vec<(f64, [f64; 3])> {
    carry(seed, index, goal, REACH_S)
}

/// [`reach`] by a hand that takes its time, as one that carries something: about `moving_s` instead of 1.5 s.
///
/// ```
/// let carried = telemime_sim::hand::carry(7, 0, [0.3, -0.1, 2.1], 4.0);
/// assert!((3.0..6.0).contains(&carried[carried.len() - 1].0));
/// ```
pub fn carry(seed: u64, index: u32, goal: [f64; 3], moving_s: f64) -> Vec<(f64, [f64; 3])> {
    let mut person = stream(seed ^ REACH_STREAM, 0);
    let rest: [f64; 3] =
        [-0.1, -0.25, 2.4].map(|centre| centre + 0.05 * normal(&mut person).clamp(-2.0, 2.0));
    let mut rng = stream(seed ^ REACH_STREAM, u64::from(index) + 1);
    let start: [f64; 3] =
        core::array::from_fn(|i| rest[i] + 0.05 * normal(&mut rng).clamp(-2.0, 2.0));
    let moving_s = moving_s * (1.0 + 0.08 * normal(&mut rng)).clamp(0.8, 1.3);
    let lift_m = 0.14 * (1.0 + 0.08 * normal(&mut rng)).clamp(0.7, 1.3);
    let back_m = 0.06 * (1.0 + 0.08 * normal(&mut rng)).clamp(0.7, 1.3);
    let frames = ((moving_s + 2.0 * REST_S) / FRAME_S).ceil() as u32;
    (0..=frames)
        .map(|frame| {
            let t_s = f64::from(frame) * FRAME_S;
            let u = ((t_s - REST_S) / moving_s).clamp(0.0, 1.0);
            // Minimum jerk (Flash & Hogan 1985).
            let s = u * u * u * (10.0 - 15.0 * u + 6.0 * u * u);
            let mut x: [f64; 3] = core::array::from_fn(|i| start[i] + (goal[i] - start[i]) * s);
            x[1] += lift_m * (PI * u).sin().powi(2);
            // Drawn back early only: what the start of the motion looks like, wherever it leads.
            x[2] += back_m * (PI * (2.5 * u).min(1.0)).sin().powi(2);
            (t_s, x.map(|x| x + NOISE_M * normal(&mut rng)))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_begins_near_one_place_and_ends_at_the_goal() {
        for index in 0..20 {
            let goal = [0.2, -0.2 + 0.01 * f64::from(index), 2.0];
            let path = reach(5, index, goal);
            assert_eq!(path, reach(5, index, goal));
            let (last_s, last) = path[path.len() - 1];
            assert!((1.5..2.5).contains(&last_s), "{last_s} s");
            let off = |a: [f64; 3], b: [f64; 3]| -> f64 {
                (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt()
            };
            assert!(off(last, goal) < 0.015);
            assert!(off(path[0].1, reach(5, 0, goal)[0].1) < 0.4);
            let highest = path.iter().map(|(_, x)| x[1]).fold(f64::MIN, f64::max);
            assert!(highest > path[0].1[1].max(goal[1]) - 0.05);
        }
        assert_ne!(reach(5, 0, [0.0; 3]), reach(6, 0, [0.0; 3]));
    }
}
