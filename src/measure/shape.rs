//! How two paths over the same grid of times differ: in value, in time, in place, in size.

use nalgebra::{SymmetricEigen, Vector3};

/// A root mean square, a 99th percentile and a largest value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// √(Σ e²/n).
    pub rms: f64,
    /// The 99th percentile: nearest rank.
    pub p99: f64,
    /// The largest.
    pub max: f64,
}

impl Spread {
    /// Of errors, none negative; `None` of none.
    pub fn of(errors: impl IntoIterator<Item = f64>) -> Option<Self> {
        let mut errors: Vec<f64> = errors.into_iter().collect();
        let rms = super::rms(errors.iter().copied());
        Some(Self {
            p99: quantile(&mut errors, 0.99)?,
            max: *errors.last()?,
            rms,
        })
    }
}

/// The smallest value that at least the share `p` of all is no larger than (nearest rank); sorts. `None` of none.
pub fn quantile(values: &mut [f64], p: f64) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let rank = (p * values.len() as f64).ceil().max(1.0) as usize;
    values.get(rank.min(values.len()).checked_sub(1)?).copied()
}

/// The shift by which `tip` trails `truth` best in the least-squares sense, in steps of the grid, and the RMS that remains
/// there, m: time and value told apart. `tip[i]` belongs to `truth[i + before]`, and `truth` has values for shifts from −`after` to
/// `before`; every `stride`th moment counts.
///
/// # Panics
/// If `truth` is not `tip.len() + before + after` long.
pub fn shift(
    tip: &[Vector3<f64>],
    truth: &[Vector3<f64>],
    (before, after): (usize, usize),
    stride: usize,
) -> (i64, f64) {
    assert_eq!(truth.len(), tip.len() + before + after, "the grids fit");
    let error = |late: i64| -> f64 {
        let offset = (before as i64 - late) as usize;
        let moments = (0..tip.len()).step_by(stride.max(1));
        moments
            .map(|i| (tip[i] - truth[i + offset]).norm_squared())
            .sum()
    };
    let (least, late) = (-(after as i64)..=before as i64)
        .map(|late| (error(late), late))
        .min_by(|a, b| a.0.total_cmp(&b.0))
        .unwrap_or((0.0, 0));
    let moments = tip.len().div_ceil(stride.max(1)).max(1);
    (late, (least / moments as f64).sqrt())
}

/// From each point of `tip` to the nearest point of the path through `truth` within `reach` steps of the same index, m; every
/// `stride`th moment.
pub fn off_path(
    tip: &[Vector3<f64>],
    truth: &[Vector3<f64>],
    reach: usize,
    stride: usize,
) -> Vec<f64> {
    let stride = stride.max(1);
    let nearest = |i: usize| {
        let (from, to) = (i.saturating_sub(reach), (i + reach).min(truth.len() - 1));
        let mut least = (truth[from] - tip[i]).norm_squared();
        let mut at = from;
        while at < to {
            let next = (at + stride).min(to);
            let way = truth[next] - truth[at];
            let u = (tip[i] - truth[at]).dot(&way) / way.norm_squared();
            let u = if u.is_finite() {
                u.clamp(0.0, 1.0)
            } else {
                0.0
            };
            least = least.min((truth[at] + way * u - tip[i]).norm_squared());
            at = next;
        }
        least.sqrt()
    };
    let count = tip.len().min(truth.len());
    (0..count).step_by(stride).map(nearest).collect()
}

/// The direction in which a path reaches farthest (the principal axis of its covariance), of length 1, and its mean, m.
pub fn principal_axis(path: &[Vector3<f64>]) -> (Vector3<f64>, Vector3<f64>) {
    let n = path.len().max(1) as f64;
    let mean = path.iter().sum::<Vector3<f64>>() / n;
    let scatter = path
        .iter()
        .map(|x| (x - mean) * (x - mean).transpose())
        .sum::<nalgebra::Matrix3<f64>>();
    let eigen = SymmetricEigen::new(scatter);
    let axis = eigen
        .eigenvectors
        .column(eigen.eigenvalues.imax())
        .into_owned();
    // Either sign is an axis; one is chosen.
    let largest = axis[axis.iamax()];
    (if largest < 0.0 { -axis } else { axis }, mean)
}

/// How much larger `tip` moves than `truth`: √(Σ|tip − mean|² / Σ|truth − mean|²); `None` of a hand at rest.
pub fn amplitude_gain(tip: &[Vector3<f64>], truth: &[Vector3<f64>]) -> Option<f64> {
    let spread = |path: &[Vector3<f64>]| -> f64 {
        let mean = path.iter().sum::<Vector3<f64>>() / path.len().max(1) as f64;
        path.iter().map(|x| (x - mean).norm_squared()).sum()
    };
    let gain = (spread(tip) / spread(truth)).sqrt();
    gain.is_finite().then_some(gain)
}

