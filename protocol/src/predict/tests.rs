use nalgebra::Vector3;
use proptest::prelude::*;

use super::*;
use crate::skill::example;
use crate::time::Stamp;

const UNDAMPED: Params = Params {
    gain: 1.0,
    trust: 1.0,
    cv_damping: 1.0,
};

/// A hand that has moved at `v` (m/s) for two seconds.
fn steady(v: Vector3<f64>) -> HandState {
    let mut s = HandState::first(Stamp(0), Vector3::zeros());
    for i in 1..=60 {
        let t = Stamp(i * 33_333_333);
        assert!(s.advance(t, v * t.as_secs_f64()));
    }
    s
}

/// A state at the mean of one component of the example.
fn at_home(model: &Model) -> HandState {
    let f = model.components()[0]
        .mean
        .component_mul(&model.standardisation().scale)
        + model.standardisation().mean;
    let x = Vector3::new(f[0], f[1], f[2]);
    HandState {
        t: Stamp(0),
        x,
        memory: std::array::from_fn(|m| x - f.fixed_rows::<3>(3 * m + 3)),
    }
}

#[test]
fn steady_motion_is_continued_without_a_model() {
    let v = Vector3::new(1.0, -0.5, 0.25);
    let s = steady(v);
    let f = Forecast::constant_velocity(&s, &UNDAMPED);
    for h_s in [0.0, 0.05, 0.1, 0.37, 0.8] {
        let p = f.at(h_s);
        assert!((p.position - s.x - v * h_s).norm() < 1e-6, "{h_s}");
        assert!(!p.beyond);
    }
    let half = Forecast::constant_velocity(&s, &Params::DEFAULT);
    assert!((half.at(0.4).position - s.x - v * 0.2).norm() < 1e-6);
}

#[test]
fn constant_acceleration_does_not_bias_the_velocity() {
    let (v, a) = (Vector3::new(0.5, 0.0, 1.0), Vector3::new(2.0, -3.0, 0.0));
    let mut s = HandState::first(Stamp(0), Vector3::zeros());
    for ms in 1..=4000 {
        let t = Stamp(ms * 1_000_000);
        let t_s = t.as_secs_f64();
        s.advance(t, v * t_s + a * (0.5 * t_s * t_s));
    }
    let (velocity, acceleration) = s.motion();
    assert!((velocity - v - a * 4.0).norm() < 1e-3, "{velocity}");
    assert!((acceleration - a).norm() < 1e-2, "{acceleration}");
}

#[test]
fn beyond_the_last_knot_the_position_is_held_and_said_to_be() {
    let skill = example(3, 6);
    let f = skill.predictor().forecast(&steady(Vector3::x()), &UNDAMPED);
    assert_eq!(f.ahead.count, 6);
    let last = f.at(f.reach_s());
    assert!(!last.beyond);
    for h_s in [0.21, 5.0, f64::INFINITY] {
        let p = f.at(h_s);
        assert!(p.beyond);
        assert_eq!((p.position, p.sigma_m), (last.position, last.sigma_m));
    }
    for h_s in [0.0, -1.0, f64::NEG_INFINITY, f64::NAN] {
        let p = f.at(h_s);
        assert_eq!((p.position, p.sigma_m, p.beyond), (f.x, 0.0, false));
    }
}

#[test]
fn between_knots_the_path_is_linear() {
    let skill = example(3, 6);
    let f = skill
        .predictor()
        .forecast(&at_home(skill.predictor()), &Params::DEFAULT);
    let (a, b) = (f.at(2.0 * KNOT_SPACING_S), f.at(3.0 * KNOT_SPACING_S));
    let middle = f.at(2.5 * KNOT_SPACING_S);
    assert!((middle.position - (a.position + b.position) * 0.5).norm() < 1e-12);
    assert!((a.position - f.x - f.ahead.knots[2].displacement).norm() < 1e-12);
}

#[test]
fn the_mixture_speaks_where_it_knows_and_constant_velocity_elsewhere() {
    let skill = example(3, 6);
    let model = skill.predictor();
    let home = at_home(model);
    let known = model.forecast(&home, &Params::DEFAULT);
    assert!(
        known.ahead.weight > 0.99 && known.ahead.novelty < 1e-9,
        "{known:?}"
    );
    let learned = model.posterior(&home).displacement[2];
    assert!((known.ahead.knots[3].displacement - learned).norm() < 1e-4);

    let far = steady(Vector3::new(40.0, 0.0, 0.0));
    let new = model.forecast(&far, &UNDAMPED);
    assert!(new.ahead.weight < 1e-4, "{}", new.ahead.weight);
    let expected = Forecast::constant_velocity(&far, &UNDAMPED);
    assert!((new.at(0.1).position - expected.at(0.1).position).norm() < 0.02);

    let absurd = steady(Vector3::new(1e200, 0.0, 0.0));
    let f = model.forecast(&absurd, &UNDAMPED);
    assert_eq!(f.ahead.weight, 0.0);
    assert!(f.at(0.1).position.x.is_finite() && f.at(0.1).sigma_m.is_finite());
}

