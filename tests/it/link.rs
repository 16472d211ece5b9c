//! `sim::link` where packets are real: on the relay's sockets, and under both daemons.

use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

use telemime::ground::{Pair, run_virtual};
use telemime::relay::{Fate, Relay, RelayConfig};
use telemime_endpoint::HostClock;
use telemime_endpoint::meter::IP_UDP_HEADER;
use telemime_operator::task::Outcome;
use telemime_sim::link::{Link, LinkConfig};
use tokio::net::UdpSocket;
use tokio::sync::watch;

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
        let relay = Relay::bind(config, HostClock::new()).await.unwrap();
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
