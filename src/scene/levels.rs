//! Level of detail: coarser copies of a finished scene, and the choice among them for a camera.
//!
//! The Gaussians are sorted along a Morton curve and cut into blocks of [`BLOCK`]. Level 0 of a block is
//! its Gaussians. At a coarser level the Gaussians of the level before in one cell of a grid are merged
//! to one of the same moments ([`crate::finish::merge`]). The cells are boxes: each bit of the curve doubles them
//! along one axis. A level has at most half of the Gaussians of the level before. A Gaussian with a σ
//! above the cells' side stays as it is.
//!
//! Groups of four along the Morton curve were considered, but a group that spans a jump of the curve merges distant
//! Gaussians. A cell bounds the size of every merge, and one rule chooses all levels.
//!
//! The rasterizer widens each Gaussian by a low-pass. A merge conserves the optical depth after the
//! low-pass, for the size of a pixel at which its level is chosen.
//!
//! A block takes the coarsest level whose cells are at most [`CELL_PX`] pixels wide, at the distance of
//! the nearest point of the block's bounding sphere. The direction of the view has no influence, so a
//! rotation of the camera changes nothing. The same input gives the same bytes on any number of threads.
//!
//! Measured on `examples/room` (524 288 Gaussians, views of 512²), the camera moved back to 1, 2, 3, 4, 6
//! and 8 times the distance of the middle Gaussian:
//!
//! | distance | ×1 | ×2 | ×3 | ×4 | ×6 | ×8 |
//! |---|---|---|---|---|---|---|
//! | Gaussians drawn | 100 % | 100 % | 77 % | 44 % | 16 % | 10 % |
//! | PSNR to the picture of all, dB | ∞ | ∞ | 59.2 | 56.1 | 53.2 | 53.4 |
//! | the same in the pixels that the scene covers | ∞ | ∞ | 49.9 | 44.3 | 38.0 | 35.8 |
//! | the same with cells of 1.5 pixels | ∞ | 48.2 | 42.0 | 37.5 | 33.5 | 31.2 |
//!
//! `cargo bench --bench raster -- levels` times frames; benches/README.md, "Level of detail", has numbers.
//!
//! The picture of all Gaussians is itself no reference far away: the nearest of many Gaussians in a pixel
//! decide its colour, while a merge has the mean of all.

use crate::finish::merge::{Blob, CURVE_BITS, curve_code, folded};
use crate::scene::splats::Splats;
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::{ALPHA_MIN, LOWPASS, SPLAT_STRIDE};
use thiserror::Error;

/// Gaussians of a block.
pub const BLOCK: usize = 1024;
/// Largest side of the cells of a chosen level, px.
pub const CELL_PX: f32 = 1.0;
/// Largest σ of a Gaussian that is merged, sides of a cell. With 0.5, PSNR gains 1.4 dB for 1.6 times
/// the Gaussians; with 2, it loses 0.6 dB at four times the distance.
const SIGMA_MAX: f64 = 1.0;
/// Share of the Gaussians of the level before that a level holds at most. With 0.7, the levels need 2.3
/// times the memory.
const SHARE_MAX: f64 = 0.5;
/// Share of all Gaussians above which level 0 is selected everywhere. A selection copies its Gaussians
/// and gives each an SH set of its own, so that a larger share saves nothing.
const WORTH: f64 = 0.8;
/// Pixels on a cell's side for which opacities are made, [`CELL_PX`] times: with 0.35 instead, PSNR
/// loses 1.5 dB.
const PIXEL_SIDES: f64 = 1.4;

/// The levels of detail of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Levels {
    /// The scene's Gaussians along the curve.
    order: Vec<usize>,
    blocks: Vec<Block>,
    /// Gaussians of the levels above 0, each with an SH set of its own.
    merged: Splats,
}

/// Consecutive Gaussians along the curve.
#[derive(Clone, Debug, PartialEq)]
struct Block {
    centre: Vec3,
    /// Radius of the sphere that holds all means; infinite where one is not finite.
    radius: f32,
    /// Range of `order`.
    first: usize,
    count: usize,
    /// The levels above 0, finest first.
    coarse: Vec<Level>,
}

/// A level above 0 of a block.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Level {
    /// Range of `merged`.
    first: usize,
    count: usize,
    /// Side of a cube of a cell's volume, world units.
    side: f32,
}

