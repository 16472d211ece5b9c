//! The book's commands, run as they stand: what a reader types does what the text says.
//!
//! A block ```` ```sh ```` of a chapter (or the README) is run line by line in one folder, chapter after chapter; several readers read at once, each
//! with a folder, a robot and recordings of its own. With `robot` or `operator` a block is run at that host, which here is a home of its own;
//! `interrupt` and `until-heard` are ended by Ctrl-C once they have said where they listen. What stands for something else:
//!
//! - the robot's address for `robot.example:4433` and the other names it has, and a free port for what the text listens at;
//! - for the public recordings a few files of a few folders of each set, because they are many (`data`; without them, skipped and said);
//! - for a demo that the README and a chapter have alike, that of who comes first;
//! - for a ready plan's people one of them (`experiment quick`);
//! - for what builds this program a look whether what is named exists (`cargo …`).
//!
//! What takes a program that this host lacks is skipped and said; [`NEVER`] is all that is never tried.

mod given;
mod reader;
mod text;

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::data::skipped;
use crate::processes::alone;
use reader::{Reader, cargo_has, own_tests};
use text::{blocks, commands_elsewhere, documents, read, spans};

/// In the order in which they are read: each goes on where the one before has ended.
const EVENING: [&str; 3] = ["docs/start.md", "docs/teaching.md", "docs/hosts.md"];

/// With recordings at hand.
const AT_WORK: [&str; 9] = [
    "docs/compare.md",
    "docs/experiments.md",
    "README.md",
    "docs/console.md",
    "docs/input.md",
    "docs/recordings.md",
    "docs/driver.md",
    "docs/arm.md",
    "docs/operations.md",
];

/// What is looked up and measured.
const MEASURED: [&str; 5] = [
    "docs/commands.md",
    "docs/codec.md",
    "docs/recognition.md",
    "docs/prediction.md",
    "docs/paper.md",
];

/// What no test can do, and why.
const NEVER: [(&str, &str); 4] = [
    (
        "telemime operator --connect robot --skill wave.skill --input evdev:/dev/input/event5 --stick-speed 0.25",
        "device",
    ),
    ("cargo install cargo-deb", "package"),
    (".ci/deb", "package"),
    (
        "sudo apt install ./target/debian/telemime_0.1.0-1_amd64.deb",
        "package",
    ),
];

/// Reads chapters, and says which lines were run.
fn reads(mut reader: Reader, chapters: &[&str]) -> Reader {
    for chapter in chapters {
        let begun = std::time::Instant::now();
        for block in blocks(&read(chapter)) {
            reader.reads(&block);
        }
        println!("{chapter}: {:.1} s", begun.elapsed().as_secs_f64());
    }
    reader.leaves();
    reader
}

#[test]
fn the_books_commands_do_what_it_says() {
    let _alone = alone();
    let readers = std::thread::scope(|scope| {
        let evening = scope.spawn(|| reads(Reader::new(), &EVENING));
        let work = scope.spawn(|| reads(Reader::with_recordings(), &AT_WORK));
        let measured = scope.spawn(|| reads(Reader::with_recordings(), &MEASURED));
        [evening, work, measured].map(|reader| reader.join().unwrap())
    });
    for file in [
        "runs/demo/mirror.png",
        "swing.svg",
        "swing.skill",
        "reach.skill",
    ] {
        assert!(readers[0].at(file).exists(), "{file}");
    }
    for file in [
        "runs/quick/report.html",
        "wave.svg",
        "prediction.svg",
        "robot.mcap",
        "monday.skill",
    ] {
        assert!(readers[1].at(file).exists(), "{file}");
    }
    assert!(readers[2].at("ticks.csv").exists());

    let tests = own_tests();
    let (mut ran, mut again, mut checked, mut never) = (0, 0, 0, Vec::new());
    for reader in &readers {
        let tally = &reader.tally;
        ran += tally.ran.len();
        again += tally.again;
        for line in &tally.checked {
            assert_eq!(cargo_has(line, &tests), Ok(()), "{line}");
            checked += 1;
        }
        for (line, why) in &tally.skipped {
            skipped(format_args!("the line `{line}`: {why}"));
        }
        for (line, by) in &tally.elsewhere {
            assert!(tests.contains(test_of(by)), "{line}: {by}");
        }
        never.extend(tally.never.clone());
    }
    let never: Vec<_> = never.iter().map(|(line, why)| (&**line, &**why)).collect();
    let mut all = NEVER;
    all.sort_unstable();
    let mut found = never.clone();
    found.sort_unstable();
    assert_eq!(found, all, "what is never run is stated here");
    println!(
        "{ran} lines run, {again} not again, {checked} of cargo's looked at, {} never",
        never.len()
    );
    assert!(ran > 80, "{ran}");
}

