//! A surface that the tip may touch.

use nalgebra::Vector3;

/// Below this sliding speed friction fades, m/s: it can then hold without chattering.
const SLIP_M_S: f64 = 0.05;

/// The stiffest surface that a substep of a quarter of a millisecond still integrates for a tip of some 100 g, N/m.
pub const MAX_STIFFNESS_N_M: f64 = 1e5;

/// Why there is no such surface.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum ContactError {
    /// A normal without direction.
    #[error("a contact plane's normal is ({}, {}, {}); it needs a length", normal[0], normal[1], normal[2])]
    Normal {
        /// What was given.
        normal: [f64; 3],
    },
    /// A number outside its range.
    #[error("a contact plane's {what} is {value}; it must be between 0 and {most}")]
    Range {
        /// Which number.
        what: &'static str,
        /// Its value.
        value: f64,
        /// The largest.
        most: f64,
    },
    /// A place that is not finite.
    #[error("a contact plane at {offset_m} m from the base; give a number")]
    Offset {
        /// What was given.
        offset_m: f64,
    },
}

/// A compliant plane: pushes the tip's origin out along its normal with k·δ·(1 + c·δ̇), never pulls (Hunt & Crossley 1975), and resists sliding by
/// Coulomb friction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactPlane {
    normal: Vector3<f64>,
    offset_m: f64,
    stiffness_n_m: f64,
    damping_s_m: f64,
    friction: f64,
}

impl ContactPlane {
    /// The surface n·x = `offset_m` (base axes, m), solid where n·x is less; `normal` is made unit. Stiffness 20 kN/m, damping 1 s/m and friction 0.3
    /// until said otherwise.
    ///
    /// # Errors
    /// [`ContactError`].
    pub fn new(normal: Vector3<f64>, offset_m: f64) -> Result<Self, ContactError> {
        let unit = normal.try_normalize(1e-9).filter(|n| n.norm().is_finite());
        let Some(unit) = unit else {
            return Err(ContactError::Normal {
                normal: normal.into(),
            });
        };
        if !offset_m.is_finite() {
            return Err(ContactError::Offset { offset_m });
        }
        Ok(Self {
            normal: unit,
            offset_m,
            stiffness_n_m: 2e4,
            damping_s_m: 1.0,
            friction: 0.3,
        })
    }

    /// The same plane of another material: stiffness, N/m; damping of Hunt and Crossley, s/m; coefficient of friction.
    ///
    /// # Errors
    /// [`ContactError::Range`].
    pub fn made_of(
        mut self,
        stiffness_n_m: f64,
        damping_s_m: f64,
        friction: f64,
    ) -> Result<Self, ContactError> {
        for (what, value, most) in [
            ("stiffness", stiffness_n_m, MAX_STIFFNESS_N_M),
            ("damping", damping_s_m, 100.0),
            ("friction", friction, 2.0),
        ] {
            if !(0.0..=most).contains(&value) {
                return Err(ContactError::Range { what, value, most });
            }
        }
        self.stiffness_n_m = stiffness_n_m;
        self.damping_s_m = damping_s_m;
        self.friction = friction;
        Ok(self)
    }

    /// How far `tip` (m) is above the surface; negative inside.
    pub fn height_m(&self, tip: &Vector3<f64>) -> f64 {
        self.normal.dot(tip) - self.offset_m
    }

    /// The force on a tip at `tip` (m) that moves with `velocity` (m/s), N in base axes.
    pub fn force(&self, tip: &Vector3<f64>, velocity: &Vector3<f64>) -> Vector3<f64> {
        let depth = -self.height_m(tip);
        if !(depth > 0.0) {
            return Vector3::zeros();
        }
        let outward = self.normal.dot(velocity);
        let push = (self.stiffness_n_m * depth * (1.0 - self.damping_s_m * outward)).max(0.0);
        let sliding = velocity - self.normal * outward;
        let drag = self.friction * push / sliding.norm().max(SLIP_M_S);
        self.normal * push - sliding * drag
    }
}
