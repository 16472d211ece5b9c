//! What the tip carries.

use core::fmt;
use core::str::FromStr;

use nalgebra::{Matrix3, SymmetricEigen, Vector3};

use super::Body;

/// The heaviest payload, kg.
const MAX_MASS_KG: f64 = 1e4;

/// How far from the tip its centre may be, m.
const MAX_OFFSET_M: f64 = 10.0;

/// Its largest moment of inertia, kg·m².
const MAX_MOMENT_KG_M2: f64 = 1e6;

/// Why a payload is refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PayloadError {
    /// Not of the form that is read.
    #[error(
        "`{text}` is no payload: write KG, KG@X,Y,Z (centre in tip axes, m) or KG@X,Y,Z@IXX,IYY,IZZ (moments about the centre, kg·m²)"
    )]
    Syntax {
        /// What was written.
        text: String,
    },
    /// A mass that no payload has.
    #[error("a payload of {mass_kg} kg: it must be between 0 and {MAX_MASS_KG} kg")]
    Mass {
        /// The mass, kg.
        mass_kg: f64,
    },
    /// A centre too far away, or not finite.
    #[error("a payload's centre at ({}, {}, {}) m: it must be within {MAX_OFFSET_M} m of the tip", com_m.x, com_m.y, com_m.z)]
    Centre {
        /// The centre, m.
        com_m: Vector3<f64>,
    },
    /// Principal moments that no mass distribution has.
    #[error(
        "a payload with principal moments {moments_kg_m2:?} kg·m²: none may be negative or exceed the sum of the others (or {MAX_MOMENT_KG_M2:e})"
    )]
    Inertia {
        /// The moments in ascending order, kg·m².
        moments_kg_m2: [f64; 3],
    },
}

/// A rigid load at the tip. Model, control and simulation all know of it.
///
/// As text: `KG`, `KG@X,Y,Z` or `KG@X,Y,Z@IXX,IYY,IZZ`; without moments it is a point mass, without a centre at the tip's origin.
///
/// ```
/// use telemime_sim::arm::Payload;
///
/// let cup: Payload = "0.4@0,0,0.06".parse()?;
/// assert_eq!(cup.body().com_m.z, 0.06);
/// # Ok::<(), telemime_sim::arm::PayloadError>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Payload {
    body: Body,
}

impl Payload {
    /// A load given in tip axes: its mass, kg; its centre, m from the tip; its rotational inertia about that centre, kg·m².
    ///
    /// # Errors
    /// [`PayloadError`]: what no load has.
    pub fn new(
        mass_kg: f64,
        com_m: Vector3<f64>,
        inertia_kg_m2: Matrix3<f64>,
    ) -> Result<Self, PayloadError> {
        if !(0.0..=MAX_MASS_KG).contains(&mass_kg) {
            return Err(PayloadError::Mass { mass_kg });
        }
        if !(com_m.norm() <= MAX_OFFSET_M) {
            return Err(PayloadError::Centre { com_m });
        }
        let moments_kg_m2 = moments(&inertia_kg_m2);
        let [least, middle, most] = moments_kg_m2;
        let rounding = 1e-9 * most.abs();
        let possible = least >= -rounding && most <= least + middle + rounding;
        if !(possible && most <= MAX_MOMENT_KG_M2) {
            return Err(PayloadError::Inertia { moments_kg_m2 });
        }
        let body = Body {
            mass_kg,
            com_m,
            inertia_kg_m2,
        };
        Ok(Self { body })
    }

    /// The load as a rigid body in tip axes.
    pub fn body(&self) -> &Body {
        &self.body
    }
}

/// Principal moments in ascending order; NaN if the matrix is not finite.
pub(super) fn moments(inertia: &Matrix3<f64>) -> [f64; 3] {
    if !inertia.iter().all(|x| x.is_finite()) {
        return [f64::NAN; 3];
    }
    let mut moments = SymmetricEigen::new(*inertia).eigenvalues;
    moments.as_mut_slice().sort_by(f64::total_cmp);
    moments.into()
}

impl FromStr for Payload {
    type Err = PayloadError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let syntax = || PayloadError::Syntax {
            text: text.to_owned(),
        };
        let vector = |part: Option<&str>| -> Option<Vector3<f64>> {
            let Some(part) = part else {
                return Some(Vector3::zeros());
            };
            let numbers: Vec<f64> = part
                .split(',')
                .map(|x| x.trim().parse().ok())
                .collect::<Option<_>>()?;
            <[f64; 3]>::try_from(numbers).ok().map(Vector3::from)
        };
        let mut parts = text.split('@');
        let mass = parts.next().and_then(|x| x.trim().parse().ok());
        let (com, moments) = (vector(parts.next()), vector(parts.next()));
        match (mass, com, moments, parts.next()) {
            (Some(mass), Some(com), Some(moments), None) => {
                Self::new(mass, com, Matrix3::from_diagonal(&moments))
            }
            _ => Err(syntax()),
        }
    }
}

impl fmt::Display for Payload {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Body { mass_kg, com_m, .. } = &self.body;
        write!(
            f,
            "{mass_kg} kg at ({}, {}, {}) m",
            com_m.x, com_m.y, com_m.z
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read_and_nonsense_is_named() {
        let full: Payload = " 2 @ 0.1, -0.2,0.3@1e-3,2e-3,2.5e-3".parse().unwrap();
        assert_eq!(full.body().mass_kg, 2.0);
        assert_eq!(full.body().com_m, Vector3::new(0.1, -0.2, 0.3));
        assert_eq!(full.body().inertia_kg_m2[(2, 2)], 2.5e-3);
        let point: Payload = "1.5".parse().unwrap();
        assert_eq!(point.body().com_m, Vector3::zeros());
        for text in ["", "x", "1@2", "1@1,2,3@1,2", "1@1,2,3@1,1,1@0", "1@a,b,c"] {
            let error = text.parse::<Payload>().unwrap_err();
            assert!(matches!(error, PayloadError::Syntax { .. }), "{text}");
        }
        let fails = |text: &str| text.parse::<Payload>().unwrap_err();
        assert!(matches!(fails("-1"), PayloadError::Mass { .. }));
        assert!(matches!(fails("NaN"), PayloadError::Mass { .. }));
        assert!(matches!(fails("1@0,0,inf"), PayloadError::Centre { .. }));
        for moments in ["1,1,3", "-1,1,1", "NaN,0,0", "1e9,1e9,1e9"] {
            let error = fails(&format!("1@0,0,0@{moments}"));
            assert!(matches!(error, PayloadError::Inertia { .. }), "{moments}");
        }
    }
}
