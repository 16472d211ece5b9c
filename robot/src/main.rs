//! The robot daemon on its own.

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use telemime_endpoint::admin;
use telemime_endpoint::cli::one_line;
use telemime_endpoint::peers::Role;

/// Drive an arm for a Telemime operator.
#[derive(Parser)]
#[command(
    version,
    name = "telemime-robot",
    args_conflicts_with_subcommands = true
)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    args: telemime_robot::cli::Args,
}

#[derive(Subcommand)]
enum Command {
    Identity(admin::IdentityArgs),
    Peers(admin::PeersArgs),
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    let done = match &cli.command {
        None => telemime_robot::cli::run(&cli.args),
        Some(Command::Identity(args)) => admin::identity(args, Role::Robot),
        Some(Command::Peers(args)) => admin::peers(args),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("telemime-robot: {}", one_line(e.chain()));
            ExitCode::FAILURE
        }
    }
}
