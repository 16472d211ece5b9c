//! Little data: one demonstration, or the same one several times.

use telemime_protocol::skill::Gmr;

use super::*;

/// A reach to the side with a bow, 1.5 s at 30 Hz, and a tracker's millimetre of noise.
fn reach(name: &str, seed: u64) -> Demonstration {
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
    let samples: Vec<_> = (0..=45)
        .map(|i| {
            let t_s = f64::from(i) / 30.0;
            let mut noise = || rng.random_range(-0.0017..0.0017);
            Sample::at(t_s, bow(t_s) + Vector3::from_fn(|_, _| noise()))
        })
        .collect();
    Demonstration::from_samples(name, &samples).unwrap()
}

/// Where the hand is `t_s` seconds into the reach, m.
fn bow(t_s: f64) -> Vector3<f64> {
    let u = t_s / 1.5;
    let s = u.powi(3) * (10.0 + u * (6.0 * u - 15.0));
    Vector3::new(
        0.4 * s,
        0.3 * (std::f64::consts::PI * s).sin(),
        2.0 - 0.2 * s,
    )
}

/// A component a sample told every sample to a tenth of a millimetre, and jumped by centimetres between them.
#[test]
fn one_demonstration_is_no_staircase_between_its_samples() {
    for demonstrations in [
        vec![reach("a", 1)],
        vec![reach("a", 1), reach("b", 1)],
        (0..6).map(|n| reach(&n.to_string(), 1)).collect(),
    ] {
        let skill = learn_skill("reach", &demonstrations, &LearnOptions::default(), |_| ());
        let gmr = Gmr::<1, 3>::new(skill.unwrap().motion()).unwrap();
        let motion = |t_s: f64| gmr.query(&[t_s].into()).mean;
        let n = demonstrations.len();
        let step_s = 0.002;
        let mut before = motion(0.0);
        let mut t_s = step_s;
        while t_s <= 1.5 {
            let at = motion(t_s);
            let off_mm = (at - bow(t_s)).norm() * 1e3;
            assert!(
                off_mm < 16.0,
                "{n} times the same: {off_mm} mm off at {t_s} s"
            );
            let v = (at - before).norm() / step_s;
            assert!(v < 1.8, "{n} times the same: {v} m/s at {t_s} s");
            before = at;
            t_s += step_s;
        }
    }
}

/// A performance of the publication's first task: all of them begin in one point and end in another, exactly.
fn task_one(own: &mut impl FnMut() -> f64) -> Vec<Vector3<f64>> {
    let (width, middle) = (0.25 * (1.0 + 0.1 * own()), 0.5 * (1.0 + 0.1 * own()));
    let raw = |t: f64| {
        let bump = (-0.5 * ((t - middle) / width).powi(2)).exp() / (width * 2.5066);
        3.4 * t.powf(6.971958) + 0.6 * (t + bump)
    };
    let points = (0..50).map(|i| f64::from(i) / 49.0);
    let y = |t| (raw(t) - raw(0.0)) / (raw(1.0) - raw(0.0)) * 2.0;
    points.map(|t| Vector3::new(t, y(t), 0.0)).collect()
}

/// Components of a moment near the end told every sample, and between two of them the motion fell by half its height.
#[test]
fn where_demonstrations_meet_the_motion_does_not_jump_between_samples() {
    for seed in [0, 2, 8, 10] {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        // About normal: a sum of uniform numbers.
        let mut own = || (0..12).map(|_| rng.random_range(-0.5..0.5)).sum();
        let paths: Vec<_> = (0..10).map(|_| task_one(&mut own)).collect();
        let demonstrations: Vec<_> = paths
            .iter()
            .enumerate()
            .map(|(n, path)| {
                let samples: Vec<_> = path.iter().map(|x| Sample::at(x.x, *x)).collect();
                Demonstration::from_samples(n.to_string(), &samples).unwrap()
            })
            .collect();
        let skill = learn_skill("meet", &demonstrations, &LearnOptions::default(), |_| ());
        let gmr = Gmr::<1, 3>::new(skill.unwrap().motion()).unwrap();
        // Beyond 0.9 of the time they are one path.
        for i in 900..=1000 {
            let t_s = f64::from(i) / 1000.0;
            let at = |path: &Vec<Vector3<f64>>| {
                let sample = ((t_s * 49.0) as usize).min(48);
                let share = t_s * 49.0 - sample as f64;
                path[sample].y * (1.0 - share) + path[sample + 1].y * share
            };
            let shown = paths.iter().map(at);
            let (low, high) = shown.fold((f64::MAX, f64::MIN), |(l, h), y| (l.min(y), h.max(y)));
            let y = gmr.query(&[t_s].into()).mean.y;
            assert!(
                y > low - 0.03 && y < high + 0.03,
                "seed {seed}: {y} m at {t_s} s, shown {low} to {high} m"
            );
        }
    }
}
