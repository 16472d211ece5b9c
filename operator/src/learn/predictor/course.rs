//! What a predictor is trained on: where the hand was, or how it was turned.

use std::borrow::Cow;

use nalgebra::{SVector, UnitQuaternion, Vector3};
use telemime_protocol::pose;
use telemime_protocol::predict::{
    Calibration, Experts, FEATURES, Forecast, Generic, HandState, KNOT_SPACING_S, Model,
    ModelError, Posterior, Regression, Standardisation, TurnForecast, TurnModel, TurnState,
};
use telemime_protocol::time::Stamp;

use super::Row;
use crate::demonstration::Demonstration;

/// A trained predictor but for its calibration.
pub(in crate::learn) struct Fitted {
    pub(super) knots: usize,
    pub(super) standardisation: Standardisation,
    pub(super) components: Vec<Regression>,
    /// Where each component takes its absolute feature about, if it does.
    pub(super) charts: Vec<UnitQuaternion<f64>>,
    pub(super) generic: Generic,
}

/// A side of a demonstration that can be predicted: displacements are vectors, whatever the space.
pub(in crate::learn) trait Course {
    /// All that a prediction starts from.
    type State;
    /// What predicts.
    type Model;

    /// The states of a demonstration, sample by sample.
    fn states(d: &Demonstration) -> Vec<Self::State>;

    /// The displacement (m, rad) from sample `i` to knot `j`, from 1; past the end of the recording nothing moves.
    fn displacement(d: &Demonstration, i: usize, j: usize) -> Vector3<f64>;

    /// The features of a state about the common `chart`, and the orientation they are of, if any.
    fn row(
        state: &Self::State,
        chart: &UnitQuaternion<f64>,
    ) -> (SVector<f64, FEATURES>, UnitQuaternion<f64>);

    /// One chart for each component, from its responsibilities; none where the space needs none.
    fn charts(rows: &[Row], shares: &[f64], stride: usize) -> Vec<UnitQuaternion<f64>>;

    /// The standardised rows as a component with this chart sees them.
    fn seen<'a>(rows: &'a [Row], chart: Option<&UnitQuaternion<f64>>, scale: f64)
    -> Cow<'a, [Row]>;

    /// What each expert says; without a model only those that need none.
    fn experts(model: Option<&Self::Model>, state: &Self::State) -> Experts;

    /// The mixture's answer.
    fn posterior(model: &Self::Model, state: &Self::State) -> Posterior;

    /// A model's mixture, and the charts of its components where the space needs them.
    fn parts(model: &Self::Model) -> (&Model, &[UnitQuaternion<f64>]);

    /// The model of these parts.
    fn model(fitted: &Fitted, calibration: Calibration) -> Result<Self::Model, ModelError>;
}

fn model(fitted: &Fitted, calibration: Calibration) -> Result<Model, ModelError> {
    Model::new(
        fitted.knots,
        fitted.standardisation.clone(),
        fitted.components.clone(),
        fitted.generic,
        calibration,
    )
}

/// Positions.
pub(in crate::learn) struct Places;

impl Course for Places {
    type State = HandState;
    type Model = Model;

    fn states(d: &Demonstration) -> Vec<HandState> {
        super::states(d).collect()
    }

    fn displacement(d: &Demonstration, i: usize, j: usize) -> Vector3<f64> {
        let s = &d.samples()[i];
        d.position_at(s.t_s + j as f64 * KNOT_SPACING_S) - s.position
    }

    fn row(
        state: &HandState,
        chart: &UnitQuaternion<f64>,
    ) -> (SVector<f64, FEATURES>, UnitQuaternion<f64>) {
        (state.features(), *chart)
    }

    fn charts(_: &[Row], _: &[f64], _: usize) -> Vec<UnitQuaternion<f64>> {
        Vec::new()
    }

    fn seen<'a>(rows: &'a [Row], _: Option<&UnitQuaternion<f64>>, _: f64) -> Cow<'a, [Row]> {
        Cow::Borrowed(rows)
    }

    fn experts(model: Option<&Model>, state: &HandState) -> Experts {
        Forecast::experts(state, model)
    }

    fn posterior(model: &Model, state: &HandState) -> Posterior {
        model.posterior(state)
    }

    fn parts(model: &Model) -> (&Model, &[UnitQuaternion<f64>]) {
        (model, &[])
    }

    fn model(fitted: &Fitted, calibration: Calibration) -> Result<Model, ModelError> {
        model(fitted, calibration)
    }
}

/// Orientations. EM sees the absolute feature about the common mean; what it finds is then described about
/// each component's own, where the cut of the logarithm does no harm.
pub(in crate::learn) struct Turns;

impl Course for Turns {
    type State = TurnState;
    type Model = TurnModel;

    /// None if a sample has no orientation.
    fn states(d: &Demonstration) -> Vec<TurnState> {
        let mut state: Option<TurnState> = None;
        let next = |s: &crate::demonstration::Sample| {
            let (t, q) = (Stamp::from_secs_f64(s.t_s), s.orientation?);
            Some(match &mut state {
                Some(state) => {
                    state.advance(t, q);
                    *state
                }
                None => *state.insert(TurnState::first(t, q)),
            })
        };
        d.samples()
            .iter()
            .map(next)
            .collect::<Option<_>>()
            .unwrap_or_default()
    }

    fn displacement(d: &Demonstration, i: usize, j: usize) -> Vector3<f64> {
        let s = &d.samples()[i];
        let later = d.orientation_at(s.t_s + j as f64 * KNOT_SPACING_S);
        match (s.orientation, later) {
            (Some(q), Some(later)) => pose::between(&q, &later),
            _ => Vector3::zeros(),
        }
    }

    fn row(
        state: &TurnState,
        chart: &UnitQuaternion<f64>,
    ) -> (SVector<f64, FEATURES>, UnitQuaternion<f64>) {
        (state.features(chart), state.q)
    }

    fn charts(rows: &[Row], shares: &[f64], stride: usize) -> Vec<UnitQuaternion<f64>> {
        let mean = |k: usize| {
            let shares = shares.iter().skip(k).step_by(stride);
            pose::mean(shares.copied().zip(rows.iter().map(|r| r.orientation)))
        };
        (0..stride).map(|k| mean(k).unwrap_or_default()).collect()
    }

    fn seen<'a>(
        rows: &'a [Row],
        chart: Option<&UnitQuaternion<f64>>,
        scale: f64,
    ) -> Cow<'a, [Row]> {
        let Some(chart) = chart else {
            return Cow::Borrowed(rows);
        };
        let about = |row: &Row| {
            let mut row = row.clone();
            let absolute = pose::between(chart, &row.orientation) / scale;
            row.features.fixed_rows_mut::<3>(0).copy_from(&absolute);
            row
        };
        Cow::Owned(rows.iter().map(about).collect())
    }

    fn experts(model: Option<&TurnModel>, state: &TurnState) -> Experts {
        TurnForecast::experts(state, model)
    }

    fn posterior(model: &TurnModel, state: &TurnState) -> Posterior {
        model.posterior(state)
    }

    fn parts(model: &TurnModel) -> (&Model, &[UnitQuaternion<f64>]) {
        (model.model(), model.charts())
    }

    fn model(fitted: &Fitted, calibration: Calibration) -> Result<TurnModel, ModelError> {
        TurnModel::new(model(fitted, calibration)?, fitted.charts.clone())
    }
}
