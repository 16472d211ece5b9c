//! The same checkpoints in fewer bits: of the values within the bound, those that are cheap to write.

use nalgebra::SVector;

use super::super::Plan;
use super::super::packed::{Packer, Price};
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
pub(super) fn cheapen<const D: usize>(
    plan: &mut Plan<D>,
    motion: Motion<'_, D>,
    bound: f64,
    (room, packer): (&mut Room<D>, &mut Packer),
) {
    if plan.len() * motion.t.len() > MOST {
        return;
    }
    room.fill(plan, motion, bound);
    if !room.spent.is_finite() {
        return;
    }
    for _ in 0..SWEEPS {
        let price = Price::of(plan.points(), packer);
        let mut moved = false;
        for j in 0..plan.len() {
            for d in 0..D {
                for by in MOVES {
                    let before = price.around(plan.points(), j, d);
                    if !plan.shift(j, d, by) {
                        continue;
                    }
                    let bits = price.around(plan.points(), j, d) - before;
                    if bits <= 0.0 && room.take(j, d, by, -bits / ROOM_BITS) {
                        moved = true;
                    } else {
                        plan.shift(j, d, by.map(|n| -n));
                    }
                }
            }
        }
        if !moved {
            break;
        }
    }
}

/// How near the curve is to the bound: the sum over the samples of (error/bound) to the sixteenth, infinite beyond it.
///
/// The curve is linear in its values, so that a step at one point adds that point's cardinal spline to the errors.
#[derive(Clone, Debug, Default)]
pub(super) struct Room<const D: usize> {
    step: f64,
    bound2: f64,
    knots: Vec<f64>,
    curve: Curve<1>,
    /// For each point, what a value of one there is at the samples: one after the other.
    cardinals: Vec<f64>,
    errors: Vec<SVector<f64, D>>,
    spent: f64,
}

impl<const D: usize> Room<D> {
    fn fill(&mut self, plan: &Plan<D>, motion: Motion<'_, D>, bound: f64) {
        self.step = plan.grid().step_m();
        self.bound2 = bound * bound;
        self.knots.clear();
        self.knots.extend(plan.checkpoints().map(|c| c.t_s));
        self.errors.clear();
        self.errors.extend(motion.y.iter().map(|y| -y));
        self.cardinals.clear();
        for (j, c) in plan.checkpoints().enumerate() {
            let from = self.cardinals.len();
            self.cardinal(j, motion.t);
            for (e, share) in self.errors.iter_mut().zip(&self.cardinals[from..]) {
                *e += c.x * *share;
            }
        }
        self.spent = self.errors.iter().map(|e| self.of_error(e)).sum();
    }

    /// Adds the natural spline through 1 at knot `j` and 0 at all others, at `t`.
    fn cardinal(&mut self, j: usize, t: &[f64]) {
        let Self {
            curve,
            cardinals,
            knots,
            ..
        } = self;
        curve.t.clone_from(knots);
        curve.x.clear();
        curve.x.resize(knots.len(), SVector::zeros());
        curve.x[j][0] = 1.0;
        curve.solve();
        curve.visit(t, |_, x| {
            cardinals.push(x[0]);
            true
        });
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
        let size = (self.errors.len(), self.knots.len());
        // Less by more than rounding, or it would go to and fro.
        let most = self.spent + more - 1e-9;
        let mut sum = 0.0;
        for (e, (here, there)) in self.errors.iter().zip(ways(&self.cardinals, size, j)) {
            let mut e = *e;
            e[d] += a * here + b * there;
            sum += self.of_error(&e);
            if !(sum < most) {
                return false;
            }
        }
        self.spent = sum;
        for (e, (here, there)) in self.errors.iter_mut().zip(ways(&self.cardinals, size, j)) {
            e[d] += a * here + b * there;
        }
        true
    }
}

/// The cardinal splines of the points `j` and `j + 1` (of the last one, twice the same), of so many samples and points.
fn ways(
    cardinals: &[f64],
    (samples, points): (usize, usize),
    j: usize,
) -> impl Iterator<Item = (&f64, &f64)> {
    let of = |j: usize| &cardinals[j * samples..(j + 1) * samples];
    of(j).iter().zip(of((j + 1).min(points - 1)))
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::super::{Effort, Selector};
    use super::*;

    fn cheaper<const D: usize>(plan: &Plan<D>, motion: Motion<'_, D>, bound: f64) -> Plan<D> {
        let mut plan = plan.clone();
        let (mut room, mut packer) = (Room::default(), Packer::default());
        cheapen(&mut plan, motion, bound, (&mut room, &mut packer));
        plan
    }

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
            let mut selector = Selector::new();
            let plan = selector.bounded(&t, &y, bound_m, Effort::Brisk).unwrap();
            let motion = Motion { t: &t, y: &y };
            let cheaper = cheaper(plan, motion, bound_m * (1.0 - 1e-7));
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
        let mut selector = Selector::new();
        let plan = selector.bounded(&t, &y, 0.1, Effort::Quick).unwrap();
        let motion = Motion { t: &t, y: &y };
        assert_eq!(cheaper(plan, motion, 1e-6), *plan);
    }
}
