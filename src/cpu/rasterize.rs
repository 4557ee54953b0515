//! The whole forward pass: project, sort by depth, list per tile, composite.
//!
//! In: [`SplatSlices`], a camera, [`RasterOptions`]. Out, H × W pixels row-major:
//! RGB over the background, accumulated alpha 1 − T, and Σ w·z with z the camera z
//! of the means in world units (in either convention). Work is spread over rayon's
//! current pool; the same bytes come out whatever its size.

use crate::abi::{BLOCK, DEPTH_ALPHA_MIN, RasterOptions, TILE};
use crate::camera::Camera;
use crate::cpu::blend::{BLOCKS, Block, Rules, Tile};
use crate::cpu::ewa::{Footprint, View};
use crate::cpu::project::{Projection, SplatSlices};
use crate::cpu::raster_bwd::Buffers;
use crate::cpu::sort::DepthSort;
use crate::cpu::tiles::{Grid, TileLists};
use rayon::prelude::*;
use std::ops::Range;

/// A rendered picture, row-major.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rendered {
    /// W, px.
    pub width: usize,
    /// H, px.
    pub height: usize,
    /// `[H, W, 3]`: Σ w·c + T·background.
    pub rgb: Vec<f32>,
    /// `[H, W]`: 1 − T.
    pub alpha: Vec<f32>,
    /// `[H, W]`: Σ w·z, camera z in world units.
    pub depth_sum: Vec<f32>,
}

impl Rendered {
    /// `[H, W]`: Σ w·z / max(alpha, 1e-10), camera z in world units.
    pub fn depth(&self) -> Vec<f32> {
        let pixels = self.depth_sum.iter().zip(&self.alpha);
        pixels.map(|(z, a)| z / a.max(DEPTH_ALPHA_MIN)).collect()
    }
}

/// What the last frame cost.
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

/// The rasterizer with its buffers: a frame no larger than the last allocates
/// next to nothing.
#[derive(Debug, Default)]
pub struct Rasterizer {
    pub(crate) projection: Projection,
    pub(crate) order: DepthSort,
    pub(crate) lists: TileLists,
    pub(crate) grid: Grid,
    /// Accumulators, in order of work: slot s holds tile `tile_of_slot[s]`.
    pub(crate) slots: Vec<Tile>,
    tile_of_slot: Vec<usize>,
    pub(crate) slot_of_tile: Vec<usize>,
    background: [f32; 3],
    stats: Stats,
    pub(crate) back: Buffers,
}

impl Rasterizer {
    /// A context without buffers; they grow with the first frame.
    pub fn new() -> Self {
        Self::default()
    }

    /// Limits the memory of the per-tile lists to about `pairs` × 4 bytes (default
    /// 2²⁶ pairs). The picture does not depend on it.
    pub fn with_pairs_per_group(mut self, pairs: usize) -> Self {
        self.lists.set_pairs_per_group(pairs);
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
        self.composite(splats, camera, options);
        let Grid { width, height, .. } = self.grid;
        (out.width, out.height) = (width, height);
        out.rgb.resize(3 * width * height, 0.0);
        out.alpha.resize(width * height, 0.0);
        out.depth_sum.resize(width * height, 0.0);
        let w = width.max(1);
        let rows = out.rgb.par_chunks_mut(3 * w).zip(out.alpha.par_chunks_mut(w));
        let rows = rows.zip(out.depth_sum.par_chunks_mut(w));
        rows.enumerate().for_each(|(y, ((rgb, alpha), depth_sum))| {
            self.row(y, |x, pixel| {
                rgb[3 * x..3 * x + 3].copy_from_slice(&pixel[..3]);
                alpha[x] = pixel[3];
                depth_sum[x] = pixel[4];
            });
        });
    }

