//! What a tracker adds to a hand: frames in which it takes something else for the hand.

use super::{Frame, normal, stream};
use rand::RngExt;

/// Streams of their own.
const GLITCH_STREAM: u64 = 0x676c_6974_6368;

/// How far off the tracker is in a glitch, m: an elbow, or the other hand.
const STRAY_M: std::ops::Range<f64> = 0.25..0.6;

/// `samples` with a `share` of glitches in [0, 1], `running` frames long each: the tracker is 0.25 to 0.6 m off, in one place while it lasts.
///
/// Returns the samples and which of them are wrong. The first ten frames and the last three are right, and two glitches are at least three
/// right frames apart. The same arguments give the same bytes on one platform.
///
/// ```
/// let swing = telemime_sim::hand::swing(7, 0);
/// let (seen, wrong) = telemime_sim::hand::glitched(&swing, 0.02, 1, 1);
/// assert_eq!(seen.len(), swing.len());
/// assert!(seen.iter().zip(&swing).zip(&wrong).all(|((a, b), &wrong)| wrong != (a == b)));
/// ```
pub fn glitched(
    samples: &[Frame],
    share: f64,
    running: usize,
    seed: u64,
) -> (Vec<Frame>, Vec<bool>) {
    let mut rng = stream(seed ^ GLITCH_STREAM, 0);
    let mut seen = samples.to_vec();
    let mut wrong = vec![false; samples.len()];
    let begins = share.clamp(0.0, 1.0) / running.max(1) as f64;
    let mut i = 10;
    while i + running + 3 < samples.len() {
        if !rng.random_bool(begins) {
            i += 1;
            continue;
        }
        let direction: [f64; 3] = core::array::from_fn(|_| normal(&mut rng));
        let norm = direction
            .iter()
            .map(|d| d * d)
            .sum::<f64>()
            .sqrt()
            .max(1e-9);
        let far_m = rng.random_range(STRAY_M);
        for j in i..i + running {
            for (x, d) in seen[j].1.iter_mut().zip(direction) {
                *x += far_m * d / norm;
            }
            wrong[j] = true;
        }
        i += running + 3;
    }
    (seen, wrong)
}
