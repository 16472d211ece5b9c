//! The `telemime` command, and the bench on which both daemons run together.

/// As `println!`, but a reader that has gone away (`| head`) is no reason to panic.
macro_rules! say {
    ($($arg:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stdout().lock(), $($arg)*);
    }};
}

mod arm;
pub mod cli;
mod codec;
mod demo;
mod doctor;
mod evaluate;
mod experiment;
mod figure;
pub mod ground;
mod ingest;
mod link;
pub mod measure;
mod pages;
mod paper;
mod picture;
mod process;
mod recognise;
pub mod relay;
mod replay;
mod select;
mod send;
mod tap;
mod teach;
mod ticks;
