//! Which moments of a finished motion to keep.

mod bounded;
mod cheapen;
mod counted;
mod fit;
mod publication;
mod search;

pub use bounded::bounded;
pub use counted::counted;
pub use publication::{gradient, publication};

use super::Plan;
use super::packed::Packer;
use super::plan::Decoder;
use cheapen::Room;
use search::{Buffers, Motion, most_points};

/// How long to look.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effort {
    /// Checkpoints on the curve, inserted until the bound holds: some passes over the samples.
    Quick,
    /// Then fewer equal shares of the curvature, off the curve, and those left out that are not needed: less than a
    /// millisecond for 300 samples.
    Brisk,
    /// Then fewer, moved, off the curve where that helps, on coarser grids, at values that are cheap to write: tenths of
    /// a second.
    Thorough,
}

/// Chooses checkpoints, motion after motion, in the same memory.
///
/// What it chose stays in it until it chooses again. Once it has chosen for a motion it allocates nothing for another that
/// has no more samples and needs no more points.
#[derive(Clone, Debug)]
pub struct Selector<const D: usize> {
    buffers: Buffers<D>,
    lists: Lists,
    room: Room<D>,
    packer: Packer,
    decoder: Decoder<D>,
    plan: Plan<D>,
    /// What it was before its values were made cheap.
    dear: Plan<D>,
    /// That of the grid with the fewest bytes.
    best: Plan<D>,
}

/// Lists of samples, by index.
#[derive(Clone, Debug, Default)]
struct Lists {
    kept: Vec<usize>,
    other: Vec<usize>,
    best: Vec<usize>,
    order: Vec<usize>,
    costs: Vec<(f64, usize)>,
}

impl<const D: usize> Selector<D> {
    /// One that has chosen nothing yet.
    pub fn new() -> Self {
        Self {
            buffers: Buffers::default(),
            lists: Lists::default(),
            room: Room::default(),
            packer: Packer::default(),
            decoder: Decoder::default(),
            plan: Plan::blank(),
            dear: Plan::blank(),
            best: Plan::blank(),
        }
    }

    /// Before a motion: a checked series.
    fn begin(&mut self, motion: Motion<'_, D>) {
        self.buffers.begin(motion);
        let most = most_points(motion.t.len());
        for plan in [&mut self.plan, &mut self.dear, &mut self.best] {
            plan.reserve(most);
        }
        let Lists {
            kept,
            other,
            best,
            order,
            costs,
        } = &mut self.lists;
        for list in [kept, other, best, order] {
            list.clear();
            list.reserve(most + 1);
        }
        costs.clear();
        costs.reserve(most);
    }
}

impl<const D: usize> Default for Selector<D> {
    fn default() -> Self {
        Self::new()
    }
}
