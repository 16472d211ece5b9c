//! Links as they are written.

use proptest::prelude::*;

use super::*;

#[test]
fn netems_own_examples_are_read() {
    let all = link(
        "delay 100ms 10ms 25% distribution normal loss gemodel 1% 10% 70% 0.1% duplicate 1% 25% \
         corrupt 0.1% reorder 25% 50% gap 5 rate 1mbit 14 limit 500",
    );
    assert_eq!((all.delay_s, all.jitter_s), (0.1, 0.01));
    assert_eq!(all.delay_correlation, Probability::of(0.25));
    assert_eq!(all.distribution, Distribution::Normal);
    let p = Probability::of;
    let loss = Loss::Gemodel {
        p: p(0.01),
        r: p(0.1),
        lost_bad: p(0.7),
        lost_good: p(0.001),
    };
    assert_eq!(all.loss, loss);
    assert_eq!(all.duplicate.correlation, p(0.25));
    assert_eq!((all.reorder.p, all.gap), (p(0.25), 5));
    let rate = Rate {
        overhead: 14,
        ..Rate::bits(1_000_000)
    };
    assert_eq!((all.rate, all.limit), (Some(rate), 500));
    // Synonyms, abbreviations, defaults.
    assert_eq!(link("latency 20ms"), link("del 20msec"));
    assert_eq!(link("drop 1%"), link("loss random 1%"));
    // tc's per cent need no sign; nor does nothing.
    assert_eq!(link("loss 1"), link("loss 1%"));
    let bare = link("loss gemodel 2.5 30 80 0 reorder 25 50 delay 1ms");
    assert_eq!(
        bare,
        link("loss gemodel 2.5% 30% 80% 0% reorder 25% 50% delay 1ms")
    );
    assert_eq!(link("loss gemodel 1%"), link("loss gemodel 1% 99% 100% 0%"));
    assert_eq!(link("loss state 1%"), link("loss state 1% 99% 0% 100% 0%"));
    assert_eq!(link("delay 1ms reorder 5%").gap, 1);
    assert_eq!(link("rate 125kbps"), link("rate 1mbit"));
    assert_eq!(link("delay 0ms"), LinkConfig::default());
}

#[test]
fn what_is_wrong_is_named() {
    for (text, said) in [
        ("", "an empty text is no link"),
        ("delay", "`delay` needs a time"),
        (
            "delay 100",
            "`delay 100`: a time needs its unit (tc alone would read microseconds)",
        ),
        ("delay 100 10ms", "`delay 100`"),
        ("delay 100ms 10", "`delay 10`: a time needs its unit"),
        (
            "delay 10ms 3s",
            "`delay 3s`: the kernel's jitter ends at 2.147s",
        ),
        ("delay -5ms", "`delay -5ms`: not a time"),
        ("delay 2h", "`delay 2h`: not a time"),
        ("dely 5ms", "`dely` is no word of a link: limit, delay"),
        ("delay 5ms delay 6ms", "`delay` is said twice"),
        ("loss 0.01", "`loss 0.01`: is it a fraction, or per cent"),
        ("loss 101", "`loss 101`: not a share"),
        ("loss 101%", "`loss 101%`: not a share"),
        (
            "loss",
            "`loss` needs a share (1%), or random, state or gemodel",
        ),
        (
            "loss bursty",
            "`loss bursty`: a share (1%), or random, state or gemodel",
        ),
        ("loss gemodel", "`loss gemodel` needs a share"),
        ("loss gemodel 1% x", "`x` is no word of a link"),
        (
            "loss state 60% 10% 0% 0% 50%",
            "`loss state` needs p13 + p14",
        ),
        (
            "delay 5ms distribution normal",
            "`distribution` needs a delay with a jitter",
        ),
        (
            "delay 5ms 1ms distribution gauss",
            "`distribution gauss`: one of uniform, normal",
        ),
        ("reorder 5%", "`reorder` needs a delay"),
        ("delay 5ms gap 3", "`gap` needs reorder"),
        ("rate 0", "`rate 0`: not a rate of at least 8bit"),
        ("rate 1mbit 1.5", "`rate 1.5`: not a whole number"),
        ("limit many", "`limit many`: not a whole number"),
        ("slot 20ms 10ms", "`slot 10ms`: is less than the least wait"),
        ("slot 0ms", "a slot that is always there is none"),
        ("slot 5ms packets 0", "`packets 0`: a whole number above 0"),
        (
            "outage 5s",
            "`outage 5s`: from and to since the link began: 5s..7s",
        ),
        ("outage 7s..5s", "`outage 7s..5s`: ends before it begins"),
        ("outage 5..7", "`outage 5`: a time needs its unit"),
        (
            "outage 5s..7s every 1s",
            "`every 1s`: is no longer than the outage itself",
        ),
        ("loss 1% ecn", "`ecn` has no meaning here"),
        (
            "seed 5",
            "`seed` has no meaning here: the seed belongs to a run",
        ),
        ("trace", "`trace` needs a file"),
        ("trace \"a b", "the quotation mark is not closed"),
        (
            "trace nowhere.csv rtt",
            "trace: nowhere.csv: cannot be read",
        ),
    ] {
        let error = text.parse::<LinkConfig>().unwrap_err().to_string();
        assert!(error.contains(said), "{text}: {error}");
    }
}

