//! What a study has found, as the JSON object shows it.

use serde::Serialize;

use super::arm::{Driven, WAYS};
use super::dual::{Outcome, Scheme};
use super::experts::{GUARDED, PLACE_NAMES, Side, TURN_NAMES};
use super::faults::{Bin, Faults, MIND_AFTER, MIND_BEFORE, MIND_STEP_S, SINCE_S};
use super::protocol::{MIND_AT_S, Performance, Plan, Round};
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
    pub(super) faults: Faulty,
    pub(super) dual: Dual,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) arm: Option<Arm>,
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

/// Where predictions of positions fail.
#[derive(Debug, Serialize)]
pub(super) struct Faulty {
    /// Ends of the times since the onset, ms: before the first the hand rests, after the last but one there is no end.
    pub(super) since_onset_ms: Vec<Option<f64>>,
    pub(super) experts: Vec<FaultyRow>,
    /// How far ahead changes of mind are looked at, ms.
    pub(super) mind_at_ms: f64,
    /// Performances turned back at their fastest moment.
    pub(super) minds_changed: usize,
    /// Times after the turn, ms.
    pub(super) mind_ms: Vec<f64>,
    /// RMSE of each expert at these times, mm.
    pub(super) mind_mm: Vec<Vec<Option<f64>>>,
}

/// One predictor.
#[derive(Debug, Serialize)]
pub(super) struct FaultyRow {
    pub(super) name: &'static str,
    pub(super) horizons: Vec<FaultyCell>,
}

/// One predictor at one horizon.
#[derive(Debug, Serialize)]
pub(super) struct FaultyCell {
    /// RMSE by time since the onset, mm.
    pub(super) since_onset_mm: Vec<Option<f64>>,
    /// Shares of the squared error that fall into these times.
    pub(super) since_onset_share: Vec<Option<f64>>,
    /// RMSE over that of holding where the hand is to turn back.
    pub(super) turning_back: Option<f64>,
    /// Distance from the hand's path: root mean square, mm.
    pub(super) off_path_mm: Option<f64>,
    /// Its 95 % quantile.
    pub(super) off_path_95_mm: Option<f64>,
    /// How large predicted motion is, 1 as large as the hand's.
    pub(super) amplitude: Option<f64>,
    /// Mean of how far it goes beyond the hand where that turns, as a share of the hand's range.
    pub(super) overshoot: Option<f64>,
    /// Its 95 % quantile.
    pub(super) overshoot_95: Option<f64>,
}

/// What the arm did with it.
#[derive(Debug, Serialize)]
pub(super) struct Arm {
    pub(super) driven: usize,
    /// Smallest and largest, tip metres per hand metre.
    pub(super) scale: [f64; 2],
    pub(super) ways: Vec<ArmWay>,
    /// The guarded predictor's error over that of each other way: geometric mean over the folders.
    pub(super) over_delayed_ideal: Option<f64>,
    pub(super) over_delayed_same_arm: Option<f64>,
    /// The same of each folder.
    pub(super) of_groups: Vec<[Option<f64>; 2]>,
    /// Share of the delay's cost that is gone, over all moments.
    pub(super) fraction_hidden: Option<f64>,
    /// The same of what could be gone without foreseeing that the hand begins to move.
    pub(super) fraction_hidden_once_begun: Option<f64>,
    /// Share of the performances whose lag is within 10 ms.
    pub(super) lag_within_10_ms: f64,
    pub(super) messages_per_s: f64,
    /// RMS jerk of the command over that of the scaled hand through a filter of 60 rad/s.
    pub(super) jerk: Option<f64>,
    /// Ticks on which a limit acted, of all that were judged.
    pub(super) clamped: f64,
}

