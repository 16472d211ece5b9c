//! What reads a source on a thread of its own: lines and datagrams in, frames out.

use std::io::{self, BufRead, BufReader, Read};
use std::net::{IpAddr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;

use telemime_endpoint::{HostClock, Mono};
use telemime_protocol::time::Stamp;
use tokio::sync::mpsc;

#[cfg(feature = "gamepad")]
use super::device::{Device, DeviceError};
use super::frame::{self, LONGEST, Units};
use super::{Arrived, Fault, Kind, Source, What, stick, watch};
use crate::depth::{Camera, CameraError, Finder, Folder, FolderError, Intrinsics, Size};
use crate::ingest::{FPS, LengthUnit};
use crate::session::LOST_S;

/// Frames that wait for the daemon; what is beyond is dropped.
const WAITING: usize = 256;

/// More frames than this are decoded neither, 1/s: no hand needs them.
const MOST_HZ: f64 = 1000.0;

/// So many may come at once after a pause.
const BURST: f64 = 250.0;

/// Why a source cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The address cannot be bound.
    #[error("cannot listen for the hand on udp:{addr}: {source}; choose another port")]
    Bind {
        /// The address.
        addr: SocketAddr,
        /// The system's reason.
        source: io::Error,
    },
    /// Whoever can send to this address would drive the arm.
    #[error(
        "whoever can send to udp:{addr} would drive the arm: name the sender's address (--input-from), or listen on 127.0.0.1"
    )]
    Open {
        /// The address.
        addr: SocketAddr,
    },
    /// The frames cannot be read.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// Frames of a size that none can be.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// Raw frames do not say how large they are.
    #[error("how large is a depth frame? Give --frame-size WIDTHxHEIGHT")]
    Size,
    /// The device cannot be used.
    #[cfg(feature = "gamepad")]
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// None was named.
    #[error("which gamepad or SpaceMouse? `--input evdev:` lists them")]
    NoDevice,
    /// This program was built without them.
    #[error(
        "gamepads and SpaceMice are not in this build: `cargo build --release --features gamepad` makes one with them"
    )]
    NotBuilt,
    /// No thread.
    #[error("no thread to read the input with: {0}")]
    Thread(io::Error),
}

/// What is to be read, and what its numbers mean.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Settings {
    /// The only address of a UDP sender that is heard.
    pub from: Option<IpAddr>,
    /// Of lines.
    pub units: Units,
    /// Of depth frames.
    pub depth: Depth,
    /// Of a gamepad or SpaceMouse.
    pub stick: stick::Manner,
}

/// What depth frames are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Depth {
    /// Their size, where they do not say it themselves.
    pub size: Option<Size>,
    /// The camera's; none, a Kinect's.
    pub at: Option<Intrinsics>,
    /// Of a count.
    pub unit: LengthUnit,
    /// The person's right hand is on the left.
    pub mirror: bool,
    /// Of a folder, Hz.
    pub fps: f64,
}

impl Default for Depth {
    fn default() -> Self {
        Self {
            size: None,
            at: None,
            unit: LengthUnit::Mm,
            mirror: false,
            fps: FPS,
        }
    }
}

impl Depth {
    fn finder(&self, size: Size) -> Result<Finder, CameraError> {
        let camera = Camera::new(size, self.at, self.unit.metres(), self.mirror)?;
        Ok(Finder::new(camera))
    }
}

/// The session clock: what stamps arrivals.
#[derive(Debug, Clone, Copy)]
pub struct Clock {
    /// The host's.
    pub host: HostClock,
    /// Its zero.
    pub epoch: Mono,
}

impl Clock {
    /// What it shows.
    pub fn now(&self) -> Stamp {
        Stamp(self.host.now().0 - self.epoch.0)
    }
}

/// Tells the time of the session.
pub type Now = Box<dyn Fn() -> Stamp + Send>;

/// Where a thread puts what it reads.
pub struct Outlet {
    tx: mpsc::Sender<Arrived>,
    overflow: Arc<AtomicU64>,
    now: Now,
    tokens: f64,
    filled: Option<Stamp>,
}

/// The daemon's end.
#[derive(Debug)]
pub struct Inlet {
    /// What was read.
    pub arrived: mpsc::Receiver<Arrived>,
    /// Frames that were not even decoded, or found no room.
    pub overflow: Arc<AtomicU64>,
    /// A recording begins when this is dropped: once there is a robot to drive.
    pub go: Option<std::sync::mpsc::Sender<()>>,
}

/// A way from a reading thread to the daemon; what goes through is stamped by `now`.
pub fn channel(now: Now) -> (Outlet, Inlet) {
    let (tx, arrived) = mpsc::channel(WAITING);
    let overflow = Arc::<AtomicU64>::default();
    let outlet = Outlet {
        tx,
        overflow: Arc::clone(&overflow),
        now,
        tokens: BURST,
        filled: None,
    };
    let inlet = Inlet {
        arrived,
        overflow,
        go: None,
    };
    (outlet, inlet)
}

impl Outlet {
    /// Whether one more frame may be decoded now; counts it if not.
    fn admits(&mut self, now: Stamp) -> bool {
        let since_s = self
            .filled
            .replace(now)
            .map_or(0.0, |at| now.secs_since(at));
        self.tokens = (self.tokens + since_s * MOST_HZ).min(BURST);
        if self.tokens < 1.0 {
            self.overflow.fetch_add(1, Ordering::Relaxed);
            return false;
        }
        self.tokens -= 1.0;
        true
    }

    /// The time of the session.
    pub(super) fn now(&self) -> Stamp {
        (self.now)()
    }

