//! Integration tests: one binary, one module a file.

mod arms;
mod codec;
mod mirror;
mod paper;
mod prediction;
mod processes;
mod safety;
mod scene;
