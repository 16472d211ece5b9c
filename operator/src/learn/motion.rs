//! The motion to play: a mixture over time and position, of the aligned demonstrations.

use nalgebra::{SMatrix, SVector, Vector3, Vector4};
use telemime_protocol::skill::{Gmm, Gmr};

use super::align::Aligned;
use super::em::{self, Degenerate, EmOptions, Fit};
use super::select::{Candidate, bic_of_means};
use super::{LearnError, LearnOptions, Progress};

/// More rows than this say nothing new about a smooth motion.
const MOST_ROWS: usize = 2000;

/// Numbers of components tried: every small one, then ever larger steps. A motion that goes to and fro
/// needs a component or two per turn, and any number well below that is worse than one for the whole:
/// the criterion has a barrier, so the search does not stop at the first candidates that are worse.
const LADDER: [usize; 20] = [
    1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 17, 20, 24, 28, 33, 39, 46, 54, 64,
];

/// Rows (t s, x m, y m, z m) of each demonstration, evenly thinned to about 2000 in all.
pub fn rows(aligned: &Aligned) -> Vec<Vec<Vector4<f64>>> {
    let total = aligned.paths.len() * aligned.times_s.len();
    let step = total.div_ceil(MOST_ROWS);
    let each = |(n, path): (usize, &Vec<Vector3<f64>>)| {
        // Offset from one to the next, so that together they cover every moment.
        let samples = aligned
            .times_s
            .iter()
            .zip(path)
            .skip(n % step)
            .step_by(step);
        samples
            .map(|(t_s, p)| Vector4::new(*t_s, p.x, p.y, p.z))
            .collect()
    };
    aligned.paths.iter().enumerate().map(each).collect()
}

/// Rows (t s, x m, y m, z m) half-way from each aligned sample to the next, which no fit has seen.
fn between(aligned: &Aligned) -> Vec<Vector4<f64>> {
    let halves = |path: &Vec<Vector3<f64>>| -> Vec<Vector4<f64>> {
        let times = aligned.times_s.windows(2);
        times
            .zip(path.windows(2))
            .map(|(t, p)| {
                let at = (p[0] + p[1]) * 0.5;
                Vector4::new((t[0] + t[1]) * 0.5, at.x, at.y, at.z)
            })
            .collect()
    };
    aligned.paths.iter().flat_map(halves).collect()
}

/// Fits the mixture over (t s, x m, y m, z m), its number of components by BIC.
///
/// The criterion judges what the mixture is for: the likelihood is that of the *regression*, a normal
/// position at each time. By the joint likelihood a motion to and fro is best told as places the hand
/// keeps returning to, and its regression over time is one long average. For the same reason both starts
/// (time bins, k-means++) compete by this criterion, and covariances are not counted ([`bic_of_means`]).
/// A mixture that learned samples by heart is taken only where there is no other; and of the likelihoods at the samples and
/// half-way between them the lesser counts, since where demonstrations meet (all of them in one goal) components of a moment
/// or two tell every sample and jump in between.
///
/// # Errors
/// [`LearnError`], as of the fit.
pub fn fit(
    aligned: &Aligned,
    options: &LearnOptions,
    progress: &mut impl FnMut(Progress),
) -> Result<Gmm<4>, LearnError> {
    let rows = rows(aligned).concat();
    let between = between(aligned);
    let mut best: Result<(Rank, Fit<4>), LearnError> = Err(LearnError::Components { asked: 0 });
    for components in LADDER
        .into_iter()
        .filter(|k| options.motion_components.contains(k))
    {
        for time_bins in [true, false] {
            let em = EmOptions {
                components,
                max_iterations: 60,
                restarts: usize::from(!time_bins),
                time_bins,
                seed: options.seed,
                ..EmOptions::default()
            };
            let judged = em::fit(&rows, &em).and_then(|fit| {
                let score = regression_score::<4, 3>(&fit.gmm, &rows)?;
                let halfway = regression_score::<4, 3>(&fit.gmm, &between)?;
                Ok((score.min(halfway), fit))
            });
            match judged {
                Ok((score, fit)) => {
                    let bic = bic_of_means(components, 4, score, rows.len());
                    progress(Progress::Candidate(Candidate {
                        components,
                        bic,
                        score,
                    }));
                    let rank = (memorises(&fit), bic);
                    if best.as_ref().map_or(true, |(least, _)| rank < *least) {
                        best = Ok((rank, fit));
                    }
                }
                Err(e) => best = best.or(Err(e)),
            }
        }
    }
    let (_, best) = best?;
    progress(Progress::Motion {
        components: best.gmm.components().len(),
        score: best.score,
        degenerate: best.degenerate,
    });
    Ok(best.gmm)
}

/// Whether the mixture learned samples by heart, and its criterion: the smallest is best.
type Rank = (bool, f64);

/// Whether more than a quarter of the components stand for fewer samples than span a covariance, or for a single moment.
/// Such a mixture explains every row and jumps from one to the next: the criterion, which looks at the rows alone, would
/// have nothing against it.
fn memorises(fit: &Fit<4>) -> bool {
    let of_few = |d: &&Degenerate| matches!(d, Degenerate::Shrunk { .. });
    let few = fit.degenerate.iter().filter(of_few).count();
    let of_a_moment = |d: &Degenerate| match *d {
        Degenerate::Floored {
            axis: 0,
            components,
        } => components,
        _ => 0,
    };
    let moments: usize = fit.degenerate.iter().map(of_a_moment).sum();
    4 * few.max(moments) > fit.gmm.components().len()
}

/// Mean log density (nats a row) of all coordinates but the first under their regression over it.
pub(super) fn regression_score<const D: usize, const O: usize>(
    gmm: &Gmm<D>,
    rows: &[SVector<f64, D>],
) -> Result<f64, LearnError> {
    let gmr = Gmr::<1, O>::new(gmm).map_err(|_| LearnError::Singular)?;
    let mut sum = 0.0;
    for row in rows {
        let at = gmr.query(&SVector::from([row[0]]));
        let error = row.fixed_rows::<O>(1) - at.mean;
        sum += normal_log_density(&error, &at.covariance).ok_or(LearnError::Singular)?;
    }
    Ok(sum / rows.len() as f64)
}

/// ln N(error; 0, covariance), or `None` if the covariance is singular.
pub(super) fn normal_log_density<const O: usize>(
    error: &SVector<f64, O>,
    covariance: &SMatrix<f64, O, O>,
) -> Option<f64> {
    let factor = covariance.cholesky()?;
    let distance2 = error.dot(&factor.solve(error));
    let log_det: f64 = (0..O).map(|d| factor.l_dirty()[(d, d)].ln()).sum();
    Some(-0.5 * distance2 - log_det - 0.5 * O as f64 * std::f64::consts::TAU.ln())
}
