//! Integration tests: one binary, one module a file.
#![allow(
    clippy::unwrap_used,
    reason = "clippy.toml allows it in tests, but does not know these helpers for tests"
)]

mod alignment;
mod arms;
mod codec;
mod commands;
mod correct;
mod data;
mod frames;
mod ingest;
mod layout;
mod mirror;
mod paper;
mod picture;
mod play;
mod prediction;
mod processes;
mod protocol;
mod recognition;
mod refinement;
mod safety;
mod scene;
mod selection;
mod strangers;
mod wrist;
