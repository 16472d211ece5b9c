//! Which mixture tells a motion best: kinds and numbers of components, judged by several criteria.
//!
//! All rows of the table are densities of the same samples (t, x, y, z), so that any two can be compared.
//! A mixture for each dimension over (t, x_d) has three marginals of time; its density is taken as
//! `Π p_d(x_d | t)` times their geometric mean, which integrates to at most one.

mod model;

use std::fmt;
use std::ops::RangeInclusive;

use nalgebra::{Vector3, Vector4};
use rayon::prelude::*;
use serde::Serialize;

use super::LearnError;
use super::em::Covariance;
use super::em::units::Units;
use model::Model;

/// Most demonstrations that are left out in turn.
const FOLDS: usize = 6;

/// What a row of the table fits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Family {
    /// One mixture over (t, x, y, z).
    Joint,
    /// One mixture over (t, x_d) for each dimension d, as the publication's text has it.
    PerDimension,
}

/// How it is fitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// Expectation–maximisation.
    Em,
    /// Variational, a Dirichlet distribution on the weights.
    Dirichlet,
    /// Variational, a Dirichlet process on the weights.
    Process,
}

/// A kind of mixture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Kind {
    /// Over what.
    pub family: Family,
    /// How it is fitted.
    pub method: Method,
    /// What its covariances may differ in; variational ones are full.
    pub covariance: Covariance,
}

impl Kind {
    /// All kinds of the table, in its order.
    pub fn all() -> Vec<Self> {
        let mut all = Vec::new();
        for family in [Family::Joint, Family::PerDimension] {
            let kind = |method, covariance| Self {
                family,
                method,
                covariance,
            };
            all.extend(Covariance::ALL.map(|covariance| kind(Method::Em, covariance)));
            all.push(kind(Method::Dirichlet, Covariance::Full));
            all.push(kind(Method::Process, Covariance::Full));
        }
        all
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let family = match self.family {
            Family::Joint => "joint",
            Family::PerDimension => "per dimension",
        };
        let method = match self.method {
            Method::Em => "EM",
            Method::Dirichlet => "variational, Dirichlet",
            Method::Process => "variational, process",
        };
        f.pad(&format!("{family}, {}, {method}", self.covariance))
    }
}

/// One kind with one number of components.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// What was fitted.
    #[serde(flatten)]
    pub kind: Kind,
    /// Components asked for; for each dimension, where there are three mixtures.
    pub components: usize,
    /// Components that explain at least one sample, of all mixtures of the row.
    pub effective: usize,
    /// Free numbers of those.
    pub parameters: usize,
    /// Mean log density, nats a sample (s, m).
    pub score: f64,
    /// −2·ln L + p·ln N; the lowest is best.
    pub bic: f64,
    /// −2·ln L + 2·p; the lowest is best.
    pub aic: f64,
    /// Mean log density of demonstrations left out in turn, nats a sample; `None` with a single one.
    pub held_out: Option<f64>,
    /// The criterion by which a motion's mixture is chosen ([`super::motion::fit`]): BIC of the regression's
    /// likelihood, weights and means counted; the lowest is best.
    pub regression: f64,
    /// Root mean square distance of the regression to the true function, m, where that is known.
    pub rmse_m: Option<f64>,
    /// What the data could not say, in words.
    pub degenerate: Vec<String>,
}

/// A column of the table that chooses a row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Criterion {
    /// Bayesian information criterion.
    Bic,
    /// Akaike's.
    Aic,
    /// Likelihood of demonstrations left out.
    HeldOut,
    /// The rule for motions.
    Regression,
}

impl Criterion {
    /// All of them, in the order of the columns.
    pub const ALL: [Self; 4] = [Self::Bic, Self::Aic, Self::HeldOut, Self::Regression];

    /// The row's value; the lowest is best.
    fn cost(self, row: &Row) -> f64 {
        match self {
            Self::Bic => row.bic,
            Self::Aic => row.aic,
            Self::HeldOut => row.held_out.map_or(f64::INFINITY, |v| -v),
            Self::Regression => row.regression,
        }
    }
}

/// Every kind with every number of components that could be fitted.
#[derive(Debug, Clone, Serialize)]
pub struct Table {
    /// Demonstrations.
    pub demonstrations: usize,
    /// Samples of all of them.
    pub samples: usize,
    /// By kind, then by number of components.
    pub rows: Vec<Row>,
}

impl Table {
    /// The row of a kind (or of all) that a criterion prefers; the smallest number of components of equals.
    pub fn best(&self, criterion: Criterion, kind: Option<Kind>) -> Option<&Row> {
        self.rows
            .iter()
            .filter(|row| kind.is_none_or(|kind| row.kind == kind))
            .filter(|row| criterion.cost(row).is_finite())
            .min_by(|a, b| criterion.cost(a).total_cmp(&criterion.cost(b)))
    }
}

