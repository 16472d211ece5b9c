//! The robot daemon on its own.

fn main() -> std::process::ExitCode {
    telemime_robot::program::main()
}
