//! HTTP and WebSocket for the page, on a thread of its own: whatever a browser does, the daemon's thread does not wait for it.

use std::io;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::ws::{CloseFrame, Message, WebSocket, WebSocketUpgrade};
use axum::extract::{Path, Request, State};
use axum::http::header::{self, HeaderMap, HeaderValue};
use axum::http::{StatusCode, Uri};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt, StreamExt};
use serde::Serialize;
use telemime_endpoint::http::{self, Limits};
use telemime_protocol::wire::arm::WireArm;
use tokio::sync::{Semaphore, mpsc};
use tokio::time::{Instant, sleep_until, timeout};

use super::command::MAX_COMMAND_LEN;
use super::files::{FILES, File};
use super::guard::{Guard, Pass, Request as Asked, Token};
use super::{Command, Port, Said, Snapshot};

/// Connections at once; more wait.
const MAX_CONNECTIONS: usize = 64;

/// Pages at once; more are turned away.
const MAX_PAGES: usize = 8;

/// A page gets no snapshot sooner than this after the one before.
const FRAME: Duration = Duration::from_millis(25);

/// A page that takes nothing for this long is left.
const STALLED: Duration = Duration::from_secs(5);

/// A connection has this long for each request, the pause before it included.
const REQUEST: Duration = Duration::from_secs(5);

/// A page is asked whether it is still there this often …
const PING: Duration = Duration::from_secs(5);

/// … and has gone if nothing came from it for this long.
const GONE: Duration = Duration::from_secs(15);

/// A connection that is not a page by then is closed, whatever it asks.
const STAY: Duration = Duration::from_secs(60);

/// A page that is left gets this long to hear why.
const FAREWELL: Duration = Duration::from_secs(1);

/// Commands a page may say within a second; 125 of them move the hand.
const MOST_COMMANDS: u32 = 400;

/// Commands that are none, before a page is left.
const MOST_WRONG: u32 = 20;

const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Why there is no page.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The address cannot be had.
    #[error(
        "cannot serve the page at {addr}: {source}; choose another address with --console ADDR"
    )]
    Bind {
        /// Where.
        addr: SocketAddr,
        /// The system's reason.
        source: io::Error,
    },
    /// No thread, or no randomness.
    #[error("cannot serve the page: {0}")]
    System(#[from] io::Error),
}

struct Shared {
    guard: Guard,
    port: Port,
    pages: Arc<Semaphore>,
    numbers: AtomicU64,
}

/// Serves the page at `addr` until the process ends. Returns the address to open; beyond loopback it carries the token,
/// of these random bytes.
///
/// # Errors
/// [`ServeError`].
pub fn serve(addr: SocketAddr, random: [u8; 16], port: Port) -> Result<String, ServeError> {
    let limits = Limits {
        connections: MAX_CONNECTIONS,
        request: REQUEST,
        stay: STAY,
    };
    serve_within(limits, addr, random, port)
}

pub(super) fn serve_within(
    limits: Limits,
    addr: SocketAddr,
    random: [u8; 16],
    port: Port,
) -> Result<String, ServeError> {
    let bind = |source| ServeError::Bind { addr, source };
    let listener = TcpListener::bind(addr).map_err(bind)?;
    listener.set_nonblocking(true)?;
    let at = listener.local_addr()?;
    let token = (!at.ip().is_loopback()).then(|| Token::new(random));
    let url = match &token {
        Some(token) => format!("http://{at}/?token={}", token.text()),
        None => format!("http://{at}/"),
    };
    let shared = Arc::new(Shared {
        guard: Guard::new(at, token),
        port,
        pages: Arc::new(Semaphore::new(MAX_PAGES)),
        numbers: AtomicU64::new(1),
    });
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    std::thread::Builder::new()
        .name("console".into())
        .spawn(move || {
            runtime.block_on(async {
                if let Ok(listener) = tokio::net::TcpListener::from_std(listener) {
                    http::serve(listener, router(shared), limits).await;
                }
            });
        })?;
    Ok(url)
}

fn router(shared: Arc<Shared>) -> Router {
    Router::new()
        .route("/", get(|| async { file(&FILES[0]) }))
        .route("/socket", get(socket))
        .route("/{name}", get(named))
        .layer(from_fn_with_state(Arc::clone(&shared), guarded))
        .with_state(shared)
}