    /// Renders into planes `[5, H, W]`: R, G, B, alpha, Σ w·z.
    pub fn render_planes(
        &mut self,
        splats: &SplatSlices,
        camera: &Camera,
        options: &RasterOptions,
        out: &mut Vec<f32>,
    ) {
        self.composite(splats, camera, options);
        let Grid { width, height, .. } = self.grid;
        out.resize(5 * width * height, 0.0);
        out.par_chunks_mut(width.max(1)).enumerate().for_each(|(row, values)| {
            let (plane, y) = (row / height, row % height);
            self.row(y, |x, pixel| values[x] = pixel[plane]);
        });
    }

    /// `[N]`: the last frame's footprints, in the splats' order.
    pub fn footprints(&self) -> &[Footprint] {
        &self.projection.footprints
    }

    /// What the last frame cost.
    pub fn stats(&self) -> Stats {
        self.stats
    }

    /// Everything but the picture: leaves the accumulators of all tiles in `slots`.
    pub(crate) fn composite(&mut self, splats: &SplatSlices, camera: &Camera, options: &RasterOptions) {
        debug_assert!(splats.is_consistent(), "splat buffers do not fit one another");
        let view = View::new(camera, options);
        self.grid = Grid::new(camera.intrinsics.width, camera.intrinsics.height);
        self.background = options.background;
        self.projection.run(splats, &view, options);
        let footprints = &self.projection.footprints;
        self.order.run(footprints, &self.projection.visible);
        self.lists.count(self.grid, &self.order, footprints);

        let tiles = self.grid.len();
        self.slots.resize(tiles, Tile::default());
        self.tile_of_slot.clear();
        self.tile_of_slot.extend(0..tiles);
        self.slot_of_tile.resize(tiles, 0);
        let (mut first, mut items) = (0, 0);
        while first < tiles {
            let group = self.lists.group(first);
            first = group.end;
            items += self.composite_group(group, Rules::new(options.convention));
        }
        self.stats = Stats {
            visible: self.order.len(),
            pairs: self.lists.pairs(),
            items,
            bytes: self.bytes(),
        };
    }

    /// Composites one group of tiles, those with the longest lists first.
    fn composite_group(&mut self, group: Range<usize>, rules: Rules) -> usize {
        let footprints = &self.projection.footprints;
        self.lists.fill(&group, &self.order, footprints);
        let (lists, grid) = (&self.lists, &self.grid);
        let tiles = &mut self.tile_of_slot[group.clone()];
        tiles.sort_unstable_by_key(|&t| (std::cmp::Reverse(lists.tile_len(t)), t));
        for (s, &t) in tiles.iter().enumerate() {
            self.slot_of_tile[t] = group.start + s;
        }
        let slots = self.slots[group].par_iter_mut().with_max_len(1);
        let work = slots.zip(&*tiles);
        work.map(|(slot, &t)| slot.render(t, grid, lists.list(t), footprints, rules)).sum()
    }

    /// Calls `write` with every x of row `y` and its (R, G, B, alpha, Σ w·z).
    fn row(&self, y: usize, mut write: impl FnMut(usize, [f32; 5])) {
        let first_tile = y / TILE * self.grid.columns;
        let (block_row, lane_row) = (y % TILE / BLOCK, y % BLOCK);
        for x in (0..self.grid.width).step_by(BLOCK) {
            let tile = &self.slots[self.slot_of_tile[first_tile + x / TILE]];
            let block: &Block = &tile.blocks[block_row * BLOCKS + x % TILE / BLOCK];
            for i in 0..BLOCK.min(self.grid.width - x) {
                let l = lane_row * BLOCK + i;
                let t = block.t[l].abs();
                let [r, g, b]: [f32; 3] =
                    std::array::from_fn(|c| block.rgb[c][l] + t * self.background[c]);
                write(x + i, [r, g, b, 1.0 - t, block.z[l]]);
            }
        }
    }

    fn bytes(&self) -> usize {
        self.projection.bytes()
            + self.order.bytes()
            + self.lists.bytes()
            + self.back.bytes()
            + self.slots.capacity() * size_of::<Tile>()
            + 8 * (self.tile_of_slot.capacity() + self.slot_of_tile.capacity())
    }
}
