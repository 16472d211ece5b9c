//! Telemime operator.

pub mod demonstration;
pub mod learn;
pub mod skill_file;
