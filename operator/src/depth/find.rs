//! The hand in a depth frame: the far end of whatever reaches out of the body towards the camera.
//!
//! 1. The frame is thinned to at most 320 cells a row, and every cell takes the median of the seen ones around it: specks go,
//!    small holes close.
//! 2. The *nearest point* is the least depth that a patch of [`PATCH_CM2`] reaches; the *body* is the median depth of what
//!    lies within an arm's length behind it.
//! 3. What is nearer than the body by [`AWAY_M`] is arm. Its connected pieces are candidates; a temporal gate keeps to the
//!    one that was followed, else the nearest counts.
//! 4. Distances along the surface begin at the middle of the body. What is farthest of a piece, and on from there where the
//!    forearm goes back again, is the tip of the fingers; the hand is the last [`HAND_M`] before it, and its position their
//!    centroid, moved by half a hand's thickness away from the camera.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use nalgebra::Vector3;

use super::{Camera, Size};

/// Cells a row at most.
const CELLS: usize = 320;

/// Surfaces nearer than this to the camera are not measured well by any, m; and farther ones are no operator.
const RANGE_M: (f64, f64) = (0.3, 5.0);

/// A patch as large as this is no speck, cm²: half of a fist.
const PATCH_CM2: f64 = 30.0;

/// The body lies within this behind the nearest point, m: a stretched arm and half a chest.
const REACH_M: f64 = 0.95;

/// What is nearer than the body by this is arm, m.
const AWAY_M: f64 = 0.15;

/// Neighbouring cells whose depths differ by less are one surface, m.
const STEP_M: f64 = 0.06;

/// From the tips of the fingers to the wrist, along the surface, m.
const HAND_M: f64 = 0.18;

/// Surfaces farther behind the body than this are no part of the person, m.
const BEHIND_M: f64 = 0.35;

/// Distances along the surface begin within this of the middle of the body, m.
const MIDDLE_M: f64 = 0.1;

/// From where the forearm leaves what is arm for sure, it goes on at most this far, m.
const FOREARM_M: f64 = 0.4;

/// A hand has no more surface than this, cm².
const LARGEST_CM2: f64 = 300.0;

/// What of an arm that points at the camera is hand, m.
const POINTING_M: f64 = 0.12;

/// The palm lies this far behind its surface, m.
const THICK_M: f64 = 0.02;

/// The hand that was followed is looked for this near to where it was, m, for as long as this, s.
const GATE: (f64, f64) = (0.45, 0.25);

/// A hand in a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Found {
    /// Its centroid, m: x right, y up, z away from the camera.
    pub position: Vector3<f64>,
    /// Its surface, cm².
    pub area_cm2: f64,
    /// How much nearer it is than the body, m.
    pub away_m: f64,
}

/// Looks for the hand, frame by frame.
#[derive(Debug, Clone)]
pub struct Finder {
    camera: Camera,
    stride: usize,
    columns: usize,
    rows: usize,
    /// Depth of each cell, m; 0 where nothing is seen.
    cells: Vec<f32>,
    thinned: Vec<f32>,
    /// Whether a cell was visited.
    seen: Vec<bool>,
    /// Distance along the surface from the middle of the body, m; infinite where there is no way.
    along: Vec<f32>,
    last: Option<(f64, Vector3<f64>)>,
}

/// A connected piece of arm.
#[derive(Debug, Default)]
struct Piece {
    cells: Vec<usize>,
    nearest_m: f32,
}

impl Finder {
    /// For the frames of `camera`.
    pub fn new(camera: Camera) -> Self {
        let Size { width, height } = camera.size();
        let stride = width.div_ceil(CELLS);
        let (columns, rows) = (width / stride, height / stride);
        let n = columns * rows;
        Self {
            camera,
            stride,
            columns,
            rows,
            cells: vec![0.0; n],
            thinned: vec![0.0; n],
            seen: vec![false; n],
            along: vec![0.0; n],
            last: None,
        }
    }

