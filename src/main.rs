//! The `telemime` command.

mod figure;
mod paper;

use clap::Parser;

/// Teleoperation that learns the operator's skills.
#[derive(Parser)]
#[command(version)]
enum Command {
    /// Reproduce the tables of the source publication beside ours.
    Paper(paper::Args),
}

fn main() -> anyhow::Result<()> {
    match Command::parse() {
        Command::Paper(args) => paper::run(&args),
    }
}
