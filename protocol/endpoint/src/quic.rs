//! quinn, set up for teleoperation: its defaults queue stale commands and stall behind a small window.

use std::any::Any;
use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::time::{Duration, Instant};

use quinn::congestion::{Controller, ControllerFactory, ControllerMetrics, CubicConfig};
use quinn::crypto::rustls::{QuicClientConfig, QuicServerConfig};
use quinn::{
    AckFrequencyConfig, AsyncUdpSocket, ClientConfig, Endpoint, EndpointConfig, IdleTimeout,
    ServerConfig, TransportConfig, VarInt,
};
use quinn_proto::{RandomConnectionIdGenerator, RttEstimator};
use telemime_protocol::wire::{pair, v1};

use crate::identity::Identity;
use crate::meter::{CID_LEN, Meter};
use crate::tls;
use crate::trust::Trust;

/// Silence after which a connection is given up. Never a safety timer: the motion lease is.
pub const IDLE_TIMEOUT: Duration = Duration::from_secs(1);

/// Interval of keep-alive packets, so that only a dead link is silent.
pub const KEEP_ALIVE: Duration = Duration::from_millis(250);

/// Congestion window floor, bytes: 100 messages a second of about 95 B through a 25 s outage.
const WINDOW_FLOOR: u64 = 256 * 1024;

/// Stream bytes under way at once: a model on a thin link must not fill the queue in front of stops and
/// pongs for as long as it is (100 kB, 13 s at 64 kbit/s; so it is 4 s), and on a usual one must not take long
/// either (three round trips and their delayed acknowledgements).
pub(crate) const SEND_WINDOW: u64 = 32 * 1024;

/// Datagrams QUIC may hold back: two of ours, each with quinn's 32 B of bookkeeping. The newest wins.
const DATAGRAM_SEND_BUFFER: usize = 2 * (v1::MAX_DATAGRAM_LEN + 32);

/// A packet is lost when one that was sent later has been acknowledged for a while, not when some have overtaken it
/// (RFC 9002 §6.1.1 allows either): jitter of a few ms reorders whatever is sent in one go, and quinn's three would
/// send half of a model twice. More than are ever under way.
const PACKET_THRESHOLD: u32 = 1024;

/// Stream bytes held for a session that does not read them yet, twice what this implementation has under way.
const RECEIVE_WINDOW: u32 = 64 * 1024;

/// First packets held for somebody who has not been let in, bytes: a client's hello, and some of it again. quinn's
/// 10 MiB are for servers that want 0-RTT.
const INCOMING_BUFFER: u64 = 8 * 1024;

/// Cubic that never closes its window below [`WINDOW_FLOOR`].
///
/// Cubic does not grow while the application sends little, and quinn sends nothing while
/// `in_flight + MTU` exceeds the window: at 1 kHz over 40 ms and 1 % loss that costs 69 ms at the median.
/// The application's own rate (tens of messages a second) is the real limit.
struct Floored {
    cubic: Box<dyn Controller>,
    /// The least round trip of the connection.
    least_rtt: Option<Duration>,
}

struct FlooredConfig(Arc<CubicConfig>);

impl ControllerFactory for FlooredConfig {
    fn build(self: Arc<Self>, now: Instant, current_mtu: u16) -> Box<dyn Controller> {
        Box::new(Floored {
            cubic: Arc::clone(&self.0).build(now, current_mtu),
            least_rtt: None,
        })
    }
}

impl Controller for Floored {
    fn on_sent(&mut self, now: Instant, bytes: u64, last_packet_number: u64) {
        self.cubic.on_sent(now, bytes, last_packet_number);
    }

    fn on_ack(
        &mut self,
        now: Instant,
        sent: Instant,
        bytes: u64,
        app_limited: bool,
        rtt: &RttEstimator,
    ) {
        self.least_rtt = Some(rtt.min());
        self.cubic.on_ack(now, sent, bytes, app_limited, rtt);
    }

    fn on_end_acks(
        &mut self,
        now: Instant,
        in_flight: u64,
        app_limited: bool,
        largest: Option<u64>,
    ) {
        self.cubic.on_end_acks(now, in_flight, app_limited, largest);
    }

    fn on_congestion_event(
        &mut self,
        now: Instant,
        sent: Instant,
        persistent: bool,
        lost_bytes: u64,
    ) {
        self.cubic
            .on_congestion_event(now, sent, persistent, lost_bytes);
    }

    fn on_mtu_update(&mut self, new_mtu: u16) {
        self.cubic.on_mtu_update(new_mtu);
    }

    fn window(&self) -> u64 {
        self.cubic.window().max(WINDOW_FLOOR)
    }

    fn metrics(&self) -> ControllerMetrics {
        self.cubic.metrics()
    }

