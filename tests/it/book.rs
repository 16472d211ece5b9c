//! The book's commands, run as they stand: what a reader types does what the text says.
//!
//! A block ```` ```sh ```` of a chapter is run line by line in one folder, chapter after chapter; with `robot` or `operator` it is run at that
//! host, which here is a home of its own; `interrupt` and `until-heard` are ended by Ctrl-C once they have said where they listen. The robot's address is
//! what stands for `robot.example:4433`. Command lines elsewhere in the documents are parsed by the program.

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};

use crate::processes::alone;

const PATIENCE: Duration = Duration::from_secs(300);

/// In the order in which they are read: each goes on where the one before has ended.
const CHAPTERS: [&str; 4] = ["start.md", "teaching.md", "hosts.md", "compare.md"];

fn documents() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("docs")
}

/// The blocks of commands: what stands behind `sh`, and the lines.
fn blocks(text: &str) -> Vec<(String, Vec<String>)> {
    let mut blocks = Vec::new();
    let mut open: Option<(String, Vec<String>)> = None;
    for line in text.lines() {
        match (&mut open, line.strip_prefix("```")) {
            (None, Some(info)) if info.split(' ').next() == Some("sh") => {
                let how = info.strip_prefix("sh").unwrap_or_default().trim();
                open = Some((how.to_owned(), Vec::new()));
            }
            (Some(_), Some(_)) => blocks.extend(open.take()),
            (Some((_, lines)), None) => lines.push(line.to_owned()),
            _ => {}
        }
    }
    blocks
}

struct Reader {
    dir: tempfile::TempDir,
    robot: Option<Running>,
    addr: String,
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

    fn ends(mut self, line: &str) {
        drop(self.child.stdin.take());
        let rest: Vec<_> = self.said.iter().collect();
        let status = self.child.wait().unwrap();
        assert!(status.success(), "{line}: {status}\n{}", rest.join("\n"));
    }

