//! Regions of confidence of a normal distribution: how large, and which way they point.

use nalgebra::{SMatrix, SVector};

/// ln √π.
const LN_SQRT_PI: f64 = 0.572_364_942_924_700_1;

/// The most sweeps of [`axes`]; convergence is quadratic, so that ten are plenty.
const MOST_SWEEPS: usize = 16;

/// The most steps of [`chi_squared_quantile`]: bisection alone would have done by then.
const MOST_STEPS: usize = 200;

/// The share of χ² variables with `degrees` degrees of freedom that are at most `x`; `None` if `x` is negative or NaN,
/// or `degrees` is 0.
///
/// As closed sums over the integer degrees, so that nothing is approximated but exp, erfc and the rounding.
/// Abramowitz & Stegun 1964, 26.4.4, 26.4.5 (upper tail), 26.4.6 (lower).
pub fn chi_squared_cdf(x: f64, degrees: u32) -> Option<f64> {
    (degrees > 0 && x >= 0.0).then(|| lower(x, degrees))
}

/// The squared radius (in deviations) of the region that a share `p` of a normal distribution over `degrees`
/// coordinates lies in: the quantile of χ². `None` unless 0 ≤ p < 1 and `degrees` > 0.
pub fn chi_squared_quantile(p: f64, degrees: u32) -> Option<f64> {
    if degrees == 0 || !(0.0..1.0).contains(&p) {
        return None;
    }
    if p == 0.0 {
        return Some(0.0);
    }
    if degrees == 2 {
        return Some(-2.0 * libm::log1p(-p));
    }
    let (mut low, mut high) = (0.0, f64::from(degrees));
    while lower(high, degrees) < p {
        low = high;
        high *= 2.0;
    }
    // Newton's method where the curve is nearly straight: ln P over ln x below the median, ln Q over x above; a step that
    // leaves the bracket is a bisection instead.
    let lower_half = p <= 0.5;
    let aim = if lower_half {
        libm::log(p)
    } else {
        libm::log1p(-p)
    };
    let mut x = 0.5 * (low + high);
    for _ in 0..MOST_STEPS {
        let density = density(x, degrees);
        let (miss, next) = if lower_half {
            let share = lower(x, degrees);
            let miss = libm::log(share) - aim;
            (miss, x * libm::exp(-miss * share / (x * density)))
        } else {
            let share = upper(x, degrees);
            let miss = aim - libm::log(share);
            (miss, x - miss * share / density)
        };
        if miss > 0.0 {
            high = x;
        } else {
            low = x;
        }
        let next = if next > low && next < high {
            next
        } else {
            0.5 * (low + high)
        };
        let done = (next - x).abs() <= 2.0 * f64::EPSILON * x;
        x = next;
        if done {
            break;
        }
    }
    Some(x)
}

/// ln Γ(n/2).
fn ln_gamma_half(n: u32) -> f64 {
    match n {
        1 => LN_SQRT_PI,
        _ => libm::lgamma(0.5 * f64::from(n)),
    }
}

fn density(x: f64, degrees: u32) -> f64 {
    let half = 0.5 * f64::from(degrees);
    let y = 0.5 * x;
    0.5 * libm::exp((half - 1.0) * libm::log(y) - y - ln_gamma_half(degrees))
}

/// P(χ² ≤ x). Below the mean by its power series, whose terms are all positive; above, what the upper tail leaves.
fn lower(x: f64, degrees: u32) -> f64 {
    if x >= f64::from(degrees) {
        return 1.0 - upper(x, degrees);
    }
    if x == 0.0 {
        return 0.0;
    }
    let (half, y) = (0.5 * f64::from(degrees), 0.5 * x);
    let (mut term, mut sum, mut n) = (1.0, 1.0, half);
    while term > f64::EPSILON * 0.25 * sum {
        n += 1.0;
        term *= y / n;
        sum += term;
    }
    sum * libm::exp(half * libm::log(y) - y - ln_gamma_half(degrees + 2))
}

