//! What a motion message costs over what it travels on: `cargo bench -p telemime --bench overhead`.
//!
//! Four echoes over loopback in one run, each between two threads: a bare UDP socket; quinn with its default settings; quinn
//! with ours; and ours with an operator's session in front and a robot's session behind, whose order to the servo is what is
//! answered. Each round takes every echo for a while, in an order that rotates, so that whatever else the computer does
//! falls upon all of them.

#![allow(
    clippy::unwrap_used,
    reason = "a bench that cannot run has nothing to tell"
)]

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use nalgebra::Vector3;
use quinn::crypto::rustls::{QuicClientConfig, QuicServerConfig};
use quinn::{ClientConfig, Connection, Endpoint, ServerConfig};
use rustix::time::{ClockId, clock_gettime};
use telemime_endpoint::{HostClock, Identity, Meter, Mono, Trust, quic, tls};
use telemime_operator::session as operator;
use telemime_operator::session::{FutureBound, HandSample};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::frame::Frame;
use telemime_protocol::wire::v1;
use telemime_robot::rig::{Rig, RigOptions};
use telemime_robot::servo::{self, Order, Station};
use telemime_robot::session as robot;

/// Length of the bare messages, B; about that of a motion.
const BARE: usize = 64;

/// Echoes of each kind in a round; the first tenth warms up.
const ECHOES: usize = 2000;

const ROUNDS: usize = 7;

/// Epoch of the one session.
const EPOCH: u32 = 1;

/// What one round of one echo took: there and back, s, and the CPU time of either end per echo, s.
struct Round {
    there_and_back: Vec<f64>,
    cpu: [f64; 2],
}

fn cpu_s() -> f64 {
    let spent = clock_gettime(ClockId::ThreadCPUTime);
    spent.tv_sec as f64 + spent.tv_nsec as f64 * 1e-9
}

/// Runs `echo` once for every message and takes the times.
async fn timed(mut echo: impl AsyncFnMut()) -> (Vec<f64>, f64) {
    let mut times = Vec::with_capacity(ECHOES);
    let begun = cpu_s();
    for i in 0..ECHOES {
        let asked = Instant::now();
        echo().await;
        if i >= ECHOES / 10 {
            times.push(asked.elapsed().as_secs_f64());
        }
    }
    (times, (cpu_s() - begun) / ECHOES as f64)
}

fn block<T>(work: impl Future<Output = T>) -> T {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build();
    runtime.unwrap().block_on(work)
}

fn bare_udp() -> Round {
    let bind = || UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let (near, far) = (bind(), bind());
    let to = far.local_addr().unwrap();
    near.set_nonblocking(true).unwrap();
    far.set_nonblocking(true).unwrap();
    let answers = thread::spawn(move || {
        block(async {
            let socket = tokio::net::UdpSocket::from_std(far).unwrap();
            let (mut buffer, begun) = ([0; 2 * BARE], cpu_s());
            for _ in 0..ECHOES {
                let (len, from) = socket.recv_from(&mut buffer).await.unwrap();
                socket.send_to(&buffer[..len], from).await.unwrap();
            }
            (cpu_s() - begun) / ECHOES as f64
        })
    });
    let (there_and_back, cpu) = block(async {
        let socket = tokio::net::UdpSocket::from_std(near).unwrap();
        let mut buffer = [0; 2 * BARE];
        timed(async || {
            socket.send_to(&[7; BARE], to).await.unwrap();
            socket.recv(&mut buffer).await.unwrap();
        })
        .await
    });
    let cpu = [cpu, answers.join().unwrap()];
    Round {
        there_and_back,
        cpu,
    }
}

/// What the two ends of a QUIC echo do with a message: what is sent, and whether what has arrived is to be answered.
struct Ends {
    send: Box<dyn FnMut() -> Vec<u8> + Send>,
    take: Box<dyn FnMut(&[u8]) -> bool + Send>,
}

fn keys() -> [(Identity, Trust); 2] {
    let [robot, operator] = [(); 2].map(|()| Identity::ephemeral().unwrap());
    let (theirs, ours) = (robot.fingerprint(), operator.fingerprint());
    [
        (robot, Trust::new([ours])),
        (operator, Trust::new([theirs])),
    ]
}

fn bind() -> quic::Socket {
    let any = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
    quic::Socket::bind(any).unwrap()
}

