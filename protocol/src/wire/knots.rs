//! Path knots as they ride in a message: a block of bits.

use serde::{Deserialize, Serialize};

use super::codec::DecodeError;
use super::state::WireState;
use crate::checkpoint::CheckpointError;
use crate::checkpoint::path::{
    self, BlockError, Origin, POSE, PathBounds, PathGrid, PathKnot, PoseKnot, tick_of,
};

/// Knots of a path as bits: [`KnotBlock::pack`] and [`KnotBlock::unpack`]. Without knots it is empty.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct KnotBlock(pub Vec<u8>);

/// What both ends know of a path before its first knot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathCode {
    grid: PathGrid<POSE>,
    turns: bool,
    sample_us: u32,
}

impl PathCode {
    /// Of an `Engage`: its bounds, and the interval of the hand's samples, µs.
    ///
    /// # Errors
    /// As [`PathBounds::grid`].
    pub fn new(bounds: PathBounds, sample_us: u32) -> Result<Self, CheckpointError> {
        Ok(Self {
            grid: bounds.grid()?,
            turns: bounds.turn_rad().is_some(),
            sample_us,
        })
    }

    /// The grid the knots lie on.
    pub fn grid(&self) -> PathGrid<POSE> {
        self.grid
    }

    /// Whether the path carries the orientation.
    pub fn turns(&self) -> bool {
        self.turns
    }
}

/// The tick and the position (in steps of `grid`) that the first knot of a path is relative to; its orientation is
/// relative to nothing.
fn origin(state: &WireState, grid: PathGrid<POSE>) -> Origin {
    let state = state.dequantise();
    let steps = state.x / grid.step_m();
    // `as` saturates; both ends compute it from the same integers.
    Origin {
        // Rounded as knots are: one at the state's own instant must not lie after it.
        tick: tick_of(state.t),
        x: [
            steps.x.round() as i32,
            steps.y.round() as i32,
            steps.z.round() as i32,
        ],
    }
}

fn turned(origin: Origin) -> Origin<POSE> {
    let [x, y, z] = origin.x;
    Origin {
        tick: origin.tick,
        x: [x, y, z, 0, 0, 0, 0],
    }
}

/// The knots that count of those before a block.
fn recent(before: &[PoseKnot]) -> &[PoseKnot] {
    &before[before.len().saturating_sub(path::CONTEXT)..]
}

fn places(knots: &[PoseKnot]) -> Vec<PathKnot> {
    knots.iter().map(PoseKnot::place).collect()
}

impl KnotBlock {
    /// `knots` (in order), given those `before` them on the path, of which the last
    /// [`CONTEXT`](path::CONTEXT) count; `state` is the message's, and counts if there are none.
    ///
    /// `None` for knots that cannot travel: see [`path::pack`].
    pub fn pack(
        state: &WireState,
        code: PathCode,
        before: &[PoseKnot],
        knots: &[PoseKnot],
    ) -> Option<Self> {
        let (origin, before) = (origin(state, code.grid), recent(before));
        if code.turns {
            path::pack(code.sample_us, &turned(origin), before, knots)
        } else {
            path::pack(code.sample_us, &origin, &places(before), &places(knots))
        }
        .map(Self)
    }

    /// What [`KnotBlock::pack`] packed, at most `limit` knots. They are in range; `PathDecoder::append` judges
    /// them.
    ///
    /// # Errors
    /// [`BlockError`]: not a block, or not one that comes after these knots.
    pub fn unpack(
        &self,
        state: &WireState,
        code: PathCode,
        before: &[PoseKnot],
        limit: usize,
    ) -> Result<Vec<PoseKnot>, BlockError> {
        let (origin, before) = (origin(state, code.grid), recent(before));
        if code.turns {
            return path::unpack(code.sample_us, &turned(origin), before, &self.0, limit);
        }
        let knots = path::unpack(code.sample_us, &origin, &places(before), &self.0, limit)?;
        Ok(knots.into_iter().map(PoseKnot::from).collect())
    }

    /// How many knots it claims to hold, at most `limit`.
    ///
    /// # Errors
    /// [`BlockError`].
    pub fn count(&self, limit: usize) -> Result<usize, BlockError> {
        path::count(&self.0, limit)
    }

