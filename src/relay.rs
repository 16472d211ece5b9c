//! A UDP relay that shapes what passes: `sim::link` between two real processes.

use std::collections::BTreeMap;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;

use telemime_endpoint::cli::told;
use telemime_endpoint::meter::IP_UDP_HEADER;
use telemime_endpoint::{HostClock, Mono};
use telemime_sim::link::{Damage, Link, LinkConfig, Outcome};
use tokio::net::UdpSocket;
use tokio::sync::{mpsc, watch};

mod courier;

use courier::{Courier, Parcel};

/// Clients remembered; the one silent for longest makes room for the next.
const MAX_CLIENTS: usize = 64;

/// Packets read ahead from the far side.
const READ_AHEAD: usize = 256;

/// Longest UDP payload.
const MAX_PACKET: usize = 65_535;

/// What a relay is set to.
#[derive(Debug, Clone)]
pub struct RelayConfig {
    /// Where clients (operators) send to.
    pub listen: SocketAddr,
    /// Where their packets go (the robot).
    pub to: SocketAddr,
    /// Client → far side.
    pub up: LinkConfig,
    /// Far side → client.
    pub down: LinkConfig,
    /// Seed of both directions.
    pub seed: u64,
}

/// What became of one packet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Passage {
    /// When it came in.
    pub at: Mono,
    /// Client → far side.
    pub up: bool,
    /// Length, IP and UDP headers included, bytes.
    pub len_bytes: usize,
    /// When it went out again; `None` if it did not.
    pub out: Option<Mono>,
    /// Why, or how.
    pub fate: Fate,
    /// It is the duplicate of another.
    pub copy: bool,
}

/// How a packet got through, or why it did not.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fate {
    /// As it was.
    Passed,
    /// At once, before those that waited.
    Overtook,
    /// With one bit flipped.
    Corrupted,
    /// Not at all: the flipped bit lay in its headers, whose checksums tell.
    Garbled,
    /// Lost.
    Lost,
    /// The queue was full.
    Overflow,
    /// The link was out.
    Outage,
    /// The system did not take it, or its client has gone.
    Refused,
}

impl Fate {
    /// All there are.
    pub const ALL: [Self; 8] = [
        Self::Passed,
        Self::Overtook,
        Self::Corrupted,
        Self::Garbled,
        Self::Lost,
        Self::Overflow,
        Self::Outage,
        Self::Refused,
    ];

    /// In a word, as the record has it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Passed => "passed",
            Self::Overtook => "overtook",
            Self::Corrupted => "corrupted",
            Self::Garbled => "garbled",
            Self::Lost => "lost",
            Self::Overflow => "overflow",
            Self::Outage => "outage",
            Self::Refused => "refused",
        }
    }
}

/// A bound relay.
#[derive(Debug)]
pub struct Relay {
    socket: UdpSocket,
    /// The same socket, for the courier.
    near: Arc<std::net::UdpSocket>,
    config: RelayConfig,
    clock: HostClock,
    shapes: watch::Receiver<Option<LinkConfig>>,
    beginnings: watch::Receiver<Option<Mono>>,
}

struct Client {
    far: Arc<std::net::UdpSocket>,
    last: Mono,
    reader: tokio::task::JoinHandle<()>,
}

/// A socket to read by here, and to write by elsewhere.
fn both(socket: std::net::UdpSocket) -> io::Result<(UdpSocket, Arc<std::net::UdpSocket>)> {
    socket.set_nonblocking(true)?;
    let written = socket.try_clone()?;
    Ok((UdpSocket::from_std(socket)?, Arc::new(written)))
}

impl Relay {
    /// Binds the listening socket.
    ///
    /// # Errors
    /// The system's, for example when the port is taken.
    pub fn bind(config: RelayConfig, clock: HostClock) -> io::Result<Self> {
        let (socket, near) = both(std::net::UdpSocket::bind(config.listen)?)?;
        Ok(Self {
            socket,
            near,
            config,
            clock,
            shapes: watch::channel(None).1,
            beginnings: watch::channel(None).1,
        })
    }

    /// Both directions begin when it is said there, now or soon ([`Link::begin_at`]); else they begin with the relay.
    #[must_use]
    pub fn begun_by(mut self, beginnings: watch::Receiver<Option<Mono>>) -> Self {
        self.beginnings = beginnings;
        self
    }

    /// Takes on, in both directions, whatever is sent there; packets on their way arrive as they would have.
    #[must_use]
    pub fn shaped_by(mut self, shapes: watch::Receiver<Option<LinkConfig>>) -> Self {
        self.shapes = shapes;
        self
    }

    /// Where it listens.
    ///
    /// # Errors
    /// The system's.
    pub fn local_addr(&self) -> io::Result<SocketAddr> {
        self.socket.local_addr()
    }

