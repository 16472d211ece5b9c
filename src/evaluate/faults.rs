//! Where predictions fail: as motion begins, where it turns back, off the hand's path.

use nalgebra::{Matrix3, Vector3};
use telemime_operator::demonstration::{Demonstration, Sample};

use super::experts::{Expert, Side};
use super::score::{Course, perform};

/// Motion has begun when the hand is this share of its reach from where the recording begins.
const ONSET: f64 = 0.05;

/// Ends of the times since the onset that are told apart, s; before the first the hand rests.
pub(super) const SINCE_S: [f64; 7] = [0.0, 0.1, 0.2, 0.3, 0.5, 0.8, f64::INFINITY];

/// A turn of the motion's main direction counts if the hand goes back by this share of its range.
const TURN: f64 = 0.1;

/// The path is looked for this long before and after the moment predicted, s.
const PATH_S: f64 = 0.5;

/// An overshoot is looked for this long before and after a turn, s.
const AROUND_S: f64 = 0.15;

/// Errors around a change of mind are told apart in steps of this …
pub(super) const MIND_STEP_S: f64 = 1.0 / 30.0;
/// … from so many steps before …
pub(super) const MIND_BEFORE: i32 = 6;
/// … to so many after.
pub(super) const MIND_AFTER: i32 = 24;

/// Squared errors of a kind of moment.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Bin {
    pub(super) moments: usize,
    pub(super) error_2: f64,
    pub(super) hold_2: f64,
}

impl Bin {
    fn count(&mut self, error: &Vector3<f64>, truth: &Vector3<f64>) {
        self.moments += 1;
        self.error_2 += error.norm_squared();
        self.hold_2 += truth.norm_squared();
    }

    pub(super) fn add(&mut self, other: &Self) {
        self.moments += other.moments;
        self.error_2 += other.error_2;
        self.hold_2 += other.hold_2;
    }

    pub(super) fn rmse_m(&self) -> Option<f64> {
        Some((self.error_2 / self.moments as f64).sqrt()).filter(|r| r.is_finite())
    }

    pub(super) fn hold_m(&self) -> Option<f64> {
        Some((self.hold_2 / self.moments as f64).sqrt()).filter(|r| r.is_finite())
    }
}

/// The faults of one predictor at one horizon.
#[derive(Debug, Clone, Default)]
pub(super) struct Faults {
    /// By time since the onset, as [`SINCE_S`] divides it.
    pub(super) since_onset: [Bin; SINCE_S.len()],
    /// Moments whose truth moves against the present motion.
    pub(super) against: Bin,
    /// Distances from the hand's path, m.
    pub(super) off_path_m: Vec<f64>,
    /// Σ of predicted times true, and of true squared, displacements from the mean position, m².
    gain: [f64; 2],
    /// How far the prediction goes beyond the hand where it turns, as shares of the hand's range; short of it is
    /// negative.
    pub(super) overshoot: Vec<f64>,
}

impl Faults {
    pub(super) fn add(&mut self, other: &Self) {
        for (a, b) in self.since_onset.iter_mut().zip(&other.since_onset) {
            a.add(b);
        }
        self.against.add(&other.against);
        self.off_path_m.extend(&other.off_path_m);
        self.gain[0] += other.gain[0];
        self.gain[1] += other.gain[1];
        self.overshoot.extend(&other.overshoot);
    }

    /// How large predicted motion is: the slope of predictions on truths.
    pub(super) fn amplitude(&self) -> Option<f64> {
        Some(self.gain[0] / self.gain[1]).filter(|g| g.is_finite())
    }
}

/// What a performance is held against.
pub(super) struct Shape {
    onset_s: f64,
    mean: Vector3<f64>,
    axis: Vector3<f64>,
    range_m: f64,
    /// Times (s) and signs of the turns of the main direction.
    turns: Vec<(f64, f64)>,
}

impl Shape {
    pub(super) fn of(d: &Demonstration) -> Self {
        let samples = d.samples();
        let first = samples[0].position;
        let far = |s: &Sample| (s.position - first).norm();
        let reach_m = samples.iter().map(far).fold(0.0, f64::max);
        let onset = samples.iter().find(|s| far(s) > ONSET * reach_m);
        let mean = samples.iter().map(|s| s.position).sum::<Vector3<f64>>() / samples.len() as f64;
        let scatter: Matrix3<f64> = samples
            .iter()
            .map(|s| (s.position - mean) * (s.position - mean).transpose())
            .sum();
        let eigen = scatter.symmetric_eigen();
        let axis = eigen
            .eigenvectors
            .column(eigen.eigenvalues.imax())
            .into_owned();
        let along: Vec<(f64, f64)> = samples
            .iter()
            .map(|s| (s.t_s, (s.position - mean).dot(&axis)))
            .collect();
        let (low, high) = along.iter().fold((f64::MAX, f64::MIN), |(l, h), (_, s)| {
            (l.min(*s), h.max(*s))
        });
        Self {
            onset_s: onset.map_or(f64::INFINITY, |s| s.t_s),
            mean,
            axis,
            range_m: high - low,
            turns: turns(&along, TURN * (high - low)),
        }
    }

