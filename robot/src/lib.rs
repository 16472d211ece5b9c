//! The robot daemon: decodes what the operator sends, predicts ahead of it, and drives the arm safely,
//! whatever the link does.
//!
//! Data flows one way: datagram → [`session`] → [`servo`] (prediction, [`safety`], [`control`], arm) →
//! report → [`session`] → telemetry.

pub mod blackbox;
pub mod cli;
pub mod clock;
pub mod control;
pub mod daemon;
pub mod desk;
pub mod door;
pub mod driver;
pub mod program;
pub mod recording;
pub mod refused;
pub mod rig;
pub mod safety;
pub mod servo;
pub mod session;
