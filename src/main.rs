//! The `telemime` command.

use std::process::ExitCode;

fn main() -> ExitCode {
    telemime::cli::main()
}
