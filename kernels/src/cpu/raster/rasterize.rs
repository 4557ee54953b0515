//! The whole forward pass: project, list per tile; then for each tile sort by depth,
//! composite, write.
//!
//! In: [`SplatSlices`], a camera, [`RasterOptions`]. Out, H × W pixels row-major:
//! RGB over the background, accumulated alpha 1 − T, and Σ w·z with z the camera z
//! of the means in world units (in either convention). Tiles run in rayon's current pool;
//! the bytes do not depend on its size. All SIMD levels give the same bytes except
//! [`SimdLevel::Baseline`], which rounds products.
//!
//! A splat is one 64-byte record, not an entry in a structure of arrays, because tiles gather
//! splats by index.

pub use crate::layout::Rendered;

use crate::camera::Camera;
use crate::clock::Instant;
use crate::cpu::raster::blend::{BLOCKS, RenderTile, Rules, Tile, Workplace};
use crate::cpu::raster::ewa::{Footprint, View};
use crate::cpu::raster::project::{Projection, SplatSlices};
use crate::cpu::raster::rasterize_bwd::Buffers;
use crate::cpu::raster::sort::depth_order;
use crate::cpu::raster::tiles::{Grid, TileLists};
use crate::cpu::shared_slice::SharedSliceMut;
use crate::cpu::simd::{Kernel, Simd, SimdLevel};
use crate::layout::{BLOCK, RasterOptions, TILE};
use rayon::prelude::*;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering::Relaxed};
use std::time::Duration;

/// Counts and times of the last frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stats {
    /// Splats that can touch the picture.
    pub visible: usize,
    /// (splat, tile) pairs listed.
    pub pairs: usize,
    /// (splat, 4×4 block) items blended.
    pub items: usize,
    /// Bytes that the context holds, pictures excluded.
    pub bytes: usize,
}

/// Time of each stage of the last frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StageTimes {
    /// Geometry, colour and counting, from start to end.
    pub project: Duration,
    /// Prefix sums and the writing of lists, from start to end.
    pub list: Duration,
    /// Sorting, compositing and writing of tiles, from start to end.
    pub tiles: Duration,
    /// Sorting by depth, summed over threads.
    pub sort: Duration,
    /// Compositing, summed over threads.
    pub blend: Duration,
    /// Writing pixels, summed over threads.
    pub write: Duration,
}

/// Nanoseconds that tiles took, added up by all threads.
#[derive(Debug, Default)]
struct Clocks {
    sort: AtomicU64,
    blend: AtomicU64,
    write: AtomicU64,
}

/// The rasterizer with its buffers: a frame no larger than the last allocates
/// nothing.
#[derive(Debug, Default)]
pub struct Rasterizer {
    pub(crate) level: SimdLevel,
    pub(crate) timed: bool,
    pub(crate) projection: Projection,
    pub(crate) lists: TileLists,
    pub(crate) grid: Grid,
    /// Tiles in the order of work.
    queue: Vec<u32>,
    stats: Stats,
    times: StageTimes,
    pub(crate) back: Buffers,
}

/// A picture being written, tile by tile: pixel p's channel c stands at
/// `rgb[p·step + c·channel]`.
struct Target<'a> {
    rgb: SharedSliceMut<'a, f32>,
    step: usize,
    channel: usize,
    alpha: SharedSliceMut<'a, f32>,
    depth_sum: SharedSliceMut<'a, f32>,
    background: [f32; 3],
}

impl Rasterizer {
    /// A context without buffers; they grow with the first frame.
    pub fn new() -> Self {
        Self::default()
    }

    /// Limits the memory of the per-tile lists to about `pairs` × 24 bytes (default
    /// 2²⁴ pairs). The picture does not depend on it.
    pub fn with_pairs_per_group(mut self, pairs: usize) -> Self {
        self.lists.set_pairs_per_group(pairs);
        self
    }

