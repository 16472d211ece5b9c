use super::*;

const MS: i64 = 1_000_000;

fn run(config: LinkConfig, seed: u64, packets: i64, gap_ns: i64, len: usize) -> Vec<Fate> {
    let mut link = Link::new(config, seed);
    (0..packets).map(|i| link.send(i * gap_ns, len)).collect()
}

fn delays_s(fates: &[Fate], gap_ns: i64) -> Vec<f64> {
    let delay = |(i, fate): (usize, &Fate)| match fate {
        Fate::Deliver { at_ns } => Some((at_ns - i as i64 * gap_ns) as f64 * 1e-9),
        _ => None,
    };
    fates.iter().enumerate().filter_map(delay).collect()
}

#[test]
fn a_perfect_wire_delivers_at_once() {
    let fates = run(LinkConfig::default(), 1, 100, MS, 1500);
    assert!(fates.iter().enumerate().all(|(i, f)| *f
        == Fate::Deliver {
            at_ns: i as i64 * MS
        }));
}

#[test]
fn jitter_is_uniform_and_reorders() {
    let config = LinkConfig {
        delay_s: 0.1,
        jitter_s: 0.01,
        ..LinkConfig::default()
    };
    let fates = run(config, 7, 20_000, MS, 100);
    let d = delays_s(&fates, MS);
    let mean = d.iter().sum::<f64>() / d.len() as f64;
    let var = d.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / d.len() as f64;
    // Standard errors: mean 4e-5 s, variance (0.01²/3) within 1 %.
    assert!((mean - 0.1).abs() < 2e-4, "{mean}");
    assert!((var / (1e-4 / 3.0) - 1.0).abs() < 0.03, "{var}");
    assert!(d.iter().all(|&x| (0.0899999..=0.1100001).contains(&x)));
    let arrivals: Vec<_> = fates
        .iter()
        .filter_map(|f| {
            if let Fate::Deliver { at_ns } = f {
                Some(*at_ns)
            } else {
                None
            }
        })
        .collect();
    assert!(
        arrivals.windows(2).any(|w| w[1] < w[0]),
        "jitter beyond the packet spacing must reorder"
    );
}

#[test]
fn loss_has_its_rate_and_does_not_shift_later_packets() {
    let lossy = LinkConfig {
        delay_s: 0.1,
        jitter_s: 0.01,
        loss: 0.05,
        ..LinkConfig::default()
    };
    let clean = LinkConfig {
        loss: 0.0,
        ..lossy.clone()
    };
    let (a, b) = (
        run(lossy, 3, 40_000, MS, 100),
        run(clean, 3, 40_000, MS, 100),
    );
    let lost = a.iter().filter(|f| **f == Fate::Lost).count() as f64 / 40_000.0;
    assert!((lost - 0.05).abs() < 0.005, "{lost}");
    assert!(a.iter().zip(&b).all(|(x, y)| *x == Fate::Lost || x == y));
}

#[test]
fn a_rate_spaces_packets_and_the_queue_overflows() {
    // 1000 B at 80 kbit/s take 100 ms each.
    let config = LinkConfig {
        rate_bit_s: Some(80e3),
        limit: 5,
        ..LinkConfig::default()
    };
    let fates = run(config, 1, 8, 0, 1000);
    for (i, fate) in fates.iter().enumerate() {
        let expected = if i < 5 {
            Fate::Deliver {
                at_ns: (i as i64 + 1) * 100 * MS,
            }
        } else {
            Fate::Overflow
        };
        assert_eq!(*fate, expected, "packet {i}");
    }
    let mut link = Link::new(
        LinkConfig {
            rate_bit_s: Some(80e3),
            limit: 1,
            ..LinkConfig::default()
        },
        1,
    );
    assert_eq!(link.send(0, 1000), Fate::Deliver { at_ns: 100 * MS });
    assert_eq!(link.send(99 * MS, 1000), Fate::Overflow);
    assert_eq!(link.send(100 * MS, 1000), Fate::Deliver { at_ns: 200 * MS });
}

#[test]
fn same_seed_same_packets() {
    let config = LinkConfig {
        delay_s: 0.05,
        jitter_s: 0.02,
        loss: 0.1,
        ..LinkConfig::default()
    };
    assert_eq!(
        run(config.clone(), 9, 1000, MS, 64),
        run(config.clone(), 9, 1000, MS, 64)
    );
    assert_ne!(
        run(config.clone(), 9, 1000, MS, 64),
        run(config, 10, 1000, MS, 64)
    );
}

#[test]
fn settings_are_parsed_or_refused() {
    assert_eq!(parse_duration_s("100ms"), Ok(0.1));
    assert_eq!(parse_duration_s("1.5 s"), Ok(1.5));
    assert_eq!(parse_duration_s("250us"), Ok(250e-6));
    assert_eq!(parse_probability("1%"), Ok(0.01));
    assert_eq!(parse_rate_bit_s("64kbit"), Ok(64e3));
    for bad in ["", "ms", "-1ms", "nan", "inf s", "1h"] {
        assert!(parse_duration_s(bad).is_err(), "{bad}");
    }
    assert!(parse_probability("101%").is_err());
    assert!(parse_rate_bit_s("0").is_err());
}
