//! What a predictor is trained on, row by row.

use nalgebra::{SVector, UnitQuaternion};
use telemime_protocol::pose;
use telemime_protocol::predict::{BENT, FEATURES, Standardisation, TARGETS};

use super::{Character, Course};
use crate::demonstration::Demonstration;

/// Rows nearer in time than this are thinned: a sensor of 200 Hz says nothing more about a hand than
/// one of 30, all of whose samples are kept unless they jitter by 8 ms.
const LEAST_SPACING_S: f64 = 1.0 / 40.0;

/// The paces at which a demonstration is shown once more each: people differ by as much from one performance to the next.
const PACES: [f64; 2] = [0.87, 1.15];

/// Features and displacements of one moment.
#[derive(Clone)]
pub(in crate::learn) struct Row {
    /// m, or rad.
    pub(super) features: SVector<f64, FEATURES>,
    pub(super) targets: [f64; TARGETS],
    /// Of the hand, where it is what is predicted.
    pub(super) orientation: UnitQuaternion<f64>,
    /// How often the row counts.
    pub(super) weight: f64,
}

/// The rows of each demonstration, with those of its copies at other paces.
pub(super) fn rows<C: Course>(
    demonstrations: &[Demonstration],
    knots: usize,
    copies: f64,
) -> Vec<Vec<Row>> {
    // Where orientation is not what is predicted, this is the mean of nothing.
    let orientations = demonstrations
        .iter()
        .flat_map(|d| d.samples().iter().filter_map(|s| s.orientation))
        .map(|q| (1.0, q));
    let chart = pose::mean(orientations).unwrap_or_default();
    demonstrations
        .iter()
        .map(|d| with_copies::<C>(d, knots, &chart, copies))
        .collect()
}

/// A demonstration's rows, and if `copies` > 0 with that weight those of it at other paces.
pub(super) fn with_copies<C: Course>(
    d: &Demonstration,
    knots: usize,
    chart: &UnitQuaternion<f64>,
    copies: f64,
) -> Vec<Row> {
    let mut rows = rows_of::<C>(d, knots, chart, 1.0);
    if copies > 0.0 {
        for pace in PACES {
            rows.extend(rows_of::<C>(&d.paced(pace), knots, chart, copies));
        }
    }
    rows
}

/// How many rows a demonstration counts for, its copies included.
pub(in crate::learn) fn row_count(d: &Demonstration, copies: f64) -> f64 {
    let count = |d: &Demonstration| {
        let mut last_s = f64::NEG_INFINITY;
        let times = d.samples().iter().map(|s| s.t_s);
        times.filter(|t_s| kept(*t_s, &mut last_s)).count() as f64
    };
    let copied = PACES.map(|pace| count(&d.paced(pace)));
    count(d) + copies * copied.iter().sum::<f64>()
}

/// Whether a sample at `t_s` is far enough from the last one kept.
fn kept(t_s: f64, last_s: &mut f64) -> bool {
    let far = t_s - *last_s >= LEAST_SPACING_S;
    if far {
        *last_s = t_s;
    }
    far
}

pub(super) fn rows_of<C: Course>(
    d: &Demonstration,
    knots: usize,
    chart: &UnitQuaternion<f64>,
    weight: f64,
) -> Vec<Row> {
    let mut last_s = f64::NEG_INFINITY;
    let mut rows = Vec::with_capacity(d.samples().len());
    for (i, state) in C::states(d).iter().enumerate() {
        let t_s = d.samples()[i].t_s;
        if !kept(t_s, &mut last_s) {
            continue;
        }
        let mut targets = [0.0; TARGETS];
        for (j, y) in targets.chunks_exact_mut(3).take(knots).enumerate() {
            y.copy_from_slice(C::displacement(d, i, j + 1).as_slice());
        }
        let (features, orientation) = C::row(state, chart);
        rows.push(Row {
            features,
            targets,
            orientation,
            weight,
        });
    }
    rows
}

/// Means, and one scale for each 3-vector.
pub(super) struct Scaling {
    pub(super) features: Standardisation,
    pub(super) target_mean: [f64; TARGETS],
    pub(super) target_scale: [f64; TARGETS],
}

impl Scaling {
    pub(super) fn of(rows: &[&Row], character: &Character) -> Self {
        let total: f64 = rows.iter().map(|r| r.weight).sum();
        let weighted = || rows.iter().map(|r| (r.weight / total, *r));
        let (_, raw) = moments(weighted().map(|(w, r)| (w, r.features)));
        let mut features = Standardisation {
            mean: SVector::zeros(),
            scale: SVector::zeros(),
            bend: std::array::from_fn::<f64, BENT, _>(|i| character.bend * raw[3 * (i + 1)]),
            ridge: character.ridge,
            shrinkage: character.shrinkage,
        };
        (features.mean, features.scale) =
            moments(weighted().map(|(w, r)| (w, features.bent(r.features))));
        let (target_mean, target_scale) =
            moments(weighted().map(|(w, r)| (w, SVector::<f64, TARGETS>::from(r.targets))));
        Self {
            features,
            target_mean: target_mean.into(),
            target_scale: target_scale.into(),
        }
    }

    /// A row in these units.
    pub(super) fn row(&self, r: &Row) -> Row {
        let mut targets = r.targets;
        let units = self.target_mean.iter().zip(&self.target_scale);
        for (y, (m, s)) in targets.iter_mut().zip(units) {
            *y = (*y - m) / s;
        }
        Row {
            features: self.features.scaled(&self.features.bent(r.features)),
            targets,
            orientation: r.orientation,
            weight: r.weight,
        }
    }
}

/// Mean and deviation of rows whose weights sum to one; the deviation is that of its 3-vector along one axis.
fn moments<const D: usize>(
    rows: impl Iterator<Item = (f64, SVector<f64, D>)> + Clone,
) -> (SVector<f64, D>, SVector<f64, D>) {
    let mut mean = SVector::<f64, D>::zeros();
    for (w, x) in rows.clone() {
        mean += x * w;
    }
    let mut variance = SVector::<f64, D>::zeros();
    for (w, x) in rows {
        let d = x - mean;
        variance += d.component_mul(&d) * w;
    }
    let scale = SVector::from_fn(|i, _| {
        let at = i / 3 * 3;
        (variance.rows(at, 3).sum() / 3.0).sqrt() + 1e-9
    });
    (mean, scale)
}
