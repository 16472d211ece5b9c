//! A UDP relay that shapes what passes: `sim::link` between two real processes.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;

use telemime_endpoint::cli::told;
use telemime_endpoint::meter::IP_UDP_HEADER;
use telemime_endpoint::{HostClock, Mono};
use telemime_sim::link::{Damage, Link, LinkConfig, Outcome};
use tokio::net::UdpSocket;
use tokio::sync::{mpsc, watch};
use tokio::time::sleep_until;

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
    socket: Arc<UdpSocket>,
    config: RelayConfig,
    clock: HostClock,
    shapes: watch::Receiver<Option<LinkConfig>>,
}

struct Packet {
    up: bool,
    client: SocketAddr,
    at: Mono,
    bytes: Vec<u8>,
    fate: Fate,
    copy: bool,
}

struct Client {
    far: Arc<UdpSocket>,
    last: Mono,
    reader: tokio::task::JoinHandle<()>,
}

impl Relay {
    /// Binds the listening socket.
    ///
    /// # Errors
    /// The system's, for example when the port is taken.
    pub async fn bind(config: RelayConfig, clock: HostClock) -> io::Result<Self> {
        let socket = Arc::new(UdpSocket::bind(config.listen).await?);
        Ok(Self {
            socket,
            config,
            clock,
            shapes: watch::channel(None).1,
        })
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
        // Packets on their way: by time of delivery, then by order of arrival.
        let mut due: BinaryHeap<Reverse<(i64, u64)>> = BinaryHeap::new();
        let mut flying: BTreeMap<u64, Packet> = BTreeMap::new();
        let mut count = 0;
        let mut buffer = vec![0; MAX_PACKET];
        loop {
            let next = due
                .peek()
                .map(|Reverse((at, _))| self.clock.instant(Mono(*at)));
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
                () = sleep_until(next.unwrap_or_else(tokio::time::Instant::now)), if next.is_some() => {
                    let now = self.clock.now();
                    while let Some(&Reverse((at, id))) = due.peek() && at <= now.0 {
                        due.pop();
                        let Some(packet) = flying.remove(&id) else { continue };
                        let sent = self.deliver(&packet, &clients).await;
                        passages(passage(&packet, if sent { packet.fate } else { Fate::Refused }, sent.then_some(now)));
                    }
                    continue;
                }
                received = self.socket.recv_from(&mut buffer) => match received {
                    Ok((len, client)) => {
                        let at = self.clock.now();
                        if !self.know(client, at, &mut clients, &tx).await {
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
            let mut bytes = Some(bytes);
            for (outcome, copy) in copies.into_iter().flatten() {
                let bytes = if copy { bytes.clone() } else { bytes.take() };
                let mut packet = Packet {
                    up: is_up,
                    client,
                    at,
                    bytes: bytes.unwrap_or_default(),
                    fate: Fate::Passed,
                    copy,
                };
                let (fate, at_ns) = arrival(outcome, &mut packet.bytes);
                packet.fate = fate;
                match at_ns {
                    Some(at_ns) => {
                        count += 1;
                        due.push(Reverse((at_ns, count)));
                        flying.insert(count, packet);
                    }
                    None => passages(passage(&packet, fate, None)),
                }
            }
        }
        clients.values().for_each(|client| client.reader.abort());
    }

    async fn deliver(&self, packet: &Packet, clients: &BTreeMap<SocketAddr, Client>) -> bool {
        if !packet.up {
            return self
                .socket
                .send_to(&packet.bytes, packet.client)
                .await
                .is_ok();
        }
        match clients.get(&packet.client) {
            Some(client) => client.far.send(&packet.bytes).await.is_ok(),
            None => false,
        }
    }

    /// Makes sure there is a socket that stands for `client` on the far side.
    async fn know(
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
        let Ok(far) = UdpSocket::bind((any, 0)).await else {
            return false;
        };
        if far.connect(self.config.to).await.is_err() {
            return false;
        }
        let far = Arc::new(far);
        let reader = tokio::spawn(read(far.clone(), client, tx.clone()));
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

async fn read(far: Arc<UdpSocket>, client: SocketAddr, tx: mpsc::Sender<(SocketAddr, Vec<u8>)>) {
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

fn passage(packet: &Packet, fate: Fate, out: Option<Mono>) -> Passage {
    Passage {
        at: packet.at,
        up: packet.up,
        len_bytes: packet.bytes.len() + IP_UDP_HEADER as usize,
        out,
        fate,
        copy: packet.copy,
    }
}
