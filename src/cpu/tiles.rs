//! Which splats touch which tile: per-tile lists in depth order.
//!
//! Splats in depth order are cut into chunks; each chunk counts its entries per
//! tile, a prefix sum over (tile, chunk) gives every chunk its slots, and each
//! chunk writes. Lists come out depth-sorted with no sort of (tile, depth) pairs,
//! the same for any number of threads.
//!
//! Memory is bounded: tiles are taken in groups whose lists together stay within
//! [`PAIRS_PER_GROUP`] entries (or one tile's), however many tiles the splats cover.

use crate::abi::TILE;
use crate::cpu::ewa::Footprint;
use crate::cpu::sort::{DepthSort, chunk_len};
use rayon::prelude::*;
use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

/// Most (splat, tile) pairs listed at a time: 256 MiB.
pub(crate) const PAIRS_PER_GROUP: usize = 1 << 26;

/// The tiles of a picture, row-major.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Grid {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) columns: usize,
    pub(crate) rows: usize,
}

impl Grid {
    pub(crate) fn new(width: usize, height: usize) -> Self {
        Self { width, height, columns: width.div_ceil(TILE), rows: height.div_ceil(TILE) }
    }

    pub(crate) fn len(&self) -> usize {
        self.columns * self.rows
    }

    /// Calls `each` with every tile of rows `rows` that `f` can touch.
    fn touched(&self, f: &Footprint, rows: Range<usize>, mut each: impl FnMut(usize)) {
        let first = (f.y0 as usize / TILE).max(rows.start);
        let past = (f.y1 as usize).div_ceil(TILE).min(rows.end);
        let all = (f.x0 as usize / TILE, (f.x1 as usize).div_ceil(TILE));
        // For splats smaller than a tile the rectangle is nearly as good as the
        // ellipse, and cheaper.
        let side = TILE as u32;
        let small = f.x1 - f.x0 <= side && f.y1 - f.y0 <= side;
        for row in first..past {
            let (mut from, mut to) = all;
            if !small {
                let top = (row * TILE) as f32;
                match f.span(top, top + (TILE - 1) as f32) {
                    // `as` takes what lies left of the picture to column 0.
                    Some((left, right)) if right >= 0.0 => {
                        from = from.max(left as usize / TILE);
                        to = to.min(right as usize / TILE + 1);
                    }
                    _ => continue,
                }
            }
            for column in from..to {
                each(row * self.columns + column);
            }
        }
    }
}

/// Per-tile lists, reused from frame to frame.
#[derive(Debug, Default)]
pub(crate) struct TileLists {
    grid: Grid,
    /// `[chunks, tiles]`: counts, then where each chunk's next entry goes.
    slots: Vec<u32>,
    /// `[tiles]`: entries of each tile.
    counts: Vec<u32>,
    /// `[tiles]`: first entry of each tile within its group.
    starts: Vec<usize>,
    entries: Vec<AtomicU32>,
    /// Splats, in depth order, per chunk.
    chunk: usize,
    pairs_per_group: Option<usize>,
    /// The group whose lists `entries` holds; empty after a count.
    filled: Range<usize>,
}

impl TileLists {
    /// Counts the entries of every tile.
    pub(crate) fn count(&mut self, grid: Grid, order: &DepthSort, footprints: &[Footprint]) {
        self.grid = grid;
        self.filled = 0..0;
        let tiles = grid.len();
        let chunk = chunk_len(order.len());
        self.chunk = chunk;
        self.slots.clear();
        self.slots.resize(order.len().div_ceil(chunk) * tiles, 0);
        if tiles > 0 {
            self.slots.par_chunks_mut(tiles).enumerate().for_each(|(c, counts)| {
                for rank in c * chunk..((c + 1) * chunk).min(order.len()) {
                    let f = &footprints[order.splat(rank) as usize];
                    grid.touched(f, 0..grid.rows, |t| counts[t] += 1);
                }
            });
        }
        self.counts.clear();
        self.counts.resize(tiles, 0);
        self.starts.clear();
        self.starts.resize(tiles, 0);
        for counts in self.slots.chunks(tiles.max(1)) {
            for (sum, c) in self.counts.iter_mut().zip(counts) {
                *sum += c;
            }
        }
    }

    /// Limits a group of tiles to `pairs` entries instead of [`PAIRS_PER_GROUP`].
    pub(crate) fn set_pairs_per_group(&mut self, pairs: usize) {
        self.pairs_per_group = Some(pairs);
    }

