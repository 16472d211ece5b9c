//! How far the hand usually goes in a given time: the unit of a bound that suits a tennis swing and pouring alike.

use telemime_protocol::predict::{Calibration, KNOT_SPACING_S, MAX_KNOTS};

/// Root mean square way from the present, m or rad.
#[derive(Debug, Clone, Copy)]
pub(super) struct Usual {
    /// In j·[`KNOT_SPACING_S`].
    ways: [f64; MAX_KNOTS + 1],
    last: usize,
}

impl Usual {
    /// Of motion that nothing is known of: half a metre a second along each axis.
    pub(super) const UNKNOWN: &Calibration = &Calibration::UNTRIED;

    /// As the demonstrations have it that `calibration` was tried on: what holding erred by at its first `knots` knots.
    pub(super) fn of(calibration: &Calibration, knots: usize) -> Self {
        let mut ways = [0.0; MAX_KNOTS + 1];
        for (way, [.., hold]) in ways[1..].iter_mut().zip(&calibration.errors) {
            *way = (3.0 * hold).sqrt();
        }
        Self {
            ways,
            last: knots.clamp(1, MAX_KNOTS),
        }
    }

    /// In `h_s` seconds: linear between knots, beyond the last as far as to it.
    pub(super) fn in_s(&self, h_s: f64) -> f64 {
        let u = (h_s.max(0.0) / KNOT_SPACING_S).min(self.last as f64);
        let i = (u as usize).min(self.last - 1);
        self.ways[i] + (u - i as f64) * (self.ways[i + 1] - self.ways[i])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hand_goes_as_far_as_its_demonstrations_did() {
        let steady = Usual::of(Usual::UNKNOWN, MAX_KNOTS);
        // Half a metre a second along each of three axes.
        for h_s in [0.0, 0.02, 0.1, 0.175, 0.8] {
            assert!(
                (steady.in_s(h_s) - 0.75_f64.sqrt() * h_s).abs() < 1e-12,
                "{h_s}"
            );
        }
        let short = Usual::of(Usual::UNKNOWN, 3);
        assert_eq!(short.in_s(0.5), steady.in_s(0.1));
        assert_eq!([short.in_s(-1.0), short.in_s(f64::NAN)], [0.0; 2]);
    }
}
