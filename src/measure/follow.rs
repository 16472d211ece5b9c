//! The same arm and filter on other information: floors and baselines.

use nalgebra::{UnitQuaternion, Vector3};
use telemime_robot::control::Demand;
use telemime_robot::rig::Rig;
use telemime_robot::servo::{Mapping, RAMP_S, ramp};

use super::track::Track;
use super::turns::Turns;

/// A run of an arm on its own.
#[derive(Debug, Clone)]
pub struct Follow {
    /// The tip, mapped back to the hand, over the caller's time.
    pub tip: Track,
    /// Its orientation, mapped back likewise, where one was demanded from the beginning.
    pub turn: Option<Turns>,
    /// Ticks on which a limit acted.
    pub clamps: u32,
    /// The same tick by tick, and how the tip's reference jerked, m/s³.
    pub strain: Vec<(bool, f64)>,
}

/// A hand to follow.
#[derive(Debug, Clone, Copy)]
pub struct Hand {
    /// Position, m.
    pub place: Vector3<f64>,
    /// Orientation, if it is followed.
    pub turn: Option<UnitQuaternion<f64>>,
}

impl From<Vector3<f64>> for Hand {
    fn from(place: Vector3<f64>) -> Self {
        Self { place, turn: None }
    }
}

/// Drives a fresh arm from `from_s` to `to_s` with the hand that `demanded` returns for each tick
/// (`None`: stay). The mapping's tip is the arm's start, and the displacement is eased in as at an engage.
pub fn follow(
    rig: &Rig,
    mapping: &Mapping,
    from_s: f64,
    to_s: f64,
    mut demanded: impl FnMut(f64) -> Option<Hand>,
) -> Follow {
    let (mut controller, mut plant) = rig.parts();
    let tick_s = rig.tick_s();
    let mapping = Mapping {
        tip_m: controller.reset_reference(plant.q()),
        tip_orientation: controller.turn_reference().orientation,
        ..*mapping
    };
    let (mut points, mut turns) = (Vec::new(), Vec::new());
    let mut strained = Vec::new();
    let mut acceleration = Vector3::zeros();
    let ticks = ((to_s - from_s) / tick_s).ceil().max(1.0) as u64;
    for tick in 0..ticks {
        let since_s = tick as f64 * tick_s;
        let hand = demanded(from_s + since_s).unwrap_or(Hand {
            place: mapping.hand_m,
            turn: mapping.hand_orientation,
        });
        let eased = ramp(since_s / RAMP_S);
        let (target, out_of_reach) = mapping.place(hand.place, &rig.workspace, eased);
        let output = controller.tick(
            Demand::Follow {
                target,
                orientation: hand.turn.map(|q| mapping.orient(&q, eased)),
                speed_scale: 1.0,
            },
            plant.q(),
            plant.qd(),
        );
        let strain = plant.step(&output.tau, tick_s);
        let limited =
            out_of_reach || output.clamps != Default::default() || strain != Default::default();
        let jerk_m_s3 = (output.reference.a - acceleration).norm() / tick_s;
        acceleration = output.reference.a;
        strained.push((limited, jerk_m_s3));
        points.push((from_s + since_s, mapping.unplace(output.tip)));
        if let Some(q) = mapping.unorient(&output.orientation) {
            turns.push((from_s + since_s, q));
        }
    }
    let tip = Track::new(points).expect("ticks are in order, and the arm stays finite");
    Follow {
        tip,
        turn: Turns::new(turns),
        clamps: strained.iter().filter(|(limited, _)| *limited).count() as u32,
        strain: strained,
    }
}
