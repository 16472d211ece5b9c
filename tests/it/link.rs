//! `sim::link` where packets are real: on the relay's sockets, and under both daemons.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::Path;
use std::time::Duration;

use telemime::ground::{Pair, run_virtual};
use telemime::relay::{Fate, Relay, RelayConfig};
use telemime_endpoint::HostClock;
use telemime_endpoint::meter::IP_UDP_HEADER;
use telemime_operator::task::Outcome;
use telemime_sim::link::{Link, LinkConfig, Trace, TraceFormat};
use tokio::net::UdpSocket;
use tokio::sync::watch;

use crate::data::needs;
use crate::scene::{finish, mirroring, rig};

const LEN: usize = 100;

fn any_port() -> SocketAddr {
    (Ipv4Addr::LOCALHOST, 0).into()
}

#[test]
fn the_relay_doubles_and_damages_as_the_model_says_and_records_it() {
    let up: LinkConfig = "duplicate 50% corrupt 50% loss 10%".parse().unwrap();
    let mut model = Link::new(up.clone(), 5);
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    let (passages, arrived) = runtime.block_on(async {
        let far = UdpSocket::bind(any_port()).await.unwrap();
        let near = UdpSocket::bind(any_port()).await.unwrap();
        let config = RelayConfig {
            listen: any_port(),
            to: far.local_addr().unwrap(),
            up,
            down: LinkConfig::default(),
            seed: 5,
        };
        let relay = Relay::bind(config, HostClock::new()).unwrap();
        near.connect(relay.local_addr().unwrap()).await.unwrap();
        let (quit, quit_rx) = watch::channel(false);
        let relaying = tokio::spawn(async move {
            let mut passages = Vec::new();
            relay.run(quit_rx, |passage| passages.push(passage)).await;
            passages
        });
        let (mut arrived, mut buffer) = (0, [0; 2 * LEN]);
        for n in 0..200u8 {
            near.send(&[n; LEN]).await.unwrap();
            for delivery in model.send(0, LEN + IP_UDP_HEADER as usize).deliveries() {
                let mut expected = [n; LEN];
                let whole =
                    |d: telemime_sim::link::Damage| d.strike(&mut expected, IP_UDP_HEADER as usize);
                if !delivery.damage.is_none_or(whole) {
                    continue;
                }
                let receiving = far.recv_from(&mut buffer);
                // Only so that a packet that does not come fails and does not hang.
                let received = tokio::time::timeout(Duration::from_secs(20), receiving).await;
                let (len, client) = received.expect("a packet of the model's").unwrap();
                assert_eq!(buffer[..len], expected, "packet {n}");
                far.send_to(&[n], client).await.unwrap();
                assert_eq!(near.recv(&mut buffer).await.unwrap(), 1);
                arrived += 1;
            }
        }
        quit.send(true).unwrap();
        (relaying.await.unwrap(), arrived)
    });
    let count = |fate: Fate| passages.iter().filter(|p| p.up && p.fate == fate).count();
    assert_eq!(count(Fate::Passed) + count(Fate::Corrupted), arrived);
    for fate in [Fate::Lost, Fate::Corrupted, Fate::Garbled] {
        assert!(count(fate) > 0, "{}", fate.name());
    }
    let copies = passages.iter().filter(|p| p.copy).count();
    assert_eq!(passages.iter().filter(|p| p.up).count(), 200 + copies);
    let arrives = |fate| matches!(fate, Fate::Passed | Fate::Corrupted);
    assert!(passages.iter().all(|p| p.out.is_some() == arrives(p.fate)));
    assert_eq!(passages.iter().filter(|p| !p.up).count(), arrived);
}

#[test]
fn a_session_survives_everything_a_link_does_and_repeats_to_the_bit() {
    let link: LinkConfig = "delay 50ms 5ms distribution pareto loss gemodel 1% 30% duplicate 5% \
         corrupt 3% reorder 5% gap 3 rate 2mbit 14 slot 1ms 2ms"
        .parse()
        .unwrap();
    let run = || {
        run_virtual(async {
            let mut pair = Pair::start(&rig()).unwrap();
            let operator = mirroring(&mut pair, &link, 3);
            let (summary, ..) = finish(operator).await;
            let tips: Vec<_> = pair.robot.reports().iter().map(|r| r.tip_m).collect();
            (summary.unwrap(), tips)
        })
        .unwrap()
    };
    let (summary, tips) = run();
    assert_eq!(summary.outcome, Outcome::Completed);
    assert!(tips.len() > 1000);
    let (again, tips_again) = run();
    assert_eq!(format!("{:?}", summary.total), format!("{:?}", again.total));
    assert!(tips == tips_again);
}

