//! Telemime operator.

pub mod demonstration;
pub mod learn;
