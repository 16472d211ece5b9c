//! Before Foxglove's server: how many viewers there are, and how long one may stand in the way.
//!
//! That server takes whoever comes, waits for ever for a greeting or a reader, and ends when files run out. Here each
//! connection is passed on to it, or left.

use std::io;
use std::net::SocketAddr;
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, copy, split};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until, timeout};

/// Viewers at once; more are turned away.
const VIEWERS: usize = 8;

/// A viewer that has not greeted by now is left.
const GREETING: Duration = Duration::from_secs(10);

/// One that has taken nothing for so long, although there is something, is left too.
const STALL: Duration = Duration::from_secs(30);

/// All that a viewer may say, bytes: thousands of subscriptions, and not what would fill the memory.
const SAID: u64 = 1 << 20;

/// What is under way to a viewer, bytes, in each of the sockets (the system doubles it): about a second of a robot's, so
/// that a viewer which is slow sees what is new.
const UNDER_WAY: u32 = 64 * 1024;

/// After an accept that failed the next one is tried this much later.
const AGAIN: Duration = Duration::from_millis(25);

/// Connections that wait to be accepted.
const WAITING: u32 = 16;

/// Listens at `addr`.
pub(super) fn listen(addr: SocketAddr) -> io::Result<TcpListener> {
    let socket = match addr {
        SocketAddr::V4(_) => TcpSocket::new_v4(),
        SocketAddr::V6(_) => TcpSocket::new_v6(),
    }?;
    socket.set_reuseaddr(true)?;
    // Those that are accepted have it too.
    socket.set_send_buffer_size(UNDER_WAY)?;
    socket.bind(addr)?;
    socket.listen(WAITING)
}

/// Passes viewers on to the server `behind`, for ever.
pub(super) async fn serve(listener: &TcpListener, behind: SocketAddr, viewers: &mut JoinSet<()>) {
    loop {
        let Ok((viewer, _)) = listener.accept().await else {
            // Too many files are open, or the viewer is gone: the next, in a moment.
            sleep_until(Instant::now() + AGAIN).await;
            continue;
        };
        while viewers.try_join_next().is_some() {}
        if viewers.len() < VIEWERS {
            viewers.spawn(async move {
                if let Ok(server) = reach(behind).await {
                    let _ = viewer.set_nodelay(true);
                    pass(viewer, server).await;
                }
            });
        }
    }
}

async fn reach(behind: SocketAddr) -> io::Result<TcpStream> {
    let socket = TcpSocket::new_v4()?;
    socket.set_recv_buffer_size(UNDER_WAY)?;
    socket.set_nodelay(true)?;
    socket.connect(behind).await
}

/// Passes on what a viewer and the server say, until one of them ends, or the viewer is left.
async fn pass<V, S>(viewer: V, server: S)
where
    V: AsyncRead + AsyncWrite,
    S: AsyncRead + AsyncWrite,
{
    let (from_viewer, to_viewer) = split(viewer);
    let (from_server, mut to_server) = split(server);
    let mut said = from_viewer.take(SAID);
    tokio::select! {
        _ = copy(&mut said, &mut to_server) => {}
        _ = show(from_server, to_viewer) => {}
    }
}

async fn show(mut from: impl AsyncRead + Unpin, mut to: impl AsyncWrite + Unpin) -> io::Result<()> {
    let mut part = vec![0; 16 * 1024];
    // The server speaks first when it has been greeted.
    let mut n = timeout(GREETING, from.read(&mut part)).await??;
    while n > 0 {
        timeout(STALL, to.write_all(&part[..n])).await??;
        n = from.read(&mut part).await?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use tokio::io::duplex;

    use super::*;

    /// A viewer's end and the server's of a connection that is passed on, with so much room under way.
    fn passed(room: usize) -> (impl AsyncRead + AsyncWrite, impl AsyncRead + AsyncWrite) {
        let ((viewer, left), (right, server)) = (duplex(room), duplex(room));
        tokio::spawn(pass(left, right));
        (viewer, server)
    }

    #[tokio::test(start_paused = true)]
    async fn what_both_say_arrives_and_a_quiet_viewer_may_stay() {
        let (mut viewer, mut server) = passed(64);
        let mut heard = [0; 5];
        viewer.write_all(b"hello").await.unwrap();
        server.read_exact(&mut heard).await.unwrap();
        assert_eq!(&heard, b"hello");
        for wait in [0, 3600] {
            sleep_until(Instant::now() + Duration::from_secs(wait)).await;
            server.write_all(b"shown").await.unwrap();
            viewer.read_exact(&mut heard).await.unwrap();
            assert_eq!(&heard, b"shown");
        }
        drop(viewer);
        assert_eq!(server.read(&mut heard).await.unwrap(), 0);
    }

    #[tokio::test(start_paused = true)]
    async fn whoever_never_greets_or_never_reads_is_left() {
        let began = Instant::now();
        let (mut viewer, _server) = passed(64);
        assert_eq!(viewer.read(&mut [0]).await.unwrap(), 0);
        assert_eq!(began.elapsed(), GREETING);

        let (_viewer, mut server) = passed(64);
        let began = Instant::now();
        let refused = loop {
            if let Err(e) = server.write_all(&[0; 64]).await {
                break e;
            }
        };
        assert_eq!(refused.kind(), io::ErrorKind::BrokenPipe);
        assert_eq!(began.elapsed(), STALL);
    }

    #[tokio::test(start_paused = true)]
    async fn a_flood_from_a_viewer_ends_its_connection() {
        let (viewer, server) = passed(4096);
        let (_from_server, mut to_server) = split(viewer);
        let (mut from_viewer, _to_viewer) = split(server);
        let flood = async {
            let mut sent = 0_u64;
            while to_server.write_all(&[0; 4096]).await.is_ok() {
                sent += 4096;
            }
            sent
        };
        let mut rest = Vec::new();
        let (sent, heard) = tokio::join!(flood, from_viewer.read_to_end(&mut rest));
        assert_eq!(heard.unwrap() as u64, SAID);
        assert!(sent <= SAID + 2 * 4096, "{sent}");
    }
}
