use super::*;
use nalgebra::Vector3;
use proptest::prelude::*;

mod pose;

/// Encodes, decodes every knot, and returns the decoder with the knots.
fn run(bound_m: f64, samples: &[(Stamp, Vector3<f64>)]) -> (PathDecoder, Vec<PathKnot>) {
    let mut encoder = PathEncoder::new(bound_m).unwrap();
    let mut decoder = PathDecoder::new(encoder.grid(), samples.len() + 2);
    let mut knots = Vec::new();
    for (t, x) in samples {
        if let Some(k) = encoder.push(*t, *x).unwrap() {
            decoder.append(&k).unwrap();
            knots.push(k);
        }
    }
    if let Some(k) = encoder.flush() {
        decoder.append(&k).unwrap();
        knots.push(k);
    }
    assert_eq!(encoder.flush(), None);
    (decoder, knots)
}

fn on_tick(t: Stamp) -> Stamp {
    Stamp(tick_of(t) * TICK_NS)
}

fn worst(decoder: &PathDecoder, samples: &[(Stamp, Vector3<f64>)]) -> f64 {
    samples
        .iter()
        .map(|(t, x)| (decoder.eval(on_tick(*t)).expect("covered").x - x).norm())
        .fold(0.0, f64::max)
}

fn swing(rate_hz: f64, duration_s: f64) -> Vec<(Stamp, Vector3<f64>)> {
    (0..(rate_hz * duration_s) as i64)
        .map(|i| {
            let t = i as f64 / rate_hz;
            let w = 5.0 * t;
            let x = Vector3::new(
                0.4 * libm::sin(w),
                0.2 * libm::cos(w),
                0.1 * libm::sin(2.0 * w),
            );
            (Stamp::from_secs_f64(t), x)
        })
        .collect()
}

#[test]
fn a_smooth_swing_needs_few_knots() {
    for (bound_m, most) in [(0.005, 46), (0.02, 36)] {
        let samples = swing(100.0, 10.0);
        let (decoder, knots) = run(bound_m, &samples);
        assert!(worst(&decoder, &samples) <= bound_m);
        assert!(knots.len() <= most, "{} knots at {bound_m} m", knots.len());
    }
}

#[test]
fn a_hole_is_a_hole() {
    let mut samples = swing(50.0, 4.0);
    samples.retain(|(t, _)| !(1.0..2.0).contains(&t.as_secs_f64()));
    // Alone between two holes.
    samples.retain(|(t, _)| t.as_secs_f64() < 2.5 || t.as_secs_f64() > 3.5);
    samples.push((Stamp::from_secs_f64(5.0), Vector3::repeat(0.1)));
    samples.push((Stamp::from_secs_f64(6.0), Vector3::repeat(0.1)));
    let (decoder, knots) = run(0.01, &samples);
    assert!(worst(&decoder, &samples) <= 0.01);
    assert_eq!(knots.iter().filter(|k| k.start).count(), 5);
    for t_s in [1.5, 3.0, 4.5, 5.5] {
        assert_eq!(decoder.eval(Stamp::from_secs_f64(t_s)), None);
    }
    assert_eq!(decoder.eval(Stamp(-1)), None);
    assert_eq!(decoder.eval(Stamp::from_secs_f64(6.1)), None);
}

#[test]
fn the_past_never_changes_and_memory_is_bounded() {
    let samples = swing(100.0, 20.0);
    let (all, knots) = run(0.005, &samples);
    let mut decoder = PathDecoder::new(PathGrid::for_bound(0.005).unwrap(), 8);
    let probe = Stamp(knots[2].tick * TICK_NS + 7);
    let mut seen = None;
    for k in &knots {
        decoder.append(k).unwrap();
        assert!(decoder.knots().len() <= 8);
        if let Some(jet) = decoder.eval(probe) {
            assert_eq!(*seen.get_or_insert(jet), jet);
        }
    }
    assert_eq!(seen, all.eval(probe));
    assert_eq!(decoder.eval(probe), None);
    assert_eq!(decoder.frontier(), all.frontier());
}

