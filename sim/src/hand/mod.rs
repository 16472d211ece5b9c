//! A synthetic operator.
