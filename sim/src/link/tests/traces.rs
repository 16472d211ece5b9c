//! Recorded links.

use std::io::Write;

use tempfile::NamedTempFile;

use super::*;

fn file(text: &str) -> NamedTempFile {
    let mut file = NamedTempFile::new().unwrap();
    file.write_all(text.as_bytes()).unwrap();
    file
}

fn traced(text: &str, words: &str) -> Result<Link, String> {
    let file = file(text);
    let config = format!("trace {} {words}", file.path().display()).parse::<LinkConfig>();
    let name = file.path().display().to_string();
    config
        .map(|config| Link::new(config, 1))
        .map_err(|e| e.to_string().replace(&name, "FILE"))
}

#[test]
fn delays_are_taken_packet_by_packet_and_loop() {
    let mut link = traced("# a comment\n10\n20.5\n\n30\n", "delays").unwrap();
    let at: Vec<_> = (0..5).map(|_| link.send(0, 100).arrival_ns()).collect();
    let expected = [10.0, 20.5, 30.0, 10.0, 20.5].map(|ms: f64| Some((ms * 1e6) as i64));
    assert_eq!(at, expected);
    // Of a round trip each direction takes half; what is said beside the trace comes on top.
    let mut link = traced("10\n", "rtt delay 1ms").unwrap();
    assert_eq!(link.send(0, 100), Fate::whole(6 * MS));
}

#[test]
fn a_series_holds_until_its_next_row_and_loops() {
    let text = "t_s,delay_ms,loss,rate_kbit\n10,100,0,1000\n11,50,1,1000\n12,20,0,8\n";
    let mut link = traced(text, "").unwrap();
    // 125 B: 1 ms at 1 Mbit/s, 125 ms at 8 kbit/s. The last row lasts as long as the one before it.
    for (t_s, arrives_ms) in [
        (0.0, Some(101)),
        (0.9, Some(1001)),
        (1.5, None),
        (2.5, Some(2645)),
        (3.0, Some(3101)),
        (4.5, None),
        (5.0, Some(5145)),
    ] {
        let fate = link.send((t_s * 1e9) as i64, 125);
        assert_eq!(fate.arrival_ns(), arrives_ms.map(|ms| ms * MS), "{t_s} s");
    }
    let mut delays = traced("t_s,delay_ms\n0,10\n1,20\n", "series").unwrap();
    assert_eq!(delays.send(0, 100), Fate::whole(10 * MS));
}

#[test]
fn starlinks_columns_are_told_apart() {
    let text = "8,80,40,60,0.0,1.0,0\n16,160,50,70,0.0,0.0,100\n";
    let at = |words| traced(text, words).unwrap().send(0, 1000).arrival_ns();
    // 1000 B at 8 Mbit/s take 1 ms.
    assert_eq!(at("starlink-up"), Some(41 * MS));
    assert_eq!(at("starlink-down"), None);
}

#[test]
fn mahimahi_delivers_at_its_opportunities() {
    // 1500 B at 5, 5, 7 and 10 ms, and again from 10 ms on.
    let schedule = "5\n5\n7\n10\n";
    let mut link = traced(schedule, "mahimahi").unwrap();
    let mut at = |now_ms: i64, len| link.send(now_ms * MS, len).arrival_ns().unwrap() / MS;
    // What is left of an opportunity goes to the next in the queue.
    assert_eq!([at(0, 1000), at(0, 1000), at(0, 1000)], [5, 5, 5]);
    // 4500 B take 7, 10 and 15.
    assert_eq!(at(6, 4500), 15);
    assert_eq!(
        [at(15, 1500), at(15, 100), at(31, 1), at(40, 1500)],
        [15, 17, 35, 40]
    );
    // Long idle, and an end that is also a beginning.
    assert_eq!([at(10_000, 10), at(10_001, 10)], [10_000, 10_005]);
    let mut link = traced("0\n10\n", "mahimahi").unwrap().beginning_at(0);
    let at: Vec<_> = (0..3)
        .map(|_| link.send(10 * MS, 1500).arrival_ns())
        .collect();
    assert_eq!(at, [10, 10, 20].map(|ms| Some(ms * MS)));
}

