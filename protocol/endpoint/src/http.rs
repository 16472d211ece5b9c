//! HTTP for the pages that daemons serve: a bounded number of connections, and none that only stands there.

use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;
use tokio::time::{Instant, sleep_until, timeout};

/// After an accept that failed the next one is tried this much later.
const AGAIN: Duration = Duration::from_millis(25);

/// How much is served at once, and for how long.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Connections at once; more wait.
    pub connections: usize,
    /// A connection that has not asked for anything by now is left.
    pub request: Duration,
    /// A connection ends after this, whatever its peer does, unless it has become another protocol's by then (a
    /// WebSocket): that one is its handler's to end.
    pub stay: Duration,
}

/// Serves `router` on `listener`, for ever.
pub async fn serve(listener: TcpListener, router: Router, limits: Limits) {
    let places = Arc::new(Semaphore::new(limits.connections));
    loop {
        let place = Arc::clone(&places).acquire_owned().await;
        let (Ok(place), Ok((stream, _))) = (place, listener.accept().await) else {
            // Too many files are open, or the peer is gone: the next, in a moment.
            sleep_until(Instant::now() + AGAIN).await;
            continue;
        };
        let _ = stream.set_nodelay(true);
        let service = TowerToHyperService::new(router.clone());
        tokio::spawn(async move {
            let connection = http1::Builder::new()
                .timer(TokioTimer::new())
                .header_read_timeout(limits.request)
                .serve_connection(TokioIo::new(stream), service)
                .with_upgrades();
            let _ = timeout(limits.stay, connection).await;
            drop(place);
        });
    }
}
