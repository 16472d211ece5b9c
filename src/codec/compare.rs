//! All coders on the same recordings: at the same largest error, at the same bytes, with the same points.

use nalgebra::Vector3;
use rayon::prelude::*;
use serde::Serialize;
use telemime_protocol::checkpoint::Grid;

use super::coders::{self, Coded, Coder, Recording};

/// Halvings of the range of levels in a search.
const HALVINGS: usize = 24;

/// Steps tried for the coders of others, in quarters of the bound, as for our own.
const COARSER: [f64; 4] = [1.0, 2.0, 3.0, 4.0];

/// What one coder made of all recordings.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Row {
    pub(super) coder: Coder,
    /// In how many recordings it got there; the rest of the row is about those.
    pub(super) recordings: usize,
    pub(super) points: usize,
    pub(super) bytes: usize,
    pub(super) bytes_per_s: f64,
    /// The same numbers in whole bytes each.
    pub(super) whole_bytes: usize,
    pub(super) largest_error_m: f64,
    pub(super) rms_error_m: f64,
    /// Of x, y and z, over all samples; none for a coordinate that never changes.
    pub(super) r_squared: [Option<f64>; 3],
}

impl Row {
    fn pooled(coder: Coder, recordings: &[Recording], coded: &[Option<Coded>]) -> Option<Self> {
        let there: Vec<_> = recordings
            .iter()
            .zip(coded)
            .filter_map(|(r, c)| Some((r, c.as_ref()?)))
            .collect();
        if there.is_empty() {
            return None;
        }
        let sum = |of: fn(&Coded) -> usize| there.iter().map(|(_, c)| of(c)).sum();
        let (mut lost, mut all, mut samples) = (Vector3::zeros(), Vector3::<f64>::zeros(), 0);
        for (recording, coded) in &there {
            let mean = recording.x.iter().sum::<Vector3<f64>>() / recording.x.len() as f64;
            for (x, decoded) in recording.x.iter().zip(&coded.decoded) {
                lost += (x - decoded).map(|e: f64| e * e);
                all += (x - mean).map(|e| e * e);
            }
            samples += recording.x.len();
        }
        let bytes: usize = sum(|c| c.bytes);
        let duration_s: f64 = there.iter().map(|(r, _)| r.duration_s()).sum();
        Some(Self {
            coder,
            recordings: there.len(),
            points: sum(|c| c.points),
            bytes,
            bytes_per_s: bytes as f64 / duration_s,
            whole_bytes: sum(|c| c.whole_bytes),
            largest_error_m: there
                .iter()
                .map(|(r, c)| c.largest_m(r))
                .fold(0.0, f64::max),
            rms_error_m: (lost.sum() / samples as f64).sqrt(),
            // A nanometre is rounding, not motion.
            r_squared: [0, 1, 2]
                .map(|d| (all[d] > 1e-18 * samples as f64).then(|| 1.0 - lost[d] / all[d])),
        })
    }
}

/// Every coder with the fewest bytes it takes to stay within `bound_m` at every sample.
///
/// # Errors
/// Ours are refused a bound or a recording.
pub(super) fn at_error(recordings: &[Recording], bound_m: f64) -> anyhow::Result<Vec<Row>> {
    let fine = Grid::for_bound(bound_m)?;
    let mut rows = Vec::new();
    for coder in Coder::ALL {
        let coded = recordings
            .par_iter()
            .map(|r| {
                Ok(match coder {
                    Coder::Batch => Some(coders::batch(r, bound_m)?),
                    Coder::Live => Some(coders::live(r, bound_m)?),
                    _ => cheapest_within(coder, r, bound_m, fine),
                })
            })
            .collect::<anyhow::Result<Vec<_>>>()?;
        rows.extend(Row::pooled(coder, recordings, &coded));
    }
    Ok(rows)
}

/// Every coder's smallest largest error with at most the bytes our plan within `bound_m` takes, recording by
/// recording.
///
/// # Errors
/// As [`at_error`].
pub(super) fn at_bytes(recordings: &[Recording], bound_m: f64) -> anyhow::Result<Vec<Row>> {
    let fine = Grid::for_bound(bound_m)?;
    let ours = recordings
        .par_iter()
        .map(|r| Ok(coders::batch(r, bound_m)?))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let mut rows = Vec::new();
    for coder in Coder::ALL {
        let coded: Vec<_> = recordings
            .par_iter()
            .zip(&ours)
            .map(|(r, ours)| match coder {
                Coder::Batch => Some(ours.clone()),
                Coder::Live => live_with_bytes(r, ours.bytes, bound_m),
                _ => best_with_bytes(coder, r, ours.bytes, fine),
            })
            .collect();
        rows.extend(Row::pooled(coder, recordings, &coded));
    }
    Ok(rows)
}