    /// Uses the instructions of `level` (default [`SimdLevel::best`]), or the baseline's if
    /// the processor lacks them. Levels that fuse multiply and add give the same bytes. The
    /// baseline differs by about 1e-6 of a colour, and by a contribution of 1/255 where
    /// rounding decides whether a splat is skipped.
    pub fn with_simd_level(mut self, level: SimdLevel) -> Self {
        self.level = level;
        self
    }

    /// Enables the measurement of [`Rasterizer::stage_times`].
    pub fn with_stage_times(mut self) -> Self {
        self.timed = true;
        self
    }

    /// Renders `splats` seen by `camera`.
    pub fn render(
        &mut self,
        splats: &SplatSlices,
        camera: &Camera,
        options: &RasterOptions,
    ) -> Rendered {
        let mut out = Rendered::default();
        self.render_into(splats, camera, options, &mut out);
        out
    }

    /// [`Rasterizer::render`] into a picture whose buffers are reused.
    pub fn render_into(
        &mut self,
        splats: &SplatSlices,
        camera: &Camera,
        options: &RasterOptions,
        out: &mut Rendered,
    ) {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        (out.width, out.height) = (width, height);
        out.rgb.resize(3 * width * height, 0.0);
        out.alpha.resize(width * height, 0.0);
        out.depth_sum.resize(width * height, 0.0);
        let target = Target {
            rgb: SharedSliceMut::new(&mut out.rgb),
            step: 3,
            channel: 1,
            alpha: SharedSliceMut::new(&mut out.alpha),
            depth_sum: SharedSliceMut::new(&mut out.depth_sum),
            background: options.background,
        };
        self.project(splats, camera, options);
        self.composite(options, &target);
    }

    /// Renders into planes `[5, H, W]`: R, G, B, alpha, Σ w·z.
    pub fn render_planes(
        &mut self,
        splats: &SplatSlices,
        camera: &Camera,
        options: &RasterOptions,
        out: &mut Vec<f32>,
    ) {
        self.project(splats, camera, options);
        self.composite(options, &planes(camera, options, out));
    }

    /// Renders `count` splats that are projected already: `fill` writes their footprints
    /// for this camera and these options ([`crate::cpu::spgr::project`] makes them from
    /// head records). Planes `[5, H, W]` as of [`Rasterizer::render_planes`].
    ///
    /// # Errors
    /// The error of `fill`; `out` is then unchanged.
    pub fn render_footprints<E>(
        &mut self,
        count: usize,
        camera: &Camera,
        options: &RasterOptions,
        fill: impl FnOnce(&mut [Footprint]) -> Result<(), E>,
        out: &mut Vec<f32>,
    ) -> Result<(), E> {
        let start = self.now();
        self.projection.footprints.resize(count, Footprint::default());
        fill(&mut self.projection.footprints)?;
        self.grid = Grid::new(camera.intrinsics.width, camera.intrinsics.height);
        self.lists.begin(self.grid, count);
        self.projection.cover(&mut self.lists);
        self.times = StageTimes { project: since(start), ..StageTimes::default() };
        self.composite(options, &planes(camera, options, out));
        Ok(())
    }

    /// `[N]`: the last frame's footprints, in the splats' order.
    pub fn footprints(&self) -> &[Footprint] {
        &self.projection.footprints
    }

    /// Returns the counts and times of the last frame.
    pub fn stats(&self) -> Stats {
        self.stats
    }

    /// Where the last frame's time went; zeros without
    /// [`Rasterizer::with_stage_times`].
    pub fn stage_times(&self) -> StageTimes {
        self.times
    }

    /// Footprints, and what each adds to which tile.
    fn project(&mut self, splats: &SplatSlices, camera: &Camera, options: &RasterOptions) {
        debug_assert!(splats.is_consistent(), "splat buffers do not fit one another");
        let start = self.now();
        let view = View::new(camera, options);
        self.grid = Grid::new(camera.intrinsics.width, camera.intrinsics.height);
        self.lists.begin(self.grid, splats.len());
        self.projection.run(self.level, splats, &view, options, &mut self.lists);
        self.times = StageTimes { project: since(start), ..StageTimes::default() };
    }

