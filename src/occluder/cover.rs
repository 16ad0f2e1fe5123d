//! Spheres that cover the cells of a solid and little else.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use glam::{Vec3, vec3};

use super::solid::Lattice;

/// The part of cells outside.
pub(super) const OUTSIDE: u16 = u16::MAX;

/// A solid in cells, each of a part.
#[derive(Clone, Debug)]
pub(super) struct Solid {
    pub lattice: Lattice,
    /// What each cell belongs to, or [`OUTSIDE`].
    pub part: Vec<u16>,
}

impl Solid {
    /// The cells inside.
    pub fn cells_inside(&self) -> impl Iterator<Item = usize> {
        (0..self.part.len()).filter(|cell| self.part[*cell] != OUTSIDE)
    }
}

/// A sphere that stands for one part, in units of cells.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Ball {
    pub center: Vec3,
    pub radius: f32,
    pub part: u16,
}

/// A set of balls and the cells that they cover. A ball covers cells outside and those of its own part: those of others may
/// move away from it.
pub(super) struct Cover<'a> {
    solid: &'a Solid,
    pub balls: Vec<Ball>,
    /// How many balls cover each cell.
    count: Vec<u16>,
    /// What it would bring to cover each cell: [`worth`], or 0 where it is covered.
    open: Vec<i8>,
    /// What covering the cells at each distance from a point would bring.
    bins: Vec<i32>,
}

/// Radii that are tried, per cell.
const RADII: f32 = 4.0;

impl<'a> Cover<'a> {
    pub fn new(solid: &'a Solid) -> Self {
        let open = solid.part.iter().map(|part| worth(*part)).collect();
        Self { solid, balls: Vec::new(), count: vec![0; solid.part.len()], open, bins: Vec::new() }
    }

    pub fn add(&mut self, ball: Ball) {
        self.mark(ball, 1);
        self.balls.push(ball);
    }

    pub fn remove(&mut self, index: usize) -> Ball {
        let ball = self.balls.swap_remove(index);
        self.mark(ball, u16::MAX);
        ball
    }

    fn mark(&mut self, ball: Ball, change: u16) {
        let Self { solid, count, open, .. } = self;
        let squared = ball.radius * ball.radius;
        rows(&solid.lattice, ball.center, ball.radius, |start, first, across| {
            for (step, index) in start.enumerate() {
                let along = first + step as f32;
                let part = solid.part[index];
                if along * along + across < squared && (part == ball.part || part == OUTSIDE) {
                    count[index] = count[index].wrapping_add(change);
                    open[index] = if count[index] > 0 { 0 } else { worth(part) };
                }
            }
        });
    }

    /// The ball about a point that brings the most, up to a radius, and how much that is.
    pub fn best_ball(&mut self, center: Vec3, part: u16, largest: f32) -> (i32, Ball) {
        let Self { solid, open, bins, .. } = self;
        bins.clear();
        bins.resize((largest * RADII) as usize + 1, 0);
        let squared = largest * largest;
        rows(&solid.lattice, center, largest, |start, first, across| {
            let cells = open[start.clone()].iter().zip(&solid.part[start]);
            for (step, (open, other)) in cells.enumerate() {
                let along = first + step as f32;
                let distance = along * along + across;
                if *open != 0 && distance < squared && (*other == part || *other == OUTSIDE) {
                    bins[(distance.sqrt() * RADII) as usize] += i32::from(*open);
                }
            }
        });
        let (mut sum, mut best, mut radius) = (0, 0, 0.0);
        for (bin, gain) in bins.iter().enumerate() {
            sum += gain;
            if sum > best {
                (best, radius) = (sum, (bin + 1) as f32 / RADII);
            }
        }
        (best, Ball { center, radius, part })
    }

    /// Adds balls, each the one about any of the centres that brings the most, until there are `balls` of them or no more
    /// brings anything. `reach` bounds radii by the index of a centre's cell.
    pub fn grow(&mut self, balls: usize, centers: &[usize], reach: impl Fn(usize) -> f32) {
        let candidate = |cover: &mut Self, cell: usize| {
            let part = cover.solid.part[cell];
            let (gain, ball) = cover.best_ball(cover.solid.lattice.center(cell), part, reach(cell));
            Candidate { gain, cell, ball }
        };
        let mut heap: BinaryHeap<Candidate> = centers.iter().map(|cell| candidate(self, *cell)).collect();
        while self.balls.len() < balls {
            // Covering cells seldom makes other balls worth more: what was best long ago is looked at first (lazy greedy).
            let Some(old) = heap.pop() else { break };
            let new = candidate(self, old.cell);
            if heap.peek().is_some_and(|next| next.gain > new.gain) {
                if new.gain > 0 {
                    heap.push(new);
                }
                continue;
            }
            if new.gain <= 0 {
                break;
            }
            self.add(new.ball);
        }
    }

