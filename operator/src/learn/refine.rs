//! A further demonstration refines a skill without those it was learned from.

use nalgebra::{SMatrix, SVector, UnitQuaternion, Vector2, Vector3, Vector4};
use telemime_protocol::pose;
use telemime_protocol::skill::{
    Gmm, Gmr, MAX_SOURCES, Pace, Parts, Placement, Skill, Source, Stats, TaskModel, Turn,
    TurnMixture,
};

use super::align::{POINTS, warp_to};
use super::em::{self, Convergence, EmOptions};
use super::predictor::{Places, Turns, refine as refine_predictor};
use super::{GRIP, LEAST_DEVIATION_LN, LearnError, ORIENTATION, frames, short, statistics, turn};
use crate::demonstration::Demonstration;

/// A demonstration of which more than this share is new to the skill is probably not one of it.
const UNLIKE: f64 = 0.5;

/// What a demonstration was to the skill it refined.
#[derive(Debug, Clone, PartialEq)]
pub struct Refinement {
    /// The demonstration.
    pub name: String,
    /// Share of its samples that were newer to the skill than 90 % of held-out samples had been before: 0.1 of
    /// another performance of the same.
    pub novel: f64,
    /// What it has that the skill was not taught, and which is not learned.
    pub ignored: Vec<&'static str>,
}

impl Refinement {
    /// Whether it looks like another gesture.
    pub fn is_unlike(&self) -> bool {
        self.novel > UNLIKE
    }
}

/// Refines `skill` with one demonstration more.
///
/// It is warped onto the skill's own regression, and each mixture over time goes on with EM, its components
/// standing for the rows they explained ([`em::update()`]). The predictor's regressions give back the scatters they were
/// made of. The number of components stays, and so does the seed; a demonstration weighs as much as each before.
///
/// # Errors
/// [`LearnError::AlreadyLearned`], [`LearnError::Lacks`], [`LearnError::TooMany`], [`LearnError::Frame`], or
/// numbers that make no skill.
pub fn refine(skill: &Skill, d: &Demonstration) -> Result<(Skill, Refinement), LearnError> {
    let old = skill.parts();
    let sources = old.provenance.sources.len();
    if skill.was_trained_on(d.sha256()) {
        return Err(LearnError::AlreadyLearned {
            path: d.path().to_owned(),
        });
    }
    if sources >= MAX_SOURCES {
        return Err(LearnError::TooMany {
            found: sources + 1,
            limit: MAX_SOURCES,
        });
    }
    let lacks = |what| LearnError::Lacks {
        path: d.path().to_owned(),
        what,
    };
    if old.turn.is_some() && !d.has_orientation() {
        return Err(lacks(ORIENTATION));
    }
    if old.grip.is_some() && !d.has_grip() {
        return Err(lacks(GRIP));
    }
    let mut ignored = Vec::new();
    if old.turn.is_none() && d.has_orientation() {
        ignored.push("orientation");
    }
    if old.grip.is_none() && d.has_grip() {
        ignored.push("grip");
    }

    let before = sources.max(1);
    let one_more = (before + 1) as f64;
    let mut parts: Parts = old.clone();
    parts.duration_s += (d.duration_s() - old.duration_s) / one_more;
    let stretch = parts.duration_s / old.duration_s;
    let warped = warped(old, d, parts.duration_s)?;
    let had = f64::from(old.samples.motion);
    let place = |from: &Placement| -> Vec<Vector4<f64>> {
        let row = |(t_s, own_s): &(f64, f64)| {
            let x = frames::seen(from, &d.position_at(*own_s));
            Vector4::new(*t_s, x.x, x.y, x.z)
        };
        warped.iter().map(row).collect()
    };
    let world = Placement {
        origin: Vector3::zeros(),
        turn: UnitQuaternion::identity(),
    };
    parts.motion = updated(&old.motion, stretch, had, &place(&world))?;
    if let Some(task) = &old.task {
        let mut all = task.frames().to_vec();
        for frame in &mut all {
            let at = frames::placement(d, &frame.name)?;
            let usual = &mut frame.usual;
            // Which axes the frame was learned from is not kept: those in which the demonstration is likelier.
            let own = place(&at);
            let level = place(&frames::levelled(&at, usual));
            let likelihood = |rows: &[Vector4<f64>]| -> f64 {
                let then = |x: &Vector4<f64>| Vector4::new(x[0] / stretch, x[1], x[2], x[3]);
                rows.iter()
                    .map(|x| frame.motion.log_density(&then(x)))
                    .sum()
            };
            let rows = if likelihood(&own) > likelihood(&level) {
                let turns = [(before as f64, usual.turn), (1.0, at.turn)];
                usual.turn = pose::mean(turns.into_iter()).unwrap_or(usual.turn);
                own
            } else {
                level
            };
            usual.origin += (at.origin - usual.origin) / one_more;
            frame.motion = updated(&frame.motion, stretch, had, &rows)?;
        }
        parts.task = Some(TaskModel::new(all).map_err(|e| LearnError::Skill(e.into()))?);
    }
    if let Some(grip) = &old.grip {
        let rows: Vec<_> = warped
            .iter()
            .filter_map(|(t_s, own_s)| Some(Vector2::new(*t_s, d.grip_at(*own_s)?)))
            .collect();
        parts.grip = Some(updated(grip, stretch, had, &rows)?);
    }

    let rows = f64::from(old.samples.predictor);
    let refined = refine_predictor::<Places>(&old.predictor, rows, before, d)?;
    parts.predictor = refined.model;
    if let Some(old) = &old.turn {
        let along: Vec<_> = warped
            .iter()
            .filter_map(|(t_s, own_s)| Some((*t_s, d.orientation_at(*own_s)?)))
            .collect();
        let scale = Vector4::new(stretch, 1.0, 1.0, 1.0);
        let stretched = affine(old.motion.gmm(), &scale, &Vector4::zeros())?;
        let stretched = TurnMixture::new(stretched, old.motion.charts().to_vec())
            .map_err(|e| LearnError::Skill(e.into()))?;
        parts.turn = Some(Turn {
            motion: turn::update(&stretched, had, &along)?,
            predictor: refine_predictor::<Turns>(&old.predictor, rows, before, d)?.model,
        });
    }
    parts.stats = stats(&old.stats, &statistics(std::slice::from_ref(d)), one_more);
    parts.pace = pace(&old.pace, d.duration_s(), before as f64);
    let count = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
    parts.samples.motion = old.samples.motion.saturating_add(count(warped.len()));
    parts.samples.predictor = old
        .samples
        .predictor
        .saturating_add(count(refined.rows.round() as usize));
    parts.provenance.sources.push(Source {
        name: short(d.name()),
        sha256: *d.sha256(),
    });
    let refinement = Refinement {
        name: d.name().to_owned(),
        novel: refined.novel,
        ignored,
    };
    Ok((Skill::new(parts)?, refinement))
}

