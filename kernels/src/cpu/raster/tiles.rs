//! Lists of the splats that touch each tile.
//!
//! Projection writes, for each chunk of splats, the tiles that each visible splat can
//! touch and the number of entries of every tile. A prefix sum over (tile, chunk) gives
//! every chunk its slots; each chunk then writes its entries. The lists are in the splats'
//! order for any number of threads; each is sorted by depth where it is used.
//!
//! Memory is bounded: tiles are taken in groups whose lists together stay within
//! [`PAIRS_PER_GROUP`] entries (or one tile's), however many tiles the splats cover.

use crate::cpu::raster::ewa::Footprint;
use crate::cpu::raster::sort::entry;
use crate::cpu::shared_slice::SharedSliceMut;
use crate::layout::TILE;
use rayon::prelude::*;
use std::ops::Range;

/// Most (splat, tile) pairs listed at a time, 24 bytes each: 384 MiB.
pub(crate) const PAIRS_PER_GROUP: usize = 1 << 24;

/// Minimum number of splats in a chunk.
const CHUNK_MIN: usize = 1024;

/// Splats per chunk, a unit of parallel work: enough chunks to keep every thread busy,
/// few enough that a count per chunk and tile stays little. No result depends on it.
fn chunk_len(n: usize) -> usize {
    n.div_ceil(8 * rayon::current_num_threads()).next_multiple_of(CHUNK_MIN).max(CHUNK_MIN)
}

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

    /// Tiles of the pixel rectangle of `f`: columns, rows.
    #[inline(always)]
    fn rectangle(f: &Footprint) -> [Range<usize>; 2] {
        [
            f.x0 as usize / TILE..(f.x1 as usize).div_ceil(TILE),
            f.y0 as usize / TILE..(f.y1 as usize).div_ceil(TILE),
        ]
    }

    /// Calls `each` with every tile of rows `rows` that `f` can touch, by its ellipse.
    fn touched(&self, f: &Footprint, rows: Range<usize>, mut each: impl FnMut(usize)) {
        let [columns, own] = Self::rectangle(f);
        for row in own.start.max(rows.start)..own.end.min(rows.end) {
            let top = (row * TILE) as f32;
            let Some((left, right)) = f.span(top, top + (TILE - 1) as f32) else { continue };
            if right < 0.0 {
                continue;
            }
            // `as` takes what lies left of the picture to column 0.
            let from = columns.start.max(left as usize / TILE);
            let to = columns.end.min(right as usize / TILE + 1);
            for column in from..to {
                each(row * self.columns + column);
            }
        }
    }
}

/// Tiles of one visible splat.
#[derive(Clone, Copy, Debug, Default)]
struct Cover {
    /// Bits of the camera z.
    z: u32,
    splat: u32,
    /// Tile columns [from, to); to = 0: computed from the footprint.
    columns: [u16; 2],
    /// Tile rows.
    rows: [u16; 2],
}

/// Results of projection for one chunk of splats.
pub(crate) struct ChunkCover<'a> {
    grid: Grid,
    covers: &'a mut [Cover],
    len: &'a mut u32,
    /// Entries of every tile.
    counts: &'a mut [u32],
}

impl ChunkCover<'_> {
    /// Clears the lists of the last frame.
    pub(crate) fn clear(&mut self) {
        *self.len = 0;
        self.counts.fill(0);
    }

    /// Adds a visible splat; call it in the splats' order.
    #[inline(always)]
    pub(crate) fn add(&mut self, f: &Footprint, splat: u32) {
        let [columns, rows] = Grid::rectangle(f);
        // For splats that meet four tiles at most the rectangle is nearly as good as
        // the ellipse, and cheaper.
        let small = columns.len() <= 2 && rows.len() <= 2;
        let fits = columns.end <= usize::from(u16::MAX) && rows.end <= usize::from(u16::MAX);
        let mut cover = Cover { z: f.z.to_bits(), splat, ..Cover::default() };
        let grid = self.grid;
        let counts = &mut *self.counts;
        if small && fits {
            cover.columns = [columns.start as u16, columns.end as u16];
            cover.rows = [rows.start as u16, rows.end as u16];
            let first = rows.start * grid.columns + columns.start;
            let mut count = |t: usize| {
                if let Some(count) = counts.get_mut(t) {
                    *count += 1;
                }
            };
            count(first);
            if columns.len() == 2 {
                count(first + 1);
            }
            if rows.len() == 2 {
                count(first + grid.columns);
                if columns.len() == 2 {
                    count(first + grid.columns + 1);
                }
            }
        } else {
            grid.touched(f, 0..grid.rows, |t| counts[t] += 1);
        }
        if let Some(slot) = self.covers.get_mut(*self.len as usize) {
            *slot = cover;
            *self.len += 1;
        }
    }
}

