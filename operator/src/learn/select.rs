//! The number of components, by the Bayesian information criterion (Schwarz 1978).

use nalgebra::SVector;

use super::LearnError;
use super::em::{self, EmOptions, Fit};

/// One number of components that was tried.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// Components asked for.
    pub components: usize,
    /// −2·ln L + p·ln N; the smallest is best.
    pub bic: f64,
    /// Mean log likelihood, nats a sample, in the data's units.
    pub score: f64,
}

/// The best fit, and all that were compared.
#[derive(Debug, Clone, PartialEq)]
pub struct Selection<const D: usize> {
    /// The fit of smallest criterion.
    pub best: Fit<D>,
    /// Every candidate, by number of components.
    pub table: Vec<Candidate>,
}

/// `−2·score·N + p·ln N` with `p = K−1 + K·D + K·D(D+1)/2`.
pub fn bic(components: usize, dimensions: usize, score: f64, rows: usize) -> f64 {
    let (k, d, n) = (components as f64, dimensions as f64, rows as f64);
    let parameters = k - 1.0 + k * d + k * d * (d + 1.0) / 2.0;
    -2.0 * score * n + parameters * n.ln()
}

/// [`bic`] that counts weights and means only, `p = K−1 + K·D`.
///
/// Covariances of neighbouring components describe the same spread over and over; counted in full they
/// outweigh everything a motion that goes to and fro has to tell, and what is left is its average.
pub fn bic_of_means(components: usize, dimensions: usize, score: f64, rows: usize) -> f64 {
    let (k, d, n) = (components as f64, dimensions as f64, rows as f64);
    -2.0 * score * n + (k - 1.0 + k * d) * n.ln()
}

/// Fits every number of components in `candidates` and keeps the one of smallest criterion.
///
/// Stops early when `patience` candidates in a row were worse than the best so far; numbers that the
/// rows cannot support are left out. `options.components` does not apply.
///
/// # Errors
/// As [`em::fit`], if no candidate could be fitted.
pub fn select<const D: usize>(
    data: &[SVector<f64, D>],
    candidates: impl IntoIterator<Item = usize>,
    patience: usize,
    options: &EmOptions,
    mut progress: impl FnMut(Candidate),
) -> Result<Selection<D>, LearnError> {
    let mut table: Vec<Candidate> = Vec::new();
    let mut best: Result<(f64, Fit<D>), LearnError> = Err(LearnError::Components { asked: 0 });
    let mut worse = 0;
    for components in candidates {
        let fit = em::fit(
            data,
            &EmOptions {
                components,
                ..options.clone()
            },
        );
        let fit = match fit {
            Ok(fit) => fit,
            Err(e) => {
                if best.is_err() {
                    best = Err(e);
                }
                continue;
            }
        };
        let candidate = Candidate {
            components,
            bic: bic(components, D, fit.score, data.len()),
            score: fit.score,
        };
        progress(candidate);
        table.push(candidate);
        if best
            .as_ref()
            .is_ok_and(|(least, _)| *least <= candidate.bic)
        {
            worse += 1;
            if worse == patience {
                break;
            }
        } else {
            best = Ok((candidate.bic, fit));
            worse = 0;
        }
    }
    best.map(|(_, best)| Selection { best, table })
}
