use std::f64::consts::PI;

use nalgebra::Vector3;

use super::*;

fn poses(n: usize, at: impl Fn(f64) -> [f64; 3]) -> Vec<Pose> {
    (0..n)
        .map(|i| {
            let t_s = i as f64 / 30.0;
            Pose {
                t_s,
                position: Vector3::from(at(t_s)),
                orientation: None,
                grip: None,
            }
        })
        .collect()
}

/// No sample in two pieces, and pieces in order.
fn apart(found: &Found) {
    assert!(found.ranges.windows(2).all(|w| w[0].end <= w[1].start));
    assert!(found.ranges.iter().all(|r| !r.is_empty()));
}

#[test]
fn circles_have_no_slow_moment_and_are_cut_once_a_turn() {
    let circle = poses(300, |t| [(PI * t).cos(), (PI * t).sin(), 0.0]);
    let found = repetitions(&circle);
    apart(&found);
    assert_eq!(found.method, Method::Returns);
    assert!((found.period_s.unwrap() - 2.0).abs() < 0.03);
    let gaps = found.at_s.windows(2).map(|w| w[1] - w[0]);
    assert!(found.at_s.len() >= 4 && gaps.clone().all(|g| (g - 2.0).abs() < 0.1));
}

#[test]
fn an_eight_repeats_once_round_not_once_a_loop() {
    let eight = poses(360, |t| {
        [0.4 * (PI * t).sin(), 0.2 * (2.0 * PI * t).sin(), 0.0]
    });
    let found = repetitions(&eight);
    assert_eq!(found.method, Method::Returns);
    assert!((found.period_s.unwrap() - 2.0).abs() < 0.05, "{found:?}");
}

/// Out for 0.8 s, a pause, back for 0.8 s, a pause; `round` of them.
fn reach_and_back(t: f64) -> [f64; 3] {
    let smooth = |u: f64| {
        let u = u.clamp(0.0, 1.0);
        u * u * u * (10.0 - 15.0 * u + 6.0 * u * u)
    };
    let u = t % 3.0;
    [
        0.4 * (smooth((u - 0.5) / 0.8) - smooth((u - 2.0) / 0.8)),
        0.0,
        1.0,
    ]
}

#[test]
fn a_reach_a_pause_and_the_way_back_are_one_repetition() {
    let found = repetitions(&poses(360, reach_and_back));
    apart(&found);
    assert_eq!(found.method, Method::Rests);
    assert_eq!(found.ranges.len(), 4, "{found:?}");
    // Back at home from 2.8 s to 3.5 s, and so on.
    for (i, cut) in found.at_s.iter().enumerate() {
        assert!((cut - 3.15 - 3.0 * i as f64).abs() < 0.05, "{cut}");
    }
}

#[test]
fn long_rests_do_not_belong_to_what_is_between() {
    let found = repetitions(&poses(900, |t| {
        let in_turn = t % 10.0;
        if in_turn < 3.0 {
            reach_and_back(in_turn)
        } else {
            reach_and_back(0.0)
        }
    }));
    assert_eq!((found.method, found.ranges.len()), (Method::Rests, 3));
    assert!(
        found.ranges.iter().all(|r| (60..110).contains(&r.len())),
        "{found:?}"
    );
}

#[test]
fn a_hand_that_does_one_thing_or_nothing_is_left_alone() {
    for still in [0.0, 1.0] {
        let once = poses(90, |t| reach_and_back((still * t).min(1.9)));
        let found = repetitions(&once);
        assert_eq!(
            (found.method, found.ranges.as_slice()),
            (Method::Whole, std::slice::from_ref(&(0..90)))
        );
    }
    assert!(repetitions(&[]).ranges.is_empty());
    let one = repetitions(&poses(1, reach_and_back));
    assert_eq!((one.ranges.len(), one.ranges[0].clone()), (1, 0..1));
}
