//! The generic extrapolator: four scalars a knot, by ridge least squares over all demonstrations.

use nalgebra::{Matrix4, SMatrix, Vector3};
use telemime_protocol::predict::{Generic, MAX_KNOTS};

use super::Row;
use crate::learn::LearnError;

/// The ridge, as a share of each memory's own mean square: neighbouring memories tell nearly the same.
const RIDGE: f64 = 1e-3;

/// A hand that moves less than this is a sensor at rest, m² or rad².
const LEAST_M2: f64 = 1e-8;

/// The normal equations: sums over rows of products of the ways from the memories, with each other and with what followed.
pub(super) struct Products {
    n: f64,
    ways: Matrix4<f64>,
    targets: SMatrix<f64, 4, MAX_KNOTS>,
}

impl Products {
    /// Of rows in metres or radians.
    pub(super) fn of<'a>(rows: impl Iterator<Item = &'a Row>) -> Self {
        let mut out = Self {
            n: 0.0,
            ways: Matrix4::zeros(),
            targets: SMatrix::zeros(),
        };
        for row in rows {
            out.n += row.weight;
            let way = |i: usize| row.features.fixed_rows::<3>(3 * (i + 1));
            for a in 0..4 {
                for b in 0..4 {
                    out.ways[(a, b)] += row.weight * way(a).dot(&way(b));
                }
                for (j, y) in row.targets.chunks_exact(3).enumerate() {
                    let along = way(a).dot(&Vector3::from_column_slice(y));
                    out.targets[(a, j)] += row.weight * along;
                }
            }
        }
        out
    }

    /// Those that `generic` was made of, from `n` rows: all but rounding.
    pub(super) fn recovered(generic: &Generic, n: f64) -> Self {
        let mut ways = Matrix4::zeros();
        let mut packed = generic.products.iter();
        for a in 0..4 {
            for (b, v) in (0..=a).zip(&mut packed) {
                ways[(a, b)] = v * n;
                ways[(b, a)] = v * n;
            }
        }
        let lead = SMatrix::<f64, 4, MAX_KNOTS>::from_fn(|a, j| generic.lead[a][j]);
        Self {
            n,
            ways,
            targets: ridged(&ways) * lead,
        }
    }

    pub(super) fn join(&mut self, other: &Self) {
        self.n += other.n;
        self.ways += other.ways;
        self.targets += other.targets;
    }

    /// `G = (A + λ·diag A)⁻¹ B`.
    ///
    /// # Errors
    /// [`LearnError::Singular`].
    pub(super) fn solve(mut self) -> Result<Generic, LearnError> {
        let n = self.n.max(1.0);
        for a in 0..4 {
            self.ways[(a, a)] = self.ways[(a, a)].max(n * LEAST_M2);
        }
        let cholesky = ridged(&self.ways).cholesky().ok_or(LearnError::Singular)?;
        let lead = cholesky.solve(&self.targets);
        let mut products = [0.0; 10];
        let lower = (0..4).flat_map(|a| (0..=a).map(move |b| (a, b)));
        for (v, at) in products.iter_mut().zip(lower) {
            *v = self.ways[at] / n;
        }
        Ok(Generic {
            lead: std::array::from_fn(|a| std::array::from_fn(|j| lead[(a, j)])),
            products,
        })
    }
}

fn ridged(ways: &Matrix4<f64>) -> Matrix4<f64> {
    ways + Matrix4::from_diagonal(&ways.diagonal()) * RIDGE
}

#[cfg(test)]
mod tests {
    use nalgebra::SVector;

    use super::*;

    /// Rows whose displacements are a fixed combination of the ways.
    fn rows(count: u32, turn: f64) -> Vec<Row> {
        (0..count)
            .map(|i| {
                let u = f64::from(i) * 0.37;
                let mut row = Row {
                    features: SVector::from_fn(|j, _| (u * (1.0 + 0.37 * j as f64)).sin() * 0.1),
                    targets: [0.0; 3 * MAX_KNOTS],
                    orientation: Default::default(),
                    weight: 1.0,
                };
                let about = nalgebra::Rotation3::from_euler_angles(turn, 0.4 * turn, 0.0);
                for a in 0..5 {
                    let turned = about * row.features.fixed_rows::<3>(3 * a);
                    row.features.fixed_rows_mut::<3>(3 * a).copy_from(&turned);
                }
                for (j, y) in row.targets.chunks_exact_mut(3).enumerate() {
                    let d = row.features.fixed_rows::<3>(3) * (0.1 * j as f64)
                        - row.features.fixed_rows::<3>(9) * 0.5;
                    y.copy_from_slice(d.as_slice());
                }
                row
            })
            .collect()
    }

    #[test]
    fn a_combination_of_memories_is_found_whichever_way_it_is_turned() {
        let straight = Products::of(rows(200, 0.0).iter()).solve().unwrap();
        for (a, row) in straight.lead.iter().enumerate() {
            for (j, g) in row.iter().enumerate() {
                let wanted = [0.1 * j as f64, 0.0, -0.5, 0.0][a];
                assert!((g - wanted).abs() < 0.05, "{a} {j}: {g} for {wanted}");
            }
        }
        let turned = Products::of(rows(200, 1.1).iter()).solve().unwrap();
        for (a, b) in straight
            .lead
            .as_flattened()
            .iter()
            .zip(turned.lead.as_flattened())
        {
            assert!((a - b).abs() < 1e-9);
        }
    }

    #[test]
    fn what_was_fitted_is_enough_to_go_on_fitting() {
        let (first, second) = (rows(80, 0.3), rows(130, -0.8));
        let all = Products::of(first.iter().chain(&second)).solve().unwrap();
        let before = Products::of(first.iter()).solve().unwrap();
        let mut again = Products::recovered(&before, 80.0);
        again.join(&Products::of(second.iter()));
        let again = again.solve().unwrap();
        let pairs = all
            .lead
            .as_flattened()
            .iter()
            .zip(again.lead.as_flattened());
        for (a, b) in pairs.chain(all.products.iter().zip(&again.products)) {
            assert!((a - b).abs() < 1e-9, "{a} {b}");
        }
    }

    #[test]
    fn a_hand_that_never_moved_is_held() {
        let mut still = rows(30, 0.0);
        for row in &mut still {
            row.features.fill(0.0);
            row.targets.fill(0.0);
        }
        let generic = Products::of(still.iter()).solve().unwrap();
        assert_eq!(generic.lead, [[0.0; MAX_KNOTS]; 4]);
        assert!(generic.motion_m2() > 0.0);
    }
}
