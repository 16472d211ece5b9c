//! The orientation to play: a mixture over time and rotation, on the manifold.
//! Expectation–maximisation as in Zeestraten et al. 2017, §III: every component lives in the tangent
//! space at its own mean orientation, found by Gauss–Newton.

use nalgebra::{Matrix3, Matrix4, UnitQuaternion, Vector3, Vector4};
use telemime_protocol::pose;
use telemime_protocol::skill::{Gmm, TurnMixture};

use super::LearnError;
use super::align::Aligned;
use super::em::{add_outer, mirror};
use super::motion::normal_log_density;
use super::select::bic_of_means;
use crate::demonstration::Demonstration;

/// More rows than this say nothing new about a smooth motion.
const MOST_ROWS: usize = 600;

/// Numbers of components tried; time bins place them, so every one is a fair try.
const LADDER: [usize; 15] = [1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 17, 20, 24, 28];

const MOST_ITERATIONS: usize = 40;

/// Converged when the mean log likelihood changes by less, nats a row.
const CONVERGED: f64 = 1e-4;

/// Added to every variance, as a share of that of all rows.
const RIDGE: f64 = 1e-5;

/// A variance of less than this is a recording without motion: 0.1 mrad.
const LEAST_RAD2: f64 = 1e-8;

/// A component that explains less than this many rows is dropped.
const EMPTY: f64 = 1e-3;

/// An orientation at a time on the common axis, s.
type Row = (f64, UnitQuaternion<f64>);

fn rows(aligned: &Aligned, demonstrations: &[Demonstration]) -> Vec<Row> {
    let total = aligned.paths.len() * aligned.times_s.len();
    let step = total.div_ceil(MOST_ROWS);
    let mut rows = Vec::with_capacity(total / step + demonstrations.len());
    for (n, (d, warp_s)) in demonstrations.iter().zip(&aligned.warps_s).enumerate() {
        let start_s = d.samples()[0].t_s;
        let each = aligned.times_s.iter().zip(warp_s).skip(n % step);
        rows.extend(
            each.step_by(step)
                .filter_map(|(t_s, own_s)| Some((*t_s, d.orientation_at(start_s + own_s)?))),
        );
    }
    rows
}

/// Fits the mixture, its number of components by the BIC of the regression over time, as
/// [`motion::fit`](super::motion::fit) does for positions.
///
/// # Errors
/// [`LearnError::TooFewRows`], [`LearnError::Singular`].
pub fn fit(aligned: &Aligned, demonstrations: &[Demonstration]) -> Result<TurnMixture, LearnError> {
    let rows = rows(aligned, demonstrations);
    if rows.len() < 2 {
        return Err(LearnError::TooFewRows {
            found: rows.len(),
            needed: 2,
        });
    }
    let mut best: Option<(f64, TurnMixture)> = None;
    for k in LADDER.into_iter().filter(|k| 4 * k <= rows.len().max(4)) {
        let Some(mixture) = em(&rows, k) else {
            continue;
        };
        let components = mixture.charts().len();
        let Some(score) = regression_score(&mixture, &rows) else {
            continue;
        };
        let bic = bic_of_means(components, 4, score, rows.len());
        if best.as_ref().is_none_or(|(least, _)| bic < *least) {
            best = Some((bic, mixture));
        }
    }
    best.map(|(_, mixture)| mixture).ok_or(LearnError::Singular)
}

fn em(rows: &[Row], k: usize) -> Option<TurnMixture> {
    let ridge = ridge(rows)?;
    let mut order: Vec<usize> = (0..rows.len()).collect();
    order.sort_by(|&a, &b| rows[a].0.total_cmp(&rows[b].0));
    let mut shares = vec![0.0; rows.len() * k];
    for (rank, row) in order.into_iter().enumerate() {
        shares[row * k + rank * k / rows.len()] = 1.0;
    }
    let mut mixture = maximise(rows, &shares, k, &ridge)?;
    let mut previous = f64::NEG_INFINITY;
    for _ in 0..MOST_ITERATIONS {
        let k = mixture.charts().len();
        let mut likelihood = 0.0;
        for ((t_s, q), shares) in rows.iter().zip(shares.chunks_exact_mut(k)) {
            likelihood += mixture.responsibilities(*t_s, q, shares);
        }
        likelihood /= rows.len() as f64;
        if (likelihood - previous).abs() < CONVERGED {
            break;
        }
        previous = likelihood;
        match maximise(rows, &shares[..rows.len() * k], k, &ridge) {
            Some(next) => mixture = next,
            None => break,
        }
    }
    Some(mixture)
}

