//! The daemons as users start them: two processes, real sockets, real signals.
//!
//! Nothing here asserts a time; whatever is waited for has a generous limit.

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use nalgebra::Vector3;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use telemime_endpoint::Identity;
use telemime_operator::demonstration::{Demonstration, Sample};

const PATIENCE: Duration = Duration::from_secs(120);

/// These run in real time: one after the other, so that they do not take each other's.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

pub(crate) fn alone() -> MutexGuard<'static, ()> {
    // A test that failed has nothing left running that matters here.
    ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A process of ours, with what it prints.
pub(crate) struct Process {
    child: Child,
    lines: Receiver<String>,
    errors: Receiver<String>,
}

fn lines(source: impl std::io::Read + Send + 'static) -> Receiver<String> {
    let (tx, rx) = channel();
    std::thread::spawn(move || {
        for line in BufReader::new(source).lines().map_while(Result::ok) {
            if tx.send(line).is_err() {
                return;
            }
        }
    });
    rx
}

impl Process {
    pub(crate) fn start(args: &[&str]) -> Self {
        Self::spawn(Command::new(env!("CARGO_BIN_EXE_telemime")).args(args))
    }

    pub(crate) fn spawn(command: &mut Command) -> Self {
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let lines_out = lines(child.stdout.take().unwrap());
        let errors = lines(child.stderr.take().unwrap());
        Self {
            child,
            lines: lines_out,
            errors,
        }
    }

    /// The next event of this kind.
    pub(crate) fn event(&self, kind: &str) -> Value {
        self.event_where(kind, |_| true)
    }

    pub(crate) fn event_where(&self, kind: &str, wanted: impl Fn(&Value) -> bool) -> Value {
        loop {
            let line = self.lines.recv_timeout(PATIENCE).unwrap_or_else(|e| {
                let said: Vec<_> = self.errors.try_iter().collect();
                panic!("no {kind} event: {e}; stderr: {said:?}")
            });
            let event: Value = serde_json::from_str(&line).unwrap();
            if event["event"] == kind && wanted(&event) {
                return event;
            }
        }
    }

    /// Types a line at its terminal.
    pub(crate) fn types(&mut self, line: &str) {
        let stdin = self.child.stdin.as_mut().unwrap();
        writeln!(stdin, "{line}").unwrap();
    }

    /// Ends its standard input.
    pub(crate) fn closes(&mut self) {
        drop(self.child.stdin.take());
    }

    /// The next line it prints, while there is one.
    pub(crate) fn line(&self) -> Option<String> {
        self.lines.recv_timeout(PATIENCE).ok()
    }

    pub(crate) fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    /// Waits for the end; what it then had said on stderr.
    pub(crate) fn end(mut self) -> (ExitStatus, String) {
        let (tx, rx) = channel();
        let lines = self.lines;
        // The pipe closes when the process ends, and that wakes the reader.
        std::thread::spawn(move || {
            lines.iter().for_each(drop);
            let _ = tx.send(());
        });
        if rx.recv_timeout(PATIENCE).is_err() {
            self.child.kill().unwrap();
            panic!("the process did not end");
        }
        let status = self.child.wait().unwrap();
        (status, self.errors.iter().collect::<Vec<_>>().join("\n"))
    }
}

/// Keys, configurations and recordings in a folder of their own.
pub(crate) struct Stage {
    dir: tempfile::TempDir,
}

