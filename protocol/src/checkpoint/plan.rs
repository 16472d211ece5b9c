//! A finished motion on an integer grid, as it travels.

use nalgebra::SVector;
use serde::{Deserialize, Serialize};

use super::packed::{self, Packer};
use super::{Checkpoint, CheckpointError};
use crate::spline::{BSpline, End, Interpolation};

/// The most checkpoints one plan holds.
pub const MAX_POINTS: usize = 4096;

/// Coordinates stay within ± this many steps, so that a difference of two fits an `i32`.
pub(super) const MAX_STEPS: i32 = 1 << 30;
/// The coarsest time grid, µs.
const MAX_TICK_US: u32 = 1_000_000;

/// The steps on which times and positions are integers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grid {
    step_nm: u32,
    tick_us: u32,
}

impl Grid {
    /// The grid of these steps (nm, or 10⁻⁹) and ticks (µs).
    ///
    /// # Errors
    /// [`CheckpointError::Grid`]: a step of zero, a tick of zero or more than a second.
    pub fn new(step_nm: u32, tick_us: u32) -> Result<Self, CheckpointError> {
        if step_nm == 0 || !(1..=MAX_TICK_US).contains(&tick_us) {
            return Err(CheckpointError::Grid { step_nm, tick_us });
        }
        Ok(Self { step_nm, tick_us })
    }

    /// Step of the positions, nm.
    pub fn step_nm(self) -> u32 {
        self.step_nm
    }

    /// Step of the times, µs.
    pub fn tick_us(self) -> u32 {
        self.tick_us
    }

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

    /// Steps `factor` times as long (at least one, at most the longest there is), to two digits downwards.
    #[must_use]
    pub fn coarser(self, factor: f64) -> Self {
        let step_nm = (f64::from(self.step_nm) * factor.max(1.0) * (1.0 + 1e-9)) as u32;
        let unit = 10u32.pow(step_nm.ilog10().saturating_sub(1));
        Self {
            step_nm: step_nm / unit * unit,
            ..self
        }
    }

    /// Ticks of the interval of even samples at `t` (s); the ticks there were, if they are not even.
    #[must_use]
    pub fn with_ticks_of(self, t: &[f64]) -> Self {
        let (Some(first), Some(last)) = (t.first(), t.last()) else {
            return self;
        };
        let tick_us = ((last - first) / (t.len().max(2) - 1) as f64 * 1e6).round();
        let on_tick = |t: &f64| {
            let ticks = t * 1e6 / tick_us;
            (ticks - ticks.round()).abs() < 0.02
        };
        if (1.0..=f64::from(MAX_TICK_US)).contains(&tick_us) && t.iter().all(on_tick) {
            let tick_us = tick_us as u32;
            Self { tick_us, ..self }
        } else {
            self
        }
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
        let mut plan = Self::blank();
        plan.requantise(grid, points.iter().copied())?;
        Ok(plan)
    }

    /// Nothing yet: a place for [`Plan::requantise`].
    pub(super) fn blank() -> Self {
        let grid = Grid {
            step_nm: 1,
            tick_us: 1,
        };
        let points = Vec::new();
        Self { grid, points }
    }

    /// Becomes a plan of `points` rounded to `grid`, in the memory it has; after an error it is none.
    pub(super) fn requantise(
        &mut self,
        grid: Grid,
        points: impl Iterator<Item = Checkpoint<D>>,
    ) -> Result<(), CheckpointError> {
        self.grid = grid;
        self.points.clear();
        for (index, p) in points.enumerate() {
            let point = grid.ticks(p.t_s).zip(grid.steps(&p.x));
            self.points
                .push(point.ok_or(CheckpointError::OutOfRange { index })?);
        }
        self.check()
    }

    /// Becomes `other`, in the memory it has.
    pub(super) fn copy(&mut self, other: &Self) {
        self.grid = other.grid;
        self.points.clone_from(&other.points);
    }

    /// Memory for so many points.
    pub(super) fn reserve(&mut self, count: usize) {
        self.points.clear();
        self.points.reserve(count);
    }

    /// Moves the coordinate `d` of the point `j` and of the next by so many steps. False, and nothing has changed, if there
    /// is no next point that is to move, or it would leave the grid.
    pub(super) fn shift(&mut self, j: usize, d: usize, by: [i32; 2]) -> bool {
        let count = if by[1] == 0 { 1 } else { 2 };
        let Some(there) = self.points.get_mut(j..j + count) else {
            return false;
        };
        let in_range = |x: i32, by: i32| x.abs() <= MAX_STEPS - by.abs();
        if !there.iter().zip(by).all(|((_, x), by)| in_range(x[d], by)) {
            return false;
        }
        for ((_, x), by) in there.iter_mut().zip(by) {
            x[d] += by;
        }
        true
    }

    fn checked(grid: Grid, points: Vec<(u32, [i32; D])>) -> Result<Self, CheckpointError> {
        let plan = Self { grid, points };
        plan.check().map(|()| plan)
    }