/// Moments on the skill's new time axis with those of the demonstration's own that belong to them, s; as many
/// as each demonstration before had.
fn warped(old: &Parts, d: &Demonstration, duration_s: f64) -> Result<Vec<(f64, f64)>, LearnError> {
    let sources = old.provenance.sources.len().max(1);
    let points = (old.samples.motion as usize / sources).clamp(POINTS.0, POINTS.1);
    let gmr = Gmr::<1, 3>::new(&old.motion).map_err(|_| LearnError::Singular)?;
    let at = |i: usize| i as f64 / (points - 1) as f64;
    let path: Vec<Vector3<f64>> = (0..points)
        .map(|i| gmr.query(&[at(i) * old.duration_s].into()).mean)
        .collect();
    let start_s = d.samples()[0].t_s;
    let pair = |(i, own_s): (usize, f64)| (at(i) * duration_s, start_s + own_s);
    Ok(warp_to(&path, d)
        .into_iter()
        .enumerate()
        .map(pair)
        .collect())
}

/// The mixture, its first coordinate stretched, after EM over `rows` beside the `had` it stands for; in units of
/// its own spread, so that floors are relative.
fn updated<const D: usize>(
    gmm: &Gmm<D>,
    stretch: f64,
    had: f64,
    rows: &[SVector<f64, D>],
) -> Result<Gmm<D>, LearnError> {
    let mut scale = SVector::<f64, D>::repeat(1.0);
    scale[0] = stretch;
    let gmm = affine(gmm, &scale, &SVector::zeros())?;
    let parts = || gmm.components().iter();
    let mean: SVector<f64, D> = parts().map(|c| c.mean() * c.weight()).sum();
    let mut variance = SVector::<f64, D>::zeros();
    for c in parts() {
        let apart = c.mean() - mean;
        variance += (c.covariance().diagonal() + apart.component_mul(&apart)) * c.weight();
    }
    let scale = variance.map(f64::sqrt);
    let inverse = scale.map(|s| 1.0 / s);
    let standard = affine(&gmm, &inverse, &-mean.component_div(&scale))?;
    let rows: Vec<_> = rows
        .iter()
        .map(|x| (x - mean).component_div(&scale))
        .collect();
    let options = EmOptions {
        max_iterations: 30,
        convergence: Convergence::Absolute(1e-4),
        ..EmOptions::default()
    };
    let updated = em::update(&standard, had, &rows, &options)?;
    affine(&updated.gmm, &scale, &mean)
}

/// The mixture of `x∘scale + shift`.
fn affine<const D: usize>(
    gmm: &Gmm<D>,
    scale: &SVector<f64, D>,
    shift: &SVector<f64, D>,
) -> Result<Gmm<D>, LearnError> {
    let by = SMatrix::<f64, D, D>::from_diagonal(scale);
    Gmm::new(gmm.components().iter().map(|c| {
        let mean = c.mean().component_mul(scale) + shift;
        (c.weight(), mean, by * c.covariance() * by)
    }))
    .map_err(|_| LearnError::Singular)
}

/// Extremes are exact; a median of quantiles is not kept, so that their mean goes on instead.
fn stats(old: &Stats, new: &Stats, one_more: f64) -> Stats {
    let mean = |old: f64, new: f64| old + (new - old) / one_more;
    Stats {
        speed95_m_s: mean(old.speed95_m_s, new.speed95_m_s),
        acceleration95_m_s2: mean(old.acceleration95_m_s2, new.acceleration95_m_s2),
        reach_m: old.reach_m.max(new.reach_m),
        min: old.min.inf(&new.min),
        max: old.max.sup(&new.max),
    }
}

/// Mean and deviation with one value more (Welford 1962).
fn pace(old: &Pace, duration_s: f64, before: f64) -> Pace {
    let apart = duration_s.ln() - old.mean_ln_s;
    let mean_ln_s = old.mean_ln_s + apart / (before + 1.0);
    let square = old.deviation_ln * old.deviation_ln * (before - 1.0)
        + apart * (duration_s.ln() - mean_ln_s);
    Pace {
        mean_ln_s,
        deviation_ln: (square / before).sqrt().max(LEAST_DEVIATION_LN),
    }
}