    /// Hands over; whether anybody is there to take it.
    pub(super) fn put(&self, at: Stamp, what: What) -> bool {
        match self.tx.try_send(Arrived { at, what }) {
            Ok(()) => true,
            Err(mpsc::error::TrySendError::Full(_)) => {
                self.overflow.fetch_add(1, Ordering::Relaxed);
                true
            }
            Err(mpsc::error::TrySendError::Closed(_)) => false,
        }
    }

    fn line(&mut self, line: &[u8], units: &Units) -> bool {
        let at = self.now();
        if line.trim_ascii().is_empty() || !self.admits(at) {
            return true;
        }
        let what = frame::parse(line, units).map_or_else(What::Dropped, What::Frame);
        self.put(at, what)
    }

    /// Says that there will be no more, however full the way is.
    pub(super) fn end(self, why: String) {
        let at = self.now();
        // A daemon that is gone need not know.
        let _ = self.tx.blocking_send(Arrived {
            at,
            what: What::End(why),
        });
    }
}

/// Reads lines until their end.
pub fn lines(source: impl Read, units: &Units, mut to: Outlet) {
    let mut source = BufReader::new(source);
    let mut line = Vec::new();
    loop {
        line.clear();
        let limit = LONGEST as u64 + 2;
        match source.by_ref().take(limit).read_until(b'\n', &mut line) {
            Ok(0) => return to.end("nothing more to read".into()),
            Ok(_) => {}
            Err(e) if e.kind() == io::ErrorKind::Interrupted => continue,
            Err(e) => return to.end(e.to_string()),
        }
        let whole = line.last() == Some(&b'\n');
        let kept = line.strip_suffix(b"\n").unwrap_or(&line);
        if !to.line(kept, units) {
            return;
        }
        // The rest of one that is too long is no frame of its own.
        if !whole && line.len() as u64 == limit && skip_line(&mut source).is_err() {
            return to.end("it cannot be read".into());
        }
    }
}

fn skip_line(source: &mut impl BufRead) -> io::Result<()> {
    loop {
        let buffer = source.fill_buf()?;
        let end = buffer.iter().position(|b| *b == b'\n');
        let (n, done) = match end {
            Some(at) => (at + 1, true),
            None => (buffer.len(), buffer.is_empty()),
        };
        source.consume(n);
        if done {
            return Ok(());
        }
    }
}

/// Reads datagrams, one or more lines each; until the other end is gone. One sender drives at a time: another is heard
/// only after silence for as long as makes a source lost.
fn datagrams(socket: &UdpSocket, from: Option<IpAddr>, units: &Units, mut to: Outlet) {
    let mut buffer = vec![0; LONGEST + 1];
    let mut drives: Option<(SocketAddr, Stamp)> = None;
    loop {
        // What the system reports here are earlier answers that found nobody: no reason to stop listening.
        let Ok((n, peer)) = socket.recv_from(&mut buffer) else {
            continue;
        };
        let now = to.now();
        let strange = from.is_some_and(|from| from != peer.ip())
            || drives.is_some_and(|(addr, heard)| addr != peer && now.secs_since(heard) < LOST_S);
        let going = if strange {
            let why = format!("it comes from {peer}");
            !to.admits(now) || to.put(now, What::Dropped(Fault::new(Kind::Stranger, why)))
        } else {
            drives = Some((peer, now));
            if n > LONGEST {
                to.put(now, What::Dropped(frame::oversized()))
            } else {
                let mut lines = buffer[..n].split(|b| *b == b'\n');
                lines.all(|line| to.line(line, units))
            }
        };
        if !going {
            return;
        }
    }
}

/// Opens `source` and reads it on a thread of its own. Returns what to take from and how the source is called now.
///
/// # Errors
/// [`OpenError`].
pub fn open(
    source: &Source,
    settings: Settings,
    clock: Clock,
) -> Result<(Inlet, String), OpenError> {
    let (to, mut inlet) = channel(Box::new(move || clock.now()));
    let Settings {
        from,
        units,
        depth,
        stick,
    } = settings;
    let mut name = source.to_string();
    let read: Box<dyn FnOnce() + Send> = match source {
        Source::Stdin => Box::new(move || lines(io::stdin(), &units, to)),
        Source::Udp(addr) => {
            let addr = *addr;
            if !addr.ip().is_loopback() && from.is_none() {
                return Err(OpenError::Open { addr });
            }
            let bind = |source| OpenError::Bind { addr, source };
            let socket = UdpSocket::bind(addr).map_err(bind)?;
            name = Source::Udp(socket.local_addr().map_err(bind)?).to_string();
            Box::new(move || datagrams(&socket, from, &units, to))
        }
        Source::DepthStdin => {
            let finder = depth.finder(depth.size.ok_or(OpenError::Size)?)?;
            Box::new(move || watch::stream(io::stdin(), finder, to))
        }
        Source::DepthFolder(path) => {
            let folder = Folder::open(path)?;
            let finder = depth.finder(folder.size())?;
            let (go, begin) = std::sync::mpsc::channel();
            inlet.go = Some(go);
            Box::new(move || watch::folder(&folder, finder, depth.fps, &begin, to))
        }
        Source::Evdev(None) => return Err(OpenError::NoDevice),
        #[cfg(feature = "gamepad")]
        Source::Evdev(Some(path)) => {
            let (mut device, stick, called) = Device::open(path, stick)?;
            name = called;
            Box::new(move || stick::follow(stick, |stick, now| device.read(stick, now), to))
        }
        #[cfg(not(feature = "gamepad"))]
        Source::Evdev(Some(_)) => {
            let _ = stick;
            return Err(OpenError::NotBuilt);
        }
    };
    // Never joined: a blocking read cannot be cancelled, and ends with the process.
    thread::Builder::new()
        .name("input".into())
        .spawn(read)
        .map_err(OpenError::Thread)?;
    Ok((inlet, name))
}