/// A link with a recording, and how many values that has.
fn recorded(path: &Path, format: TraceFormat) -> (LinkConfig, usize) {
    let trace = Trace::open(path, Some(format)).unwrap();
    let values = trace.len();
    let config = LinkConfig {
        trace: Some(trace),
        limit: usize::MAX,
        ..LinkConfig::default()
    };
    (config, values)
}

#[test]
fn recorded_round_trips_are_replayed_whole() {
    let Some(folder) = needs("data/links/telerobot_rtt") else {
        return;
    };
    for (name, count) in [("013", 1000), ("035", 8958), ("036", 18933)] {
        let path = folder.join(format!("tyrell_roundtrip{name}.csv"));
        let (config, values) = recorded(&path, TraceFormat::Rtt);
        assert_eq!(values, count, "{name}");
        let text = std::fs::read_to_string(&path).unwrap();
        let sum: f64 = text.lines().map(|l| l.trim().parse::<f64>().unwrap()).sum();
        let mut link = Link::new(config, 1);
        let delays = (0..count).filter_map(|_| link.send(0, 100).arrival_ns());
        let replayed = delays.map(|ns| ns as f64 * 1e-6).sum::<f64>();
        assert!(
            (replayed - sum / 2.0).abs() < 1e-6 * sum,
            "{name}: {replayed} {sum}"
        );
    }
}

#[test]
fn recorded_delivery_schedules_carry_what_they_carried() {
    let Some(folder) = needs("data/links/mahimahi") else {
        return;
    };
    for (name, count) in [("up", 69367), ("down", 58655)] {
        let path = folder.join(format!("Verizon-LTE-short.{name}"));
        let (config, values) = recorded(&path, TraceFormat::Mahimahi);
        assert_eq!(values, count, "{name}");
        let end_ms: i64 = std::fs::read_to_string(&path)
            .unwrap()
            .lines()
            .last()
            .unwrap()
            .trim()
            .parse()
            .unwrap();
        // A sender that always has something to say uses every opportunity, in the second round too.
        let mut link = Link::new(config, 1);
        let last = (0..2 * count)
            .filter_map(|_| link.send(0, 1500).arrival_ns())
            .last();
        assert_eq!(last, Some(2 * end_ms * 1_000_000), "{name}");
    }
}

#[test]
fn a_recorded_satellite_link_has_its_delays_and_losses() {
    let Some(packed) = needs("data/links/starlink_lagos/lagos.csv.xz") else {
        return;
    };
    let refused = Trace::open(&packed, Some(TraceFormat::StarlinkUp)).unwrap_err();
    assert!(
        refused.to_string().contains("is xz-compressed"),
        "{refused}"
    );
    let Ok(out) = std::process::Command::new("xz")
        .arg("-dc")
        .arg(&packed)
        .output()
    else {
        crate::data::skipped(format_args!(
            "there is no xz to unpack {}",
            packed.display()
        ));
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("lagos.csv");
    std::fs::write(&path, &out.stdout).unwrap();
    let text = String::from_utf8(out.stdout).unwrap();
    for (format, column) in [(TraceFormat::StarlinkUp, 0), (TraceFormat::StarlinkDown, 1)] {
        let (config, values) = recorded(&path, format);
        let rows: Vec<Vec<f64>> = text
            .lines()
            .map(|l| l.split(',').map(|v| v.parse().unwrap()).collect())
            .collect();
        assert_eq!(values, rows.len());
        // Twenty packets in every step of 100 ms, in the middle of it, each sent within a millisecond.
        let mut link = Link::new(config, 1).beginning_at(0);
        let (mut lost, mut expected, mut last_ns) = (0, 0.0, i64::MIN);
        for row in &rows {
            let now_ns = ((row[6] + 50.0) * 1e6) as i64;
            for _ in 0..20 {
                expected += row[4 + column];
                match link.send(now_ns, 1).arrival_ns() {
                    None => lost += 1,
                    Some(at_ns) => {
                        // Behind a bottleneck nothing overtakes, however much the delay falls.
                        let due_ns = now_ns + (row[2 + column] * 1e6).round() as i64;
                        let sending_ns = at_ns - due_ns.max(last_ns);
                        assert!((0..1_000_000).contains(&sending_ns), "{} ms", row[6]);
                        last_ns = at_ns;
                    }
                }
            }
        }
        let lost = f64::from(lost);
        assert!(
            (lost - expected).abs() < 4.0 * expected.sqrt(),
            "{lost} {expected}"
        );
    }
}
