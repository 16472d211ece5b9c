//! The `telemime` command.

mod figure;
mod paper;

use std::process::ExitCode;

use clap::Parser;

/// Teleoperation that learns the operator's skills.
#[derive(Parser)]
#[command(version)]
enum Command {
    /// Reproduce the tables of the source publication beside ours.
    Paper(paper::Args),
}

fn main() -> ExitCode {
    let done = match Command::parse() {
        Command::Paper(args) => paper::run(&args),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("telemime: {e:#}");
            ExitCode::FAILURE
        }
    }
}
