//! A hand that takes hold of something, moves it aside, keeps it there and lets go.

use super::{FRAME_S, NOISE_M, normal, stream};

/// Streams of their own: whoever pushes repeats neither who swings nor who reaches.
const PUSH_STREAM: u64 = 0x0051_7c0f;

/// Where the hand is when it takes hold, m: only what it does from there means anything.
const FROM_M: [f64; 3] = [0.15, -0.1, 2.2];

/// One push by `way` (m): (time s, position m), about 30 Hz, from `at_s` on for `rise_s + hold_s`.
///
/// The hand takes hold at rest, moves by minimum jerk (Flash & Hogan 1985) within `rise_s`, and keeps still, all within the 2.5 mm of
/// the sensor's noise. After the last sample it has let go. The same arguments give the same bytes.
///
/// ```
/// let push = telemime_sim::hand::push(7, 2.0, [0.0, 0.08, 0.0], 0.4, 0.6);
/// let moved = push[push.len() - 1].1[1] - push[0].1[1];
/// assert!((moved - 0.08).abs() < 0.02);
/// ```
pub fn push(seed: u64, at_s: f64, way: [f64; 3], rise_s: f64, hold_s: f64) -> Vec<(f64, [f64; 3])> {
    let mut rng = stream(seed ^ PUSH_STREAM, at_s.to_bits());
    let frames = ((rise_s + hold_s) / FRAME_S).round() as u32;
    (0..=frames)
        .map(|frame| {
            let since_s = f64::from(frame) * FRAME_S;
            let u = (since_s / rise_s.max(FRAME_S)).clamp(0.0, 1.0);
            let s = u * u * u * (10.0 - 15.0 * u + 6.0 * u * u);
            let x: [f64; 3] =
                core::array::from_fn(|i| FROM_M[i] + way[i] * s + NOISE_M * normal(&mut rng));
            (at_s + since_s, x)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_moves_as_far_as_asked_and_for_as_long() {
        let way = [0.05, -0.2, 0.1];
        let path = push(3, 1.5, way, 0.5, 1.0);
        assert_eq!(path, push(3, 1.5, way, 0.5, 1.0));
        assert_ne!(path, push(4, 1.5, way, 0.5, 1.0));
        assert_eq!(path[0].0, 1.5);
        assert!((path[path.len() - 1].0 - 3.0).abs() < FRAME_S);
        let after = path.iter().filter(|(t_s, _)| *t_s >= 2.0);
        for (t_s, x) in after {
            let off = (0..3).map(|i| (x[i] - path[0].1[i] - way[i]).abs());
            assert!(off.fold(0.0, f64::max) < 0.02, "{x:?} at {t_s} s");
        }
    }
}
