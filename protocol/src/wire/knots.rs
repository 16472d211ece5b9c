//! Path knots as they ride in a motion: differences, small enough for one byte each most of the time.

use super::state::WireState;
use super::v1::WireKnot;
use crate::checkpoint::path::{PathGrid, PathKnot, tick_of};

/// The tick and the position (in steps of `grid`) that the first knot of a message is relative to.
fn origin(state: &WireState, grid: PathGrid) -> (i64, [i32; 3]) {
    let state = state.dequantise();
    let steps = state.x / grid.step_m();
    // `as` saturates; both ends compute it from the same integers.
    (
        // Rounded as knots are: one at the state's own instant must not lie after it.
        tick_of(state.t),
        [
            steps.x.round() as i32,
            steps.y.round() as i32,
            steps.z.round() as i32,
        ],
    )
}

fn difference(a: [i32; 3], b: [i32; 3]) -> [i32; 3] {
    core::array::from_fn(|d| a[d].wrapping_sub(b[d]))
}

/// `knots` (in order) relative to `state`; `None` if one lies after the state or too far before it.
pub fn pack(state: &WireState, grid: PathGrid, knots: &[PathKnot]) -> Option<Vec<WireKnot>> {
    let (mut tick, mut x) = origin(state, grid);
    let mut packed = Vec::with_capacity(knots.len());
    for (i, knot) in knots.iter().enumerate() {
        let ticks = if i == 0 {
            tick - knot.tick
        } else {
            knot.tick - tick
        };
        let ticks = u32::try_from(ticks).ok().filter(|&n| n < 1 << 31)?;
        packed.push(WireKnot {
            dt: ticks << 1 | u32::from(knot.start),
            dx: difference(knot.x, x),
            v: knot.v,
        });
        (tick, x) = (knot.tick, knot.x);
    }
    Some(packed)
}

/// What [`pack`] packed. Any input gives some knots; `PathDecoder::append` judges them.
pub fn unpack<'a>(
    state: &WireState,
    grid: PathGrid,
    knots: &'a [WireKnot],
) -> impl Iterator<Item = PathKnot> + use<'a> {
    let (mut tick, mut x) = origin(state, grid);
    knots.iter().enumerate().map(move |(i, knot)| {
        let ticks = i64::from(knot.dt >> 1);
        tick = if i == 0 {
            tick.saturating_sub(ticks)
        } else {
            tick.saturating_add(ticks)
        };
        x = core::array::from_fn(|d| x[d].wrapping_add(knot.dx[d]));
        PathKnot {
            tick,
            x,
            v: knot.v,
            start: knot.dt & 1 == 1,
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::predict::HandState;
    use crate::time::Stamp;
    use nalgebra::Vector3;

    #[test]
    fn a_knot_at_the_states_own_instant_can_always_travel() {
        let grid = PathGrid::for_bound(0.02).unwrap();
        for ns in 0..20_000 {
            let t = Stamp(3_000_000_000 + ns);
            let state = HandState::first(t, Vector3::new(0.4, -0.2, 2.5));
            let state = WireState::quantise(&state).unwrap();
            let knot = PathKnot {
                tick: tick_of(t),
                x: [70, -40, 500],
                v: [0; 3],
                start: false,
            };
            let packed = pack(&state, grid, &[knot]).expect("no later than the state");
            assert_eq!(unpack(&state, grid, &packed).next(), Some(knot), "{ns} ns");
        }
    }

    #[test]
    fn knots_come_back_and_a_later_one_is_refused() {
        let grid = PathGrid::for_bound(0.02).unwrap();
        let state = HandState::first(Stamp(3_000_000_000), Vector3::new(0.4, -0.2, 2.5));
        let state = WireState::quantise(&state).unwrap();
        let knot = |ms: i64, x, start| PathKnot {
            tick: ms * 100,
            x,
            v: [3, -400, 0],
            start,
        };
        let knots = [
            knot(2_400, [70, -40, 500], true),
            knot(2_700, [80, -41, 502], false),
            knot(3_000, [81, 0, 1], false),
        ];
        let packed = pack(&state, grid, &knots).unwrap();
        assert_eq!(unpack(&state, grid, &packed).collect::<Vec<_>>(), knots);
        assert_eq!(pack(&state, grid, &[knot(3_001, [0; 3], true)]), None);
    }
}
