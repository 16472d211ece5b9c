//! The robot daemon's own program: the daemon, and what is done to a host that has it.

use std::process::ExitCode;

use clap::{CommandFactory, Parser, Subcommand};
use telemime_endpoint::admin;
use telemime_endpoint::cli::one_line;
use telemime_endpoint::config::{self, CheckArgs};
use telemime_endpoint::peers::Role;

use crate::cli::Args;

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
    args: Args,
}

#[derive(Subcommand)]
enum Command {
    Identity(admin::IdentityArgs),
    Peers(admin::PeersArgs),
    CheckConfig(CheckArgs),
}

/// The program's command line, for man pages and completions.
pub fn command() -> clap::Command {
    Cli::command()
}

/// Parses the command line and runs it; the exit code is 0, 1 (failed, with one line on stderr) or 2 (usage, or a
/// configuration that cannot be).
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    let done = match &cli.command {
        None => crate::cli::run(&cli.args).map(|()| true),
        Some(Command::Identity(args)) => admin::identity(args, Role::Robot).map(|()| true),
        Some(Command::Peers(args)) => admin::peers(args).map(|()| true),
        Some(Command::CheckConfig(args)) => config::check::<Args>(args, &config::environment()),
    };
    match done {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(2),
        Err(e) => {
            eprintln!("telemime-robot: {}", one_line(e.chain()));
            ExitCode::FAILURE
        }
    }
}
