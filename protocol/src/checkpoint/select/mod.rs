//! Which moments of a finished motion to keep.

mod bounded;
mod cheapen;
mod counted;
mod fit;
mod publication;
mod search;

pub use bounded::{Effort, bounded, bounded_with};
pub use counted::{counted, counted_with};
pub use publication::{gradient, publication};