/// A level for each block of a scene.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Selection {
    levels: Vec<u8>,
    count: usize,
}

impl Selection {
    /// Returns the number of Gaussians.
    pub fn len(&self) -> usize {
        self.count
    }

    /// Reports whether there is no Gaussian.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Reports whether the selection is the whole scene: level 0 everywhere.
    pub fn is_whole(&self) -> bool {
        self.levels.iter().all(|level| *level == 0)
    }

    /// Reports whether each block is as fine as in `other`, or finer.
    pub fn covers(&self, other: &Self) -> bool {
        self.levels.len() == other.levels.len()
            && self.levels.iter().zip(&other.levels).all(|(own, level)| own <= level)
    }

    /// Returns the level of each block, along the curve.
    pub fn levels(&self) -> &[u8] {
        &self.levels
    }
}

/// The grid of the finest cells.
struct Grid {
    low: DVec3,
    /// Side of a finest cell, world units.
    side: f64,
}

impl Grid {
    /// Returns the grid over the means that are finite.
    fn of(splats: &Splats) -> Self {
        let finite = || splats.means().map(point).filter(|mean| mean.is_finite());
        let low = finite().fold(DVec3::INFINITY, DVec3::min);
        let high = finite().fold(DVec3::NEG_INFINITY, DVec3::max);
        let extent = (high - low).max_element().max(f64::MIN_POSITIVE);
        Self { low, side: extent / f64::from((1u32 << CURVE_BITS) - 1) }
    }

    /// Returns the place of a mean on the curve: the end for one that is not finite.
    fn code(&self, mean: DVec3) -> u64 {
        let at = (mean - self.low) / self.side;
        if at.is_finite() { curve_code(at) } else { u64::MAX }
    }
}

fn point(mean: [f32; 3]) -> DVec3 {
    DVec3::from_array(mean.map(f64::from))
}

/// Reports whether the rasterizer draws Gaussian `i` where its place is in the picture.
fn is_drawn(splats: &Splats, i: usize) -> bool {
    let finite = |values: &[f32]| values.iter().all(|v| v.is_finite());
    let (gamma, delta) = splats.gain_of(i);
    finite(splats.row(i))
        && finite(splats.sh_of(i))
        && finite(&delta)
        && gamma.is_finite()
        && splats.quat_wxyz(i) != [0.0; 4]
        && splats.opacity(i) >= ALPHA_MIN
}

/// A Gaussian of a level under construction.
#[derive(Clone, Copy)]
struct Entry {
    code: u64,
    blob: Blob,
    row: [f32; SPLAT_STRIDE],
    /// Index of its SH set in the space of its block.
    set: usize,
}

/// Levels above 0 of a block.
#[derive(Default)]
struct Coarse {
    levels: Vec<Level>,
    rows: Vec<f32>,
    sh: Vec<f32>,
}

impl Levels {
    /// Makes the levels of `splats`. Gaussians that no picture shows have no part in levels above 0:
    /// those with a number that is not finite, a quaternion of zero or an opacity below 1/255.
    pub fn new(splats: &Splats) -> Self {
        let grid = Grid::of(splats);
        let code = |i: usize| (grid.code(point(splats.mean(i))), i as u32);
        let mut codes: Vec<(u64, u32)> = (0..splats.len()).into_par_iter().map(code).collect();
        codes.par_sort_unstable();
        let made: Vec<(Block, Coarse)> = codes
            .par_chunks(BLOCK)
            .enumerate()
            .map(|(at, codes)| block(splats, &grid, at * BLOCK, codes))
            .collect();
        let mut merged = Splats { rows: Vec::new(), sh: Vec::new(), gain: Vec::new(), ..*splats };
        let mut blocks = Vec::with_capacity(made.len());
        for (mut block, coarse) in made {
            let first = merged.len();
            let moved = |level: Level| Level { first: first + level.first, ..level };
            block.coarse = coarse.levels.into_iter().map(moved).collect();
            merged.rows.extend(coarse.rows);
            merged.sh.extend(coarse.sh);
            blocks.push(block);
        }
        Self { order: codes.into_iter().map(|(_, i)| i as usize).collect(), blocks, merged }
    }

    /// Returns the number of Gaussians of level 0.
    pub fn len(&self) -> usize {
        self.order.len()
    }

