use nalgebra::Vector3;
use proptest::prelude::*;

use super::*;
use crate::skill::example;
use crate::time::Stamp;

const STRAIGHT: Params = Params::only([0.0, 0.0, 1.0]);

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
    let v = Vector3::new(0.1, -0.05, 0.025);
    let s = steady(v);
    let f = Forecast::constant_velocity(&s, &STRAIGHT);
    for h_s in [0.0, 0.05, 0.1, 0.37, 0.8] {
        let p = f.at(h_s);
        assert!((p.position - s.x - v * h_s).norm() <= 6e-3 * h_s, "{h_s}");
        assert!(!p.beyond);
    }
    // What the mixture would say is half as good as the straight line.
    let half = Forecast::constant_velocity(&s, &Params::DEFAULT);
    let way = f.at(0.4).position - s.x;
    assert!((half.at(0.4).position - s.x - way * 0.5).norm() < 1e-12);
}

#[test]
fn a_straight_line_ends_within_reach() {
    for speed in [0.1, 1.0, 10.0, 1e3] {
        let s = steady(Vector3::new(0.0, speed, 0.0));
        let f = Forecast::constant_velocity(&s, &STRAIGHT);
        let mut before = 0.0;
        for h_s in [0.1, 0.3, 0.8] {
            let way = (f.at(h_s).position - s.x).norm();
            assert!(way > before && way < 0.3 && way <= speed * h_s, "{way}");
            before = way;
        }
    }
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
    let f = skill.predictor().forecast(&steady(Vector3::x()), &STRAIGHT);
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
        known.ahead.familiarity > 0.99 && known.ahead.novelty < 1e-9,
        "{known:?}"
    );
    let learned = model.posterior(&home).displacement[2];
    assert!((known.ahead.knots[3].displacement - learned).norm() < 1e-4);

    let far = steady(Vector3::new(40.0, 0.0, 0.0));
    let mixed = Params::only([0.5, 0.0, 0.5]);
    let new = model.forecast(&far, &mixed);
    assert!(new.ahead.familiarity < 1e-4, "{}", new.ahead.familiarity);
    // The weights the others have say who gets the mixture's: nearly all of it the straight line.
    let expected = Forecast::constant_velocity(&far, &STRAIGHT);
    let way = (new.at(0.1).position - expected.at(0.1).position).norm();
    assert!(way < 0.02, "{way}");

    let absurd = steady(Vector3::new(1e100, 0.0, 0.0));
    let f = model.forecast(&absurd, &STRAIGHT);
    assert_eq!(f.ahead.familiarity, 0.0);
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
    let experts = Forecast::experts(&s, Some(model));
    for (e, weights) in [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
        .into_iter()
        .enumerate()
    {
        let f = model.forecast(&s, &Params::only(weights));
        for j in 1..=6 {
            let apart = f.ahead.knots[j].displacement - experts.displacement[j - 1][e];
            assert!(apart.norm() < 1e-6, "{e} {j} {apart}");
        }
    }
    let still = model.forecast(&s, &Params::only([0.0; 3]));
    assert_eq!(still.ahead.knots[6].displacement, Vector3::zeros());

    let wide = Params {
        inflation: 9.0,
        ..Params::DEFAULT
    };
    let (narrow, wide) = (
        model.forecast(&s, &Params::DEFAULT),
        model.forecast(&s, &wide),
    );
    assert!((wide.at(0.1).sigma_m / narrow.at(0.1).sigma_m - 3.0).abs() < 1e-12);

    for bad in [-0.1, 1.1, f64::NAN] {
        let refused = Params { gain: bad, ..hold }.checked().unwrap_err();
        assert_eq!(refused.field, "gain");
    }
    let refused = |weights| Params { weights, ..hold }.checked().unwrap_err().field;
    assert_eq!(refused([[0.5, 0.3, 0.3]; 3]), "sum of weights");
    assert_eq!(refused([[0.5, -0.1, 0.0]; 3]), "weight");
    let never = Params {
        inflation: 0.0,
        ..hold
    };
    assert_eq!(never.checked().unwrap_err().field, "inflation");
    assert_eq!(hold.checked(), Ok(hold));
}

