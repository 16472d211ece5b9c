//! What both ends of Telemime must compute *identically*: the skill model, Gaussian mixture
//! regression, the spline, checkpoint decoding, the predictor and the messages.
//!
//! Decoding is normative, encoding is free: how an end arrives at its output lives with that end.
//! This crate has no clock, no I/O and no platform-dependent mathematics, and a query never allocates.

pub mod checkpoint;
pub mod pose;
pub mod predict;
pub mod skill;
pub mod spline;
pub mod time;
pub mod wire;
