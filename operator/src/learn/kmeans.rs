//! k-means: the k-means++ start (Arthur & Vassilvitskii 2007) and Lloyd's steps.

use nalgebra::SVector;
use rand::RngExt;
use rand_xoshiro::Xoshiro256PlusPlus;

/// A hard clustering.
#[derive(Debug, Clone, PartialEq)]
pub struct Clusters<const D: usize> {
    /// The centres.
    pub centres: Vec<SVector<f64, D>>,
    /// For each row the index of its nearest centre.
    pub labels: Vec<usize>,
    /// Sum of squared distances to the nearest centre.
    pub inertia: f64,
    /// How often an empty cluster was started again at the row farthest from its centre.
    pub reseeded: usize,
}

/// Clusters `data` around `k` centres: k-means++ with draws from `rng`, then at most `steps` Lloyd steps.
///
/// Clusters stay empty only where fewer than `k` rows differ. `k` = 0 or no data gives no centres.
pub fn kmeans<const D: usize>(
    data: &[SVector<f64, D>],
    k: usize,
    steps: usize,
    rng: &mut Xoshiro256PlusPlus,
) -> Clusters<D> {
    let mut centres = plus_plus(data, k, rng);
    let mut labels = vec![0; data.len()];
    let mut distances = vec![0.0; data.len()];
    let mut reseeded = 0;
    let mut inertia = assign(data, &centres, &mut labels, &mut distances);
    for _ in 0..steps {
        let mut sums = vec![SVector::<f64, D>::zeros(); centres.len()];
        let mut counts = vec![0_usize; centres.len()];
        for (x, &l) in data.iter().zip(&labels) {
            sums[l] += x;
            counts[l] += 1;
        }
        for ((centre, sum), &count) in centres.iter_mut().zip(sums).zip(&counts) {
            if count > 0 {
                *centre = sum / count as f64;
            } else if let Some(far) = farthest(&distances) {
                *centre = data[far];
                distances[far] = 0.0;
                reseeded += 1;
            }
        }
        let before = labels.clone();
        inertia = assign(data, &centres, &mut labels, &mut distances);
        if labels == before {
            break;
        }
    }
    Clusters {
        centres,
        labels,
        inertia,
        reseeded,
    }
}

/// Each centre is a row drawn with a chance proportional to its squared distance to the *nearest* centre so far.
fn plus_plus<const D: usize>(
    data: &[SVector<f64, D>],
    k: usize,
    rng: &mut Xoshiro256PlusPlus,
) -> Vec<SVector<f64, D>> {
    let mut centres: Vec<SVector<f64, D>> = Vec::with_capacity(k);
    let mut nearest = vec![f64::INFINITY; data.len()];
    while centres.len() < k && !data.is_empty() {
        let chosen = if centres.is_empty() {
            rng.random_range(0..data.len())
        } else {
            draw(&nearest, rng)
        };
        let centre = data[chosen];
        for (d, x) in nearest.iter_mut().zip(data) {
            *d = d.min((x - centre).norm_squared());
        }
        centres.push(centre);
    }
    centres
}

fn draw(weights: &[f64], rng: &mut Xoshiro256PlusPlus) -> usize {
    let total: f64 = weights.iter().sum();
    let mut left = rng.random::<f64>() * total;
    for (i, &w) in weights.iter().enumerate() {
        left -= w;
        if left < 0.0 {
            return i;
        }
    }
    // Every row is a centre already (total 0), or rounding left a remainder.
    farthest(weights).unwrap_or_else(|| rng.random_range(0..weights.len()))
}

/// The row at the greatest distance, if any is away from its centre.
fn farthest(distances: &[f64]) -> Option<usize> {
    let mut best = None;
    let mut most = 0.0;
    for (i, &d) in distances.iter().enumerate() {
        if d > most {
            (best, most) = (Some(i), d);
        }
    }
    best
}

fn assign<const D: usize>(
    data: &[SVector<f64, D>],
    centres: &[SVector<f64, D>],
    labels: &mut [usize],
    distances: &mut [f64],
) -> f64 {
    let mut inertia = 0.0;
    for ((x, label), distance) in data.iter().zip(labels).zip(distances) {
        let mut best = f64::INFINITY;
        for (k, c) in centres.iter().enumerate() {
            let d = (x - c).norm_squared();
            if d < best {
                (best, *label) = (d, k);
            }
        }
        *distance = best;
        inertia += best;
    }
    inertia
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector2;
    use rand::SeedableRng;

    use super::*;

    fn rng() -> Xoshiro256PlusPlus {
        Xoshiro256PlusPlus::seed_from_u64(1)
    }

    #[test]
    fn separate_groups_are_found() {
        let mut data = Vec::new();
        for centre in [0.0, 10.0, 20.0, 30.0] {
            for i in 0..10 {
                data.push(Vector2::new(centre + 0.01 * f64::from(i), -centre));
            }
        }
        let c = kmeans(&data, 4, 15, &mut rng());
        for group in c.labels.chunks(10) {
            assert!(group.iter().all(|l| *l == group[0]));
        }
        let mut firsts: Vec<_> = c.labels.iter().step_by(10).copied().collect();
        firsts.sort_unstable();
        assert_eq!(firsts, [0, 1, 2, 3]);
    }

    #[test]
    fn fewer_distinct_rows_than_clusters_end_without_a_fault() {
        let data = vec![Vector2::new(1.0, 2.0); 6];
        let c = kmeans(&data, 4, 15, &mut rng());
        assert_eq!(c.inertia, 0.0);
        assert!(kmeans::<2>(&[], 4, 15, &mut rng()).centres.is_empty());
    }

    #[test]
    fn no_cluster_stays_empty_where_rows_differ() {
        let data: Vec<_> = (0..40)
            .map(|i| Vector2::new(f64::from(i % 7), f64::from(i / 7)))
            .collect();
        for k in 1..=14 {
            let c = kmeans(&data, k, 15, &mut rng());
            assert!((0..k).all(|k| c.labels.contains(&k)), "{k}");
        }
    }
}
