//! Frames with more footprints, pairs or pixels than a binding holds.
//!
//! The picture is divided into bands of rows of tiles, and each band into layers: consecutive
//! splats in order of depth. A layer continues from the pixels of the nearer layers, so the bytes
//! equal those of a frame drawn at once. The frame takes several submits, and one read-back per
//! band for the division into layers.
//!
//! Two cases remain too large: 4 bytes per splat, or one row of tiles, exceed a binding.
//!
//! A pixel with T < 0 in place of alpha is finished. In the backward pass a layer continues from
//! the pixels of the farther layers. Tests reduce the size of a binding to reach this path.

use crate::gpu::buffers::Buffer;
use crate::gpu::commands::{Commands, Groups};
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::raster::constants::{FOOTPRINT_STRIDE, PLAN_REQUESTED, PLAN_WORDS, TILE_GPU};
use crate::gpu::raster::frame::{
    Depths, FrameBuffers, Offsets, Store, THREADS, bind, composite, pixels, project,
};
use crate::gpu::raster::kernels::PICK;
use crate::gpu::raster::rasterize::Rasterizer;
use crate::gpu::raster::scene::Scene;
use crate::gpu::uniforms::RasterUniform;
use std::time::Duration;

/// Floats of a pixel: R, G, B, alpha, depth sum.
pub(crate) const PICTURE_CHANNELS: usize = 5;

/// Stage times, in order.
pub(crate) type Times = Vec<(&'static str, Duration)>;

/// Adds `more` to the times of the same stages.
pub(crate) fn add_times(times: &mut Times, more: Times) {
    for (stage, time) in more {
        match times.iter_mut().find(|(name, _)| *name == stage) {
            Some((_, sum)) => *sum += time,
            None => times.push((stage, time)),
        }
    }
}

/// Consecutive splats in order of depth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Layer {
    /// Position of the first splat in the order by depth.
    pub(crate) place: usize,
    /// Number of splats.
    pub(crate) places: usize,
    /// Number of pairs.
    pub(crate) pairs: usize,
}

/// Maximum size of a layer.
#[derive(Clone, Copy, Debug)]
struct LayerLimits {
    splats: usize,
    pairs: usize,
}

/// Divides `whole` into bands; `floats_per_pixel` floats of every pixel of a band fit a binding.
pub(crate) fn bands(
    gpu: &Gpu,
    whole: &RasterUniform,
    floats_per_pixel: usize,
) -> Result<Vec<RasterUniform>, GpuError> {
    let row = floats_per_pixel * TILE_GPU * whole.width as usize;
    let max_rows = gpu.rows_per_binding(row);
    if max_rows == 0 {
        let needed = row as u64;
        let limit = gpu.rows_per_binding(1) as u64;
        return Err(GpuError::TooSmall { resource: "a row of tiles, floats", needed, limit });
    }
    let band = |rows: std::ops::Range<usize>| {
        let mut call = RasterUniform { top: rows.start as u32, ..*whole };
        call.rows = rows.len() as u32;
        if call.step == 1 {
            call.channel = pixels(&call) as u32;
        }
        call
    };
    Ok(Gpu::chunks(whole.rows as usize, max_rows).map(band).collect())
}

/// Divides splats into layers within `limits`. `offsets` holds the index of each splat's first
/// pair, `total` the number of pairs. There is at least one layer.
///
/// # Errors
/// [`GpuError::TooSmall`] where one splat has more pairs than a layer may have.
fn cut(offsets: &[u32], total: u32, limits: LayerLimits) -> Result<Vec<Layer>, GpuError> {
    // Splats after the last pair intersect no tile.
    let drawn = offsets.partition_point(|&o| o < total);
    let ends: Vec<u32> = offsets.iter().take(drawn).skip(1).copied().chain([total]).collect();
    let mut layers = Vec::new();
    let mut place = 0;
    let mut first = 0;
    while place < drawn {
        let candidates = ends.get(place..(place + limits.splats).min(drawn)).unwrap_or(&[]);
        let count = candidates.partition_point(|&end| (end - first) as usize <= limits.pairs);
        let Some(&end) = candidates.get(..count).and_then(<[u32]>::last) else {
            let needed = u64::from(candidates.first().map_or(0, |end| end - first));
            let resource = "(splat, tile) pairs of a splat";
            return Err(GpuError::TooSmall { resource, needed, limit: limits.pairs as u64 });
        };
        layers.push(Layer { place, places: count, pairs: (end - first) as usize });
        (place, first) = (place + count, end);
    }
    if layers.is_empty() {
        layers.push(Layer { place: 0, places: 0, pairs: 0 });
    }
    Ok(layers)
}

