//! An in-memory network: sockets that behave like UDP, links as in [`telemime_sim::link`].

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fmt;
use std::io::{self, IoSliceMut};
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard};
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use quinn::udp::{RecvMeta, Transmit};
use quinn::{AsyncUdpSocket, UdpPoller};
use telemime_endpoint::meter::IP_UDP_HEADER;
use telemime_sim::link::{Fate, Link, LinkConfig};
use tokio::time::{Instant, sleep_until};

#[derive(Default)]
struct Inbox {
    /// Of the socket it belongs to: another may have come to its address later.
    id: u64,
    packets: VecDeque<(SocketAddr, Vec<u8>)>,
    waker: Option<Waker>,
}

struct State {
    epoch: Instant,
    inboxes: BTreeMap<SocketAddr, Inbox>,
    links: BTreeMap<(SocketAddr, SocketAddr), Link>,
    down: bool,
    sockets: u64,
    /// Sockets whose address is gone.
    vanished: BTreeSet<u64>,
    under_way: usize,
    tape: Option<Vec<Taped>>,
    log: Option<Vec<Passage>>,
}

/// What became of one packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Passage {
    /// Who sent it.
    pub from: SocketAddr,
    /// Who was to receive it.
    pub to: SocketAddr,
    /// When it was sent, on tokio's clock.
    pub sent: Instant,
    /// Its length, IP and UDP headers included.
    pub len_bytes: usize,
    /// When it arrives; `None` if it does not.
    pub arrives: Option<Instant>,
}

/// A packet that somebody on the way has kept.
struct Taped {
    from: SocketAddr,
    to: SocketAddr,
    packet: Vec<u8>,
}

/// Sockets and the links between them, on tokio's clock.
#[derive(Clone)]
pub struct Network(Arc<Mutex<State>>);

impl Default for Network {
    fn default() -> Self {
        Self::new()
    }
}

impl Network {
    /// No sockets, perfect wires.
    pub fn new() -> Self {
        Self(Arc::new(Mutex::new(State {
            epoch: Instant::now(),
            inboxes: BTreeMap::new(),
            links: BTreeMap::new(),
            down: false,
            sockets: 0,
            vanished: BTreeSet::new(),
            under_way: 0,
            tape: None,
            log: None,
        })))
    }

    /// A socket at `addr`.
    pub fn socket(&self, addr: SocketAddr) -> Arc<Socket> {
        let mut state = self.state();
        state.sockets += 1;
        let id = state.sockets;
        let inbox = Inbox {
            id,
            ..Inbox::default()
        };
        state.inboxes.insert(addr, inbox);
        drop(state);
        Arc::new(Socket {
            network: self.clone(),
            addr,
            id,
        })
    }

    /// Takes the socket at `addr` away: what it sends, and what is sent to it, is lost.
    pub fn remove(&self, addr: SocketAddr) {
        self.state().inboxes.remove(&addr);
    }

    /// Takes the address itself away, as when an interface goes: its socket fails from now on.
    pub fn vanish(&self, addr: SocketAddr) {
        let mut state = self.state();
        if let Some(inbox) = state.inboxes.remove(&addr) {
            state.vanished.insert(inbox.id);
            if let Some(waker) = inbox.waker {
                waker.wake();
            }
        }
    }

    /// Sets the link from `from` to `to`, which begins now: its outages and traces count from here.
    pub fn link(&self, from: SocketAddr, to: SocketAddr, config: LinkConfig, seed: u64) {
        let mut state = self.state();
        let now_ns = state.epoch.elapsed().as_nanos() as i64;
        let link = Link::new(config, seed).beginning_at(now_ns);
        state.links.insert((from, to), link);
    }

    /// Every link begins then, now or soon: outages and traces count from there ([`Link::begin_at`]).
    pub fn begin(&self, at: Instant) {
        let mut state = self.state();
        let at_ns = (at - state.epoch).as_nanos() as i64;
        state.links.values_mut().for_each(|l| l.begin_at(at_ns));
    }

    /// Cuts every link, or restores them. Packets already on their way arrive.
    pub fn set_down(&self, down: bool) {
        self.state().down = down;
    }

    /// From now on keeps count of every packet that is sent.
    pub fn log(&self) {
        self.state().log = Some(Vec::new());
    }

    /// Every packet sent since [`Network::log`], in order; the count ends.
    pub fn logged(&self) -> Vec<Passage> {
        self.state().log.take().unwrap_or_default()
    }

    /// From now on keeps a copy of every packet that is delivered.
    pub fn record(&self) {
        self.state().tape = Some(Vec::new());
    }

    /// Delivers every packet that was kept once more, at once and in order, as somebody on the way could; how many.
    pub fn replay(&self) -> usize {
        let tape = self.state().tape.take().unwrap_or_default();
        let count = tape.len();
        for Taped { from, to, packet } in tape {
            self.deliver(from, to, packet);
        }
        count
    }

    /// Delivers a packet that nobody has sent, as if it came from `from`.
    pub fn forge(&self, from: SocketAddr, to: SocketAddr, packet: Vec<u8>) {
        self.deliver(from, to, packet);
    }

