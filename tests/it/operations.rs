//! What keeps the daemons running: metrics, logs, a supervisor, a doctor.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::os::unix::net::UnixDatagram;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

use crate::processes::{Process, Stage, alone};

const PATIENCE: Duration = Duration::from_secs(120);

fn get(addr: &str, path: &str) -> (String, String) {
    let mut stream = TcpStream::connect(addr).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    write!(
        stream,
        "GET {path} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n"
    )
    .unwrap();
    let mut text = String::new();
    stream.read_to_string(&mut text).unwrap();
    let (head, body) = text.split_once("\r\n\r\n").unwrap();
    (head.to_owned(), body.to_owned())
}

/// The address of a daemon's metrics, from its event.
fn metrics_of(daemon: &Process) -> String {
    let url = daemon.event("metrics")["url"].as_str().unwrap().to_owned();
    url.trim_start_matches("http://")
        .trim_end_matches("/metrics")
        .to_owned()
}

/// Names and types, and the samples by name and labels; the page is held against the format on the way.
fn parsed(page: &str) -> (BTreeMap<String, String>, BTreeMap<String, f64>) {
    let (mut types, mut samples) = (BTreeMap::new(), BTreeMap::new());
    let mut helped = BTreeSet::new();
    for line in page.lines() {
        if let Some(rest) = line.strip_prefix("# HELP ") {
            let (name, help) = rest.split_once(' ').unwrap();
            assert!(
                helped.insert(name.to_owned()) && help.ends_with('.') || help.contains("always 1"),
                "{line}"
            );
        } else if let Some(rest) = line.strip_prefix("# TYPE ") {
            let (name, kind) = rest.split_once(' ').unwrap();
            assert!(helped.contains(name), "{line}");
            assert_eq!(kind == "counter", name.ends_with("_total"), "{line}");
            types.insert(name.to_owned(), kind.to_owned());
        } else {
            let (what, value) = line.rsplit_once(' ').unwrap();
            let name = what.split('{').next().unwrap();
            assert!(types.contains_key(name), "{line}");
            assert!(
                samples
                    .insert(what.to_owned(), value.parse().unwrap())
                    .is_none(),
                "{line}"
            );
        }
    }
    (types, samples)
}

/// The names that the document lists for a daemon.
fn documented(prefix: &str) -> BTreeSet<String> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/operations.md");
    let text = std::fs::read_to_string(path).unwrap();
    let rows = text.lines().filter_map(|line| line.strip_prefix("| `"));
    rows.filter_map(|row| row.split('`').next())
        .map(|name| name.split('{').next().unwrap().to_owned())
        .filter(|name| name.starts_with(prefix))
        .collect()
}

/// Reads until a page says what is wanted.
fn until(
    addr: &str,
    wanted: impl Fn(&BTreeMap<String, f64>) -> bool,
) -> (BTreeMap<String, String>, BTreeMap<String, f64>) {
    let begun = std::time::Instant::now();
    loop {
        let (head, body) = get(addr, "/metrics");
        assert!(
            head.starts_with("HTTP/1.1 200") && head.contains("version=0.0.4"),
            "{head}"
        );
        let page = parsed(&body);
        if wanted(&page.1) {
            return page;
        }
        assert!(begun.elapsed() < PATIENCE, "{body}");
    }
}

#[test]
fn metrics_of_both_daemons_are_those_documented_and_a_stalled_scraper_holds_up_nothing() {
    let _alone = alone();
    let stage = Stage::new();
    let (robot, addr) = stage.robot_with(&["--metrics", "127.0.0.1:0"]);
    let robot_at = metrics_of(&robot);
    // It asks, and never reads.
    let mut stalled = TcpStream::connect(&robot_at).unwrap();
    stalled
        .write_all(&b"GET /metrics HTTP/1.1\r\nHost: x\r\n\r\n".repeat(200))
        .unwrap();
    let operator = stage.operator_with(&addr, "operator", &["--metrics", "127.0.0.1:0"]);
    let operator_at = metrics_of(&operator);
    operator.event("engaged");
    let motion = |way: &str| format!("telemime_{way}_total{{kind=\"motion\"}}");
    let (types, samples) = until(&operator_at, |samples| {
        samples[&motion("operator_messages_sent")] > 20.0
            && samples["telemime_operator_engagements_total"] == 1.0
            && samples.contains_key("telemime_operator_hand_age_seconds{stat=\"p95\"}")
    });
    assert_eq!(samples["telemime_operator_connected"], 1.0);
    assert_eq!(samples["telemime_operator_models_stored_total"], 1.0);
    assert!(
        samples["telemime_operator_bytes_sent_total"]
            > samples["telemime_operator_message_bytes_sent_total{kind=\"motion\"}"]
    );
    let names: BTreeSet<_> = types.into_keys().collect();
    assert_eq!(
        names,
        documented("telemime_operator_"),
        "the program, then docs/operations.md"
    );

    let (types, samples) = until(&robot_at, |samples| {
        samples[&motion("robot_messages_received")] > 20.0
    });
    assert_eq!(samples["telemime_robot_sessions_total"], 1.0);
    assert_eq!(samples["telemime_robot_engagements_total"], 1.0);
    assert!(samples["telemime_robot_ticks_total"] > 0.0);
    let states = samples
        .iter()
        .filter(|(name, _)| name.starts_with("telemime_robot_state{"));
    assert_eq!(states.map(|(_, value)| value).sum::<f64>(), 1.0);
    let names: BTreeSet<_> = types.into_keys().collect();
    assert_eq!(
        names,
        documented("telemime_robot_"),
        "the program, then docs/operations.md"
    );

    let done = operator.event("done");
    assert_eq!(done["completed"], true, "{done}");
    robot.event("disconnected");
    let stops = "telemime_robot_stops_total{cause=\"requested\"}";
    let (_, samples) = until(&robot_at, |samples| {
        samples["telemime_robot_connected"] == 0.0
    });
    assert!(samples[stops] >= 1.0, "{samples:?}");
    let (received, sent) = (
        samples[&motion("robot_messages_received")],
        done["messages"].as_f64().unwrap(),
    );
    assert!(
        received <= sent && received > 0.5 * sent,
        "{received} of {sent}"
    );
    assert!(get(&robot_at, "/").0.starts_with("HTTP/1.1 404"));
    drop(stalled);
    robot.signal(Signal::TERM);
    assert!(robot.end().0.success());
}