/// A band whose splats are projected, sorted and divided into layers.
pub(crate) struct Band {
    pub(crate) call: RasterUniform,
    pub(crate) stores: Vec<Store>,
    pub(crate) depths: Depths,
    pub(crate) layers: Vec<Layer>,
    /// (splat, tile) pairs.
    pub(crate) pairs: usize,
    pub(crate) times: Times,
}

impl Band {
    /// Projects and sorts the splats of the band of `call`, and divides it into layers;
    /// `words_per_pair` words of every pair of a layer fit a binding.
    pub(crate) fn open(
        gpu: &Gpu,
        scene: &Scene,
        call: RasterUniform,
        words_per_pair: usize,
        timed: bool,
    ) -> Result<Self, GpuError> {
        let n = scene.len;
        let limit = gpu.rows_per_binding(1);
        if n > limit {
            let (needed, limit) = (n as u64, limit as u64);
            return Err(GpuError::TooSmall { resource: "splats", needed, limit });
        }
        let stores = scene.parts.iter().map(|part| Store::new(gpu, part.first, part.count));
        let stores = stores.collect::<Result<Vec<_>, _>>()?;
        let mut commands = gpu.commands("layers", timed);
        let depths = project(gpu, &mut commands, scene, call, &stores)?;
        let whole = gpu.uniform(&call)?;
        let offsets = Offsets::record(gpu, &mut commands, &depths, n)?;
        let plan = offsets.plan(gpu, &mut commands, &whole)?;
        let offsets = commands.read::<u32>(&offsets.offsets, n)?;
        let plan = commands.read::<u32>(&plan, PLAN_WORDS)?;
        let submitted = commands.submit()?;
        let (offsets, plan) = (offsets.take(gpu)?, plan.take(gpu)?);
        let total = plan.get(PLAN_REQUESTED).copied().unwrap_or(u32::MAX);
        // The prefix sums saturate at this value (wgsl/shared/scan.wgsl).
        if total == u32::MAX {
            let needed = u64::from(total);
            let limit = u64::from(total - 1);
            return Err(GpuError::TooSmall { resource: "(splat, tile) pairs", needed, limit });
        }
        let limits = LayerLimits {
            splats: gpu.rows_per_binding(FOOTPRINT_STRIDE),
            pairs: gpu.rows_per_binding(words_per_pair),
        };
        let layers = cut(&offsets, total, limits)?;
        let times = submitted.times(gpu)?;
        Ok(Self { call, stores, depths, layers, pairs: total as usize, times })
    }

    /// Appends layer `index`, drawn over the layers before it.
    pub(crate) fn draw(
        &self,
        gpu: &Gpu,
        commands: &mut Commands,
        scene: &Scene,
        index: usize,
        picture: &Buffer,
    ) -> Result<FrameBuffers, GpuError> {
        let layer = self.layers[index];
        let n = layer.places;
        let own = Store::new(gpu, 0, n)?;
        let order = gpu.empty::<u32>("a layer's order", n)?;
        let counts = gpu.empty::<u32>("tile counts", n)?;
        commands.stage("pick");
        for (part, store) in scene.parts.iter().zip(&self.stores) {
            let call = gpu.uniform(&self.of_part(layer, part.first, part.count))?;
            let bindings = bind([
                &call,
                &self.depths.order,
                &self.depths.counts,
                &store.footprints,
                &store.rectangles,
                &own.footprints,
                &own.rectangles,
                &order,
                &counts,
            ]);
            commands.run(&PICK, &[], &bindings, Groups::of(n, THREADS))?;
        }
        let call = RasterUniform {
            count: n as u32,
            capacity: layer.pairs as u32,
            resumes: u32::from(index > 0),
            carries: u32::from(index + 1 < self.layers.len()),
            ..self.call
        };
        composite(gpu, commands, call, own, Depths { order, counts }, picture)
    }

