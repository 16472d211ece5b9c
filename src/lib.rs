//! The `telemime` command, and the bench on which both daemons run together.

pub mod cli;
mod demo;
mod figure;
pub mod ground;
pub mod measure;
mod paper;
pub mod relay;
mod teach;
