//! Alignment of recorded gestures: the tube before and after, and what alignment did not see.

use telemime_operator::demonstration::{Demonstration, Demonstrations};
use telemime_operator::learn::align::{Aligned, align};
use telemime_operator::learn::tube::BeforeAfter;
use telemime_protocol::pose;
use telemime_protocol::skill::chi_squared_quantile;

use crate::data::needs;

fn aligned(folder: &str) -> Option<(Vec<Demonstration>, Aligned, BeforeAfter)> {
    let dir = needs(&format!("data/demos/{folder}"))?;
    let demonstrations = Demonstrations::read_dir(dir, None).unwrap().demonstrations;
    let aligned = align(&demonstrations).unwrap();
    let tubes = BeforeAfter::of(&demonstrations, &aligned);
    Some((demonstrations, aligned, tubes))
}

/// Timing made the tube this many times as wide, at least.
fn narrower(folder: &str, ratio: f64) {
    let Some((demonstrations, aligned, tubes)) = aligned(folder) else {
        return;
    };
    let (before, after) = (tubes.before.deviation_m(), tubes.after.deviation_m());
    assert!(before > ratio * after, "{folder}: {before} m, {after} m");
    // No clock stands still, and every sample has a phase of its own.
    for (index, d) in demonstrations.iter().enumerate() {
        let step_s = d.duration_s() / (aligned.times_s.len() - 1) as f64;
        let steps = aligned.warps_s[index].windows(2).map(|w| w[1] - w[0]);
        let least = steps.fold(f64::INFINITY, f64::min);
        assert!(least > 0.1 * step_s, "{}: {least} s", d.name());
        let phases = aligned.phases(index, d);
        assert_eq!((phases[0], phases[phases.len() - 1]), (0.0, 1.0));
        assert!(phases.windows(2).all(|w| w[0] < w[1]), "{}", d.name());
    }
}

#[test]
fn a_recorded_wave_is_narrower_aligned() {
    narrower("utd_mhad/a03_wave", 1.12);
}

#[test]
fn other_people_s_wave_is_narrower_aligned() {
    narrower("kard/a01_horizontal_arm_wave", 1.45);
}

#[test]
fn a_guided_robot_s_motion_is_narrower_aligned() {
    narrower("robottasks/pouring", 1.25);
    narrower("robottasks/openbox", 2.1);
}

/// Alignment looks at positions only. If it explained noise by pace, orientations would be farther apart for it.
#[test]
fn orientations_that_alignment_does_not_see_agree_better_too() {
    let Some((demonstrations, aligned, _)) = aligned("robottasks/pouring") else {
        return;
    };
    let points = aligned.times_s.len();
    let spread = |moment: &dyn Fn(usize, usize) -> f64| {
        let mut sum = 0.0;
        for i in 0..points {
            let turns: Vec<_> = demonstrations
                .iter()
                .enumerate()
                .map(|(k, d)| d.orientation_at(d.samples()[0].t_s + moment(k, i)).unwrap())
                .collect();
            let mean = pose::mean(turns.iter().map(|q| (1.0, *q))).unwrap();
            let squares: f64 = turns.iter().map(|q| mean.angle_to(q).powi(2)).sum();
            sum += (squares / turns.len() as f64).sqrt();
        }
        sum / points as f64
    };
    let before = spread(&|k, i| demonstrations[k].duration_s() * i as f64 / (points - 1) as f64);
    let after = spread(&|k, i| aligned.warps_s[k][i]);
    assert!(after < 0.8 * before, "{after} rad, {before} rad");
}

/// The region of 95 % around the mean holds about that share of what it was made from.
#[test]
fn the_tube_of_a_recorded_motion_holds_what_it_says() {
    let Some((_, aligned, tubes)) = aligned("kard/a01_horizontal_arm_wave") else {
        return;
    };
    let radius2 = chi_squared_quantile(0.95, 3).unwrap();
    let (mut inside, mut of) = (0, 0);
    for i in 0..aligned.times_s.len() {
        let at = telemime_protocol::skill::Regressed {
            mean: tubes.after.mean[i],
            covariance: tubes.after.covariance[i],
        };
        for path in &aligned.paths {
            inside += usize::from(at.distance2(&path[i]).is_some_and(|d| d <= radius2));
            of += 1;
        }
    }
    let share = inside as f64 / of as f64;
    assert!((0.90..0.99).contains(&share), "{share}");
}
