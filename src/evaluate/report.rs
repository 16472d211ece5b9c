//! What a study has found, as the JSON object shows it.

use serde::Serialize;

use super::dual::{Outcome, Scheme};
use super::experts::{GUARDED, PLACE_NAMES, Side, TURN_NAMES};
use super::protocol::{Performance, Plan, Round};
use super::score::Tally;

/// A performance worse than holding by this factor is named.
const ABOVE: f64 = 1.1;

/// The JSON object. Null is what nothing can be said of: no motion, no region, a lag beyond those tried.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    pub(super) protocol: &'static str,
    pub(super) group_by: String,
    /// Most demonstrations that a skill was learned from.
    pub(super) demonstrations: usize,
    pub(super) seed: u64,
    pub(super) horizons_ms: Vec<f64>,
    /// Skills learned.
    pub(super) skills: usize,
    pub(super) recordings: usize,
    /// Recordings that nothing could be learned for.
    pub(super) not_predicted: usize,
    pub(super) position: Section,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) orientation: Option<Section>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) off_model: Option<Section>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) off_model_orientation: Option<Section>,
    pub(super) dual: Dual,
}

/// Predictions of one side of the hand.
#[derive(Debug, Serialize)]
pub(super) struct Section {
    /// Of `rmse`.
    pub(super) unit: &'static str,
    /// What ratios are taken over before their geometric mean: folders, or off the model (learned, performed).
    pub(super) groups: Vec<String>,
    pub(super) performances: Vec<One>,
    pub(super) experts: Vec<Row>,
    /// Performances that the guarded predictor makes worse than holding by more than a tenth.
    pub(super) above: Vec<Above>,
    /// Of the mixture, in multiples of the calibrated 90 % quantile: median, and 90 % quantile.
    pub(super) novelty: Option<[f64; 2]>,
}

/// One performance.
#[derive(Debug, Serialize)]
pub(super) struct One {
    pub(super) group: usize,
    pub(super) name: String,
    /// The guarded predictor's ratio to holding, by horizon.
    pub(super) ratio: Vec<Option<f64>>,
}

/// One predictor.
#[derive(Debug, Serialize)]
pub(super) struct Row {
    pub(super) name: &'static str,
    pub(super) horizons: Vec<Cell>,
}

/// One predictor at one horizon.
#[derive(Debug, Serialize)]
pub(super) struct Cell {
    /// RMSE over that of holding: geometric mean over the groups.
    pub(super) ratio: Option<f64>,
    /// The same of each group.
    pub(super) of_groups: Vec<Option<f64>>,
    /// Over all moments.
    pub(super) rmse: Option<f64>,
    /// The shift of least squared error, over all moments.
    pub(super) lag_ms: Option<f64>,
    /// RMS jerk over the hand's own.
    pub(super) jerk: Option<f64>,
    /// Shares of truths within the 50, 90 and 95 % regions.
    pub(super) coverage: Option<[f64; 3]>,
    /// The largest ratio of a single performance.
    pub(super) worst: Option<f64>,
}

/// A performance better left unpredicted.
#[derive(Debug, Serialize)]
pub(super) struct Above {
    pub(super) group: String,
    pub(super) name: String,
    pub(super) horizon_ms: f64,
    pub(super) ratio: f64,
}

/// Messages against error.
#[derive(Debug, Serialize)]
pub(super) struct Dual {
    pub(super) delay_ms: f64,
    pub(super) jitter_ms: f64,
    pub(super) loss: f64,
    /// Of sending every sample and holding it.
    pub(super) hold_rmse_mm: Option<f64>,
    pub(super) rows: Vec<DualRow>,
}

