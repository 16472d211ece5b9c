//! Where the two daemons meet. *Virtual*: both run on one thread, on real quinn over an in-memory
//! network, under a paused clock; everything else is as in the processes.

mod ends;
mod net;
mod pair;
mod tap;

pub use ends::{Operator, Robot};
pub use net::{Network, Passage, Socket};
pub use pair::{PATIENCE, Pair, PairError, run_virtual};
pub use tap::{Told, Watcher};