    /// The camera.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The hand in `frame`, row by row from the top, 0 where nothing was measured, taken at `t_s`; `None` if no hand is
    /// away from the body. A frame of another size has none.
    pub fn find(&mut self, t_s: f64, frame: &[u16]) -> Option<Found> {
        let Size { width, height } = self.camera.size();
        if frame.len() != width * height {
            return None;
        }
        self.thin(frame);
        self.median();
        let nearest_m = self.nearest()?;
        let body_m = self.body(nearest_m)?;
        let limit_m = body_m - AWAY_M;
        if f64::from(nearest_m) >= limit_m {
            return None;
        }
        let pieces = self.split(limit_m as f32);
        self.measure(limit_m as f32, (body_m + BEHIND_M) as f32);
        let hands: Vec<_> = pieces
            .iter()
            .filter_map(|piece| self.hand(piece, body_m))
            .collect();
        let recent = self.last.filter(|(at_s, _)| t_s - at_s <= GATE.1);
        let followed = recent.and_then(|(_, last)| {
            let off = |hand: &&Found| (hand.position - last).norm();
            let best = hands.iter().min_by(|a, b| off(a).total_cmp(&off(b)))?;
            (off(&best) <= GATE.0).then_some(*best)
        });
        let found = followed.or_else(|| {
            let first = |a: &&Found, b: &&Found| b.away_m.total_cmp(&a.away_m);
            hands.iter().min_by(first).copied()
        })?;
        self.last = Some((t_s, found.position));
        Some(found)
    }

    /// One cell for `stride` × `stride` pixels: the lower median of what they see.
    fn thin(&mut self, frame: &[u16]) {
        let (near, far) = RANGE_M;
        let (unit, width) = (self.camera.unit_m(), self.camera.size().width);
        let mut seen: Vec<u16> = Vec::with_capacity(self.stride * self.stride);
        for row in 0..self.rows {
            for column in 0..self.columns {
                seen.clear();
                for dy in 0..self.stride {
                    let at = (row * self.stride + dy) * width + column * self.stride;
                    let pixels = &frame[at..at + self.stride];
                    seen.extend(pixels.iter().filter(|d| **d != 0));
                }
                seen.sort_unstable();
                let depth_m = match seen.len() {
                    0 => 0.0,
                    n => f64::from(seen[(n - 1) / 2]) * unit,
                };
                let usable = (near..=far).contains(&depth_m);
                self.thinned[row * self.columns + column] =
                    if usable { depth_m as f32 } else { 0.0 };
            }
        }
    }

    /// The median of the seen cells among nine, where most are seen.
    fn median(&mut self) {
        self.cells.fill(0.0);
        for row in 1..self.rows.saturating_sub(1) {
            for column in 1..self.columns.saturating_sub(1) {
                let mut seen = [0.0_f32; 9];
                let mut n = 0;
                for r in row - 1..=row + 1 {
                    let at = r * self.columns + column;
                    for &d in &self.thinned[at - 1..=at + 1] {
                        if d > 0.0 {
                            seen[n] = d;
                            n += 1;
                        }
                    }
                }
                if n >= 5 {
                    seen[..n].sort_unstable_by(f32::total_cmp);
                    self.cells[row * self.columns + column] = seen[(n - 1) / 2];
                }
            }
        }
    }

    /// The surface a cell at this depth stands for, cm².
    fn area_cm2(&self, depth_m: f64) -> f64 {
        let pixels = self.stride * self.stride;
        self.camera.pixel_m2(depth_m) * pixels as f64 * 1e4
    }

    fn surface_cm2(&self, cells: &[usize]) -> f64 {
        let area = |cell: &usize| self.area_cm2(f64::from(self.cells[*cell]));
        cells.iter().map(area).sum()
    }

