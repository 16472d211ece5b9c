//! `telemime paper`