/// Weights hold up to 0.1 s, change evenly to those of 0.2 s, and hold beyond 0.4 s.
#[test]
fn weights_change_gently_over_the_horizon() {
    let mut params = Params::DEFAULT;
    params.weights = [[0.9, 0.0, 0.1], [0.3, 0.0, 0.7], [0.0, 0.6, 0.4]];
    let mixture = |j: usize| params.at(j)[0];
    assert_eq!([mixture(1), mixture(3)], [0.9, 0.9]);
    assert!((mixture(4) - 0.7).abs() < 1e-12 && (mixture(6) - 0.3).abs() < 1e-12);
    assert!((mixture(9) - 0.15).abs() < 1e-12);
    assert_eq!(params.at(12), params.at(24));
    for j in 1..=24 {
        assert!((params.at(j).iter().sum::<f64>() - 1.0).abs() < 1e-12);
    }
}

/// Where experts disagree, nobody knows: the distance between them is part of the deviation.
#[test]
fn disagreement_widens_the_region() {
    let skill = example(3, 6);
    let model = skill.predictor();
    let s = at_home(model);
    let sigma = |weights| model.forecast(&s, &Params::only(weights)).at(0.2).sigma_m;
    let (one, other) = (sigma([1.0, 0.0, 0.0]), sigma([0.0, 1.0, 0.0]));
    let experts = Forecast::experts(&s, Some(model)).displacement[5];
    let apart2 = (experts[0] - experts[1]).norm_squared();
    let both = sigma([0.5, 0.5, 0.0]);
    let expected = 0.5 * (one * one + other * other) + 0.25 * apart2 / 3.0;
    assert!(
        (both * both / expected - 1.0).abs() < 1e-6,
        "{both} {expected}"
    );
}

#[test]
fn the_checksum_sees_a_micrometre_and_nothing_below() {
    let mut f =
        Forecast::constant_velocity(&HandState::first(Stamp(0), Vector3::zeros()), &STRAIGHT);
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

/// Every bit of a model's forecasts along a fixed path, folded.
fn folded(model: &Model) -> String {
    let mut s = HandState::first(Stamp(0), Vector3::new(0.1, 0.2, 0.3));
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    for i in 1..40_i64 {
        let u = i as f64;
        let x = Vector3::new(libm::sin(0.3 * u), libm::cos(0.2 * u), 0.01 * u);
        assert!(s.advance(Stamp(i * 31_000_000 + i * i * 1000), x));
        let f = model.forecast(&s, &Params::DEFAULT);
        for knot in &f.ahead.knots {
            for v in knot
                .displacement
                .iter()
                .chain(&knot.covariance)
                .chain([&knot.sigma])
            {
                hash = (hash ^ v.to_bits()).wrapping_mul(0x0000_0100_0000_01b3);
            }
        }
    }
    format!("{hash:016x}")
}

/// Both ends may be built differently; they must still get these.
#[test]
fn every_build_predicts_the_same_bits() {
    let skill = example(14, 24);
    let model = skill.predictor();
    assert_eq!(folded(model), "2b2be94c5327f79c");
    assert_eq!(skill.id().to_string(), "a1412075850b579dfe49376f03e95683");
    let units = Standardisation {
        bend: [0.02, 0.05],
        ..model.standardisation().clone()
    };
    let parts = (model.components().to_vec(), *model.generic());
    let bent = Model::new(24, units, parts.0, parts.1, *model.calibration()).unwrap();
    assert_eq!(folded(&bent), "34ef99bf2e640359");
}

proptest! {
    #[test]
    fn no_finite_hand_gives_nan(path in proptest::collection::vec(
        (1_i64..500_000_000, -1e6..1e6, -1e6..1e6, -1e6..1e6), 1..12),
        gain in 0.0..=1.0, weights in proptest::array::uniform3(proptest::array::uniform3(0.0..=0.33)),
        octaves in -16.0..16.0_f64, h_s in -1.0..2.0,
    ) {
        let skill = example(3, 6);
        let params = Params { gain, inflation: octaves.exp2(), weights };
        let mut s = HandState::first(Stamp(0), Vector3::zeros());
        for (dt, x, y, z) in path {
            prop_assert!(s.advance(Stamp(s.t.0 + dt), Vector3::new(x, y, z)));
        }
        prop_assert!(s.is_finite());
        for f in [skill.predictor().forecast(&s, &params), Forecast::constant_velocity(&s, &params)] {
            let p = f.at(h_s);
            prop_assert!(p.position.iter().all(|v| v.is_finite()));
            prop_assert!(p.sigma_m.is_finite() && p.sigma_m >= 0.0);
            prop_assert!((0.0..=1.0).contains(&f.ahead.familiarity));
        }
    }
}