/// The test that runs the blocks with this word.
fn test_of(word: &str) -> &'static str {
    match word {
        "systemd" => "units::systemd_starts_watches_and_stops_both_units",
        "cluster" => "cluster::the_clusters_examples_give_what_one_machine_gives",
        other => panic!("who runs a block `sh {other}`?"),
    }
}

/// Every block of commands is in a chapter that is run, and every command in a block is in one of these.
#[test]
fn no_command_stands_where_nobody_runs_it() {
    let run = [&EVENING[..], &AT_WORK, &MEASURED].concat();
    for document in documents() {
        let text = read(&document);
        let typed: usize = blocks(&text).iter().map(|block| block.lines.len()).sum();
        assert!(typed == 0 || run.contains(&&*document), "{document}");
        let loose = commands_elsewhere(&text);
        assert!(
            loose.is_empty(),
            "{document}: not in a block `sh`: {loose:?}"
        );
    }
}

/// A test, bench or feature that is named in passing exists.
#[test]
fn what_cargo_is_told_in_passing_exists() {
    let tests = own_tests();
    let mut seen = 0;
    for document in documents() {
        for span in spans(&read(&document)) {
            let command = span.split_once("cargo ").map(|(_, rest)| rest);
            if let Some(rest) = command.filter(|rest| rest.contains(" --") || rest.contains("-p "))
            {
                let line = format!("cargo {rest}");
                assert_eq!(cargo_has(&line, &tests), Ok(()), "{document}: {span}");
                seen += 1;
            }
        }
    }
    assert!(seen > 8, "{seen}");
}

/// Every line of a document that is a command of ours, without what is for the shell, and those that text mentions whole.
fn command_lines(text: &str) -> Vec<String> {
    let lines = blocks(text).into_iter().flat_map(|block| block.lines);
    let mentioned = spans(text).into_iter().filter(|span| {
        let placeholder = |c: char| c.is_ascii_uppercase() || "…|[".contains(c);
        let whole = !span
            .rsplit(' ')
            .next()
            .is_some_and(|last| last.starts_with('-'));
        whole && span.split(' ').count() > 2 && !span.contains(placeholder)
    });
    let mut found = Vec::new();
    for line in lines.chain(mentioned) {
        for part in line.split(['&', '|']).map(str::trim) {
            // Where it goes is not for the program.
            let part = part.split(" >").next().unwrap_or(part);
            if part.starts_with("telemime ") {
                found.push(part.to_owned());
            }
        }
    }
    found
}

#[test]
fn every_command_line_in_the_documents_is_one() {
    let program = Path::new(env!("CARGO_BIN_EXE_telemime"));
    let mut seen = 0;
    for document in documents() {
        for line in command_lines(&read(&document)) {
            // `--help` at the end: everything before it is parsed, and nothing is done.
            let line = line.replacen("telemime", "\"$PROGRAM\"", 1);
            // A relay asks at once for whom it is.
            let line = line.replace("robot.example:", "127.0.0.1:");
            let line = line.replace("--to robot:", "--to 127.0.0.1:");
            // What comes after `--` is another's.
            let line = line.split(" -- ").next().unwrap();
            let script = format!("{line} --help");
            let out = Command::new("sh")
                .args(["-fc", &script])
                .env("PROGRAM", program)
                .env("SLURM_ARRAY_TASK_ID", "1")
                .env("JOB_COMPLETION_INDEX", "1")
                .output()
                .unwrap();
            let why = String::from_utf8_lossy(&out.stderr);
            assert!(out.status.success(), "{document}: {line}\n{why}");
            seen += 1;
        }
    }
    assert!(seen > 80, "{seen}");
}

/// The book has every page there is, and no other.
#[test]
fn the_book_has_every_page() {
    let docs: PathBuf = text::root().join("docs");
    let summary = read("docs/SUMMARY.md");
    for document in documents() {
        let name = document.trim_start_matches("docs/");
        if !["SUMMARY.md", "README.md"].contains(&name) {
            assert!(summary.contains(&format!("]({name})")), "{name}");
        }
    }
    for target in summary.split("](").skip(1) {
        let name = target.split(')').next().unwrap();
        assert!(docs.join(name).exists(), "{name}");
    }
}