    /// All that follows projection, written to `target`.
    fn composite(&mut self, options: &RasterOptions, target: &Target) {
        let clocks = Clocks::default();
        self.lists.count();
        let tiles = self.grid.len();
        let (mut first, mut items) = (0, 0);
        while first < tiles {
            let start = self.now();
            let group = self.lists.group(first);
            first = group.end;
            self.lists.fill(&group, &self.projection.footprints);
            self.times.list += since(start);
            let start = self.now();
            items += self.tiles(group, Rules::new(options.convention), target, &clocks);
            self.times.tiles += since(start);
        }
        let spent = |clock: &AtomicU64| Duration::from_nanos(clock.load(Relaxed));
        self.times.sort = spent(&clocks.sort);
        self.times.blend = spent(&clocks.blend);
        self.times.write = spent(&clocks.write);
        self.stats = Stats {
            visible: self.lists.visible(),
            pairs: self.lists.pairs(),
            items,
            bytes: self.projection.bytes()
                + self.lists.bytes()
                + self.back.bytes()
                + 4 * self.queue.capacity(),
        };
    }

    /// Sorts, composites and writes one group of tiles, those with the longest lists
    /// first: threads take them from one queue.
    fn tiles(
        &mut self,
        group: Range<usize>,
        rules: Rules,
        target: &Target,
        clocks: &Clocks,
    ) -> usize {
        let (lists, timed) = (&self.lists, self.timed);
        self.queue.clear();
        self.queue.extend(group.map(|t| t as u32));
        self.queue.sort_unstable_by_key(|&t| (std::cmp::Reverse(lists.tile_len(t as usize)), t));
        let grid = self.grid;
        let level = self.level;
        let queue = &self.queue;
        let footprints = &self.projection.footprints;
        let lists = self.lists.lists();
        let (next, items) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let work = |_| {
            let mut place = Workplace::default();
            while let Some(&t) = queue.get(next.fetch_add(1, Relaxed)) {
                let t = t as usize;
                let start = timed.then(Instant::now);
                // SAFETY: the queue names each tile once, and its counter gives each
                // place to one thread.
                let list = unsafe { lists.take(t) };
                level.run(PrefetchTile { t, grid: &grid, target });
                depth_order(list.entries, list.spare, list.order);
                let (order, splats) = (&*list.order, list.splats);
                let sorted = timed.then(Instant::now);
                let work =
                    RenderTile { place: &mut place, t, grid, order, splats, footprints, rules };
                items.fetch_add(level.run(work), Relaxed);
                let blended = timed.then(Instant::now);
                level.run(WriteTile { tile: &place.tile, t, grid: &grid, target });
                if let (Some(start), Some(sorted), Some(blended)) = (start, sorted, blended) {
                    let add = |clock: &AtomicU64, from: Instant, to: Instant| {
                        clock.fetch_add((to - from).as_nanos() as u64, Relaxed);
                    };
                    add(&clocks.sort, start, sorted);
                    add(&clocks.blend, sorted, blended);
                    add(&clocks.write, blended, Instant::now());
                }
            }
        };
        let threads = rayon::current_num_threads().min(queue.len());
        (0..threads).into_par_iter().with_max_len(1).for_each(work);
        items.into_inner()
    }

    pub(crate) fn now(&self) -> Option<Instant> {
        self.timed.then(Instant::now)
    }
}

/// Planes R, G, B, alpha, Σ w·z in `out`, made as long as they are.
fn planes<'a>(camera: &Camera, options: &RasterOptions, out: &'a mut Vec<f32>) -> Target<'a> {
    let plane = camera.intrinsics.width * camera.intrinsics.height;
    out.resize(5 * plane, 0.0);
    let (rgb, rest) = out.split_at_mut(3 * plane);
    let (alpha, depth_sum) = rest.split_at_mut(plane);
    Target {
        rgb: SharedSliceMut::new(rgb),
        step: 1,
        channel: plane,
        alpha: SharedSliceMut::new(alpha),
        depth_sum: SharedSliceMut::new(depth_sum),
        background: options.background,
    }
}

