pub mod arm;
pub mod hand;
pub mod link;
