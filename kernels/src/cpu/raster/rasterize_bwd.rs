//! The whole backward pass: tiles, then a gather over each splat's tiles, then one pass
//! over all splats.
//!
//! In: the gradient of a scalar loss with respect to the five planes that
//! [`Rasterizer::render_planes`] gives. Out: [`Gradients`], exact for the piecewise
//! function that the forward is: nothing passes a capped alpha, a clamped colour or a
//! cull; directions of SH are not detached. No atomic sum anywhere: each (splat, tile)
//! pair has its own row, rows are added in the order of tiles, so the same bytes come
//! out for any number of threads.
//!
//! Memory beyond the forward's: 48 bytes a pair, at most [`PAIRS_PER_GROUP`] at a time
//! (or one tile's), 40 bytes a splat and a few MiB a thread.
//!
//! The moments of a splat are in whitened coordinates, so that the sums of needle-shaped splats do
//! not cancel.
//!
//! Each tile runs forward again, so nothing is stored per pixel and splat.

use crate::camera::Camera;
use crate::cpu::raster::blend::Rules;
use crate::cpu::raster::blend_bwd::{PairSums, SUMS, Scratch, Upstream, WalkTile};
use crate::cpu::raster::ewa::View;
use crate::cpu::raster::project::SplatSlices;
use crate::cpu::raster::project_bwd::{Gradients, Pass};
use crate::cpu::raster::rasterize::{Rasterizer, since};
use crate::cpu::raster::sort::depth_order;
use crate::cpu::raster::tiles::Grid;
use crate::cpu::shared_slice::SharedSliceMut;
use crate::layout::RasterOptions;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::atomic::AtomicUsize;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

/// Most (splat, tile) pairs whose sums are held at a time: 192 MiB.
const PAIRS_PER_GROUP: usize = 1 << 22;

/// Times of the last backward pass by stage; zeros unless enabled.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BackwardTimes {
    /// Walking the tiles (and listing them again, where they did not fit one group).
    pub tiles: Duration,
    /// Adding up each splat's tiles.
    pub gather: Duration,
    /// From sums to gradients.
    pub splats: Duration,
}

/// Buffers of the backward pass, reused from call to call.
#[derive(Debug, Default)]
pub(crate) struct Buffers {
    /// A row per pair of the group at hand, in the order of its lists.
    pairs: Vec<PairSums>,
    /// `[N]`; only those of visible splats are meant.
    sums: Vec<PairSums>,
    /// `[tiles]`: gradients of the background.
    background: Vec<[f64; 3]>,
    /// A mask of blocks per pair.
    masks: Vec<u64>,
    /// One per thread.
    scratch: Vec<Scratch>,
    times: BackwardTimes,
}

impl Buffers {
    /// Bytes held.
    pub(crate) fn bytes(&self) -> usize {
        (self.pairs.capacity() + self.sums.capacity()) * size_of::<PairSums>()
            + self.background.capacity() * size_of::<[f64; 3]>()
            + 8 * self.masks.capacity()
            + self.scratch.iter().map(Scratch::bytes).sum::<usize>()
    }
}

/// A rendered frame with its splats; its backward pass uses the results of the forward
/// pass. Made by [`Rasterizer::frame`].
#[derive(Debug)]
pub struct Frame<'r, 's> {
    rasterizer: &'r mut Rasterizer,
    splats: SplatSlices<'s>,
    camera: Camera,
    options: RasterOptions,
}

impl Frame<'_, '_> {
    /// Gradients of a loss whose gradient with respect to the frame's planes
    /// `[5, H, W]` (R, G, B, alpha, Σ w·z) is `gradients`; zeros where that has another
    /// size.
    pub fn backward(&mut self, gradients: &[f32], out: &mut Gradients) {
        let (camera, options) = (&self.camera, &self.options);
        self.rasterizer.backward_of_last(&self.splats, camera, options, gradients, out);
    }
}

impl Rasterizer {
    /// Renders into planes as [`Rasterizer::render_planes`] does, and keeps hold of the
    /// splats for [`Frame::backward`].
    pub fn frame<'r, 's>(
        &'r mut self,
        splats: SplatSlices<'s>,
        camera: &Camera,
        options: &RasterOptions,
        planes: &mut Vec<f32>,
    ) -> Frame<'r, 's> {
        self.render_planes(&splats, camera, options, planes);
        Frame { rasterizer: self, splats, camera: *camera, options: *options }
    }

    /// Forward and backward: gradients of a loss whose gradient with respect to the
    /// planes `[5, H, W]` of this view (R, G, B, alpha, Σ w·z) is `gradients`; zeros
    /// where that has another size.
    pub fn backward(
        &mut self,
        splats: &SplatSlices,
        camera: &Camera,
        options: &RasterOptions,
        gradients: &[f32],
        out: &mut Gradients,
    ) {
        debug_assert!(splats.is_consistent(), "splat buffers do not fit one another");
        let view = View::new(camera, options);
        self.grid = Grid::new(camera.intrinsics.width, camera.intrinsics.height);
        self.lists.begin(self.grid, splats.len());
        self.projection.run(self.level, splats, &view, options, &mut self.lists);
        self.lists.count();
        self.backward_of_last(splats, camera, options, gradients, out);
    }