    fn interrupted(self, line: &str) {
        kill_process(Pid::from_child(&self.child), Signal::INT).unwrap();
        let rest: Vec<_> = self.said.iter().collect();
        let mut child = self.child;
        let status = child.wait().unwrap();
        assert!(
            status.success() || status.code() == Some(130),
            "{line}: {status}\n{}",
            rest.join("\n")
        );
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

impl Reader {
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        for home in ["robot", "operator"] {
            std::fs::create_dir(dir.path().join(home)).unwrap();
        }
        Self {
            dir,
            robot: None,
            addr: String::new(),
        }
    }

    fn start(&self, host: &str, line: &str) -> Running {
        let program = Path::new(env!("CARGO_BIN_EXE_telemime"));
        let path = std::env::var("PATH").unwrap_or_default();
        let home = self.dir.path().join(host);
        // The shell becomes the command, so that signals reach it.
        let mut child = Command::new("sh")
            .args(["-c", &format!("exec {line}")])
            .current_dir(self.dir.path().join("operator"))
            .env("HOME", &home)
            .env("XDG_CONFIG_HOME", home.join(".config"))
            .env(
                "PATH",
                format!("{}:{path}", program.parent().unwrap().display()),
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

    fn run(&mut self, how: &str, line: &str) {
        println!("{how}$ {line}");
        let there = line.replace("robot.example:4433", &self.addr);
        match how {
            // What builds this very program is not for it to run.
            "" if line.starts_with("cargo ") || line.starts_with("export PATH") => {}
            "robot" => {
                let robot = self.start(
                    "robot",
                    &format!("{there} --listen 127.0.0.1:0 --follow-stdin"),
                );
                let said = robot.hears("127.0.0.1:");
                let (_, port) = said.split_once("127.0.0.1:").unwrap();
                let port: String = port.chars().take_while(char::is_ascii_digit).collect();
                self.addr = format!("127.0.0.1:{port}");
                self.robot = Some(robot);
            }
            "interrupt" | "until-heard" => {
                let running = self.start("operator", &there);
                running.hears("127.0.0.1:");
                running.interrupted(line);
            }
            "" | "operator" if line.starts_with("telemime pair ") => {
                let mut operator = self.start("operator", &there);
                operator.hears("Does the robot show the same?");
                operator.types("yes");
                let robot = self.robot.as_mut().unwrap();
                robot.hears("Does the operator show the same?");
                robot.types("yes");
                operator.ends(line);
            }
            "" | "operator" => self.start("operator", &there).ends(line),
            other => panic!("how is a block `sh {other}` run?"),
        }
    }
}

#[test]
fn the_books_commands_do_what_it_says() {
    let _alone = alone();
    let mut reader = Reader::new();
    for chapter in CHAPTERS {
        let text = std::fs::read_to_string(documents().join(chapter)).unwrap();
        let blocks = blocks(&text);
        assert!(!blocks.is_empty(), "{chapter} has nothing to run");
        for (how, lines) in blocks {
            for line in lines {
                reader.run(&how, &line);
            }
        }
    }
    let left = |name: &str| reader.dir.path().join("operator").join(name);
    for file in [
        "runs/demo/mirror.png",
        "swing.svg",
        "swing.skill",
        "reach.skill",
        "runs/quick/report.html",
    ] {
        assert!(left(file).exists(), "{file}");
    }
}

/// Every line of a document that is a command of ours, without its prompt and its comment.
fn command_lines(text: &str) -> Vec<String> {
    let mut found = Vec::new();
    let mut fenced = false;
    for line in text.lines() {
        if line.starts_with("```") {
            fenced = !fenced;
            continue;
        }
        let Some(line) = line.strip_prefix("    ").or(fenced.then_some(line)) else {
            continue;
        };
        let line = line.trim();
        let line = line.split_once("$ ").map_or(line, |(_, line)| line.trim());
        let line = line.split(" #").next().unwrap_or(line);
        for part in line.split(['&', '|']).map(str::trim) {
            // Where it goes, and what is left out, is not for the program.
            let part = part.split(" >").next().unwrap_or(part).replace(" …", "");
            if part.starts_with("telemime ") {
                found.push(part);
            }
        }
    }
    found
}

#[test]
fn every_command_line_in_the_documents_is_one() {
    let mut files: Vec<_> = std::fs::read_dir(documents())
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|e| e == "md"))
        .collect();
    files.push(documents().join("../README.md"));
    files.sort();
    let program = Path::new(env!("CARGO_BIN_EXE_telemime"));
    let mut seen = 0;
    for file in files {
        for line in command_lines(&std::fs::read_to_string(&file).unwrap()) {
            // `--help` at the end: everything before it is parsed, and nothing is done.
            let line = line.replacen("telemime", "\"$PROGRAM\"", 1);
            // A relay asks at once for whom it is.
            let line = line.replace("robot.example:", "127.0.0.1:");
            let script = line.replace("--to robot:", "--to 127.0.0.1:") + " --help";
            let out = Command::new("sh")
                .args(["-fc", &script])
                .env("PROGRAM", program)
                .env("SLURM_ARRAY_TASK_ID", "1")
                .env("JOB_COMPLETION_INDEX", "1")
                .output()
                .unwrap();
            let why = String::from_utf8_lossy(&out.stderr);
            assert!(out.status.success(), "{}: {line}\n{why}", file.display());
            seen += 1;
        }
    }
    assert!(seen > 40, "{seen}");
}

/// The book has every page there is, and no other.
#[test]
fn the_book_has_every_page() {
    let summary = std::fs::read_to_string(documents().join("SUMMARY.md")).unwrap();
    for entry in std::fs::read_dir(documents()).unwrap() {
        let name = entry.unwrap().file_name().into_string().unwrap();
        if name.ends_with(".md") && name != "SUMMARY.md" {
            assert!(summary.contains(&format!("]({name})")), "{name}");
        }
    }
    for target in summary.split("](").skip(1) {
        let name = target.split(')').next().unwrap();
        assert!(documents().join(name).exists(), "{name}");
    }
}