    /// Packets on their way, and those that nobody has read yet.
    pub fn queued(&self) -> (usize, usize) {
        let state = self.state();
        let unread = state.inboxes.values().map(|inbox| inbox.packets.len());
        (state.under_way, unread.sum())
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.0
            .lock()
            .expect("no code panics while it holds the network")
    }

    fn send(&self, socket: &Socket, to: SocketAddr, packet: &[u8]) {
        let from = socket.addr;
        let mut state = self.state();
        if state.inboxes.get(&from).is_none_or(|i| i.id != socket.id) {
            return;
        }
        let now_ns = state.epoch.elapsed().as_nanos() as i64;
        let len = packet.len() + IP_UDP_HEADER as usize;
        let fate = match state.links.get_mut(&(from, to)) {
            Some(link) => link.send(now_ns, len),
            None => Fate::whole(now_ns),
        };
        let (epoch, down) = (state.epoch, state.down);
        let at = |ns: i64| epoch + Duration::from_nanos(ns.max(0) as u64);
        if let Some(log) = &mut state.log {
            log.push(Passage {
                from,
                to,
                sent: Instant::now(),
                len_bytes: len,
                arrives: fate.arrival_ns().filter(|_| !down).map(at),
            });
        }
        if down {
            return;
        }
        drop(state);
        for delivery in fate.deliveries() {
            let (network, mut packet) = (self.clone(), packet.to_vec());
            if let Some(damage) = delivery.damage
                && !damage.strike(&mut packet, IP_UDP_HEADER as usize)
            {
                continue;
            }
            let at = at(delivery.at_ns);
            self.state().under_way += 1;
            tokio::spawn(async move {
                sleep_until(at).await;
                network.state().under_way -= 1;
                network.deliver(from, to, packet);
            });
        }
    }

    fn deliver(&self, from: SocketAddr, to: SocketAddr, packet: Vec<u8>) {
        let mut state = self.state();
        if let Some(tape) = &mut state.tape {
            let packet = packet.clone();
            tape.push(Taped { from, to, packet });
        }
        let Some(inbox) = state.inboxes.get_mut(&to) else {
            return;
        };
        inbox.packets.push_back((from, packet));
        if let Some(waker) = inbox.waker.take() {
            waker.wake();
        }
    }
}

/// One end of the network.
pub struct Socket {
    network: Network,
    addr: SocketAddr,
    id: u64,
}

impl Drop for Socket {
    /// What is sent to a socket that is closed piles up nowhere.
    fn drop(&mut self) {
        let mut state = self.network.state();
        if state
            .inboxes
            .get(&self.addr)
            .is_some_and(|i| i.id == self.id)
        {
            state.inboxes.remove(&self.addr);
        }
    }
}

impl fmt::Debug for Socket {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Socket({})", self.addr)
    }
}

#[derive(Debug)]
struct AlwaysWritable;

impl UdpPoller for AlwaysWritable {
    fn poll_writable(self: Pin<&mut Self>, _cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

impl AsyncUdpSocket for Socket {
    fn create_io_poller(self: Arc<Self>) -> Pin<Box<dyn UdpPoller>> {
        Box::pin(AlwaysWritable)
    }

    fn try_send(&self, transmit: &Transmit<'_>) -> io::Result<()> {
        let segment = transmit
            .segment_size
            .unwrap_or(transmit.contents.len())
            .max(1);
        if self.network.state().vanished.contains(&self.id) {
            return Err(io::ErrorKind::AddrNotAvailable.into());
        }
        for packet in transmit.contents.chunks(segment) {
            self.network.send(self, transmit.destination, packet);
        }
        Ok(())
    }

    fn poll_recv(
        &self,
        cx: &mut Context<'_>,
        bufs: &mut [IoSliceMut<'_>],
        meta: &mut [RecvMeta],
    ) -> Poll<io::Result<usize>> {
        let mut state = self.network.state();
        if state.vanished.contains(&self.id) {
            return Poll::Ready(Err(io::ErrorKind::AddrNotAvailable.into()));
        }
        let inbox = state.inboxes.get_mut(&self.addr);
        let Some(inbox) = inbox.filter(|inbox| inbox.id == self.id) else {
            // Taken away: nothing arrives any more, and nobody is told.
            return Poll::Pending;
        };
        let mut received = 0;
        while received < bufs.len().min(meta.len())
            && let Some((from, packet)) = inbox.packets.pop_front()
        {
            let len = packet.len().min(bufs[received].len());
            bufs[received][..len].copy_from_slice(&packet[..len]);
            meta[received] = RecvMeta {
                addr: from,
                len,
                stride: len,
                ecn: None,
                dst_ip: None,
            };
            received += 1;
        }
        if received > 0 {
            return Poll::Ready(Ok(received));
        }
        inbox.waker = Some(cx.waker().clone());
        Poll::Pending
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        Ok(self.addr)
    }

    fn may_fragment(&self) -> bool {
        false
    }
}
