//! Integration tests: one binary, one module a file.

mod codec;
mod mirror;
mod paper;
mod prediction;