/// One way to decide when to speak.
#[derive(Debug, Serialize)]
pub(super) struct DualRow {
    #[serde(skip)]
    pub(super) scheme: Option<Scheme>,
    /// `everything, held`, `deadband, held`, `deadband, velocity` or `guarded`.
    pub(super) name: &'static str,
    /// The bound as a distance, mm.
    pub(super) bound_mm: Option<f64>,
    /// The bound as a multiple of the predicted deviation.
    pub(super) bound_sigmas: Option<f64>,
    /// The largest silence, ms.
    pub(super) silence_ms: Option<f64>,
    pub(super) messages_per_s: f64,
    /// With the headers of QUIC, UDP and IP; of the session only.
    pub(super) bytes_per_s: Option<f64>,
    pub(super) rmse_mm: Option<f64>,
    /// Over `hold_rmse_mm`.
    pub(super) ratio: Option<f64>,
}

pub(super) fn report(plan: &Plan<'_>, rounds: &[Round], performances: &[Performance]) -> Report {
    let recordings = plan.sets.iter().map(|s| s.demonstrations.len()).sum();
    let on = performances.iter().filter(|p| p.off.is_none());
    let section = |side, off| section(plan, side, performances, off);
    Report {
        protocol: plan.protocol.name(),
        group_by: plan.persons.to_string(),
        demonstrations: plan.most,
        seed: plan.seed,
        horizons_ms: plan.horizons_s.iter().map(|h| ms(*h)).collect(),
        skills: rounds.len(),
        recordings,
        not_predicted: recordings - on.count(),
        position: section(Side::Place, false).expect("every round predicts something"),
        orientation: section(Side::Turn, false),
        off_model: section(Side::Place, true),
        off_model_orientation: section(Side::Turn, true),
        dual: dual(plan, performances),
    }
}

/// To a tenth of a microsecond: 33.3 ms stays what was asked for.
fn ms(s: f64) -> f64 {
    (s * 1e7).round() * 1e-4
}

fn section(
    plan: &Plan<'_>,
    side: Side,
    performances: &[Performance],
    off: bool,
) -> Option<Section> {
    let (names, unit, scale): (&[&'static str], _, _) = match side {
        Side::Place => (&PLACE_NAMES, "mm", 1e3),
        Side::Turn => (&TURN_NAMES, "deg", 1_f64.to_degrees()),
    };
    let group = |p: &Performance| match p.off {
        Some(dir) => format!(
            "{} learned, {} performed",
            plan.sets[p.set].name, plan.off_model[dir].name
        ),
        None => plan.sets[p.set].name.clone(),
    };
    let mut groups: Vec<String> = Vec::new();
    let mut of: Vec<(usize, &Performance, &Vec<Vec<Tally>>)> = Vec::new();
    for p in performances.iter().filter(|p| p.off.is_some() == off) {
        let tallies = match side {
            Side::Place => Some(&p.places),
            Side::Turn => p.turns.as_ref(),
        };
        let Some(tallies) = tallies else { continue };
        let name = group(p);
        let at = groups.iter().position(|g| *g == name).unwrap_or_else(|| {
            groups.push(name);
            groups.len() - 1
        });
        of.push((at, p, tallies));
    }
    if of.is_empty() {
        return None;
    }
    let row = |(expert, name): (usize, &&'static str)| Row {
        name,
        horizons: (0..plan.horizons_s.len())
            .map(|h| {
                let each = of.iter().map(|(g, _, t)| (*g, &t[expert][h]));
                cell(groups.len(), each, scale)
            })
            .collect(),
    };
    let experts: Vec<Row> = names.iter().enumerate().map(row).collect();
    let guarded = names.iter().position(|n| *n == GUARDED)?;
    let mut above = Vec::new();
    let mut ones = Vec::new();
    for (g, p, tallies) in &of {
        let ratio: Vec<_> = tallies[guarded].iter().map(Tally::ratio).collect();
        for (r, h_s) in ratio.iter().zip(plan.horizons_s) {
            if let Some(ratio) = r.filter(|r| *r > ABOVE) {
                above.push(Above {
                    group: groups[*g].clone(),
                    name: p.name.clone(),
                    horizon_ms: ms(*h_s),
                    ratio,
                });
            }
        }
        ones.push(One {
            group: *g,
            name: p.name.clone(),
            ratio,
        });
    }
    let mut novelty: Vec<f64> = match side {
        Side::Place => of
            .iter()
            .flat_map(|(_, p, _)| p.novelty.iter().copied())
            .collect(),
        Side::Turn => Vec::new(),
    };
    novelty.sort_by(f64::total_cmp);
    let quantile = |q: f64| novelty[((novelty.len() - 1) as f64 * q).round() as usize];
    Some(Section {
        unit,
        performances: ones,
        experts,
        above,
        novelty: (!novelty.is_empty()).then(|| [quantile(0.5), quantile(0.9)]),
        groups,
    })
}

fn cell<'a>(groups: usize, tallies: impl Iterator<Item = (usize, &'a Tally)>, scale: f64) -> Cell {
    let mut all = Tally::default();
    let mut each = vec![Tally::default(); groups];
    let mut worst: Option<f64> = None;
    for (group, tally) in tallies {
        all.add(tally);
        each[group].add(tally);
        if let Some(ratio) = tally.ratio() {
            worst = Some(worst.map_or(ratio, |w| w.max(ratio)));
        }
    }
    let of_groups: Vec<_> = each.iter().map(Tally::ratio).collect();
    let known: Vec<f64> = of_groups.iter().flatten().copied().collect();
    let mean_ln = known.iter().map(|r| r.ln()).sum::<f64>() / known.len() as f64;
    Cell {
        ratio: Some(mean_ln.exp()).filter(|r| r.is_finite()),
        of_groups,
        rmse: all.rmse().map(|r| r * scale),
        lag_ms: all.lag_s().map(|s| s * 1e3),
        jerk: all.jerk_ratio(),
        coverage: all.coverage(),
        worst,
    }
}

