//! Path knots as they ride in a message: a block of bits.

use serde::{Deserialize, Serialize};

use super::codec::DecodeError;
use super::state::WireState;
use crate::checkpoint::path::{self, BlockError, Origin, PathGrid, PathKnot, tick_of};

/// Knots of a path as bits: [`KnotBlock::pack`] and [`KnotBlock::unpack`]. Without knots it is empty.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct KnotBlock(pub Vec<u8>);

/// What both ends know of a path before its first knot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathCode {
    /// The grid of the path's bound.
    pub grid: PathGrid,
    /// `Engage::sample_us`: the interval of the hand's samples, µs.
    pub sample_us: u32,
}

/// The tick and the position (in steps of `grid`) that the first knot of a path is relative to.
fn origin(state: &WireState, grid: PathGrid) -> Origin {
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

impl KnotBlock {
    /// `knots` (in order), given those `before` them on the path, of which the last
    /// [`CONTEXT`](path::CONTEXT) count; `state` is the message's, and counts if there are none.
    ///
    /// `None` for knots that cannot travel: see [`path::pack`].
    pub fn pack(
        state: &WireState,
        code: PathCode,
        before: &[PathKnot],
        knots: &[PathKnot],
    ) -> Option<Self> {
        let origin = origin(state, code.grid);
        path::pack(code.sample_us, &origin, before, knots).map(Self)
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
        before: &[PathKnot],
        limit: usize,
    ) -> Result<Vec<PathKnot>, BlockError> {
        let origin = origin(state, code.grid);
        path::unpack(code.sample_us, &origin, before, &self.0, limit)
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
        PathCode {
            grid: PathGrid::for_bound(0.02).unwrap(),
            sample_us: 33_333,
        }
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
            let knot = PathKnot {
                tick: tick_of(t),
                x: [35, -20, 250],
                v: [0; 3],
                start: true,
            };
            let packed = KnotBlock::pack(&state, code(), &[], &[knot]).expect("not later");
            let found = packed.unpack(&state, code(), &[], 1).unwrap();
            assert_eq!(found, [knot], "{ns} ns");
        }
    }

    #[test]
    fn knots_come_back_and_one_later_than_its_origin_is_refused() {
        let state = state(3_000_000_000);
        let knot = |ms: i64, x, v, start| PathKnot {
            tick: ms * 100,
            x,
            v,
            start,
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
}
