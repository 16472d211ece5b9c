//! What is drawn: delays, losses, duplicates, damage, reordering.

use super::*;

const N: i64 = 100_000;

#[test]
fn a_perfect_wire_delivers_at_once() {
    for (i, fate) in run("delay 0ms", 1, 100, MS, 1500).iter().enumerate() {
        assert_eq!(*fate, Fate::whole(i as i64 * MS));
    }
}

#[test]
fn jitter_has_the_moments_of_its_distribution_and_reorders() {
    // In units of σ. Uniform: 1/√3. Normal: table. Pareto and the mixture are cut at four (see `table`); the mixture
    // takes both at the same quantile, which makes it comonotonic: its spread is that of its table.
    let (cut, spread) = (-0.03292, 0.82087);
    for (shape, mean, deviation) in [
        ("uniform", 0.0, 3f64.sqrt().recip()),
        ("normal", 0.0, 1.0),
        ("pareto", cut, spread),
        ("paretonormal", 0.75 * cut, 0.8339),
    ] {
        let text = format!("delay 100ms 10ms distribution {shape}");
        let fates = run(&text, 7, N, MS, 100);
        let (m, sd, rho) = moments(&delays_s(&fates, MS));
        // Four standard errors of a mean; the deviation's depends on the tails.
        let tolerance = 4.0 * 0.01 / (N as f64).sqrt();
        assert!((m - (0.1 + 0.01 * mean)).abs() < tolerance, "{shape}: {m}");
        assert!(
            (sd / (0.01 * deviation) - 1.0).abs() < 0.02,
            "{shape}: {sd}"
        );
        assert!(rho.abs() < 0.013, "{shape}: {rho}");
        let arrivals: Vec<_> = fates.iter().filter_map(Fate::arrival_ns).collect();
        assert!(arrivals.windows(2).any(|w| w[1] < w[0]), "{shape}");
    }
}

#[test]
fn uniform_jitter_stays_within_its_width() {
    let d = delays_s(&run("delay 100ms 10ms", 7, N, MS, 100), MS);
    assert!(d.iter().all(|x| (0.09..0.11).contains(x)));
    assert!(d.iter().any(|&x| x < 0.0902) && d.iter().any(|&x| x > 0.1098));
}

#[test]
fn correlated_delays_are_netems() {
    // The kernel takes the correlated draw modulo 2σ (or the table's size), which leaves next to nothing of the
    // correlation as long as 2σ is far below 2³² ns: netem is like that, and so are we.
    let (_, sd, rho) = moments(&delays_s(&run("delay 100ms 10ms 50%", 5, N, MS, 100), MS));
    assert!(rho.abs() < 0.013, "{rho}");
    assert!((sd * 3f64.sqrt() / 0.01 - 1.0).abs() < 0.02, "{sd}");
    // With 2σ ≈ 2³² it is all there: an autoregression with (1−ρ)/(1+ρ) of the uniform variance.
    let wide = run("delay 3s 2147483647ns 50%", 5, N, 10_000 * MS, 100);
    let (mean, sd, rho) = moments(&delays_s(&wide, 10_000 * MS));
    assert!((rho - 0.5).abs() < 0.013, "{rho}");
    assert!((sd / (2.147_483_647 / 3.0) - 1.0).abs() < 0.02, "{sd}");
    assert!((mean - 3.0).abs() < 0.02, "{mean}");
}

#[test]
fn the_delay_is_never_negative() {
    let d = delays_s(&run("delay 5ms 20ms", 3, 10_000, MS, 100), MS);
    assert!(d.iter().all(|x| *x >= 0.0));
    // A quarter of ±20 ms about 5 ms is above 15, three eighths below 0.
    let at_once = d.iter().filter(|x| **x == 0.0).count() as f64 / d.len() as f64;
    assert!((at_once - 0.375).abs() < 0.02, "{at_once}");
}