    /// Where the last backward's time went; zeros without
    /// [`Rasterizer::with_stage_times`].
    pub fn backward_times(&self) -> BackwardTimes {
        self.back.times
    }

    /// The backward pass of the last frame, whose splats, camera and options these must
    /// be.
    pub fn backward_of_last(
        &mut self,
        splats: &SplatSlices,
        camera: &Camera,
        options: &RasterOptions,
        gradients: &[f32],
        out: &mut Gradients,
    ) {
        let upstream = Upstream { planes: gradients, background: options.background };
        let tiles = self.grid.len();
        let numbers = 5 * self.grid.width * self.grid.height;
        if gradients.len() != numbers || self.projection.footprints.len() != splats.len() {
            return out.clear(splats);
        }
        let mut times = BackwardTimes::default();
        self.back.background.clear();
        self.back.background.resize(tiles, [0.0; 3]);
        self.back.sums.resize(splats.len(), [0.0; SUMS]);
        let before = !self.lists.filled().is_empty();
        let mut first = 0;
        while first < tiles {
            let start = self.now();
            let group = self.lists.group_within(first, PAIRS_PER_GROUP);
            let listed = group == self.lists.filled();
            if !listed && !before {
                self.lists.fill(&group, &self.projection.footprints);
            } else if !listed {
                self.lists.fill_again(&group, &self.projection.footprints);
            }
            self.walk_group(group.clone(), listed, Rules::new(options.convention), upstream);
            times.tiles += since(start);
            let start = self.now();
            self.gather_group(&group);
            times.gather += since(start);
            first = group.end;
        }
        let start = self.now();
        let pass = Pass {
            splats,
            view: &View::new(camera, options),
            options,
            footprints: &self.projection.footprints,
            sums: &self.back.sums,
            radiance: &self.projection.parents,
        };
        pass.run(self.level, out);
        let mut background = [0.0f64; 3];
        for tile in &self.back.background {
            for (sum, v) in background.iter_mut().zip(tile) {
                *sum += v;
            }
        }
        out.background = background.map(|v| v as f32);
        times.splats = since(start);
        self.back.times = times;
    }

    /// The backward of one group of tiles, those with the longest lists first; sorts
    /// their lists unless the forward did.
    fn walk_group(&mut self, group: Range<usize>, listed: bool, rules: Rules, upstream: Upstream) {
        let Buffers { pairs, masks, background, scratch, .. } = &mut self.back;
        let total: usize = group.clone().map(|t| self.lists.tile_len(t)).sum();
        if pairs.len() < total {
            pairs.resize(total, [0.0; SUMS]);
            masks.resize(total, 0);
        }
        let mut queue: Vec<usize> = group.collect();
        queue.sort_unstable_by_key(|&t| (std::cmp::Reverse(self.lists.tile_len(t)), t));
        let (grid, level) = (self.grid, self.level);
        let footprints = &self.projection.footprints;
        let (pairs, masks) = (SharedSliceMut::new(pairs), SharedSliceMut::new(masks));
        let background = SharedSliceMut::new(background);
        let lists = self.lists.lists();
        let threads = rayon::current_num_threads().min(queue.len());
        if scratch.len() < threads {
            scratch.resize_with(threads, Scratch::default);
        }
        let next = AtomicUsize::new(0);
        scratch[..threads].par_iter_mut().with_max_len(1).for_each(|scratch| {
            while let Some(&t) = queue.get(next.fetch_add(1, Relaxed)) {
                // SAFETY: the queue names each tile once, its counter gives each place
                // to one thread, and no two tiles share a place.
                let (list, rows, masks) = unsafe {
                    let places = lists.places(t);
                    (lists.take(t), pairs.part(places.clone()), masks.part(places))
                };
                if !listed {
                    depth_order(list.entries, list.spare, list.order);
                }
                let (order, splats) = (&*list.order, list.splats);
                let seen = level.run(WalkTile {
                    t,
                    grid,
                    order,
                    splats,
                    footprints,
                    rules,
                    upstream,
                    masks,
                    rows,
                    scratch: &mut *scratch,
                });
                // SAFETY: as above.
                unsafe { background.write(t, seen) };
            }
        });
    }

    /// Adds the rows of `group` to the sums of their splats, tile by tile.
    fn gather_group(&mut self, group: &Range<usize>) {
        let Buffers { pairs, sums, .. } = &mut self.back;
        let fresh = group.start == 0;
        let pairs = &*pairs;
        self.lists.gather(group, &self.projection.footprints, sums, |sum, slots| {
            if fresh {
                *sum = [0.0; SUMS];
            }
            for &slot in slots {
                for (s, v) in sum.iter_mut().zip(pairs[slot as usize]) {
                    *s += v;
                }
            }
        });
    }
}
