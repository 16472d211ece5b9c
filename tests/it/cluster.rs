//! The worked examples for clusters, as they stand in the document: every shard, the merge, and the same bytes.

use std::path::Path;
use std::process::Command;

const PLAN: &str = "\
[motion]
people = 1
performances = 2
[factors]
motion = \"on-model\"
method = [\"ours\", \"hold\", \"velocity\", \"floor\"]
link = \"delay 50ms 5ms loss 1%\"
";

/// Of the forty that the document has.
const SHARDS: u32 = 3;

/// The fenced block of `text` that begins with `first`.
fn block(text: &str, first: &str) -> String {
    let lines = text.lines().skip_while(|line| *line != first);
    let of: Vec<_> = lines.take_while(|line| *line != "```").collect();
    assert!(!of.is_empty(), "no block that begins with {first}");
    of.join("\n")
}

fn sh(script: &str, dir: &Path, variables: &[(&str, u32)]) {
    let program = Path::new(env!("CARGO_BIN_EXE_telemime"));
    let path = std::env::var("PATH").unwrap();
    let folder = program.parent().unwrap().display();
    let mut command = Command::new("sh");
    let command = command.args(["-c", script]).current_dir(dir);
    command.env("PATH", format!("{folder}:{path}"));
    for (name, value) in variables {
        command.env(name, value.to_string());
    }
    let done = command.output().unwrap();
    let said = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.success(), "{script}\n{said}");
}

fn same(dir: &Path, merged: &str) {
    let files = |name: &str| {
        let mut all = Vec::new();
        for folder in [dir.join(name), dir.join(name).join("series")] {
            for entry in std::fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                let short = path.strip_prefix(dir.join(name)).unwrap().to_owned();
                let kept = !["timing.json", "report.html"].contains(&short.to_str().unwrap());
                if path.is_file() && kept {
                    all.push((short, std::fs::read(&path).unwrap()));
                }
            }
        }
        all.sort();
        all
    };
    let (merged, whole) = (files(merged), files("whole"));
    assert!(whole.len() > 4);
    let differs = merged.iter().zip(&whole).find(|(a, b)| a != b);
    let differs = differs.map(|((name, _), _)| name);
    assert!(merged == whole, "merged, it is another result: {differs:?}");
}

#[test]
fn the_clusters_examples_give_what_one_machine_gives() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    std::fs::write(dir.join("latency.toml"), PLAN).unwrap();
    sh("telemime experiment latency.toml -o whole", dir, &[]);
    let text = include_str!("../../docs/experiments.md").replace("40", &SHARDS.to_string());

    // Slurm runs the script once a task, counted from 1; what comes when all are done comes after the comment.
    let script = block(&text, "#!/bin/sh");
    assert!(script.contains(&format!("#SBATCH --array=1-{SHARDS} ")));
    let (task, after) = script.split_once("# when all are done").unwrap();
    for id in 1..=SHARDS {
        sh(task, dir, &[("SLURM_ARRAY_TASK_ID", id)]);
    }
    sh(after, dir, &[]);
    same(dir, "latency");
    assert!(dir.join("latency/report.html").exists());

    // A Job counts from 0, and what it mounts is at /results.
    let job = block(&text, "apiVersion: batch/v1");
    assert!(job.contains(&format!("completions: {SHARDS}\n")));
    let line = job.lines().find(|l| l.trim().starts_with("command: ["));
    let (_, quoted) = line.unwrap().split_once('"').unwrap();
    let (command, _) = quoted.rsplit_once('"').unwrap();
    let results = dir.join("results");
    std::fs::create_dir(&results).unwrap();
    std::fs::write(results.join("latency.toml"), PLAN).unwrap();
    let here = |text: &str| text.replace("/results", results.to_str().unwrap());
    for index in 0..SHARDS {
        sh(&here(command), dir, &[("JOB_COMPLETION_INDEX", index)]);
    }
    let merge = text
        .lines()
        .find(|l| l.starts_with("telemime experiment merge /results"));
    sh(&here(merge.unwrap().trim()), dir, &[]);
    std::fs::rename(results.join("latency"), dir.join("of-the-job")).unwrap();
    same(dir, "of-the-job");
}
