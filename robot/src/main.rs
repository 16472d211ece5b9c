//! The robot daemon on its own.

use std::process::ExitCode;

use clap::Parser;
use telemime_endpoint::cli::one_line;

/// Drive an arm for a Telemime operator.
#[derive(Parser)]
#[command(version, name = "telemime-robot")]
struct Cli {
    #[command(flatten)]
    args: telemime_robot::cli::Args,
}

fn main() -> ExitCode {
    match telemime_robot::cli::run(&Cli::parse().args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("telemime-robot: {}", one_line(e.chain()));
            ExitCode::FAILURE
        }
    }
}
