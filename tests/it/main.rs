//! Integration tests: one binary, one module a file.

mod arms;
mod codec;
mod mirror;
mod paper;
mod play;
mod prediction;
mod safety;
mod scene;
mod strangers;