    /// Returns the uniform for the splats of a layer that lie in one part of the scene.
    pub(crate) fn of_part(&self, layer: Layer, first: usize, count: usize) -> RasterUniform {
        RasterUniform {
            first: first as u32,
            count: count as u32,
            own: 0,
            place: layer.place as u32,
            places: layer.places as u32,
            ..self.call
        }
    }
}

impl Rasterizer {
    /// Draws a frame in layers. `end` is called with the last commands, the uniform and the
    /// picture of each band.
    pub(crate) fn layered<R>(
        &mut self,
        scene: &Scene,
        whole: &RasterUniform,
        mut end: impl FnMut(&mut Commands, &RasterUniform, &Buffer) -> Result<R, GpuError>,
    ) -> Result<Vec<(RasterUniform, R)>, GpuError> {
        let gpu = self.gpu().clone();
        let mut ends = Vec::new();
        let mut times = Times::new();
        let mut pairs = 0;
        for call in bands(&gpu, whole, PICTURE_CHANNELS)? {
            let band = Band::open(&gpu, scene, call, 1, self.timed)?;
            let picture = gpu.empty::<f32>("the picture", PICTURE_CHANNELS * pixels(&call))?;
            for index in 0..band.layers.len() {
                let mut commands = gpu.commands("layer", self.timed);
                band.draw(&gpu, &mut commands, scene, index, &picture)?;
                if index + 1 == band.layers.len() {
                    ends.push((call, end(&mut commands, &call, &picture)?));
                }
                add_times(&mut times, commands.submit()?.times(&gpu)?);
            }
            add_times(&mut times, band.times);
            pairs += band.pairs;
        }
        self.set_pair_count(pairs);
        self.times = times;
        Ok(ends)
    }

    /// Returns the picture of a frame in layers.
    pub(crate) fn layered_picture(
        &mut self,
        scene: &Scene,
        whole: &RasterUniform,
    ) -> Result<Vec<f32>, GpuError> {
        let bands = self.layered(scene, whole, |commands, call, picture| {
            commands.read::<f32>(picture, PICTURE_CHANNELS * pixels(call))
        })?;
        let all = pixels(whole);
        let mut out = vec![0.0; PICTURE_CHANNELS * all];
        let planes: &[usize] = if whole.step == 1 { &[1; PICTURE_CHANNELS] } else { &[3, 1, 1] };
        for (call, picture) in bands {
            let own = pixels(&call);
            let first = call.top as usize * TILE_GPU * call.width as usize;
            let picture = picture.take(self.gpu())?;
            let mut rest = &picture[..];
            let mut channel = 0;
            for &channels in planes {
                let (from, remaining) = rest.split_at((channels * own).min(rest.len()));
                let to = channel * all + channels * first;
                if let Some(to) = out.get_mut(to..to + from.len()) {
                    to.copy_from_slice(from);
                }
                (rest, channel) = (remaining, channel + channels);
            }
        }
        Ok(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn layers_have_the_maximum_size() {
        let limits = |splats, pairs| LayerLimits { splats, pairs };
        let layer = |place, places, pairs| Layer { place, places, pairs };
        // Counts 2 0 3 1 4, and two splats that intersect no tile.
        let offsets = [0, 2, 2, 5, 6, 10, 10];
        assert_eq!(cut(&offsets, 10, limits(9, 99)), Ok(vec![layer(0, 5, 10)]));
        let expected = vec![layer(0, 3, 5), layer(3, 2, 5)];
        assert_eq!(cut(&offsets, 10, limits(9, 5)), Ok(expected));
        let expected = vec![layer(0, 2, 2), layer(2, 2, 4), layer(4, 1, 4)];
        assert_eq!(cut(&offsets, 10, limits(2, 5)), Ok(expected));
        assert_eq!(cut(&[], 0, limits(2, 5)), Ok(vec![layer(0, 0, 0)]));
        assert_eq!(cut(&[0, 0], 0, limits(2, 5)), Ok(vec![layer(0, 0, 0)]));
        let error = cut(&offsets, 10, limits(9, 3));
        assert!(matches!(error, Err(GpuError::TooSmall { needed: 4, limit: 3, .. })), "{error:?}");
    }
}
