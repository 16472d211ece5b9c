//! The Kalman filter of constant acceleration: what many a teleoperation would try first.

use nalgebra::{Matrix3, Vector3};
use telemime_operator::demonstration::{Demonstration, Sample};

use super::experts::{Expert, Guess};

/// Ratios of jerk density (m²/s⁵) to measurement variance (m²) that are tried, as powers of ten.
const RATIOS: std::ops::RangeInclusive<i32> = 2..=12;

/// The horizon at which the ratio is chosen, s.
const CHOSEN_AT_S: f64 = 0.1;

/// Position, velocity and acceleration of each axis; the axes share one covariance, in units of the
/// measurement's.
#[derive(Debug, Clone)]
pub(crate) struct Kalman {
    ratio: f64,
    t_s: Option<f64>,
    /// Rows: position (m), velocity (m/s), acceleration (m/s²); a column an axis.
    state: Matrix3<f64>,
    covariance: Matrix3<f64>,
    newest: Vector3<f64>,
}

impl Kalman {
    fn new(ratio: f64) -> Self {
        Self {
            ratio,
            t_s: None,
            state: Matrix3::zeros(),
            covariance: Matrix3::zeros(),
            newest: Vector3::zeros(),
        }
    }

    /// The filter that predicts these demonstrations best 100 ms ahead.
    pub(crate) fn tuned(demonstrations: &[Demonstration]) -> Self {
        let error = |ratio: f64| -> f64 {
            let each = demonstrations.iter().map(|d| {
                let mut filter = Self::new(ratio);
                let samples = d.samples().iter();
                let ahead = samples.map(|s| {
                    filter.take(s);
                    let truth = d.position_at(s.t_s + CHOSEN_AT_S) - s.position;
                    (filter.ahead(CHOSEN_AT_S).way - truth).norm_squared()
                });
                ahead.sum::<f64>()
            });
            each.sum()
        };
        let best = RATIOS
            .map(|power| 10_f64.powi(power))
            .map(|ratio| (error(ratio), ratio))
            .min_by(|a, b| a.0.total_cmp(&b.0));
        Self::new(best.map_or(1e8, |(_, ratio)| ratio))
    }

    /// Takes the next sample; position (m), velocity (m/s) and acceleration (m/s²) as the filter then has them.
    pub(crate) fn take_motion(&mut self, sample: &Sample) -> [Vector3<f64>; 3] {
        self.take(sample);
        [0, 1, 2].map(|row| self.state.row(row).transpose())
    }

    fn transition(dt_s: f64) -> Matrix3<f64> {
        Matrix3::new(1.0, dt_s, 0.5 * dt_s * dt_s, 0.0, 1.0, dt_s, 0.0, 0.0, 1.0)
    }

    /// The covariance that white jerk of density 1 adds in `dt`.
    fn noise(dt_s: f64) -> Matrix3<f64> {
        let [d1, d2, d3, d4, d5] = [1, 2, 3, 4, 5].map(|n| dt_s.powi(n));
        Matrix3::new(
            d5 / 20.0,
            d4 / 8.0,
            d3 / 6.0,
            d4 / 8.0,
            d3 / 3.0,
            d2 / 2.0,
            d3 / 6.0,
            d2 / 2.0,
            d1,
        )
    }
}

impl Expert for Kalman {
    fn take(&mut self, sample: &Sample) {
        self.newest = sample.position;
        let Some(before_s) = self.t_s.replace(sample.t_s) else {
            self.state = Matrix3::from_rows(&[
                sample.position.transpose(),
                Vector3::zeros().transpose(),
                Vector3::zeros().transpose(),
            ]);
            // A hand at rest, as sure as the measurement that it is there.
            self.covariance = Matrix3::from_diagonal(&Vector3::new(1.0, 0.0, 0.0));
            return;
        };
        let dt_s = sample.t_s - before_s;
        let f = Self::transition(dt_s);
        self.state = f * self.state;
        self.covariance = f * self.covariance * f.transpose() + Self::noise(dt_s) * self.ratio;
        let column = self.covariance.column(0).into_owned();
        let gain = column / (column[0] + 1.0);
        let innovation = sample.position.transpose() - self.state.row(0);
        self.state += gain * innovation;
        self.covariance -= gain * column.transpose();
        self.covariance = (self.covariance + self.covariance.transpose()) * 0.5;
    }

    fn ahead(&self, h_s: f64) -> Guess {
        let ahead = Self::transition(h_s) * self.state;
        (ahead.row(0).transpose() - self.newest).into()
    }
}