#[test]
fn flags_are_parsed_or_refused() {
    assert_eq!(parse_duration_s("100ms"), Ok(0.1));
    assert_eq!(parse_duration_s("100"), Ok(0.1));
    assert_eq!(parse_duration_s("1.5 s"), Ok(1.5));
    assert_eq!(parse_duration_s("250us"), Ok(250e-6));
    assert_eq!(parse_probability("1%"), Ok(0.01));
    assert_eq!(parse_probability("0.01"), Ok(0.01));
    assert_eq!(parse_rate_bit_s("64kbit"), Ok(64_000));
    assert_eq!(parse_rate_bit_s("500000"), Ok(500_000));
    for bad in ["", "ms", "-1ms", "nan", "inf s", "1h"] {
        assert!(parse_duration_s(bad).is_err(), "{bad}");
    }
    assert!(parse_probability("101%").is_err());
    assert!(parse_rate_bit_s("0").is_err());
}

#[test]
fn a_link_prints_as_one_would_write_it() {
    for text in [
        "delay 0ms",
        "delay 100ms 10ms loss 1%",
        "delay 1500us 250ns 25% distribution paretonormal",
        "loss gemodel 1% 10% 70% 0.1%",
        "loss 0.1234568%",
        "delay 20ms duplicate 1% 25% corrupt 0.1% reorder 25% 50% gap 5",
        "rate 64kbit",
        "rate 5kbit 20 100 5",
        "rate 1500500bit 0 48",
        "slot 800us 1ms packets 32 bytes 4000",
        "slot distribution normal 20ms 2ms",
        "delay 1s outage 5s..7s outage 1ms..2ms every 1s limit 10",
    ] {
        assert_eq!(link(text).to_string(), text);
    }
    let json = serde_json::to_string(&link("delay 20ms loss 1%")).unwrap();
    assert_eq!(json, "\"delay 20ms loss 1%\"");
    assert_eq!(
        serde_json::from_str::<LinkConfig>(&json).unwrap(),
        link("delay 20ms loss 1%")
    );
    let error = serde_json::from_str::<LinkConfig>("\"delay 20\"").unwrap_err();
    assert!(error.to_string().contains("needs its unit"), "{error}");
}

fn seconds(up_to_ns: i64) -> impl Strategy<Value = f64> {
    (0..=up_to_ns).prop_map(|ns| ns as f64 / 1e9)
}

fn probability() -> impl Strategy<Value = Probability> {
    any::<u32>().prop_map(Probability)
}

fn chance() -> impl Strategy<Value = Chance> {
    (probability(), probability()).prop_map(|(p, correlation)| Chance { p, correlation })
}

fn loss() -> impl Strategy<Value = Loss> {
    let half = || (0..u32::MAX / 2).prop_map(Probability);
    prop_oneof![
        chance().prop_map(Loss::Random),
        (half(), half(), half(), probability(), half()).prop_map(|(p13, p31, p32, p23, p14)| {
            Loss::State {
                p13,
                p31,
                p32,
                p23,
                p14,
            }
        }),
        (probability(), probability(), probability(), probability()).prop_map(
            |(p, r, lost_bad, lost_good)| Loss::Gemodel {
                p,
                r,
                lost_bad,
                lost_good
            }
        ),
    ]
}

fn distribution() -> impl Strategy<Value = Distribution> {
    (0..4usize).prop_map(|i| Distribution::ALL[i])
}

