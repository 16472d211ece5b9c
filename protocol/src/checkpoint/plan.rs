//! A finished motion on an integer grid, as it travels.

use nalgebra::SVector;
use serde::{Deserialize, Serialize};

use super::{Checkpoint, CheckpointError};
use crate::spline::{BSpline, End};

/// The most checkpoints one plan holds.
pub const MAX_POINTS: usize = 4096;

/// Coordinates stay within ± this many steps, so that a difference of two fits an `i32`.
const MAX_STEPS: i32 = 1 << 30;
/// The coarsest time grid, µs.
const MAX_TICK_US: u32 = 1_000_000;

/// The steps on which times and positions are integers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grid {
    step_nm: u32,
    tick_us: u32,
}

impl Grid {
    /// The grid for an error bound: positions in steps of a quarter of it, times in ticks of 1 ms.
    ///
    /// In three dimensions rounding to that step costs at most √3/8 ≈ 0.22 of the bound, which leaves
    /// 0.78 of it for the curve.
    ///
    /// # Errors
    /// [`CheckpointError::Bound`], [`CheckpointError::BoundTooFine`].
    pub fn for_bound(bound_m: f64) -> Result<Self, CheckpointError> {
        let largest_m = f64::from(u32::MAX) * 4e-9;
        if !(bound_m > 0.0 && bound_m <= largest_m) {
            return Err(CheckpointError::Bound { bound_m, largest_m });
        }
        // One part in 10⁹ of slack, so that 4 nm is 1 step and not 0.999….
        let step_nm = (bound_m / 4e-9 * (1.0 + 1e-9)) as u32;
        if step_nm == 0 {
            return Err(CheckpointError::BoundTooFine {
                bound_m,
                least_m: 4e-9,
            });
        }
        Ok(Self {
            step_nm,
            tick_us: 1000,
        })
    }

    /// The same steps with ticks of 1 µs, for samples that do not lie on whole milliseconds.
    #[must_use]
    pub fn with_fine_ticks(self) -> Self {
        Self { tick_us: 1, ..self }
    }

    /// Step of the positions, m.
    pub fn step_m(self) -> f64 {
        f64::from(self.step_nm) * 1e-9
    }

    /// Step of the times, s.
    pub fn tick_s(self) -> f64 {
        f64::from(self.tick_us) * 1e-6
    }

    fn steps<const D: usize>(self, x: &SVector<f64, D>) -> Option<[i32; D]> {
        let limit = f64::from(MAX_STEPS);
        let scaled = x / self.step_m();
        let inside = scaled.iter().all(|v| v.abs() <= limit);
        inside.then(|| core::array::from_fn(|d| scaled[d].round() as i32))
    }

    fn ticks(self, t_s: f64) -> Option<u32> {
        let ticks = (t_s / self.tick_s()).round();
        (0.0..=f64::from(u32::MAX))
            .contains(&ticks)
            .then_some(ticks as u32)
    }
}

/// The checkpoints of one motion, quantised: 2 ..= [`MAX_POINTS`] points, times strictly increasing.
///
/// What both ends hold; its serde form is delta-coded, and a decoded plan has passed every check.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "PlanWire", into = "PlanWire")]
pub struct Plan<const D: usize> {
    grid: Grid,
    points: Vec<(u32, [i32; D])>,
}

impl<const D: usize> Plan<D> {
    /// `points` rounded to `grid`.
    ///
    /// # Errors
    /// [`CheckpointError`]: too few or too many points, times that do not increase on the grid, values
    /// outside its range.
    pub fn quantise(grid: Grid, points: &[Checkpoint<D>]) -> Result<Self, CheckpointError> {
        let rounded = points
            .iter()
            .enumerate()
            .map(|(index, p)| {
                let ticks = grid.ticks(p.t_s);
                let steps = grid.steps(&p.x);
                ticks
                    .zip(steps)
                    .ok_or(CheckpointError::OutOfRange { index })
            })
            .collect::<Result<_, _>>()?;
        Self::checked(grid, rounded)
    }

    fn checked(grid: Grid, points: Vec<(u32, [i32; D])>) -> Result<Self, CheckpointError> {
        if points.len() < 2 {
            return Err(CheckpointError::TooFew {
                count: points.len(),
                least: 2,
            });
        }
        if points.len() > MAX_POINTS {
            return Err(CheckpointError::TooMany);
        }
        match points.windows(2).position(|w| w[1].0 <= w[0].0) {
            Some(i) => Err(CheckpointError::Unordered { index: i + 1 }),
            None => Ok(Self { grid, points }),
        }
    }

    /// How many checkpoints.
    #[allow(
        clippy::len_without_is_empty,
        reason = "a plan has at least two points"
    )]
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// The grid its points lie on.
    pub fn grid(&self) -> Grid {
        self.grid
    }

    /// The decoded checkpoints.
    pub fn checkpoints(&self) -> impl ExactSizeIterator<Item = Checkpoint<D>> + '_ {
        let (tick_s, step_m) = (self.grid.tick_s(), self.grid.step_m());
        self.points.iter().map(move |(ticks, steps)| Checkpoint {
            t_s: f64::from(*ticks) * tick_s,
            x: SVector::from(steps.map(|n| f64::from(n) * step_m)),
        })
    }

    /// The decoded motion: the interpolating cubic with natural ends, over the plan's own times (s).
    ///
    /// # Errors
    /// [`SplineError::Singular`](crate::spline::SplineError::Singular) for times so uneven (a billion to
    /// one) that `f64` cannot tell them apart.
    pub fn spline(&self) -> Result<BSpline<D>, CheckpointError> {
        let (t, x): (Vec<f64>, Vec<_>) = self.checkpoints().map(|c| (c.t_s, c.x)).unzip();
        Ok(BSpline::interpolate(&t, &x, End::Natural)?)
    }
}