    /// The bin of a moment.
    fn since(&self, t_s: f64) -> usize {
        let since_s = t_s - self.onset_s;
        SINCE_S
            .iter()
            .position(|end| since_s < *end)
            .unwrap_or(SINCE_S.len() - 1)
    }
}

/// Interior extremes from which the course goes back by at least `least`: (time, +1 a maximum, −1 a minimum).
fn turns(along: &[(f64, f64)], least: f64) -> Vec<(f64, f64)> {
    let mut found: Vec<(f64, f64)> = Vec::new();
    let Some(&first) = along.first().filter(|_| least > 0.0) else {
        return found;
    };
    let (mut low, mut high) = (first, first);
    let mut sign = 0.0;
    for &(t_s, s) in along {
        if s > high.1 {
            high = (t_s, s);
        }
        if s < low.1 {
            low = (t_s, s);
        }
        if sign >= 0.0 && high.1 - s >= least {
            // Where the recording begins nothing turns.
            if high.0 > first.0 {
                found.push((high.0, 1.0));
            }
            (sign, low) = (-1.0, (t_s, s));
            high = low;
        } else if sign <= 0.0 && s - low.1 >= least {
            if low.0 > first.0 {
                found.push((low.0, -1.0));
            }
            (sign, high) = (1.0, (t_s, s));
            low = high;
        }
    }
    found
}

/// What was wrong with predictions `h_s` ahead.
pub(super) fn faults(d: &Demonstration, shape: &Shape, course: &Course, h_s: f64) -> Faults {
    let mut faults = Faults::default();
    let samples = d.samples();
    let mut beyond = vec![f64::NEG_INFINITY; shape.turns.len()];
    for m in course {
        let now = &samples[m.sample];
        let target_s = now.t_s + h_s;
        let (predicted, truth) = (now.position + m.guess.way, now.position + m.truth);
        let error = predicted - truth;
        faults.since_onset[shape.since(now.t_s)].count(&error, &m.truth);
        let pace = |t_s: f64| d.position_at(t_s) - d.position_at(t_s - MIND_STEP_S);
        if pace(now.t_s).dot(&pace(target_s)) < 0.0 {
            faults.against.count(&error, &m.truth);
        }
        faults.off_path_m.push(off_path(d, target_s, &predicted));
        faults.gain[0] += (predicted - shape.mean).dot(&(truth - shape.mean));
        faults.gain[1] += (truth - shape.mean).norm_squared();
        for ((t_s, sign), most) in shape.turns.iter().zip(&mut beyond) {
            if (target_s - t_s).abs() <= AROUND_S {
                let extreme = d.position_at(*t_s);
                *most = most.max(sign * (predicted - extreme).dot(&shape.axis));
            }
        }
    }
    let shares = beyond.iter().map(|m| m / shape.range_m);
    faults.overshoot = shares.filter(|share| share.is_finite()).collect();
    faults
}

/// The distance from `x` to the hand's path around `t_s`, m.
fn off_path(d: &Demonstration, t_s: f64, x: &Vector3<f64>) -> f64 {
    let samples = d.samples();
    let from = samples
        .partition_point(|s| s.t_s < t_s - PATH_S)
        .saturating_sub(1);
    let to = samples.partition_point(|s| s.t_s <= t_s + PATH_S);
    let near = samples[from..(to + 1).min(samples.len())].windows(2);
    let distances = near.map(|w| {
        let (a, b) = (w[0].position, w[1].position);
        let way = b - a;
        let u = ((x - a).dot(&way) / way.norm_squared().max(1e-18)).clamp(0.0, 1.0);
        (a + way * u - x).norm()
    });
    distances.fold(f64::INFINITY, f64::min)
}

