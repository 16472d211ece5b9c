//! The robot daemon's own program: the daemon, and what is done to a host that has it.

use std::process::ExitCode;

use clap::{CommandFactory, Parser};
use telemime_endpoint::admin::HostCommand;
use telemime_endpoint::cli::exit_code;
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
    command: Option<HostCommand>,
    #[command(flatten)]
    args: Args,
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
        Some(command) => command.run::<Args>(Role::Robot),
    };
    exit_code("telemime-robot", &done)
}
