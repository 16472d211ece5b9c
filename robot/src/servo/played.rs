//! A trajectory as numbers, for a record: knots and control points of its curves.

use std::sync::Arc;

use nalgebra::SVector;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};
use telemime_protocol::checkpoint::PoseCurve;
use telemime_protocol::spline::BSpline;

use super::orders::Trajectory;

#[derive(Serialize, Deserialize)]
struct Curve<const D: usize> {
    knots: Vec<f64>,
    control: Vec<SVector<f64, D>>,
}

#[derive(Serialize, Deserialize)]
struct Numbers {
    position: Curve<3>,
    orientation: Option<Curve<4>>,
    grip: Option<Curve<1>>,
    duration_s: f64,
}

impl<const D: usize> Curve<D> {
    fn of(curve: &BSpline<D>) -> Self {
        Self {
            knots: curve.knots().to_vec(),
            control: curve.control().to_vec(),
        }
    }

    fn read<E: de::Error>(self) -> Result<BSpline<D>, E> {
        BSpline::new(self.knots, self.control).map_err(E::custom)
    }
}

pub(super) fn serialize<S: Serializer>(played: &Arc<Trajectory>, to: S) -> Result<S::Ok, S::Error> {
    let curve = &played.curve;
    Numbers {
        position: Curve::of(&curve.position),
        orientation: curve.orientation.as_ref().map(Curve::of),
        grip: curve.grip.as_ref().map(Curve::of),
        duration_s: played.duration_s,
    }
    .serialize(to)
}

pub(super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Arc<Trajectory>, D::Error> {
    let numbers = Numbers::deserialize(from)?;
    Ok(Arc::new(Trajectory {
        curve: PoseCurve {
            position: numbers.position.read()?,
            orientation: numbers.orientation.map(Curve::read).transpose()?,
            grip: numbers.grip.map(Curve::read).transpose()?,
        },
        duration_s: numbers.duration_s,
    }))
}