/// The performance up to its fastest moment, and from there back the way it came; `None` if there is too
/// little of it before or after. With the time of the turn, s.
pub(super) fn change_of_mind(d: &Demonstration) -> Option<(Demonstration, f64)> {
    let samples = d.samples();
    let steps = samples.windows(2).enumerate();
    let speed = |w: &[Sample]| (w[1].position - w[0].position).norm() / (w[1].t_s - w[0].t_s);
    let (fastest, _) = steps
        .map(|(n, w)| (n, speed(w)))
        .max_by(|a, b| a.1.total_cmp(&b.1))?;
    let turn = &samples[fastest + 1];
    if turn.t_s - samples[0].t_s < f64::from(MIND_AFTER) * MIND_STEP_S * 0.5 {
        return None;
    }
    let back = samples[..=fastest].iter().rev().map(|s| Sample {
        t_s: 2.0 * turn.t_s - s.t_s,
        ..*s
    });
    let all: Vec<_> = samples[..=fastest + 1]
        .iter()
        .copied()
        .chain(back)
        .collect();
    let changed = Demonstration::from_samples(d.name(), &all).ok()?;
    Some((changed, turn.t_s - samples[0].t_s))
}

/// Errors around a change of mind at `turn_s`, of each expert, by the time of what was predicted.
pub(super) fn around(
    d: &Demonstration,
    turn_s: f64,
    experts: &mut [Box<dyn Expert>],
    h_s: f64,
) -> Vec<Vec<Bin>> {
    let courses = perform(Side::Place, d, experts, &[h_s], |_| ());
    let of = |courses: Vec<Course>| {
        let mut bins = vec![Bin::default(); (MIND_BEFORE + MIND_AFTER + 1) as usize];
        for m in courses.iter().flatten() {
            let since_s = d.samples()[m.sample].t_s + h_s - turn_s;
            let step = (since_s / MIND_STEP_S).round() as i32 + MIND_BEFORE;
            if let Some(bin) = usize::try_from(step).ok().and_then(|n| bins.get_mut(n)) {
                bin.count(&(m.guess.way - m.truth), &m.truth);
            }
        }
        bins
    };
    courses.into_iter().map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluate::score::Moment;

    /// A hand that rests, then swings to and fro along x.
    fn swing() -> Demonstration {
        let place = |t: f64| {
            let t = (t - 0.5).max(0.0);
            Vector3::new(0.2 * (1.0 - (4.0 * t).cos()), 0.0, 1.0)
        };
        let samples: Vec<_> = (0..100)
            .map(|i| f64::from(i) / 30.0)
            .map(|t| Sample::at(t, place(t)))
            .collect();
        Demonstration::from_samples("swing", &samples).unwrap()
    }

    #[test]
    fn turns_are_where_the_motion_goes_back() {
        let d = swing();
        let found = Shape::of(&d).turns;
        // At (2n+1)π/4 and 2nπ/4 s after the onset, those that the recording still shows going back.
        let times: Vec<_> = found.iter().map(|(t, _)| *t).collect();
        assert_eq!(found.len(), 3, "{times:?}");
        for (n, (t, _)) in found.iter().enumerate() {
            let wanted = 0.5 + std::f64::consts::FRAC_PI_4 * (n + 1) as f64;
            assert!((t - wanted).abs() < 0.04, "{times:?}");
        }
        assert!(found.windows(2).all(|w| w[0].1 == -w[1].1));
    }

    #[test]
    fn a_prediction_too_large_by_a_fifth_is_seen_to_be() {
        let (d, h_s) = (swing(), 0.1);
        let shape = Shape::of(&d);
        let course: Vec<_> = (0..90)
            .map(|sample| {
                let now = &d.samples()[sample];
                let truth = Side::Place.way(&d, sample, now.t_s + h_s);
                let large = shape.mean + (now.position + truth - shape.mean) * 1.2;
                Moment {
                    sample,
                    guess: (large - now.position).into(),
                    truth,
                }
            })
            .collect();
        let found = faults(&d, &shape, &course, h_s);
        assert!((found.amplitude().unwrap() - 1.2).abs() < 1e-9);
        // The mean lies near the middle of the range, so beyond it by a tenth of the range or so.
        assert_eq!(found.overshoot.len(), 3);
        assert!(found.overshoot.iter().all(|o| (0.05..0.15).contains(o)));
        // Along the path's own line it is off only beyond the ends.
        assert!(found.off_path_m.iter().all(|m| *m < 0.06));
        assert!(found.since_onset[0].moments > 10);
        assert!(found.against.moments > 0);
    }

    #[test]
    fn a_changed_mind_goes_back_the_way_it_came() {
        let d = swing();
        let (changed, turn_s) = change_of_mind(&d).unwrap();
        for by_s in [0.1, 0.3] {
            let (a, b) = (
                changed.position_at(turn_s - by_s),
                changed.position_at(turn_s + by_s),
            );
            assert!((a - b).norm() < 1e-9);
        }
        assert!((changed.position_at(turn_s) - d.position_at(turn_s)).norm() < 1e-9);
    }
}
