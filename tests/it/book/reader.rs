//! A reader at two hosts: types what a block says, waits for it, and knows what could not be tried here.

use std::collections::BTreeSet;
use std::io::{BufRead, BufReader, Write as _};
use std::net::UdpSocket;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use super::given::{give, program};
use super::text::{Block, root};

const PATIENCE: Duration = Duration::from_secs(300);

/// The console page has one default address.
static PAGE: Mutex<()> = Mutex::new(());

/// The demos that were shown: the same line twice would be the same again.
static SHOWN: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());

/// What the documents call the robot.
const ROBOT: [&str; 5] = [
    "robot.example:4433",
    "robot:4433",
    "--connect lab-arm",
    "--connect robot ",
    "--to robot ",
];

pub(super) struct Reader {
    dir: tempfile::TempDir,
    robot: Option<Running>,
    addr: String,
    pub(super) tally: Tally,
}

/// What became of the lines.
#[derive(Debug, Default)]
pub(super) struct Tally {
    pub(super) ran: Vec<String>,
    pub(super) checked: Vec<String>,
    /// Shown to another reader.
    pub(super) again: usize,
    pub(super) skipped: Vec<(String, String)>,
    /// With who runs them.
    pub(super) elsewhere: Vec<(String, String)>,
    /// With the reason.
    pub(super) never: Vec<(String, String)>,
}

struct Running {
    child: Child,
    said: Receiver<String>,
}

impl Running {
    /// Waits for a line with this in it.
    fn hears(&self, what: &str) -> String {
        let mut all = String::new();
        loop {
            match self.said.recv_timeout(PATIENCE) {
                Ok(line) if line.contains(what) => return line,
                Ok(line) => all += &format!("{line}\n"),
                Err(e) => panic!("nothing says {what:?}: {e}; instead:\n{all}"),
            }
        }
    }

    fn types(&mut self, line: &str) {
        writeln!(self.child.stdin.as_mut().unwrap(), "{line}").unwrap();
    }

    /// Its end, which must be a good one; what it said until then.
    fn ends(mut self, line: &str) -> String {
        drop(self.child.stdin.take());
        let rest: Vec<_> = self.said.iter().collect();
        let status = self.child.wait().unwrap();
        assert!(status.success(), "{line}: {status}\n{}", rest.join("\n"));
        rest.join("\n")
    }

    fn interrupted(mut self, line: &str) {
        kill_process(Pid::from_child(&self.child), Signal::INT).unwrap();
        let rest: Vec<_> = self.said.iter().collect();
        let status = self.child.wait().unwrap();
        let good = status.success() || status.code() == Some(130);
        assert!(good, "{line}: {status}\n{}", rest.join("\n"));
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        if let Some(mut robot) = self.robot.take() {
            let _ = robot.child.kill();
            let _ = robot.child.wait();
        }
    }
}

/// Whether this is the first time.
fn shown(line: &str) -> bool {
    let mut all = SHOWN.lock().unwrap_or_else(PoisonError::into_inner);
    all.insert(line.to_owned())
}

fn there_is(program: &str) -> bool {
    let found = Command::new("sh")
        .args(["-c", &format!("command -v {program}")])
        .stdout(Stdio::null())
        .status();
    found.is_ok_and(|status| status.success())
}

