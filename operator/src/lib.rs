//! The operator daemon: learns skills from demonstrations, follows the hand, and speaks to the robot
//! only when the robot's own prediction would go wrong.

pub mod cli;
mod clutch;
pub mod console;
pub mod daemon;
mod dating;
pub mod demonstration;
pub mod depth;
pub mod dial;
pub mod ingest;
pub mod input;
pub mod learn;
pub mod lessons;
pub mod placed;
pub mod program;
pub mod recognise;
pub mod recording;
pub mod session;
pub mod skill_file;
pub mod tap;
pub mod task;
