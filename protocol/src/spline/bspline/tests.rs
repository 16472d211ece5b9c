use super::*;
use serde_json::Value;

fn load(name: &str) -> Value {
    let path = format!("{}/../tests/vectors/{name}", env!("CARGO_MANIFEST_DIR"));
    serde_json::from_str(&std::fs::read_to_string(&path).expect(&path)).expect(&path)
}

fn list(v: &Value) -> Vec<f64> {
    v.as_array()
        .unwrap()
        .iter()
        .map(|x| x.as_f64().unwrap())
        .collect()
}

fn points<const D: usize>(v: &Value) -> Vec<SVector<f64, D>> {
    v.as_array()
        .unwrap()
        .iter()
        .map(|p| SVector::from_iterator(list(p)))
        .collect()
}

/// Largest difference, relative to the largest reference value.
fn worst<const D: usize>(got: &[SVector<f64, D>], want: &[SVector<f64, D>]) -> f64 {
    let scale = want.iter().fold(1.0, |m: f64, p| m.max(p.amax()));
    got.iter()
        .zip(want)
        .fold(0.0, |m: f64, (a, b)| m.max((a - b).amax()))
        / scale
}

fn check_interpolating<const D: usize>(case: &Value) -> usize {
    let (t, y) = (list(&case["t"]), points::<D>(&case["y"]));
    let query = list(&case["query"]);
    let mut checked = 0;
    for (end, name) in [(End::Natural, "natural"), (End::NotAKnot, "not_a_knot")] {
        let want = &case["result"][name];
        if want.is_null() {
            continue;
        }
        let s = BSpline::interpolate(&t, &y, end).unwrap();
        let got: Vec<Jet<D>> = query.iter().map(|&q| s.eval(q).unwrap()).collect();
        let part = |f: fn(&Jet<D>) -> SVector<f64, D>| got.iter().map(f).collect::<Vec<_>>();
        let label = format!("{} {name}", case["name"]);
        assert!(
            worst(&part(|j| j.x), &points(&want["value"])) < 1e-10,
            "{label}"
        );
        assert!(
            worst(&part(|j| j.v), &points(&want["d1"])) < 1e-10,
            "{label}"
        );
        assert!(
            worst(&part(|j| j.a), &points(&want["d2"])) < 1e-10,
            "{label}"
        );
        checked += 1;
    }
    checked
}

#[test]
fn interpolation_matches_the_reference_vectors() {
    let file = load("spline_interpolating.json");
    let mut checked = 0;
    for case in file["cases"].as_array().unwrap() {
        checked += match case["y"][0].as_array().unwrap().len() {
            1 => check_interpolating::<1>(case),
            2 => check_interpolating::<2>(case),
            3 => check_interpolating::<3>(case),
            d => panic!("no test for {d} dimensions"),
        };
    }
    assert_eq!(checked, 13);
}

fn check_clamped<const D: usize>(case: &Value) {
    let control = points::<D>(&case["control_points"]);
    let s = BSpline::new(list(&case["knots"]), control.clone()).unwrap();
    if case["knots_kind"] == "uniform" {
        let uniform = BSpline::clamped_uniform(control).unwrap();
        assert!(
            uniform
                .knots()
                .iter()
                .zip(s.knots())
                .all(|(a, b)| (a - b).abs() < 1e-15)
        );
    }
    let got: Vec<Jet<D>> = list(&case["u"])
        .iter()
        .map(|&u| s.eval(u).unwrap())
        .collect();
    let x: Vec<_> = got.iter().map(|j| j.x).collect();
    let v: Vec<_> = got.iter().map(|j| j.v).collect();
    let a: Vec<_> = got.iter().map(|j| j.a).collect();
    assert!(worst(&x, &points(&case["value"])) < 1e-10);
    assert!(worst(&v, &points(&case["d1"])) < 1e-10);
    if !case["d2"].is_null() {
        assert!(worst(&a, &points(&case["d2"])) < 1e-10);
    }
}

