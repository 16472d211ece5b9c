//! The natural cubic through checkpoints, fast: what the search runs thousands of times. The promise is
//! checked on the decoder's own [`BSpline`](crate::spline::BSpline), once, at the end.

use nalgebra::SVector;

/// A natural cubic in the form of its second derivatives at the knots (de Boor, ch. IV).
#[derive(Clone, Debug, Default)]
pub(super) struct Curve<const D: usize> {
    pub(super) t: Vec<f64>,
    pub(super) x: Vec<SVector<f64, D>>,
    /// x'' at the knots.
    bend: Vec<SVector<f64, D>>,
    share: Vec<f64>,
}

impl<const D: usize> Curve<D> {
    /// Solves for the second derivatives (Thomas' algorithm; diagonally dominant).
    pub(super) fn solve(&mut self) {
        let n = self.t.len();
        self.bend.clear();
        self.bend.resize(n, SVector::zeros());
        self.share.clear();
        self.share.resize(n, 0.0);
        for i in 1..n.saturating_sub(1) {
            let (h0, h1) = (self.t[i] - self.t[i - 1], self.t[i + 1] - self.t[i]);
            let turn = (self.x[i + 1] - self.x[i]) / h1 - (self.x[i] - self.x[i - 1]) / h0;
            let pivot = 1.0 / (2.0 * (h0 + h1) - h0 * self.share[i - 1]);
            self.share[i] = h1 * pivot;
            self.bend[i] = (turn * 6.0 - self.bend[i - 1] * h0) * pivot;
        }
        for i in (1..n.saturating_sub(1)).rev() {
            let after = self.bend[i + 1];
            self.bend[i] -= after * self.share[i];
        }
    }

    /// The curve at ascending times (held before its first and after its last knot), until told to stop.
    pub(super) fn visit(&self, t: &[f64], mut go_on: impl FnMut(usize, SVector<f64, D>) -> bool) {
        let last = self.t.len() - 1;
        let mut j = 0;
        for (i, &t) in t.iter().enumerate() {
            while j + 2 <= last && t >= self.t[j + 1] {
                j += 1;
            }
            let h = self.t[j + 1] - self.t[j];
            let u = ((t - self.t[j]) / h).clamp(0.0, 1.0);
            let v = 1.0 - u;
            let bent = self.bend[j] * (v * (v * v - 1.0)) + self.bend[j + 1] * (u * (u * u - 1.0));
            let x = self.x[j] * v + self.x[j + 1] * u + bent * (h * h / 6.0);
            if !go_on(i, x) {
                break;
            }
        }
    }
}

/// The natural cubic with given knots nearest to samples, by weighted least squares.
///
/// In B-splines on the clamped knots; zero bend at the ends takes the second and the last but one
/// control point out, so that what is left has as many unknowns as there are knots, in a band of four.
#[derive(Clone, Debug, Default)]
pub(super) struct LeastSquares<const D: usize> {
    knots: Vec<f64>,
    rows: Vec<(usize, [f64; 4])>,
    at_knots: Vec<(usize, [f64; 4])>,
    band: Vec<[f64; 4]>,
    unknown: Vec<SVector<f64, D>>,
}

impl<const D: usize> LeastSquares<D> {
    /// For these knots (at least two) and ascending sample times within them.
    pub(super) fn prepare(&mut self, knots: &[f64], t: &[f64]) {
        let (start, end) = (knots[0], knots[knots.len() - 1]);
        self.knots.clear();
        self.knots.extend([start; 3]);
        self.knots.extend_from_slice(knots);
        self.knots.extend([end; 3]);
        let mut rows = std::mem::take(&mut self.rows);
        rows.clear();
        let mut span = 3;
        rows.extend(t.iter().map(|&t| self.row(t.clamp(start, end), &mut span)));
        self.rows = rows;
        let mut rows = std::mem::take(&mut self.at_knots);
        rows.clear();
        let mut span = 3;
        rows.extend(knots.iter().map(|&t| self.row(t, &mut span)));
        self.at_knots = rows;
    }

