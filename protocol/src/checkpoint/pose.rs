//! A finished motion with orientation and gripper: one plan for each, on one time axis.
//!
//! An orientation travels as a curve in ℝ⁴ through unit quaternions of one sign, and is read by
//! normalising it. No chart, no singularity: between near checkpoints the curve stays near the sphere.

use nalgebra::{SVector, UnitQuaternion, Vector3, Vector4};
use serde::{Deserialize, Serialize};

use super::{CheckpointError, Plan, select};
use crate::pose;
use crate::spline::BSpline;

/// Checkpoints of an orientation lie this near to the unit sphere: they need not lie on the curve they stand for.
const NORM_SLACK: f64 = 0.25;

/// Checkpoints of a gripper leave [0, 1] by at most this much; what is read of them is clamped.
const GRIP_SLACK: f64 = 0.05;

/// The curve between them stays this far from the origin, looked at in so many places a span.
const LEAST_NORM: f64 = 0.5;
const LOOKS: usize = 8;

/// Why plans do not make a motion.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PosePlanError {
    /// A checkpoint of the orientation is not a rotation.
    #[error("orientation checkpoint {index} is not a unit quaternion")]
    NotARotation {
        /// The checkpoint.
        index: usize,
    },
    /// The curve passes so near the origin that its direction means nothing: two checkpoints too far apart, or
    /// of opposite sign.
    #[error(
        "the orientation is lost before checkpoint {index}: too far from the one before, or of opposite sign"
    )]
    Gap {
        /// The later of the two.
        index: usize,
    },
    /// The orientation's checkpoints have no curve.
    #[error("orientation: {0}")]
    Curve(CheckpointError),
    /// A gripper's opening outside [−0.05, 1.05].
    #[error("gripper checkpoint {index} is not in [-0.05, 1.05]")]
    Grip {
        /// The checkpoint.
        index: usize,
    },
}

/// The checkpoints of a motion's position and, where it has them, orientation and gripper.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "Parts", into = "Parts")]
pub struct PosePlan {
    position: Plan<3>,
    orientation: Option<Plan<4>>,
    grip: Option<Plan<1>>,
}

#[derive(Serialize, Deserialize)]
struct Parts {
    position: Plan<3>,
    orientation: Option<Plan<4>>,
    grip: Option<Plan<1>>,
}

impl TryFrom<Parts> for PosePlan {
    type Error = PosePlanError;

    fn try_from(parts: Parts) -> Result<Self, PosePlanError> {
        Self::new(parts.position, parts.orientation, parts.grip)
    }
}

impl From<PosePlan> for Parts {
    fn from(plan: PosePlan) -> Self {
        Self {
            position: plan.position,
            orientation: plan.orientation,
            grip: plan.grip,
        }
    }
}

impl From<Plan<3>> for PosePlan {
    fn from(position: Plan<3>) -> Self {
        Self {
            position,
            orientation: None,
            grip: None,
        }
    }
}

impl PosePlan {
    /// Puts plans together. Where one is shorter than the position's, its last value is held.
    ///
    /// # Errors
    /// [`PosePlanError`], one variant a cause.
    pub fn new(
        position: Plan<3>,
        orientation: Option<Plan<4>>,
        grip: Option<Plan<1>>,
    ) -> Result<Self, PosePlanError> {
        if let Some(plan) = &orientation {
            let curve = plan.spline().map_err(PosePlanError::Curve)?;
            let mut before_s = 0.0;
            for (index, c) in plan.checkpoints().enumerate() {
                if (c.x.norm() - 1.0).abs() > NORM_SLACK {
                    return Err(PosePlanError::NotARotation { index });
                }
                let step_s = (c.t_s - before_s) / LOOKS as f64;
                let lost =
                    |i: &usize| clamped(&curve, before_s + step_s * *i as f64).norm() < LEAST_NORM;
                if index > 0 && (1..LOOKS).any(|i| lost(&i)) {
                    return Err(PosePlanError::Gap { index });
                }
                before_s = c.t_s;
            }
        }
        for (index, c) in grip.iter().flat_map(Plan::checkpoints).enumerate() {
            if !(-GRIP_SLACK..=1.0 + GRIP_SLACK).contains(&c.x[0]) {
                return Err(PosePlanError::Grip { index });
            }
        }
        Ok(Self {
            position,
            orientation,
            grip,
        })
    }

    /// The plan of the position, m.
    pub fn position(&self) -> &Plan<3> {
        &self.position
    }

    /// The plan of the orientation: (w, x, y, z) of unit quaternions.
    pub fn orientation(&self) -> Option<&Plan<4>> {
        self.orientation.as_ref()
    }

    /// The plan of the gripper's opening, from 0 to 1.
    pub fn grip(&self) -> Option<&Plan<1>> {
        self.grip.as_ref()
    }

    /// All checkpoints together.
    pub fn len(&self) -> usize {
        self.position.len()
            + self.orientation.as_ref().map_or(0, Plan::len)
            + self.grip.as_ref().map_or(0, Plan::len)
    }

    /// Never: a position's plan has two checkpoints.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// The curves both ends read.
    ///
    /// # Errors
    /// [`CheckpointError::Spline`], which no plan that decoded shows.
    pub fn curve(&self) -> Result<PoseCurve, CheckpointError> {
        Ok(PoseCurve {
            position: self.position.spline()?,
            orientation: self.orientation.as_ref().map(Plan::spline).transpose()?,
            grip: self.grip.as_ref().map(Plan::spline).transpose()?,
        })
    }
}