/// Those coders whose points can be counted out, with so many.
///
/// # Errors
/// Ours is refused the number.
pub(super) fn with_points(recordings: &[Recording], count: usize) -> anyhow::Result<Vec<Row>> {
    let ours = recordings
        .par_iter()
        .map(|r| Ok(coders::counted(r, count)?))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let mut rows = Vec::new();
    for coder in [
        Coder::Batch,
        Coder::Publication,
        Coder::PublicationInTime,
        Coder::Uniform,
        Coder::RamerDouglasPeucker,
    ] {
        let coded: Vec<_> = recordings
            .par_iter()
            .zip(&ours)
            .map(|(r, ours)| match coder {
                Coder::Batch => Some(ours.clone()),
                _ => {
                    // Steps that are no part of the error.
                    let step_m = (0.5 * ours.largest_m(r)).clamp(4e-9, 1.0);
                    let grid = Grid::for_bound(step_m).ok()?;
                    fewest(coder, r, grid, |c| c.points > count).filter(|c| c.points <= count)
                }
            })
            .collect();
        rows.extend(Row::pooled(coder, recordings, &coded));
    }
    Ok(rows)
}

/// The range of a coder's level: from every sample a point to none.
fn levels(coder: Coder, of: &Recording) -> (f64, f64) {
    match coder {
        Coder::Uniform => (1.0, of.t.len() as f64),
        Coder::Publication | Coder::PublicationInTime => (1e-9, 1e9),
        _ => (1e-7, 1e3),
    }
}

/// Bisects the level, on a logarithmic scale, between one where `too_many` holds and one where it does not, and
/// returns the last that does not.
fn fewest(
    coder: Coder,
    of: &Recording,
    grid: Grid,
    too_many: impl Fn(&Coded) -> bool,
) -> Option<Coded> {
    let (mut low, mut high) = levels(coder, of);
    let mut found = None;
    for _ in 0..HALVINGS {
        let middle = (low * high).sqrt();
        match coders::other(coder, of, middle, grid) {
            Some(coded) if !too_many(&coded) => {
                found = Some(coded);
                high = middle;
            }
            _ => low = middle,
        }
    }
    found
}

fn cheapest_within(coder: Coder, of: &Recording, bound_m: f64, fine: Grid) -> Option<Coded> {
    let within = |c: &Coded| c.largest_m(of) <= bound_m;
    let on = |grid| match coder {
        // Their own parameter is the bound.
        Coder::DeadbandHold | Coder::DeadbandLinear => {
            coders::other(coder, of, bound_m, grid).filter(within)
        }
        _ => {
            let (mut low, mut high) = levels(coder, of);
            let mut found = coders::other(coder, of, low, grid).filter(within)?;
            for _ in 0..HALVINGS {
                let middle = (low * high).sqrt();
                match coders::other(coder, of, middle, grid).filter(within) {
                    Some(coded) => {
                        found = coded;
                        low = middle;
                    }
                    None => high = middle,
                }
            }
            Some(found)
        }
    };
    let tried = COARSER
        .iter()
        .filter_map(|c| on(fine.coarser(*c).with_ticks_of(&of.t)));
    tried.min_by_key(|c| c.bytes)
}

fn best_with_bytes(coder: Coder, of: &Recording, bytes: usize, fine: Grid) -> Option<Coded> {
    let tried = COARSER.iter().filter_map(|c| {
        let grid = fine.coarser(*c).with_ticks_of(&of.t);
        fewest(coder, of, grid, |c| c.bytes > bytes)
    });
    tried.min_by(|a, b| a.largest_m(of).total_cmp(&b.largest_m(of)))
}

fn live_with_bytes(of: &Recording, bytes: usize, bound_m: f64) -> Option<Coded> {
    let (mut low, mut high) = (bound_m, bound_m * 64.0);
    let mut found = None;
    for _ in 0..HALVINGS {
        let middle = (low * high).sqrt();
        match coders::live(of, middle).ok().filter(|c| c.bytes <= bytes) {
            Some(coded) => {
                found = Some(coded);
                high = middle;
            }
            None => low = middle,
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn swing() -> Recording {
        let t: Vec<f64> = (0..120).map(|i| f64::from(i) / 60.0).collect();
        let at = |t: &f64| Vector3::new((5.0 * t).sin() * 0.3, (3.0 * t).cos() * 0.2, 0.1);
        Recording {
            x: t.iter().map(at).collect(),
            t,
        }
    }

    #[test]
    fn everyone_keeps_the_bound_and_ours_takes_the_fewest_bytes() {
        let rows = at_error(&[swing()], 0.002).unwrap();
        for row in &rows {
            assert!(row.largest_error_m <= 0.002, "{row:?}");
            assert!(row.bytes >= rows[0].bytes, "{row:?}");
            assert_eq!(row.r_squared[2], None);
        }
        assert_eq!(rows[0].coder, Coder::Batch);
        // Control points are not on the curve: the publication's decoder never gets there.
        assert!(rows.iter().all(|r| r.coder != Coder::Publication));
        assert_eq!(rows.len(), Coder::ALL.len() - 1);
    }

    #[test]
    fn with_the_same_bytes_the_others_are_further_off() {
        let rows = at_bytes(&[swing()], 0.002).unwrap();
        for row in &rows {
            assert!(row.bytes <= rows[0].bytes, "{row:?}");
            assert!(row.largest_error_m >= rows[0].largest_error_m, "{row:?}");
        }
        let rows = with_points(&[swing()], 14).unwrap();
        assert!(rows.iter().all(|r| r.points <= 14));
        assert!(rows.iter().all(|r| r.rms_error_m >= rows[0].rms_error_m));
    }
}
