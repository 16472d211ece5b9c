use super::*;
use nalgebra::{Vector1, Vector3};
use proptest::prelude::*;
use serde_json::Value;

fn load(name: &str) -> Value {
    let path = format!("{}/../tests/vectors/{name}", env!("CARGO_MANIFEST_DIR"));
    serde_json::from_str(&std::fs::read_to_string(&path).expect(&path)).expect(&path)
}

fn list(v: &Value) -> Vec<f64> {
    serde_json::from_value(v.clone()).unwrap()
}

fn largest_error<const D: usize>(plan: &Plan<D>, t: &[f64], y: &[SVector<f64, D>]) -> f64 {
    let s = plan.spline().unwrap();
    let (start_s, end_s) = s.span_s();
    assert!(start_s <= t[0] + 1e-9 && end_s >= t[t.len() - 1] - 1e-9);
    t.iter()
        .zip(y)
        .map(|(&t, y)| (s.eval(t.clamp(start_s, end_s)).unwrap().x - y).norm())
        .fold(0.0, f64::max)
}

fn at_half_a_per_cent<const D: usize>(t: &[f64], y: &[SVector<f64, D>]) -> usize {
    let range = (0..D)
        .map(|d| {
            let (low, high) = y.iter().fold((f64::MAX, f64::MIN), |(low, high), v| {
                (low.min(v[d]), high.max(v[d]))
            });
            high - low
        })
        .fold(0.0, f64::max);
    let plan = bounded(t, y, 0.005 * range).unwrap();
    assert!(largest_error(&plan, t, y) <= 0.005 * range);
    plan.len()
}

/// The rate–distortion study's best: 6 for task 1, 7 for task 2; 48 for the five swings by greedy
/// insertion, 38 with relocation and least-squares values, both without quantisation.
#[test]
fn few_points_hold_the_bound() {
    let most = [
        ("task1", 7),
        ("task1k7", 12),
        ("task1demo", 7),
        ("task2", 7),
        ("task2k5", 10),
    ];
    let curves = load("codec_curves.json");
    let curves = curves["curves"].as_array().unwrap();
    assert_eq!(curves.len(), most.len());
    for (curve, (name, most)) in curves.iter().zip(most) {
        assert_eq!(curve["name"], name);
        let y: Vec<_> = list(&curve["y"]).into_iter().map(Vector1::new).collect();
        let count = at_half_a_per_cent(&list(&curve["t"]), &y);
        assert!(count <= most, "{name}: {count}");
    }
    let hand = load("hand3d.json");
    let y = hand["y"].as_array().unwrap().iter();
    let y: Vec<_> = y.map(|p| Vector3::from_iterator(list(p))).collect();
    let count = at_half_a_per_cent(&list(&hand["t"]), &y);
    assert!(count <= 40, "five swings: {count}");
}

#[test]
fn a_line_needs_its_ends_only() {
    let t: Vec<f64> = (0..100).map(|i| f64::from(i) * 0.01).collect();
    let y: Vec<_> = t.iter().map(|t| Vector3::new(*t, -2.0 * t, 0.5)).collect();
    assert_eq!(bounded(&t, &y, 1e-3).unwrap().len(), 2);
}

#[test]
fn a_hand_that_rests_costs_two_points() {
    let t: Vec<f64> = (0..100).map(|i| f64::from(i) * 0.01).collect();
    let plan = bounded(&t, &[Vector3::new(0.3, -1.2, 0.7); 100], 1e-3).unwrap();
    assert_eq!(plan.len(), 2);
    assert!(plan.byte_len() < 25, "{} bytes", plan.byte_len());
}

#[test]
fn a_hasty_choice_holds_the_bound_too() {
    let hand = load("hand3d.json");
    let y = hand["y"].as_array().unwrap().iter();
    let y: Vec<_> = y.map(|p| Vector3::from_iterator(list(p))).collect();
    let t = list(&hand["t"]);
    let mut selector = Selector::new();
    let hasty = selector
        .bounded(&t, &y, 0.002, Effort::Quick)
        .unwrap()
        .clone();
    let thorough = bounded(&t, &y, 0.002).unwrap();
    assert!(largest_error(&hasty, &t, &y) <= 0.002);
    assert!(largest_error(&thorough, &t, &y) <= 0.002);
    assert!(thorough.byte_len() < hasty.byte_len());
}