    fn clone_box(&self) -> Box<dyn Controller> {
        Box::new(Self {
            cubic: self.cubic.clone_box(),
            least_rtt: self.least_rtt,
        })
    }

    fn initial_window(&self) -> u64 {
        self.cubic.initial_window().max(WINDOW_FLOOR)
    }

    fn into_any(self: Box<Self>) -> Box<dyn Any> {
        self
    }
}

/// The least round trip of a connection so far; the smoothed one as long as nothing has been acknowledged.
pub fn least_rtt(connection: &quinn::Connection) -> Duration {
    let controller = connection.congestion_state().into_any();
    let least = controller.downcast::<Floored>().ok();
    least
        .and_then(|floored| floored.least_rtt)
        .unwrap_or_else(|| connection.rtt())
}

fn transport() -> TransportConfig {
    let mut acks = AckFrequencyConfig::default();
    acks.ack_eliciting_threshold(VarInt::from_u32(10))
        .max_ack_delay(Some(Duration::from_millis(200)));
    let mut transport = TransportConfig::default();
    transport
        .max_idle_timeout(Some(IdleTimeout::from(VarInt::from_u32(
            IDLE_TIMEOUT.as_millis() as u32,
        ))))
        .keep_alive_interval(Some(KEEP_ALIVE))
        .send_window(SEND_WINDOW)
        .packet_threshold(PACKET_THRESHOLD)
        .datagram_send_buffer_size(DATAGRAM_SEND_BUFFER)
        .datagram_receive_buffer_size(Some(64 * 1024))
        .stream_receive_window(VarInt::from_u32(RECEIVE_WINDOW))
        .receive_window(VarInt::from_u32(RECEIVE_WINDOW))
        .max_concurrent_bidi_streams(VarInt::from_u32(1))
        .max_concurrent_uni_streams(VarInt::from_u32(0))
        .ack_frequency_config(Some(acks))
        // Our packets are small; a 1452-byte probe blocks a 64 kbit/s link for 180 ms.
        .mtu_discovery_config(None)
        .congestion_controller_factory(Arc::new(FlooredConfig(Arc::new(CubicConfig::default()))));
    transport
}

/// How an endpoint is bound.
#[derive(Debug)]
pub enum Socket {
    /// A real UDP socket.
    Udp(UdpSocket),
    /// Anything that behaves like one; `seed` makes connection ids repeatable.
    Abstract {
        /// The socket.
        socket: Arc<dyn AsyncUdpSocket>,
        /// Seed of the endpoint's randomness.
        seed: [u8; 32],
    },
}

impl Socket {
    /// Binds a UDP socket.
    ///
    /// # Errors
    /// The system's, for example when the port is taken.
    pub fn bind(addr: SocketAddr) -> io::Result<Self> {
        UdpSocket::bind(addr).map(Self::Udp)
    }
}

