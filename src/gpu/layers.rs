//! Frames of more footprints, pairs or pixels than a binding holds: a picture in bands of
//! rows of tiles, and each band in layers, runs of the splats' order by depth. A layer goes
//! on from the pixels that the nearer ones left, so that the bytes are those of a frame
//! drawn at once. Several submits, and one read-back a band to see where to cut.
//!
//! What remains too small: a device on which 4 bytes of every splat, or one row of tiles,
//! do not fit a binding.

use crate::abi::{FOOTPRINT_STRIDE, PLAN_REQUESTED, PLAN_WORDS, RasterUniform, TILE_GPU};
use crate::gpu::buffers::Buffer;
use crate::gpu::commands::{Commands, Groups};
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::frame::{
    Depths, FrameBuffers, Offsets, Store, THREADS, bind, composite, pixels, project,
};
use crate::gpu::raster_kernels::PICK;
use crate::gpu::rasterize::Rasterizer;
use crate::gpu::scene::Scene;
use std::time::Duration;

/// Floats of a pixel: R, G, B, alpha, depth sum.
pub(crate) const PICTURE_CHANNELS: usize = 5;

/// Time of stages, in order.
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

/// A run of the order by depth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Layer {
    pub(crate) place: usize,
    pub(crate) places: usize,
    pub(crate) pairs: usize,
}

/// `whole` in bands of which a binding holds `lanes` floats a pixel.
pub(crate) fn bands(
    gpu: &Gpu,
    whole: &RasterUniform,
    lanes: usize,
) -> Result<Vec<RasterUniform>, GpuError> {
    let row = lanes * TILE_GPU * whole.width as usize;
    let most = gpu.rows_per_binding(row);
    if most == 0 {
        let (needed, limit) = (row as u64, gpu.rows_per_binding(1) as u64);
        return Err(GpuError::TooSmall { what: "a row of tiles, floats", needed, limit });
    }
    let band = |rows: std::ops::Range<usize>| {
        let mut call = RasterUniform { top: rows.start as u32, ..*whole };
        call.rows = rows.len() as u32;
        if call.step == 1 {
            call.channel = pixels(&call) as u32;
        }
        call
    };
    Ok(Gpu::chunks(whole.rows as usize, most).map(band).collect())
}

/// Layers of at most `places` splats with `pairs` pairs; `offsets` says where each one's
/// begin, `total` how many there are. At least one layer.
///
/// # Errors
/// One splat has more.
fn cut(
    offsets: &[u32],
    total: u32,
    (places, pairs): (usize, usize),
) -> Result<Vec<Layer>, GpuError> {
    // Splats behind the last pair meet no tile.
    let drawn = offsets.partition_point(|&o| o < total);
    let ends: Vec<u32> = offsets.iter().take(drawn).skip(1).copied().chain([total]).collect();
    let (mut layers, mut place, mut first) = (Vec::new(), 0, 0);
    while place < drawn {
        let room = ends.get(place..(place + places).min(drawn)).unwrap_or(&[]);
        let fits = room.partition_point(|&end| (end - first) as usize <= pairs);
        let Some(&end) = room.get(..fits).and_then(<[u32]>::last) else {
            let needed = u64::from(room.first().map_or(0, |end| end - first));
            let what = "(splat, tile) pairs of a splat";
            return Err(GpuError::TooSmall { what, needed, limit: pairs as u64 });
        };
        layers.push(Layer { place, places: fits, pairs: (end - first) as usize });
        (place, first) = (place + fits, end);
    }
    if layers.is_empty() {
        layers.push(Layer { place: 0, places: 0, pairs: 0 });
    }
    Ok(layers)
}

