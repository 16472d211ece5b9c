//! One pass over the data: E step and the sums of the M step together.
//!
//! Rows are taken in tiles of [`LANES`], coordinate by coordinate, so that every inner loop is the same
//! operation on neighbouring numbers. Responsibilities live for one block of rows only: memory beside the
//! data does not grow with K·N. Sums are taken about the component's present mean, lane by lane, and
//! added up in an order that depends on nothing but the number of rows.

use nalgebra::{SMatrix, SVector};
use rayon::prelude::*;
use telemime_protocol::skill::{Gmm, MAX_COMPONENTS};

/// Rows of a tile.
pub(in crate::learn) const LANES: usize = 8;

/// Tiles whose responsibilities are kept at a time.
const BLOCK: usize = 16;

/// Tiles of one parallel task: fixed, so that the sums do not depend on the number of threads.
const CHUNK: usize = 512;

/// ln of the smallest responsibility that adds anything to a sum of doubles.
const NEGLIGIBLE: f64 = -41.5;

/// Stands for a log density of −∞ (or NaN), so that differences of them stay numbers.
const FLOOR: f64 = -1e300;

type Lanes = [f64; LANES];

/// Rows, transposed in tiles.
pub(in crate::learn) struct Tiles<const D: usize> {
    tiles: Vec<[Lanes; D]>,
    rows: usize,
    /// Of each lane, if rows do not all count alike.
    weights: Vec<Lanes>,
}

impl<const D: usize> Tiles<D> {
    /// The last tile is filled up with its last row.
    pub(in crate::learn) fn new(rows: &[SVector<f64, D>]) -> Self {
        let tiles = rows
            .chunks(LANES)
            .map(|chunk| {
                std::array::from_fn(|i| std::array::from_fn(|l| chunk[l.min(chunk.len() - 1)][i]))
            })
            .collect();
        Self {
            tiles,
            rows: rows.len(),
            weights: Vec::new(),
        }
    }

    /// Rows that count as often as their weights say.
    pub(in crate::learn) fn weighted(rows: &[SVector<f64, D>], weights: &[f64]) -> Self {
        let lanes = |chunk: &[f64]| std::array::from_fn(|l| chunk.get(l).copied().unwrap_or(0.0));
        Self {
            weights: weights.chunks(LANES).map(lanes).collect(),
            ..Self::new(rows)
        }
    }

    /// How often a row counts.
    pub(in crate::learn) fn weight(&self, row: usize) -> f64 {
        let lanes = self.weights.get(row / LANES);
        lanes.map_or(1.0, |lanes| lanes[row % LANES])
    }

    /// Rows of data, without the filling.
    pub(in crate::learn) fn rows(&self) -> usize {
        self.rows
    }
}

/// What the E step needs of a component: `ln ρ = log_scale − ½‖L⁻¹(x − mean)‖²`.
pub(in crate::learn) struct Kernel<const D: usize> {
    log_scale: f64,
    mean: [f64; D],
    /// L below the diagonal, 1/Lᵢᵢ on it.
    factor: [[f64; D]; D],
}

impl<const D: usize> Kernel<D> {
    pub(in crate::learn) fn new(
        log_scale: f64,
        mean: &SVector<f64, D>,
        factor: &SMatrix<f64, D, D>,
    ) -> Self {
        Self {
            log_scale,
            mean: std::array::from_fn(|i| mean[i]),
            factor: std::array::from_fn(|i| {
                std::array::from_fn(|j| {
                    if i == j {
                        1.0 / factor[(i, i)]
                    } else {
                        factor[(i, j)]
                    }
                })
            }),
        }
    }

    /// The kernels of a mixture.
    pub(in crate::learn) fn of(gmm: &Gmm<D>) -> Vec<Self> {
        let constant = 0.5 * D as f64 * std::f64::consts::TAU.ln();
        gmm.components()
            .iter()
            .map(|c| {
                let log_det: f64 = (0..D).map(|i| c.factor()[(i, i)].ln()).sum();
                Self::new(c.weight().ln() - log_det - constant, c.mean(), c.factor())
            })
            .collect()
    }

    fn log_density(&self, x: &[Lanes; D]) -> Lanes {
        let mut z = [[0.0; LANES]; D];
        let mut square = [0.0; LANES];
        for i in 0..D {
            let mut e = x[i];
            for v in &mut e {
                *v -= self.mean[i];
            }
            for (f, z) in self.factor[i][..i].iter().zip(&z) {
                for l in 0..LANES {
                    e[l] -= f * z[l];
                }
            }
            for l in 0..LANES {
                e[l] *= self.factor[i][i];
                square[l] += e[l] * e[l];
            }
            z[i] = e;
        }
        let mut density = [0.0; LANES];
        for l in 0..LANES {
            let d = self.log_scale - 0.5 * square[l];
            density[l] = if d > FLOOR { d } else { FLOOR };
        }
        density
    }
}