/// Refines a mixture that stands for `n` rows no longer at hand: each component keeps those it had, and shares in
/// the new ones. What was known of a component is carried to its new mean by parallel transport.
///
/// # Errors
/// [`LearnError::Singular`].
pub(super) fn update(
    old: &TurnMixture,
    n: f64,
    rows: &[(f64, UnitQuaternion<f64>)],
) -> Result<TurnMixture, LearnError> {
    const STEPS: usize = 6;
    let k = old.charts().len();
    let mut mixture = old.clone();
    let mut shares = vec![0.0; rows.len() * k];
    for _ in 0..STEPS {
        for ((t_s, q), shares) in rows.iter().zip(shares.chunks_exact_mut(k)) {
            mixture.responsibilities(*t_s, q, shares);
        }
        let mut parts = Vec::with_capacity(k);
        let mut charts = Vec::with_capacity(k);
        for (i, (c, before)) in old.gmm().components().iter().zip(old.charts()).enumerate() {
            let own = || shares.iter().skip(i).step_by(k).copied();
            let had = c.weight() * n;
            let total = had + own().sum::<f64>();
            let new_s = own().zip(rows).map(|(r, row)| r * row.0).sum::<f64>();
            let t_s = (had * c.mean()[0] + new_s) / total;
            let new = own().zip(rows.iter().map(|row| row.1));
            let chart = pose::mean(std::iter::once((had, *before)).chain(new));
            let chart = chart.ok_or(LearnError::Singular)?;
            let way = pose::between(before, &chart);
            let mut carry = Matrix4::identity();
            let axes = [Vector3::x(), Vector3::y(), Vector3::z()];
            let turned = Matrix3::from_columns(&axes.map(|v| pose::transported(&v, &way)));
            carry.fixed_view_mut::<3, 3>(1, 1).copy_from(&turned);
            let mut scatter = carry * c.covariance() * carry.transpose() * had;
            let mut add = |t: f64, q: &UnitQuaternion<f64>, r: f64| {
                let v = pose::between(&chart, q);
                add_outer(&mut scatter, &Vector4::new(t - t_s, v.x, v.y, v.z), r);
            };
            add(c.mean()[0], before, had);
            own().zip(rows).for_each(|(r, (t, q))| add(*t, q, r));
            mirror(&mut scatter);
            parts.push((total, Vector4::new(t_s, 0.0, 0.0, 0.0), scatter / total));
            charts.push(chart);
        }
        let all: f64 = parts.iter().map(|p| p.0).sum();
        let gmm = Gmm::new(parts.into_iter().map(|(n, m, c)| (n / all, m, c)))
            .map_err(|_| LearnError::Singular)?;
        mixture = TurnMixture::new(gmm, charts).map_err(|_| LearnError::Singular)?;
    }
    Ok(mixture)
}

/// What every covariance gets on its diagonal: (s², rad², rad², rad²).
fn ridge(rows: &[Row]) -> Option<Vector4<f64>> {
    let n = rows.len() as f64;
    let mean_s = rows.iter().map(|r| r.0).sum::<f64>() / n;
    let time = rows.iter().map(|r| (r.0 - mean_s).powi(2)).sum::<f64>() / n;
    let centre = pose::mean(rows.iter().map(|r| (1.0, r.1)))?;
    let turn = rows
        .iter()
        .map(|r| pose::between(&centre, &r.1).norm_squared())
        .sum::<f64>()
        / (3.0 * n);
    let turn = (RIDGE * turn).max(LEAST_RAD2);
    Some(Vector4::new((RIDGE * time).max(1e-12), turn, turn, turn))
}

