//! Integration tests: one binary, one module a file.

mod codec;
mod paper;
mod prediction;