/// A robot's endpoint and how an operator's is made, with our settings or quinn's.
fn server((identity, trust): &(Identity, Trust), ours: bool) -> Endpoint {
    let endpoint = quic::server(identity, trust, bind(), &Meter::default()).unwrap();
    if !ours {
        let crypto = tls::server(identity, trust.clone(), &[v1::ALPN]).unwrap();
        let crypto = QuicServerConfig::try_from(crypto).unwrap();
        endpoint.set_server_config(Some(ServerConfig::with_crypto(Arc::new(crypto))));
    }
    endpoint
}

fn client((identity, trust): &(Identity, Trust), ours: bool) -> Endpoint {
    let mut endpoint = quic::client(identity, trust, bind(), &Meter::default()).unwrap();
    if !ours {
        let crypto = tls::client(identity, trust.clone(), &[v1::ALPN]).unwrap();
        let crypto = QuicClientConfig::try_from(crypto).unwrap();
        endpoint.set_default_client_config(ClientConfig::new(Arc::new(crypto)));
    }
    endpoint
}

async fn answer(connection: Connection, mut take: impl FnMut(&[u8]) -> bool) -> f64 {
    let begun = cpu_s();
    for _ in 0..ECHOES {
        let message = connection.read_datagram().await.unwrap();
        assert!(take(&message), "a message that was of no use");
        connection.send_datagram(message).unwrap();
    }
    let cpu = (cpu_s() - begun) / ECHOES as f64;
    connection.closed().await;
    cpu
}

fn quinn_echo(ours: bool, ends: Ends) -> Round {
    let [robots, operators] = keys();
    let (address_tx, address) = std::sync::mpsc::channel();
    let Ends { mut send, take } = ends;
    let answers = thread::spawn(move || {
        block(async {
            let endpoint = server(&robots, ours);
            address_tx.send(endpoint.local_addr().unwrap()).unwrap();
            let connection = endpoint.accept().await.unwrap().await.unwrap();
            answer(connection, take).await
        })
    });
    let (there_and_back, cpu) = block(async {
        let endpoint = client(&operators, ours);
        let to = address.recv().unwrap();
        let connection = endpoint.connect(to, "telemime").unwrap().await.unwrap();
        let timed = timed(async || {
            connection.send_datagram(send().into()).unwrap();
            connection.read_datagram().await.unwrap();
        })
        .await;
        connection.close(0u32.into(), b"");
        endpoint.wait_idle().await;
        timed
    });
    let cpu = [cpu, answers.join().unwrap()];
    Round {
        there_and_back,
        cpu,
    }
}

fn bare() -> Ends {
    Ends {
        send: Box::new(|| vec![7; BARE]),
        take: Box::new(|_| true),
    }
}

/// Both sessions of an engagement, as they stand before they are parted.
struct Engaged {
    operator: operator::Session,
    robot: robot::Session,
    station: Station,
    handle: servo::Handle,
    clock: HostClock,
}

fn frame(payload: Vec<u8>) -> Frame {
    Frame {
        payload,
        ignorable: false,
    }
}

impl Engaged {
    /// An arm that follows a hand, by constant velocity: what a skill adds is measured by the predictor's own bench.
    fn new() -> Self {
        let rig = Rig::load(&RigOptions::default()).unwrap();
        let (rings, handle) = servo::rings();
        let clock = HostClock::new();
        let config = operator::SessionConfig {
            // Every sample is news, however soon it comes, and a hand that trembles needs no path.
            future_bound: FutureBound::Absolute(0.0),
            min_interval_s: 0.0,
            path_bound_m: Some(1.0),
            ..operator::SessionConfig::default()
        };
        let now = clock.now();
        let mut engaged = Self {
            operator: operator::Session::new(config, None, EPOCH),
            robot: robot::Session::new(Default::default(), rig.info(), EPOCH, None, now),
            station: rig.servo(rings),
            handle,
            clock,
        };
        for i in 0..5000 {
            thread::sleep(Duration::from_millis(1));
            let now = clock.now();
            let sample = HandSample::at(Stamp(now.0), Vector3::new(0.0, 0.0, 2.0));
            engaged.operator.handle_sample(Stamp(now.0), sample);
            if i % 100 == 99 {
                engaged.operator.engage(Stamp(now.0));
            }
            engaged.step(now);
            if engaged.follows() {
                return engaged;
            }
        }
        panic!("it never engaged");
    }