    /// Passes packets on until `quit` turns true. `passages` hears of every packet once its fate is done.
    pub async fn run(mut self, mut quit: watch::Receiver<bool>, mut passages: impl FnMut(Passage)) {
        let began = self.clock.now().0;
        let mut up = Link::new(self.config.up.clone(), self.config.seed).beginning_at(began);
        let seed_down = self.config.seed ^ 0x9e37_79b9_7f4a_7c15;
        let mut down = Link::new(self.config.down.clone(), seed_down).beginning_at(began);
        let mut clients: BTreeMap<SocketAddr, Client> = BTreeMap::new();
        let (tx, mut from_far) = mpsc::channel::<(SocketAddr, Vec<u8>)>(READ_AHEAD);
        let (done, mut done_rx) = mpsc::unbounded_channel();
        let courier = Courier::start(self.clock, done);
        let mut buffer = vec![0; MAX_PACKET];
        loop {
            let (is_up, client, at, bytes) = tokio::select! {
                biased;
                () = told(&mut quit) => break,
                Ok(()) = self.shapes.changed() => {
                    let shape = self.shapes.borrow_and_update().clone();
                    if let Some(shape) = shape {
                        up = Link::new(shape.clone(), self.config.seed).beginning_at(began);
                        down = Link::new(shape, seed_down).beginning_at(began);
                    }
                    continue;
                }
                Ok(()) = self.beginnings.changed() => {
                    if let Some(at) = *self.beginnings.borrow_and_update() {
                        up.begin_at(at.0);
                        down.begin_at(at.0);
                    }
                    continue;
                }
                Some(passage) = done_rx.recv() => {
                    passages(passage);
                    continue;
                }
                received = self.socket.recv_from(&mut buffer) => match received {
                    Ok((len, client)) => {
                        let at = self.clock.now();
                        if !self.know(client, at, &mut clients, &tx) {
                            continue;
                        }
                        (true, client, at, buffer[..len].to_vec())
                    }
                    // An ICMP error of an earlier packet: the link goes on.
                    Err(_) => continue,
                },
                Some((client, bytes)) = from_far.recv() => (false, client, self.clock.now(), bytes),
            };
            let link = if is_up { &mut up } else { &mut down };
            let fate = link.send(at.0, bytes.len() + IP_UDP_HEADER as usize);
            let copies = [
                fate.duplicate.map(|o| (o, true)),
                Some((fate.packet, false)),
            ];
            for (outcome, copy) in copies.into_iter().flatten() {
                let mut bytes = bytes.clone();
                let (fate, at_ns) = arrival(outcome, &mut bytes);
                let passage = Passage {
                    at,
                    up: is_up,
                    len_bytes: bytes.len() + IP_UDP_HEADER as usize,
                    out: None,
                    fate,
                    copy,
                };
                let by = if is_up {
                    clients.get(&client).map(|c| &c.far)
                } else {
                    Some(&self.near)
                };
                let Some(at_ns) = at_ns else {
                    passages(passage);
                    continue;
                };
                let Some(by) = by else {
                    let fate = Fate::Refused;
                    passages(Passage { fate, ..passage });
                    continue;
                };
                courier.take(Parcel {
                    at_ns,
                    bytes,
                    by: by.clone(),
                    to: (!is_up).then_some(client),
                    passage,
                });
            }
        }
        clients.values().for_each(|client| client.reader.abort());
        drop(courier);
        while let Ok(passage) = done_rx.try_recv() {
            passages(passage);
        }
    }

    /// Makes sure there is a socket that stands for `client` on the far side.
    fn know(
        &self,
        client: SocketAddr,
        now: Mono,
        clients: &mut BTreeMap<SocketAddr, Client>,
        tx: &mpsc::Sender<(SocketAddr, Vec<u8>)>,
    ) -> bool {
        if let Some(known) = clients.get_mut(&client) {
            known.last = now;
            return true;
        }
        if clients.len() >= MAX_CLIENTS
            && let Some(oldest) = clients
                .iter()
                .min_by_key(|(_, c)| c.last)
                .map(|(addr, _)| *addr)
            && let Some(gone) = clients.remove(&oldest)
        {
            gone.reader.abort();
        }
        let any: IpAddr = if self.config.to.is_ipv4() {
            Ipv4Addr::UNSPECIFIED.into()
        } else {
            Ipv6Addr::UNSPECIFIED.into()
        };
        let open = || {
            let far = std::net::UdpSocket::bind((any, 0))?;
            far.connect(self.config.to)?;
            both(far)
        };
        let Ok((read_by, far)) = open() else {
            return false;
        };
        let reader = tokio::spawn(read(read_by, client, tx.clone()));
        clients.insert(
            client,
            Client {
                far,
                last: now,
                reader,
            },
        );
        true
    }
}

async fn read(far: UdpSocket, client: SocketAddr, tx: mpsc::Sender<(SocketAddr, Vec<u8>)>) {
    let mut buffer = vec![0; MAX_PACKET];
    loop {
        // An error is an ICMP answer to an earlier packet (nobody listens there yet): wait for the next.
        if let Ok(len) = far.recv(&mut buffer).await
            && tx.send((client, buffer[..len].to_vec())).await.is_err()
        {
            return;
        }
    }
}

/// What becomes of one copy, which is damaged here if it is to be, and when it arrives, ns.
fn arrival(outcome: Outcome, bytes: &mut [u8]) -> (Fate, Option<i64>) {
    let delivery = match outcome {
        Outcome::Lost => return (Fate::Lost, None),
        Outcome::Overflow => return (Fate::Overflow, None),
        Outcome::Outage => return (Fate::Outage, None),
        Outcome::Deliver(delivery) => delivery,
    };
    let struck = |damage: Damage| damage.strike(bytes, IP_UDP_HEADER as usize);
    match delivery.damage.map(struck) {
        Some(false) => (Fate::Garbled, None),
        Some(true) => (Fate::Corrupted, Some(delivery.at_ns)),
        None if delivery.at_once => (Fate::Overtook, Some(delivery.at_ns)),
        None => (Fate::Passed, Some(delivery.at_ns)),
    }
}