impl Reader {
    pub(super) fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        for home in ["robot", "operator"] {
            std::fs::create_dir(dir.path().join(home)).unwrap();
        }
        Self {
            dir,
            robot: None,
            addr: String::new(),
            tally: Tally::default(),
        }
    }

    /// One that has recordings, raw ones, an arm and a skill.
    pub(super) fn with_recordings() -> Self {
        let reader = Self::new();
        give(&reader.at(""));
        reader
    }

    /// Of the folder in which all is typed.
    pub(super) fn at(&self, name: &str) -> std::path::PathBuf {
        self.dir.path().join("operator").join(name)
    }

    /// Why a block is not run here.
    fn lacks(&self, block: &Block) -> Option<String> {
        if block.is("data") && !self.at("data").exists() {
            return Some("the recordings are not here; set TELEMIME_DATA".to_owned());
        }
        if !block.python.is_empty() && block.is("beside-python") && !there_is("python3") {
            return Some("there is no python3".to_owned());
        }
        match block.value("needs")? {
            "feature:live" => (!cfg!(feature = "live")).then(|| "built without `live`".to_owned()),
            "feature:gamepad" => {
                (!cfg!(feature = "gamepad")).then(|| "built without `gamepad`".to_owned())
            }
            program => (!there_is(program)).then(|| format!("there is no {program}")),
        }
    }

    /// Types a block.
    pub(super) fn reads(&mut self, block: &Block) {
        let other = ["systemd", "cluster"].into_iter().find(|w| block.is(w));
        let lacks = self.lacks(block);
        for line in &block.lines {
            if let Some(why) = block.value("never") {
                self.tally.never.push((line.clone(), why.to_owned()));
            } else if let Some(other) = other {
                self.tally.elsewhere.push((line.clone(), other.to_owned()));
            } else if line.starts_with("cargo ") || line.starts_with("export PATH") {
                // What builds this very program is not for it to run.
                self.tally.checked.push(line.clone());
            } else if let Some(why) = &lacks {
                self.tally.skipped.push((line.clone(), why.clone()));
            } else if line.starts_with("telemime demo --") && !shown(line) {
                self.tally.again += 1;
            } else {
                let begun = Instant::now();
                self.types(block, line);
                let took_s = begun.elapsed().as_secs_f64();
                println!("{took_s:5.1} s {}$ {line}", block.how.join(" "));
                self.tally.ran.push(line.clone());
            }
        }
    }

    /// Ends the robot, if one runs.
    pub(super) fn leaves(&mut self) {
        if let Some(robot) = self.robot.take() {
            robot.ends("the robot");
        }
    }

    fn start(&self, host: &str, line: &str) -> Running {
        let path = std::env::var("PATH").unwrap_or_default();
        let home = self.dir.path().join(host);
        // A shell with one command becomes it, so that signals reach it.
        let several = ["&&", "|", ";"].iter().any(|sign| line.contains(sign));
        let exec = if several { "" } else { "exec " };
        let mut child = Command::new("sh")
            .args(["-c", &format!("{exec}{line}")])
            .current_dir(self.at(""))
            .env("HOME", &home)
            .env("XDG_CONFIG_HOME", home.join(".config"))
            .env(
                "PATH",
                format!("{}:{path}", program().parent().unwrap().display()),
            )
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let (tx, said) = channel();
        let sources: [Box<dyn std::io::Read + Send>; 2] = [
            Box::new(child.stdout.take().unwrap()),
            Box::new(child.stderr.take().unwrap()),
        ];
        for source in sources {
            let tx = tx.clone();
            std::thread::spawn(move || {
                for line in BufReader::new(source).lines().map_while(Result::ok) {
                    if tx.send(line).is_err() {
                        return;
                    }
                }
            });
        }
        Running { child, said }
    }

    /// With the robot's address, no port that may be taken, and no more than one person of an experiment's plan.
    fn here(&self, line: &str) -> String {
        let mut line = format!("{line} ").replace("--listen 0.0.0.0:5000", "--listen 127.0.0.1:0");
        // One person of the plan's.
        line = line.replace("experiment quick ", "experiment quick --people 1 ");
        for name in ROBOT {
            let flag = name.split_once(' ').map_or("", |(flag, _)| flag);
            line = line.replace(name, &format!("{flag} {} ", self.addr));
        }
        line.trim().to_owned()
    }

    fn types(&mut self, block: &Block, line: &str) {
        let there = self.here(line);
        let one_page = there.contains("--console");
        let _page = one_page.then(|| PAGE.lock().unwrap_or_else(PoisonError::into_inner));
        if block.is("robot") {
            self.leaves();
            self.starts_robot(&there);
            if let Some(typed) = block.value("types") {
                let robot = self.robot.as_mut().unwrap();
                robot.types(typed);
                robot.hears("black box");
            }
        } else if block.is("interrupt") || block.is("until-heard") {
            let running = self.start("operator", &there);
            running.hears("127.0.0.1:");
            running.interrupted(line);
        } else if block.is("beside-python") {
            self.beside_python(&there, &block.python);
        } else if line.starts_with("telemime pair ") {
            let mut operator = self.start("operator", &there);
            operator.hears("Does the robot show the same?");
            operator.types("yes");
            let robot = self.robot.as_mut().unwrap();
            robot.hears("Does the operator show the same?");
            robot.types("yes");
            operator.ends(line);
        } else {
            self.start("operator", &there).ends(line);
        }
    }

    fn starts_robot(&mut self, line: &str) {
        // Always the same address: it is what the operator knows the robot by.
        let listen = if self.addr.is_empty() {
            "127.0.0.1:0"
        } else {
            &self.addr
        };
        let robot = self.start("robot", &format!("{line} --listen {listen} --follow-stdin"));
        let said = robot.hears("listens on 127.0.0.1:");
        let (_, port) = said.split_once("127.0.0.1:").unwrap();
        let port: String = port.chars().take_while(char::is_ascii_digit).collect();
        self.addr = format!("127.0.0.1:{port}");
        self.robot = Some(robot);
    }

    /// The operator is followed by what the Python before it sends.
    fn beside_python(&self, line: &str, python: &str) {
        let free = UdpSocket::bind("127.0.0.1:0").unwrap();
        let port = free.local_addr().unwrap().port().to_string();
        drop(free);
        let operator = self.start("operator", &line.replace("5005", &port));
        operator.hears("follows at scale");
        let code = python.replace("5005", &port);
        let sender = Command::new("python3").args(["-c", &code]).status();
        assert!(sender.unwrap().success(), "{code}");
        operator.hears("engage");
        operator.interrupted(line);
    }
}