#[test]
fn one_sample_is_no_motion() {
    assert_eq!(
        bounded(&[0.0], &[Vector1::new(1.0)], 0.1),
        Err(CheckpointError::TooFew { count: 1, least: 2 })
    );
    assert!(matches!(
        bounded(&[0.0, 1.0], &[Vector1::new(1.0); 2], 1e-9),
        Err(CheckpointError::BoundTooFine { .. })
    ));
}

#[test]
fn bad_input_is_named() {
    let y = [Vector1::new(0.0), Vector1::new(1.0)];
    assert!(matches!(
        bounded(&[0.0, 1.0], &y, 0.0),
        Err(CheckpointError::Bound { .. })
    ));
    assert_eq!(
        bounded(&[1.0, 1.0], &y, 0.1),
        Err(CheckpointError::Unordered { index: 1 })
    );
    assert_eq!(
        bounded(&[0.0, 1.0], &[y[0], Vector1::new(f64::NAN)], 0.1),
        Err(CheckpointError::NonFinite { index: 1 })
    );
    assert_eq!(
        bounded(&[-1.0, 1.0], &y, 0.1),
        Err(CheckpointError::OutOfRange { index: 0 })
    );
    assert!(matches!(
        bounded(&[0.0, 1e-7, 1.0], &[y[0], y[1], y[1]], 1e-3),
        Err(CheckpointError::Unreachable { index: 1, .. })
    ));
}

/// One selector for all, in turn: what it has chosen before changes nothing, and a second choice allocates nothing.
#[test]
fn once_warm_it_allocates_nothing() {
    let motion = |n: usize, pace: f64| {
        let t: Vec<f64> = (0..n).map(|i| i as f64 / 30.0).collect();
        let at = |t: &f64| {
            let (s, c) = (libm::sin(pace * t), libm::cos(1.7 * pace * t));
            Vector3::new(s, 0.6 * c, s * c) * 0.4
        };
        (t.clone(), t.iter().map(at).collect::<Vec<_>>())
    };
    let motions = [motion(200, 3.0), motion(150, 2.0)];
    let mut selector = Selector::new();
    for effort in [Effort::Quick, Effort::Brisk, Effort::Thorough] {
        let cold = motions.each_ref().map(|(t, y)| {
            let plan = Selector::new().bounded(t, y, 0.004, effort).cloned();
            plan.unwrap()
        });
        let few = motions.each_ref().map(|(t, y)| {
            let plan = Selector::new().counted(t, y, 20, effort).cloned();
            plan.unwrap()
        });
        for warm in [false, true] {
            let touched = allocation_counter::measure(|| {
                for (i, (t, y)) in motions.iter().enumerate() {
                    let plan = selector.bounded(t, y, 0.004, effort).unwrap();
                    assert_eq!(*plan, cold[i]);
                    let plan = selector.counted(t, y, 20, effort).unwrap();
                    assert_eq!(*plan, few[i]);
                }
            });
            println!(
                "{effort:?}, warm: {warm}: {} allocations",
                touched.count_total
            );
            assert!(!warm || touched.count_total == 0, "{effort:?}: {touched:?}");
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    /// Noise, jumps and uneven sampling: the bound holds, or the refusal is typed.
    #[test]
    fn the_bound_holds_on_any_series(
        steps in prop::collection::vec((1u32..40_000, prop::array::uniform3(-1.0..1.0f64)), 2..60),
        bound_m in 1e-4..0.5f64,
    ) {
        let mut now_us = 0;
        let (t, y): (Vec<f64>, Vec<_>) = steps
            .iter()
            .map(|(dt_us, x)| {
                now_us += dt_us;
                (f64::from(now_us) * 1e-6, Vector3::from(*x))
            })
            .unzip();
        match bounded(&t, &y, bound_m) {
            Ok(plan) => prop_assert!(largest_error(&plan, &t, &y) <= bound_m),
            Err(e) => prop_assert!(matches!(e, CheckpointError::Unreachable { .. }), "{e}"),
        }
    }
}