#[test]
fn independent_loss_has_its_rate_and_leaves_the_others_as_they_were() {
    let lossy = run("delay 100ms 10ms loss 5%", 3, N, MS, 100);
    let clean = run("delay 100ms 10ms", 3, N, MS, 100);
    let lost = share(&lossy, |f| f.packet == Outcome::Lost);
    assert!(
        (lost - 0.05).abs() < 4.0 * (0.05 * 0.95 / N as f64).sqrt(),
        "{lost}"
    );
    let pairs = lossy.iter().zip(&clean);
    assert!(
        pairs
            .clone()
            .all(|(x, y)| x.packet == Outcome::Lost || x == y)
    );
}

/// Share of losses, and how many are lost on end on average.
fn bursts(text: &str) -> (f64, f64) {
    let lost: Vec<bool> = run(text, 11, 4 * N, MS, 100)
        .iter()
        .map(|f| f.packet == Outcome::Lost)
        .collect();
    let all = lost.iter().filter(|l| **l).count() as f64;
    let begun = lost.windows(2).filter(|w| !w[0] && w[1]).count() as f64;
    (all / lost.len() as f64, all / begun)
}

#[test]
fn gilbert_elliott_loses_its_share_in_bursts_of_its_length() {
    // Simple Gilbert: share p/(p+r), bursts of 1/r.
    let text = "loss gemodel 1% 10%";
    let (share, length) = bursts(text);
    assert!((share / (0.01 / 0.11) - 1.0).abs() < 0.05, "{share}");
    assert!((length - 10.0).abs() < 0.5, "{length}");
    // All four: (r(1−k) + p(1−h))/(p+r).
    let full = "loss gemodel 1% 10% 70% 0.1%";
    let expected = (0.1 * 0.001 + 0.01 * 0.7) / 0.11;
    let (share, length) = bursts(full);
    assert!((share / expected - 1.0).abs() < 0.05, "{share} {expected}");
    // A loss in the bad state is followed by one if the state stays (0.9 · 0.7, but for the good state's share).
    let stays = 0.9 * 0.7;
    assert!(
        (length / (1.0 / (1.0 - stays)) - 1.0).abs() < 0.06,
        "{length}"
    );
    for (text, share) in [(text, 0.01 / 0.11), (full, expected)] {
        assert!((link(text).loss.share().unwrap() - share).abs() < 1e-8);
    }
    // p alone is a Bernoulli process: r = 1 − p.
    let (share, length) = bursts("loss gemodel 5%");
    assert!((share - 0.05).abs() < 0.002 && (length - 1.0 / 0.95).abs() < 0.01);
}

#[test]
fn four_states_lose_their_stationary_share() {
    // p13, p31, p32, p23, p14.
    let text = "loss state 1% 20% 10% 40% 0.5%";
    let (one, three) = (0.2 * 0.4, 0.01 * 0.4);
    let (two, four) = (0.01 * 0.1, 0.005 * one);
    let expected = (three + four) / (one + two + three + four);
    let (share, length) = bursts(text);
    assert!((share / expected - 1.0).abs() < 0.05, "{share} {expected}");
    // Runs: of 3s, left with p31 + p32; of 4s, one packet each.
    let (of_three, of_four) = (three * 0.3, four);
    let mean = (three + four) / (of_three + of_four);
    assert!((length / mean - 1.0).abs() < 0.05, "{length} {mean}");
    assert!((link(text).loss.share().unwrap() - expected).abs() < 1e-8);
    // p13 alone is a Bernoulli process.
    let (share, _) = bursts("loss state 3%");
    assert!((share - 0.03).abs() < 0.002, "{share}");
}

#[test]
fn correlated_loss_at_one_half_stays_one_half_and_clusters() {
    // The draws are symmetric about ½, so a half is still lost; runs get longer.
    let (share, length) = bursts("loss 50% 50%");
    assert!((share - 0.5).abs() < 0.01, "{share}");
    assert!(length > 2.5, "{length}");
    // At small shares netem's correlation loses far less than it is told to: the draws keep to the middle.
    let (share, _) = bursts("loss 5% 50%");
    assert!(share < 0.02, "{share}");
    assert_eq!(link("loss 5% 50%").loss.share(), None);
}

