//! The operator daemon on its own.

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use telemime_endpoint::admin;
use telemime_endpoint::cli::one_line;
use telemime_endpoint::peers::Role;

/// Teach, drive and play a Telemime robot.
#[derive(Parser)]
#[command(
    version,
    name = "telemime-operator",
    args_conflicts_with_subcommands = true
)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    args: telemime_operator::cli::Args,
}

#[derive(Subcommand)]
enum Command {
    Identity(admin::IdentityArgs),
    Peers(admin::PeersArgs),
    Pair(telemime_operator::cli::PairArgs),
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    let done = match &cli.command {
        None => telemime_operator::cli::run(&cli.args),
        Some(Command::Identity(args)) => admin::identity(args, Role::Operator),
        Some(Command::Peers(args)) => admin::peers(args),
        Some(Command::Pair(args)) => telemime_operator::cli::pair(args),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("telemime-operator: {}", one_line(e.chain()));
            ExitCode::FAILURE
        }
    }
}