#[test]
fn clamped_curves_match_the_reference_vectors() {
    let file = load("bspline_clamped.json");
    let mut checked = 0;
    for case in file["cases"].as_array().unwrap() {
        if case["degree"] != 3 {
            continue;
        }
        match case["control_points"][0].as_array().unwrap().len() {
            1 => check_clamped::<1>(case),
            2 => check_clamped::<2>(case),
            3 => check_clamped::<3>(case),
            d => panic!("no test for {d} dimensions"),
        }
        checked += 1;
    }
    assert_eq!(checked, 8);
}

#[test]
fn two_points_are_a_line_and_three_a_parabola() {
    let line = BSpline::interpolate(
        &[1.0, 3.0],
        &[SVector::from([0.0]), SVector::from([4.0])],
        End::NotAKnot,
    );
    let j = line.unwrap().eval(1.5).unwrap();
    assert!((j.x[0] - 1.0).abs() < 1e-15 && (j.v[0] - 2.0).abs() < 1e-15 && j.a[0] == 0.0);
    let y = [
        SVector::from([0.0]),
        SVector::from([1.0]),
        SVector::from([9.0]),
    ];
    let parabola = BSpline::interpolate(&[0.0, 1.0, 3.0], &y, End::NotAKnot).unwrap();
    let j = parabola.eval(2.0).unwrap();
    assert!((j.x[0] - 4.0).abs() < 1e-14 && (j.v[0] - 4.0).abs() < 1e-14);
    assert!((j.a[0] - 2.0).abs() < 1e-13);
}

#[test]
fn bad_input_is_named() {
    let y = [
        SVector::from([0.0]),
        SVector::from([1.0]),
        SVector::from([2.0]),
    ];
    let build = |t: &[f64], y| BSpline::interpolate(t, y, End::Natural);
    assert_eq!(
        build(&[0.0], &y[..1]),
        Err(SplineError::TooFew { count: 1, least: 2 })
    );
    assert_eq!(
        build(&[0.0, 1.0, 1.0], &y),
        Err(SplineError::Unordered { index: 2 })
    );
    assert_eq!(
        build(&[0.0, f64::NAN, 1.0], &y),
        Err(SplineError::NonFinite { index: 1 })
    );
    assert_eq!(
        build(&[0.0, 1.0], &y),
        Err(SplineError::CountMismatch {
            found: 3,
            expected: 2
        })
    );
    let s = build(&[0.0, 1.0, 2.0], &y).unwrap();
    assert!(matches!(s.eval(2.1), Err(SplineError::OutOfSpan { .. })));
    assert!(s.eval(f64::NAN).is_err());
    assert!(BSpline::new(vec![0.0; 8], vec![SVector::from([0.0]); 4]).is_err());
}

#[test]
fn near_coincident_times_never_panic() {
    let tiny = f64::MIN_POSITIVE;
    let y = [
        SVector::from([0.0]),
        SVector::from([1.0]),
        SVector::from([-1.0]),
        SVector::from([0.5]),
    ];
    for end in [End::Natural, End::NotAKnot] {
        if let Ok(s) = BSpline::interpolate(&[0.0, tiny, 2.0 * tiny, 1.0], &y, end) {
            let _ = s.eval(0.5);
        }
    }
}

/// A digest of the bits: it must be the same in every build and on every target.
#[test]
fn the_bits_are_pinned() {
    let hand = load("hand3d.json");
    let (t, y) = (list(&hand["t"]), points::<3>(&hand["y"]));
    let pick: Vec<usize> = (0..t.len()).step_by(7).collect();
    let kt: Vec<f64> = pick.iter().map(|&i| t[i]).collect();
    let ky: Vec<_> = pick.iter().map(|&i| y[i]).collect();
    let s = BSpline::interpolate(&kt, &ky, End::Natural).unwrap();
    let mut digest = 0u64;
    for &q in t.iter().filter(|&&q| q <= s.span_s().1) {
        let j = s.eval(q).unwrap();
        for value in j.x.iter().chain(j.v.iter()).chain(j.a.iter()) {
            digest = digest.rotate_left(7) ^ value.to_bits();
        }
    }
    assert_eq!(digest, 10_101_364_316_117_293_330);
}