    /// Whether it holds no knot.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    pub(super) fn check(&self, field: &'static str, limit: usize) -> Result<(), DecodeError> {
        let why = match self.count(limit) {
            Ok(_) => return Ok(()),
            Err(BlockError::TooMany { .. }) => "more knots than allowed",
            Err(_) => "not a block of knots",
        };
        Err(DecodeError::Invalid { field, why })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::predict::HandState;
    use crate::time::Stamp;
    use nalgebra::Vector3;

    fn code() -> PathCode {
        PathCode::new(PathBounds::new(0.02, None), 33_333).unwrap()
    }

    fn state(ns: i64) -> WireState {
        let state = HandState::first(Stamp(ns), Vector3::new(0.4, -0.2, 2.5));
        WireState::quantise(&state).unwrap()
    }

    #[test]
    fn a_knot_at_the_states_own_instant_can_always_travel() {
        for ns in 0..20_000 {
            let t = Stamp(3_000_000_000 + ns);
            let state = state(t.0);
            let knot = PoseKnot::from(PathKnot {
                tick: tick_of(t),
                x: [35, -20, 250],
                v: [0; 3],
                start: true,
            });
            let packed = KnotBlock::pack(&state, code(), &[], &[knot]).expect("not later");
            let found = packed.unpack(&state, code(), &[], 1).unwrap();
            assert_eq!(found, [knot], "{ns} ns");
        }
    }

    #[test]
    fn knots_come_back_and_one_later_than_its_origin_is_refused() {
        let state = state(3_000_000_000);
        let knot = |ms: i64, x, v, start| {
            PoseKnot::from(PathKnot {
                tick: ms * 100,
                x,
                v,
                start,
            })
        };
        let knots = [
            knot(2_400, [35, -20, 250], [2, -400, 0], true),
            knot(2_700, [40, -20, 251], [4, -400, 0], false),
            knot(3_000, [40, 0, 1], [0; 3], false),
        ];
        let all = KnotBlock::pack(&state, code(), &[], &knots).unwrap();
        assert_eq!(all.unpack(&state, code(), &[], 3).unwrap(), knots);
        assert_eq!(all.count(3), Ok(3));
        let last = KnotBlock::pack(&state, code(), &knots[..2], &knots[2..]).unwrap();
        assert_eq!(
            last.unpack(&state, code(), &knots[..2], 3).unwrap(),
            knots[2..]
        );
        assert!(last.0.len() < all.0.len());
        let late = [knot(3_001, [0; 3], [0; 3], true)];
        assert_eq!(KnotBlock::pack(&state, code(), &[], &late), None);
        assert!(KnotBlock::pack(&state, code(), &knots, &late).is_some());
    }

    #[test]
    fn an_orientation_takes_bits_only_where_it_was_asked_for() {
        let state = state(3_000_000_000);
        let turning = PathCode::new(PathBounds::new(0.02, Some(0.05)), 33_333).unwrap();
        let knot = |ms: i64, x, v, start| PoseKnot {
            tick: ms * 100,
            x,
            v,
            start,
        };
        let knots = [
            knot(
                2_400,
                [35, -20, 250, 78, 12, 3, 0],
                [2, -400, 0, 8, 0, 0, 2],
                true,
            ),
            knot(
                2_700,
                [40, -20, 251, 79, 12, -4, 0],
                [4, -400, 0, 2, 0, 6, 0],
                false,
            ),
        ];
        let places: Vec<_> = knots.iter().map(|k| k.place().into()).collect();
        let plain = KnotBlock::pack(&state, code(), &[], &knots).unwrap();
        assert_eq!(plain.unpack(&state, code(), &[], 2).unwrap(), places);
        assert_eq!(Some(plain), KnotBlock::pack(&state, code(), &[], &places));
        let whole = KnotBlock::pack(&state, turning, &[], &knots).unwrap();
        assert_eq!(whole.unpack(&state, turning, &[], 2).unwrap(), knots);
        assert!(whole.unpack(&state, code(), &[], 2).is_err());
    }
}
