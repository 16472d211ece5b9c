//! Foxglove's server, and ours before it, on a thread of their own.

use std::collections::BTreeMap;
use std::io;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::{Arc, mpsc};
use std::thread::JoinHandle;
use std::time::Duration;

use foxglove::websocket::ShutdownHandle;
use foxglove::{ChannelBuilder, Context, Encode, PartialMetadata, RawChannel};
use foxglove::{WebSocketServer, WebSocketServerHandle};
use tokio::net::TcpListener;
use tokio::sync::oneshot;
use tokio::task::JoinSet;
use tokio::time::timeout;

use super::{LiveError, front};
use crate::recording::{At, nanos};

/// Messages that wait for one viewer, at most: a second of them. The oldest make room.
const BACKLOG: usize = 512;

/// So long viewers are given to take their leave.
const GOODBYE: Duration = Duration::from_millis(500);

/// What viewers are served from; dropping it sends them away.
pub(in crate::recording) struct Live {
    addr: SocketAddr,
    context: Arc<Context>,
    channels: BTreeMap<&'static str, Arc<RawChannel>>,
    server: Option<WebSocketServerHandle>,
    stop: Option<oneshot::Sender<ShutdownHandle>>,
    thread: Option<JoinHandle<()>>,
}

impl Live {
    /// Listens at `addr` for viewers of what the daemon `role` does.
    pub(in crate::recording) fn start(addr: SocketAddr, role: &str) -> Result<Self, LiveError> {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()?;
        let context = Context::new();
        // No capabilities: nothing is taken from viewers but what they want to see.
        let server = WebSocketServer::new()
            .context(&context)
            .name(format!("telemime {role}"))
            .message_backlog_size(BACKLOG)
            .bind(Ipv4Addr::LOCALHOST.to_string(), 0);
        let (tx, begun) = mpsc::sync_channel(1);
        let (stop, stopped) = oneshot::channel();
        // Whoever calls may be in a runtime of its own, where nobody may wait for another.
        let thread = std::thread::Builder::new()
            .name("viewers".into())
            .spawn(move || {
                runtime.block_on(async {
                    let (listener, begun) = match begin(addr, server).await {
                        Ok((listener, at, server)) => {
                            let behind = (Ipv4Addr::LOCALHOST, server.port());
                            (Some((listener, behind.into())), Ok((at, server)))
                        }
                        Err(e) => (None, Err(e)),
                    };
                    // If it has not been waited for, `stopped` is over too.
                    let _ = tx.send(begun);
                    if let Some((listener, behind)) = listener {
                        serve(listener, behind, stopped).await;
                    }
                });
            })?;
        let begun = begun.recv().map_err(|_| io::ErrorKind::Other.into());
        let (at, server) = begun.map_err(LiveError::System)??;
        Ok(Self {
            addr: at,
            context,
            channels: BTreeMap::new(),
            server: Some(server),
            stop: Some(stop),
            thread: Some(thread),
        })
    }

    /// Where viewers connect.
    pub(in crate::recording) fn addr(&self) -> SocketAddr {
        self.addr
    }

    /// Shows a message to whoever wants the topic: a `T`, as it is encoded. Never waits for a viewer.
    pub(in crate::recording) fn message<T: Encode>(
        &mut self,
        topic: &'static str,
        at: At,
        encoded: &[u8],
    ) {
        let channel = self.channels.entry(topic).or_insert_with(|| {
            ChannelBuilder::new(topic)
                .context(&self.context)
                .message_encoding(T::get_message_encoding())
                .schema(T::get_schema())
                .build_raw()
                .expect("every message has an encoding")
        });
        channel.log_with_meta(encoded, PartialMetadata::with_log_time(nanos(at.log)));
    }

    /// What comes now is on another clock: viewers forget what they have.
    pub(in crate::recording) fn another(&mut self) {
        for (_, channel) in std::mem::take(&mut self.channels) {
            channel.close();
        }
        if let Some(server) = &self.server {
            server.clear_session(None);
        }
    }
}

impl Drop for Live {
    fn drop(&mut self) {
        if let (Some(server), Some(stop)) = (self.server.take(), self.stop.take()) {
            // If nobody hears it, the thread is over already.
            let _ = stop.send(server.stop());
        }
        if let Some(thread) = self.thread.take() {
            // If it panicked, the message is already on stderr.
            let _ = thread.join();
        }
    }
}

async fn begin(
    addr: SocketAddr,
    server: WebSocketServer,
) -> Result<(TcpListener, SocketAddr, WebSocketServerHandle), LiveError> {
    let listener = front::listen(addr).map_err(|source| LiveError::Bind { addr, source })?;
    let at = listener.local_addr()?;
    Ok((listener, at, server.start().await?))
}

async fn serve(
    listener: TcpListener,
    behind: SocketAddr,
    stopped: oneshot::Receiver<ShutdownHandle>,
) {
    let mut viewers = JoinSet::new();
    let leaving = tokio::select! {
        () = front::serve(&listener, behind, &mut viewers) => return,
        leaving = stopped => leaving,
    };
    if let Ok(leaving) = leaving {
        let gone = async {
            leaving.wait().await;
            while viewers.join_next().await.is_some() {}
        };
        // Whoever reads nothing is left.
        let _ = timeout(GOODBYE, gone).await;
    }
}