    /// Moves and sizes every ball in turn for the best, in steps that start with `step` cells and are halved `halvings`
    /// times; `rounds` rounds for each.
    pub fn refine(&mut self, step: f32, halvings: u32, rounds: usize) {
        let mut step = step;
        for _ in 0..=halvings {
            for _ in 0..rounds {
                let mut moved = false;
                for index in 0..self.balls.len() {
                    moved |= self.settle(index, step);
                }
                if !moved {
                    break;
                }
            }
            step *= 0.5;
        }
    }

    /// Moves a ball by a step, or not at all, whichever is best.
    fn settle(&mut self, index: usize, step: f32) -> bool {
        let old = self.balls[index];
        self.mark(old, u16::MAX);
        let largest = 1.15 * old.radius + 2.0 * step;
        let mut best = self.best_ball(old.center, old.part, largest);
        for direction in [Vec3::X, Vec3::Y, Vec3::Z, Vec3::NEG_X, Vec3::NEG_Y, Vec3::NEG_Z] {
            let moved = self.best_ball(old.center + step * direction, old.part, largest);
            if moved.0 > best.0 {
                best = moved;
            }
        }
        // One that brings nothing stays a seed of its size, for its neighbours may make room for it.
        let new = if best.0 > 0 { best.1 } else { old };
        self.mark(new, 1);
        self.balls[index] = new;
        new != old
    }

    /// Moves the balls that bring least to where they bring most, as long as that helps, at most `times`.
    pub fn teleport(&mut self, times: usize, centers: &[usize], reach: impl Fn(usize) -> f32) {
        for _ in 0..times {
            let losses = (0..self.balls.len()).map(|index| (self.loss(index), index));
            let Some((loss, worst)) = losses.min() else { return };
            let gone = self.remove(worst);
            let open: Vec<usize> = centers.iter().copied().filter(|cell| self.open[*cell] > 0).collect();
            let stride = open.len() / 200 + 1;
            let best = open
                .iter()
                .step_by(stride)
                .map(|cell| self.best_ball(self.solid.lattice.center(*cell), self.solid.part[*cell], reach(*cell)))
                .max_by_key(|best| best.0);
            match best {
                Some((gain, ball)) if gain > loss => self.add(ball),
                _ => {
                    self.add(gone);
                    return;
                }
            }
            self.refine(1.0, 0, 1);
        }
    }

    /// What a ball brings beside the others.
    fn loss(&self, index: usize) -> i32 {
        let ball = self.balls[index];
        let Self { solid, count, .. } = self;
        let squared = ball.radius * ball.radius;
        let mut sum = 0;
        rows(&solid.lattice, ball.center, ball.radius, |start, first, across| {
            for (step, index) in start.enumerate() {
                let along = first + step as f32;
                let part = solid.part[index];
                if along * along + across < squared && count[index] == 1 && (part == ball.part || part == OUTSIDE) {
                    sum += i32::from(worth(part));
                }
            }
        });
        sum
    }

    /// Cells inside that nothing covers, and cells outside that something covers.
    pub fn errors(&self) -> [usize; 2] {
        let cells = self.solid.part.iter().zip(&self.count);
        cells.fold([0; 2], |[missing, extra], (part, count)| match (*part == OUTSIDE, *count > 0) {
            (false, false) => [missing + 1, extra],
            (true, true) => [missing, extra + 1],
            _ => [missing, extra],
        })
    }
}

/// What it is worth to cover a cell. Volume outside counts half: among the shares that were tried that brings outlines, which
/// are what shadows see, closest to the mesh's, of a flat box to less than half of the error that equal shares leave.
fn worth(part: u16) -> i8 {
    if part == OUTSIDE { -1 } else { 2 }
}

/// Calls with the rows of cells that a ball may touch: their indices, how far the first one's centre lies from the ball's
/// along the row, and the square of how far the row does.
fn rows(lattice: &Lattice, center: Vec3, radius: f32, mut row: impl FnMut(std::ops::Range<usize>, f32, f32)) {
    let dims = lattice.dims.map(|cells| cells as f32);
    let range = |at: f32, reach: f32, cells: f32| {
        let (low, high) = ((at - reach).ceil().max(0.0), (at + reach).floor().min(cells - 1.0));
        low as usize..(high + 1.0).max(0.0) as usize
    };
    let strides = lattice.strides();
    for z in range(center.z, radius, dims[2]) {
        for y in range(center.y, radius, dims[1]) {
            let offset = vec3(0.0, y as f32 - center.y, z as f32 - center.z);
            let across = offset.length_squared();
            let reach = (radius * radius - across).max(0.0).sqrt();
            let x = range(center.x, reach, dims[0]);
            let start = y * strides[1] + z * strides[2];
            if x.start < x.end {
                row(start + x.start..start + x.end, x.start as f32 - center.x, across);
            }
        }
    }
}

/// A ball that might be added.
struct Candidate {
    gain: i32,
    cell: usize,
    ball: Ball,
}

impl PartialEq for Candidate {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Candidate {}

impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Candidate {
    fn cmp(&self, other: &Self) -> Ordering {
        // Of equals the first: the same input gives the same balls.
        self.gain.cmp(&other.gain).then(other.cell.cmp(&self.cell))
    }
}
