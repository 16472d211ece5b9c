//! The operator daemon on its own.

use std::process::ExitCode;

use clap::Parser;
use telemime_endpoint::cli::one_line;

/// Teach, drive and play a Telemime robot.
#[derive(Parser)]
#[command(version, name = "telemime-operator")]
struct Cli {
    #[command(flatten)]
    args: telemime_operator::cli::Args,
}

fn main() -> ExitCode {
    match telemime_operator::cli::run(&Cli::parse().args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("telemime-operator: {}", one_line(e.chain()));
            ExitCode::FAILURE
        }
    }
}
