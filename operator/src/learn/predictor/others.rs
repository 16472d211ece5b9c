//! What other people's performances of a motion have to say about this person's.

use nalgebra::{UnitQuaternion, Vector3};
use telemime_protocol::predict::{FEATURES, Model};

use super::rows::{Row, rows_of};
use super::{EM_KNOTS, Places};
use crate::demonstration::Demonstration;

/// An error of this many times the own rows' mean square halves a row's weight, and so does a novelty of
/// the number of features.
const UNLIKE: f64 = 4.0;

/// Rows that count less than this only cost time.
const LEAST_WEIGHT: f64 = 0.01;

/// The rows of `others`, each moved to where the own demonstrations are.
pub(super) fn brought(own: &[Demonstration], others: &[Demonstration], knots: usize) -> Vec<Row> {
    let here = mean(own);
    others
        .iter()
        .map(|d| d.shifted(&(here - mean(std::slice::from_ref(d)))))
        .flat_map(|d| rows_of::<Places>(&d, knots, &UnitQuaternion::identity(), 1.0))
        .collect()
}

/// Weighs others' rows by what a model of the own ones thinks of them:
/// `w = 1/((1 + d²/15)·(1 + e²/(4·ē²)))`, with novelty d², squared error e² of the displacements at the knots that
/// EM sees, each relative to how far own rows move by then, and ē² the mean of that over the `own` rows. People do most of a gesture alike and
/// something each in their own way.
pub(super) fn weigh(model: &Model, own: &[&Row], others: &[Row]) -> Vec<Row> {
    let way = |r: &Row, knot: usize| {
        let at = 3 * (knot.min(model.knots()) - 1);
        Vector3::from_column_slice(&r.targets[at..at + 3])
    };
    let moved_m2 = EM_KNOTS.map(|knot| {
        let all = own.iter().map(|r| way(r, knot).norm_squared());
        all.sum::<f64>() / own.len() as f64 + f64::MIN_POSITIVE
    });
    let judged = |r: &Row| {
        let p = model.posterior_at(&r.features);
        let error = |(&knot, moved_m2): (&usize, &f64)| {
            let e = p.displacement[knot.min(model.knots()) - 1] - way(r, knot);
            e.norm_squared() / moved_m2
        };
        let errors = EM_KNOTS.iter().zip(&moved_m2).map(error);
        (p.novelty, errors.sum::<f64>())
    };
    let usual = own.iter().map(|r| judged(r).1).sum::<f64>() / own.len() as f64;
    others
        .iter()
        .map(|r| {
            let (novelty, error) = judged(r);
            let near = 1.0 + novelty / FEATURES as f64;
            let right = 1.0 + error / (UNLIKE * usual).max(f64::MIN_POSITIVE);
            Row {
                weight: 1.0 / (near * right),
                ..r.clone()
            }
        })
        .filter(|r| r.weight >= LEAST_WEIGHT)
        .collect()
}

/// The mean of all positions, m.
fn mean(demonstrations: &[Demonstration]) -> Vector3<f64> {
    let all = || demonstrations.iter().flat_map(|d| d.samples());
    all().map(|s| s.position).sum::<Vector3<f64>>() / all().count().max(1) as f64
}
