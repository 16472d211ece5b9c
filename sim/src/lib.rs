//! Stand-ins for the physical world: an arm, a hand, a link. Nothing here knows of daemons or sockets.

pub mod arm;
pub mod hand;
pub mod link;
