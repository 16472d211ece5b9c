//! The same arm and filter on other information: floors and baselines.

use nalgebra::Vector3;
use telemime_robot::control::Demand;
use telemime_robot::rig::Rig;
use telemime_robot::servo::{Mapping, RAMP_S, ramp};

use super::track::Track;

/// A run of an arm on its own.
#[derive(Debug, Clone)]
pub struct Follow {
    /// The tip, mapped back to the hand, over the caller's time.
    pub tip: Track,
    /// Ticks on which a limit acted.
    pub clamps: u32,
}

/// Drives a fresh arm from `from_s` to `to_s` with the hand position that `demanded` returns for each tick
/// (`None`: stay). The mapping's tip is the arm's start, and the displacement is eased in as at an engage.
pub fn follow(
    rig: &Rig,
    mapping: &Mapping,
    from_s: f64,
    to_s: f64,
    mut demanded: impl FnMut(f64) -> Option<Vector3<f64>>,
) -> Follow {
    let (mut controller, mut plant) = rig.parts();
    let tick_s = rig.tick_s();
    let mapping = Mapping {
        tip_m: controller.reset_reference(plant.q()),
        ..*mapping
    };
    let mut points = Vec::new();
    let mut clamps = 0;
    let ticks = ((to_s - from_s) / tick_s).ceil().max(1.0) as u64;
    for tick in 0..ticks {
        let since_s = tick as f64 * tick_s;
        let hand_m = demanded(from_s + since_s).unwrap_or(mapping.hand_m);
        let eased = ramp(since_s / RAMP_S);
        let (target, out_of_reach) = mapping.place(hand_m, &rig.workspace, eased);
        let output = controller.tick(
            Demand::Follow {
                target,
                orientation: None,
                speed_scale: 1.0,
            },
            plant.q(),
            plant.qd(),
        );
        let strain = plant.step(&output.tau, tick_s);
        clamps += u32::from(
            out_of_reach || output.clamps != Default::default() || strain != Default::default(),
        );
        points.push((from_s + since_s, mapping.unplace(output.tip)));
    }
    let tip = Track::new(points).expect("ticks are in order, and the arm stays finite");
    Follow { tip, clamps }
}
