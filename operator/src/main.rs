//! The operator daemon on its own.

fn main() -> std::process::ExitCode {
    telemime_operator::program::main()
}
