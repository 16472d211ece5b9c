//! docs/commands.md knows every flag, key and event there is.

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;

const COMMANDS: [&str; 27] = [
    "demo",
    "import",
    "learn",
    "inspect",
    "list",
    "recognise",
    "confusion",
    "select",
    "evaluate",
    "codec",
    "robot",
    "replay",
    "send",
    "arm check",
    "operator",
    "identity",
    "pair",
    "peers",
    "experiment",
    "report",
    "link",
    "tap",
    "check-config",
    "doctor",
    "completions",
    "man",
    "paper",
];

fn document(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("docs")
        .join(name);
    std::fs::read_to_string(path).unwrap()
}

fn help(args: &[&str]) -> String {
    let out = Command::new(env!("CARGO_BIN_EXE_telemime"))
        .args(args)
        .arg("--help")
        .output()
        .unwrap();
    assert!(out.status.success(), "{args:?}");
    String::from_utf8(out.stdout).unwrap()
}

/// Every `--flag` at the beginning of a line of a help text.
fn flags(help: &str) -> BTreeSet<&str> {
    help.lines()
        .filter_map(|line| {
            let line = line.trim_start();
            let line = line
                .split_once(", --")
                .filter(|(short, _)| short.len() == 2)
                .map_or(line, |(short, _)| &line[short.len() + 2..]);
            let name = line
                .strip_prefix("--")?
                .split(|c: char| !(c.is_ascii_alphanumeric() || c == '-'))
                .next()?;
            (!["help", "version"].contains(&name)).then_some(name)
        })
        .collect()
}

/// The chapter about `telemime name`.
fn chapter<'a>(text: &'a str, name: &str) -> &'a str {
    let heading = format!("## telemime {name}");
    let (_, after) = text
        .split_once(&heading)
        .unwrap_or_else(|| panic!("no chapter on {name}"));
    after.split("\n## ").next().unwrap_or(after)
}

#[test]
fn every_flag_is_documented_and_every_documented_flag_exists() {
    let commands = document("commands.md");
    for name in COMMANDS.iter().filter(|name| **name != "paper") {
        let help = help(&name.split(' ').collect::<Vec<_>>());
        let there = flags(&help);
        let chapter = chapter(&commands, name);
        let documented: BTreeSet<_> = chapter
            .lines()
            .filter_map(|line| line.strip_prefix("| ")?.split(" |").next())
            .flat_map(|cell| cell.split('`'))
            .filter_map(|code| code.strip_prefix("--")?.split(' ').next())
            .collect();
        assert!(!there.is_empty() || ["inspect", "man"].contains(name));
        assert_eq!(documented, there, "{name}: the document, then the program");
    }
    let paper = document("paper.md");
    for flag in flags(&help(&["paper"])) {
        assert!(paper.contains(&format!("--{flag}")), "paper --{flag}");
    }
}

#[test]
fn every_command_is_listed() {
    let (text, program) = (document("commands.md"), help(&[]));
    for name in COMMANDS {
        let first = name.split(' ').next().unwrap();
        assert!(program.contains(&format!("\n  {first} ")), "{name}");
        assert!(text.contains(&format!("`telemime {name}`")), "{name}");
    }
}
