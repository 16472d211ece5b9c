//! The same checkpoints in fewer bits: of the values within the bound, those that are cheap to write.

use nalgebra::SVector;

use super::super::packed::Price;
use super::super::{CheckpointError, Plan};
use super::fit::Curve;
use super::search::Motion;

/// Most sweeps over all points.
const SWEEPS: usize = 12;

/// Points times samples beyond which the memory is not worth it.
const MOST: usize = 1 << 21;

/// What a unit of room ([`Room`]) counts, in bits: among values that cost the same, those that keep away from the bound.
const ROOM_BITS: f64 = 0.02;

/// What is tried, in steps: of one value, and of the next point's same coordinate with it.
const MOVES: [[i32; 2]; 8] = [
    [1, 0],
    [-1, 0],
    [2, 0],
    [-2, 0],
    [1, 1],
    [-1, -1],
    [1, -1],
    [-1, 1],
];

/// Moves single values, and neighbours together, as long as that takes fewer bits and the curve stays within `bound` of
/// the samples. A motion that is too long for it, or beyond the bound already, is left as it is.
///
/// # Errors
/// None that a plan shows whose points are only moved.
pub(super) fn cheapen<const D: usize>(
    plan: &Plan<D>,
    motion: &Motion<'_, D>,
    bound: f64,
) -> Result<Plan<D>, CheckpointError> {
    let mut points = plan.points().to_vec();
    if points.len() * motion.t.len() > MOST {
        return Ok(plan.clone());
    }
    let mut room = Room::of(plan, motion, bound);
    if !room.spent.is_finite() {
        return Ok(plan.clone());
    }
    for _ in 0..SWEEPS {
        let price = Price::of(&points);
        let mut moved = false;
        for j in 0..points.len() {
            for d in 0..D {
                for by in MOVES {
                    let before = price.around(&points, j, d);
                    if !shift(&mut points, j, d, by) {
                        continue;
                    }
                    let bits = price.around(&points, j, d) - before;
                    if bits <= 0.0 && room.take(j, d, by, -bits / ROOM_BITS) {
                        moved = true;
                    } else {
                        shift(&mut points, j, d, by.map(|n| -n));
                    }
                }
            }
        }
        if !moved {
            break;
        }
    }
    plan.with_points(points)
}

/// False, and nothing has changed, if there is no next point that is to move, or it would leave the grid.
fn shift<const D: usize>(points: &mut [(u32, [i32; D])], j: usize, d: usize, by: [i32; 2]) -> bool {
    let count = if by[1] == 0 { 1 } else { 2 };
    let Some(there) = points.get_mut(j..j + count) else {
        return false;
    };
    let in_range = |x: i32, by: i32| x.abs() <= super::super::plan::MAX_STEPS - by.abs();
    if !there.iter().zip(by).all(|((_, x), by)| in_range(x[d], by)) {
        return false;
    }
    for ((_, x), by) in there.iter_mut().zip(by) {
        x[d] += by;
    }
    true
}

/// How near the curve is to the bound: the sum over the samples of (error/bound) to the sixteenth, infinite beyond it.
///
/// The curve is linear in its values, so that a step at one point adds that point's cardinal spline to the errors.
struct Room<const D: usize> {
    step: f64,
    bound2: f64,
    /// For each point, what a value of one there is at the samples.
    cardinals: Vec<Vec<f64>>,
    errors: Vec<SVector<f64, D>>,
    spent: f64,
}

impl<const D: usize> Room<D> {
    fn of(plan: &Plan<D>, motion: &Motion<'_, D>, bound: f64) -> Self {
        let knots: Vec<f64> = plan.checkpoints().map(|c| c.t_s).collect();
        let cardinals: Vec<_> = (0..knots.len())
            .map(|j| cardinal(&knots, j, motion.t))
            .collect();
        let mut errors: Vec<SVector<f64, D>> = motion.y.iter().map(|y| -y).collect();
        for (c, cardinal) in plan.checkpoints().zip(&cardinals) {
            for (e, share) in errors.iter_mut().zip(cardinal) {
                *e += c.x * *share;
            }
        }
        let mut room = Self {
            step: plan.grid().step_m(),
            bound2: bound * bound,
            cardinals,
            errors,
            spent: 0.0,
        };
        room.spent = room.errors.iter().map(|e| room.of_error(e)).sum();
        room
    }