/// What to compare.
#[derive(Debug, Clone)]
pub struct CompareOptions<'a> {
    /// Numbers of components.
    pub components: RangeInclusive<usize>,
    /// Seed of every random choice.
    pub seed: u64,
    /// The true function, where it is known: times (s) and positions (m).
    pub truth: Option<&'a [(f64, Vector3<f64>)]>,
}

/// Fits every kind of mixture with every number of components to demonstrations on a common time axis
/// (rows t s, x m, y m, z m), in parallel; `progress` is told of each row done.
///
/// A number of components that the samples cannot support has no row.
///
/// # Errors
/// [`LearnError`]: no demonstration, or nothing that could be fitted.
pub fn compare(
    demonstrations: &[Vec<Vector4<f64>>],
    options: &CompareOptions<'_>,
    progress: impl Fn(&Row) + Sync,
) -> Result<Table, LearnError> {
    if demonstrations.iter().all(Vec::is_empty) {
        return Err(LearnError::NoDemonstrations);
    }
    let all: Vec<Vector4<f64>> = demonstrations.iter().flatten().copied().collect();
    super::em::check(&all, *options.components.start())?;
    // One set of units for all, so that ridge and prior mean the same in every row and fold.
    let units = Units::of(&all, true);
    let data = Data {
        demonstrations: demonstrations.iter().map(|d| units.apply(d)).collect(),
        all: units.apply(&all),
        units,
        options,
    };
    let jobs: Vec<(Kind, usize)> = Kind::all()
        .into_iter()
        .flat_map(|kind| options.components.clone().map(move |k| (kind, k)))
        .collect();
    let rows: Vec<Result<Row, LearnError>> = jobs
        .into_par_iter()
        .map(|(kind, components)| {
            let row = data.row(kind, components)?;
            progress(&row);
            Ok(row)
        })
        .collect();
    let mut table = Table {
        demonstrations: demonstrations.len(),
        samples: all.len(),
        rows: Vec::new(),
    };
    let mut trouble = LearnError::Singular;
    for row in rows {
        match row {
            Ok(row) => table.rows.push(row),
            Err(e) => trouble = e,
        }
    }
    if table.rows.is_empty() {
        return Err(trouble);
    }
    Ok(table)
}

/// Samples in units of their own deviation.
struct Data<'a> {
    demonstrations: Vec<Vec<Vector4<f64>>>,
    all: Vec<Vector4<f64>>,
    units: Units<4>,
    options: &'a CompareOptions<'a>,
}

impl Data<'_> {
    fn row(&self, kind: Kind, components: usize) -> Result<Row, LearnError> {
        let seed = self.options.seed;
        let model = Model::fit(&self.all, kind, components, seed)?;
        let n = self.all.len() as f64;
        let score = model.score(&self.all) - self.units.log_jacobian();
        let parameters = model.parameters(kind.covariance);
        let cost = -2.0 * score * n;
        let regression = model.regression()?;
        // ln dx/du of the positions alone.
        let positions = self.units.log_jacobian() - self.units.scale()[0].ln();
        let likelihood = regression.score(&self.all)? - positions;
        let rmse_m = self.options.truth.map(|truth| {
            let square = |(t_s, x): &(f64, Vector3<f64>)| {
                let t = (t_s - self.units.mean()[0]) / self.units.scale()[0];
                let at = regression.mean(t);
                (self.units.position(&at) - x).norm_squared()
            };
            (truth.iter().map(square).sum::<f64>() / truth.len() as f64).sqrt()
        });
        Ok(Row {
            kind,
            components,
            effective: model.effective(),
            parameters,
            score,
            bic: cost + parameters as f64 * n.ln(),
            aic: cost + 2.0 * parameters as f64,
            held_out: self.held_out(kind, components),
            regression: -2.0 * likelihood * n + model.means() as f64 * n.ln(),
            rmse_m,
            degenerate: model.degenerate.iter().map(ToString::to_string).collect(),
        })
    }

    /// A fold that cannot be fitted says that the number is too large: no value.
    fn held_out(&self, kind: Kind, components: usize) -> Option<f64> {
        let count = self.demonstrations.len();
        let folds = FOLDS.min(count);
        if folds < 2 {
            return None;
        }
        let (mut sum, mut samples) = (0.0, 0);
        for fold in 0..folds {
            let out = fold * count / folds;
            let rest: Vec<_> = self
                .demonstrations
                .iter()
                .enumerate()
                .filter(|(i, _)| *i != out)
                .flat_map(|(_, d)| d)
                .copied()
                .collect();
            let model = Model::fit(&rest, kind, components, self.options.seed).ok()?;
            let unseen = &self.demonstrations[out];
            sum += model.score(unseen) * unseen.len() as f64;
            samples += unseen.len();
        }
        Some(sum / samples as f64 - self.units.log_jacobian())
    }
}
