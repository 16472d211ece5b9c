//! What predictions were worth: errors, lag, smoothness, and whether the regions held.

use nalgebra::Vector3;
use telemime_operator::demonstration::Demonstration;

use super::experts::{Expert, Guess, Side};

/// The regions whose coverage is counted, and the quantiles of χ² with three degrees of freedom.
pub(super) const REGIONS: [(f64, f64); 3] = [(0.5, 2.366), (0.9, REGION_90), (0.95, 7.815)];

/// The quantile at 90 %.
pub(crate) const REGION_90: f64 = 6.251;

/// Shifts at which the lag is sought: from this much early …
const FIRST_SHIFT_S: f64 = -0.1;
/// … in steps of this …
const SHIFT_STEP_S: f64 = 0.01;
/// … to this much late, s.
const LAST_SHIFT_S: f64 = 0.9;

const SHIFTS: usize = ((LAST_SHIFT_S - FIRST_SHIFT_S) / SHIFT_STEP_S) as usize + 1;

/// Sums over the moments of one performance, or of several, of one predictor at one horizon.
#[derive(Debug, Clone)]
pub(super) struct Tally {
    pub(super) moments: usize,
    /// Σ|error|², m² or rad².
    pub(super) error_2: f64,
    /// Σ|way|²: the error of holding.
    pub(super) hold_2: f64,
    /// Moments with a region, and how many of the truths each of [`REGIONS`] held.
    pub(super) regions: usize,
    pub(super) held: [usize; 3],
    /// Σ|error|² against the hand as it was at each shift.
    shifted_2: Vec<f64>,
    /// Σ|jerk|² of the predictions and of the hand.
    jerk_2: f64,
    hand_jerk_2: f64,
}

impl Default for Tally {
    fn default() -> Self {
        Self {
            moments: 0,
            error_2: 0.0,
            hold_2: 0.0,
            regions: 0,
            held: [0; 3],
            shifted_2: vec![0.0; SHIFTS],
            jerk_2: 0.0,
            hand_jerk_2: 0.0,
        }
    }
}

fn root(of: f64, over: f64) -> Option<f64> {
    Some((of / over).sqrt()).filter(|r| r.is_finite())
}

impl Tally {
    pub(super) fn add(&mut self, other: &Self) {
        self.moments += other.moments;
        self.error_2 += other.error_2;
        self.hold_2 += other.hold_2;
        self.regions += other.regions;
        for (a, b) in self.held.iter_mut().zip(other.held) {
            *a += b;
        }
        for (a, b) in self.shifted_2.iter_mut().zip(&other.shifted_2) {
            *a += b;
        }
        self.jerk_2 += other.jerk_2;
        self.hand_jerk_2 += other.hand_jerk_2;
    }

    /// RMSE over that of holding; `None` where nothing moved.
    pub(super) fn ratio(&self) -> Option<f64> {
        root(self.error_2, self.hold_2)
    }

    /// RMSE, m or rad.
    pub(super) fn rmse(&self) -> Option<f64> {
        root(self.error_2, self.moments as f64)
    }

    /// RMS jerk over that of the hand's own samples.
    pub(super) fn jerk_ratio(&self) -> Option<f64> {
        root(self.jerk_2, self.hand_jerk_2).filter(|_| self.hand_jerk_2 > 0.0)
    }

    /// The share of truths that each region held.
    pub(super) fn coverage(&self) -> Option<[f64; 3]> {
        (self.regions > 0).then(|| self.held.map(|n| n as f64 / self.regions as f64))
    }

    /// How late the predictions are: the shift of least squared error, s; `None` if it may lie beyond those tried.
    pub(super) fn lag_s(&self) -> Option<f64> {
        let shifts = &self.shifted_2;
        let best = (1..SHIFTS - 1).min_by(|&a, &b| shifts[a].total_cmp(&shifts[b]))?;
        let (before, at, after) = (shifts[best - 1], shifts[best], shifts[best + 1]);
        let bend = before - 2.0 * at + after;
        if !(at <= before && at <= after && bend > 0.0) {
            return None;
        }
        // The vertex of the parabola through the three.
        let between = 0.5 * (before - after) / bend;
        Some(FIRST_SHIFT_S + SHIFT_STEP_S * (best as f64 + between))
    }
}

/// One prediction, and what it was of.
pub(super) struct Moment {
    /// The sample predicted from.
    pub(super) sample: usize,
    pub(super) guess: Guess,
    /// What came.
    pub(super) truth: Vector3<f64>,
}

/// Everything one expert predicted of one performance at one horizon.
pub(super) type Course = Vec<Moment>;

/// Lets every expert predict the whole performance. Result: [expert][horizon]; moments whose truth lies
/// beyond the recording are not asked for. `each` hears of every expert after every sample.
pub(super) fn perform(
    side: Side,
    d: &Demonstration,
    experts: &mut [Box<dyn Expert>],
    horizons_s: &[f64],
    mut each: impl FnMut(&dyn Expert),
) -> Vec<Vec<Course>> {
    let end_s = d.last().t_s + 1e-9;
    let nothing = || horizons_s.iter().map(|_| Vec::new()).collect();
    let mut courses: Vec<Vec<Course>> = experts.iter().map(|_| nothing()).collect();
    for (sample, now) in d.samples().iter().enumerate() {
        let truths: Vec<_> = horizons_s
            .iter()
            .map(|h_s| (now.t_s + h_s <= end_s).then(|| side.way(d, sample, now.t_s + h_s)))
            .collect();
        for (expert, courses) in experts.iter_mut().zip(&mut courses) {
            expert.take(now);
            each(&**expert);
            for (n, (h_s, course)) in horizons_s.iter().zip(courses).enumerate() {
                if let Some(truth) = truths[n] {
                    course.push(Moment {
                        sample,
                        guess: expert.ahead(*h_s),
                        truth,
                    });
                }
            }
        }
    }
    courses
}

