//! The `telemime` command.

mod figure;

fn main() {}
