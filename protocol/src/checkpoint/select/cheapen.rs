//! The same checkpoints in fewer bits: of the values within the bound, those that are cheap to write.

use nalgebra::SVector;

use super::super::packed::Price;
use super::super::{CheckpointError, Plan};
use super::fit::Curve;
use super::search::Motion;

/// Sweeps over all points.
const SWEEPS: usize = 12;

/// Points times samples beyond which it is not worth the memory.
const MOST: usize = 1 << 21;

/// A bit is worth this much room: the sum over the samples of (error/bound) to the sixteenth, so that what is nearly
/// at the bound is kept from it where that costs nothing.
const ROOM: f64 = 0.02;

/// Moves single values, and neighbours together, as long as that takes fewer bits and the curve stays within `bound`.
///
/// The curve is linear in its values: a step at one point adds that point's cardinal spline.
pub(super) fn cheapen<const D: usize>(
    plan: &Plan<D>,
    motion: &Motion<'_, D>,
    bound: f64,
) -> Result<Plan<D>, CheckpointError> {
    let (count, samples) = (plan.len(), motion.t.len());
    if count * samples > MOST {
        return Ok(plan.clone());
    }
    let step = plan.grid().step_m();
    let times: Vec<f64> = plan.checkpoints().map(|c| c.t_s).collect();
    let cardinals: Vec<Vec<f64>> = (0..count).map(|j| cardinal(&times, j, motion.t)).collect();
    let mut points = plan.points().to_vec();
    let mut errors: Vec<SVector<f64, D>> = motion.y.iter().map(|y| -y).collect();
    for ((_, x), cardinal) in points.iter().zip(&cardinals) {
        let x = SVector::<f64, D>::from(x.map(|n| f64::from(n) * step));
        for (e, c) in errors.iter_mut().zip(cardinal) {
            *e += x * *c;
        }
    }
    let room = |e2: f64| {
        let share = e2 / (bound * bound);
        if share > 1.0 {
            f64::INFINITY
        } else {
            share.powi(8)
        }
    };
    let mut spent: f64 = errors.iter().map(|e| room(e.norm_squared())).sum();
    if !spent.is_finite() {
        return Ok(plan.clone());
    }
    let mut price = Price::of(&points);
    for _ in 0..SWEEPS {
        let mut moved = false;
        for j in 0..count {
            for d in 0..D {
                for (here, next) in [
                    (1, 0),
                    (-1, 0),
                    (2, 0),
                    (-2, 0),
                    (1, 1),
                    (-1, -1),
                    (1, -1),
                    (-1, 1),
                ] {
                    if next != 0 && j + 1 == count {
                        continue;
                    }
                    let before = price.around(&points, j, d);
                    points[j].1[d] += here;
                    if next != 0 {
                        points[j + 1].1[d] += next;
                    }
                    let bits = price.around(&points, j, d) - before;
                    let mut better = false;
                    if bits <= 0.0 {
                        let (a, b) = (f64::from(here) * step, f64::from(next) * step);
                        let other = &cardinals[(j + 1).min(count - 1)];
                        let mut sum = 0.0;
                        let most = spent - bits / ROOM;
                        for ((e, c), o) in errors.iter().zip(&cardinals[j]).zip(other) {
                            let mut e = *e;
                            e[d] += a * c + b * o;
                            sum += room(e.norm_squared());
                            if sum >= most {
                                break;
                            }
                        }
                        if sum < most - 1e-9 {
                            better = true;
                            spent = sum;
                            for ((e, c), o) in errors.iter_mut().zip(&cardinals[j]).zip(other) {
                                e[d] += a * c + b * o;
                            }
                        }
                    }
                    if better {
                        moved = true;
                    } else {
                        points[j].1[d] -= here;
                        if next != 0 {
                            points[j + 1].1[d] -= next;
                        }
                    }
                }
            }
        }
        price = Price::of(&points);
        if !moved {
            break;
        }
    }
    plan.with_points(points)
}

/// What one step at knot `j` adds to the curve at `t`.
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