/// Why an endpoint cannot be set up.
#[derive(Debug, thiserror::Error)]
pub enum EndpointError {
    /// The socket.
    #[error("socket: {0}")]
    Io(#[from] io::Error),
    /// Our own TLS settings.
    #[error("TLS: {0}")]
    Tls(#[from] rustls::Error),
    /// The cipher suites have none for QUIC's first packets.
    #[error("TLS: {0}")]
    Cipher(#[from] quinn::crypto::rustls::NoInitialCipherSuite),
}

/// The robot's endpoint: accepts whom `peers` trusts and nobody else.
///
/// # Errors
/// [`EndpointError`].
pub fn server(
    identity: &Identity,
    peers: impl Into<Trust>,
    socket: Socket,
    meter: &Meter,
) -> Result<Endpoint, EndpointError> {
    let tls = tls::server(identity, peers.into(), &[v1::ALPN, pair::ALPN])?;
    let crypto = QuicServerConfig::try_from(tls)?;
    let mut config = ServerConfig::with_crypto(Arc::new(crypto));
    config
        .transport_config(Arc::new(transport()))
        .max_incoming(16)
        .incoming_buffer_size(INCOMING_BUFFER)
        .incoming_buffer_size_total(16 * INCOMING_BUFFER);
    endpoint(identity, Some(config), socket, meter)
}

/// The operator's endpoint and the settings to reach whom `peer` trusts with.
///
/// # Errors
/// [`EndpointError`].
pub fn client(
    identity: &Identity,
    peer: impl Into<Trust>,
    socket: Socket,
    meter: &Meter,
) -> Result<Endpoint, EndpointError> {
    client_for(identity, peer.into(), v1::ALPN, socket, meter)
}

/// The endpoint of an operator that wants to be paired: it talks to anybody, of nothing else.
///
/// # Errors
/// [`EndpointError`].
pub fn pairing_client(identity: &Identity, socket: Socket) -> Result<Endpoint, EndpointError> {
    let anybody = Trust::new([]);
    anybody.set_open(true);
    client_for(identity, anybody, pair::ALPN, socket, &Meter::default())
}

fn client_for(
    identity: &Identity,
    peer: Trust,
    alpn: &[u8],
    socket: Socket,
    meter: &Meter,
) -> Result<Endpoint, EndpointError> {
    let crypto = QuicClientConfig::try_from(tls::client(identity, peer, &[alpn])?)?;
    let mut config = ClientConfig::new(Arc::new(crypto));
    config.transport_config(Arc::new(transport()));
    let mut endpoint = endpoint(identity, None, socket, meter)?;
    endpoint.set_default_client_config(config);
    Ok(endpoint)
}

fn endpoint(
    identity: &Identity,
    server: Option<ServerConfig>,
    socket: Socket,
    meter: &Meter,
) -> Result<Endpoint, EndpointError> {
    // The same after a restart: a peer whose session died with the process is told at its next packet, and need not
    // wait for its idle time-out (RFC 9000 §10.3).
    let mut config = EndpointConfig::new(Arc::new(identity.reset_key()));
    config.cid_generator(|| Box::new(RandomConnectionIdGenerator::new(CID_LEN)));
    let runtime = Arc::new(quinn::TokioRuntime);
    let socket = match socket {
        Socket::Udp(socket) => quinn::Runtime::wrap_udp_socket(&*runtime, socket)?,
        Socket::Abstract { socket, seed } => {
            config.rng_seed(Some(seed));
            socket
        }
    };
    Ok(Endpoint::new_with_abstract_socket(
        config,
        server,
        meter.wrap(socket),
        runtime,
    )?)
}

/// The ALPN of a connection whose handshake is complete.
pub fn alpn(connection: &quinn::Connection) -> Option<Vec<u8>> {
    let data = connection.handshake_data()?;
    let data = data
        .downcast::<quinn::crypto::rustls::HandshakeData>()
        .ok()?;
    data.protocol
}

/// Why TLS ended a handshake, as far as it concerns keys and versions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// The peer's key is not pinned here.
    KeyUnknown,
    /// The peer's key was revoked here.
    KeyRevoked,
    /// Our key is not pinned there.
    OurKeyUnknown,
    /// Our key was revoked there.
    OurKeyRevoked,
    /// No common ALPN.
    Version,
}

// TLS alerts (RFC 8446 §6.2) as QUIC errors (RFC 9001 §4.8).
const ALERT_REVOKED: u8 = 44;
const ALERT_ACCESS_DENIED: u8 = 49;
const ALERT_NO_ALPN: u8 = 120;

/// What a connection's end says about keys and versions, if it does.
pub fn refusal(error: &quinn::ConnectionError) -> Option<Refusal> {
    use quinn::ConnectionError as E;
    let (code, theirs) = match error {
        E::ConnectionClosed(close) => (close.error_code, true),
        E::TransportError(e) => (e.code, false),
        _ => return None,
    };
    let alert = |n| quinn::TransportErrorCode::crypto(n) == code;
    match theirs {
        _ if alert(ALERT_NO_ALPN) => Some(Refusal::Version),
        true if alert(ALERT_REVOKED) => Some(Refusal::OurKeyRevoked),
        true if alert(ALERT_ACCESS_DENIED) => Some(Refusal::OurKeyUnknown),
        false if alert(ALERT_REVOKED) => Some(Refusal::KeyRevoked),
        false if alert(ALERT_ACCESS_DENIED) => Some(Refusal::KeyUnknown),
        _ => None,
    }
}

/// A connection's end, in one line a person can act on.
pub fn explain(error: &quinn::ConnectionError) -> String {
    use quinn::ConnectionError as E;
    match (refusal(error), error) {
        (Some(Refusal::Version), _) => "the peer speaks no version of Telemime that we know".into(),
        (Some(Refusal::KeyUnknown), _) => {
            "the peer's key is not one we know: pair, or compare the fingerprints both ends print with --peer".into()
        }
        (Some(Refusal::KeyRevoked), _) => "the peer's key was revoked here".into(),
        (Some(Refusal::OurKeyUnknown), _) => {
            "the peer does not accept our key: pair, or add our fingerprint to its --peer".into()
        }
        (Some(Refusal::OurKeyRevoked), _) => {
            "the peer has revoked our key: it must be removed there (`telemime peers remove`) before it can be paired again".into()
        }
        (None, E::TimedOut) => "no answer: is the peer running, and does UDP reach it?".into(),
        (None, E::LocallyClosed) => "closed here".into(),
        (None, E::ApplicationClosed(close)) if close.reason.is_empty() => "closed by the peer".into(),
        (None, E::ApplicationClosed(close)) => {
            format!("closed by the peer: {}", String::from_utf8_lossy(&close.reason))
        }
        (None, other) => other.to_string(),
    }
}
