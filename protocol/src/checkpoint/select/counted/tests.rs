use super::*;
use nalgebra::{Vector1, Vector3};
use serde_json::Value;

fn load(name: &str) -> Value {
    let path = format!("{}/../tests/vectors/{name}", env!("CARGO_MANIFEST_DIR"));
    serde_json::from_str(&std::fs::read_to_string(&path).expect(&path)).expect(&path)
}

fn list(v: &Value) -> Vec<f64> {
    serde_json::from_value(v.clone()).unwrap()
}

fn curve(name: &str) -> (Vec<f64>, Vec<Vector1<f64>>) {
    let file = load("codec_curves.json");
    let curves = file["curves"].as_array().unwrap();
    let one = curves.iter().find(|c| c["name"] == name).unwrap();
    let y = list(&one["y"]).into_iter().map(Vector1::new).collect();
    (list(&one["t"]), y)
}

/// 1 − R² of the worst dimension, decoded and quantised.
fn lost<const D: usize>(t: &[f64], y: &[SVector<f64, D>], count: usize, effort: Effort) -> f64 {
    let mut selector = Selector::new();
    let plan = selector.counted(t, y, count, effort).unwrap();
    assert!(plan.len() <= count);
    let spline = plan.spline().unwrap();
    let (start_s, end_s) = spline.span_s();
    let mean = y.iter().sum::<SVector<f64, D>>() / y.len() as f64;
    let (mut residual, mut total) = (SVector::<f64, D>::zeros(), SVector::<f64, D>::zeros());
    for (&t, y) in t.iter().zip(y) {
        let e = spline.eval(t.clamp(start_s, end_s)).unwrap().x - y;
        residual += e.component_mul(&e);
        total += (y - mean).component_mul(&(y - mean));
    }
    let lost = residual.component_div(&total).max();
    println!("{count} of {}, {effort:?}: 1 - R2 = {lost:.2e}", t.len());
    lost
}

const EFFORTS: [Effort; 2] = [Effort::Brisk, Effort::Thorough];

#[test]
fn fewest_points_for_a_coefficient_of_determination() {
    for effort in EFFORTS {
        for (name, count) in [("task1", 7), ("task1k7", 11), ("task2", 8)] {
            let (t, y) = curve(name);
            assert!(lost(&t, &y, count, effort) <= 1e-4, "{name} with {count}");
        }
        let hand = load("hand3d.json");
        let y = hand["y"].as_array().unwrap().iter();
        let y: Vec<_> = y.map(|p| Vector3::from_iterator(list(p))).collect();
        assert!(lost(&list(&hand["t"]), &y, 46, effort) <= 1e-4);
    }
}

#[test]
fn with_as_many_points_as_the_publication() {
    for effort in EFFORTS {
        let (t, y) = curve("task2");
        assert!(lost(&t, &y, 18, effort) <= 1e-7);
        let (t, y) = curve("task1k7");
        assert!(lost(&t, &y, 18, effort) <= 5e-6);
    }
}

#[test]
fn odd_requests() {
    let t = [0.0, 0.5, 1.0];
    let y = [0.0, 1.0, 0.0].map(Vector1::new);
    assert_eq!(counted(&t, &y, 99).unwrap().len(), 3);
    assert_eq!(counted(&t, &[Vector1::new(2.0); 3], 2).unwrap().len(), 2);
    assert!(matches!(
        counted(&t, &y, 1),
        Err(CheckpointError::TooFew { .. })
    ));
    assert_eq!(
        counted(&t, &y, MAX_POINTS + 1),
        Err(CheckpointError::TooMany)
    );
    let close = counted(&[0.0, 1e-9, 1.0], &y, 3).unwrap();
    assert_eq!(close.len(), 2);
}
