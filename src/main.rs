//! The `telemime` command.

fn main() {}