pub(crate) fn since(start: Option<Instant>) -> Duration {
    start.map_or(Duration::ZERO, |s| s.elapsed())
}

/// Prefetches the cache lines of tile `t`'s pixels before they are written. The rows lie too
/// far apart for hardware prefetchers.
struct PrefetchTile<'a> {
    t: usize,
    grid: &'a Grid,
    target: &'a Target<'a>,
}

impl Kernel for PrefetchTile<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        /// Floats of a cache line.
        const LINE: usize = 16;
        let (grid, target) = (self.grid, self.target);
        let left = self.t % grid.columns * TILE;
        let top = self.t / grid.columns * TILE;
        for y in 0..TILE.min(grid.height - top) {
            let first = (top + y) * grid.width + left;
            for x in (0..TILE).step_by(LINE) {
                s.prefetch(target.alpha.address(first + x));
                s.prefetch(target.depth_sum.address(first + x));
                for c in 0..3 {
                    let at = if target.step == 1 {
                        first + x + c * target.channel
                    } else {
                        3 * (first + x) + c * LINE
                    };
                    s.prefetch(target.rgb.address(at));
                }
            }
        }
    }
}

/// Writes the pixels of tile `t` of `grid`. One thread at a time for each tile.
struct WriteTile<'a> {
    tile: &'a Tile,
    t: usize,
    grid: &'a Grid,
    target: &'a Target<'a>,
}

impl Kernel for WriteTile<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let (grid, target) = (self.grid, self.target);
        let left = self.t % grid.columns * TILE;
        let top = self.t / grid.columns * TILE;
        let width = TILE.min(grid.width - left);
        for y in 0..TILE.min(grid.height - top) {
            let row = unfold(self.tile, y, target.background);
            let first = (top + y) * grid.width + left;
            // SAFETY: no other tile has these pixels, and this tile is one thread's.
            unsafe {
                copy(target.alpha.part(first..first + width), &row[3]);
                copy(target.depth_sum.part(first..first + width), &row[4]);
                if target.step == 1 {
                    for (c, plane) in row[..3].iter().enumerate() {
                        let first = c * target.channel + first;
                        copy(target.rgb.part(first..first + width), plane);
                    }
                } else {
                    let mut pixels = [0.0; 3 * TILE];
                    for x in 0..TILE {
                        pixels[3 * x] = row[0][x];
                        pixels[3 * x + 1] = row[1][x];
                        pixels[3 * x + 2] = row[2][x];
                    }
                    copy(target.rgb.part(3 * first..3 * (first + width)), &pixels);
                }
            }
        }
    }
}

/// Pixel row `y` of a tile: R, G, B over the background, alpha, Σ w·z.
#[inline(always)]
#[expect(clippy::needless_range_loop, reason = "one index walks five rows")]
fn unfold(tile: &Tile, y: usize, background: [f32; 3]) -> [[f32; TILE]; 5] {
    let mut row = [[0.0f32; TILE]; 5];
    let lane = y % BLOCK * BLOCK;
    for b in 0..BLOCKS {
        let block = &tile.blocks[y / BLOCK * BLOCKS + b];
        for i in 0..BLOCK {
            let x = b * BLOCK + i;
            row[0][x] = block.rgb[0][lane + i];
            row[1][x] = block.rgb[1][lane + i];
            row[2][x] = block.rgb[2][lane + i];
            row[3][x] = block.t[lane + i].abs();
            row[4][x] = block.z[lane + i];
        }
    }
    for x in 0..TILE {
        let rest = row[3][x];
        row[0][x] += rest * background[0];
        row[1][x] += rest * background[1];
        row[2][x] += rest * background[2];
        row[3][x] = 1.0 - rest;
    }
    row
}

/// Copies as much of `from` as `to` takes; a whole row without a test of its length.
#[inline(always)]
fn copy<const L: usize>(to: &mut [f32], from: &[f32; L]) {
    if let Ok(to) = <&mut [f32; L]>::try_from(&mut *to) {
        *to = *from;
    } else {
        for (to, from) in to.iter_mut().zip(from) {
            *to = *from;
        }
    }
}
