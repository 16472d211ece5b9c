//! Formats, units and axes, as people write them.

use std::fmt;
use std::str::FromStr;

use nalgebra::{Matrix3, Vector3};
use serde::Serialize;

/// What kind of file a raw recording is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Format {
    /// OpenNI skeletons as in KARD: a joint a line, `x y z` in mm, 15 lines a frame, no times.
    Kard,
    /// Kinect SDK: a frame a line, time, then 20 × (x y z state).
    Kinect,
    /// A table with a sample a line.
    Csv,
    /// A folder of depth frames, 16-bit PNG.
    Depth,
}

/// A unit of length.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum LengthUnit {
    /// Metres.
    M,
    /// Centimetres.
    Cm,
    /// Millimetres.
    Mm,
}

impl LengthUnit {
    /// How many metres one is.
    pub fn metres(self) -> f64 {
        match self {
            Self::M => 1.0,
            Self::Cm => 1e-2,
            Self::Mm => 1e-3,
        }
    }
}

/// A unit of time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum TimeUnit {
    /// Seconds.
    S,
    /// Milliseconds.
    Ms,
    /// Microseconds.
    Us,
    /// Nanoseconds.
    Ns,
}

impl TimeUnit {
    const ALL: [Self; 4] = [Self::S, Self::Ms, Self::Us, Self::Ns];

    /// How many seconds one is.
    pub fn seconds(self) -> f64 {
        match self {
            Self::S => 1.0,
            Self::Ms => 1e-3,
            Self::Us => 1e-6,
            Self::Ns => 1e-9,
        }
    }

    /// The unit in which this usual step between samples is the most ordinary frame rate; none if
    /// even that is not between 3 and 1000 Hz.
    pub(super) fn of_step(step: f64) -> Option<Self> {
        const ORDINARY_HZ: f64 = 45.0;
        let off = |unit: Self| (step * unit.seconds() * ORDINARY_HZ).ln().abs();
        let best = Self::ALL
            .into_iter()
            .min_by(|a, b| off(*a).total_cmp(&off(*b)))?;
        (1e-3..=1.0 / 3.0)
            .contains(&(step * best.seconds()))
            .then_some(best)
    }
}

/// The gripper's readings when closed and when open, as `0,0.08`.
///
/// # Errors
/// One line that says what to write.
pub fn grip_range(text: &str) -> Result<(f64, f64), String> {
    let number = |t: &str| t.trim().parse().ok().filter(|v: &f64| v.is_finite());
    text.split_once(',')
        .and_then(|(closed, open)| number(closed).zip(number(open)))
        .filter(|(closed, open)| closed != open)
        .ok_or_else(|| format!("{text:?} is not two different numbers, as 0,0.08"))
}

/// A relabelling of axes: which signed source axis each of ours is.
///
/// ```
/// use telemime_operator::ingest::Axes;
/// // Unity (x right, y up, z forward) to a robot's base (x forward, y left, z up).
/// let axes: Axes = "z,-x,y".parse()?;
/// let ours = axes.position([1.0, 2.0, 3.0].into());
/// assert_eq!([ours.x, ours.y, ours.z], [3.0, -1.0, 2.0]);
/// # Ok::<(), String>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Axes(Matrix3<f64>);

impl Default for Axes {
    fn default() -> Self {
        Self(Matrix3::identity())
    }
}

impl Axes {
    /// A position, in our axes.
    pub fn position(&self, source: Vector3<f64>) -> Vector3<f64> {
        self.0 * source
    }

    /// A unit quaternion (w, x, y, z), in our axes; the body's own axes are relabelled alike: R → M R Mᵀ. A map that
    /// changes handedness turns the axis of rotation twice: as a vector, and as the sense of turning.
    pub fn orientation(&self, [w, x, y, z]: [f64; 4]) -> [f64; 4] {
        let v = self.0 * Vector3::new(x, y, z) * self.0.determinant();
        [w, v.x, v.y, v.z]
    }
}

impl FromStr for Axes {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let fault = || {
            format!("{text:?}: name each source axis once, signed, in the order of ours, as x,-z,y")
        };
        let mut m = Matrix3::zeros();
        let mut rows = 0;
        for (row, axis) in text.split(',').enumerate() {
            let axis = axis.trim();
            let (sign, name) = match axis.strip_prefix('-') {
                Some(name) => (-1.0, name),
                None => (1.0, axis.strip_prefix('+').unwrap_or(axis)),
            };
            let column = ["x", "y", "z"]
                .iter()
                .position(|a| *a == name)
                .filter(|_| row < 3)
                .ok_or_else(fault)?;
            m[(row, column)] = sign;
            rows += 1;
        }
        if rows == 3 && m.determinant() != 0.0 {
            Ok(Self(m))
        } else {
            Err(fault())
        }
    }
}

/// Reads and prints an enumeration by the names given.
macro_rules! words {
    ($type:ty, $($word:literal => $variant:ident),+) => {
        impl FromStr for $type {
            type Err = String;

            fn from_str(text: &str) -> Result<Self, String> {
                match text {
                    $($word => Ok(Self::$variant),)+
                    _ => Err(format!("{text:?}: one of {}", [$($word),+].join(", "))),
                }
            }
        }

        impl fmt::Display for $type {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(match self { $(Self::$variant => $word),+ })
            }
        }
    };
}

words!(Format, "kard" => Kard, "kinect" => Kinect, "csv" => Csv, "depth" => Depth);
words!(LengthUnit, "m" => M, "cm" => Cm, "mm" => Mm);
words!(TimeUnit, "s" => S, "ms" => Ms, "us" => Us, "ns" => Ns);

#[cfg(test)]
mod tests {
    use nalgebra::{Quaternion, UnitQuaternion};

    use super::*;

    #[test]
    fn the_unit_of_time_shows_in_the_step() {
        for (step, unit) in [
            (33.0, TimeUnit::Ms),
            (33_333.0, TimeUnit::Us),
            (0.033, TimeUnit::S),
            (3.3e7, TimeUnit::Ns),
            (1.0, TimeUnit::Ms),
            (200.0, TimeUnit::Ms),
            (2000.0, TimeUnit::Us),
            (0.2, TimeUnit::S),
            (0.01, TimeUnit::S),
        ] {
            assert_eq!(TimeUnit::of_step(step), Some(unit), "{step}");
        }
        assert_eq!(TimeUnit::of_step(1e11), None);
        assert_eq!(TimeUnit::of_step(0.5), None);
    }

    #[test]
    fn axes_relabel_rotations_with_the_places_they_turn() {
        let q = UnitQuaternion::from_euler_angles(0.3, -0.7, 1.1);
        let p = Vector3::new(0.2, -0.5, 0.9);
        for text in ["x,y,z", "x,-z,y", "z,-x,y", "-x,y,z", "y,x,z"] {
            let axes: Axes = text.parse().unwrap();
            let [w, i, j, k] = axes.orientation([q.w, q.i, q.j, q.k]);
            let turned = UnitQuaternion::new_unchecked(Quaternion::new(w, i, j, k));
            let (a, b) = (axes.position(q * p), turned * axes.position(p));
            assert!((a - b).norm() < 1e-12, "{text}");
        }
        for text in ["x,y", "x,y,y", "x,y,z,x", "a,b,c", ""] {
            assert!(text.parse::<Axes>().is_err(), "{text}");
        }
    }
}