    fn follows(&mut self) -> bool {
        let event = |e| matches!(e, operator::Event::Engaged { .. });
        std::iter::from_fn(|| self.operator.poll_event()).any(event)
    }

    /// Whatever either has to say is said at once.
    fn step(&mut self, now: Mono) {
        self.robot.handle_timeout(now);
        while let Some(output) = self.operator.poll_output() {
            match output {
                operator::Output::Control(payload) => {
                    self.robot.handle_control(now, &frame(payload)).unwrap();
                }
                operator::Output::Datagram { bytes, .. } => self.robot.handle_datagram(now, &bytes),
            }
        }
        while let Some(output) = self.robot.poll_output() {
            let at = Stamp(now.0);
            match output {
                robot::Output::Control(payload) => {
                    self.operator.handle_control(at, &frame(payload)).unwrap();
                }
                robot::Output::Datagram(bytes) => self.operator.handle_datagram(at, &bytes),
                robot::Output::Order(order) => self.handle.orders.push(order).unwrap(),
                robot::Output::Brake(_) | robot::Output::Goodbye => {}
            }
        }
        let report = self.station.tick(now);
        self.robot.handle_report(&report, Default::default());
    }

    /// The operator's session before the socket, the robot's behind it.
    fn part(self) -> Ends {
        let Self {
            mut operator,
            mut robot,
            clock,
            ..
        } = self;
        let mut side = 0.01;
        let send = move || {
            let now = Stamp(clock.now().0);
            side = -side;
            operator.handle_sample(now, HandSample::at(now, Vector3::new(side, 0.0, 2.0)));
            std::iter::from_fn(|| operator.poll_output())
                .find_map(|output| match output {
                    operator::Output::Datagram {
                        bytes,
                        motion: true,
                    } => Some(bytes),
                    _ => None,
                })
                .unwrap()
        };
        let take = move |bytes: &[u8]| {
            robot.handle_datagram(clock.now(), bytes);
            let track = |output| matches!(output, robot::Output::Order(Order::Track { .. }));
            std::iter::from_fn(|| robot.poll_output()).any(track)
        };
        Ends {
            send: Box::new(send),
            take: Box::new(take),
        }
    }
}

fn quantile(sorted: &[f64], q: f64) -> f64 {
    sorted[((sorted.len() - 1) as f64 * q) as usize]
}

fn main() {
    // cargo test runs benches with --test: one round shows that they work.
    let rounds = if std::env::args().any(|a| a == "--bench") {
        ROUNDS
    } else {
        1
    };
    let names = [
        "bare UDP",
        "quinn, its defaults",
        "quinn, our settings",
        "our sessions over it",
    ];
    let kinds: [fn() -> Round; 4] = [
        bare_udp,
        || quinn_echo(false, bare()),
        || quinn_echo(true, bare()),
        || quinn_echo(true, Engaged::new().part()),
    ];
    let mut all: [Vec<Round>; 4] = Default::default();
    for round in 0..rounds {
        for i in 0..kinds.len() {
            let kind = (i + round) % kinds.len();
            all[kind].push(kinds[kind]());
        }
    }
    let length = {
        let mut ends = Engaged::new().part();
        (0..100)
            .map(|_| (ends.send)().len())
            .max()
            .unwrap_or_default()
    };
    println!(
        "{rounds} rounds of {ECHOES} echoes over loopback; bare messages have {BARE} B, a motion up to {length} B\n"
    );
    let sums = all.map(|rounds| {
        let cpu =
            [0, 1].map(|end| rounds.iter().map(|r| r.cpu[end]).sum::<f64>() / rounds.len() as f64);
        let mut times: Vec<f64> = rounds.into_iter().flat_map(|r| r.there_and_back).collect();
        times.sort_by(f64::total_cmp);
        (quantile(&times, 0.5), quantile(&times, 0.99), cpu)
    });
    let bare = sums[2];
    println!(
        "| echo | p50, µs | p99, µs | p50 and p99 of quinn with our settings | CPU of either end, µs |"
    );
    println!("|---|---|---|---|---|");
    for (name, (p50, p99, cpu)) in names.iter().zip(sums) {
        println!(
            "| {name} | {:.1} | {:.1} | {:.2}, {:.2} | {:.1}, {:.1} |",
            p50 * 1e6,
            p99 * 1e6,
            p50 / bare.0,
            p99 / bare.1,
            cpu[0] * 1e6,
            cpu[1] * 1e6,
        );
    }
}