/// Weighted sums of one component about a reference point.
#[derive(Clone)]
pub(in crate::learn) struct Sums<const D: usize> {
    /// Σ r
    pub(in crate::learn) n: f64,
    /// Σ r·(x − reference)
    pub(in crate::learn) first: SVector<f64, D>,
    /// Σ r·(x − reference)(x − reference)ᵀ, lower triangle.
    pub(in crate::learn) second: SMatrix<f64, D, D>,
}

/// What a pass found.
#[derive(Clone)]
pub(in crate::learn) struct Pass<const D: usize> {
    /// Σ ln p(x)
    pub(in crate::learn) log_likelihood: f64,
    /// Of each component.
    pub(in crate::learn) sums: Vec<Sums<D>>,
}

/// Sums of one component, lane by lane.
#[derive(Clone)]
struct Accumulator<const D: usize> {
    n: Lanes,
    first: [Lanes; D],
    second: [[Lanes; D]; D],
}

impl<const D: usize> Accumulator<D> {
    fn zero() -> Self {
        Self {
            n: [0.0; LANES],
            first: [[0.0; LANES]; D],
            second: [[[0.0; LANES]; D]; D],
        }
    }

    fn add(&mut self, r: &Lanes, x: &[Lanes; D], reference: &[f64; D]) {
        let mut e = [[0.0; LANES]; D];
        for (n, r) in self.n.iter_mut().zip(r) {
            *n += r;
        }
        for i in 0..D {
            let mut w = [0.0; LANES];
            for l in 0..LANES {
                e[i][l] = x[i][l] - reference[i];
                w[l] = r[l] * e[i][l];
                self.first[i][l] += w[l];
            }
            for (to, e) in self.second[i].iter_mut().zip(&e[..=i]) {
                for l in 0..LANES {
                    to[l] += w[l] * e[l];
                }
            }
        }
    }

    fn total(&self) -> Sums<D> {
        let sum = |lanes: &Lanes| {
            let [a, b, c, d, e, f, g, h] = *lanes;
            ((a + b) + (c + d)) + ((e + f) + (g + h))
        };
        Sums {
            n: sum(&self.n),
            first: SVector::from_fn(|i, _| sum(&self.first[i])),
            second: SMatrix::from_fn(|i, j| if j <= i { sum(&self.second[i][j]) } else { 0.0 }),
        }
    }
}

/// The E step under `kernels` and the sums about `references` (normally the kernels' own means).
///
/// Where no component gives a row a density above e^−1e300, it counts for all alike.
pub(in crate::learn) fn pass<const D: usize>(
    tiles: &Tiles<D>,
    kernels: &[Kernel<D>],
    references: Option<&[SVector<f64, D>]>,
) -> Pass<D> {
    let references: Vec<[f64; D]> = match references {
        Some(given) => given
            .iter()
            .map(|m| std::array::from_fn(|i| m[i]))
            .collect(),
        None => kernels.iter().map(|k| k.mean).collect(),
    };
    // The filling of the last tile counts nothing.
    let fill = tiles.tiles.len() * LANES - tiles.rows;
    let of = |(index, chunk): (usize, &[[Lanes; D]])| {
        let last = (index + 1) * CHUNK >= tiles.tiles.len();
        let weights = tiles.weights.get(index * CHUNK..).unwrap_or(&[]);
        chunk_pass(
            chunk,
            weights,
            if last { fill } else { 0 },
            kernels,
            &references,
        )
    };
    let zero = Pass {
        log_likelihood: 0.0,
        sums: Vec::new(),
    };
    let parts: Vec<Pass<D>> = if tiles.tiles.len() <= CHUNK {
        tiles.tiles.chunks(CHUNK).enumerate().map(of).collect()
    } else {
        tiles.tiles.par_chunks(CHUNK).enumerate().map(of).collect()
    };
    parts
        .into_iter()
        .reduce(|mut a, b| {
            a.log_likelihood += b.log_likelihood;
            for (a, b) in a.sums.iter_mut().zip(&b.sums) {
                a.n += b.n;
                a.first += b.first;
                a.second += b.second;
            }
            a
        })
        .unwrap_or(zero)
}

