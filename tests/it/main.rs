//! Integration tests: one binary, one module a file.
#![allow(
    clippy::unwrap_used,
    reason = "clippy.toml allows it in tests, but does not know these helpers for tests"
)]

mod adapting;
mod alignment;
mod arms;
mod blackbox;
mod book;
mod cluster;
mod codec;
mod commands;
mod config;
mod correct;
mod data;
mod depth;
mod driver;
mod evaluate;
mod floods;
mod frames;
mod gate;
mod goodbye;
mod grounds;
mod horizon;
mod ingest;
mod input;
mod interop;
mod layout;
mod link;
mod live;
mod mirror;
mod operations;
mod overhead;
mod pairing;
mod paper;
mod picture;
mod play;
mod prediction;
mod processes;
mod protocol;
mod recognition;
mod recordings;
mod recovery;
mod refinement;
mod safety;
mod scene;
mod selection;
mod soak;
mod strangers;
mod tap;
mod units;
mod versions;
mod wrist;