/// A plan as bytes see it: the first differences, dimension by dimension within a point.
#[derive(Serialize, Deserialize)]
struct PlanWire {
    step_nm: u32,
    tick_us: u32,
    dt: Vec<u32>,
    dx: Vec<i32>,
}

impl<const D: usize> From<Plan<D>> for PlanWire {
    fn from(plan: Plan<D>) -> Self {
        let (mut t, mut x) = (0, [0; D]);
        let mut dt = Vec::with_capacity(plan.len());
        let mut dx = Vec::with_capacity(plan.len() * D);
        for (ticks, steps) in plan.points {
            dt.push(ticks - t);
            dx.extend(steps.iter().zip(x).map(|(now, before)| now - before));
            (t, x) = (ticks, steps);
        }
        Self {
            step_nm: plan.grid.step_nm,
            tick_us: plan.grid.tick_us,
            dt,
            dx,
        }
    }
}

impl<const D: usize> TryFrom<PlanWire> for Plan<D> {
    type Error = CheckpointError;

    fn try_from(wire: PlanWire) -> Result<Self, CheckpointError> {
        let PlanWire {
            step_nm,
            tick_us,
            dt,
            dx,
        } = wire;
        if step_nm == 0 || !(1..=MAX_TICK_US).contains(&tick_us) {
            return Err(CheckpointError::Grid { step_nm, tick_us });
        }
        if dt.len() > MAX_POINTS {
            return Err(CheckpointError::TooMany);
        }
        if dx.len() != dt.len() * D {
            return Err(CheckpointError::CountMismatch {
                times: dt.len(),
                positions: dx.len() / D.max(1),
            });
        }
        let (mut t, mut x) = (0u32, [0i32; D]);
        let mut points = Vec::with_capacity(dt.len());
        for (index, (dt, dx)) in dt.iter().zip(dx.chunks_exact(D)).enumerate() {
            let out_of_range = CheckpointError::OutOfRange { index };
            t = t.checked_add(*dt).ok_or(out_of_range.clone())?;
            for (now, d) in x.iter_mut().zip(dx) {
                *now = now
                    .checked_add(*d)
                    .filter(|n| (-MAX_STEPS..=MAX_STEPS).contains(n))
                    .ok_or(out_of_range.clone())?;
            }
            points.push((t, x));
        }
        Self::checked(Grid { step_nm, tick_us }, points)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::codec::{DecodeError, decode, encode};

    fn plan() -> Plan<3> {
        let grid = Grid::for_bound(0.004).unwrap();
        let point = |t_s, x| Checkpoint {
            t_s,
            x: SVector::from(x),
        };
        let points = [
            point(0.0, [0.1, 0.0, -0.3]),
            point(0.2504, [0.15, 0.05, -0.3]),
            point(0.4, [0.2, 0.01, 0.7]),
        ];
        Plan::quantise(grid, &points).unwrap()
    }

    #[test]
    fn the_bytes_are_pinned_and_come_back() {
        let plan = plan();
        let bytes = encode(&plan);
        // step 10⁶ nm, tick 10³ µs; 3 times; 9 zigzag differences, in steps of 1 mm.
        let golden = [
            &[252, 64, 66, 15, 0, 251, 232, 3, 3, 0, 250, 150, 9][..],
            &[200, 0, 251, 87, 2, 100, 100, 0, 100, 79, 251, 208, 7],
        ]
        .concat();
        assert_eq!(bytes, golden);
        assert_eq!(decode::<Plan<3>, 4096>(&bytes), Ok(plan));
    }

    #[test]
    fn decoded_points_lie_within_half_a_step() {
        let last = plan().checkpoints().last().unwrap();
        assert!((last.t_s - 0.4).abs() < 1e-12 && (last.x[2] - 0.7).abs() < 1e-12);
        assert_eq!(plan().checkpoints().nth(1).unwrap().t_s, 0.25);
    }

    #[test]
    fn a_plan_that_breaks_a_rule_is_no_plan() {
        let refuse = |change: fn(&mut PlanWire)| {
            let mut wire = PlanWire::from(plan());
            change(&mut wire);
            let bytes = encode(&wire);
            matches!(
                decode::<Plan<3>, 65_536>(&bytes),
                Err(DecodeError::Malformed(_))
            )
        };
        assert!(refuse(|w| w.step_nm = 0));
        assert!(refuse(|w| w.tick_us = 0));
        assert!(refuse(|w| w.dt[1] = 0));
        assert!(refuse(|w| w.dt[1] = u32::MAX - 1));
        assert!(refuse(|w| w.dx[4] = i32::MAX));
        assert!(refuse(|w| w.dx.truncate(8)));
        assert!(refuse(|w| (w.dt, w.dx) = (vec![0], vec![0; 3])));
        assert!(refuse(|w| {
            w.dt = vec![1; MAX_POINTS + 1];
            w.dx = vec![0; 3 * (MAX_POINTS + 1)];
        }));
    }

    #[test]
    fn a_grid_needs_a_usable_bound() {
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY, 20.0] {
            assert!(matches!(
                Grid::for_bound(bad),
                Err(CheckpointError::Bound { .. })
            ));
        }
        assert!(matches!(
            Grid::for_bound(1e-9),
            Err(CheckpointError::BoundTooFine { .. })
        ));
        assert_eq!(Grid::for_bound(4e-9).unwrap().step_nm, 1);
    }
}
