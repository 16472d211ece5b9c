//! A skill's motion to play: regression over time, compressed to checkpoints within a bound.

use anyhow::Context;
use nalgebra::{UnitQuaternion, Vector1, Vector3};
use telemime_protocol::checkpoint::{PosePlan, select, turns};
use telemime_protocol::skill::{Gmr, Skill};
use telemime_protocol::wire::codec;

use super::scores::{PlayReport, Scores, TurnScores};
use crate::placed::{Motion, Placed};

/// Inferred motions are sampled at this interval before they are compressed, s.
const SAMPLE_S: f64 = 0.02;

/// How far the gripper's opening may be off, of 1.
const GRIP_BOUND: f64 = 0.02;

/// How far a played motion may be off the inferred one, at every sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Position, m.
    pub place_m: f64,
    /// Orientation, rad.
    pub turn_rad: f64,
}

impl Bounds {
    /// 1 % of the skill's reach, and a degree or so.
    pub fn of(skill: &Skill) -> Self {
        Self {
            place_m: 0.01 * skill.stats().reach_m,
            turn_rad: 0.02,
        }
    }
}

/// Infers the skill's motion, with these of its frames placed anew, and compresses it.
///
/// # Errors
/// A bound that cannot be held, or a frame that cannot be placed.
pub fn infer(
    skill: &Skill,
    bounds: Bounds,
    placed: &[Placed],
) -> anyhow::Result<(PosePlan, PlayReport)> {
    let motion = Motion::new(skill, placed)?;
    let steps = (skill.duration_s() / SAMPLE_S).ceil().max(2.0) as usize;
    let t: Vec<f64> = (0..=steps)
        .map(|i| skill.duration_s() * i as f64 / steps as f64)
        .collect();
    let inferred: Vec<Vector3<f64>> = t.iter().map(|&t| motion.at(t).mean).collect();
    let position = select::bounded(&t, &inferred, bounds.place_m)
        .with_context(|| format!("--bound {}", bounds.place_m))?;
    let turned: Option<Vec<UnitQuaternion<f64>>> = skill
        .turn()
        .and_then(|_| t.iter().map(|&t| motion.turn_at(t)).collect());
    let orientation = turned
        .as_ref()
        .map(|q| turns(&t, q, bounds.turn_rad))
        .transpose()
        .with_context(|| format!("--turn-bound {}", bounds.turn_rad))?;
    let grip = skill
        .grip()
        .map(|grip| -> anyhow::Result<_> {
            let gmr = Gmr::<1, 1>::new(grip)?;
            let opening = |&t: &f64| gmr.query(&Vector1::new(t)).mean[0].clamp(0.0, 1.0);
            let openings: Vec<_> = t.iter().map(|t| Vector1::new(opening(t))).collect();
            Ok(select::bounded(&t, &openings, GRIP_BOUND)?)
        })
        .transpose()?;
    let plan = PosePlan::new(position, orientation, grip)?;
    let curve = plan.curve()?;
    let rebuilt: Vec<_> = t.iter().map(|&t| curve.position_at(t)).collect();
    let report = PlayReport {
        skill: skill.name().to_owned(),
        duration_s: skill.duration_s(),
        bound_m: bounds.place_m,
        samples: t.len(),
        checkpoints: plan.position().len(),
        turn_checkpoints: plan.orientation().map(|plan| plan.len()),
        grip_checkpoints: plan.grip().map(|plan| plan.len()),
        bytes: codec::encode(&plan).len(),
        rebuilt: Scores::of(&inferred, &rebuilt),
        rebuilt_turn: turned.map(|q| {
            TurnScores::of(
                t.iter()
                    .zip(&q)
                    .filter_map(|(&t, q)| Some(curve.orientation_at(t)?.angle_to(q))),
            )
        }),
        points: plan
            .position()
            .checkpoints()
            .map(|c| (c.t_s, c.x.into()))
            .collect(),
    };
    Ok((plan, report))
}

#[cfg(test)]
mod tests {
    use telemime_protocol::skill::posed_example;

    use super::*;

    #[test]
    fn a_pose_is_played_within_both_bounds() {
        let skill = posed_example(4, 2);
        let bounds = Bounds {
            place_m: 2e-3,
            turn_rad: 0.01,
        };
        let (plan, report) = infer(&skill, bounds, &[]).unwrap();
        let curve = plan.curve().unwrap();
        assert!(report.rebuilt.max_m <= bounds.place_m + 1e-9);
        let turned = report.rebuilt_turn.unwrap();
        assert!(turned.max_rad <= bounds.turn_rad + 1e-9 && turned.rms_rad > 0.0);
        let middle_s = 0.5 * skill.duration_s();
        let learned = skill.turn().unwrap().motion.query(middle_s).mean;
        let played = curve.orientation_at(middle_s).unwrap();
        assert!(played.angle_to(&learned) < 2.0 * bounds.turn_rad);
        assert!((curve.grip_at(middle_s).unwrap() - 0.5).abs() < 0.05);
        assert_eq!(codec::encode(&plan).len(), report.bytes);
    }
}