/// Whether a line of cargo's names what there is: a feature, a test, a bench.
pub(super) fn cargo_has(line: &str, tests: &str) -> Result<(), String> {
    let words: Vec<_> = line.split(' ').collect();
    let after = |flag: &str| {
        let at = words.iter().position(|word| *word == flag)?;
        words.get(at + 1).copied()
    };
    if let Some(features) = after("--features") {
        let manifest = std::fs::read_to_string(root().join("Cargo.toml")).unwrap();
        for feature in features.split(',') {
            if !manifest.contains(&format!("\n{feature} = [")) {
                return Err(format!("there is no feature {feature}"));
            }
        }
    }
    let folder = |package: &str| match package {
        "telemime" => root().to_owned(),
        "telemime-endpoint" => root().join("protocol/endpoint"),
        other => root().join(other.trim_start_matches("telemime-")),
    };
    if let Some(bench) = after("--bench") {
        let package = after("-p").ok_or("of which package?")?;
        let manifest = std::fs::read_to_string(folder(package).join("Cargo.toml")).unwrap();
        if !manifest.contains(&format!("name = \"{bench}\"")) {
            return Err(format!("{package} has no bench {bench}"));
        }
    } else if words.get(1) == Some(&"bench") {
        let package = after("-p").ok_or("of which package?")?;
        if !folder(package).join("benches").is_dir() && package != "telemime" {
            return Err(format!("{package} has no benches"));
        }
    }
    if after("--test") == Some("it") {
        let at = words.iter().position(|word| *word == "it").unwrap();
        if let Some(filter) = words.get(at + 1).filter(|word| **word != "--") {
            let any = tests.lines().any(|name| name.contains(filter));
            if !any {
                return Err(format!("no test's name holds {filter}"));
            }
        }
    }
    Ok(())
}

/// The names of this binary's tests.
pub(super) fn own_tests() -> String {
    let out = Command::new(std::env::current_exe().unwrap())
        .args(["--list"])
        .output()
        .unwrap();
    String::from_utf8(out.stdout).unwrap()
}
