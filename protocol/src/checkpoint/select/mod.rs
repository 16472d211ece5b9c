//! Which moments of a finished motion to keep.

mod bounded;
mod publication;

pub use bounded::bounded;
pub use publication::{gradient, publication};
