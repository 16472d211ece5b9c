//! A place and an orientation in ℝ⁴, each within its own bound, whatever the signal does and however it is sampled.

use super::*;
use crate::pose::{exp, nearest, point};
use nalgebra::{SVector, Vector4};

type Pose = SVector<f64, 7>;
const BOUNDS: [f64; 2] = [0.002, 0.01];

fn pose(x: &Vector3<f64>, q: &Vector4<f64>) -> Pose {
    Pose::from_iterator(x.iter().chain(q.iter()).copied())
}

fn parts(pose: &Pose) -> (Vector3<f64>, Vector4<f64>) {
    (
        pose.fixed_rows::<3>(0).into_owned(),
        pose.fixed_rows::<4>(3).into_owned(),
    )
}

/// Knots of `samples`, after they have travelled in blocks; the largest errors of both groups.
fn travelled(samples: &[(Stamp, Pose)], block: usize) -> ([f64; 2], usize) {
    let mut encoder = PathEncoder::with_bounds(3, BOUNDS).unwrap();
    let mut knots = Vec::new();
    for (t, x) in samples {
        knots.extend(encoder.push(*t, *x).unwrap());
    }
    knots.extend(encoder.flush());
    let mut decoder = PathDecoder::new(encoder.grid(), samples.len() + 2);
    let origin = Origin {
        tick: knots[0].tick,
        x: [0; 7],
    };
    for (i, chunk) in knots.chunks(block).enumerate() {
        let before = decoder.before(0).unwrap();
        assert_eq!(before.len(), (i * block).min(CONTEXT));
        let bytes = pack(1_000, &origin, &before, chunk).unwrap();
        for knot in unpack(1_000, &origin, &before, &bytes, block).unwrap() {
            decoder.append(&knot).unwrap();
        }
    }
    let mut worst = [0.0f64; 2];
    for (t, x) in samples {
        let (place, turn) = parts(&(decoder.eval(on_tick(*t)).expect("covered").x - x));
        worst = [worst[0].max(place.norm()), worst[1].max(turn.norm())];
    }
    (worst, knots.len())
}

/// 30 Hz and 1 kHz, jittered, with a pause and a hole.
#[test]
fn an_arm_that_turns_is_held_in_metres_and_radians() {
    for (rate_hz, jitter_ns, most) in [(30.0, 4_000_000, 110), (1000.0, 200_000, 130)] {
        let (mut samples, mut turns) = (Vec::new(), Vec::new());
        let mut before = None;
        for i in 0..(6.0 * rate_hz) as i64 {
            let jitter = (i * 7919 % 101 - 50) * jitter_ns / 50;
            let t = Stamp::from_secs_f64(i as f64 / rate_hz).0 + jitter;
            let s = t as f64 * 1e-9;
            if (3.0..3.6).contains(&s) {
                continue;
            }
            // At rest for a second.
            let phase = if s > 4.0 {
                s.min(4.5) + (s - 5.5).max(0.0)
            } else {
                s
            };
            let x = Vector3::new(libm::sin(3.0 * phase), libm::cos(2.0 * phase), 0.0) * 0.3;
            let q = exp(&(Vector3::new(1.0, 0.2, libm::sin(phase)) * (1.5 * phase)));
            let q = point(&q, before.as_ref());
            before = Some(q);
            samples.push((Stamp(t), pose(&x, &q)));
            turns.push(q);
        }
        let (worst, knots) = travelled(&samples, 2);
        assert!(worst[0] <= BOUNDS[0] && worst[1] <= BOUNDS[1], "{worst:?}");
        assert!(knots <= most, "{knots} knots at {rate_hz} Hz");
        // A curve within e of a unit quaternion is within 2·asin e of the rotation.
        let angle = 2.0 * libm::asin(BOUNDS[1]);
        let mut encoder = PathEncoder::with_bounds(3, BOUNDS).unwrap();
        let mut decoder = PathDecoder::new(encoder.grid(), 1000);
        for (t, x) in &samples {
            if let Some(k) = encoder.push(*t, *x).unwrap() {
                decoder.append(&k).unwrap();
            }
        }
        for ((t, _), q) in samples.iter().zip(&turns) {
            if let Some(jet) = decoder.eval(on_tick(*t)) {
                let found = nearest(&parts(&jet.x).1).unwrap();
                let error = found.angle_to(&nearest(q).unwrap());
                assert!(error <= angle * (1.0 + 1e-9), "{error} rad");
            }
        }
    }
}

/// What the live path costs is known beforehand, also where it runs beside a control loop.
#[test]
fn once_made_neither_end_allocates() {
    let mut encoder = PathEncoder::with_bounds(3, BOUNDS).unwrap();
    let mut decoder = PathDecoder::new(encoder.grid(), 8);
    let samples: Vec<_> = (0..3000_i64)
        .map(|i| {
            let s = i as f64 * 1e-3;
            let q = exp(&(Vector3::new(1.0, 0.2, 0.0) * s));
            let x = Vector3::new(libm::sin(9.0 * s), libm::cos(7.0 * s), s) * 0.3;
            (Stamp(i * 1_000_000), pose(&x, &q.coords))
        })
        .collect();
    let mut knots = 0;
    let touched = allocation_counter::measure(|| {
        for (t, x) in &samples {
            if let Some(knot) = encoder.push(*t, *x).unwrap() {
                decoder.append(&knot).unwrap();
                knots += 1;
            }
            if let Some(frontier) = decoder.frontier() {
                assert!(decoder.eval(frontier).is_some());
            }
        }
    });
    assert!(knots > 8, "{knots}: the decoder has forgotten some");
    assert_eq!(touched.count_total, 0);
}

/// Steps of every kind in every coordinate, at intervals of every kind.
fn wild() -> impl Strategy<Value = Vec<(Stamp, Pose)>> {
    let interval = prop_oneof![
        4 => 15_000_000..50_000_000i64,
        4 => 900_000..1_100_000i64,
        1 => 10_000..20_000i64,
        1 => 300_000_000..900_000_000i64,
    ];
    let step = prop_oneof![
        4 => prop::array::uniform7(-0.01..0.01f64),
        3 => Just([0.0; 7]),
        1 => prop::array::uniform7(-1.0..1.0f64),
    ];
    prop::collection::vec((interval, step), 1..200).prop_map(|steps| {
        let (mut t, mut x) = (Stamp(0), Pose::zeros());
        let walk = steps.into_iter().map(|(dt, dx)| {
            t = Stamp(t.0 + dt);
            x += Pose::from(dx);
            (t, x)
        });
        walk.collect()
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, ..ProptestConfig::default() })]

    #[test]
    fn both_bounds_hold_at_every_sample(samples in wild(), block in 1usize..7) {
        let (worst, _) = travelled(&samples, block);
        prop_assert!(worst[0] <= BOUNDS[0] && worst[1] <= BOUNDS[1], "{:?}", worst);
    }
}
