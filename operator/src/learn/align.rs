//! One time axis for all demonstrations: the medoid by dynamic time warping (Sakoe & Chiba 1978), and a warp
//! to it that ascends at every step (`warp`).

use nalgebra::Vector3;

use super::{LearnError, warp};
use crate::demonstration::Demonstration;

/// Points on the common axis, at most and at least.
pub(super) const POINTS: (usize, usize) = (30, 200);

/// How far a warp may stray from proportional time, as a share of the axis.
const BAND: f64 = 0.25;

/// Demonstrations resampled at the same phases.
#[derive(Debug, Clone, PartialEq)]
pub struct Aligned {
    /// Index of the medoid: the demonstration nearest to all others.
    pub medoid: usize,
    /// Mean duration of the demonstrations, s.
    pub duration_s: f64,
    /// The common times, s, from 0 to `duration_s`.
    pub times_s: Vec<f64>,
    /// For each demonstration its position (m) at each of `times_s`.
    pub paths: Vec<Vec<Vector3<f64>>>,
    /// For each demonstration the moment (s from its own start) that belongs to each of `times_s`; strictly
    /// ascending, from 0 to its duration.
    pub warps_s: Vec<Vec<f64>>,
}

impl Aligned {
    /// How far through the motion demonstration `index` (of those aligned) is `own_s` seconds after its own
    /// start: the phase, from 0 to 1, linear between the points of the axis.
    ///
    /// # Panics
    /// If there is no such demonstration.
    pub fn phase(&self, index: usize, own_s: f64) -> f64 {
        let warp_s = &self.warps_s[index];
        let last = warp_s.len() - 1;
        let i = warp_s.partition_point(|w| *w <= own_s).clamp(1, last) - 1;
        let part = (own_s - warp_s[i]) / (warp_s[i + 1] - warp_s[i]);
        (i as f64 + part.clamp(0.0, 1.0)) / last as f64
    }

    /// The phase of every sample of demonstration `index`, which is `demonstration`: strictly ascending from 0
    /// to 1.
    ///
    /// # Panics
    /// If there is no such demonstration.
    pub fn phases(&self, index: usize, demonstration: &Demonstration) -> Vec<f64> {
        let start_s = demonstration.samples()[0].t_s;
        let samples = demonstration.samples().iter();
        samples
            .map(|s| self.phase(index, s.t_s - start_s))
            .collect()
    }
}

/// Aligns demonstrations of any lengths and rates to their medoid and gives them the mean duration.
///
/// Shapes are compared about their own centres, so that a displaced performance is not a different one.
///
/// # Errors
/// [`LearnError::NoDemonstrations`].
pub fn align(demonstrations: &[Demonstration]) -> Result<Aligned, LearnError> {
    if demonstrations.is_empty() {
        return Err(LearnError::NoDemonstrations);
    }
    let count = demonstrations.len();
    let samples: usize = demonstrations.iter().map(|d| d.samples().len()).sum();
    let points = (samples / count).clamp(POINTS.0, POINTS.1);
    let shapes: Vec<_> = demonstrations.iter().map(|d| shape(d, points)).collect();

    let mut distance = vec![0.0; count];
    for a in 0..count {
        for b in a + 1..count {
            let cost = Warp::new(&shapes[a], &shapes[b]).cost();
            distance[a] += cost;
            distance[b] += cost;
        }
    }
    let mut medoid = 0;
    for (i, d) in distance.iter().enumerate() {
        if *d < distance[medoid] {
            medoid = i;
        }
    }

    let duration_s = demonstrations
        .iter()
        .map(Demonstration::duration_s)
        .sum::<f64>()
        / count as f64;
    let last = (points - 1) as f64;
    let mut paths = Vec::with_capacity(count);
    let mut warps_s = Vec::with_capacity(count);
    for (d, shape) in demonstrations.iter().zip(&shapes) {
        let start_s = d.samples()[0].t_s;
        let warp_s: Vec<f64> = Warp::new(&shapes[medoid], shape)
            .phases()
            .into_iter()
            .map(|phase| phase / last * d.duration_s())
            .collect();
        paths.push(
            warp_s
                .iter()
                .map(|t_s| d.position_at(start_s + t_s))
                .collect(),
        );
        warps_s.push(warp_s);
    }
    Ok(Aligned {
        medoid,
        duration_s,
        times_s: (0..points).map(|i| i as f64 / last * duration_s).collect(),
        paths,
        warps_s,
    })
}

/// The moments (s from its own start) of a demonstration that belong to the points of `path`, which are at equal
/// steps of its time; at least two. Shapes are compared as [`align`] does.
pub fn warp_to(path: &[Vector3<f64>], d: &Demonstration) -> Vec<f64> {
    let last = (path.len() - 1) as f64;
    let mut centred = path.to_vec();
    centre(&mut centred);
    Warp::new(&centred, &shape(d, path.len()))
        .phases()
        .into_iter()
        .map(|phase| phase / last * d.duration_s())
        .collect()
}

/// A demonstration at `points` equal steps of its own time, about the centre of its bounding box
/// (which, unlike the mean, does not depend on the pace).
fn shape(d: &Demonstration, points: usize) -> Vec<Vector3<f64>> {
    let start_s = d.samples()[0].t_s;
    let step_s = d.duration_s() / (points - 1) as f64;
    let mut path: Vec<_> = (0..points)
        .map(|i| d.position_at(start_s + i as f64 * step_s))
        .collect();
    centre(&mut path);
    path
}