async fn guarded(State(shared): State<Arc<Shared>>, request: Request, next: Next) -> Response {
    let passed = {
        let headers = request.headers();
        shared.guard.judge(&Asked {
            host: text(headers, header::HOST),
            origin: text(headers, header::ORIGIN),
            cookies: text(headers, header::COOKIE),
            query: request.uri().query(),
        })
    };
    let mut response = match passed {
        Ok(Pass::Known) => next.run(request).await,
        Ok(Pass::Token) => welcomed(&shared.guard, request.uri()),
        Err(why) => (StatusCode::FORBIDDEN, format!("{why}\n")).into_response(),
    };
    let headers = response.headers_mut();
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::X_FRAME_OPTIONS, "DENY"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CACHE_CONTROL, "no-store"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    headers.insert(
        "cross-origin-resource-policy",
        HeaderValue::from_static("same-origin"),
    );
    response
}

fn text(headers: &HeaderMap, name: header::HeaderName) -> Option<&str> {
    // What is no text is no name of ours either.
    headers.get(name).map(|value| value.to_str().unwrap_or("?"))
}

/// The token becomes a cookie, so that it does not stay in the address bar and the history. Lax, or whoever follows the
/// address from a message would be asked again; that the socket is opened by our own page is the Origin's to show.
fn welcomed(guard: &Guard, uri: &Uri) -> Response {
    let cookie = guard.cookie().unwrap_or_default();
    let cookie = format!("{cookie}; HttpOnly; SameSite=Lax; Path=/");
    let headers = [
        (header::SET_COOKIE, cookie),
        (header::LOCATION, uri.path().to_owned()),
    ];
    (StatusCode::SEE_OTHER, headers).into_response()
}

fn file(file: &'static File) -> Response {
    ([(header::CONTENT_TYPE, file.kind)], file.text).into_response()
}

async fn named(Path(name): Path<String>) -> Response {
    match FILES.iter().find(|file| file.name == name) {
        Some(found) => file(found),
        None => StatusCode::NOT_FOUND.into_response(),
    }
}

async fn socket(State(shared): State<Arc<Shared>>, upgrade: WebSocketUpgrade) -> Response {
    let Ok(place) = Arc::clone(&shared.pages).try_acquire_owned() else {
        let why = "as many pages are open as there may be\n";
        return (StatusCode::SERVICE_UNAVAILABLE, Body::from(why)).into_response();
    };
    upgrade
        .max_message_size(2 * MAX_COMMAND_LEN)
        .max_frame_size(2 * MAX_COMMAND_LEN)
        .on_upgrade(move |socket| async move {
            page(&shared, socket).await;
            drop(place);
        })
}

/// One page, as long as it is there. Listening and telling do not wait for each other.
async fn page(shared: &Shared, socket: WebSocket) {
    let number = shared.numbers.fetch_add(1, Ordering::Relaxed);
    let (mut out, heard) = socket.split();
    let commands = &shared.port.commands;
    let mut ear = Ear {
        heard,
        commands,
        number,
        owes_stop: false,
    };
    // A daemon that takes nothing has more to do than to know who looks.
    let _ = commands.try_send((number, Said::Here));
    let why = tokio::select! {
        why = tell(&mut out, shared, number) => why,
        why = ear.listen() => why,
    };
    // If there is no room for it, the lease says the same.
    let _ = commands.try_send((number, Said::Gone));
    let told = async {
        if let Some(why) = why {
            let frame = CloseFrame {
                code: 1008,
                reason: why.into(),
            };
            let _ = out.send(Message::Close(Some(frame))).await;
        }
    };
    let _ = timeout(FAREWELL, async { tokio::join!(told, ear.hear_out()) }).await;
    ear.stop_if_owed().await;
}

#[derive(Serialize)]
struct Now<'a> {
    #[serde(flatten)]
    snapshot: &'a Snapshot,
    /// Whether this page holds the clutch; `None` if nobody does.
    you: Option<bool>,
}

#[derive(Serialize)]
struct Frame<'a> {
    #[serde(skip_serializing_if = "Option::is_none")]
    arm: Option<&'a WireArm>,
    now: Now<'a>,
}

