//! Telemime operator.
