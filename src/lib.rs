//! The `telemime` command, and the bench on which both daemons run together.

pub mod ground;
pub mod measure;