    fn check(&self) -> Result<(), CheckpointError> {
        let points = &self.points;
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
            None => Ok(()),
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

    /// The points, in ticks and steps.
    pub(super) fn points(&self) -> &[(u32, [i32; D])] {
        &self.points
    }

    /// The grid its points lie on.
    pub fn grid(&self) -> Grid {
        self.grid
    }

    /// How many bytes it takes on the wire, its own length among them.
    pub fn byte_len(&self) -> usize {
        self.byte_len_by(&mut Packer::default())
    }

    /// The same, with the packer's memory.
    pub(super) fn byte_len_by(&self, packer: &mut Packer) -> usize {
        let bytes = packer.pack(self.grid, &self.points).len();
        bytes + if bytes < 251 { 1 } else { 3 }
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
        self.spline_by(&mut Decoder::default()).cloned()
    }

    /// The same, in the decoder's memory.
    pub(super) fn spline_by<'a>(
        &self,
        decoder: &'a mut Decoder<D>,
    ) -> Result<&'a BSpline<D>, CheckpointError> {
        let Decoder { t, x, curve } = decoder;
        t.clear();
        x.clear();
        for c in self.checkpoints() {
            t.push(c.t_s);
            x.push(c.x);
        }
        Ok(curve.through(t, x, End::Natural)?)
    }
}

/// What decoding a plan reuses.
#[derive(Clone, Debug, Default)]
pub(super) struct Decoder<const D: usize> {
    t: Vec<f64>,
    x: Vec<SVector<f64, D>>,
    curve: Interpolation<D>,
}

/// A plan as bytes see it.
#[derive(Serialize, Deserialize)]
struct PlanWire(Vec<u8>);

impl<const D: usize> From<Plan<D>> for PlanWire {
    fn from(plan: Plan<D>) -> Self {
        Self(packed::pack(plan.grid, &plan.points))
    }
}

impl<const D: usize> TryFrom<PlanWire> for Plan<D> {
    type Error = CheckpointError;

    fn try_from(wire: PlanWire) -> Result<Self, CheckpointError> {
        let (grid, points) = packed::unpack(&wire.0)?;
        Self::checked(grid, points)
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
        let golden = [
            &[0x14, 0x8e, 0x2c, 0x89, 0xec, 0x88, 0x01, 0x15, 0xca, 0x16][..],
            &[
                0x41, 0xdf, 0x9e, 0x4e, 0x4e, 0x57, 0x93, 0x3c, 0x00, 0xfa, 0x20,
            ],
        ]
        .concat();
        assert_eq!(bytes, golden);
        assert_eq!(bytes.len(), plan.byte_len());
        assert_eq!(decode::<Plan<3>, 4096>(&bytes), Ok(plan));
    }

    #[test]
    fn decoded_points_lie_within_half_a_step() {
        let last = plan().checkpoints().last().unwrap();
        assert!((last.t_s - 0.4).abs() < 1e-12 && (last.x[2] - 0.7).abs() < 1e-12);
        assert_eq!(plan().checkpoints().nth(1).unwrap().t_s, 0.25);
    }

    /// The bytes of a list, as [`PlanWire`].
    fn refused(bytes: &[u8]) -> String {
        match decode::<Plan<3>, 65_536>(&encode(&bytes.to_vec())) {
            Err(DecodeError::Malformed(why)) => why,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_plan_that_breaks_a_rule_is_no_plan() {
        let packed = |grid, points: &[(u32, [i32; 3])]| packed::pack(grid, points);
        let grid = Grid::new(1000, 1000).unwrap();
        let two = [(0, [0; 3]), (5, [1; 3])];
        assert!(refused(&packed(Grid { step_nm: 0, ..grid }, &two)).contains("grid"));
        assert!(refused(&packed(Grid { tick_us: 0, ..grid }, &two)).contains("grid"));
        let slow = Grid {
            tick_us: 1_000_001,
            ..grid
        };
        assert!(refused(&packed(slow, &two)).contains("grid"));
        assert!(refused(&packed(grid, &two[..1])).contains("at least 2"));
        let many: Vec<_> = (0..=MAX_POINTS as u32).map(|t| (t, [0; 3])).collect();
        assert!(refused(&packed(grid, &many)).contains("more than"));
        let far = [(0, [0; 3]), (5, [MAX_STEPS + 1, 0, 0])];
        assert!(refused(&packed(grid, &far)).contains("range"));
        let mut long = packed(grid, &two);
        long.push(0);
        assert!(refused(&long).contains("left over"));
        long.truncate(long.len() - 2);
        assert!(refused(&long).contains("too soon"));
    }

    #[test]
    fn another_spelling_of_a_plan_is_refused() {
        // Each column's order sits after the head: try every other value of every bit.
        let bytes = encode(&plan());
        let mut same = 0;
        for bit in 8..bytes.len() * 8 {
            let mut other = bytes.clone();
            other[bit / 8] ^= 0x80 >> (bit % 8);
            if decode::<Plan<3>, 4096>(&other).is_ok_and(|p| p == plan()) {
                same += 1;
            }
        }
        assert_eq!(same, 0);
    }

    proptest::proptest! {
        #[test]
        fn any_bytes_decode_or_err(bytes: Vec<u8>) {
            if let Ok(plan) = decode::<Plan<3>, 65_536>(&encode(&bytes)) {
                proptest::prop_assert_eq!(encode(&plan), encode(&bytes));
            }
        }

        #[test]
        fn any_plan_comes_back(
            points in proptest::collection::vec((1u32..1 << 18, proptest::array::uniform3(-MAX_STEPS..=MAX_STEPS)), 2..40),
        ) {
            let mut t = 0;
            let points = points.into_iter().map(|(dt, x)| { t += dt; (t - 1, x) }).collect();
            let plan = Plan::checked(Grid::new(12_345, 33_333).unwrap(), points).unwrap();
            let bytes = encode(&plan);
            proptest::prop_assert_eq!(bytes.len(), plan.byte_len());
            proptest::prop_assert_eq!(decode::<Plan<3>, 65_536>(&bytes), Ok(plan));
        }
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