    /// The least depth (m) at which, a hand's thickness taken together, a patch large enough lies.
    fn nearest(&self) -> Option<f32> {
        const BIN_M: f64 = 0.02;
        const TOGETHER: usize = 4;
        let mut areas = vec![0.0; (RANGE_M.1 / BIN_M) as usize + 1];
        for &d in self.cells.iter().filter(|d| **d > 0.0) {
            let d = f64::from(d);
            areas[(d / BIN_M) as usize] += self.area_cm2(d);
        }
        let enough = |w: &[f64]| w.iter().sum::<f64>() >= PATCH_CM2;
        let first = areas.windows(TOGETHER).position(enough)?;
        // Of the window that is the first to hold enough, the last bin made it so.
        let nearest = areas[first..].iter().position(|a| *a > 0.0)? + first;
        Some((nearest as f64 * BIN_M) as f32)
    }

    /// The median depth (m) of what an arm may be of.
    fn body(&self, nearest_m: f32) -> Option<f64> {
        let behind = nearest_m..=nearest_m + REACH_M as f32;
        let mut depths: Vec<f32> = self
            .cells
            .iter()
            .filter(|d| **d > 0.0 && behind.contains(*d))
            .copied()
            .collect();
        let middle = depths.len().checked_sub(1)? / 2;
        let (_, median, _) = depths.select_nth_unstable_by(middle, f32::total_cmp);
        Some(f64::from(*median))
    }

    /// Connected pieces nearer than `limit_m`.
    fn split(&mut self, limit_m: f32) -> Vec<Piece> {
        self.seen.fill(false);
        let mut found = Vec::new();
        for start in 0..self.cells.len() {
            let arm = |d: f32| d > 0.0 && d < limit_m;
            if !arm(self.cells[start]) || self.seen[start] {
                continue;
            }
            let cells = self.grow(start, |this, cell| arm(this.cells[cell]));
            let nearest = cells.iter().map(|&cell| self.cells[cell]);
            found.push(Piece {
                nearest_m: nearest.fold(f32::INFINITY, f32::min),
                cells,
            });
        }
        found
    }

    /// The surface around `start` of cells that were not seen yet and belong to it.
    fn grow(&mut self, start: usize, belongs: impl Fn(&Self, usize) -> bool) -> Vec<usize> {
        let mut cells = vec![start];
        self.seen[start] = true;
        let mut next = 0;
        while let Some(&cell) = cells.get(next) {
            next += 1;
            for other in around(cell, self.columns) {
                if !self.seen[other] && self.joined(cell, other) && belongs(self, other) {
                    self.seen[other] = true;
                    cells.push(other);
                }
            }
        }
        cells
    }

    /// Whether two neighbours are of one surface.
    fn joined(&self, a: usize, b: usize) -> bool {
        let (a, b) = (self.cells[a], self.cells[b]);
        b > 0.0 && (b - a).abs() <= STEP_M as f32
    }

    /// The end of an arm; `None` if it is too small to be one.
    fn hand(&mut self, piece: &Piece, body_m: f64) -> Option<Found> {
        if self.surface_cm2(&piece.cells) < PATCH_CM2 {
            return None;
        }
        let along = &self.along;
        let reached = piece
            .cells
            .iter()
            .copied()
            .filter(|c| along[*c].is_finite());
        let farthest = reached.max_by(|a, b| along[*a].total_cmp(&along[*b]));
        let climbed = farthest.map(|cell| {
            let tip = self.tip(cell);
            self.seen.fill(false);
            let from_m = self.along[tip] - HAND_M as f32;
            self.grow(tip, |this, cell| {
                this.along[cell].is_finite() && this.along[cell] >= from_m
            })
        });
        // Where the hand touches the body its surface goes on: then it is what of the arm is before the body.
        let before = farthest.map(|cell| {
            let from_m = self.along[cell] - HAND_M as f32;
            let end = |cell: &usize| self.along[*cell] >= from_m;
            piece.cells.iter().copied().filter(end).collect::<Vec<_>>()
        });
        let mut ends = [climbed, before].into_iter().flatten();
        let hand = ends.find(|cells| self.surface_cm2(cells) <= LARGEST_CM2);
        // It points at the camera and hides what it hangs on.
        let hand = hand.unwrap_or_else(|| {
            let to_m = piece.nearest_m + POINTING_M as f32;
            let near = |cell: &usize| self.cells[*cell] <= to_m;
            piece.cells.iter().copied().filter(near).collect()
        });
        let sum: Vector3<f64> = hand.iter().map(|&cell| self.point(cell)).sum();
        let surface = sum / hand.len() as f64;
        Some(Found {
            position: surface * (1.0 + THICK_M / surface.norm()),
            area_cm2: self.surface_cm2(&hand),
            away_m: body_m - f64::from(piece.nearest_m),
        })
    }