#[test]
fn parameters_do_what_they_say() {
    let skill = example(3, 6);
    let model = skill.predictor();
    let s = at_home(model);
    let hold = Params {
        gain: 0.0,
        ..Params::DEFAULT
    };
    assert_eq!(model.forecast(&s, &hold).at(0.15).position, s.x);
    let distrust = Params {
        trust: 0.0,
        ..UNDAMPED
    };
    let f = model.forecast(&s, &distrust);
    let cv = Forecast::constant_velocity(&s, &UNDAMPED);
    assert_eq!(
        (f.ahead.weight, f.ahead.knots[4].displacement),
        (0.0, cv.ahead.knots[4].displacement)
    );
    for bad in [-0.1, 1.1, f64::NAN] {
        let refused = Params { trust: bad, ..hold }.checked().unwrap_err();
        assert_eq!(refused.field, "trust");
    }
    assert_eq!(hold.checked(), Ok(hold));
}

#[test]
fn the_checksum_sees_a_micrometre_and_nothing_below() {
    let mut f =
        Forecast::constant_velocity(&HandState::first(Stamp(0), Vector3::zeros()), &UNDAMPED);
    let sum = checksum(&f, None);
    f.x.y = 0.4e-6;
    assert_eq!(checksum(&f, None), sum);
    f.x.y = 1e-6;
    assert_ne!(checksum(&f, None), sum);
}

#[test]
fn a_decoded_model_predicts_to_the_bit_as_the_one_that_was_sent() {
    let skill = example(14, 24);
    let other = crate::skill::Skill::from_bytes(skill.to_bytes()).unwrap();
    let s = steady(Vector3::new(0.3, 0.1, -0.2));
    let (a, b) = (
        skill.predictor().forecast(&s, &Params::DEFAULT),
        other.predictor().forecast(&s, &Params::DEFAULT),
    );
    assert_eq!(a, b);
    assert_eq!(checksum(&a, None), checksum(&b, None));
}

/// Every bit of a forecast, folded. Both ends may be built differently; they must still get these.
#[test]
fn every_build_predicts_the_same_bits() {
    let skill = example(14, 24);
    let mut s = HandState::first(Stamp(0), Vector3::new(0.1, 0.2, 0.3));
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    for i in 1..40_i64 {
        let u = i as f64;
        let x = Vector3::new(libm::sin(0.3 * u), libm::cos(0.2 * u), 0.01 * u);
        assert!(s.advance(Stamp(i * 31_000_000 + i * i * 1000), x));
        let f = skill.predictor().forecast(&s, &Params::DEFAULT);
        for knot in &f.ahead.knots {
            for v in knot.displacement.iter().chain([&knot.sigma]) {
                hash = (hash ^ v.to_bits()).wrapping_mul(0x0000_0100_0000_01b3);
            }
        }
    }
    assert_eq!(format!("{hash:016x}"), "b875f50a66c10553");
    assert_eq!(skill.id().to_string(), "a2ea9815aac6b4696208f0949c3bb76a");
}

proptest! {
    #[test]
    fn no_finite_hand_gives_nan(path in proptest::collection::vec(
        (1_i64..500_000_000, -1e6..1e6, -1e6..1e6, -1e6..1e6), 1..12),
        gain in 0.0..=1.0, trust in 0.0..=1.0, cv_damping in 0.0..=1.0, h_s in -1.0..2.0,
    ) {
        let skill = example(3, 6);
        let params = Params { gain, trust, cv_damping };
        let mut s = HandState::first(Stamp(0), Vector3::zeros());
        for (dt, x, y, z) in path {
            prop_assert!(s.advance(Stamp(s.t.0 + dt), Vector3::new(x, y, z)));
        }
        prop_assert!(s.is_finite());
        for f in [skill.predictor().forecast(&s, &params), Forecast::constant_velocity(&s, &params)] {
            let p = f.at(h_s);
            prop_assert!(p.position.iter().all(|v| v.is_finite()));
            prop_assert!(p.sigma_m.is_finite() && p.sigma_m >= 0.0);
            prop_assert!((0.0..=1.0).contains(&f.ahead.weight));
        }
    }
}