/// Per-tile lists, reused from frame to frame.
#[derive(Debug, Default)]
pub(crate) struct TileLists {
    grid: Grid,
    /// Splats per chunk.
    chunk: usize,
    /// `[chunks, chunk]`: each chunk's first `lens` entries are valid.
    covers: Vec<Cover>,
    /// `[chunks]`: visible splats.
    lens: Vec<u32>,
    /// `[chunks, tiles]`: counts, then where each chunk's next entry goes.
    slots: Vec<u32>,
    /// `[tiles]`: entries of each tile.
    counts: Vec<u32>,
    /// `[tiles]`: first entry of each tile within its group.
    starts: Vec<u32>,
    /// Depth and place of every entry, tile by tile.
    entries: Vec<u64>,
    spare: Vec<u64>,
    /// Splat of every entry, ascending within a tile.
    splats: Vec<u32>,
    /// Places within the tile, nearest first.
    order: Vec<u32>,
    pairs_per_group: Option<usize>,
    /// The group that the lists hold; empty before a fill.
    filled: Range<usize>,
}

/// One tile's lists.
pub(crate) struct TileList<'a> {
    /// Depth and place; as long as the list.
    pub(crate) entries: &'a mut [u64],
    /// Scratch memory of the sort.
    pub(crate) spare: &'a mut [u64],
    /// Places, nearest first, once sorted.
    pub(crate) order: &'a mut [u32],
    /// Splat at each place.
    pub(crate) splats: &'a [u32],
}

/// The lists of one group of tiles, given out tile by tile to several threads.
pub(crate) struct GroupLists<'a> {
    counts: &'a [u32],
    starts: &'a [u32],
    entries: SharedSliceMut<'a, u64>,
    spare: SharedSliceMut<'a, u64>,
    order: SharedSliceMut<'a, u32>,
    splats: &'a [u32],
}

impl GroupLists<'_> {
    /// Places of the entries of tile `t` among those of the group.
    pub(crate) fn places(&self, t: usize) -> Range<usize> {
        let start = self.starts[t] as usize;
        start..start + self.counts[t] as usize
    }

    /// The lists of tile `t`.
    ///
    /// # Safety
    /// Each tile is taken at most once.
    pub(crate) unsafe fn take(&self, t: usize) -> TileList<'_> {
        let start = self.starts[t] as usize;
        let range = start..start + self.counts[t] as usize;
        // SAFETY: ranges of different tiles do not overlap, being made by a prefix sum,
        // and each is taken once (the caller's promise).
        unsafe {
            TileList {
                entries: self.entries.part(range.clone()),
                spare: self.spare.part(range.clone()),
                order: self.order.part(range.clone()),
                splats: &self.splats[range],
            }
        }
    }
}

impl TileLists {
    /// Resizes the buffers for a frame of `n` splats.
    pub(crate) fn begin(&mut self, grid: Grid, n: usize) {
        self.grid = grid;
        self.filled = 0..0;
        self.chunk = chunk_len(n);
        let chunks = n.div_ceil(self.chunk);
        if self.covers.len() < n {
            self.covers.resize(n, Cover::default());
        }
        self.lens.resize(chunks, 0);
        self.slots.resize(chunks * grid.len().max(1), 0);
    }

    /// Splats per chunk of this frame.
    pub(crate) fn chunk(&self) -> usize {
        self.chunk
    }

