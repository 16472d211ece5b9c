//! Linear systems with two diagonals on either side of the main one.

use nalgebra::SVector;

/// Row `i` holds the entries of columns `i-2 ..= i+2`; those outside the matrix must be zero.
pub(super) type Row = [f64; 5];

/// Solves `A x = b` in place: `b` becomes `x`. `None` if a pivot vanishes.
///
/// Elimination without pivoting: the collocation matrices of B-splines are totally positive, for
/// which it is stable (de Boor, *A Practical Guide to Splines*, ch. XIII), and the end rows added
/// here keep their pivots away from zero. A fixed order of operations keeps both ends bit-equal.
pub(super) fn solve<const D: usize>(rows: &mut [Row], b: &mut [SVector<f64, D>]) -> Option<()> {
    let n = rows.len();
    for i in 0..n {
        let pivot = rows[i][2];
        if !pivot.is_normal() {
            return None;
        }
        for r in i + 1..(i + 3).min(n) {
            let below = i + 2 - r;
            let factor = rows[r][below] / pivot;
            if factor == 0.0 {
                continue;
            }
            for k in 1..3 {
                rows[r][below + k] -= factor * rows[i][2 + k];
            }
            let step = b[i] * factor;
            b[r] -= step;
        }
    }
    for i in (0..n).rev() {
        for k in 1..3 {
            if i + k < n {
                let step = b[i + k] * rows[i][2 + k];
                b[i] -= step;
            }
        }
        b[i] /= rows[i][2];
    }
    b.iter()
        .all(|x| x.iter().all(|v| v.is_finite()))
        .then_some(())
}
