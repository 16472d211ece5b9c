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
