pub mod daemon;
pub mod demonstration;
pub mod learn;
pub mod session;
pub mod task;
