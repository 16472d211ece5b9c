//! The server, over real sockets, by hand: what a browser would not send is sent too.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::time::Duration;

use telemime_endpoint::http::Limits;
use tokio::sync::{mpsc, watch};

use super::super::live::Port;
use super::super::server::serve_within;
use super::super::{Command, Said, ServeError, Snapshot, serve};

struct Served {
    at: String,
    token: Option<String>,
    commands: mpsc::Receiver<(u64, Said)>,
    snapshots: watch::Sender<Arc<Snapshot>>,
}

fn served(addr: &str) -> Served {
    served_with_room(addr, 64)
}

fn served_with_room(addr: &str, room: usize) -> Served {
    served_by(room, |port| serve(addr.parse().unwrap(), [7; 16], port))
}

fn served_by(room: usize, serve: impl FnOnce(Port) -> Result<String, ServeError>) -> Served {
    let (commands, heard) = mpsc::channel(room);
    let (snapshots, shown) = watch::channel(Arc::default());
    let port = Port {
        commands,
        snapshots: shown,
    };
    let url = serve(port).unwrap();
    let at = url.strip_prefix("http://").unwrap();
    let (at, rest) = at.split_once('/').unwrap();
    Served {
        at: at.replace("0.0.0.0", "127.0.0.1"),
        token: rest.strip_prefix("?token=").map(str::to_owned),
        commands: heard,
        snapshots,
    }
}

impl Served {
    fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(&self.at).unwrap();
        let patience = Some(Duration::from_secs(60));
        stream.set_read_timeout(patience).unwrap();
        stream.set_write_timeout(patience).unwrap();
        stream
    }

    /// Status line, headers and body of the answer to `GET path`.
    fn get(&self, path: &str, headers: &str) -> String {
        let mut stream = self.connect();
        let request = format!("GET {path} HTTP/1.1\r\nConnection: close\r\n{headers}\r\n");
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        answer
    }

    fn host(&self) -> String {
        format!("Host: {}\r\n", self.at)
    }

    fn socket(&self, headers: &str) -> (String, BufReader<TcpStream>) {
        let mut stream = self.connect();
        let request = format!(
            "GET /socket HTTP/1.1\r\nConnection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n\
             Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n{headers}\r\n"
        );
        stream.write_all(request.as_bytes()).unwrap();
        let mut reader = BufReader::new(stream);
        let mut status = String::new();
        reader.read_line(&mut status).unwrap();
        let mut line = String::new();
        while line != "\r\n" {
            line.clear();
            if reader.read_line(&mut line).unwrap() == 0 {
                break;
            }
        }
        (status, reader)
    }

    fn page(&self) -> BufReader<TcpStream> {
        let (status, page) = self.socket(&self.host());
        assert!(status.contains("101"), "{status}");
        page
    }
}

/// Sends a text frame, masked as a client's must be (with zeros).
fn say(page: &mut BufReader<TcpStream>, text: &str) {
    let mut frame = vec![0x81];
    match text.len() {
        len @ 0..126 => frame.push(0x80 | len as u8),
        len => {
            frame.push(0x80 | 126);
            frame.extend((len as u16).to_be_bytes());
        }
    }
    frame.extend([0; 4]);
    frame.extend(text.as_bytes());
    page.get_mut().write_all(&frame).unwrap();
}

/// The next frame: its kind and what it says.
fn frame(page: &mut BufReader<TcpStream>) -> (u8, Vec<u8>) {
    let mut head = [0; 2];
    page.read_exact(&mut head).unwrap();
    let len = match head[1] {
        126 => {
            let mut len = [0; 2];
            page.read_exact(&mut len).unwrap();
            u64::from(u16::from_be_bytes(len))
        }
        127 => {
            let mut len = [0; 8];
            page.read_exact(&mut len).unwrap();
            u64::from_be_bytes(len)
        }
        len => u64::from(len),
    };
    let mut text = vec![0; len as usize];
    page.read_exact(&mut text).unwrap();
    (head[0] & 0xf, text)
}

/// The reason a page is given when it is left.
fn farewell(page: &mut BufReader<TcpStream>) -> String {
    loop {
        let (kind, text) = frame(page);
        if kind == 8 {
            return String::from_utf8(text[2..].to_vec()).unwrap();
        }
    }
}