fn rate() -> impl Strategy<Value = Rate> {
    // Up to where a double still counts single bits.
    (
        8..=1_000_000_000_000_000u64,
        any::<i32>(),
        any::<u32>(),
        any::<i32>(),
    )
        .prop_map(|(bit_s, overhead, cell, cell_overhead)| Rate {
            bit_s,
            overhead,
            cell,
            cell_overhead,
        })
}

fn slot() -> impl Strategy<Value = Slot> {
    let many = || prop::option::of(1..i32::MAX as u32);
    let wait = prop_oneof![
        (seconds(1_000_000_000), 1..1_000_000_000i64).prop_map(|(min_s, more)| {
            let max_s = ((min_s * 1e9).round() as i64 + more) as f64 / 1e9;
            SlotWait::Between { min_s, max_s }
        }),
        (
            distribution(),
            seconds(2_000_000_000),
            1..=i64::from(i32::MAX)
        )
            .prop_map(|(distribution, delay_s, ns)| SlotWait::Around {
                distribution,
                delay_s,
                jitter_s: ns as f64 / 1e9
            }),
    ];
    (wait, many(), many()).prop_map(|(wait, packets, bytes)| Slot {
        wait,
        packets,
        bytes,
    })
}

fn outage() -> impl Strategy<Value = Outage> {
    let ns = 1..1_000_000_000_000i64;
    let s = |ns: i64| ns as f64 / 1e9;
    (ns.clone(), ns.clone(), prop::option::of(ns)).prop_map(move |(from, long, pause)| Outage {
        from_s: s(from),
        to_s: s(from + long),
        every_s: pause.map(|pause| s(long + pause)),
    })
}

proptest! {
    #[test]
    fn what_is_printed_is_read_again(
        (delay_s, jitter_s) in (seconds(3_600_000_000_000), seconds(i32::MAX.into())),
        (delay_correlation, shape) in (probability(), distribution()),
        (loss, duplicate, corrupt, reorder) in (loss(), chance(), chance(), chance()),
        gap in 1..=u32::MAX,
        rate in prop::option::of(rate()),
        limit in 0..=u32::MAX,
        slot in prop::option::of(slot()),
        outages in prop::collection::vec(outage(), 0..4),
    ) {
        let spreads = jitter_s > 0.0;
        let overtakes = reorder.p > Probability::NEVER && delay_s > 0.0;
        let config = LinkConfig {
            delay_s,
            jitter_s,
            delay_correlation: if spreads { delay_correlation } else { Probability::NEVER },
            distribution: if spreads { shape } else { Distribution::Uniform },
            loss,
            duplicate,
            corrupt,
            reorder: if overtakes { reorder } else { Chance::NEVER },
            gap: if overtakes { gap } else { 0 },
            rate,
            limit: limit as usize,
            slot,
            outages,
            trace: None,
        };
        let text = config.to_string();
        let read = text.parse::<LinkConfig>();
        prop_assert_eq!(read.as_ref(), Ok(&config), "{}", text);
    }

    #[test]
    fn no_text_makes_the_reader_panic(text in "\\PC{0,60}") {
        let _ = text.parse::<LinkConfig>();
    }

    #[test]
    fn no_sequence_of_options_makes_the_reader_panic(
        words in prop::collection::vec("(delay|loss|rate|slot|reorder|gap|state|gemodel|outage|every|1%|5ms|1s..2s|7|-3|1mbit)", 0..12)
    ) {
        let _ = words.join(" ").parse::<LinkConfig>();
    }

    #[test]
    fn nothing_arrives_before_it_was_sent(
        loss in loss(),
        rate in prop::option::of(rate()),
        slot in prop::option::of(slot()),
        (delay_s, jitter_s, shape) in (seconds(1_000_000_000), seconds(i32::MAX.into()), distribution()),
        duplicate in chance(),
        sends in prop::collection::vec((0..50_000_000i64, 0..3000usize), 1..60),
        seed in any::<u64>(),
    ) {
        let config = LinkConfig { delay_s, jitter_s, distribution: shape, loss, duplicate, rate, slot, ..LinkConfig::default() };
        let mut link = Link::new(config, seed);
        let mut now_ns = 0;
        for (gap, len) in sends {
            now_ns += gap;
            for d in link.send(now_ns, len).deliveries() {
                prop_assert!(d.at_ns >= now_ns);
            }
        }
    }
}