/// A robot with an environment, its stderr to be read.
fn robot(stage: &Stage, flags: &[&str], environment: &[(&str, &str)]) -> std::process::Child {
    let key = stage.text("robot.key");
    let first = [
        "robot",
        "--listen",
        "127.0.0.1:0",
        "--identity",
        &key,
        "--follow-stdin",
    ];
    Command::new(env!("CARGO_BIN_EXE_telemime"))
        .args([&first, flags].concat())
        .env("XDG_CONFIG_HOME", stage.text(""))
        .envs(environment.iter().copied())
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

/// A socket for what a daemon tells its supervisor, and the environment that names it.
struct Supervisor {
    socket: UnixDatagram,
    path: String,
}

impl Supervisor {
    fn new(stage: &Stage, name: &str) -> Self {
        let path = stage.text(name);
        let socket = UnixDatagram::bind(&path).unwrap();
        socket.set_read_timeout(Some(PATIENCE)).unwrap();
        Self { socket, path }
    }

    fn environment(&self) -> [(&str, &str); 2] {
        [("NOTIFY_SOCKET", &self.path), ("WATCHDOG_USEC", "200000")]
    }

    /// The datagram with this line in it.
    fn hears(&self, wanted: &str) -> String {
        let mut bytes = [0; 512];
        loop {
            let n = self.socket.recv(&mut bytes).unwrap();
            let said = String::from_utf8_lossy(&bytes[..n]).into_owned();
            if said.lines().any(|line| line == wanted) {
                return said;
            }
        }
    }

    fn hears_it_all(&self, status: &str, leave: impl FnOnce()) {
        let ready = self.hears("READY=1");
        assert!(
            ready.contains("STATUS=") && ready.contains(status),
            "{ready}"
        );
        for _ in 0..3 {
            self.hears("WATCHDOG=1");
        }
        leave();
        self.hears("STOPPING=1");
    }
}

#[test]
fn a_supervisor_hears_of_ready_alive_and_stopping() {
    let stage = Stage::new();
    let of_robot = Supervisor::new(&stage, "of-robot");
    let mut robot = robot(&stage, &[], &of_robot.environment());
    let input = robot.stdin.take();
    of_robot.hears_it_all("listens on 127.0.0.1:", || drop(input));
    assert!(robot.wait().unwrap().success());

    // An operator is ready when it dials, whether or not there is a robot.
    let of_operator = Supervisor::new(&stage, "of-operator");
    let key = stage.text("operator.key");
    let peer = stage.fingerprint("robot");
    let mut operator = Command::new(env!("CARGO_BIN_EXE_telemime"))
        .args(["operator", "--connect", "127.0.0.1:1", "--peer", &peer])
        .args(["--identity", &key, "--console", "127.0.0.1:0"])
        .args(["--patience", "1000"])
        .envs(of_operator.environment())
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    of_operator.hears_it_all("reaches for 127.0.0.1:1", || {
        kill_process(Pid::from_child(&operator), Signal::TERM).unwrap();
    });
    assert!(operator.wait().unwrap().success());
}

#[test]
fn a_log_is_text_or_json_and_rust_log_chooses_what() {
    let stage = Stage::new();
    let read = |format: &str, environment: &[(&str, &str)]| {
        let mut robot = robot(&stage, &["--log-format", format], environment);
        drop(robot.stdin.take());
        let (mut out, mut log) = (String::new(), Vec::new());
        for line in BufReader::new(robot.stderr.take().unwrap()).lines() {
            log.push(line.unwrap());
        }
        robot
            .stdout
            .take()
            .unwrap()
            .read_to_string(&mut out)
            .unwrap();
        assert!(robot.wait().unwrap().success());
        assert_eq!(out, "", "what is logged is not told besides");
        log
    };
    let lines = read("json", &[]);
    let events: Vec<Value> = lines
        .iter()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    let of = |name: &str| events.iter().find(|e| e["fields"]["event"] == name);
    let listening = of("listening").unwrap();
    assert!(
        listening["timestamp"].is_string() && listening["level"] == "INFO",
        "{listening}"
    );
    let data: Value = serde_json::from_str(listening["fields"]["data"].as_str().unwrap()).unwrap();
    let addr: SocketAddr = data["addr"].as_str().unwrap().parse().unwrap();
    assert!(addr.ip().is_loopback());
    assert!(of("servo").is_some(), "the last word is not lost");
    assert!(
        events.iter().any(|e| e["level"] == "WARN"),
        "notes are warnings: {lines:?}"
    );

    let text = read("text", &[]);
    assert!(
        text.iter()
            .any(|line| line.contains("INFO") && line.contains("listens on")),
        "{text:?}"
    );
    let quiet = read("text", &[("RUST_LOG", "error")]);
    assert!(quiet.is_empty(), "{quiet:?}");
}

#[test]
fn the_doctor_greets_a_robot_and_tells_a_stranger_what_to_do() {
    let _alone = alone();
    let stage = Stage::new();
    let (robot, addr) = stage.robot();
    let doctor = |key: &str, peer: &str| {
        let (key, peer, peers) = (
            stage.text(&format!("{key}.key")),
            stage.fingerprint(peer),
            stage.text("none"),
        );
        let out = Command::new(env!("CARGO_BIN_EXE_telemime"))
            .args([
                "doctor",
                "--json",
                "--connect",
                &addr,
                "--identity",
                &key,
                "--peer",
                &peer,
                "--peer-file",
                &peers,
            ])
            .output()
            .unwrap();
        let report: Value = serde_json::from_slice(&out.stdout).unwrap();
        let findings = report["findings"].as_array().unwrap().clone();
        let find = move |what: &str| {
            findings
                .iter()
                .find(|f| f["what"] == what)
                .cloned()
                .unwrap_or_default()
        };
        (out.status.code(), find)
    };
    let (_, find) = doctor("operator", "robot");
    let path = find("path to the robot");
    assert!(
        path["verdict"] == "ok" && path["found"].as_str().unwrap().contains("round trip"),
        "{path}"
    );
    let version = find("robot's version");
    assert!(
        version["verdict"] == "ok" && version["found"].as_str().unwrap().contains("version 1"),
        "{version}"
    );
    let ended = robot.event("disconnected");
    assert!(
        ended["why"].as_str().unwrap().contains("goodbye"),
        "{ended}"
    );

    let (code, find) = doctor("stranger", "robot");
    let identity = find("our identity");
    assert_eq!(
        (code, identity["verdict"].as_str()),
        (Some(1), Some("fail")),
        "{identity}"
    );
    assert!(identity["remedy"].as_str().unwrap().contains("pair"));
    // The key that is pinned is another one.
    let (code, find) = doctor("operator", "stranger");
    let identity = find("robot's identity");
    assert_eq!(
        (code, identity["verdict"].as_str()),
        (Some(1), Some("fail")),
        "{identity}"
    );
    assert!(
        identity["found"]
            .as_str()
            .unwrap()
            .contains(&stage.fingerprint("robot")),
        "{identity}"
    );
    robot.signal(Signal::TERM);
    assert!(robot.end().0.success());
}

#[test]
fn the_units_start_what_the_package_installs() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let manifest: toml::Table = std::fs::read_to_string(root.join("Cargo.toml"))
        .unwrap()
        .parse()
        .unwrap();
    let assets = manifest["package"]["metadata"]["deb"]["assets"]
        .as_array()
        .unwrap();
    let installed: BTreeSet<_> = assets
        .iter()
        .map(|asset| {
            let (from, to) = (asset[0].as_str().unwrap(), asset[1].as_str().unwrap());
            let name = if to.ends_with('/') {
                from.rsplit('/').next().unwrap()
            } else {
                ""
            };
            format!("/{to}{name}")
        })
        .collect();
    for daemon in ["robot", "operator"] {
        let unit =
            std::fs::read_to_string(root.join(format!("docs/systemd/telemime-{daemon}.service")))
                .unwrap();
        let of = |key: &str| -> Vec<&str> {
            unit.lines()
                .filter_map(|line| line.strip_prefix(key)?.strip_prefix('='))
                .collect()
        };
        assert_eq!(of("Type"), ["notify"]);
        assert!(
            installed.contains(&format!(
                "/usr/lib/systemd/system/telemime-{daemon}.service"
            )),
            "{installed:?}"
        );
        for command in [of("ExecStartPre"), of("ExecStart")].concat() {
            let words: Vec<_> = command.split(' ').collect();
            assert!(installed.contains(words[0]), "{command}");
            let config = words.iter().find(|word| word.ends_with(".toml")).unwrap();
            assert!(installed.contains(*config), "{command}");
        }
    }
}
