//! The whole backward pass: tiles, then a gather over each splat's tiles, then one pass
//! over all splats.
//!
//! In: the gradient of a scalar loss with respect to the five planes that
//! [`Rasterizer::render_planes`] gives. Out: [`Gradients`], exact for the piecewise
//! function that the forward is: nothing passes a capped alpha, a clamped colour or a
//! cull; directions of SH are not detached. No atomic sum anywhere: each
//! (splat, tile) pair has its own row, rows are added in the order of tiles, so the
//! same bytes come out for any number of threads.
//!
//! Memory beyond the forward's: 40 bytes a pair, at most [`PAIRS_PER_GROUP`] at a time
//! (or one tile's), and 40 bytes a splat.

use crate::abi::RasterOptions;
use crate::camera::Camera;
use crate::cpu::blend::Rules;
use crate::cpu::ewa::View;
use crate::cpu::math::vectorised;
use crate::cpu::project::SplatSlices;
use crate::cpu::project_bwd::{Gradients, Pass, SplatSums};
use crate::cpu::raster_bwd_tile::{PairSums, Report, SUMS, Upstream, backward};
use crate::cpu::rasterize::Rasterizer;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::atomic::Ordering::Relaxed;

/// Most (splat, tile) pairs whose sums are held at a time: 160 MiB.
const PAIRS_PER_GROUP: usize = 1 << 22;

/// Buffers of the backward pass, reused from call to call.
#[derive(Debug, Default)]
pub(crate) struct Buffers {
    /// A row per pair of the group at hand, in the order of its lists.
    pairs: Vec<PairSums>,
    /// `[tiles]`.
    reports: Vec<Report>,
    /// `[N]`.
    sums: Vec<SplatSums>,
}

impl Buffers {
    /// Bytes held.
    pub(crate) fn bytes(&self) -> usize {
        self.pairs.capacity() * size_of::<PairSums>()
            + self.reports.capacity() * size_of::<Report>()
            + self.sums.capacity() * size_of::<SplatSums>()
    }
}

/// A rendered frame that still knows its splats, so that its backward pass can use what
/// the forward left. Made by [`Rasterizer::frame`].
#[derive(Debug)]
pub struct Frame<'r, 's> {
    rasterizer: &'r mut Rasterizer,
    splats: SplatSlices<'s>,
    camera: Camera,
    options: RasterOptions,
}

impl Frame<'_, '_> {
    /// Gradients of a loss whose gradient with respect to the frame's planes
    /// `[5, H, W]` (R, G, B, alpha, Σ w·z) is `planes`.
    pub fn backward(&mut self, planes: &[f32], out: &mut Gradients) {
        self.rasterizer.backward_of_last(&self.splats, &self.camera, &self.options, planes, out);
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
    /// planes `[5, H, W]` of this view (R, G, B, alpha, Σ w·z) is `planes`.
    pub fn backward(
        &mut self,
        splats: &SplatSlices,
        camera: &Camera,
        options: &RasterOptions,
        planes: &[f32],
        out: &mut Gradients,
    ) {
        self.composite(splats, camera, options);
        self.backward_of_last(splats, camera, options, planes, out);
    }

    /// The backward pass of the last frame, whose splats, camera and options these must
    /// be. Planes of another size count as zeros.
    pub(crate) fn backward_of_last(
        &mut self,
        splats: &SplatSlices,
        camera: &Camera,
        options: &RasterOptions,
        planes: &[f32],
        out: &mut Gradients,
    ) {
        let tiles = self.grid.len();
        let fits = planes.len() == 5 * self.grid.width * self.grid.height
            && self.projection.footprints.len() == splats.len();
        debug_assert!(fits, "gradient planes or splats that do not fit the last frame");
        if !fits {
            return out.clear(splats);
        }
        let upstream = Upstream { planes, background: options.background };
        let buffers = &mut self.back;
        buffers.reports.clear();
        buffers.reports.resize(tiles, Report::default());
        buffers.sums.resize_with(splats.len(), Default::default);
        let mut first = 0;
        while first < tiles {
            let group = self.lists.group_within(first, PAIRS_PER_GROUP);
            if group != self.lists.filled() {
                if first == 0 {
                    self.lists.count(self.grid, &self.order, &self.projection.footprints);
                }
                self.lists.fill(&group, &self.order, &self.projection.footprints);
            }
            self.walk_group(group.clone(), Rules::new(options.convention), upstream);
            self.gather_group(&group);
            first = group.end;
        }
        let mut background = [0.0f64; 3];
        for report in &self.back.reports {
            for (sum, v) in background.iter_mut().zip(report.background) {
                *sum += v;
            }
        }
        let pass = Pass {
            splats,
            view: &View::new(camera, options),
            options,
            footprints: &self.projection.footprints,
            sums: &self.back.sums,
            radiance: self.projection.parents(),
        };
        pass.run(out);
        out.background = background.map(|v| v as f32);
    }

    /// The backward of one group of tiles, those with the longest lists first.
    fn walk_group(&mut self, group: Range<usize>, rules: Rules, upstream: Upstream) {
        let Buffers { pairs, reports, .. } = &mut self.back;
        let (lists, grid, slots) = (&self.lists, &self.grid, &self.slots);
        let footprints = &self.projection.footprints;
        let total: usize = group.clone().map(|t| lists.tile_len(t)).sum();
        if pairs.len() < total {
            pairs.resize(total, [0.0; SUMS]);
        }
        let mut rest = &mut pairs[..total];
        let mut work = Vec::with_capacity(group.len());
        for (t, report) in group.clone().zip(&mut reports[group]) {
            let (rows, tail) = rest.split_at_mut(lists.tile_len(t));
            rest = tail;
            work.push((t, rows, report));
        }
        work.sort_unstable_by_key(|(t, rows, _)| (std::cmp::Reverse(rows.len()), *t));
        let slot_of_tile = &self.slot_of_tile;
        work.into_par_iter().with_max_len(1).for_each(|(t, rows, report)| {
            let done = (&slots[slot_of_tile[t]], rules);
            let list = lists.list(t);
            *report = vectorised(|| backward((t, grid), list, footprints, done, upstream, rows));
        });
    }

    /// Adds the rows of `group` to the sums of their splats, tile by tile.
    fn gather_group(&mut self, group: &Range<usize>) {
        let Buffers { pairs, reports, sums } = &self.back;
        let (lists, first_group) = (&self.lists, group.start == 0);
        lists.visit(group, &self.order, &self.projection.footprints, |splat, slots| {
            let target = &sums[splat as usize];
            let mut sum: PairSums = if first_group {
                [0.0; SUMS]
            } else {
                std::array::from_fn(|k| f32::from_bits(target[k].load(Relaxed)))
            };
            slots(&mut |t, position, slot| {
                if position < reports[t].reached {
                    for (s, v) in sum.iter_mut().zip(pairs[slot]) {
                        *s += v;
                    }
                }
            });
            for (to, s) in target.iter().zip(sum) {
                to.store(s.to_bits(), Relaxed);
            }
        });
    }
}