    /// The end of the arm whose farthest cell in front of the body is `cell`: where the forearm goes back, it is farther.
    fn tip(&mut self, cell: usize) -> usize {
        let from_m = self.along[cell];
        self.seen.fill(false);
        let on = self.grow(cell, |this, cell| {
            this.along[cell].is_finite() && this.along[cell] >= from_m
        });
        let farther = |a: &&usize, b: &&usize| self.along[**a].total_cmp(&self.along[**b]);
        let tip = on.iter().max_by(farther).copied().unwrap_or(cell);
        // A way that goes on much farther leads from a hand on the hip down the leg.
        if self.along[tip] - from_m <= FOREARM_M as f32 {
            tip
        } else {
            cell
        }
    }

    /// How far each cell nearer than `to_m` is along the surface from the middle of what is farther than `from_m`.
    fn measure(&mut self, from_m: f32, to_m: f32) {
        self.along.fill(f32::INFINITY);
        let body = (0..self.cells.len()).filter(|c| (from_m..to_m).contains(&self.cells[*c]));
        let mut body: Vec<usize> = body.collect();
        if body.is_empty() {
            return;
        }
        let middle = body.len() / 2;
        // Cells are numbered row by row.
        let row = body[middle] / self.columns;
        let columns = self.columns;
        body.sort_unstable_by_key(|cell| cell % columns);
        let middle = row * columns + body[middle] % columns;
        let nearest = body.iter().copied().min_by_key(|&cell| {
            let (x, y) = (cell % columns, cell / columns);
            x.abs_diff(middle % columns).pow(2) + y.abs_diff(middle / columns).pow(2)
        });
        let Some(centre) = nearest.map(|cell| self.point(cell)) else {
            return;
        };
        let mut open = BinaryHeap::new();
        for &cell in &body {
            if (self.point(cell) - centre).norm() <= MIDDLE_M {
                self.along[cell] = 0.0;
                open.push((Reverse(0_u32), cell));
            }
        }
        // Whole tenths of a millimetre: a heap wants an order.
        while let Some((Reverse(tenths), cell)) = open.pop() {
            let so_far = tenths as f32 * 1e-4;
            if so_far > self.along[cell] + 1e-4 {
                continue;
            }
            let here = self.point(cell);
            for other in around(cell, columns) {
                if !self.joined(cell, other) || self.cells[other] >= to_m {
                    continue;
                }
                let there = so_far + (self.point(other) - here).norm() as f32;
                if there + 1e-4 < self.along[other] {
                    self.along[other] = there;
                    open.push((Reverse((there * 1e4).round() as u32), other));
                }
            }
        }
    }

    /// Where a cell's surface is, m.
    fn point(&self, cell: usize) -> Vector3<f64> {
        let middle = (self.stride as f64 - 1.0) / 2.0;
        let u = (cell % self.columns * self.stride) as f64 + middle;
        let v = (cell / self.columns * self.stride) as f64 + middle;
        self.camera.point(u, v, f64::from(self.cells[cell]))
    }
}

/// The eight cells around one that is not at the rim; rims hold nothing.
fn around(cell: usize, columns: usize) -> impl Iterator<Item = usize> {
    let up = cell - columns;
    let down = cell + columns;
    [
        cell - 1,
        cell + 1,
        up - 1,
        up,
        up + 1,
        down - 1,
        down,
        down + 1,
    ]
    .into_iter()
}
