//! An actuator's dead time: what is asked for now takes effect a fixed time later.

/// The longest dead time modelled, s.
pub const MAX_DEAD_TIME_S: f64 = 0.05;

/// A dead time that is not modelled.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum DeadTimeError {
    /// Outside the range.
    #[error(
        "a dead time of {seconds} s: it must be between 0 and {MAX_DEAD_TIME_S} s (0 to 50 ms)"
    )]
    OutOfRange {
        /// What was asked for, s.
        seconds: f64,
    },
    /// No tick.
    #[error("a tick of {dt_s} s: it must be a positive number")]
    Tick {
        /// What was given, s.
        dt_s: f64,
    },
}

/// A delay line of whole ticks, full from the start and never empty: allocated once, passing is a swap.
#[derive(Clone, Debug)]
pub struct DeadTime<T> {
    line: Box<[T]>,
    next: usize,
    seconds: f64,
}

impl<T: Copy> DeadTime<T> {
    /// A line of `seconds`, rounded to ticks of `dt_s` (s), in which `rest` has been for ever.
    ///
    /// # Errors
    /// [`DeadTimeError`].
    pub fn new(seconds: f64, dt_s: f64, rest: T) -> Result<Self, DeadTimeError> {
        if !(0.0..=MAX_DEAD_TIME_S).contains(&seconds) {
            return Err(DeadTimeError::OutOfRange { seconds });
        }
        if !(dt_s.is_finite() && dt_s > 0.0) {
            return Err(DeadTimeError::Tick { dt_s });
        }
        let ticks = (seconds / dt_s).round();
        Ok(Self {
            line: vec![rest; ticks as usize].into(),
            next: 0,
            seconds: ticks * dt_s,
        })
    }

    /// The dead time in whole ticks, s.
    pub fn seconds(&self) -> f64 {
        self.seconds
    }

    /// One tick: `asked` goes in, and what was asked for the dead time ago comes out.
    pub fn pass(&mut self, asked: T) -> T {
        let Some(slot) = self.line.get_mut(self.next) else {
            return asked;
        };
        let due = std::mem::replace(slot, asked);
        self.next = (self.next + 1) % self.line.len();
        due
    }

    /// Forgets what is on its way: `rest` has been asked for ever.
    pub fn fill(&mut self, rest: T) {
        self.line.fill(rest);
    }

    /// What is on its way, what is due next first, into `line` in place of what that holds.
    pub fn save(&self, line: &mut Vec<T>) {
        line.clear();
        line.extend_from_slice(&self.line[self.next..]);
        line.extend_from_slice(&self.line[..self.next]);
    }

    /// Puts `line`, what is due next first, on its way; says whether it is as long as the dead time.
    pub fn restore(&mut self, line: &[T]) -> bool {
        let fits = line.len() == self.line.len();
        if fits {
            self.line.copy_from_slice(line);
            self.next = 0;
        }
        fits
    }

    /// What is on its way, in no particular order.
    pub fn on_its_way(&self) -> &[T] {
        &self.line
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_asked_comes_out_exactly_the_dead_time_later() {
        for ticks in [0_usize, 1, 20, 50] {
            let mut line = DeadTime::new(ticks as f64 * 1e-3, 1e-3, -1).unwrap();
            assert!((line.seconds() - ticks as f64 * 1e-3).abs() < 1e-15);
            for now in 0..200 {
                let due = now - ticks as i32;
                assert_eq!(line.pass(now), if due < 0 { -1 } else { due });
            }
            line.fill(7);
            assert!((0..ticks).all(|_| line.pass(0) == 7));
            assert_eq!(line.on_its_way().len(), ticks);
        }
    }

    #[test]
    fn a_dead_time_that_is_none_is_refused() {
        for seconds in [-1e-3, 0.051, f64::NAN, f64::INFINITY] {
            let error = DeadTime::new(seconds, 1e-3, 0).unwrap_err();
            assert!(matches!(error, DeadTimeError::OutOfRange { .. }), "{error}");
        }
        assert!(DeadTime::new(0.01, 0.0, 0).is_err());
    }
}
