//! placeholder until merged
use crate::time::Stamp;
use nalgebra::Vector3;
/// s
#[derive(Clone, Copy, Debug)]
pub struct HandState {
    /// t
    pub t: Stamp,
    /// x
    pub x: Vector3<f64>,
    /// m
    pub memory: [Vector3<f64>; 4],
}
