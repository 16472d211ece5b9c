//! A hand that taps on a table: stops so abrupt that their moment is known.

use rand::RngExt;

use super::{FRAME_S, Frame, NOISE_M, normal, stream};

/// Streams of their own.
const TAP_STREAM: u64 = 0x0074_6170;

/// The hand comes down on the table this fast, m/s.
const FALL_M_S: std::ops::Range<f64> = 0.8..1.6;

/// `count` taps: what a tracker of 30 Hz sees (time s, position m; times are those at which the positions hold), and when the hand touched the table, s.
///
/// The hand rests on the table, rises 15 to 25 cm, waits, and comes down ever faster; 1.2 to 2 s lie between two taps. Axes are a Kinect's: y is up.
/// Positions carry 2.5 mm of sensor noise. The same `seed` gives the same bytes on one platform.
///
/// ```
/// let (samples, taps) = telemime_sim::hand::taps(7, 10);
/// assert_eq!(taps.len(), 10);
/// assert!(taps.iter().all(|t| (0.0..samples[samples.len() - 1].0).contains(t)));
/// ```
pub fn taps(seed: u64, count: usize) -> (Vec<Frame>, Vec<f64>) {
    let mut rng = stream(seed ^ TAP_STREAM, 0);
    // Each tap: rises from, waits from, falls from, touches; how high; where aside.
    let mut taps = Vec::with_capacity(count);
    let mut t_s = 0.5;
    for _ in 0..count {
        let high_m = rng.random_range(0.15..0.25);
        let speed_m_s = rng.random_range(FALL_M_S);
        let rise_s = rng.random_range(0.35..0.5);
        let wait_s = rng.random_range(0.1..0.25);
        // Ever faster, from rest: the mean speed is half of the last.
        let fall_s = 2.0 * high_m / speed_m_s;
        let waits = t_s + rise_s;
        let falls = waits + wait_s;
        taps.push((t_s, waits, falls, falls + fall_s, high_m));
        t_s = falls + fall_s + rng.random_range(0.4..0.7);
    }
    let height = |t: f64| -> f64 {
        let Some(&(rises, waits, falls, touches, high_m)) =
            taps.iter().rev().find(|tap| t >= tap.0)
        else {
            return 0.0;
        };
        if t < waits {
            let u = (t - rises) / (waits - rises);
            high_m * u * u * u * (10.0 - 15.0 * u + 6.0 * u * u)
        } else if t < falls {
            high_m
        } else if t < touches {
            let u = (t - falls) / (touches - falls);
            high_m * (1.0 - u * u)
        } else {
            0.0
        }
    };
    let table = [0.1 + 0.05 * normal(&mut rng), -0.3, 2.0];
    let frames = ((t_s + 0.5) / FRAME_S) as u32;
    let samples = (0..frames)
        .map(|frame| {
            let jitter = (0.7e-3 * normal(&mut rng)).clamp(-3e-3, 3e-3);
            let t = f64::from(frame) * FRAME_S + if frame == 0 { 0.0 } else { jitter };
            let up = height(t);
            let x = [table[0] + 0.1 * up, table[1] + up, table[2] - 0.2 * up];
            (t, x.map(|x| x + NOISE_M * normal(&mut rng)))
        })
        .collect();
    (samples, taps.iter().map(|tap| tap.3).collect())
}