    /// Returns the parts that each chunk of `n` splats fills in.
    pub(crate) fn chunks(
        &mut self,
        n: usize,
    ) -> impl IndexedParallelIterator<Item = ChunkCover<'_>> {
        let grid = self.grid;
        let covers = self.covers[..n].par_chunks_mut(self.chunk).zip(&mut self.lens);
        let counts = self.slots.par_chunks_mut(grid.len().max(1));
        covers.zip(counts).map(move |((covers, len), counts)| ChunkCover {
            grid,
            covers,
            len,
            counts,
        })
    }

    /// Counts the entries of every tile, all chunks being done.
    pub(crate) fn count(&mut self) {
        let tiles = self.grid.len();
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

    /// Splats that can touch the picture.
    pub(crate) fn visible(&self) -> usize {
        self.lens.iter().map(|&n| n as usize).sum()
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
        size_of::<Cover>() * self.covers.capacity()
            + 8 * (self.entries.capacity() + self.spare.capacity())
            + 4 * (self.lens.capacity() + self.slots.capacity() + self.counts.capacity())
            + 4 * (self.starts.capacity() + self.splats.capacity() + self.order.capacity())
    }

    /// The largest range of tiles from `first` on that makes one group.
    pub(crate) fn group(&self, first: usize) -> Range<usize> {
        self.group_within(first, PAIRS_PER_GROUP)
    }

    /// The same with `limit` entries unless a lower limit was set.
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

    /// Writes the lists of the tiles of `group`, unsorted.
    pub(crate) fn fill(&mut self, group: &Range<usize>, footprints: &[Footprint]) {
        let tiles = self.grid.len();
        self.filled = group.clone();
        let mut next = 0;
        for t in group.clone() {
            self.starts[t] = next;
            next += self.counts[t];
        }
        let total = next as usize;
        // Where the next chunk's entries of each tile begin; `starts` in the end again.
        let cursor = &mut self.starts[group.clone()];
        for counts in self.slots.chunks_mut(tiles) {
            for (slot, c) in counts[group.clone()].iter_mut().zip(&mut *cursor) {
                *c += std::mem::replace(slot, *c);
            }
        }
        for (c, n) in cursor.iter_mut().zip(&self.counts[group.clone()]) {
            *c -= n;
        }
        if self.entries.len() < total {
            self.entries.resize(total, 0);
            self.spare.resize(total, 0);
            self.splats.resize(total, 0);
            self.order.resize(total, 0);
        }
        let (entries, splats) =
            (SharedSliceMut::new(&mut self.entries), SharedSliceMut::new(&mut self.splats));
        let (grid, starts) = (self.grid, &self.starts);
        let rows = group.start / grid.columns..group.end.div_ceil(grid.columns);
        let chunks = self.covers.par_chunks(self.chunk).zip(&self.lens);
        chunks.zip(self.slots.par_chunks_mut(tiles)).for_each(|((covers, len), slots)| {
            for cover in &covers[..*len as usize] {
                let mut put = |t: usize| {
                    if !group.contains(&t) {
                        return;
                    }
                    let slot = slots[t];
                    slots[t] = slot + 1;
                    // SAFETY: the prefix sum gave every entry of every chunk a slot of
                    // its own.
                    unsafe {
                        entries.write(slot as usize, entry(cover.z, slot - starts[t]));
                        splats.write(slot as usize, cover.splat);
                    }
                };
                if cover.columns[1] == 0 {
                    grid.touched(&footprints[cover.splat as usize], rows.clone(), put);
                    continue;
                }
                for row in cover.rows[0]..cover.rows[1] {
                    for column in cover.columns[0]..cover.columns[1] {
                        put(usize::from(row) * grid.columns + usize::from(column));
                    }
                }
            }
        });
    }

    /// The group last filled.
    pub(crate) fn filled(&self) -> Range<usize> {
        self.filled.clone()
    }

    /// [`TileLists::fill`] for tiles that were filled before, in the same groups or in
    /// others.
    pub(crate) fn fill_again(&mut self, group: &Range<usize>, footprints: &[Footprint]) {
        let tiles = self.grid.len().max(1);
        // After a fill, a chunk's slot is where the next chunk's entries begin.
        for c in (0..self.slots.len() / tiles).rev() {
            for t in group.clone() {
                let begin = match c {
                    0 => self.starts[t],
                    _ => self.slots[(c - 1) * tiles + t],
                };
                self.slots[c * tiles + t] -= begin;
            }
        }
        self.fill(group, footprints);
    }

    /// Calls `each` for every visible splat with its element of `targets` (`[N]`) and
    /// its entries in the lists of `group`, the one last filled, tiles ascending.
    pub(crate) fn gather<T: Send>(
        &self,
        group: &Range<usize>,
        footprints: &[Footprint],
        targets: &mut [T],
        each: impl Fn(&mut T, &[u32]) + Sync,
    ) {
        let (grid, tiles) = (self.grid, self.grid.len().max(1));
        let rows = group.start / grid.columns.max(1)..group.end.div_ceil(grid.columns.max(1));
        let chunks = self.covers.par_chunks(self.chunk).zip(&self.lens);
        chunks.zip(targets.par_chunks_mut(self.chunk)).enumerate().for_each(
            |(c, ((covers, len), targets))| {
                let mut cursor = match c {
                    0 => self.starts[group.clone()].to_vec(),
                    _ => self.slots[(c - 1) * tiles..][group.clone()].to_vec(),
                };
                let mut found = Vec::new();
                for cover in &covers[..*len as usize] {
                    found.clear();
                    let mut take = |t: usize| {
                        let slot = t.checked_sub(group.start).and_then(|i| cursor.get_mut(i));
                        if let Some(slot) = slot {
                            found.push(*slot);
                            *slot += 1;
                        }
                    };
                    if cover.columns[1] == 0 {
                        grid.touched(&footprints[cover.splat as usize], rows.clone(), take);
                    } else {
                        for row in cover.rows[0]..cover.rows[1] {
                            for column in cover.columns[0]..cover.columns[1] {
                                take(usize::from(row) * grid.columns + usize::from(column));
                            }
                        }
                    }
                    if let Some(target) = targets.get_mut(cover.splat as usize - c * self.chunk) {
                        each(target, &found);
                    }
                }
            },
        );
    }

    /// The lists of the group last filled, to be taken tile by tile.
    pub(crate) fn lists(&mut self) -> GroupLists<'_> {
        GroupLists {
            counts: &self.counts,
            starts: &self.starts,
            entries: SharedSliceMut::new(&mut self.entries),
            spare: SharedSliceMut::new(&mut self.spare),
            order: SharedSliceMut::new(&mut self.order),
            splats: &self.splats,
        }
    }
}
