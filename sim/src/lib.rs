//! Telemime sim.
