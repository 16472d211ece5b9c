//! What stands in the documents: blocks of commands, and what is said of how they are run.

use std::path::{Path, PathBuf};

/// Behind `sh` stands how a block is run: a host (`robot`, `operator`), an end (`interrupt`, `until-heard`), what it takes (`data`, `needs=PROGRAM`,
/// `needs=feature:NAME`), what happens beside it (`beside-python`, `types=LINE`), or who runs it instead (`systemd`, `cluster`; `never=WHY` is nobody).
#[derive(Debug, Clone, Default)]
pub(super) struct Block {
    pub(super) how: Vec<String>,
    pub(super) lines: Vec<String>,
    /// The Python block before it.
    pub(super) python: String,
}

impl Block {
    pub(super) fn is(&self, word: &str) -> bool {
        self.how.iter().any(|how| how == word)
    }

    /// What stands behind `key=`.
    pub(super) fn value(&self, key: &str) -> Option<&str> {
        let mut words = self.how.iter();
        words.find_map(|how| how.strip_prefix(key)?.strip_prefix('='))
    }
}

pub(super) fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

pub(super) fn read(document: &str) -> String {
    std::fs::read_to_string(root().join(document)).unwrap()
}

/// Every document that a reader types from, and the README.
pub(super) fn documents() -> Vec<String> {
    let entries = std::fs::read_dir(root().join("docs")).unwrap();
    let names = entries.map(|entry| entry.unwrap().path());
    let pages: Vec<PathBuf> = names
        .filter(|path| path.extension().is_some_and(|e| e == "md"))
        .collect();
    let mut all: Vec<_> = pages
        .iter()
        .map(|path| format!("docs/{}", path.file_name().unwrap().to_str().unwrap()))
        .collect();
    all.push("README.md".to_owned());
    all.sort();
    all
}

/// A line as it is typed, without the remark behind it.
fn typed(line: &str) -> String {
    let line = line.split("  #").next().unwrap_or(line);
    line.split(" # ").next().unwrap_or(line).trim().to_owned()
}

/// The blocks of commands: `sh`, and `console` with a host's prompt before each (what has none is what a daemon says).
pub(super) fn blocks(text: &str) -> Vec<Block> {
    let mut blocks = Vec::new();
    let mut python = String::new();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        let Some(info) = line.strip_prefix("```").filter(|info| !info.is_empty()) else {
            continue;
        };
        let inside: Vec<_> = lines
            .by_ref()
            .take_while(|line| !line.starts_with("```"))
            .collect();
        let mut words = info.split(' ').map(str::to_owned);
        match words.next().as_deref() {
            Some("sh") => blocks.push(Block {
                how: words.collect(),
                lines: inside
                    .iter()
                    .map(|line| typed(line))
                    .filter(|line| !line.is_empty() && !line.starts_with('#'))
                    .collect(),
                python: python.clone(),
            }),
            Some("console") => {
                for line in inside {
                    if let Some((host @ ("robot" | "operator"), line)) = line.split_once('$') {
                        blocks.push(Block {
                            how: vec![host.to_owned()],
                            lines: vec![typed(line)],
                            python: String::new(),
                        });
                    }
                }
            }
            Some("python") => python = inside.join("\n"),
            _ => {}
        }
    }
    blocks
}

/// What is in a block that is none of commands (or in an indented one), though it begins like a command.
pub(super) fn commands_elsewhere(text: &str) -> Vec<String> {
    let programs = [
        "telemime", "cargo", "sudo", "ssh", "mdbook", "python3", "pip", "mcap", "rerun",
    ];
    let mut fence: Option<&str> = None;
    let mut found = Vec::new();
    for line in text.lines() {
        if let Some(info) = line.strip_prefix("```") {
            fence = fence.is_none().then_some(info);
            continue;
        }
        let of_commands = fence.is_some_and(|info| {
            let kind = info.split(' ').next();
            kind == Some("sh") || kind == Some("console")
        });
        let code = fence.is_some() || line.starts_with("    ");
        let bare = line.trim().trim_start_matches("$ ");
        let first = bare.split(' ').next().unwrap_or_default();
        if code && !of_commands && programs.contains(&first) && bare.contains(' ') {
            found.push(line.to_owned());
        }
    }
    found
}

/// The code spans of a text.
pub(super) fn spans(text: &str) -> Vec<String> {
    let mut fenced = false;
    let mut found = Vec::new();
    for line in text.lines() {
        if line.starts_with("```") {
            fenced = !fenced;
        } else if !fenced {
            found.extend(line.split('`').skip(1).step_by(2).map(str::to_owned));
        }
    }
    found
}
