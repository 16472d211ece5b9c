//! Integration tests: one binary, one module a file.

mod mirror;
mod prediction;
