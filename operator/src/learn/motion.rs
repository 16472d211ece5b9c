//! The motion to play: a mixture over time and position, of the aligned demonstrations.

use nalgebra::Vector4;
use telemime_protocol::skill::Gmm;

use super::align::Aligned;
use super::em::EmOptions;
use super::select::select;
use super::{LearnError, LearnOptions, Progress};

/// More rows than this say nothing new about a smooth motion.
const MOST_ROWS: usize = 2000;

/// Candidates in a row that may be worse before the search for K ends.
const PATIENCE: usize = 3;

/// Rows (t s, x m, y m, z m), demonstration by demonstration, evenly thinned to about [`MOST_ROWS`].
fn rows(aligned: &Aligned) -> Vec<Vector4<f64>> {
    let total = aligned.paths.len() * aligned.times_s.len();
    let step = total.div_ceil(MOST_ROWS);
    let mut rows = Vec::with_capacity(total / step + aligned.paths.len());
    for (n, path) in aligned.paths.iter().enumerate() {
        // Offset from one to the next, so that together they cover every moment.
        let each = aligned
            .times_s
            .iter()
            .zip(path)
            .skip(n % step)
            .step_by(step);
        rows.extend(each.map(|(t_s, p)| Vector4::new(*t_s, p.x, p.y, p.z)));
    }
    rows
}

/// Fits the mixture over (t s, x m, y m, z m), its number of components by BIC.
///
/// # Errors
/// [`LearnError`], as of the fit.
pub fn fit(
    aligned: &Aligned,
    options: &LearnOptions,
    progress: &mut impl FnMut(Progress),
) -> Result<Gmm<4>, LearnError> {
    let rows = rows(aligned);
    let em = EmOptions {
        restarts: 1,
        seed: options.seed,
        ..EmOptions::default()
    };
    let selection = select(
        &rows,
        options.motion_components.clone(),
        PATIENCE,
        &em,
        |candidate| progress(Progress::Candidate(candidate)),
    )?;
    let best = selection.best;
    progress(Progress::Motion {
        components: best.gmm.components().len(),
        score: best.score,
        degenerate: best.degenerate,
    });
    Ok(best.gmm)
}