fn dual(plan: &Plan<'_>, performances: &[Performance]) -> Dual {
    use telemime_operator::session::FutureBound::{Absolute, Relative};
    let mut sums = vec![Outcome::default(); plan.schemes.len()];
    for p in performances {
        for (sum, outcome) in sums.iter_mut().zip(&p.dual) {
            sum.add(outcome);
        }
    }
    let everything = plan.schemes.iter().position(|s| *s == Scheme::Everything);
    let hold_m = everything.and_then(|n| sums[n].rmse_m());
    let row = |(scheme, sum): (&Scheme, &Outcome)| {
        let (name, bound_m, bound_sigmas, silence_s) = match *scheme {
            Scheme::Everything => ("everything, held", None, None, None),
            Scheme::DeadbandHold(m) => ("deadband, held", Some(m), None, None),
            Scheme::DeadbandStraight(m) => ("deadband, velocity", Some(m), None, None),
            Scheme::Session(Absolute(m), silence) => (GUARDED, Some(m), None, silence),
            Scheme::Session(Relative(n), silence) => (GUARDED, None, Some(n), silence),
        };
        let session = matches!(scheme, Scheme::Session(..));
        DualRow {
            scheme: Some(*scheme),
            name,
            bound_mm: bound_m.map(ms),
            bound_sigmas,
            silence_ms: silence_s.map(ms),
            messages_per_s: sum.messages as f64 / sum.duration_s,
            bytes_per_s: session.then(|| sum.bytes as f64 / sum.duration_s),
            rmse_mm: sum.rmse_m().map(|m| m * 1e3),
            ratio: sum
                .rmse_m()
                .zip(hold_m)
                .map(|(own, hold)| own / hold)
                .filter(|r| r.is_finite()),
        }
    };
    Dual {
        delay_ms: ms(plan.link.delay_s),
        jitter_ms: ms(plan.link.jitter_s),
        loss: plan.link.loss,
        hold_rmse_mm: hold_m.map(|m| m * 1e3),
        rows: plan.schemes.iter().zip(&sums).map(row).collect(),
    }
}