fn maximise(rows: &[Row], shares: &[f64], k: usize, ridge: &Vector4<f64>) -> Option<TurnMixture> {
    let mut parts = Vec::with_capacity(k);
    let mut charts = Vec::with_capacity(k);
    for component in 0..k {
        let own = || shares.iter().skip(component).step_by(k).copied();
        let n: f64 = own().sum();
        if n < EMPTY {
            continue;
        }
        let t_s = own().zip(rows).map(|(r, row)| r * row.0).sum::<f64>() / n;
        let chart = pose::mean(own().zip(rows.iter().map(|r| r.1)))?;
        let mut scatter = Matrix4::zeros();
        for (r, (t, q)) in own().zip(rows) {
            if r > 0.0 {
                let v = pose::between(&chart, q);
                add_outer(&mut scatter, &Vector4::new(t - t_s, v.x, v.y, v.z), r);
            }
        }
        mirror(&mut scatter);
        let covariance = scatter / n + Matrix4::from_diagonal(ridge);
        parts.push((n, Vector4::new(t_s, 0.0, 0.0, 0.0), covariance));
        charts.push(chart);
    }
    let total: f64 = parts.iter().map(|p| p.0).sum();
    let gmm = Gmm::new(parts.into_iter().map(|(n, m, c)| (n / total, m, c))).ok()?;
    TurnMixture::new(gmm, charts).ok()
}

/// Mean log density (nats a row) of the orientations under the regression over time; `None` if that is singular.
fn regression_score(mixture: &TurnMixture, rows: &[Row]) -> Option<f64> {
    let mut sum = 0.0;
    for (t_s, q) in rows {
        let at = mixture.query(*t_s);
        sum += normal_log_density(&pose::between(&at.mean, q), &at.covariance)?;
    }
    Some(sum / rows.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demonstration::Sample;
    use crate::learn::align::align;

    /// A wrist that turns by more than half a circle, each performance a little differently.
    fn performance(n: u32) -> Demonstration {
        let own = f64::from(n);
        let samples: Vec<_> = (0..120)
            .map(|i| {
                let u = f64::from(i) / 119.0;
                let u = u + 0.03 * (own - 1.0) * (std::f64::consts::PI * u).sin();
                let turn = Vector3::new(0.2 * own, 4.0 * u, 0.5 * (3.0 * u).sin());
                let q = pose::exp(&turn);
                let q = if n % 2 == 1 {
                    UnitQuaternion::new_unchecked(-q.into_inner())
                } else {
                    q
                };
                Sample {
                    orientation: Some(q),
                    ..Sample::at(
                        f64::from(i) / 30.0 * (1.0 + 0.1 * own),
                        Vector3::new(u, u * u, (5.0 * u).cos()),
                    )
                }
            })
            .collect();
        Demonstration::from_samples(format!("turn {n}"), &samples).unwrap()
    }

    #[test]
    fn a_turn_beyond_half_a_circle_is_learned() {
        let demonstrations: Vec<_> = (0..3).map(performance).collect();
        let aligned = align(&demonstrations).unwrap();
        let mixture = fit(&aligned, &demonstrations).unwrap();
        assert!(mixture.charts().len() > 2);
        let middle = &demonstrations[1];
        let mut worst = 0.0_f64;
        for (t_s, own_s) in aligned.times_s.iter().zip(&aligned.warps_s[1]) {
            let at = mixture.query(*t_s);
            worst = worst.max(at.mean.angle_to(&middle.orientation_at(*own_s).unwrap()));
            assert!(at.covariance.symmetric_eigenvalues().min() > 0.0);
        }
        // The three differ by 0.2 rad about x, and the middle one is the mean.
        assert!(worst < 0.12, "{worst} rad");
    }

    #[test]
    fn an_orientation_that_does_not_change_is_learned_too() {
        let samples: Vec<_> = (0..40)
            .map(|i| Sample {
                orientation: Some(pose::exp(&Vector3::x())),
                ..Sample::at(f64::from(i) * 0.03, Vector3::x() * f64::from(i))
            })
            .collect();
        let still = [Demonstration::from_samples("still", &samples).unwrap()];
        let mixture = fit(&align(&still).unwrap(), &still).unwrap();
        assert!(mixture.query(0.5).mean.angle_to(&pose::exp(&Vector3::x())) < 1e-9);
    }

    #[test]
    fn nothing_to_learn_from_is_said() {
        let samples: Vec<_> = (0..40)
            .map(|i| Sample::at(f64::from(i) * 0.03, Vector3::x() * f64::from(i)))
            .collect();
        let bare = [Demonstration::from_samples("bare", &samples).unwrap()];
        let refused = fit(&align(&bare).unwrap(), &bare);
        assert!(matches!(
            refused,
            Err(LearnError::TooFewRows { found: 0, .. })
        ));
    }
}