    fn of_error(&self, e: &SVector<f64, D>) -> f64 {
        let share = e.norm_squared() / self.bound2;
        if share > 1.0 {
            return f64::INFINITY;
        }
        let fourth = share * share;
        let eighth = fourth * fourth;
        eighth * eighth
    }

    /// Takes the move if it spends less than `more` than now.
    fn take(&mut self, j: usize, d: usize, by: [i32; 2], more: f64) -> bool {
        let [a, b] = by.map(|n| f64::from(n) * self.step);
        let next = (j + 1).min(self.cardinals.len() - 1);
        let ways = || self.cardinals[j].iter().zip(&self.cardinals[next]);
        // Less by more than rounding, or it would go to and fro.
        let most = self.spent + more - 1e-9;
        let mut sum = 0.0;
        for (e, (here, there)) in self.errors.iter().zip(ways()) {
            let mut e = *e;
            e[d] += a * here + b * there;
            sum += self.of_error(&e);
            if !(sum < most) {
                return false;
            }
        }
        self.spent = sum;
        let ways = self.cardinals[j].iter().zip(&self.cardinals[next]);
        for (e, (here, there)) in self.errors.iter_mut().zip(ways) {
            e[d] += a * here + b * there;
        }
        true
    }
}

/// The natural spline through 1 at knot `j` and 0 at all others, at `t`.
fn cardinal(knots: &[f64], j: usize, t: &[f64]) -> Vec<f64> {
    let mut curve = Curve::<1>::default();
    curve.t.extend_from_slice(knots);
    curve.x.resize(knots.len(), SVector::zeros());
    curve.x[j][0] = 1.0;
    curve.solve();
    let mut values = Vec::with_capacity(t.len());
    curve.visit(t, |_, x| {
        values.push(x[0]);
        true
    });
    values
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::super::bounded::{Effort, bounded_with};
    use super::*;

    #[test]
    fn it_takes_fewer_bytes_and_keeps_the_bound() {
        let bound_m = 0.02;
        let (mut before, mut after) = (0, 0);
        for seed in 0..8 {
            let t: Vec<f64> = (0..120).map(|i| f64::from(i) / 30.0).collect();
            let noise = |i: usize| f64::from((i as u32 * 7919 + seed * 104_729) % 101) * 1e-4;
            let at = |(i, t): (usize, &f64)| {
                let phase = (2.0 + 0.3 * f64::from(seed)) * t;
                let x = Vector3::new(libm::sin(phase), libm::cos(1.7 * phase), 0.2 * phase);
                x * 0.4 + Vector3::new(noise(i), noise(3 * i), noise(5 * i))
            };
            let y: Vec<_> = t.iter().enumerate().map(at).collect();
            let plan = bounded_with(&t, &y, bound_m, Effort::Brisk).unwrap();
            let cheaper = cheapen(&plan, &Motion::new(&t, &y), bound_m * (1.0 - 1e-7)).unwrap();
            let curve = cheaper.spline().unwrap();
            let (start_s, end_s) = curve.span_s();
            for (t, y) in t.iter().zip(&y) {
                let x = curve.eval(t.clamp(start_s, end_s)).unwrap().x;
                assert!((x - y).norm() <= bound_m);
            }
            before += plan.byte_len();
            after += cheaper.byte_len();
        }
        assert!(after < before, "{after} of {before} bytes");
    }

    #[test]
    fn what_is_beyond_the_bound_is_left_as_it_is() {
        let (t, y) = ([0.0, 0.5, 1.0], [0.0, 1.01, 0.0].map(Vector3::repeat));
        let plan = bounded_with(&t, &y, 0.1, Effort::Quick).unwrap();
        let motion = Motion::new(&t, &y);
        assert_eq!(cheapen(&plan, &motion, 1e-6).unwrap(), plan);
    }
}
