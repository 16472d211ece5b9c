//! What is counted: the bottleneck, the queue, slots, outages.

use super::*;

#[test]
fn a_rate_spaces_packets_and_the_queue_overflows() {
    // 1000 B at 80 kbit/s take 100 ms each.
    for (i, fate) in run("rate 80kbit limit 5", 1, 8, 0, 1000).iter().enumerate() {
        let expected = if i < 5 {
            Fate::whole((i as i64 + 1) * 100 * MS)
        } else {
            Fate {
                packet: Outcome::Overflow,
                duplicate: None,
            }
        };
        assert_eq!(*fate, expected, "packet {i}");
    }
    let mut link = Link::new(link("rate 80kbit limit 1"), 1);
    assert_eq!(link.send(0, 1000), Fate::whole(100 * MS));
    assert_eq!(link.send(99 * MS, 1000).packet, Outcome::Overflow);
    assert_eq!(link.send(100 * MS, 1000), Fate::whole(200 * MS));
}

#[test]
fn a_saturated_link_carries_its_rate_and_drops_the_rest() {
    // 2 Mbit/s offered to 1: half is dropped, the queue stands full, and every packet waits 100 × 8 ms.
    let fates = run("rate 1mbit limit 100", 1, 20_000, 4 * MS, 1000);
    let passed = fates.iter().filter(|f| f.arrival_ns().is_some()).count();
    let span_s = 20_000.0 * 0.004;
    let bit_s = passed as f64 * 8000.0 / span_s;
    assert!((bit_s / 1e6 - 1.0).abs() < 0.02, "{bit_s}");
    let tail = fates[10_000..].iter().enumerate();
    for (i, fate) in tail {
        if let Some(at_ns) = fate.arrival_ns() {
            let wait_ms = (at_ns - (10_000 + i as i64) * 4 * MS) as f64 / MS as f64;
            assert!((792.0..=800.0).contains(&wait_ms), "{wait_ms}");
        }
    }
}

#[test]
fn delay_spent_waiting_for_the_bottleneck_counts() {
    // Both 1000 B at once, 50 ms delay, 100 ms of transmission: the second starts when the first has left.
    let fates = run("delay 50ms rate 80kbit", 1, 2, 0, 1000);
    assert_eq!(arrivals_ns(&fates), [Some(150 * MS), Some(250 * MS)]);
    // After a pause it is on its own again.
    let fates = run("delay 50ms rate 80kbit", 1, 2, 1000 * MS, 1000);
    assert_eq!(arrivals_ns(&fates), [Some(150 * MS), Some(1150 * MS)]);
}

#[test]
fn overhead_and_cells_are_paid_for() {
    // The man page's example: 50 B in ATM cells of 48 + 5 take 106 B.
    let time = |text: &str, len| run(text, 1, 1, 0, len)[0].arrival_ns().unwrap();
    assert_eq!(time("rate 8kbit 0 48 5", 50), 106 * MS);
    assert_eq!(time("rate 8kbit 14", 50), 64 * MS);
    assert_eq!(time("rate 8kbit -14", 50), 36 * MS);
    // 5 kbit/s = 625 B/s, 20 B a packet, cells of 100 + 5: 90 + 20 = 110 B are two cells.
    assert_eq!(time("rate 5kbit 20 100 5", 90), 210 * 1000 * MS / 625);
    assert_eq!(time("rate 8kbit -100", 50), 0);
}

#[test]
fn slots_take_what_is_due_together() {
    // A packet a ms, a slot every 20 ms: all leave on slots, and none waits longer than one.
    let fates = run("slot 20ms", 1, 1000, MS, 100);
    let mut leave: Vec<i64> = fates.iter().filter_map(Fate::arrival_ns).collect();
    for (i, at_ns) in leave.iter().enumerate() {
        let wait_ms = at_ns / MS - i as i64;
        assert!((0..=20).contains(&wait_ms), "packet {i} waits {wait_ms} ms");
    }
    leave.dedup();
    assert!((45..=52).contains(&leave.len()), "{}", leave.len());
    // Five a slot carry a quarter of that, and the queue grows.
    let fates = run("slot 20ms packets 5", 1, 400, MS, 100);
    for slot in fates[1..].chunks(5).collect::<Vec<_>>().windows(2) {
        let (a, b) = (
            slot[0][0].arrival_ns().unwrap(),
            slot[1][0].arrival_ns().unwrap(),
        );
        assert_eq!(b - a, 20 * MS);
    }
    // A slot is over with the packet that uses up its bytes.
    let fates = run("slot 20ms bytes 250", 1, 4, 0, 100);
    let at: Vec<_> = arrivals_ns(&fates).into_iter().flatten().collect();
    assert_eq!(at, [0, 0, 0, 20 * MS]);
}

#[test]
fn slots_are_as_far_apart_as_they_are_drawn() {
    let gaps = |text: &str| {
        let mut at: Vec<i64> = run(text, 29, 20_000, 0, 100)
            .iter()
            .filter_map(Fate::arrival_ns)
            .collect();
        at.dedup();
        at.windows(2)
            .map(|w| (w[1] - w[0]) as f64 * 1e-6)
            .collect::<Vec<_>>()
    };
    let (mean, sd, _) = moments(&gaps("slot 10ms 30ms packets 1 limit 100000"));
    assert!(
        (mean - 20.0).abs() < 0.2 && (sd - 20.0 / 12f64.sqrt()).abs() < 0.1,
        "{mean} {sd}"
    );
    let text = "slot distribution normal 20ms 2ms packets 1 limit 100000";
    let (mean, sd, _) = moments(&gaps(text));
    assert!(
        (mean - 20.0).abs() < 0.1 && (sd - 2.0).abs() < 0.05,
        "{mean} {sd}"
    );
}

#[test]
fn nothing_gets_in_during_an_outage() {
    let out = |text: &str| -> Vec<i64> {
        let fates = run(text, 1, 20, 1000 * MS, 100);
        let out = |i: &i64| fates[*i as usize].packet == Outcome::Outage;
        (0..20).filter(out).collect()
    };
    assert_eq!(out("outage 5s..7s"), [5, 6]);
    assert_eq!(out("outage 5s..7s outage 9s..9500ms"), [5, 6, 9]);
    assert_eq!(out("outage 3s..4s every 5s"), [3, 8, 13, 18]);
    // What is on its way arrives; the clock may begin elsewhere.
    let mut late = Link::new(link("delay 100ms outage 1s..2s"), 1).beginning_at(-500 * MS);
    assert_eq!(late.send(499 * MS, 100), Fate::whole(599 * MS));
    assert_eq!(late.send(500 * MS, 100).packet, Outcome::Outage);
}