#[test]
fn the_page_and_all_it_needs_is_served_to_its_own_host_alone() {
    let served = served("127.0.0.1:0");
    assert_eq!(served.token, None);
    let page = served.get("/", &served.host());
    assert!(page.starts_with("HTTP/1.1 200") && page.contains("Hold to run"));
    for header in [
        "content-security-policy: default-src 'none'",
        "x-content-type-options: nosniff",
        "x-frame-options: DENY",
        "cache-control: no-store",
    ] {
        assert!(page.contains(header), "{header}");
    }
    // What the page asks for is there, whatever it is.
    for name in page
        .split(['"', '\''])
        .filter(|n| n.ends_with(".js") || n.ends_with(".css"))
    {
        let file = served.get(&format!("/{name}"), &served.host());
        assert!(file.starts_with("HTTP/1.1 200"), "{name}");
        for import in file.split("from \"./").skip(1) {
            let import = import.split('"').next().unwrap();
            let answer = served.get(&format!("/{import}"), &served.host());
            assert!(answer.starts_with("HTTP/1.1 200"), "{import}");
        }
    }
    assert!(
        served
            .get("/nothing", &served.host())
            .starts_with("HTTP/1.1 404")
    );
    for headers in [
        "Host: evil.example\r\n".to_owned(),
        format!("{}Origin: http://evil.example\r\n", served.host()),
    ] {
        for path in ["/", "/main.js", "/nothing"] {
            let refused = served.get(path, &headers);
            assert!(refused.starts_with("HTTP/1.1 403"), "{headers}{path}");
            assert!(!refused.contains("Hold to run"));
        }
        assert!(served.socket(&headers).0.contains("403"), "{headers}");
    }
}

#[test]
fn beyond_loopback_nobody_gets_in_without_the_token() {
    let served = served("0.0.0.0:0");
    let token = served.token.clone().unwrap();
    assert!(served.get("/", &served.host()).starts_with("HTTP/1.1 403"));
    assert!(served.socket(&served.host()).0.contains("403"));
    let welcomed = served.get(&format!("/?token={token}"), &served.host());
    assert!(welcomed.starts_with("HTTP/1.1 303"));
    let cookie = welcomed
        .lines()
        .find_map(|line| line.strip_prefix("set-cookie: "))
        .unwrap();
    assert!(cookie.contains("HttpOnly") && cookie.contains("SameSite=Lax"));
    let cookie = cookie.split(';').next().unwrap();
    let headers = format!("{}Cookie: {cookie}\r\n", served.host());
    assert!(served.get("/", &headers).starts_with("HTTP/1.1 200"));
    assert!(served.socket(&headers).0.contains("101"));
}