    fn row(&self, t: f64, span: &mut usize) -> (usize, [f64; 4]) {
        let k = &self.knots;
        let count = k.len() - 6;
        if count == 2 {
            let u = (t - k[3]) / (k[4] - k[3]);
            return (0, [1.0 - u, u, 0.0, 0.0]);
        }
        let n = count + 2;
        while *span + 1 < n && t >= k[*span + 1] {
            *span += 1;
        }
        let j = *span;
        let mut b = [1.0, 0.0, 0.0, 0.0];
        for degree in 1..=3 {
            let mut carry = 0.0;
            for i in 0..degree {
                let (right, left) = (k[j + 1 + i] - t, t - k[j + 1 + i - degree]);
                let share = b[i] / (right + left);
                b[i] = carry + right * share;
                carry = left * share;
            }
            b[degree] = carry;
        }
        let first = (j - 3).saturating_sub(1).min(count.saturating_sub(4));
        let mut row = [0.0; 4];
        for (c, w) in (j - 3..).zip(b) {
            if c == 1 || c == n - 2 {
                let before = 1.0 / (k[c + 3] - k[c]);
                let after = 1.0 / (k[c + 4] - k[c + 1]);
                let share = before / (before + after);
                let at = if c == 1 { 0 } else { n - 4 } - first;
                row[at] += w * share;
                row[at + 1] += w * (1.0 - share);
            } else {
                let at = if c == 0 { 0 } else { (c - 1).min(count - 1) };
                row[at - first] += w;
            }
        }
        (first, row)
    }

    /// Solves for `y` with the weights `w`; false if the samples do not determine the curve.
    pub(super) fn solve(&mut self, y: &[SVector<f64, D>], w: &[f64]) -> bool {
        let count = self.at_knots.len();
        self.band.clear();
        self.band.resize(count, [0.0; 4]);
        self.unknown.clear();
        self.unknown.resize(count, SVector::zeros());
        for ((&(first, row), y), w) in self.rows.iter().zip(y).zip(w) {
            for i in 0..4.min(count - first) {
                let weighted = w * row[i];
                self.unknown[first + i] += y * weighted;
                let there = 4.min(count - first);
                for (entry, other) in self.band[first + i].iter_mut().zip(&row[i..there]) {
                    *entry += weighted * other;
                }
            }
        }
        // Cholesky, row by row of the upper band.
        for i in 0..count {
            let pivot = self.band[i][0];
            if !(pivot > 1e-12) {
                return false;
            }
            for r in 1..4.min(count - i) {
                let factor = self.band[i][r] / pivot;
                for c in r..4.min(count - i) {
                    let step = factor * self.band[i][c];
                    self.band[i + r][c - r] -= step;
                }
                let step = self.unknown[i] * factor;
                self.unknown[i + r] -= step;
            }
        }
        for i in (0..count).rev() {
            for r in 1..4.min(count - i) {
                let step = self.unknown[i + r] * self.band[i][r];
                self.unknown[i] -= step;
            }
            self.unknown[i] /= self.band[i][0];
        }
        true
    }

    fn value(&self, (first, row): (usize, [f64; 4])) -> SVector<f64, D> {
        let there = 4.min(self.unknown.len() - first);
        (0..there).fold(SVector::zeros(), |x, i| {
            x + self.unknown[first + i] * row[i]
        })
    }

    /// The fitted curve at the samples.
    pub(super) fn at_samples(&self) -> impl Iterator<Item = SVector<f64, D>> + '_ {
        self.rows.iter().map(|&row| self.value(row))
    }

    /// The fitted curve at the knots: the checkpoints' values.
    pub(super) fn at_knots(&self) -> impl Iterator<Item = SVector<f64, D>> + '_ {
        self.at_knots.iter().map(|&row| self.value(row))
    }
}
