//! A resting hand: what it has been seen to do, and what may be made of it.

use super::*;
use telemime_protocol::predict::BAND_KNOTS;

/// The weights of the mixture, 15 for all of it.
type Trust = [u8; BAND_KNOTS.len()];

/// In the request of a hand that was watched at rest for so many samples, 33 ms apart; and in what is said while it rests on for two
/// seconds, with how long after the request each is valid, s.
fn trust(watched: usize) -> (Trust, Vec<(f64, Trust)>) {
    let config = SessionConfig {
        max_silence_s: 0.05,
        ..SessionConfig::default()
    };
    let mut bench = Bench::ready(config, Some(example(2, 24)));
    for _ in 0..watched {
        bench.sample(home());
    }
    let engaged = bench.now;
    bench.session.engage(engaged);
    bench.drain();
    let [OperatorControl::Engage(engage)] = &bench.control[..] else {
        panic!("{:?}", bench.control)
    };
    let Drive::Mirror { params, .. } = &engage.drive else {
        panic!("{:?}", engage.drive)
    };
    let asked = params.weights.map(|w| w[0]);
    bench.hears(&granted(1));
    for _ in 0..60 {
        bench.sample(home());
    }
    let since_s = |t_us: i64| Stamp(t_us * 1000).secs_since(engaged);
    let said = bench.motions();
    let said = said
        .iter()
        .map(|m| (since_s(m.state.t_us), m.params.weights.map(|w| w[0])));
    (asked, said.collect())
}

#[test]
fn a_hand_seen_to_rest_begins_nothing_and_one_not_seen_before_may_be_about_to() {
    let (asked, said) = trust(1);
    assert!(asked.iter().all(|w| *w > 7), "nothing is known: {asked:?}");
    assert!(said.len() > 20, "{}", said.len());
    for (since_s, weights) in &said {
        let most = match since_s {
            s if *s > 1.0 => 0,
            _ => 15,
        };
        assert!(
            weights.iter().all(|w| *w <= most),
            "{since_s} s: {weights:?}"
        );
    }
    let (asked, said) = trust(32);
    assert!(
        asked.iter().all(|w| *w == 0),
        "seen for a second: {asked:?}"
    );
    for (since_s, weights) in &said {
        assert!(weights.iter().all(|w| *w == 0), "{since_s} s: {weights:?}");
    }
    assert_eq!(trust(70).0, [0; 3], "seen for more than two");
}
