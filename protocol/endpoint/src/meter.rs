//! Counts what really goes over the socket, headers included, and which packets carry motion.

use std::collections::VecDeque;
use std::fmt;
use std::io::{self, IoSliceMut};
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard};
use std::task::{Context, Poll};

use quinn::udp::{RecvMeta, Transmit};
use quinn::{AsyncUdpSocket, UdpPoller};

/// IPv4 and UDP headers of one packet, bytes.
pub const IP_UDP_HEADER: u64 = 28;

/// Length of the connection ids both ends issue, bytes.
pub const CID_LEN: usize = 4;

/// Least QUIC bytes around one datagram: flags, connection id, packet number, AEAD tag (RFC 9000 §17.3,
/// RFC 9001 §5.3).
const SHORT_HEADER_AND_TAG: usize = 1 + CID_LEN + 1 + 16;

/// Frame type and length in front of a datagram (RFC 9221 §4).
const FRAME_HEADER: usize = 2;

/// Packets and bytes, IP and UDP headers included.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Traffic {
    /// Packets.
    pub packets: u64,
    /// Bytes.
    pub bytes: u64,
}

impl Traffic {
    fn since(self, earlier: Self) -> Self {
        Self {
            packets: self.packets - earlier.packets,
            bytes: self.bytes - earlier.bytes,
        }
    }

    fn add(&mut self, packets: u64, udp_bytes: u64) {
        self.packets += packets;
        self.bytes += udp_bytes + packets * IP_UDP_HEADER;
    }
}

/// What a [`Meter`] has counted so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// Everything sent.
    pub sent: Traffic,
    /// Everything received.
    pub received: Traffic,
    /// Of what was sent, the packets that carried a marked datagram.
    pub motion: Traffic,
}

impl Counts {
    /// What has been counted after `earlier`, a former reading of the same meter.
    #[must_use]
    pub fn since(self, earlier: Self) -> Self {
        Self {
            sent: self.sent.since(earlier.sent),
            received: self.received.since(earlier.received),
            motion: self.motion.since(earlier.motion),
        }
    }
}

#[derive(Debug, Default)]
struct State {
    counts: Counts,
    pending: VecDeque<usize>,
}

/// Shared counters of a metered socket.
#[derive(Debug, Clone, Default)]
pub struct Meter(Arc<Mutex<State>>);

impl Meter {
    /// The counts so far.
    pub fn counts(&self) -> Counts {
        self.state().counts
    }

    /// Announces that a datagram of `len` bytes, handed to QUIC next, carries motion.
    ///
    /// QUIC puts datagrams first into a packet, so the next packet with room for it is the one.
    pub fn mark_motion(&self, len: usize) {
        let mut state = self.state();
        // More are never waiting: QUIC's own queue holds a couple and drops the oldest.
        if state.pending.len() >= 4 {
            state.pending.pop_front();
        }
        state.pending.push_back(len);
    }

    /// `socket`, counted.
    pub fn wrap(&self, socket: Arc<dyn AsyncUdpSocket>) -> Arc<dyn AsyncUdpSocket> {
        Arc::new(MeteredSocket {
            meter: self.clone(),
            socket,
        })
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.0.lock().expect("no code panics while it counts")
    }

    fn on_sent(&self, packet_len: usize) {
        let mut state = self.state();
        state.counts.sent.add(1, packet_len as u64);
        let mut room = packet_len.saturating_sub(SHORT_HEADER_AND_TAG);
        let mut carries = false;
        while let Some(&len) = state.pending.front()
            && room >= len + FRAME_HEADER
        {
            room -= len + FRAME_HEADER;
            state.pending.pop_front();
            carries = true;
        }
        if carries {
            state.counts.motion.add(1, packet_len as u64);
        }
    }
}

struct MeteredSocket {
    meter: Meter,
    socket: Arc<dyn AsyncUdpSocket>,
}

impl fmt::Debug for MeteredSocket {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.socket.fmt(f)
    }
}

impl AsyncUdpSocket for MeteredSocket {
    fn create_io_poller(self: Arc<Self>) -> Pin<Box<dyn UdpPoller>> {
        self.socket.clone().create_io_poller()
    }

    fn try_send(&self, transmit: &Transmit<'_>) -> io::Result<()> {
        self.socket.try_send(transmit)?;
        let segment = transmit
            .segment_size
            .unwrap_or(transmit.contents.len())
            .max(1);
        transmit
            .contents
            .chunks(segment)
            .for_each(|packet| self.meter.on_sent(packet.len()));
        Ok(())
    }

    fn poll_recv(
        &self,
        cx: &mut Context<'_>,
        bufs: &mut [IoSliceMut<'_>],
        meta: &mut [RecvMeta],
    ) -> Poll<io::Result<usize>> {
        let polled = self.socket.poll_recv(cx, bufs, meta);
        if let Poll::Ready(Ok(n)) = polled {
            let mut state = self.meter.state();
            for meta in &meta[..n] {
                state.counts.received.add(
                    meta.len.div_ceil(meta.stride.max(1)) as u64,
                    meta.len as u64,
                );
            }
        }
        polled
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.socket.local_addr()
    }

    fn max_transmit_segments(&self) -> usize {
        self.socket.max_transmit_segments()
    }

    fn max_receive_segments(&self) -> usize {
        self.socket.max_receive_segments()
    }

    fn may_fragment(&self) -> bool {
        self.socket.may_fragment()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_packet_counts_as_motion_if_it_has_room_for_the_marked_datagram() {
        let meter = Meter::default();
        meter.mark_motion(50);
        meter.on_sent(40);
        assert_eq!(meter.counts().motion, Traffic::default());
        meter.on_sent(50 + 24);
        meter.on_sent(50 + 24);
        assert_eq!(
            meter.counts().motion,
            Traffic {
                packets: 1,
                bytes: 74 + 28
            }
        );
        meter.mark_motion(10);
        meter.mark_motion(10);
        meter.on_sent(24 + 12 + 12);
        assert_eq!(
            meter.counts().motion.packets,
            2,
            "two datagrams in one packet"
        );
        assert_eq!(meter.counts().sent.packets, 4);
    }
}
