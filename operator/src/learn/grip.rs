//! The gripper to play: a mixture over time and opening.

use nalgebra::Vector2;
use telemime_protocol::skill::Gmm;

use super::LearnError;
use super::align::Aligned;
use super::em::{self, EmOptions};
use super::motion::regression_score;
use super::select::bic_of_means;
use crate::demonstration::Demonstration;

/// Numbers of components tried: a gripper opens and closes a few times.
const LADDER: [usize; 9] = [1, 2, 3, 4, 6, 8, 12, 16, 24];

/// Fits the mixture over (t s, opening), by the BIC of its regression over time.
///
/// # Errors
/// [`LearnError`], as of the fit.
pub fn fit(
    aligned: &Aligned,
    demonstrations: &[Demonstration],
    seed: u64,
) -> Result<Gmm<2>, LearnError> {
    let mut rows = Vec::new();
    for (d, warp_s) in demonstrations.iter().zip(&aligned.warps_s) {
        let start_s = d.samples()[0].t_s;
        for (t_s, own_s) in aligned.times_s.iter().zip(warp_s) {
            rows.extend(
                d.grip_at(start_s + own_s)
                    .map(|grip| Vector2::new(*t_s, grip)),
            );
        }
    }
    let mut best: Option<(f64, Gmm<2>)> = None;
    let mut failed = LearnError::Singular;
    for components in LADDER {
        let options = EmOptions {
            components,
            max_iterations: 60,
            restarts: 0,
            time_bins: true,
            seed,
            ..EmOptions::default()
        };
        let judged = em::fit(&rows, &options)
            .and_then(|fit| Ok((regression_score::<2, 1>(&fit.gmm, &rows)?, fit.gmm)));
        match judged {
            Ok((score, gmm)) => {
                let bic = bic_of_means(gmm.components().len(), 2, score, rows.len());
                if best.as_ref().is_none_or(|(least, _)| bic < *least) {
                    best = Some((bic, gmm));
                }
            }
            Err(e) => failed = e,
        }
    }
    best.map(|(_, gmm)| gmm).ok_or(failed)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use telemime_protocol::skill::Gmr;

    use super::*;
    use crate::demonstration::Sample;
    use crate::learn::align::align;

    #[test]
    fn a_grip_closes_when_it_was_closed() {
        let demonstrations: Vec<_> = (0..3)
            .map(|n| {
                let samples: Vec<_> = (0..90)
                    .map(|i| {
                        let u = f64::from(i) / 89.0;
                        Sample {
                            grip: Some(if u < 0.4 { 1.0 } else { 0.1 }),
                            ..Sample::at(
                                f64::from(i) * (0.03 + 0.002 * f64::from(n)),
                                Vector3::new(u, (4.0 * u).sin(), 0.0),
                            )
                        }
                    })
                    .collect();
                Demonstration::from_samples(format!("grip {n}"), &samples).unwrap()
            })
            .collect();
        let aligned = align(&demonstrations).unwrap();
        let gmm = fit(&aligned, &demonstrations, 0).unwrap();
        let gmr = Gmr::<1, 1>::new(&gmm).unwrap();
        let at = |u: f64| gmr.query(&[u * aligned.duration_s].into()).mean[0];
        assert!(
            at(0.2) > 0.9 && at(0.7) < 0.2 && at(1.0) < 0.2,
            "{} {}",
            at(0.2),
            at(0.7)
        );
    }
}