/// P(χ² > x): e^(−x/2) Σ (x/2)ⁱ/Γ(i+1) over i = 0, 1, … or i = ½, 1½, …, below `degrees`/2.
fn upper(x: f64, degrees: u32) -> f64 {
    if x < f64::from(degrees) {
        return 1.0 - lower(x, degrees);
    }
    if x == f64::INFINITY {
        return 0.0;
    }
    let y = 0.5 * x;
    let odd = degrees % 2 == 1;
    let mut sum = if odd { libm::erfc(y.sqrt()) } else { 0.0 };
    let mut i = if odd { 0.5 } else { 0.0 };
    let mut n = u32::from(odd) + 2;
    while n <= degrees {
        sum += libm::exp(i * libm::log(y) - y - ln_gamma_half(n));
        i += 1.0;
        n += 2;
    }
    sum
}

/// The semi-axes of {y: yᵀΣ⁻¹y = `radius2`}, one a column, longest first, each with its largest entry positive.
/// Jacobi's method (Golub & Van Loan 2013, §8.5): additions, products and roots in a fixed order, so that it is the same
/// everywhere.
pub(super) fn axes<const D: usize>(
    covariance: &SMatrix<f64, D, D>,
    radius2: f64,
) -> SMatrix<f64, D, D> {
    let (mut a, mut v) = (*covariance, SMatrix::<f64, D, D>::identity());
    for _ in 0..MOST_SWEEPS {
        let mut turned = false;
        for p in 0..D {
            for q in p + 1..D {
                let off = a[(p, q)];
                // Against this pair's own variances: millimetres beside metres are resolved too.
                let negligible = off.abs() <= f64::EPSILON * (a[(p, p)] * a[(q, q)]).abs().sqrt();
                if negligible || !off.is_finite() {
                    continue;
                }
                turned = true;
                let tau = (a[(q, q)] - a[(p, p)]) / (2.0 * off);
                let t = tau.signum() / (tau.abs() + (1.0 + tau * tau).sqrt());
                let cos = 1.0 / (1.0 + t * t).sqrt();
                let sin = t * cos;
                for k in 0..D {
                    let (x, y) = (a[(k, p)], a[(k, q)]);
                    a[(k, p)] = cos * x - sin * y;
                    a[(k, q)] = sin * x + cos * y;
                }
                for k in 0..D {
                    let (x, y) = (a[(p, k)], a[(q, k)]);
                    a[(p, k)] = cos * x - sin * y;
                    a[(q, k)] = sin * x + cos * y;
                    let (x, y) = (v[(k, p)], v[(k, q)]);
                    v[(k, p)] = cos * x - sin * y;
                    v[(k, q)] = sin * x + cos * y;
                }
            }
        }
        if !turned {
            break;
        }
    }
    let mut order: [usize; D] = core::array::from_fn(|i| i);
    order.sort_unstable_by(|&i, &j| a[(j, j)].total_cmp(&a[(i, i)]).then(i.cmp(&j)));
    let mut axes = SMatrix::<f64, D, D>::zeros();
    for (to, from) in order.into_iter().enumerate() {
        let axis: SVector<f64, D> = v.column(from).into_owned();
        let largest = axis
            .iter()
            .fold(0.0_f64, |m, x| if x.abs() > m.abs() { *x } else { m });
        let length = (radius2 * a[(from, from)].max(0.0)).sqrt();
        axes.set_column(to, &(axis * if largest < 0.0 { -length } else { length }));
    }
    axes
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};

    use super::*;

    /// p, degrees, quantile: from the integral's power series with 80 digits.
    const QUANTILES: &[(f64, u32, f64)] = &[
        (1e-12, 1, 1.5707963267948966e-24),
        (0.05, 1, 0.003932140000019523),
        (0.5, 1, 0.4549364231195728),
        (0.6827, 1, 1.0000434271174665),
        (0.95, 1, 3.8414588206941245),
        (0.997, 1, 8.80746839351195),
        (0.999999, 1, 23.92812697687947),
        (1e-12, 2, 2.000000000001e-12),
        (0.05, 2, 0.10258658877510107),
        (0.5, 2, 1.3862943611198906),
        (0.6827, 2, 2.295815160785974),
        (0.95, 2, 5.99146454710798),
        (0.997, 2, 11.618285980628054),
        (0.999999, 2, 27.631021115871036),
        (1e-12, 3, 2.4179879427180358e-08),
        (0.05, 3, 0.3518463177492714),
        (0.5, 3, 2.365973884375338),
        (0.6827, 3, 3.526822178865991),
        (0.95, 3, 7.814727903251178),
        (0.997, 3, 13.931422665512082),
        (0.999999, 3, 30.664849706154268),
        (1e-12, 4, 2.8284284580803877e-06),
        (0.05, 4, 0.7107230213973241),
        (0.5, 4, 3.356693980033321),
        (0.6827, 4, 4.719568759116984),
        (0.95, 4, 9.487729036781154),
        (0.997, 4, 16.014326314940618),
        (0.999999, 4, 33.37684158165888),
        (1e-12, 6, 0.0003634406292527489),
        (0.05, 6, 1.6353828943279067),
        (0.5, 6, 5.348120627447121),
        (0.6827, 6, 7.03851549114496),
        (0.95, 6, 12.591587243743977),
        (0.997, 6, 19.804652358849605),
        (0.999999, 6, 38.258336377145845),
        (1e-12, 7, 0.0015031450349627612),
        (0.05, 7, 2.167349909298057),
        (0.5, 7, 6.3458111955215175),
        (0.6827, 7, 8.176359741456094),
        (0.95, 7, 14.067140449340167),
        (0.997, 7, 21.580145393456753),
        (0.999999, 7, 40.52183123411472),
        (1e-12, 40, 4.660083155185234),
        (0.05, 40, 26.50930319669311),
        (0.5, 40, 39.335344846611335),
        (0.6827, 40, 43.69648818094945),
        (0.95, 40, 55.75847927888703),
        (0.997, 40, 68.93974480024212),
        (0.999999, 40, 97.65295741497067),
    ];

    #[test]
    fn quantiles_are_those_of_the_integral() {
        for &(p, degrees, x) in QUANTILES {
            let found = chi_squared_quantile(p, degrees).unwrap();
            assert!(
                (found - x).abs() <= 4e-14 * x,
                "{p} {degrees}: {found:e}, not {x:e}"
            );
        }
    }

    #[test]
    fn share_and_quantile_are_inverse() {
        for degrees in [1, 2, 3, 4, 5, 7, 12, 33, 100, 999] {
            for i in 1..100 {
                let p = f64::from(i) / 100.0;
                let x = chi_squared_quantile(p, degrees).unwrap();
                let back = chi_squared_cdf(x, degrees).unwrap();
                assert!(
                    (back - p).abs() < 1e-13 * f64::from(degrees).max(10.0),
                    "{p} {degrees} {back}"
                );
            }
        }
    }

    #[test]
    fn what_is_no_question_has_no_answer() {
        for p in [-0.1, 1.0, 1.5, f64::NAN, f64::INFINITY] {
            assert_eq!(chi_squared_quantile(p, 3), None);
        }
        assert_eq!(chi_squared_quantile(0.5, 0), None);
        assert_eq!(chi_squared_quantile(0.0, 3), Some(0.0));
        assert_eq!(chi_squared_cdf(-1.0, 3), None);
        assert_eq!(chi_squared_cdf(f64::NAN, 3), None);
        assert_eq!(chi_squared_cdf(1.0, 0), None);
        for degrees in [1, 2, 3, 8] {
            assert_eq!(chi_squared_cdf(0.0, degrees), Some(0.0));
            assert_eq!(chi_squared_cdf(f64::INFINITY, degrees), Some(1.0));
        }
    }

    #[test]
    fn axes_span_the_covariance() {
        // Millimetres beside metres, and one direction that follows from the others.
        let l = Matrix3::new(1.0, 0.0, 0.0, 0.4, 1e-3, 0.0, -0.3, 2e-4, 0.0);
        let covariance = l * l.transpose();
        let axes = axes(&covariance, 4.0);
        let back = axes * axes.transpose() / 4.0;
        assert!((back - covariance).abs().max() < 1e-14, "{back}");
        let length = |i: usize| axes.column(i).norm();
        assert!(length(0) > length(1) && length(1) > length(2));
        assert!(length(2) < 1e-7, "{}", length(2));
        assert!(axes.column(0).dot(&axes.column(1)).abs() < 1e-15);
        assert!(axes.column(0)[0] > 0.0);
    }

    #[test]
    fn axes_of_a_diagonal_are_the_coordinates() {
        let axes = axes(&Matrix3::from_diagonal(&Vector3::new(1.0, 9.0, 4.0)), 1.0);
        assert_eq!(
            axes,
            Matrix3::new(0.0, 0.0, 1.0, 3.0, 0.0, 0.0, 0.0, 2.0, 0.0)
        );
    }
}