fn centre(path: &mut [Vector3<f64>]) {
    let low = path.iter().fold(path[0], |a, p| a.inf(p));
    let high = path.iter().fold(path[0], |a, p| a.sup(p));
    let centre = (low + high) * 0.5;
    path.iter_mut().for_each(|p| *p -= centre);
}

/// How two paths of the same number of points differ when their timing does not count.
struct Warp<'a> {
    a: &'a [Vector3<f64>],
    b: &'a [Vector3<f64>],
    cost: f64,
}

impl<'a> Warp<'a> {
    /// The least cost over all warps within the band, which may stop either clock: cheap, and enough to find the
    /// medoid by.
    fn new(a: &'a [Vector3<f64>], b: &'a [Vector3<f64>]) -> Self {
        let n = a.len();
        let band = (BAND * n as f64).ceil() as usize;
        let mut table = vec![f64::INFINITY; n * n];
        for i in 0..n {
            for j in i.saturating_sub(band)..(i + band + 1).min(n) {
                let before = match (i, j) {
                    (0, 0) => 0.0,
                    (0, _) => table[j - 1],
                    (_, 0) => table[(i - 1) * n],
                    _ => table[(i - 1) * n + j - 1]
                        .min(table[(i - 1) * n + j])
                        .min(table[i * n + j - 1]),
                };
                table[i * n + j] = before + (a[i] - b[j]).norm_squared();
            }
        }
        Self {
            a,
            b,
            cost: table[n * n - 1],
        }
    }

    fn cost(&self) -> f64 {
        self.cost
    }

    /// For each point of the first path the (fractional) index of the point of the second that belongs to
    /// it; strictly ascending, from the first to the last point.
    fn phases(&self) -> Vec<f64> {
        let band = (BAND * self.a.len() as f64).ceil() as usize;
        warp::phases(self.a, self.b, band)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demonstration::Sample;

    fn swing(name: &str, duration_s: f64, warp: impl Fn(f64) -> f64, offset: f64) -> Demonstration {
        let samples: Vec<_> = (0..60)
            .map(|i| {
                let u = f64::from(i) / 59.0;
                let p = warp(u);
                Sample::at(
                    5.0 + u * duration_s,
                    Vector3::new((6.0 * p).sin() + offset, (4.0 * p).cos(), p),
                )
            })
            .collect();
        Demonstration::from_samples(name, &samples).unwrap()
    }

    #[test]
    fn a_change_of_pace_is_undone() {
        let demos = [
            swing("even", 2.0, |u| u, 0.0),
            swing("slow start", 3.0, |u| 0.6 * u + 0.4 * u * u, 0.0),
            swing("slow end", 2.5, |u| 1.4 * u - 0.4 * u * u, 0.0),
        ];
        let a = align(&demos).unwrap();
        assert_eq!(a.medoid, 0);
        assert!((a.duration_s - 2.5).abs() < 1e-9);
        for path in &a.paths {
            let worst = path
                .iter()
                .zip(&a.paths[0])
                .map(|(p, q)| (p - q).norm())
                .fold(0.0, f64::max);
            assert!(worst < 0.1, "{worst}");
        }
        for warp in &a.warps_s {
            assert!(warp.windows(2).all(|w| w[0] < w[1]));
        }
    }

    #[test]
    fn a_displaced_performance_is_warped_alike() {
        let near = [swing("a", 2.0, |u| u, 0.0), swing("b", 2.0, |u| u * u, 0.0)];
        let far = [swing("a", 2.0, |u| u, 0.0), swing("b", 2.0, |u| u * u, 7.0)];
        let (near, far) = (align(&near).unwrap(), align(&far).unwrap());
        for (a, b) in near.warps_s[1].iter().zip(&far.warps_s[1]) {
            assert!((a - b).abs() < 1e-9);
        }
    }

    #[test]
    fn one_demonstration_is_its_own_medoid() {
        let a = align(&[swing("only", 1.0, |u| u, 0.0)]).unwrap();
        assert_eq!((a.medoid, a.paths.len()), (0, 1));
        assert_eq!(align(&[]), Err(LearnError::NoDemonstrations));
    }

    #[test]
    fn every_sample_has_its_phase() {
        let demos = [
            swing("even", 2.0, |u| u, 0.0),
            swing("slow start", 3.0, |u| 0.6 * u + 0.4 * u * u, 0.0),
        ];
        let a = align(&demos).unwrap();
        for (index, d) in demos.iter().enumerate() {
            let phases = a.phases(index, d);
            assert_eq!((phases[0], phases[59]), (0.0, 1.0));
            assert!(phases.windows(2).all(|w| w[0] < w[1]));
            for (i, phase) in phases.iter().enumerate() {
                let u = i as f64 / 59.0;
                let truth = if index == 0 { u } else { 0.6 * u + 0.4 * u * u };
                assert!((phase - truth).abs() < 0.02, "{i}: {phase}, not {truth}");
            }
        }
        assert_eq!((a.phase(1, -1.0), a.phase(1, 9.0)), (0.0, 1.0));
    }
}