async fn tell(
    out: &mut SplitSink<WebSocket, Message>,
    shared: &Shared,
    number: u64,
) -> Option<String> {
    let mut snapshots = shared.port.snapshots.clone();
    snapshots.mark_changed();
    let mut told: Option<Arc<WireArm>> = None;
    let mut ping = Instant::now() + PING;
    loop {
        let shown = tokio::select! {
            shown = snapshots.changed() => Some(shown.ok()?),
            () = sleep_until(ping) => None,
        };
        let begun = Instant::now();
        if begun >= ping {
            ping = begun + PING;
            match timeout(STALLED, out.send(Message::Ping(Bytes::new()))).await {
                Ok(Ok(())) => {}
                _ => return None,
            }
        }
        if shown.is_none() {
            continue;
        }
        let snapshot = Arc::clone(&snapshots.borrow_and_update());
        let built = snapshot.built.as_ref();
        let fresh =
            built.filter(|built| told.as_ref().is_none_or(|told| !Arc::ptr_eq(told, built)));
        let frame = Frame {
            arm: fresh.map(AsRef::as_ref),
            now: Now {
                snapshot: &snapshot,
                you: snapshot.holder.map(|holder| holder == number),
            },
        };
        let Ok(text) = serde_json::to_string(&frame) else {
            continue;
        };
        told = built.cloned();
        // While this waits, newer snapshots take each other's place.
        match timeout(STALLED, out.send(Message::text(text))).await {
            Ok(Ok(())) => {}
            Ok(Err(_)) => return None,
            Err(_) => return Some("the page takes nothing".to_owned()),
        }
        sleep_until(begun + FRAME).await;
    }
}

/// What a page says, on its way to the daemon.
struct Ear<'a> {
    heard: SplitStream<WebSocket>,
    commands: &'a mpsc::Sender<(u64, Said)>,
    number: u64,
    /// It said stop, and the daemon does not have it yet.
    owes_stop: bool,
}

impl Ear<'_> {
    /// Says why the page is to be left, if it is to be told.
    async fn listen(&mut self) -> Option<String> {
        let (mut second, mut count, mut wrong) = (Instant::now(), 0, 0);
        loop {
            let message = match timeout(GONE, self.heard.next()).await.ok()? {
                Some(Ok(message)) => message,
                // Too long, or not a WebSocket any more.
                Some(Err(e)) => return Some(e.to_string().chars().take(100).collect()),
                None => return None,
            };
            let command = match &message {
                Message::Text(text) => Some(Command::parse(text)),
                Message::Close(_) => return None,
                Message::Ping(_) | Message::Pong(_) => None,
                Message::Binary(_) => Some(Command::parse("")),
            };
            // Waits for its place, and only its own page with it; nobody says it too often.
            if let Some(Ok(Command::Stop {})) = command {
                self.owes_stop = true;
                self.stop_if_owed().await;
                continue;
            }
            if second.elapsed() >= Duration::from_secs(1) {
                (second, count) = (Instant::now(), 0);
            }
            count += 1;
            if count > MOST_COMMANDS {
                return Some(format!("more than {MOST_COMMANDS} commands in a second"));
            }
            match command {
                None => {}
                Some(Ok(command)) => self.try_say(Said::Command(command)),
                Some(Err(why)) => {
                    wrong += 1;
                    let why = why.to_string().chars().take(100).collect::<String>();
                    if wrong >= MOST_WRONG {
                        return Some(why);
                    }
                    self.try_say(Said::Wrong(why));
                }
            }
        }
    }

    /// What is still on its way from a page that is left: a stop is obeyed, and the rest only read, or the connection
    /// would be reset before the page has heard why.
    async fn hear_out(&mut self) {
        self.stop_if_owed().await;
        while let Some(Ok(message)) = self.heard.next().await {
            if let Message::Text(text) = message
                && let Ok(Command::Stop {}) = Command::parse(&text)
            {
                self.owes_stop = true;
                self.stop_if_owed().await;
            }
        }
    }

    /// Waits until there is room for it; who cancels that still owes it.
    async fn stop_if_owed(&mut self) {
        if self.owes_stop {
            let stop = Said::Command(Command::Stop {});
            drop(self.commands.send((self.number, stop)).await);
            self.owes_stop = false;
        }
    }

    /// Where there is no room the daemon is behind, and what it does not hear is not obeyed.
    fn try_say(&self, said: Said) {
        let _ = self.commands.try_send((self.number, said));
    }
}
