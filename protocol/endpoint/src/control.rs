//! The control stream: a greeting each way, then frames.

use std::time::Duration;

use quinn::{Connection, RecvStream, SendStream, VarInt};
use telemime_protocol::wire::DecodeError;
use telemime_protocol::wire::frame::{self, Deframer, Frame};
use telemime_protocol::wire::hello::{self, Answer, Hello, HelloError};
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio::time::{Instant, timeout};

use crate::quic;

/// A peer that connects but does not greet within this time is let go.
pub const GREETING_TIMEOUT: Duration = Duration::from_secs(5);

/// Frames read ahead of the session; a slow session pushes back on the stream, not on memory.
const READ_AHEAD: usize = 4;

/// Why the control stream ended.
#[derive(Debug, thiserror::Error)]
pub enum ControlError {
    /// The connection ended.
    #[error("{}", quic::explain(.0))]
    Connection(#[from] quinn::ConnectionError),
    /// The stream was reset or closed under us.
    #[error("control stream: {0}")]
    Stream(String),
    /// The peer said nothing in time.
    #[error("the peer did not greet within {} s", GREETING_TIMEOUT.as_secs())]
    Silent,
    /// The greeting was none.
    #[error("greeting: {0}")]
    Hello(#[from] HelloError),
    /// The peer leaves what we say unread, or is gone.
    #[error("the peer does not read what is sent")]
    Unread,
    /// A frame was malformed.
    #[error("control message: {0}")]
    Frame(#[from] DecodeError),
}

/// Both directions of an open control stream, greetings still to come.
#[derive(Debug)]
pub struct Control {
    /// Towards the peer.
    pub send: SendStream,
    connection: Connection,
    recv: RecvStream,
    read: Vec<u8>,
}

impl Control {
    /// Opens the stream (operator).
    ///
    /// # Errors
    /// [`ControlError::Connection`].
    pub async fn open(connection: &Connection) -> Result<Self, ControlError> {
        let (send, recv) = connection.open_bi().await?;
        Ok(Self {
            send,
            connection: connection.clone(),
            recv,
            read: Vec::new(),
        })
    }

    /// Waits for the stream (robot).
    ///
    /// # Errors
    /// [`ControlError`], also if the peer opens none in time.
    pub async fn accept(connection: &Connection) -> Result<Self, ControlError> {
        let (send, recv) = timeout(GREETING_TIMEOUT, connection.accept_bi())
            .await
            .map_err(|_| ControlError::Silent)??;
        Ok(Self {
            send,
            connection: connection.clone(),
            recv,
            read: Vec::new(),
        })
    }

    /// Reads the operator's greeting.
    ///
    /// # Errors
    /// [`ControlError`].
    pub async fn hello(&mut self) -> Result<Hello, ControlError> {
        self.greeting(Hello::decode).await
    }

    /// Reads the robot's answer.
    ///
    /// # Errors
    /// [`ControlError`].
    pub async fn answer(&mut self) -> Result<Answer, ControlError> {
        self.greeting(Answer::decode).await
    }

    /// Writes raw bytes: a greeting.
    ///
    /// # Errors
    /// [`ControlError::Stream`].
    pub async fn write(&mut self, bytes: &[u8]) -> Result<(), ControlError> {
        self.send
            .write_all(bytes)
            .await
            .map_err(|e| ControlError::Stream(e.to_string()))
    }

    /// Greetings are over: frames arrive on the receiver, after whose last item the stream has ended.
    pub fn into_frames(self) -> (Writer, mpsc::Receiver<Result<Frame, ControlError>>) {
        let (tx, rx) = mpsc::channel(READ_AHEAD);
        tokio::spawn(read_frames(self.recv, self.read, tx));
        (Writer::start(self.connection, self.send), rx)
    }

    async fn greeting<T>(
        &mut self,
        decode: impl Fn(&[u8]) -> Result<Option<(T, usize)>, HelloError>,
    ) -> Result<T, ControlError> {
        let read = async {
            loop {
                if let Some((greeting, used)) = decode(&self.read)? {
                    self.read.drain(..used);
                    return Ok(greeting);
                }
                let mut buffer = [0; hello::MAX_LEN];
                match self.recv.read(&mut buffer).await {
                    Ok(Some(n)) => self.read.extend_from_slice(&buffer[..n]),
                    Ok(None) => {
                        return Err(ControlError::Stream("ended before the greeting".into()));
                    }
                    Err(quinn::ReadError::ConnectionLost(e)) => return Err(e.into()),
                    Err(e) => return Err(ControlError::Stream(e.to_string())),
                }
            }
        };
        timeout(GREETING_TIMEOUT, read)
            .await
            .map_err(|_| ControlError::Silent)?
    }
}

/// Messages a peer may leave unread before the session is given up.
const MAX_UNREAD: usize = 256;

/// The sending half, written by a task of its own: a peer that does not read, or a model that takes its
/// time on a thin link, holds up nobody.
#[derive(Debug)]
pub struct Writer {
    queue: mpsc::Sender<Vec<u8>>,
    written: JoinHandle<bool>,
}

impl Writer {
    /// Starts writing to `send`, a stream of `connection`.
    pub fn start(connection: Connection, send: SendStream) -> Self {
        let (queue, due) = mpsc::channel(MAX_UNREAD);
        let written = tokio::spawn(write(connection, send, due));
        Self { queue, written }
    }

    /// Queues raw bytes: a greeting.
    ///
    /// # Errors
    /// [`ControlError::Unread`] if the peer has left too much unread, or is gone.
    pub fn raw(&self, bytes: Vec<u8>) -> Result<(), ControlError> {
        self.queue.try_send(bytes).map_err(|_| ControlError::Unread)
    }

    /// Queues a message as a frame.
    ///
    /// # Errors
    /// As [`Writer::raw`].
    pub fn message(&self, payload: &[u8]) -> Result<(), ControlError> {
        self.raw(frame::encode(payload, false))
    }

    /// Writes what is queued, ends the stream and waits for the peer to have it, but no longer than `within`. Says
    /// whether the peer has it: it acknowledged all, or ended the connection on purpose.
    pub async fn finish(self, within: Duration) -> bool {
        drop(self.queue);
        matches!(timeout(within, self.written).await, Ok(Ok(true)))
    }
}

/// Says whether the peer has it all.
async fn write(
    connection: Connection,
    mut send: SendStream,
    mut due: mpsc::Receiver<Vec<u8>>,
) -> bool {
    let delivered = async {
        while let Some(bytes) = due.recv().await {
            if bytes.len() > LONG {
                write_long(&connection, &mut send, &bytes).await
            } else {
                send.write_all(&bytes).await
            }
            .ok()?;
        }
        send.finish().ok()?;
        send.stopped().await.ok()
    };
    match delivered.await {
        Some(stopped) => stopped.is_none(),
        None => matches!(
            connection.close_reason(),
            Some(quinn::ConnectionError::ApplicationClosed(close)) if close.error_code == GOODBYE
        ),
    }
}

/// Application close code of a peer that has no more to hear (docs/protocol.md §1).
const GOODBYE: VarInt = VarInt::from_u32(0);

/// A message longer than this is a model or a plan.
const LONG: usize = 4 * 1024;

/// It is handed over in pieces of this length …
const PIECE: usize = 1024;

/// … so that no more of it is under way than the link carries in this time: what is behind it in the queue, the answers to the robot's
/// clock and a stop, must not wait longer, and QUIC must not take the queue for loss and send it all again.
const UNDER_WAY: Duration = Duration::from_millis(600);

/// On a link whose handshake was answered within this, the first pieces take no time.
const BRISK: Duration = Duration::from_millis(300);

/// The least under way: three packets.
const LEAST_WINDOW: u64 = 4 * 1024;

/// Writes what may be long on a thin link. How fast QUIC takes it, once the window is full, is how fast the link carries it.
async fn write_long(
    connection: &Connection,
    send: &mut SendStream,
    bytes: &[u8],
) -> Result<(), quinn::WriteError> {
    let mut window = if connection.rtt() < BRISK {
        quic::SEND_WINDOW
    } else {
        LEAST_WINDOW
    };
    connection.set_send_window(window);
    let (mut taken, mut full_since) = (0, None::<Instant>);
    for piece in bytes.chunks(PIECE) {
        send.write_all(piece).await?;
        taken += piece.len() as u64;
        if taken < window {
            continue;
        }
        let now = Instant::now();
        // The first round only filled the window.
        if let Some(since) = full_since {
            let took_s = (now - since).as_secs_f64().max(1e-3);
            let carried = taken as f64 / took_s * UNDER_WAY.as_secs_f64();
            window = (carried as u64).clamp(LEAST_WINDOW, quic::SEND_WINDOW);
            connection.set_send_window(window);
        }
        (taken, full_since) = (0, Some(now));
    }
    connection.set_send_window(quic::SEND_WINDOW);
    Ok(())
}

async fn read_frames(
    mut recv: RecvStream,
    read: Vec<u8>,
    tx: mpsc::Sender<Result<Frame, ControlError>>,
) {
    let mut deframer = Deframer::default();
    deframer.push(&read);
    let mut buffer = vec![0; 16 * 1024];
    loop {
        loop {
            match deframer.next_frame() {
                Ok(Some(frame)) => {
                    if tx.send(Ok(frame)).await.is_err() {
                        return;
                    }
                }
                Ok(None) => break,
                Err(e) => {
                    let _ = tx.send(Err(e.into())).await;
                    return;
                }
            }
        }
        let end = match recv.read(&mut buffer).await {
            Ok(Some(n)) => {
                deframer.push(&buffer[..n]);
                continue;
            }
            Ok(None) => ControlError::Stream("ended by the peer".into()),
            Err(quinn::ReadError::ConnectionLost(e)) => e.into(),
            Err(e) => ControlError::Stream(e.to_string()),
        };
        // Nobody listening means the session is over already.
        let _ = tx.send(Err(end)).await;
        return;
    }
}

#[cfg(test)]
mod tests {
    use std::net::{Ipv4Addr, SocketAddr};

    use super::*;
    use crate::identity::Identity;
    use crate::meter::Meter;
    use crate::trust::Trust;

    fn socket() -> quic::Socket {
        quic::Socket::bind(SocketAddr::from((Ipv4Addr::LOCALHOST, 0))).unwrap()
    }

    /// Whether what was written counts as heard by a peer that reads nothing of it and closes with `code`.
    async fn heard(code: u32) -> bool {
        let [ours, theirs] = [(); 2].map(|()| Identity::ephemeral().unwrap());
        let trust = |peer: &Identity| Trust::new([peer.fingerprint()]);
        let meter = Meter::default();
        let robot = quic::server(&theirs, trust(&ours), socket(), &meter).unwrap();
        let operator = quic::client(&ours, trust(&theirs), socket(), &meter).unwrap();
        let dialled = async {
            let connecting = operator.connect(robot.local_addr().unwrap(), "telemime");
            connecting.unwrap().await.unwrap()
        };
        let accepted = async { robot.accept().await.unwrap().await.unwrap() };
        let (connection, accepted) = tokio::join!(dialled, accepted);
        let (writer, _frames) = Control::open(&connection).await.unwrap().into_frames();
        // More than may be under way: some of it is never acknowledged.
        writer.raw(vec![0; 1024 * 1024]).unwrap();
        let control = Control::accept(&accepted).await.unwrap();
        accepted.close(VarInt::from_u32(code), b"");
        drop(control);
        writer.finish(Duration::from_secs(60)).await
    }

    #[tokio::test]
    async fn only_a_goodbye_says_that_all_is_heard() {
        assert!(heard(0).await, "it has no more to hear");
        for code in [1, 5, 9] {
            assert!(!heard(code).await, "{code}");
        }
    }
}