    /// Reports whether the scene has no Gaussian.
    pub fn is_empty(&self) -> bool {
        self.order.is_empty()
    }

    /// Returns the number of Gaussians that the levels above 0 hold together.
    pub fn coarse_len(&self) -> usize {
        self.merged.len()
    }

    /// Selects a level for each block: the coarsest whose cells are at most `cell_px` px wide in the
    /// pictures of `camera`; usually [`CELL_PX`]. Where this saves too little, and where a number is NaN,
    /// it selects level 0 everywhere.
    pub fn select(&self, camera: &Camera, cell_px: f32) -> Selection {
        let k = camera.intrinsics();
        let eye = camera.position();
        let focal = k.fx.max(k.fy);
        let level = |block: &Block| {
            let distance = (block.centre - eye).length() - block.radius;
            // A comparison with NaN is false.
            let fits = |level: &&Level| level.side * focal <= cell_px * distance;
            block.coarse.iter().take_while(fits).count()
        };
        let mut levels: Vec<u8> = self.blocks.iter().map(|block| level(block) as u8).collect();
        let count_of = |(block, level): (&Block, &u8)| block.range(*level).1;
        let mut count = self.blocks.iter().zip(&levels).map(count_of).sum();
        if count as f64 > WORTH * self.len() as f64 {
            levels.fill(0);
            count = self.len();
        }
        Selection { levels, count }
    }

    /// Returns the Gaussians of a selection among the levels of `splats`, each with an SH set of its
    /// own and without gain. Where [`Selection::is_whole`], these are `splats` themselves.
    ///
    /// # Errors
    /// `splats` or `selection` are not those of these levels, as far as their lengths tell.
    pub fn gather(&self, splats: &Splats, selection: &Selection) -> Result<Splats, LevelsError> {
        let check = |what, expected: usize, got: usize| {
            if expected == got { Ok(()) } else { Err(LevelsError { what, expected, got }) }
        };
        check("Gaussians", self.len(), splats.len())?;
        check("SH coefficients", self.merged.sh_coefficients(), splats.sh_coefficients())?;
        check("blocks", self.blocks.len(), selection.levels.len())?;
        if selection.is_whole() {
            return Ok(splats.clone());
        }
        let set = 3 * self.merged.sh_coefficients();
        let mut rows = vec![0.0; selection.count * SPLAT_STRIDE];
        let mut sh = vec![0.0; selection.count * set];
        let (mut rows_left, mut sh_left) = (&mut rows[..], &mut sh[..]);
        let mut parts = Vec::with_capacity(self.blocks.len());
        for (block, level) in self.blocks.iter().zip(&selection.levels) {
            let (first, count) = block.range(*level);
            check("Gaussians of the selection", count, count.min(rows_left.len() / SPLAT_STRIDE))?;
            let (own_rows, rows_rest) = rows_left.split_at_mut(count * SPLAT_STRIDE);
            let (own_sh, sh_rest) = sh_left.split_at_mut(count * set);
            (rows_left, sh_left) = (rows_rest, sh_rest);
            parts.push((*level, first, count, own_rows, own_sh));
        }
        check(
            "Gaussians of the selection",
            selection.count - rows_left.len() / SPLAT_STRIDE,
            selection.count,
        )?;
        parts.into_par_iter().for_each(|(level, first, count, rows, sh)| {
            if level > 0 {
                let all = &self.merged;
                rows.copy_from_slice(
                    &all.rows[first * SPLAT_STRIDE..(first + count) * SPLAT_STRIDE],
                );
                sh.copy_from_slice(&all.sh[first * set..(first + count) * set]);
                return;
            }
            let own = folded(splats, &self.order[first..first + count]);
            rows.copy_from_slice(&own.rows);
            sh.copy_from_slice(&own.sh);
        });
        Ok(Splats { rows, sh, gain: Vec::new(), ..self.merged })
    }
}

/// Reason for which a selection is refused.
#[derive(Debug, Error, PartialEq, Eq)]
#[error("levels of detail: expected {expected} {what}, got {got}")]
pub struct LevelsError {
    what: &'static str,
    expected: usize,
    got: usize,
}

impl Block {
    /// Returns the first Gaussian of a level and their number.
    fn range(&self, level: u8) -> (usize, usize) {
        match usize::from(level).checked_sub(1).and_then(|at| self.coarse.get(at)) {
            Some(level) => (level.first, level.count),
            None => (self.first, self.count),
        }
    }
}

