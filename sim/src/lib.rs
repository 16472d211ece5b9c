//! Everything that stands in for the physical world: an arm built from its URDF and an operator's hand.

pub mod arm;
pub mod hand;