    /// All (splat, tile) pairs of the frame.
    pub(crate) fn pairs(&self) -> usize {
        self.counts.iter().map(|&c| c as usize).sum()
    }

    /// Entries of tile `t`.
    pub(crate) fn tile_len(&self, t: usize) -> usize {
        self.counts[t] as usize
    }

    /// Bytes held.
    pub(crate) fn bytes(&self) -> usize {
        4 * (self.slots.capacity() + self.counts.capacity() + self.entries.capacity())
            + 8 * self.starts.capacity()
    }

    /// The largest range of tiles from `first` on that makes one group.
    pub(crate) fn group(&self, first: usize) -> Range<usize> {
        self.group_within(first, PAIRS_PER_GROUP)
    }

    /// The same with at most `limit` pairs.
    pub(crate) fn group_within(&self, first: usize, limit: usize) -> Range<usize> {
        let limit = self.pairs_per_group.map_or(limit, |own| own.min(limit));
        let mut pairs = 0;
        let mut past = first;
        while past < self.counts.len() {
            pairs += self.counts[past] as usize;
            if pairs > limit && past > first {
                break;
            }
            past += 1;
        }
        first..past
    }

    /// Writes the lists of the tiles of `group`.
    pub(crate) fn fill(
        &mut self,
        group: &Range<usize>,
        order: &DepthSort,
        footprints: &[Footprint],
    ) {
        let tiles = self.grid.len();
        self.filled = group.clone();
        let mut next = 0;
        for t in group.clone() {
            self.starts[t] = next;
            let mut slot = next as u32;
            next += self.counts[t] as usize;
            for counts in self.slots.chunks_mut(tiles) {
                slot += std::mem::replace(&mut counts[t], slot);
            }
        }
        if self.entries.len() < next {
            self.entries.resize_with(next, AtomicU32::default);
        }
        let (grid, entries, chunk) = (self.grid, &self.entries, self.chunk);
        let rows = group.start / grid.columns..group.end.div_ceil(grid.columns);
        self.slots.par_chunks_mut(tiles).enumerate().for_each(|(c, slots)| {
            for rank in c * chunk..((c + 1) * chunk).min(order.len()) {
                let splat = order.splat(rank);
                grid.touched(&footprints[splat as usize], rows.clone(), |t| {
                    if group.contains(&t) {
                        entries[slots[t] as usize].store(splat, Relaxed);
                        slots[t] += 1;
                    }
                });
            }
        });
    }

    /// The group last filled.
    pub(crate) fn filled(&self) -> Range<usize> {
        self.filled.clone()
    }

    /// Calls `each` for every splat with a function that walks its entries in the lists
    /// of `group`, the one last filled: (tile, place in the tile's list, place among
    /// all entries), tiles ascending.
    pub(crate) fn visit(
        &self,
        group: &Range<usize>,
        order: &DepthSort,
        footprints: &[Footprint],
        each: impl Fn(u32, &mut dyn FnMut(&mut dyn FnMut(usize, usize, usize))) + Sync,
    ) {
        let (tiles, chunk) = (self.grid.len(), self.chunk);
        if tiles == 0 {
            return;
        }
        let rows = group.start / self.grid.columns..group.end.div_ceil(self.grid.columns);
        let chunks = self.slots.len() / tiles;
        (0..chunks).into_par_iter().for_each(|c| {
            // After a fill, a chunk's slots are where the next one's entries begin.
            let begin = |t: usize| match c {
                0 => self.starts[t],
                _ => self.slots[(c - 1) * tiles + t] as usize,
            };
            let mut cursor: Vec<usize> = group.clone().map(begin).collect();
            for rank in c * chunk..((c + 1) * chunk).min(order.len()) {
                let splat = order.splat(rank);
                each(splat, &mut |entry| {
                    self.grid.touched(&footprints[splat as usize], rows.clone(), |t| {
                        if let Some(slot) = t.checked_sub(group.start).and_then(|i| cursor.get_mut(i)) {
                            entry(t, *slot - self.starts[t], *slot);
                            *slot += 1;
                        }
                    });
                });
            }
        });
    }

    /// Splats of tile `t` of the group last filled, nearest first.
    pub(crate) fn list(&self, t: usize) -> &[AtomicU32] {
        &self.entries[self.starts[t]..self.starts[t] + self.counts[t] as usize]
    }
}