#[test]
fn what_cannot_be_is_refused_and_the_path_goes_on() {
    let mut e = PathEncoder::new(0.01).unwrap();
    let o = Vector3::zeros();
    e.push(Stamp(0), o).unwrap();
    assert_eq!(
        e.push(Stamp(4_000), o),
        Err(PathError::Unordered { tick: 0, newest: 0 })
    );
    assert_eq!(
        e.push(Stamp(1 << 30), o * f64::NAN),
        Err(PathError::NonFinite)
    );
    assert_eq!(
        e.push(Stamp(1 << 30), o.add_scalar(1e12)),
        Err(PathError::OutOfRange)
    );
    assert!(e.push(Stamp(20_000_000), o).unwrap().is_some());

    let grid = e.grid();
    let knot = |tick, start| PathKnot {
        tick,
        x: [0; 3],
        v: [0; 3],
        start,
    };
    let mut d = PathDecoder::new(grid, 16);
    assert_eq!(
        d.append(&knot(0, false)),
        Err(PathError::Disconnected { gap_ticks: 0 })
    );
    d.append(&knot(0, true)).unwrap();
    assert_eq!(
        d.append(&knot(100_001, false)),
        Err(PathError::Disconnected { gap_ticks: 100_001 })
    );
    assert!(matches!(
        d.append(&knot(0, false)),
        Err(PathError::Unordered { .. })
    ));
    assert_eq!(d.append(&knot(i64::MAX, true)), Err(PathError::OutOfRange));
    let far = PathKnot {
        x: [i32::MIN, 0, 0],
        ..knot(5, false)
    };
    assert_eq!(d.append(&far), Err(PathError::OutOfRange));
    d.append(&knot(100_000, false)).unwrap();
    assert!(PathEncoder::<3>::new(0.0).is_err());
}

/// The delay of the live path: a knot is due with the first sample it does not reach, and stands at the one before.
#[test]
fn a_knot_is_one_sample_late_and_no_more() {
    for rate_hz in [30.0, 1000.0] {
        let samples = swing(rate_hz, 3.0);
        let mut encoder = PathEncoder::new(0.002).unwrap();
        let mut knots = 0;
        for (i, (t, x)) in samples.iter().enumerate() {
            if let Some(knot) = encoder.push(*t, *x).unwrap() {
                assert_eq!(knot.tick, tick_of(samples[i - 1].0));
                knots += 1;
            }
        }
        assert!(knots > 5, "{rate_hz} Hz");
    }
}

#[test]
fn what_no_block_holds_is_not_packed_and_what_is_none_is_named() {
    let origin = Origin {
        tick: 100,
        x: [0; 3],
    };
    let knot = |tick, v: i32, start| PathKnot {
        tick,
        x: [1; 3],
        v: [v; 3],
        start,
    };
    let packed = |knots: &[PathKnot]| pack(10_000, &origin, &[], knots);
    assert_eq!(packed(&[]), Some(vec![]));
    assert_eq!(packed(&[knot(0, 0, false)]), None, "nothing to join");
    assert_eq!(packed(&[knot(101, 0, true)]), None, "after the origin");
    assert_eq!(packed(&[knot(0, 1, true)]), None, "off the lattice");
    let two = [knot(0, 0, true), knot(1_000, 64, false)];
    assert_eq!(
        packed(&[two[0], knot(1_000, 32, false)]),
        None,
        "off the lattice"
    );
    assert_eq!(packed(&[two[1], two[0]]), None, "backwards");
    let far = knot(1 << 31, 0, false);
    assert_eq!(packed(&[two[0], far]), None, "too far");

    let bytes = packed(&two).unwrap();
    let read = |bytes: &[u8], limit| unpack(10_000, &origin, &[], bytes, limit);
    assert_eq!(read(&bytes, 2), Ok(two.to_vec()));
    assert_eq!(read(&[], 2), Ok(vec![]));
    let many = BlockError::TooMany { count: 2, limit: 1 };
    assert_eq!(read(&bytes, 1), Err(many));
    assert_eq!(
        read(&bytes[..bytes.len() - 1], 2),
        Err(BlockError::Truncated)
    );
    let longer = [&bytes[..], &[0]].concat();
    assert_eq!(read(&longer, 2), Err(BlockError::Trailing));
    // One knot: 1; its ticks, position and tangent: 0 less than the origin's.
    let mut w = super::super::bits::BitWriter::default();
    w.golomb(0, 0);
    w.golomb(1 << 31, 12);
    assert_eq!(
        read(&w.finish(), 2),
        Err(BlockError::OutOfRange { index: 0 })
    );
    // Half an interval early is the interval before, late.
    let mut w = super::super::bits::BitWriter::default();
    w.golomb(0, 0);
    w.golomb(2, 2);
    w.signed(-501, 0);
    (0..3).for_each(|_| w.golomb(0, 5));
    let found = unpack(10_000, &origin, &two[..1], &w.finish(), 2);
    assert_eq!(found, Err(BlockError::NotCanonical { index: 0 }));
}

