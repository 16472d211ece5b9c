//! Paths over time, and how far apart two of them are.

use nalgebra::Vector3;

/// Shifts tried when the lag is sought: −200 ms to 800 ms in steps of 1 ms.
const LAG_RANGE_MS: std::ops::RangeInclusive<i32> = -200..=800;

/// A position over time, linear between its points and still outside them.
#[derive(Debug, Clone, PartialEq)]
pub struct Track(Vec<(f64, Vector3<f64>)>);

/// Why a list of points is no track.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum TrackError {
    /// No points.
    #[error("no points")]
    Empty,
    /// Not in order of time, or not finite.
    #[error("point {0} is out of order or not finite")]
    Unordered(usize),
}

impl Track {
    /// A track through `points` (s, m), in order of time; of points at the same time the last one counts.
    ///
    /// # Errors
    /// [`TrackError`].
    pub fn new(points: Vec<(f64, Vector3<f64>)>) -> Result<Self, TrackError> {
        if points.is_empty() {
            return Err(TrackError::Empty);
        }
        let finite = |p: &(f64, Vector3<f64>)| p.0.is_finite() && p.1.iter().all(|v| v.is_finite());
        if let Some(i) = points.iter().position(|p| !finite(p)) {
            return Err(TrackError::Unordered(i));
        }
        match points.windows(2).position(|w| w[1].0 < w[0].0) {
            Some(i) => Err(TrackError::Unordered(i + 1)),
            None => Ok(Self(points)),
        }
    }

    /// The points.
    pub fn points(&self) -> &[(f64, Vector3<f64>)] {
        &self.0
    }

    /// First and last time, s.
    pub fn span_s(&self) -> (f64, f64) {
        (self.0[0].0, self.0[self.0.len() - 1].0)
    }

    /// The position at `t_s`, m.
    pub fn at(&self, t_s: f64) -> Vector3<f64> {
        let after = self.0.partition_point(|p| p.0 <= t_s);
        let Some((t0, x0)) = after.checked_sub(1).map(|i| self.0[i]) else {
            return self.0[0].1;
        };
        match self.0.get(after) {
            Some((t1, x1)) if *t1 > t0 => x0.lerp(x1, (t_s - t0) / (t1 - t0)),
            _ => x0,
        }
    }

    /// The shift, s, by which `self` trails `truth` best in the least-squares sense, on a 1 ms grid, with the
    /// error at that shift, m: `argmin_τ Σ |self(t) − truth(t − τ)|²` over `grid_s`.
    pub fn lag_behind(&self, truth: &Self, grid_s: &[f64]) -> (f64, f64) {
        let own: Vec<_> = grid_s.iter().map(|&t| self.at(t)).collect();
        let error = |shift_s: f64| -> f64 {
            own.iter()
                .zip(grid_s)
                .map(|(x, t)| (x - truth.at(t - shift_s)).norm_squared())
                .sum()
        };
        let best = LAG_RANGE_MS
            .map(|ms| (f64::from(ms) * 1e-3, error(f64::from(ms) * 1e-3)))
            .min_by(|a, b| a.1.total_cmp(&b.1));
        let (shift_s, sum) = best.unwrap_or((0.0, 0.0));
        (shift_s, (sum / grid_s.len().max(1) as f64).sqrt())
    }
}

/// Whether a lag lies at the end of what [`Track::lag_behind`] searches: the true one may be beyond.
pub fn is_edge(lag_s: f64) -> bool {
    let ms = (lag_s * 1e3).round() as i32;
    ms == *LAG_RANGE_MS.start() || ms == *LAG_RANGE_MS.end()
}

/// Root mean square distance of two tracks over the times `grid_s`, m.
pub fn rmse_m(a: &Track, b: &Track, grid_s: &[f64]) -> f64 {
    let sum: f64 = grid_s
        .iter()
        .map(|&t| (a.at(t) - b.at(t)).norm_squared())
        .sum();
    (sum / grid_s.len().max(1) as f64).sqrt()
}

/// The newest sample that has arrived by `t_s`: what a robot that holds the last sample would know.
/// `arrivals` are (arrival s, sample time s, what was sampled); a sample overtaken by a newer one is not used.
pub fn sample_and_hold<T: Copy>(arrivals: &[(f64, f64, T)], t_s: f64) -> Option<T> {
    arrivals
        .iter()
        .filter(|(arrival, ..)| *arrival <= t_s)
        .max_by(|a, b| a.1.total_cmp(&b.1))
        .map(|(.., x)| *x)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sine(shift_s: f64) -> Track {
        let point = |i: i32| {
            let t = f64::from(i) * 0.01;
            (t, Vector3::new((3.0 * (t - shift_s)).sin(), 0.0, t))
        };
        Track::new((0..=500).map(point).collect()).unwrap()
    }

    #[test]
    fn a_delayed_track_lags_by_its_delay() {
        let grid: Vec<_> = (100..400).map(|i| f64::from(i) * 0.01).collect();
        let sine_only = |t: Track| {
            Track::new(
                t.0.into_iter()
                    .map(|(t, x)| (t, x.xy().push(0.0)))
                    .collect(),
            )
            .unwrap()
        };
        let (lag_s, rest_m) = sine_only(sine(0.123)).lag_behind(&sine_only(sine(0.0)), &grid);
        assert!(
            (lag_s - 0.123).abs() < 1e-9 && rest_m < 1e-3,
            "{lag_s} {rest_m}"
        );
        assert!(!is_edge(lag_s));
        // A ramp a second late: no shift that is searched is enough.
        let ramp = |shift_s: f64| {
            let point = |i: i32| {
                let t = f64::from(i) * 0.01;
                (t, Vector3::new(t - shift_s, 0.0, 0.0))
            };
            Track::new((0..=500).map(point).collect()).unwrap()
        };
        assert!(is_edge(ramp(1.0).lag_behind(&ramp(0.0), &grid).0));
    }

    #[test]
    fn the_newest_sample_counts_whenever_it_came() {
        let x = |v: f64| Vector3::new(v, 0.0, 0.0);
        let arrivals = [(0.2, 0.0, x(0.0)), (0.3, 0.2, x(2.0)), (0.31, 0.1, x(1.0))];
        assert_eq!(sample_and_hold(&arrivals, 0.1), None);
        assert_eq!(sample_and_hold(&arrivals, 0.25), Some(x(0.0)));
        assert_eq!(
            sample_and_hold(&arrivals, 0.4),
            Some(x(2.0)),
            "a late one is overtaken"
        );
    }
}