/// Makes a block of the Gaussians `codes`, which begin at `first` of the curve.
fn block(splats: &Splats, grid: &Grid, first: usize, codes: &[(u64, u32)]) -> (Block, Coarse) {
    let shown: Vec<(u64, u32)> =
        codes.iter().copied().filter(|(_, i)| is_drawn(splats, *i as usize)).collect();
    let indices: Vec<usize> = shown.iter().map(|(_, i)| *i as usize).collect();
    let own = folded(splats, &indices);
    let entries = |(set, (code, _)): (usize, &(u64, u32))| {
        let mut row = [0.0; SPLAT_STRIDE];
        row.copy_from_slice(own.row(set));
        Entry { code: *code, blob: Blob::of(own.row(set)), row, set }
    };
    let entries: Vec<Entry> = shown.iter().enumerate().map(entries).collect();
    let low = entries.iter().fold(DVec3::INFINITY, |m, e| m.min(e.blob.mean));
    let high = entries.iter().fold(DVec3::NEG_INFINITY, |m, e| m.max(e.blob.mean));
    let centre = if entries.is_empty() { DVec3::ZERO } else { 0.5 * (low + high) };
    let radius = entries.iter().fold(0.0, |r: f64, e| r.max((e.blob.mean - centre).length()));
    let centre = centre.as_vec3();
    let radius = radius as f32;
    let new = Block { centre, radius, first, count: codes.len(), coarse: Vec::new() };
    (new, coarse(entries, own.sh, 3 * splats.sh_coefficients(), grid))
}

/// Makes the levels above 0 of the `entries` of a block, whose SH sets of `set` numbers are `sh`.
fn coarse(mut entries: Vec<Entry>, mut sh: Vec<f32>, set: usize, grid: &Grid) -> Coarse {
    let mut made = Coarse::default();
    // Each bit doubles the cells along one axis.
    for bits in 1..=3 * CURVE_BITS {
        if entries.len() < 2 {
            break;
        }
        let side = grid.side * (f64::from(bits) / 3.0).exp2();
        let cell = |e: &Entry| e.code >> bits;
        let merges = |e: &Entry| e.blob.sigmas[1] <= SIGMA_MAX * side;
        let cells = entries.chunk_by(|a, b| cell(a) == cell(b));
        let count_of = |cell: &[Entry]| {
            let merging = cell.iter().filter(|e| merges(e)).count();
            cell.len() - merging.saturating_sub(1)
        };
        let count: usize = cells.clone().map(count_of).sum();
        if count as f64 > SHARE_MAX * entries.len() as f64 {
            continue;
        }
        let pixel = PIXEL_SIDES * side / f64::from(CELL_PX);
        let lowpass = f64::from(LOWPASS) * pixel * pixel;
        let mut next: Vec<Entry> = Vec::with_capacity(count);
        for cell in cells {
            let (merging, others): (Vec<&Entry>, Vec<&Entry>) =
                cell.iter().partition(|e| merges(e));
            if let Some((first, rest)) = merging.split_first() {
                next.push(merged(first, rest, lowpass, &mut sh, set));
            }
            next.extend(others.into_iter().copied());
        }
        entries = next;
        let first = made.rows.len() / SPLAT_STRIDE;
        made.levels.push(Level { first, count, side: side as f32 });
        for entry in &entries {
            made.rows.extend(entry.row);
            made.sh.extend_from_slice(&sh[entry.set * set..(entry.set + 1) * set]);
        }
    }
    made
}

/// Merges `rest` into `first`, whose SH set receives the mean.
fn merged(first: &Entry, rest: &[&Entry], lowpass: f64, sh: &mut [f32], set: usize) -> Entry {
    let mut new = *first;
    if rest.is_empty() {
        return new;
    }
    let mut moments = first.blob.moments(lowpass);
    for entry in rest {
        let other = entry.blob.moments(lowpass);
        let part = moments.share_of(&other) as f32;
        moments = moments.joined(&other);
        for c in 0..set {
            let value = sh[entry.set * set + c];
            sh[first.set * set + c] += part * (value - sh[first.set * set + c]);
        }
    }
    new.blob = moments.write(lowpass, &mut new.row);
    new
}
