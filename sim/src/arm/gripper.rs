//! The simulated gripper: an opening that follows a command at a limited speed.

/// Why a gripper cannot be made.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum GripperError {
    /// A speed that is not a positive number.
    #[error("a gripper's speed is {value} strokes/s; it must be a positive number")]
    Speed {
        /// The value.
        value: f64,
    },
}

/// A parallel gripper without dynamics: what it holds is not modelled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gripper {
    speed: f64,
    opening: f64,
}

impl Default for Gripper {
    /// Open, and from there closed in 0.8 s: that of a published arm.
    fn default() -> Self {
        Self {
            speed: 1.25,
            opening: 1.0,
        }
    }
}

impl Gripper {
    /// An open gripper that moves at up to `speed` strokes a second.
    ///
    /// # Errors
    /// [`GripperError::Speed`]: not a positive number.
    pub fn new(speed: f64) -> Result<Self, GripperError> {
        if !(speed.is_finite() && speed > 0.0) {
            return Err(GripperError::Speed { value: speed });
        }
        Ok(Self {
            speed,
            opening: 1.0,
        })
    }

    /// How far it is open: 0 is closed, 1 is open.
    pub fn opening(&self) -> f64 {
        self.opening
    }

    /// `dt_s` seconds towards the opening `target`, taken as the nearest in [0, 1]; returns the opening then. A target that is not finite, or a `dt_s` that is
    /// not a positive number, moves nothing.
    pub fn step(&mut self, target: f64, dt_s: f64) -> f64 {
        if target.is_finite() && dt_s.is_finite() && dt_s > 0.0 {
            let most = self.speed * dt_s;
            self.opening += (target.clamp(0.0, 1.0) - self.opening).clamp(-most, most);
        }
        self.opening
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn it_stays_within_its_stroke_and_speed(
            speed in 0.01..50.0_f64,
            targets in prop::collection::vec(-2.0..3.0_f64, 1..50),
        ) {
            let mut gripper = Gripper::new(speed).unwrap();
            for target in targets {
                let before = gripper.opening();
                let after = gripper.step(target, 1e-2);
                prop_assert!((0.0..=1.0).contains(&after));
                prop_assert!((after - before).abs() <= speed * 1e-2 * (1.0 + 1e-9));
                let aim = target.clamp(0.0, 1.0);
                prop_assert!((after - aim).abs() <= (before - aim).abs());
            }
        }
    }

    #[test]
    fn it_closes_in_its_time_and_nonsense_moves_nothing() {
        let mut gripper = Gripper::default();
        let ticks = (1..).take_while(|_| gripper.step(0.0, 1e-3) > 0.0).count();
        assert!((799..=800).contains(&ticks), "{ticks} ms");
        for (target, dt_s) in [
            (f64::NAN, 1e-3),
            (f64::INFINITY, 1e-3),
            (1.0, f64::NAN),
            (1.0, -1.0),
        ] {
            assert_eq!(gripper.step(target, dt_s), 0.0);
        }
        for speed in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(matches!(
                Gripper::new(speed),
                Err(GripperError::Speed { .. })
            ));
        }
    }
}