/// One way to follow the hand.
#[derive(Debug, Serialize)]
pub(super) struct ArmWay {
    pub(super) name: &'static str,
    /// In the hand's metres.
    pub(super) rmse_mm: Option<f64>,
    /// Lags of the performances: 10 % quantile, median, 90 % quantile.
    pub(super) lag_ms: Option<[f64; 3]>,
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
    /// The bound as a share of the way the hand usually goes.
    pub(super) bound_share: Option<f64>,
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
        faults: faulty(plan, performances),
        dual: dual(plan, performances),
        arm: plan.arm.and_then(|_| arm(plan, performances)),
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
    Some(Section {
        unit,
        performances: ones,
        experts,
        above,
        novelty: quantile(&mut novelty, 0.5)
            .zip(quantile(&mut novelty, 0.9))
            .map(Into::into),
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

fn arm(plan: &Plan<'_>, performances: &[Performance]) -> Option<Arm> {
    let driven: Vec<(usize, &Driven)> = performances
        .iter()
        .filter_map(|p| Some((p.set, p.driven.as_ref()?)))
        .collect();
    let error_2 = |way: usize, set: Option<usize>| -> f64 {
        let own = driven
            .iter()
            .filter(|(s, _)| set.is_none_or(|set| set == *s));
        own.map(|(_, one)| one.error_2[way]).sum()
    };
    let moments: usize = driven.iter().map(|(_, one)| one.moments).sum();
    let rmse = |way: usize| finite((error_2(way, None) / moments as f64).sqrt());
    let [ideal, delayed, own, begun, known] = std::array::from_fn(|way| way);
    let of_groups: Vec<[Option<f64>; 2]> = (0..plan.sets.len())
        .map(|set| {
            let over = |way| finite((error_2(own, Some(set)) / error_2(way, Some(set))).sqrt());
            [over(ideal), over(delayed)]
        })
        .collect();
    let mean = |n: usize| {
        let ln: Option<Vec<f64>> = of_groups.iter().map(|r| Some(r[n]?.ln())).collect();
        let ln = ln?;
        finite((ln.iter().sum::<f64>() / ln.len() as f64).exp())
    };
    let (over_delayed_ideal, over_delayed_same_arm) = (mean(0), mean(1));
    let ways = WAYS.iter().enumerate().map(|(way, name)| {
        let mut lags: Vec<f64> = driven
            .iter()
            .filter_map(|(_, one)| one.lag_s[way].map(|s| s * 1e3))
            .collect();
        let mut lag = |q| quantile(&mut lags, q);
        ArmWay {
            name,
            rmse_mm: rmse(way).map(|m| m * 1e3),
            lag_ms: lag(0.1)
                .zip(lag(0.5))
                .zip(lag(0.9))
                .map(|((a, b), c)| [a, b, c]),
        }
    });
    let scales = || driven.iter().map(|(_, one)| one.scale);
    let near = |one: &Driven| one.lag_s[own].is_some_and(|s| s.abs() <= 0.01);
    let within = driven.iter().filter(|(_, one)| near(one)).count();
    let (messages, seconds) = driven.iter().fold((0.0, 0.0), |(m, s), (_, one)| {
        (m + f64::from(one.messages), s + one.duration_s)
    });
    let clamps: f64 = driven.iter().map(|(_, one)| f64::from(one.clamps)).sum();
    let jerk_2 = |n: usize| -> f64 { driven.iter().map(|(_, one)| one.jerk_2[n]).sum() };
    let hidden = |floor: usize| {
        let gone = rmse(delayed)? - rmse(own)?;
        finite(gone / (rmse(delayed)? - rmse(floor)?))
    };
    (!driven.is_empty()).then(|| Arm {
        driven: driven.len(),
        scale: [
            scales().fold(f64::INFINITY, f64::min),
            scales().fold(0.0, f64::max),
        ],
        ways: ways.collect(),
        over_delayed_ideal,
        over_delayed_same_arm,
        of_groups,
        fraction_hidden: hidden(known),
        fraction_hidden_once_begun: hidden(begun),
        lag_within_10_ms: within as f64 / driven.len() as f64,
        messages_per_s: messages / seconds,
        jerk: finite((jerk_2(0) / jerk_2(1)).sqrt()),
        clamped: clamps / moments as f64,
    })
}

fn faulty(plan: &Plan<'_>, performances: &[Performance]) -> Faulty {
    let on = || performances.iter().filter(|p| p.off.is_none());
    let cell = |expert: usize, h: usize| {
        let mut sum = Faults::default();
        on().for_each(|p| sum.add(&p.faults[expert][h]));
        let all_2: f64 = sum.since_onset.iter().map(|b| b.error_2).sum();
        let square = sum.off_path_m.iter().map(|m| m * m).sum::<f64>();
        let mean = |values: &[f64]| finite(values.iter().sum::<f64>() / values.len() as f64);
        FaultyCell {
            since_onset_mm: sum
                .since_onset
                .iter()
                .map(|b| b.rmse_m().map(|m| m * 1e3))
                .collect(),
            since_onset_share: sum
                .since_onset
                .iter()
                .map(|b| finite(b.error_2 / all_2))
                .collect(),
            turning_back: sum
                .against
                .rmse_m()
                .zip(sum.against.hold_m())
                .and_then(|(m, hold_m)| finite(m / hold_m)),
            off_path_mm: finite((square / sum.off_path_m.len() as f64).sqrt() * 1e3),
            amplitude: sum.amplitude(),
            overshoot: mean(&sum.overshoot),
            overshoot_95: quantile(&mut sum.overshoot, 0.95),
            off_path_95_mm: quantile(&mut sum.off_path_m, 0.95).map(|m| m * 1e3),
        }
    };
    let steps = -MIND_BEFORE..=MIND_AFTER;
    let mind = |expert: usize| {
        let at = |n: usize| {
            let mut bin = Bin::default();
            on().filter_map(|p| p.mind.get(expert))
                .for_each(|bins| bin.add(&bins[n]));
            bin.rmse_m().map(|m| m * 1e3)
        };
        (0..steps.clone().count()).map(at).collect()
    };
    let experts = || 0..PLACE_NAMES.len();
    Faulty {
        since_onset_ms: SINCE_S.iter().map(|s| finite(ms(*s))).collect(),
        experts: experts()
            .map(|expert| FaultyRow {
                name: PLACE_NAMES[expert],
                horizons: (0..plan.horizons_s.len())
                    .map(|h| cell(expert, h))
                    .collect(),
            })
            .collect(),
        mind_at_ms: ms(MIND_AT_S),
        minds_changed: on().filter(|p| !p.mind.is_empty()).count(),
        mind_ms: steps
            .clone()
            .map(|n| ms(f64::from(n) * MIND_STEP_S))
            .collect(),
        mind_mm: experts().map(mind).collect(),
    }
}

/// The place of the value nearest to `wanted`.
pub(super) fn nearest(values: &[f64], wanted: f64) -> usize {
    let off = |v: &f64| (v - wanted).abs();
    let all = values.iter().enumerate();
    all.min_by(|a, b| off(a.1).total_cmp(&off(b.1)))
        .map_or(0, |(n, _)| n)
}

fn finite(value: f64) -> Option<f64> {
    Some(value).filter(|v| v.is_finite())
}

fn quantile(values: &mut [f64], q: f64) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let last = values.len().checked_sub(1)?;
    Some(values[(last as f64 * q).round() as usize])
}

fn dual(plan: &Plan<'_>, performances: &[Performance]) -> Dual {
    use telemime_operator::session::FutureBound::{Absolute, Relative, Share};
    let mut sums = vec![Outcome::default(); plan.schemes.len()];
    for p in performances {
        for (sum, outcome) in sums.iter_mut().zip(&p.dual) {
            sum.add(outcome);
        }
    }
    let everything = plan.schemes.iter().position(|s| *s == Scheme::Everything);
    let hold_m = everything.and_then(|n| sums[n].rmse_m());
    let row = |(scheme, sum): (&Scheme, &Outcome)| {
        let bound = |bound| match bound {
            Absolute(m) => (Some(m), None, None),
            Relative(n) => (None, Some(n), None),
            Share(n) => (None, None, Some(n)),
        };
        let (name, (bound_m, bound_sigmas, bound_share), silence_s) = match *scheme {
            Scheme::Everything => ("everything, held", (None, None, None), None),
            Scheme::DeadbandHold(m) => ("deadband, held", bound(Absolute(m)), None),
            Scheme::DeadbandStraight(m) => ("deadband, velocity", bound(Absolute(m)), None),
            Scheme::Session(future, silence) => (GUARDED, bound(future), silence),
        };
        let session = matches!(scheme, Scheme::Session(..));
        DualRow {
            scheme: Some(*scheme),
            name,
            bound_mm: bound_m.map(ms),
            bound_sigmas,
            bound_share,
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
        loss: plan
            .link
            .loss
            .share()
            .expect("the study's losses are independent"),
        hold_rmse_mm: hold_m.map(|m| m * 1e3),
        rows: plan.schemes.iter().zip(&sums).map(row).collect(),
    }
}
