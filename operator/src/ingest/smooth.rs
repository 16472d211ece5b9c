//! A low-pass that shifts nothing in time, on samples at any times.

use std::f64::consts::PI;

/// Half the phase of the cut-off in one step, at most, rad: nearer to a right angle there is nothing left to smooth.
const LARGEST_ANGLE: f64 = 1.2;

/// Smooths `x` (any number of coordinates) at the times `t_s` (strictly ascending) by a critically damped second-order
/// low-pass run forward and then backward: no phase, −3 dB in all at `cutoff_hz`.
///
/// Each run is two first-order lags by the trapezoidal rule, which a straight line passes unbent however uneven the samples, its time constant
/// prewarped (Tustin) for the usual step: the cut-off is where it is said to be up to a third of the sampling rate. Beyond both ends the motion is continued by its
/// reflection through the end point, so that ends are not drawn inwards.
pub(super) fn smooth<const D: usize>(t_s: &[f64], x: &[[f64; D]], cutoff_hz: f64) -> Vec<[f64; D]> {
    let (Some((&first, &last)), Some((&from, &to))) =
        (x.first().zip(x.last()), t_s.first().zip(t_s.last()))
    else {
        return Vec::new();
    };
    let mut steps: Vec<f64> = t_s.windows(2).map(|w| w[1] - w[0]).collect();
    steps.sort_by(f64::total_cmp);
    let step = steps.get(steps.len() / 2).copied().unwrap_or(1.0);
    // Four first-order lags in all: (1 + (ωτ)²)^-2 = 1/√2 at the cut-off.
    let omega_tau = (2.0_f64.powf(0.25) - 1.0).sqrt();
    let warped = (PI * cutoff_hz * step).min(LARGEST_ANGLE).tan();
    let tau = omega_tau * step / (2.0 * warped);
    let reach = 12.0 * tau;
    let through = |end: [f64; D], x: &[f64; D]| std::array::from_fn(|d| 2.0 * end[d] - x[d]);
    let mut series: Vec<(f64, [f64; D])> = Vec::new();
    let all = || t_s.iter().zip(x);
    series.extend(
        all()
            .rev()
            .filter(|(t, _)| **t > from && **t <= from + reach)
            .map(|(t, x)| (2.0 * from - t, through(first, x))),
    );
    let begin = series.len();
    series.extend(all().map(|(t, x)| (*t, *x)));
    series.extend(
        all()
            .rev()
            .filter(|(t, _)| **t < to && **t >= to - reach)
            .map(|(t, x)| (2.0 * to - t, through(last, x))),
    );
    for _ in 0..2 {
        lag(&mut series, tau);
        lag(&mut series, tau);
        series.reverse();
    }
    series[begin..begin + x.len()]
        .iter()
        .map(|(_, x)| *x)
        .collect()
}

/// One first-order lag along the series, whichever way its times run.
fn lag<const D: usize>(series: &mut [(f64, [f64; D])], tau: f64) {
    let Some(&(mut t, mut input)) = series.first() else {
        return;
    };
    let mut y = input;
    for (next, x) in series.iter_mut().skip(1) {
        let dt = (*next - t).abs();
        let a = dt / (2.0 * tau);
        for d in 0..D {
            y[d] = ((1.0 - a) * y[d] + a * (x[d] + input[d])) / (1.0 + a);
        }
        (t, input) = (*next, *x);
        *x = y;
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_xoshiro::Xoshiro256PlusPlus;

    use super::*;

    /// Gain and phase (rad) of a sine after smoothing at 5 Hz, sampled at a rate with times off by up to `jitter_s`.
    fn response(hz: f64, rate_hz: f64, jitter_s: f64) -> (f64, f64) {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(3);
        let n = (20.0 * rate_hz) as usize;
        let t: Vec<f64> = (0..n)
            .map(|i| i as f64 / rate_hz + jitter_s * rng.random_range(-1.0..1.0))
            .collect();
        let w = 2.0 * PI * hz;
        let x: Vec<[f64; 1]> = t.iter().map(|t| [(w * t).sin()]).collect();
        let y = smooth(&t, &x, 5.0);
        let (mut a, mut b, mut n) = (0.0, 0.0, 0.0);
        for (t, y) in t.iter().zip(&y).filter(|(t, _)| (2.0..18.0).contains(*t)) {
            a += y[0] * (w * t).sin();
            b += y[0] * (w * t).cos();
            n += 0.5;
        }
        (f64::hypot(a, b) / n, f64::atan2(b, a))
    }

    #[test]
    fn keeps_phase_and_cuts_off_where_it_says() {
        for (rate_hz, jitter_s) in [(30.0, 0.0), (100.0, 0.0), (100.0, 0.004), (30.0, 0.01)] {
            for (hz, gain, tolerance) in [
                (0.5, 1.0, 0.01),
                (
                    5.0,
                    0.5_f64.sqrt(),
                    if jitter_s > 0.0 { 0.04 } else { 0.001 },
                ),
                (14.0, 0.0, 0.2),
            ] {
                let (g, phase) = response(hz, rate_hz, jitter_s);
                assert!((g - gain).abs() < tolerance, "{hz} Hz at {rate_hz}: {g}");
                assert!(
                    g < 0.2 || phase.abs() < 0.03,
                    "{hz} Hz at {rate_hz}: {phase} rad"
                );
            }
        }
    }

    #[test]
    fn a_straight_line_stays_one_to_its_ends() {
        let t: Vec<f64> = (0..40)
            .map(|i| f64::from(i) * 0.03 + if i % 3 == 0 { 0.01 } else { 0.0 })
            .collect();
        let x: Vec<[f64; 2]> = t.iter().map(|t| [2.0 * t - 1.0, 3.0]).collect();
        for (a, b) in smooth(&t, &x, 4.0).iter().zip(&x) {
            assert!((a[0] - b[0]).abs() < 1e-4 && (a[1] - b[1]).abs() < 1e-12);
        }
        assert!(smooth::<1>(&[], &[], 4.0).is_empty());
        assert_eq!(smooth(&[1.0], &[[7.0]], 4.0), [[7.0]]);
    }
}
