//! Integration tests: one binary, one module a file.

#![allow(
    clippy::unwrap_used,
    reason = "a test that cannot go on says where it stopped"
)]

mod prediction;
