//! Telemime robot.