fn chunk_pass<const D: usize>(
    tiles: &[[Lanes; D]],
    weights: &[Lanes],
    fill: usize,
    kernels: &[Kernel<D>],
    references: &[[f64; D]],
) -> Pass<D> {
    let k = kernels.len();
    let mut shares = vec![[[0.0; LANES]; BLOCK]; k];
    let mut sums = vec![Accumulator::zero(); k];
    let mut log_likelihood = 0.0;
    for (index, block) in tiles.chunks(BLOCK).enumerate() {
        for (kernel, shares) in kernels.iter().zip(&mut shares) {
            for (x, l) in block.iter().zip(shares) {
                *l = kernel.log_density(x);
            }
        }
        // Which components a tile has anything to say about.
        let mut concerned = [0_u64; BLOCK];
        for (t, concerned) in concerned.iter_mut().enumerate().take(block.len()) {
            let is_last = index * BLOCK + t + 1 == tiles.len();
            let counted = LANES - if is_last { fill } else { 0 };
            let weights = weights.get(index * BLOCK + t);
            log_likelihood += normalise(&mut shares, t, counted, weights, concerned);
        }
        for (c, (sum, shares)) in sums.iter_mut().zip(&shares).enumerate() {
            for ((x, r), concerned) in block.iter().zip(shares).zip(&concerned) {
                if concerned >> c & 1 == 1 {
                    sum.add(r, x, &references[c]);
                }
            }
        }
    }
    Pass {
        log_likelihood,
        sums: sums.iter().map(Accumulator::total).collect(),
    }
}

/// Log densities to responsibilities, of one tile; returns its log likelihood.
#[inline]
fn normalise(
    shares: &mut [[Lanes; BLOCK]],
    t: usize,
    counted: usize,
    weights: Option<&Lanes>,
    concerned: &mut u64,
) -> f64 {
    const { assert!(MAX_COMPONENTS <= 64, "a component is a bit of `concerned`") };
    let mut max = [FLOOR; LANES];
    for l in shares.iter() {
        for (m, &v) in max.iter_mut().zip(&l[t]) {
            *m = if v > *m { v } else { *m };
        }
    }
    let mut sum = [0.0; LANES];
    for (c, l) in shares.iter_mut().enumerate() {
        let l = &mut l[t];
        let mut most = f64::NEG_INFINITY;
        for (v, m) in l.iter_mut().zip(&max) {
            *v -= m;
            most = if *v > most { *v } else { most };
        }
        if most > NEGLIGIBLE {
            *concerned |= 1 << c;
            *l = exp(l);
            for (s, v) in sum.iter_mut().zip(&*l) {
                *s += v;
            }
        }
    }
    let mut scale = [0.0; LANES];
    for (l, (scale, sum)) in scale.iter_mut().zip(&sum).enumerate() {
        // Every sum holds the exponential of zero, so it is at least one.
        *scale = if l < counted { 1.0 / sum } else { 0.0 };
    }
    if let Some(weights) = weights {
        scale.iter_mut().zip(weights).for_each(|(s, w)| *s *= w);
    }
    for (c, l) in shares.iter_mut().enumerate() {
        if *concerned >> c & 1 == 1 {
            for (v, s) in l[t].iter_mut().zip(&scale) {
                *v *= s;
            }
        }
    }
    if let Some(weights) = weights {
        let each = max.iter().zip(&sum).zip(weights).take(counted);
        return each.map(|((m, s), w)| w * (m + s.ln())).sum();
    }
    // Eight sums of at most 64 multiply to 2⁴⁸: one logarithm does for all.
    let product: f64 = sum[..counted].iter().product();
    max[..counted].iter().sum::<f64>() + product.ln()
}