#[test]
fn commands_arrive_and_what_is_none_is_counted_until_the_page_is_left() {
    let mut served = served("127.0.0.1:0");
    let mut page = served.page();
    say(&mut page, r#"{"do":"stop"}"#);
    say(&mut page, "rm -rf /");
    assert!(matches!(
        served.commands.blocking_recv(),
        Some((_, Said::Here))
    ));
    let stop = served.commands.blocking_recv().unwrap();
    assert_eq!(stop.1, Said::Command(Command::Stop {}));
    let wrong = served.commands.blocking_recv().unwrap();
    assert!(
        matches!(&wrong.1, Said::Wrong(why) if why.contains("not a command")),
        "{wrong:?}"
    );
    for _ in 0..19 {
        say(&mut page, "{}");
    }
    assert!(farewell(&mut page).contains("not a command"));
    let said: Vec<_> = std::iter::from_fn(|| {
        served
            .commands
            .blocking_recv()
            .filter(|s| s.1 != Said::Gone)
    })
    .collect();
    assert_eq!(said.len(), 18, "and the page is gone");
}

#[test]
fn a_page_that_says_too_much_is_left() {
    let served = served("127.0.0.1:0");
    let mut page = served.page();
    say(&mut page, &"x".repeat(5000));
    // What it has not read may cost the farewell, but not the leaving.
    let mut rest = Vec::new();
    let _ = page.read_to_end(&mut rest);
    let mut page = served.page();
    for _ in 0..500 {
        say(&mut page, r#"{"do":"alive"}"#);
    }
    assert!(farewell(&mut page).contains("400 commands"));
}

/// Says goodbye as well as a page that has been left, and returns all that the daemon was to hear until it was.
fn heard_of(mut page: BufReader<TcpStream>, served: &mut Served) -> Vec<Said> {
    page.get_mut().write_all(&[0x88, 0x80, 0, 0, 0, 0]).unwrap();
    let mut rest = Vec::new();
    let _ = page.read_to_end(&mut rest);
    std::iter::from_fn(|| served.commands.try_recv().ok())
        .map(|(_, said)| said)
        .collect()
}

#[test]
fn a_stop_behind_what_a_page_is_left_for_is_obeyed() {
    let stop = Said::Command(Command::Stop {});
    for (many, what, why) in [
        (500, r#"{"do":"alive"}"#, "400 commands"),
        (25, "{}", "not a command"),
    ] {
        let mut served = served_with_room("127.0.0.1:0", 1000);
        let mut page = served.page();
        for _ in 0..many {
            say(&mut page, what);
        }
        say(&mut page, r#"{"do":"stop"}"#);
        assert!(farewell(&mut page).contains(why));
        let heard = heard_of(page, &mut served);
        assert_eq!(heard.last(), Some(&stop), "{why}");
    }
}

#[test]
fn stop_is_never_said_too_often() {
    let mut served = served_with_room("127.0.0.1:0", 1000);
    let mut page = served.page();
    for _ in 0..500 {
        say(&mut page, r#"{"do":"stop"}"#);
    }
    let heard = heard_of(page, &mut served);
    let stops = heard
        .iter()
        .filter(|said| **said == Said::Command(Command::Stop {}));
    assert_eq!(stops.count(), 500);
}

/// The page vanishes while its stop still waits for a daemon that is behind.
#[test]
fn a_stop_that_waits_outlives_its_page() {
    let mut served = served_with_room("127.0.0.1:0", 1);
    let mut page = served.page();
    say(&mut page, r#"{"do":"stop"}"#);
    frame(&mut page);
    drop(page);
    // Until its snapshots are written to nobody.
    while served.snapshots.receiver_count() > 1 {
        served.snapshots.send_replace(Arc::default());
        std::thread::yield_now();
    }
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_time()
        .build()
        .unwrap();
    let all = async {
        while let Some((_, said)) = served.commands.recv().await {
            if said == Said::Command(Command::Stop {}) {
                return;
            }
        }
    };
    let within = Duration::from_secs(30);
    let heard = runtime.block_on(async { tokio::time::timeout(within, all).await });
    assert!(heard.is_ok(), "the stop was dropped");
}

/// Nobody reads: snapshots take each other's place, and none of them waits anywhere.
#[test]
fn a_page_that_stalls_loses_snapshots_and_holds_up_nothing() {
    let mut served = served("127.0.0.1:0");
    let mut page = served.page();
    assert!(matches!(
        served.commands.blocking_recv(),
        Some((_, Said::Here))
    ));
    let filling = "x".repeat(200_000);
    let many = 400;
    for t in 1..=many {
        // Never waits, whoever reads.
        served.snapshots.send_replace(Arc::new(Snapshot {
            t: f64::from(t),
            why: filling.clone(),
            ..Snapshot::default()
        }));
    }
    // The page can still be heard …
    say(&mut page, r#"{"do":"stop"}"#);
    let stop = served.commands.blocking_recv().unwrap();
    assert_eq!(stop.1, Said::Command(Command::Stop {}));
    // … and when it reads again it soon has the newest.
    let (mut seen, mut newest) = (0, 0.0);
    while newest < f64::from(many) {
        let (_, text) = frame(&mut page);
        let told: serde_json::Value = serde_json::from_slice(&text).unwrap();
        newest = told["now"]["t"].as_f64().unwrap();
        seen += 1;
    }
    assert!(seen < many / 4, "{seen} of {many} were kept for it");
}

#[test]
fn a_stop_waits_for_its_place_where_all_else_is_lost() {
    let mut served = served_with_room("127.0.0.1:0", 1);
    let mut page = served.page();
    for _ in 0..5 {
        say(&mut page, r#"{"do":"alive"}"#);
    }
    say(&mut page, r#"{"do":"stop"}"#);
    let mut said = std::iter::from_fn(|| served.commands.blocking_recv());
    assert!(
        said.any(|(_, said)| said == Said::Command(Command::Stop {})),
        "the page is still there, so this ends with the stop"
    );
}

#[test]
fn who_connects_and_asks_for_nothing_keeps_nobody_out() {
    let served = served("127.0.0.1:0");
    let idle: Vec<_> = (0..64).map(|_| served.connect()).collect();
    assert!(served.get("/", &served.host()).starts_with("HTTP/1.1 200"));
    drop(idle);
}

/// All places are taken by who asks and asks and reads no answer; a page is none of them.
#[test]
fn who_reads_no_answer_keeps_nobody_out_and_a_page_may_stay() {
    let limits = Limits {
        connections: 2,
        request: Duration::from_secs(5),
        stay: Duration::from_millis(300),
    };
    let served = served_by(64, |port| {
        serve_within(limits, "127.0.0.1:0".parse().unwrap(), [7; 16], port)
    });
    let mut page = served.page();
    let asks = format!("GET / HTTP/1.1\r\n{}\r\n", served.host());
    let asking: Vec<_> = (0..limits.connections)
        .map(|_| {
            let (mut stream, asks) = (served.connect(), asks.clone());
            std::thread::spawn(move || while stream.write_all(asks.as_bytes()).is_ok() {})
        })
        .collect();
    for asking in asking {
        asking.join().unwrap();
    }
    assert!(served.get("/", &served.host()).starts_with("HTTP/1.1 200"));
    served.snapshots.send_replace(Arc::new(Snapshot {
        t: 7.0,
        ..Snapshot::default()
    }));
    let mut told = String::new();
    while !told.contains(r#""t":7.0"#) {
        told = String::from_utf8(frame(&mut page).1).unwrap();
    }
}

#[test]
fn pages_are_few() {
    let served = served("127.0.0.1:0");
    let pages: Vec<_> = (0..8).map(|_| served.page()).collect();
    assert!(served.socket(&served.host()).0.contains("503"));
    drop(pages);
}