/// Sums up what was predicted `h_s` ahead.
pub(super) fn tally(side: Side, d: &Demonstration, course: &Course, h_s: f64) -> Tally {
    let mut tally = Tally::default();
    for m in course {
        let error = m.guess.way - m.truth;
        tally.moments += 1;
        tally.error_2 += error.norm_squared();
        tally.hold_2 += m.truth.norm_squared();
        if let Some(distance2) = m.guess.distance2(&m.truth) {
            tally.regions += 1;
            for (held, (_, quantile)) in tally.held.iter_mut().zip(REGIONS) {
                *held += usize::from(distance2 <= quantile);
            }
        }
        let target_s = d.samples()[m.sample].t_s + h_s;
        for (n, sum) in tally.shifted_2.iter_mut().enumerate() {
            let shift_s = FIRST_SHIFT_S + SHIFT_STEP_S * n as f64;
            let then = side.way(d, m.sample, target_s - shift_s);
            *sum += (m.guess.way - then).norm_squared();
        }
    }
    if side == Side::Place {
        for four in course.windows(4) {
            let at = |m: &Moment| d.samples()[m.sample];
            let t: [f64; 4] = std::array::from_fn(|i| at(&four[i]).t_s);
            let hand = std::array::from_fn(|i| at(&four[i]).position);
            let predicted = std::array::from_fn(|i| hand[i] + four[i].guess.way);
            tally.hand_jerk_2 += jerk(&t, hand).norm_squared();
            tally.jerk_2 += jerk(&t, predicted).norm_squared();
        }
    }
    tally
}

/// The third derivative of the cubic through four points, m/s³.
pub(super) fn jerk(t: &[f64; 4], mut x: [Vector3<f64>; 4]) -> Vector3<f64> {
    for order in 1..4 {
        for i in 0..4 - order {
            x[i] = (x[i + 1] - x[i]) / (t[i + order] - t[i]);
        }
    }
    x[0] * 6.0
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix3;
    use telemime_operator::demonstration::Sample;

    use super::*;

    /// A hand on a circle, sampled unevenly.
    fn circle() -> Demonstration {
        let samples: Vec<_> = (0..120)
            .map(|i| {
                let t = 0.033 * f64::from(i) + 0.005 * f64::from(i % 3);
                Sample::at(t, Vector3::new((3.0 * t).cos(), (3.0 * t).sin(), 0.0))
            })
            .collect();
        Demonstration::from_samples("circle", &samples).unwrap()
    }

    /// Knows where the hand was a while before the time asked for.
    struct Late {
        d: Demonstration,
        by_s: f64,
        now: usize,
    }

    impl Expert for Late {
        fn take(&mut self, sample: &Sample) {
            self.now = self
                .d
                .samples()
                .iter()
                .position(|s| s.t_s == sample.t_s)
                .unwrap();
        }

        fn ahead(&self, h_s: f64) -> Guess {
            let t_s = self.d.samples()[self.now].t_s + h_s - self.by_s;
            Guess {
                way: Side::Place.way(&self.d, self.now, t_s),
                spread: Some(Matrix3::identity() * 1e-6),
            }
        }
    }

    #[test]
    fn lag_ratio_jerk_and_coverage_are_what_they_must_be() {
        let d = circle();
        let late = |by_s| -> Box<dyn Expert> {
            Box::new(Late {
                d: circle(),
                by_s,
                now: 0,
            })
        };
        let mut experts = [late(0.2), late(0.0), late(0.063)];
        let courses = perform(Side::Place, &d, &mut experts, &[0.2], |_| ());
        let [hold, right, between] = [0, 1, 2].map(|e| tally(Side::Place, &d, &courses[e][0], 0.2));
        assert!((hold.lag_s().unwrap() - 0.2).abs() < 1e-3);
        assert!((between.lag_s().unwrap() - 0.063).abs() < 2e-3);
        assert!((hold.ratio().unwrap() - 1.0).abs() < 1e-12);
        assert!((hold.jerk_ratio().unwrap() - 1.0).abs() < 1e-9);
        assert_eq!(right.ratio(), Some(0.0));
        assert_eq!(right.coverage(), Some([1.0; 3]));
        assert_eq!(hold.coverage().map(|c| c[2] < 0.1), Some(true));
        // Two whole arcs of 0.2 s at 3 rad/s lie between.
        assert!((hold.rmse().unwrap() - 2.0 * 0.3_f64.sin()).abs() < 5e-3);
        assert_eq!(
            hold.moments,
            d.samples()
                .iter()
                .filter(|s| s.t_s + 0.2 <= d.last().t_s)
                .count()
        );
    }

    #[test]
    fn the_jerk_of_a_cubic_is_its_own() {
        let t = [0.0, 0.1, 0.15, 0.4];
        let x = t.map(|t: f64| Vector3::new(2.0 * t.powi(3), t * t, 1.0));
        assert!((jerk(&t, x) - Vector3::new(12.0, 0.0, 0.0)).norm() < 1e-9);
    }
}