#[test]
fn extreme_stamps_do_not_overflow() {
    let mut e = PathEncoder::new(0.01).unwrap();
    for ns in [i64::MIN, -1, 0, i64::MAX] {
        let _ = e.push(Stamp(ns), Vector3::zeros());
    }
    let _ = e.flush();
}

/// Random walks, jumps, stillness and jitter, at intervals from one tick to a long hole.
fn signal() -> impl Strategy<Value = Vec<(Stamp, Vector3<f64>)>> {
    let interval = prop_oneof![
        4 => 15_000_000..50_000_000i64,
        2 => 10_000..5_000_000i64,
        1 => 300_000_000..900_000_000i64,
    ];
    let step = prop_oneof![
        4 => prop::array::uniform3(-0.02..0.02f64),
        2 => Just([0.0; 3]),
        1 => prop::array::uniform3(-2.0..2.0f64),
    ];
    prop::collection::vec((interval, step), 1..250).prop_map(|steps| {
        let (mut t, mut x) = (Stamp(-1_000_000_000), Vector3::zeros());
        steps
            .into_iter()
            .map(|(dt, dx)| {
                t = Stamp(t.0 + dt);
                x += Vector3::from(dx);
                (t, x)
            })
            .collect()
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, ..ProptestConfig::default() })]

    #[test]
    fn the_bound_holds_at_every_sample(samples in signal(), bound_m in 1e-4..0.1f64) {
        let (decoder, knots) = run(bound_m, &samples);
        prop_assert!(worst(&decoder, &samples) <= bound_m);
        for pair in knots.windows(2) {
            let gap_s = (pair[1].tick - pair[0].tick) as f64 * TICK_NS as f64 * 1e-9;
            prop_assert!(pair[1].start || gap_s <= MAX_SPAN_S);
        }
    }

    #[test]
    fn quantising_twice_changes_nothing(samples in signal(), bound_m in 1e-4..0.1f64) {
        let (_, knots) = run(bound_m, &samples);
        let grid = PathGrid::for_bound(bound_m).unwrap();
        let mut before = None;
        for k in knots {
            let after = before.replace(k.tick).filter(|_| !k.start);
            let d = grid.dequantise(&k).unwrap();
            prop_assert_eq!(grid.quantise(d.t, &d.x, &d.v, after).unwrap(), k);
        }
    }

    /// Flushing at arbitrary moments closes the path early but never breaks it.
    #[test]
    fn the_bound_survives_flushes(samples in signal(), every in 1usize..20) {
        let mut encoder = PathEncoder::new(0.01).unwrap();
        let mut decoder = PathDecoder::new(encoder.grid(), samples.len() + 2);
        for (i, (t, x)) in samples.iter().enumerate() {
            if let Some(k) = encoder.push(*t, *x).unwrap() {
                decoder.append(&k).unwrap();
            }
            if i % every == 0 {
                if let Some(k) = encoder.flush() {
                    decoder.append(&k).unwrap();
                }
                prop_assert_eq!(decoder.frontier(), Some(on_tick(*t)));
            }
        }
        if let Some(k) = encoder.flush() {
            decoder.append(&k).unwrap();
        }
        prop_assert!(worst(&decoder, &samples) <= 0.01);
    }

    /// Both codecs are near the samples, so they are near each other.
    #[test]
    fn live_and_finished_agree(samples in signal(), bound_m in 1e-3..0.05f64) {
        let (decoder, _) = run(bound_m, &samples);
        let first = samples[0].0;
        let (t, x): (Vec<f64>, Vec<_>) =
            samples.iter().map(|(t, x)| (on_tick(*t).secs_since(on_tick(first)), *x)).unzip();
        prop_assume!(t.len() > 1);
        let mut selector = crate::checkpoint::select::Selector::new();
        let effort = crate::checkpoint::select::Effort::Quick;
        let plan = selector.bounded(&t, &x, bound_m, effort).cloned();
        // Jumps between samples closer than a tick of the plan.
        prop_assume!(plan.is_ok());
        let plan = plan.unwrap();
        let points: Vec<_> = plan.checkpoints().collect();
        prop_assert_eq!(&crate::checkpoint::Plan::quantise(plan.grid(), &points).unwrap(), &plan);
        let curve = plan.spline().unwrap();
        let (start_s, end_s) = curve.span_s();
        for ((stamp, _), t) in samples.iter().zip(&t) {
            let live = decoder.eval(on_tick(*stamp)).unwrap().x;
            let finished = curve.eval(t.clamp(start_s, end_s)).unwrap().x;
            prop_assert!((live - finished).norm() <= 2.0 * bound_m + 1e-9);
        }
    }

    /// Any stretch of a path travels, given the knots before it; what arrives is what was sent, to the bit.
    #[test]
    fn knots_travel_in_blocks(
        samples in signal(),
        bound_m in 1e-4..0.1f64,
        interval_us in prop_oneof![Just(33_333u32), 1..1_000_000u32],
        cuts in prop::collection::vec(1usize..9, 1..8),
    ) {
        let (_, knots) = run(bound_m, &samples);
        let origin = Origin { tick: knots[0].tick + 7, x: [3, -2, 1] };
        let (mut from, mut found) = (0, Vec::new());
        for length in cuts.iter().cycle() {
            let to = (from + length).min(knots.len());
            let bytes = pack(interval_us, &origin, &knots[..from], &knots[from..to]).unwrap();
            prop_assert_eq!(count(&bytes, 9), Ok(to - from));
            // No more than the context counts.
            let before = &found[from.saturating_sub(CONTEXT)..];
            let block = unpack(interval_us, &origin, before, &bytes, 9).unwrap();
            prop_assert_eq!(pack(interval_us, &origin, before, &block).unwrap(), bytes);
            found.extend(block);
            from = to;
            if from == knots.len() {
                break;
            }
        }
        prop_assert_eq!(found, knots);
    }

    /// Whatever arrives is refused, or is what a sender would have sent.
    #[test]
    fn any_bytes_are_knots_or_an_error(
        bytes: Vec<u8>,
        interval_us in 1..1_000_000u32,
        samples in signal(),
        known in 0usize..10,
    ) {
        let (_, knots) = run(0.01, &samples);
        let before = &knots[..known.min(knots.len())];
        let origin = Origin { tick: i64::MIN, x: [i32::MAX; 3] };
        for origin in [origin, Origin { tick: 0, x: [0; 3] }] {
            if let Ok(found) = unpack(interval_us, &origin, before, &bytes, 32) {
                prop_assert!(found.len() <= 32);
                prop_assert_eq!(pack(interval_us, &origin, before, &found).unwrap(), bytes.clone());
            }
        }
    }
}