#[test]
fn a_beginning_that_is_set_anew_is_where_outages_and_traces_count_from() {
    // A second of handshake, then: it begins at 3 s.
    let begun = |mut link: Link| {
        link.send(500 * MS, 100);
        link.begin_at(3000 * MS);
        link
    };
    let series = "t_s,delay_ms\n0,10\n1,20\n2,30\n";
    let mut link = begun(traced(series, "outage 1.5s..2s").unwrap());
    // Before it, the trace's end; then from its beginning, with the outage.
    for (t_ms, late_ms) in [
        (2500, Some(30)),
        (3000, Some(10)),
        (4400, Some(20)),
        (4500, None),
        (4999, None),
        (5000, Some(30)),
        (6000, Some(10)),
    ] {
        let arrives = link.send(t_ms * MS, 100).arrival_ns();
        assert_eq!(arrives, late_ms.map(|late| (t_ms + late) * MS), "{t_ms} ms");
    }
    let mut link = begun(traced("4\n7\n", "mahimahi").unwrap());
    let at: Vec<_> = [2990, 3000, 3005, 3008]
        .map(|t_ms| link.send(t_ms * MS, 1500).arrival_ns().unwrap() / MS)
        .into();
    // The end of a round is the beginning of the next.
    assert_eq!(at, [2990, 3000, 3007, 3011]);
    let mut link = begun(traced("5\n6\n7\n", "delays").unwrap());
    assert_eq!(link.send(3000 * MS, 100), Fate::whole(3005 * MS));
}

#[test]
fn a_saturated_schedule_carries_all_its_opportunities() {
    let schedule: String = (1..=100).map(|ms| format!("{}\n", ms * ms / 10)).collect();
    let mut link = traced(&schedule, "mahimahi limit 100000").unwrap();
    let last = (0..1000)
        .map(|_| link.send(0, 1500).arrival_ns().unwrap())
        .last();
    assert_eq!(last, Some(10 * 1000 * MS));
}

#[test]
fn bad_traces_are_refused_by_name_and_line() {
    for (text, words, said) in [
        ("", "delays", "FILE: holds no values"),
        (
            "1\n2\n",
            "",
            "FILE: say which format it has: delays, rtt, series",
        ),
        ("1\nx\n", "delays", "FILE:2: `x` is not a delay"),
        ("1\n-2\n", "rtt", "FILE:2: `-2` is not a delay"),
        ("1\nnan\n", "rtt", "FILE:2: `nan` is not a delay"),
        (
            "1\n2.5\n",
            "mahimahi",
            "FILE:2: `2.5` is not a whole number of milliseconds",
        ),
        (
            "5\n4\n",
            "mahimahi",
            "FILE:2: 4 ms comes before the line above it",
        ),
        (
            "0\n0\n",
            "mahimahi",
            "FILE:2: the last opportunity must be later than 0 ms",
        ),
        (
            "t_s\n1\n",
            "",
            "FILE:1: a series has t_s and at least one of",
        ),
        (
            "t_s,lag\n1,2\n",
            "",
            "FILE:1: `lag` is no column of a series",
        ),
        (
            "delay_ms,loss\n1,0\n",
            "series",
            "FILE:1: a series needs a column t_s",
        ),
        ("t_s,loss\n", "", "FILE: holds no values"),
        ("t_s,loss\n0,2\n", "", "FILE:2: loss 2 is outside 0 to 1"),
        (
            "t_s,loss\n0,0\n0,0\n",
            "",
            "FILE:3: its time is not after that of the line above",
        ),
        (
            "t_s,rate_kbit\n0,0\n",
            "",
            "FILE:2: a rate of nothing: say loss 1 instead",
        ),
        ("t_s,loss\n0,0,0\n", "", "FILE:2: 3 values where 2 belong"),
        (
            "1,2,3,4,0,0\n",
            "starlink-up",
            "FILE:1: 6 values where 7 belong",
        ),
        (
            "1\n",
            "mahimahi rate 1mbit",
            "`rate` needs a trace without a bottleneck",
        ),
        ("\u{fd}", "delays", "is not a delay"),
    ] {
        let error = traced(text, words).unwrap_err();
        assert!(error.contains(said), "{text:?} {words}: {error}");
    }
    let mut packed = NamedTempFile::new().unwrap();
    packed.write_all(b"\xfd7zXZ\0rest").unwrap();
    let error = Trace::open(packed.path(), None).unwrap_err().to_string();
    assert!(
        error.contains("is xz-compressed: unpack it first"),
        "{error}"
    );
    let mut binary = NamedTempFile::new().unwrap();
    binary.write_all(b"1\n2\n\xff\n").unwrap();
    let error = Trace::open(binary.path(), Some(TraceFormat::Delays)).unwrap_err();
    assert!(error.to_string().contains(":3: is not text"), "{error}");
}

#[test]
fn a_traces_path_may_hold_spaces_and_is_seen_from_its_plan() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("my trip.txt"), "7\n").unwrap();
    let text = "delay 1ms trace \"my trip.txt\" delays limit 9";
    let config = LinkConfig::parse_in(text, folder.path()).unwrap();
    assert_eq!(config.to_string(), text);
    assert_eq!(Link::new(config, 1).send(0, 10), Fate::whole(8 * MS));
}