impl Stage {
    pub(crate) fn new() -> Self {
        let stage = Self {
            dir: tempfile::tempdir().unwrap(),
        };
        std::fs::create_dir(stage.path("swing")).unwrap();
        for index in 0..3 {
            stage.recording(&format!("swing/{index}.csv"), index);
        }
        stage.recording("unseen.csv", 5);
        for name in ["robot", "operator", "stranger"] {
            Identity::load_or_create(&stage.path(&format!("{name}.key"))).unwrap();
        }
        stage
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    pub(crate) fn text(&self, name: &str) -> String {
        self.path(name).to_str().unwrap().to_owned()
    }

    fn recording(&self, name: &str, index: u32) {
        let samples: Vec<_> = telemime_sim::hand::swing(3, index)
            .into_iter()
            .map(|(t_s, x)| Sample::at(t_s, Vector3::from(x)))
            .collect();
        let path = self.path(name);
        let text = Demonstration::from_samples(&path, &samples)
            .unwrap()
            .to_csv();
        std::fs::write(path, text).unwrap();
    }

    pub(crate) fn fingerprint(&self, who: &str) -> String {
        Identity::load_or_create(&self.path(&format!("{who}.key")))
            .unwrap()
            .fingerprint()
            .to_string()
    }

    /// A robot from a TOML file, as on a host of its own; and its address.
    pub(crate) fn robot(&self) -> (Process, String) {
        self.robot_with(&[])
    }

    /// The same with more flags.
    pub(crate) fn robot_with(&self, flags: &[&str]) -> (Process, String) {
        self.robot_by(Command::new(env!("CARGO_BIN_EXE_telemime")).args(self.robot_args(flags)))
    }

    pub(crate) fn robot_args(&self, flags: &[&str]) -> Vec<String> {
        let config = format!(
            "listen = \"127.0.0.1:0\"\nidentity = {:?}\npeers = [{:?}]\n",
            self.text("robot.key"),
            self.fingerprint("operator")
        );
        std::fs::write(self.path("robot.toml"), config).unwrap();
        let config = self.text("robot.toml");
        let first = ["robot", "--config", &config, "--json", "--follow-stdin"];
        let all = [&first, flags].concat();
        all.into_iter().map(str::to_owned).collect()
    }

    /// A robot started by `command`, and its address.
    pub(crate) fn robot_by(&self, command: &mut Command) -> (Process, String) {
        let robot = Process::spawn(command);
        let listening = robot.event("listening");
        assert_eq!(listening["fingerprint"], self.fingerprint("robot"));
        let addr = listening["addr"].as_str().unwrap().to_owned();
        (robot, addr)
    }

    pub(crate) fn operator(&self, addr: &str, key: &str) -> Process {
        self.operator_with(addr, key, &[])
    }

    /// The same with more flags.
    pub(crate) fn operator_with(&self, addr: &str, key: &str, flags: &[&str]) -> Process {
        let config = format!(
            "connect = {addr:?}\nidentity = {:?}\npeer = {:?}\nlearn = [{:?}]\nreplay = {:?}\npatience_s = 5.0\n",
            self.text(&format!("{key}.key")),
            self.fingerprint("robot"),
            self.text("swing"),
            self.text("unseen.csv"),
        );
        std::fs::write(self.path("operator.toml"), config).unwrap();
        let config = self.text("operator.toml");
        let first = ["operator", "--config", &config, "--json", "--follow-stdin"];
        Process::start(&[&first, flags].concat())
    }
}

#[test]
fn two_hosts_from_configuration_files() {
    let _alone = alone();
    let stage = Stage::new();
    let (robot, addr) = stage.robot();
    let operator = stage.operator(&addr, "operator");
    let done = operator.event("done");
    assert_eq!(done["completed"], true, "{done}");
    assert!(
        done["messages"].as_u64().unwrap() > 20 && done["knots"].as_u64().unwrap() > 20,
        "{done}"
    );
    assert!(operator.end().0.success());
    let ended = robot.event("disconnected");
    assert!(
        ended["why"].as_str().unwrap().contains("goodbye"),
        "{ended}"
    );
    robot.signal(Signal::TERM);
    assert!(robot.end().0.success());
}

#[test]
fn a_killed_operator_leaves_a_stopped_arm_and_a_robot_that_serves_the_next() {
    let _alone = alone();
    let stage = Stage::new();
    let (robot, addr) = stage.robot();
    let operator = stage.operator(&addr, "operator");
    operator.event_where("progress", |e| e["done"].as_f64().unwrap() > 0.3);
    operator.signal(Signal::KILL);
    let held = robot.event_where("state", |e| e["state"] == "Holding");
    assert!(
        ["LeaseExpired", "ConnectionLost"].contains(&held["cause"].as_str().unwrap()),
        "{held}"
    );
    robot.event("disconnected");
    let next = stage.operator(&addr, "operator");
    next.event("engaged");
    next.signal(Signal::INT);
    assert!(
        !next.end().0.success(),
        "an interrupted task is not a success"
    );
    robot.event_where("state", |e| e["state"] == "Idle");
    robot.signal(Signal::INT);
    assert!(robot.end().0.success());
}

#[test]
fn a_killed_robot_ends_the_operator_with_a_reason() {
    let _alone = alone();
    let stage = Stage::new();
    let (robot, addr) = stage.robot();
    let operator = stage.operator(&addr, "operator");
    operator.event("engaged");
    robot.signal(Signal::KILL);
    let done = operator.event("done");
    assert_eq!(done["completed"], false);
    let (status, said) = operator.end();
    assert!(!status.success());
    assert!(said.contains("the link was lost"), "{said}");
}

#[test]
fn a_foreign_key_is_refused_at_both_ends_with_a_remedy() {
    let _alone = alone();
    let stage = Stage::new();
    let (robot, addr) = stage.robot();
    let stranger = stage.operator(&addr, "stranger");
    let (status, said) = stranger.end();
    assert!(!status.success());
    assert!(said.contains("does not accept our key"), "{said}");
    robot.event("refused");
    drop(robot.child.stdin);
}

#[test]
fn two_hosts_pair_drive_by_name_and_part_by_revocation() {
    let _alone = alone();
    let stage = Stage::new();
    let (robots, operators) = (stage.text("robots-peers"), stage.text("operators-peers"));
    let mut robot = Process::start(&[
        "robot",
        "--listen",
        "127.0.0.1:0",
        "--identity",
        &stage.text("robot.key"),
        "--peer-file",
        &robots,
        "--name",
        "lab-arm",
        "--pair",
        "--clock-dispersion",
        "50us",
        "--json",
        "--follow-stdin",
    ]);
    let addr = robot.event("listening")["addr"]
        .as_str()
        .unwrap()
        .to_owned();
    assert_eq!(robot.event("pairing")["stage"], "open");
    let mut laptop = Process::start(&[
        "pair",
        &addr,
        "--identity",
        &stage.text("operator.key"),
        "--peer-file",
        &operators,
        "--name",
        "laptop",
        "--json",
    ]);
    let here = laptop.event("code");
    let there = robot.event_where("pairing", |e| e["stage"] == "code");
    assert_eq!(
        (&here["code"], &here["name"]),
        (&there["code"], &"lab-arm".into())
    );
    assert_eq!(there["name"], "laptop");
    laptop.types("yes");
    assert!(!Path::new(&robots).exists() && !Path::new(&operators).exists());
    robot.types("yes");
    robot.event_where("pairing", |e| e["stage"] == "paired");
    laptop.event("paired");
    assert!(laptop.end().0.success());

    let start = || {
        Process::start(&[
            "operator",
            "--connect",
            "lab-arm",
            "--identity",
            &stage.text("operator.key"),
            "--peer-file",
            &operators,
            "--learn",
            &stage.text("swing"),
            "--replay",
            &stage.text("unseen.csv"),
            "--clock-dispersion",
            "50us",
            "--json",
            "--follow-stdin",
        ])
    };
    let operator = start();
    operator.event("engaged");
    // One host, one clock: both ends' wall clocks are the same to the nanosecond.
    operator.event_where("telemetry", |e| {
        e["clock_uncertainty_ms"].as_f64().unwrap() < 0.2
    });
    let revoke = Process::start(&["peers", "revoke", "laptop", "--file", &robots, "--json"]);
    assert!(revoke.end().0.success());
    let ended = robot.event("disconnected");
    assert!(
        ended["why"].as_str().unwrap().contains("revoked"),
        "{ended}"
    );
    assert_eq!(ended["clock_origin"], "disciplined");
    robot.event_where("state", |e| e["state"] == "Holding");
    let (status, said) = operator.end();
    assert!(!status.success());
    assert!(said.contains("has revoked our key"), "{said}");
    let refused = robot.event("refused");
    assert_eq!(
        (&refused["reason"], &refused["times"]),
        (&"revoked_key".into(), &1.into())
    );

    // A robot with another key in its place is refused before anything is sent.
    robot.signal(Signal::TERM);
    assert!(robot.end().0.success());
    let impostor = Process::start(&[
        "robot",
        "--listen",
        &addr,
        "--identity",
        &stage.text("stranger.key"),
        "--peer-file",
        &robots,
        "--json",
        "--follow-stdin",
    ]);
    impostor.event("listening");
    let (status, said) = start().end();
    assert!(!status.success());
    assert!(
        said.contains("has another key than the one we know"),
        "{said}"
    );
    drop(impostor.child.stdin);
}

#[test]
fn a_taken_port_is_one_clear_line() {
    let _alone = alone();
    let stage = Stage::new();
    let taken = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let addr = taken.local_addr().unwrap().to_string();
    let robot = Process::start(&[
        "robot",
        "--listen",
        &addr,
        "--identity",
        &stage.text("robot.key"),
        "--json",
    ]);
    let (status, said) = robot.end();
    assert_eq!(status.code(), Some(1));
    assert!(
        said.lines()
            .last()
            .unwrap()
            .contains(&format!("cannot listen on {addr}")),
        "{said}"
    );
}

/// Processes whose command line mentions `what`.
fn mentioning(what: &Path) -> usize {
    let what = what.to_str().unwrap();
    let entries = std::fs::read_dir("/proc").unwrap().flatten();
    let command =
        |e: std::fs::DirEntry| std::fs::read(e.path().join("cmdline")).unwrap_or_default();
    entries
        .map(command)
        .filter(|c| String::from_utf8_lossy(c).contains(what))
        .count()
}

#[test]
fn a_killed_demo_leaves_no_orphans() {
    let _alone = alone();
    let stage = Stage::new();
    let out = stage.path("figures");
    let demo = Process::start(&["demo", "--out", out.to_str().unwrap()]);
    let record = out.join("robot.csv");
    let deadline = std::time::Instant::now() + PATIENCE;
    // The robot makes its record when it starts.
    while !record.exists() {
        assert!(
            std::time::Instant::now() < deadline,
            "the robot did not start"
        );
        std::thread::yield_now();
    }
    demo.signal(Signal::KILL);
    demo.end();
    while mentioning(&out) > 0 {
        assert!(std::time::Instant::now() < deadline, "an orphan is left");
        std::thread::yield_now();
    }
}

#[test]
fn the_demo_gives_one_json_object_and_its_figures() {
    let _alone = alone();
    let stage = Stage::new();
    let out = stage.path("figures");
    let demo = Process::start(&["demo", "--json", "--out", out.to_str().unwrap()]);
    let line = demo.lines.recv_timeout(PATIENCE).unwrap_or_else(|e| {
        panic!("{e}: {:?}", demo.errors.try_iter().collect::<Vec<_>>());
    });
    let result: Value = serde_json::from_str(&line).unwrap();
    for key in [
        "rmse_delayed_m",
        "rmse_delayed_same_arm_m",
        "rmse_floor_m",
        "rmse_predicted_m",
        "fraction_hidden",
        "lag_delayed_ms",
        "lag_predicted_ms",
        "scale",
        "clamps",
        "bytes_on_wire",
        "bytes_raw",
        "checkpoints",
        "samples",
        "tick_mean_us",
        "tick_p99_us",
    ] {
        assert!(result[key].is_number(), "{key} is {}", result[key]);
    }
    assert!(
        result["bytes_session"]["operator_to_robot"]
            .as_u64()
            .unwrap()
            > 0
    );
    let number = |key: &str| result[key].as_f64().unwrap();
    assert!(
        number("rmse_predicted_m") < 0.7 * number("rmse_delayed_same_arm_m"),
        "{result}"
    );
    assert!(
        number("path_error_m") <= number("path_bound_m") * 1.01,
        "{result}"
    );
    assert!(
        demo.lines.recv_timeout(PATIENCE).is_err(),
        "more than one line on stdout"
    );
    assert!(demo.end().0.success());
    for figure in ["mirror.png", "mirror.svg", "skill.png", "skill.svg"] {
        assert!(out.join(figure).exists(), "{figure}");
    }
}

#[test]
fn an_interrupted_demo_says_once_why_it_ended() {
    let _alone = alone();
    let stage = Stage::new();
    let (out, demos) = (stage.text("out"), stage.text("swing"));
    let demo = Process::start(&["demo", "--demos", &demos, "--out", &out]);
    // It is saved when both daemons run, and before the recording has been driven.
    let begun = std::time::Instant::now();
    while !stage.path("out/skills/swing.skill").exists() {
        assert!(begun.elapsed() < PATIENCE, "nothing was learned");
        std::thread::yield_now();
    }
    demo.signal(Signal::INT);
    let (status, said) = demo.end();
    assert_eq!(status.code(), Some(1), "{said}");
    let why: Vec<_> = said.lines().filter(|l| l.starts_with("telemime")).collect();
    assert_eq!(why, ["telemime: stopped by hand"], "{said}");
}
