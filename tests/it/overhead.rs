//! What it costs on the wire: bytes of a live hand, counted at the socket on the virtual ground, beside sending each of its
//! samples as a bare UDP datagram of four f32. Times are measured by `cargo bench -p telemime --bench overhead`.

use nalgebra::Vector3;
use telemime::ground::{Pair, run_virtual};
use telemime_operator::daemon::Summary;
use telemime_operator::session::{FutureBound, SessionConfig};
use telemime_operator::task::Outcome;
use telemime_protocol::spline::{BSpline, End};

use telemime_operator::demonstration::Sample;
use telemime_operator::task::{Recording, Task};

use crate::scene::{Samples, finish, performance, rig, shaped, skill};

/// Of the hand before it begins; what is seen of a live one is sent raw, too, s.
const REST_S: f64 = 1.0;

/// Performances nothing was learned from.
const DRIVEN: std::ops::Range<u32> = 5..13;

/// A sample as a bare UDP datagram: four f32, IP and UDP headers.
const RAW_BYTES: u64 = 4 * 4 + 28;

/// Two silences and 50 ms for jitter, as ε_future and ε_path of the aims.
fn config(silence_s: f64) -> SessionConfig {
    SessionConfig {
        future_bound: FutureBound::Absolute(0.16),
        path_bound_m: Some(0.04),
        max_silence_s: silence_s,
        lease_s: 2.0 * silence_s + 0.05,
        ..SessionConfig::default()
    }
}

/// What a set of performances cost.
#[derive(Debug, Default)]
struct Cost {
    seconds: f64,
    raw: u64,
    motion: u64,
    sent: u64,
    received: u64,
    packets: [u64; 3],
    messages: u64,
    knots: u64,
}

impl Cost {
    fn add(&mut self, summary: &Summary, seconds: f64) {
        let (counters, traffic) = (summary.counters, summary.engaged);
        self.seconds += seconds;
        self.raw += RAW_BYTES * u64::from(counters.samples);
        self.motion += traffic.motion.bytes;
        self.sent += traffic.sent.bytes;
        self.received += traffic.received.bytes;
        let counts = [traffic.motion, traffic.sent, traffic.received];
        for (sum, counted) in self.packets.iter_mut().zip(counts) {
            *sum += counted.packets;
        }
        self.messages += u64::from(counters.messages);
        self.knots += u64::from(counters.knots);
    }

    fn share(&self) -> f64 {
        self.motion as f64 / self.raw as f64
    }

    fn row(&self, name: &str) {
        let per = |bytes: u64, of: f64| bytes as f64 / of;
        println!(
            "| {name} | {:.1} | {:.1} | {:.1} | {:.1} | {:.0} | {:.0} | {:.0} | {:.0} | {:.3} |",
            self.messages as f64 / self.seconds,
            (self.packets[1] - self.packets[0]) as f64 / self.seconds,
            self.knots as f64 / self.seconds,
            per(self.motion, self.messages as f64),
            per(self.motion, self.seconds),
            per(self.sent - self.motion, self.seconds),
            per(self.received, self.seconds),
            per(self.sent + self.received, self.knots as f64),
            self.share(),
        );
    }
}

/// Drives the hands, one after the other, each over a link of its own.
fn drive(config: SessionConfig, hand: impl Fn(u32) -> Samples) -> Cost {
    let (rig, mut cost) = (rig(), Cost::default());
    for index in DRIVEN {
        run_virtual(async {
            let mut pair = Pair::start(&rig).unwrap();
            let samples = hand(index);
            let seconds = samples[samples.len() - 1].0;
            let samples = samples.into_iter().map(|(t_s, x)| Sample::at(t_s, x));
            let task = Task::replay(Recording {
                samples: samples.collect(),
                rest_s: 0.0,
            });
            let operator = pair
                .operator(task, Some(skill()), config, &shaped(), u64::from(index))
                .unwrap();
            let summary = finish(operator).await.0.unwrap();
            assert_eq!(summary.outcome, Outcome::Completed, "performance {index}");
            cost.add(&summary, seconds);
        })
        .unwrap();
    }
    cost
}

/// A performance, and the hand at rest before it.
fn live(index: u32) -> Samples {
    let samples = performance(index);
    let start = samples[0].1;
    let rest = (0..(REST_S * 30.0) as u32).map(|i| (f64::from(i) / 30.0, start));
    let begun = samples.into_iter().map(|(t_s, x)| (t_s + REST_S, x));
    rest.chain(begun).collect()
}

/// The same, smoothly, every millisecond.
fn fast(index: u32) -> Samples {
    let samples = live(index);
    let (t, x): (Vec<f64>, Vec<Vector3<f64>>) = samples.into_iter().unzip();
    let spline = BSpline::interpolate(&t, &x, End::Natural).unwrap();
    let end = (t[t.len() - 1] * 1e3) as u32;
    let at = |i: u32| {
        let t_s = f64::from(i) * 1e-3;
        (t_s, spline.eval(t_s).unwrap().x)
    };
    (0..=end).map(at).collect()
}

#[test]
fn a_live_hand_costs_less_than_its_samples() {
    println!(
        "| hand, lease | messages/s | other packets up/s | knots/s | B a message | B/s of motion | B/s else, up | B/s down | B a knot, all included | of raw |"
    );
    let usual = drive(SessionConfig::default(), live);
    usual.row("30 Hz, as it comes (0.2 of the way, 650 ms)");
    let short = drive(config(0.1), live);
    short.row("30 Hz, 250 ms");
    let long = drive(config(0.3), live);
    long.row("30 Hz, 650 ms");
    let quick = drive(config(0.1), fast);
    quick.row("1 kHz, 250 ms");
    let quick_long = drive(config(0.3), fast);
    quick_long.row("1 kHz, 650 ms");
    assert!(short.share() <= 1.0, "{short:?}");
    assert!(long.share() <= 1.0 / 3.0, "{long:?}");
    assert!(quick_long.share() <= 1.0 / 50.0, "{quick_long:?}");
}
