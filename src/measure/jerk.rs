//! How smooth a motion is.

use nalgebra::Vector3;
use telemime_robot::control::{FilterConfig, LimitedFilter};

use super::track::Track;

/// A recorded hand has a jerk only through a filter: one as fast as the robot's, and free of limits, rad/s.
const OMEGA_RAD_S: f64 = 60.0;

const TICK_S: f64 = 1e-3;

/// Far beyond what a hand does, so that no limit acts.
const FREE: FilterConfig = FilterConfig {
    omega: OMEGA_RAD_S,
    v_max: 1e6,
    a_max: 1e5,
    j_max: 1e9,
    dt_s: TICK_S,
};

/// Root mean square; 0 of nothing.
pub fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (mut n, mut sum) = (0_u32, 0.0);
    for value in values {
        n += 1;
        sum += value * value;
    }
    (sum / f64::from(n.max(1))).sqrt()
}

/// RMS jerk of a hand from `from_s` to `to_s`, m/s³, through the robot's filter with all poles at −60 rad/s, no limits and a tick of 1 ms.
pub fn smooth_jerk_m_s3(hand: &Track, from_s: f64, to_s: f64) -> f64 {
    // The filter has settled when it counts.
    let begin_s = from_s - 0.5;
    let Ok(mut filter) = LimitedFilter::new(FREE, hand.at(begin_s)) else {
        return 0.0;
    };
    let ticks = ((to_s - begin_s) / TICK_S).max(0.0) as u32;
    let mut acceleration = Vector3::zeros();
    let jerks = (0..ticks).filter_map(|tick| {
        let t_s = begin_s + f64::from(tick) * TICK_S;
        filter.follow(hand.at(t_s), 1.0);
        let jerk = (filter.state().a - acceleration).norm() / TICK_S;
        acceleration = filter.state().a;
        (t_s >= from_s).then_some(jerk)
    });
    rms(jerks)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slow_sine_keeps_its_jerk_and_what_rests_has_none() {
        let rate = 4.0_f64;
        let points = (0..=6000).map(|i| {
            let t = f64::from(i) * 1e-3;
            (t, Vector3::new(0.2 * (rate * t).sin(), 0.0, 0.0))
        });
        let sine = Track::new(points.collect()).unwrap();
        let period = std::f64::consts::TAU / rate;
        let jerk = smooth_jerk_m_s3(&sine, 1.0, 1.0 + 3.0 * period);
        // Each pole leaves 1/√(1 + (rate/ω)²) of it.
        let left = (1.0 + (rate / OMEGA_RAD_S).powi(2)).powf(-1.5);
        let expected = 0.2 * rate.powi(3) / 2.0_f64.sqrt() * left;
        assert!((jerk / expected - 1.0).abs() < 2e-3, "{jerk} {expected}");
        let rest = Track::new(vec![(0.0, Vector3::x())]).unwrap();
        assert_eq!(smooth_jerk_m_s3(&rest, 1.0, 3.0), 0.0);
    }
}