/// A band whose splats are projected, sorted and cut into layers.
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
    /// Cuts the band of `call` into layers of which a binding holds `lanes` words a pair.
    pub(crate) fn open(
        gpu: &Gpu,
        scene: &Scene,
        call: RasterUniform,
        lanes: usize,
        timed: bool,
    ) -> Result<Self, GpuError> {
        let (n, limit) = (scene.len, gpu.rows_per_binding(1));
        if n > limit {
            let (needed, limit) = (n as u64, limit as u64);
            return Err(GpuError::TooSmall { what: "splats", needed, limit });
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
        // Sums stop there (kernels/shared/scan.wgsl).
        if total == u32::MAX {
            let (needed, limit) = (u64::from(total), u64::from(total - 1));
            return Err(GpuError::TooSmall { what: "(splat, tile) pairs", needed, limit });
        }
        let most = (gpu.rows_per_binding(FOOTPRINT_STRIDE), gpu.rows_per_binding(lanes));
        let layers = cut(&offsets, total, most)?;
        let times = submitted.times(gpu)?;
        Ok(Self { call, stores, depths, layers, pairs: total as usize, times })
    }

    /// Adds layer `at` to `commands`, drawn over those before it.
    pub(crate) fn draw(
        &self,
        gpu: &Gpu,
        commands: &mut Commands,
        scene: &Scene,
        at: usize,
        picture: &Buffer,
    ) -> Result<FrameBuffers, GpuError> {
        let layer = self.layers[at];
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
            resumes: u32::from(at > 0),
            carries: u32::from(at + 1 < self.layers.len()),
            ..self.call
        };
        composite(gpu, commands, call, (own, Depths { order, counts }), picture)
    }

    /// What kernels are told that take places of a layer and splats of a part.
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
    /// A frame in layers. `end` is called with each band's last commands, call and picture.
    pub(crate) fn layered<R>(
        &mut self,
        scene: &Scene,
        whole: &RasterUniform,
        mut end: impl FnMut(&mut Commands, &RasterUniform, &Buffer) -> Result<R, GpuError>,
    ) -> Result<Vec<(RasterUniform, R)>, GpuError> {
        let gpu = self.gpu().clone();
        let (mut ends, mut times, mut pairs) = (Vec::new(), Times::new(), 0);
        for call in bands(&gpu, whole, PICTURE_CHANNELS)? {
            let band = Band::open(&gpu, scene, call, 1, self.timed)?;
            let picture = gpu.empty::<f32>("the picture", PICTURE_CHANNELS * pixels(&call))?;
            for at in 0..band.layers.len() {
                let mut commands = gpu.commands("layer", self.timed);
                band.draw(&gpu, &mut commands, scene, at, &picture)?;
                if at + 1 == band.layers.len() {
                    ends.push((call, end(&mut commands, &call, &picture)?));
                }
                add_times(&mut times, commands.submit()?.times(&gpu)?);
            }
            add_times(&mut times, band.times);
            pairs += band.pairs;
        }
        self.counted(pairs);
        self.times = times;
        Ok(ends)
    }

    /// The picture of a frame in layers.
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
            let (own, first) = (pixels(&call), call.top as usize * TILE_GPU * call.width as usize);
            let picture = picture.take(self.gpu())?;
            let mut rest = &picture[..];
            let mut lane = 0;
            for &lanes in planes {
                let (from, behind) = rest.split_at((lanes * own).min(rest.len()));
                let to = lane * all + lanes * first;
                if let Some(to) = out.get_mut(to..to + from.len()) {
                    to.copy_from_slice(from);
                }
                (rest, lane) = (behind, lane + lanes);
            }
        }
        Ok(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn layers_are_as_long_as_fits() {
        let layer = |place, places, pairs| Layer { place, places, pairs };
        // Counts 2 0 3 1 4 and two splats that meet nothing.
        let offsets = [0, 2, 2, 5, 6, 10, 10];
        assert_eq!(cut(&offsets, 10, (9, 99)), Ok(vec![layer(0, 5, 10)]));
        let expected = vec![layer(0, 3, 5), layer(3, 2, 5)];
        assert_eq!(cut(&offsets, 10, (9, 5)), Ok(expected));
        let expected = vec![layer(0, 2, 2), layer(2, 2, 4), layer(4, 1, 4)];
        assert_eq!(cut(&offsets, 10, (2, 5)), Ok(expected));
        assert_eq!(cut(&[], 0, (2, 5)), Ok(vec![layer(0, 0, 0)]));
        assert_eq!(cut(&[0, 0], 0, (2, 5)), Ok(vec![layer(0, 0, 0)]));
        let error = cut(&offsets, 10, (9, 3));
        assert!(matches!(error, Err(GpuError::TooSmall { needed: 4, limit: 3, .. })), "{error:?}");
    }
}