/// At each reversal of `truth` along its principal axis how far beyond it `tip` goes, m; negative where it falls short.
///
/// A reversal is an extremum from which the hand then goes back by a fifth of its whole range; the tip's own extremum is sought from there
/// until `within` steps later.
pub fn overshoots(tip: &[Vector3<f64>], truth: &[Vector3<f64>], within: usize) -> Vec<f64> {
    let (axis, mean) = principal_axis(truth);
    let along = |x: &Vector3<f64>| (x - mean).dot(&axis);
    let hand: Vec<f64> = truth.iter().map(along).collect();
    let range = hand.iter().copied().fold(f64::MIN, f64::max)
        - hand.iter().copied().fold(f64::MAX, f64::min);
    let back = 0.2 * range;
    let beyond = |at: usize, sign: f64| {
        let until = (at + within).min(tip.len());
        let far = tip[at.min(until)..until].iter().map(|x| sign * along(x));
        far.fold(f64::MIN, f64::max) - sign * hand[at]
    };
    let mut found = Vec::new();
    // Until the hand has set out, its farthest places either way; then the way it goes and its farthest place on it.
    let (mut high, mut low) = (0, 0);
    let mut going: Option<(f64, usize)> = None;
    for (i, x) in hand.iter().enumerate() {
        match going {
            None => {
                high = if *x > hand[high] { i } else { high };
                low = if *x < hand[low] { i } else { low };
                if x - hand[low] > back {
                    going = Some((1.0, i));
                } else if hand[high] - x > back {
                    going = Some((-1.0, i));
                }
            }
            Some((sign, far)) if sign * (x - hand[far]) >= 0.0 => going = Some((sign, i)),
            Some((sign, far)) if sign * (hand[far] - x) > back => {
                found.push(beyond(far, sign));
                going = Some((-sign, i));
            }
            Some(_) => {}
        }
    }
    found.retain(|v| v.is_finite());
    found
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    /// `amplitude`·sin(2πt) along an oblique axis, every millisecond for 4 s, `late` ms late, from phase −π/2 or 0.
    fn sine(amplitude: f64, late: i64) -> Vec<Vector3<f64>> {
        let at = |i: i64| {
            let s = amplitude * (2.0 * PI * (i - late) as f64 * 1e-3).sin();
            Vector3::new(0.6 * s, 0.8 * s, 0.0)
        };
        (0..4000).map(at).collect()
    }

    #[test]
    fn spreads_and_quantiles_are_what_they_are_called() {
        let spread = Spread::of((1..=100).map(f64::from)).unwrap();
        assert_eq!((spread.p99, spread.max), (99.0, 100.0));
        // Σ i² = n(n+1)(2n+1)/6.
        assert!((spread.rms - (101.0 * 201.0 / 6.0_f64).sqrt()).abs() < 1e-9);
        assert_eq!(Spread::of([]), None);
        assert_eq!(quantile(&mut [3.0, 1.0, 2.0], 0.5), Some(2.0));
    }

    #[test]
    fn a_shift_is_found_and_what_remains_is_the_value() {
        let tip: Vec<_> = sine(0.9, 70)[1000..3000].to_vec();
        let truth: Vec<_> = sine(1.0, 0)[200..3200].to_vec();
        let (late, rest) = shift(&tip, &truth, (800, 200), 1);
        assert_eq!(late, 70);
        // A tenth of a sine.
        assert!((rest - 0.1 / 2.0_f64.sqrt()).abs() < 1e-3, "{rest}");
    }

    #[test]
    fn a_late_tip_is_on_the_path_and_a_tip_beside_it_is_off_by_the_distance() {
        let truth = sine(1.0, 0);
        let late = off_path(&sine(1.0, 100), &truth, 500, 5);
        // Before the recording there is no path to be on.
        assert!(late[20..].iter().all(|d| *d < 1e-6));
        let beside: Vec<_> = truth.iter().map(|x| x + Vector3::z() * 0.02).collect();
        let off = off_path(&beside, &truth, 500, 5);
        assert!(off.iter().all(|d| (d - 0.02).abs() < 1e-9));
    }

    #[test]
    fn gain_and_overshoot_of_a_larger_sine_are_its_share() {
        let truth = sine(1.0, 0);
        for (size, late) in [(1.1, 0), (0.9, 40)] {
            let tip = sine(size, late);
            let gain = amplitude_gain(&tip, &truth).unwrap();
            assert!((gain - size).abs() < 0.01, "{gain}");
            let beyond = overshoots(&tip, &truth, 300);
            assert_eq!(beyond.len(), 8, "two reversals a period");
            assert!(
                beyond.iter().all(|d| (d - (size - 1.0)).abs() < 1e-6),
                "{beyond:?}"
            );
        }
        assert_eq!(amplitude_gain(&truth, &[Vector3::x(); 10]), None);
    }

    #[test]
    fn the_principal_axis_is_the_longest() {
        let (axis, mean) = principal_axis(&sine(2.0, 0));
        assert!((axis - Vector3::new(0.6, 0.8, 0.0)).norm() < 1e-9 && mean.norm() < 1e-9);
    }
}