/// A motion as read from a [`PosePlan`]. Every value is that of the nearest moment its own curve covers.
#[derive(Clone, Debug)]
pub struct PoseCurve {
    /// Position, m, over time, s.
    pub position: BSpline<3>,
    /// Orientation as a curve in ℝ⁴; [`pose::nearest`] reads it.
    pub orientation: Option<BSpline<4>>,
    /// The gripper's opening.
    pub grip: Option<BSpline<1>>,
}

impl PoseCurve {
    /// When the position's curve ends, s.
    pub fn end_s(&self) -> f64 {
        self.position.span_s().1
    }

    /// Position at `t_s`, m.
    pub fn position_at(&self, t_s: f64) -> Vector3<f64> {
        clamped(&self.position, t_s)
    }

    /// Orientation at `t_s`; `None` if the motion has none, or where its curve passes through the origin.
    pub fn orientation_at(&self, t_s: f64) -> Option<UnitQuaternion<f64>> {
        pose::nearest(&clamped(self.orientation.as_ref()?, t_s))
    }

    /// The gripper's opening at `t_s`, in [0, 1].
    pub fn grip_at(&self, t_s: f64) -> Option<f64> {
        Some(clamped(self.grip.as_ref()?, t_s)[0].clamp(0.0, 1.0))
    }
}

fn clamped<const D: usize>(curve: &BSpline<D>, t_s: f64) -> SVector<f64, D> {
    let (start_s, end_s) = curve.span_s();
    curve
        .eval(t_s.clamp(start_s, end_s))
        .map_or_else(|_| SVector::zeros(), |jet| jet.x)
}

/// Checkpoints of the orientations `q` at the times `t_s` such that what they decode to is within
/// `bound_rad` of *every* sample.
///
/// A curve within e = sin(ε/2) of a unit quaternion in ℝ⁴ is, normalised, within the angle ε of the rotation.
///
/// # Errors
/// [`CheckpointError`], with the bound and errors in units of ℝ⁴.
pub fn turns(
    t_s: &[f64],
    q: &[UnitQuaternion<f64>],
    bound_rad: f64,
) -> Result<Plan<4>, CheckpointError> {
    let mut points: Vec<Vector4<f64>> = Vec::with_capacity(q.len());
    for q in q {
        let point = pose::point(q, points.last());
        points.push(point);
    }
    let chord = libm::sin(0.5 * bound_rad.clamp(-1.0, 1.0));
    select::bounded(t_s, &points, chord)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::codec::{self, DecodeError};

    fn times() -> Vec<f64> {
        (0..200).map(|i| f64::from(i) * 0.01).collect()
    }

    fn turning(t_s: f64) -> UnitQuaternion<f64> {
        // Three turns about a wandering axis, with signs as a tracker may give them.
        let q = pose::exp(&(Vector3::new(0.3 * t_s, 1.0, libm::sin(2.0 * t_s)) * (9.0 * t_s)));
        if (t_s * 100.0) as i64 % 3 == 0 {
            UnitQuaternion::new_unchecked(-q.into_inner())
        } else {
            q
        }
    }

    fn plan() -> PosePlan {
        let t = times();
        let x: Vec<_> = t
            .iter()
            .map(|t| Vector3::new(libm::sin(*t), libm::cos(*t), *t))
            .collect();
        let q: Vec<_> = t.iter().map(|t| turning(*t)).collect();
        let g: Vec<_> = t
            .iter()
            .map(|t| SVector::from([if *t < 1.0 { 1.0 } else { 0.2 }]))
            .collect();
        PosePlan::new(
            select::bounded(&t, &x, 1e-3).unwrap(),
            Some(turns(&t, &q, 0.02).unwrap()),
            Some(select::bounded(&t, &g, 0.02).unwrap()),
        )
        .unwrap()
    }

    #[test]
    fn every_sample_is_within_the_angle_of_the_bound() {
        let plan = plan();
        assert!(plan.orientation().unwrap().len() < 100);
        let curve = plan.curve().unwrap();
        for t in times() {
            let error = curve.orientation_at(t).unwrap().angle_to(&turning(t));
            assert!(error <= 0.02 + 1e-9, "{error} rad at {t} s");
            let open = if t < 1.0 { 1.0 } else { 0.2 };
            assert!((curve.grip_at(t).unwrap() - open).abs() <= 0.02 + 1e-9);
        }
        assert_eq!(curve.grip_at(99.0), curve.grip_at(curve.end_s()));
    }

    #[test]
    fn bytes_come_back_and_nonsense_is_refused() {
        let plan = plan();
        let bytes = codec::encode(&plan);
        assert_eq!(codec::decode::<PosePlan, 65_536>(&bytes), Ok(plan.clone()));
        let decoded = |parts: Parts| codec::decode::<PosePlan, 65_536>(&codec::encode(&parts));
        let flat = select::bounded(&[0.0, 1.0], &[Vector4::zeros(); 2], 1e-3).unwrap();
        let refused = decoded(Parts {
            orientation: Some(flat),
            ..plan.clone().into()
        });
        assert!(
            matches!(refused, Err(DecodeError::Malformed(_))),
            "{refused:?}"
        );
        let opposite = [Vector4::x(), -Vector4::x()];
        let refused = decoded(Parts {
            orientation: Some(select::bounded(&[0.0, 1.0], &opposite, 1e-3).unwrap()),
            ..plan.clone().into()
        });
        assert!(
            matches!(refused, Err(DecodeError::Malformed(_))),
            "{refused:?}"
        );
        let wide = [SVector::from([0.0]), SVector::from([2.0])];
        let refused = decoded(Parts {
            grip: Some(select::bounded(&[0.0, 1.0], &wide, 1e-3).unwrap()),
            ..plan.into()
        });
        assert!(
            matches!(refused, Err(DecodeError::Malformed(_))),
            "{refused:?}"
        );
    }
}