/// eˣ for x ≤ 0, to two units in the last place; below −700 as at −700.
///
/// x = n·ln 2 + r with |r| ≤ ½·ln 2 (ln 2 in two parts, Cody & Waite 1980), the Taylor polynomial of
/// degree 12 for eʳ (truncation 2·10⁻¹⁶), and n added to the exponent's bits.
#[inline]
fn exp(x: &Lanes) -> Lanes {
    /// 1.5·2⁵²: adding it leaves the nearest integer in the low bits.
    const ROUND: f64 = 6_755_399_441_055_744.0;
    const LN2_HIGH: f64 = 6.931_471_803_691_238e-1;
    const LN2_LOW: f64 = 1.908_214_929_270_587_7e-10;
    const TAYLOR: [f64; 13] = [
        1.0 / 479_001_600.0,
        1.0 / 39_916_800.0,
        1.0 / 3_628_800.0,
        1.0 / 362_880.0,
        1.0 / 40_320.0,
        1.0 / 5_040.0,
        1.0 / 720.0,
        1.0 / 120.0,
        1.0 / 24.0,
        1.0 / 6.0,
        0.5,
        1.0,
        1.0,
    ];
    let mut out = [0.0; LANES];
    for (out, &x) in out.iter_mut().zip(x) {
        let x = if x > -700.0 { x } else { -700.0 };
        let shifted = x * std::f64::consts::LOG2_E + ROUND;
        let n = shifted - ROUND;
        let r = (x - n * LN2_HIGH) - n * LN2_LOW;
        let mut p = TAYLOR[0];
        for c in &TAYLOR[1..] {
            p = p * r + c;
        }
        *out = f64::from_bits(p.to_bits().wrapping_add(shifted.to_bits() << 52));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exponential_is_right_to_two_units() {
        for i in 0..70_000 {
            let x = -f64::from(i) * 0.01 - 1e-4 * f64::from(i % 7);
            let got = exp(&[x.max(-700.0); LANES])[3];
            let want = x.max(-700.0).exp();
            assert!(
                (got - want).abs() <= 4.5e-16 * want,
                "{x}: {got} for {want}"
            );
        }
        assert_eq!(exp(&[0.0; LANES]), [1.0; LANES]);
        assert!(exp(&[f64::NEG_INFINITY; LANES])[0] < 1e-300);
    }

    #[test]
    fn the_sums_are_those_of_the_definition_for_every_number_of_rows() {
        let gmm = Gmm::<2>::new([
            (0.3, SVector::from([0.0, 0.0]), SMatrix::identity()),
            (
                0.7,
                SVector::from([1.0, -1.0]),
                SMatrix::from([[0.5, 0.2], [0.2, 0.4]]),
            ),
        ])
        .unwrap();
        for n in [1, 7, 8, 9, 130, 4097, 9000] {
            let rows: Vec<SVector<f64, 2>> = (0..n)
                .map(|i| {
                    let a = f64::from(i) * 0.7;
                    SVector::from([a.sin() * 2.0, (1.3 * a).cos()])
                })
                .collect();
            let got = pass(&Tiles::new(&rows), &Kernel::of(&gmm), None);
            let mut shares = [0.0; 2];
            let (mut log_likelihood, mut sums) = (0.0, [0.0; 6]);
            for x in &rows {
                log_likelihood += gmm.responsibilities(x, &mut shares);
                for k in 0..2 {
                    let e = x - gmm.components()[k].mean();
                    sums[3 * k] += shares[k];
                    sums[3 * k + 1] += shares[k] * e.x;
                    sums[3 * k + 2] += shares[k] * e.x * e.y;
                }
            }
            let near = |a: f64, b: f64| (a - b).abs() < 1e-12 * f64::from(n);
            assert!(near(got.log_likelihood, log_likelihood), "{n}");
            for k in 0..2 {
                assert!(near(got.sums[k].n, sums[3 * k]), "{n}");
                assert!(near(got.sums[k].first.x, sums[3 * k + 1]), "{n}");
                assert!(near(got.sums[k].second[(1, 0)], sums[3 * k + 2]), "{n}");
            }
        }
    }

    /// A row of weight two is two rows, one of weight nothing none.
    #[test]
    fn a_weight_is_how_often_a_row_counts() {
        let gmm = Gmm::<1>::new([
            (0.5, SVector::from([0.0]), SMatrix::from([[1.0]])),
            (0.5, SVector::from([2.0]), SMatrix::from([[0.5]])),
        ])
        .unwrap();
        let rows: Vec<SVector<f64, 1>> = (0..13)
            .map(|i| SVector::from([0.3 * f64::from(i)]))
            .collect();
        let weights: Vec<f64> = (0..13).map(|i| f64::from(i % 3)).collect();
        let repeated: Vec<SVector<f64, 1>> = rows
            .iter()
            .zip(&weights)
            .flat_map(|(x, w)| std::iter::repeat_n(*x, *w as usize))
            .collect();
        let kernels = Kernel::of(&gmm);
        let weighted = pass(&Tiles::weighted(&rows, &weights), &kernels, None);
        let plain = pass(&Tiles::new(&repeated), &kernels, None);
        assert!((weighted.log_likelihood - plain.log_likelihood).abs() < 1e-12);
        for (a, b) in weighted.sums.iter().zip(&plain.sums) {
            assert!((a.n - b.n).abs() < 1e-12);
            assert!((a.first - b.first).norm() < 1e-12);
            assert!((a.second - b.second).norm() < 1e-12);
        }
    }

    #[test]
    fn a_row_out_of_everyones_sight_counts_for_all_alike() {
        let gmm =
            Gmm::<1>::new([(0.5, SVector::from([0.0]), SMatrix::from([[1e-200]])); 2]).unwrap();
        let got = pass(
            &Tiles::new(&[SVector::from([1e150])]),
            &Kernel::of(&gmm),
            None,
        );
        assert_eq!([got.sums[0].n, got.sums[1].n], [0.5, 0.5]);
        assert!(got.log_likelihood.is_finite());
    }
}
