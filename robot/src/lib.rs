//! The robot daemon: decodes, predicts, keeps safe, drives the arm.

pub mod control;