#[test]
fn duplicates_come_at_their_share_and_are_not_doubled() {
    let fates = run("delay 10ms 1ms duplicate 10%", 13, N, MS, 100);
    let doubled = share(&fates, |f| f.duplicate.is_some());
    assert!((doubled - 0.1).abs() < 0.004, "{doubled}");
    // A copy has a delay of its own.
    assert!(fates.iter().any(|f| {
        let at: Vec<_> = f.deliveries().map(|d| d.at_ns).collect();
        at.len() == 2 && at[0] != at[1]
    }));
    // Doubled and lost is sent once; a copy may be lost by itself.
    let fates = run("delay 10ms duplicate 100% loss 20%", 17, N, MS, 100);
    let once = share(&fates, |f| f.duplicate.is_none());
    assert!((once - 0.2).abs() < 0.006, "{once}");
    assert!(fates.iter().all(|f| f.packet != Outcome::Lost));
    let copy_lost = share(&fates, |f| f.duplicate == Some(Outcome::Lost));
    assert!((copy_lost - 0.8 * 0.2).abs() < 0.006, "{copy_lost}");
}

#[test]
fn one_bit_of_one_byte_is_flipped_anywhere() {
    let fates = run("corrupt 5%", 19, N, MS, 100);
    let damaged: Vec<Damage> = fates
        .iter()
        .flat_map(Fate::deliveries)
        .filter_map(|d| d.damage)
        .collect();
    let share = damaged.len() as f64 / N as f64;
    assert!((share - 0.05).abs() < 0.003, "{share}");
    let mut bits = [[0u32; 8]; 100];
    for d in &damaged {
        assert_eq!(d.mask.count_ones(), 1);
        bits[d.byte][d.mask.trailing_zeros() as usize] += 1;
    }
    // About 50 a byte.
    assert!(
        bits.iter()
            .all(|b| (15..100).contains(&b.iter().sum::<u32>()))
    );

    let mut payload = [0u8; 72];
    for d in &damaged {
        let struck = d.strike(&mut payload, 28);
        assert_eq!(struck, d.byte >= 28);
        assert_eq!(
            payload.iter().map(|b| b.count_ones()).sum::<u32>(),
            u32::from(struck)
        );
        payload = [0; 72];
    }
}

#[test]
fn reordering_sends_its_share_at_once() {
    let at_once = |f: &Fate| matches!(f.packet, Outcome::Deliver(d) if d.at_once);
    let fates = run("delay 10ms reorder 25%", 23, N, MS, 100);
    let early = share(&fates, at_once);
    assert!((early - 0.25).abs() < 0.006, "{early}");
    for (i, fate) in fates.iter().enumerate() {
        let delay = if at_once(fate) { 0 } else { 10 };
        assert_eq!(fate.arrival_ns(), Some((i as i64 + delay) * MS));
    }
    // With a gap of g, g − 1 wait, then each goes with probability p: one of g − 1 + 1/p.
    let fates = run("delay 10ms reorder 25% gap 5", 23, N, MS, 100);
    let early = share(&fates, at_once);
    assert!((early - 1.0 / (4.0 + 4.0)).abs() < 0.004, "{early}");
    // At 100 % it is every fifth.
    let fates = run("delay 10ms reorder 100% gap 5", 23, 1000, MS, 100);
    for (i, fate) in fates.iter().enumerate() {
        assert_eq!(at_once(fate), i % 5 == 4, "packet {i}");
    }
}

#[test]
fn same_seed_same_packets() {
    let text = "delay 50ms 20ms 25% distribution pareto loss gemodel 2% 10% duplicate 3% corrupt 1% reorder 5% gap 3";
    assert_eq!(run(text, 9, 5000, MS, 64), run(text, 9, 5000, MS, 64));
    assert_ne!(run(text, 9, 5000, MS, 64), run(text, 10, 5000, MS, 64));
}
