//! What a skill foretold of the present, and how wrong it was.

use nalgebra::{Matrix3, Vector3};
use telemime_protocol::time::Stamp;

/// Predictions nearer together than this are not kept, s: a fast sensor must not fill the ring.
const LEAST_SPACING_S: f64 = 0.01;

/// Room for predictions 0.2 s ahead at that spacing, and some.
const ROOM: usize = 32;

/// Added to every variance, m²: a planar motion has none across its plane.
const LEAST_M2: f64 = 1e-6;

/// The hand at a moment to come.
#[derive(Debug, Clone, Copy)]
struct Point {
    t: Stamp,
    position: Vector3<f64>,
    covariance: Matrix3<f64>,
}

/// The path foretold for the next moments: a ring, in order of time.
#[derive(Debug, Clone)]
pub(super) struct Foretold {
    points: [Point; ROOM],
    /// Points ever kept; the newest is at `kept − 1`, modulo the room.
    kept: usize,
}

impl Default for Foretold {
    fn default() -> Self {
        let nothing = Point {
            t: Stamp(0),
            position: Vector3::zeros(),
            covariance: Matrix3::zeros(),
        };
        Self {
            points: [nothing; ROOM],
            kept: 0,
        }
    }
}

impl Foretold {
    /// Keeps the prediction made at `t` for `ahead_s` later, m and m².
    pub(super) fn remember(
        &mut self,
        t: Stamp,
        ahead_s: f64,
        position: Vector3<f64>,
        covariance: Matrix3<f64>,
    ) {
        let due = Stamp::from_secs_f64(t.as_secs_f64() + ahead_s);
        if self.kept > 0 && due.secs_since(self.back(0).t) < LEAST_SPACING_S {
            return;
        }
        self.points[self.kept % ROOM] = Point {
            t: due,
            position,
            covariance,
        };
        self.kept += 1;
    }

    /// The squared error of what was foretold for `t`, in units of its covariance; `None` if nothing was.
    pub(super) fn error(&self, t: Stamp, x: &Vector3<f64>) -> Option<f64> {
        let held = self.kept.min(ROOM);
        let n = (0..held).find(|&n| self.back(n).t <= t)?;
        if n == 0 {
            return None;
        }
        let (a, b) = (self.back(n), self.back(n - 1));
        let u = t.secs_since(a.t) / b.t.secs_since(a.t);
        let e = x - a.position.lerp(&b.position, u);
        let covariance =
            a.covariance * (1.0 - u) + b.covariance * u + Matrix3::identity() * LEAST_M2;
        Some(e.dot(&covariance.cholesky()?.solve(&e)))
    }

    /// The n-th newest point.
    fn back(&self, n: usize) -> &Point {
        &self.points[(self.kept - 1 - n) % ROOM]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_is_that_of_the_path_foretold_and_old_news_is_none() {
        let mut f = Foretold::default();
        let x = Vector3::x();
        assert_eq!(f.error(Stamp(0), &x), None);
        // 3 ms apart: most are not kept, and the ring turns over more than once.
        for i in 0..500 {
            let t = Stamp(i * 3_000_000);
            let at = x * (t.as_secs_f64() + 0.2);
            f.remember(t, 0.2, at, Matrix3::identity() * (0.01 - LEAST_M2));
        }
        for ms in [1400, 1404, 1497, 1650] {
            let t = Stamp(ms * 1_000_000);
            let here = x * t.as_secs_f64();
            assert!(f.error(t, &here).unwrap() < 1e-18, "{ms}");
            let off = here + Vector3::new(0.0, 0.2, 0.0);
            assert!((f.error(t, &off).unwrap() - 4.0).abs() < 1e-9, "{ms}");
        }
        assert_eq!(f.error(Stamp(1_700_000_000), &x), None);
        assert_eq!(f.error(Stamp(1_000_000), &x), None);
    }
}
