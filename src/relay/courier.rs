//! Hands packets over when they are due: a thread of its own, because tokio's timers round up to the millisecond.

use std::collections::BTreeMap;
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use telemime_endpoint::HostClock;
use tokio::sync::mpsc::UnboundedSender;

use super::{Fate, Passage};

/// A packet on its way.
pub(super) struct Parcel {
    /// When it arrives, ns.
    pub(super) at_ns: i64,
    pub(super) bytes: Vec<u8>,
    /// What it leaves by; a connected socket needs no address.
    pub(super) by: Arc<UdpSocket>,
    pub(super) to: Option<SocketAddr>,
    /// As it will be if the system takes it.
    pub(super) passage: Passage,
}

/// The thread, and the way to it.
pub(super) struct Courier {
    parcels: Option<Sender<Parcel>>,
    thread: Option<JoinHandle<()>>,
}

impl Courier {
    /// Begins; `done` hears of every packet that was due.
    pub(super) fn start(clock: HostClock, done: UnboundedSender<Passage>) -> Self {
        let (parcels, received) = channel();
        let thread = std::thread::spawn(move || deliver(&received, clock, &done));
        Self {
            parcels: Some(parcels),
            thread: Some(thread),
        }
    }

    /// Takes a packet over.
    pub(super) fn take(&self, parcel: Parcel) {
        if let Some(parcels) = &self.parcels {
            // It ends only with its relay.
            let _ = parcels.send(parcel);
        }
    }
}

impl Drop for Courier {
    /// Ends the thread; what was on its way is lost.
    fn drop(&mut self) {
        self.parcels = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn deliver(parcels: &Receiver<Parcel>, clock: HostClock, done: &UnboundedSender<Passage>) {
    // By time, then by order of sending.
    let mut due: BTreeMap<(i64, u64), Parcel> = BTreeMap::new();
    let mut count = 0;
    loop {
        let now = clock.now();
        while let Some(first) = due.first_entry()
            && first.key().0 <= now.0
        {
            let parcel = first.remove();
            let sent = match parcel.to {
                Some(to) => parcel.by.send_to(&parcel.bytes, to),
                None => parcel.by.send(&parcel.bytes),
            };
            let mut passage = parcel.passage;
            match sent {
                Ok(_) => passage.out = Some(clock.now()),
                Err(_) => passage.fate = Fate::Refused,
            }
            let _ = done.send(passage);
        }
        let next = match due.first_key_value() {
            None => parcels.recv().map_err(|_| RecvTimeoutError::Disconnected),
            Some(((at_ns, _), _)) => {
                let left_ns = at_ns.saturating_sub(clock.now().0).max(0);
                parcels.recv_timeout(Duration::from_nanos(left_ns as u64))
            }
        };
        match next {
            Ok(parcel) => {
                count += 1;
                due.insert((parcel.at_ns, count), parcel);
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return,
        }
    }
}
