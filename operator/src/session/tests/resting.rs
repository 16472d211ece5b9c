//! A resting hand: what it has been seen to do, and what may be made of it.

use super::*;
use telemime_protocol::predict::BAND_KNOTS;

/// Weights of the mixture in the request of a hand that was watched at rest for so many samples, 33 ms apart, and in what is said
/// while it rests on for two seconds.
fn trust(watched: usize) -> (Vec<u8>, Vec<Vec<u8>>) {
    let config = SessionConfig {
        future_bound: FutureBound::Absolute(0.0),
        max_silence_s: 0.03,
        ..SessionConfig::default()
    };
    let mut bench = Bench::ready(config, Some(example(2, 24)));
    for _ in 0..watched {
        bench.sample(home());
    }
    bench.session.engage(bench.now);
    bench.drain();
    let [OperatorControl::Engage(engage)] = &bench.control[..] else {
        panic!("{:?}", bench.control)
    };
    let Drive::Mirror { params, .. } = &engage.drive else {
        panic!("{:?}", engage.drive)
    };
    let asked = params.weights.map(|w| w[0]).to_vec();
    bench.hears(&RobotControl::Engaged {
        engagement: 1,
        t_us: 0,
        hand_m: [0.0; 3],
        tip_m: [0.0; 3],
        hand_q: None,
        tip_q: WireRotation::default(),
    });
    for _ in 0..60 {
        bench.sample(home());
    }
    let said = bench.motions();
    let said = said.iter().map(|m| m.params.weights.map(|w| w[0]).to_vec());
    (asked, said.collect())
}

#[test]
fn a_hand_seen_to_rest_begins_nothing_and_one_not_seen_before_may_be_about_to() {
    let (asked, said) = trust(1);
    assert!(
        asked.iter().all(|w| *w > 127),
        "nothing is known yet: {asked:?}"
    );
    assert_eq!(said.len(), 60);
    for pair in said.windows(2) {
        let more = (0..BAND_KNOTS.len()).any(|b| pair[1][b] > pair[0][b]);
        assert!(!more, "rest never makes motion likelier: {pair:?}");
    }
    let after = |s: f64| &said[(s / 0.033) as usize - 1];
    assert!(
        after(1.0).iter().all(|w| *w <= 255 / 50),
        "{:?}",
        after(1.0)
    );
    assert!(after(1.9).iter().all(|w| *w == 0), "{:?}", after(1.9));

    let (asked, said) = trust(31);
    assert!(
        asked.iter().all(|w| *w <= 255 / 50),
        "seen for a second: {asked:?}"
    );
    let most = said.iter().flatten().max();
    assert!(most <= asked.iter().max(), "{most:?} of {asked:?}");
    let (asked, _) = trust(70);
    assert_eq!(asked, [0, 0, 0], "seen for more than two");
}
