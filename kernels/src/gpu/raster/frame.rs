//! Stages of a frame as lists of calls: projection with the sort by depth, then the (splat, tile)
//! pairs and the pixels of a picture.

use crate::camera::Camera;
use crate::gpu::buffers::{Binding, Buffer};
use crate::gpu::commands::{Commands, Groups};
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::raster::constants::{
    FOOTPRINT_STRIDE, GPU_BLOCK, PLAN_ELEMENT_GROUPS, PLAN_WORDS, TILE_GPU,
};
use crate::gpu::raster::kernels::{
    BLEND, INTERSECT, PLAN, PROJECT, RANGES, SCAN_APPLY, SCAN_REDUCE, SCAN_WHOLE,
};
use crate::gpu::raster::scene::Scene;
use crate::gpu::raster::sort::{Sort, plan_of};
use crate::gpu::uniforms::RasterUniform;
use crate::layout::View;
use crate::layout::{BlendRules, RasterOptions, ShBasis, ShDirection};

/// Threads of a workgroup whose threads process one splat each.
pub(crate) const THREADS: usize = 64;

/// Memory layout of a picture's channels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Channels {
    /// RGB per pixel, then the plane of alpha, then the plane of depth sums.
    Interleaved,
    /// Five planes.
    Planes,
}

/// Projected splats of a part of the scene.
#[derive(Clone, Debug)]
pub(crate) struct Store {
    /// Index in the scene of the first splat.
    pub(crate) first: usize,
    /// `[n, 12]`.
    pub(crate) footprints: Buffer,
    /// `[n, 2]`: packed rectangles of tiles.
    pub(crate) rectangles: Buffer,
}

impl Store {
    pub(crate) fn new(gpu: &Gpu, first: usize, count: usize) -> Result<Self, GpuError> {
        Ok(Self {
            first,
            footprints: gpu.empty::<f32>("footprints", FOOTPRINT_STRIDE * count)?,
            rectangles: gpu.empty::<u32>("tile rectangles", 2 * count)?,
        })
    }
}

/// Order of a scene's splats by depth, and their tile counts.
#[derive(Debug)]
pub(crate) struct Depths {
    /// `[N]`: indices of the splats in order of depth.
    pub(crate) order: Buffer,
    /// `[N]`: number of tiles that each splat intersects.
    pub(crate) counts: Buffer,
}

/// Results of a frame on the device, and the inputs of its backward pass.
#[derive(Debug)]
pub(crate) struct FrameBuffers {
    /// Uniform of all splats.
    pub(crate) call: RasterUniform,
    /// `[5·H·W]`, see [`RasterUniform::step`].
    pub(crate) picture: Buffer,
    /// Plan of the pairs.
    pub(crate) plan: Buffer,
    /// `[N, 12]`.
    pub(crate) footprints: Buffer,
    pub(crate) depths: Depths,
    /// Index of the first pair of every splat, in the splats' order by depth.
    pub(crate) offsets: Buffer,
    /// Splat of every pair, in the order of `intersect`.
    pub(crate) owners: Buffer,
    /// Indices of the pairs, sorted by tile.
    pub(crate) pairs: Buffer,
    /// Half-open ranges of `pairs` per tile, and the range of the surplus pairs after the last
    /// tile.
    pub(crate) ranges: Buffer,
    /// `[H, W, 2]`: final transmittance and end of the list (wgsl/raster/blend.wgsl).
    pub(crate) finals: Buffer,
}

/// Returns the bindings of whole buffers.
pub(crate) fn bind<const N: usize>(buffers: [&Buffer; N]) -> [Binding; N] {
    buffers.map(Binding::from)
}

/// Returns the number of pixels of a call's band.
pub(crate) fn pixels(call: &RasterUniform) -> usize {
    let [top, rows] = [call.top, call.rows].map(|t| t as usize * TILE_GPU);
    call.width as usize * rows.min((call.height as usize).saturating_sub(top))
}

/// Returns the number of tiles of a call's band.
pub(crate) fn tiles(call: &RasterUniform) -> usize {
    call.columns as usize * call.rows as usize
}

/// Appends the projection of `scene` into `stores`, one for each part, and the sort by depth.
pub(crate) fn project(
    gpu: &Gpu,
    commands: &mut Commands,
    scene: &Scene,
    mut call: RasterUniform,
    stores: &[Store],
) -> Result<Depths, GpuError> {
    let n = scene.len;
    let counts = gpu.empty::<u32>("tile counts", n)?;
    let plan = gpu.upload("plan", &plan_of(n))?;
    let mut depth = Sort::new(gpu, plan, Groups::of(n, GPU_BLOCK), n)?;
    commands.stage("project");
    for (part, store) in scene.parts.iter().zip(stores) {
        (call.first, call.count) = (part.first as u32, part.count as u32);
        call.own = (part.first - store.first) as u32;
        let own = gpu.uniform(&call)?;
        let results = bind([&store.footprints, &store.rectangles, &depth.keys[0], &counts]);
        let splats = [&part.rows, &part.sh, &part.gain].map(Clone::clone);
        let bindings = [vec![Binding::from(&own)], splats.into(), results.into()].concat();
        commands.run(&PROJECT, &[], &bindings, Groups::of(part.count, THREADS))?;
    }
    commands.stage("sort by depth");
    depth.record(commands, u32::BITS)?;
    let [order, _] = depth.values;
    Ok(Depths { order, counts })
}

/// Indices of the first pairs.
pub(crate) struct Offsets {
    /// Plan of the splats.
    splats: Buffer,
    /// Sums of the blocks, then the number of pairs.
    sums: Buffer,
    /// `[N]`.
    pub(crate) offsets: Buffer,
}

impl Offsets {
    /// Appends the prefix sum of the tile counts of `n` splats, in their order by depth.
    pub(crate) fn record(
        gpu: &Gpu,
        commands: &mut Commands,
        depths: &Depths,
        n: usize,
    ) -> Result<Self, GpuError> {
        commands.stage("prefix sum");
        let (blocks, Depths { order, counts }) = (Groups::of(n, GPU_BLOCK), depths);
        let splats = gpu.upload("plan", &plan_of(n))?;
        let sums = gpu.empty::<u32>("sums", n.div_ceil(GPU_BLOCK) + 1)?;
        let offsets = gpu.empty::<u32>("offsets", n)?;
        let bindings = bind([&splats, order, counts, &sums]);
        commands.run(&SCAN_REDUCE, &[], &bindings, blocks.clone())?;
        let bindings = bind([&splats, &sums]);
        commands.run(&SCAN_WHOLE, &[], &bindings, Groups::Of([1; 3]))?;
        let bindings = bind([&splats, order, counts, &sums, &offsets]);
        commands.run(&SCAN_APPLY, &[], &bindings, blocks)?;
        Ok(Self { splats, sums, offsets })
    }

    /// Appends the computation of the pairs' plan, limited to the call's capacity.
    pub(crate) fn plan(
        &self,
        gpu: &Gpu,
        commands: &mut Commands,
        whole: &Buffer,
    ) -> Result<Buffer, GpuError> {
        let plan = gpu.empty::<u32>("plan", PLAN_WORDS)?;
        let bindings = bind([whole, &self.splats, &self.sums, &plan]);
        commands.run(&PLAN, &[], &bindings, Groups::Of([1; 3]))?;
        Ok(plan)
    }
}

/// Appends the listing of the pairs of the call's splats, which `store` holds, and their
/// rasterization to `picture`.
pub(crate) fn composite(
    gpu: &Gpu,
    commands: &mut Commands,
    call: RasterUniform,
    store: Store,
    depths: Depths,
    picture: &Buffer,
) -> Result<FrameBuffers, GpuError> {
    let (n, capacity) = (call.count as usize, call.capacity as usize);
    let whole = gpu.uniform(&call)?;
    let offsets = Offsets::record(gpu, commands, &depths, n)?;
    let plan = offsets.plan(gpu, commands, &whole)?;
    let Offsets { offsets, .. } = offsets;

    commands.stage("intersect");
    let groups = Groups::Indirect(plan.clone(), 0);
    let owners = gpu.empty::<u32>("owners of pairs", capacity)?;
    let mut pairs = Sort::new(gpu, plan.clone(), groups, capacity)?;
    let bindings = bind([
        &whole,
        &store.footprints,
        &store.rectangles,
        &depths.order,
        &depths.counts,
        &offsets,
        &pairs.keys[0],
        &owners,
    ]);
    commands.run(&INTERSECT, &[], &bindings, Groups::of(n, THREADS))?;

    commands.stage("sort by tile");
    // The surplus tile after the last one has a key, too.
    let tiles = tiles(&call);
    pairs.record(commands, u32::BITS - (tiles as u32).leading_zeros())?;

    commands.stage("ranges");
    let ranges = gpu.empty::<u32>("tile ranges", 2 * (tiles + 1))?;
    commands.clear(&ranges);
    let bindings = bind([&whole, &plan, &pairs.keys[0], &ranges]);
    let per_element = Groups::Indirect(plan.clone(), 4 * PLAN_ELEMENT_GROUPS as u64);
    commands.run(&RANGES, &[], &bindings, per_element)?;

    commands.stage("rasterize");
    let finals = gpu.empty::<u32>("final states of pixels", 2 * pixels(&call))?;
    let [pairs, _] = pairs.values;
    let footprints = store.footprints;
    let bindings = bind([&whole, &footprints, &ranges, &pairs, &owners, picture, &finals]);
    commands.run(&BLEND, &[], &bindings, Groups::of(tiles, 1))?;
    let picture = picture.clone();
    Ok(FrameBuffers {
        call,
        picture,
        plan,
        footprints,
        depths,
        offsets,
        owners,
        pairs,
        ranges,
        finals,
    })
}

/// Returns the uniform for all splats and the whole picture, without a capacity.
///
/// # Errors
/// [`GpuError::Argument`] for [`ShDirection::Colour`], which the CPU alone has.
pub(crate) fn uniform(
    scene: &Scene,
    camera: &Camera,
    options: &RasterOptions,
    channels: Channels,
) -> Result<RasterUniform, GpuError> {
    if options.sh_direction == ShDirection::Colour {
        return Err(GpuError::Argument {
            kernel: PROJECT.name,
            argument: "sh_direction",
            expected: "child or parent".to_owned(),
            got: "colour".to_owned(),
        });
    }
    let view = View::new(camera, options);
    let rules = BlendRules::new(options.convention);
    let row = |i: usize| {
        let [x, y, z] = view.rows[i];
        [x, y, z, view.eye[i]]
    };
    let [(x_low, x_high), (y_low, y_high)] = view.limit;
    let [r, g, b] = options.background;
    let [width, height] = view.size.map(|s| s as u32);
    let (step, channel) = match channels {
        Channels::Interleaved => (3, 1),
        Channels::Planes => (1, width * height),
    };
    let flag = u32::from;
    Ok(RasterUniform {
        right: row(0),
        down: row(1),
        ahead: row(2),
        focal_centre: [view.focal[0], view.focal[1], view.centre[0], view.centre[1]],
        limits: [x_low, x_high, y_low, y_high],
        background: [r, g, b, 0.0],
        near: view.near,
        z_epsilon: view.z_epsilon,
        lowpass: view.lowpass,
        alpha_max: rules.alpha_max,
        stop: rules.stop,
        antialiased: flag(view.antialiased),
        tile_cut: flag(view.tile_cut),
        width,
        height,
        columns: width.div_ceil(TILE_GPU as u32),
        rows: height.div_ceil(TILE_GPU as u32),
        count: scene.len as u32,
        places: scene.len as u32,
        children: scene.children as u32,
        stride: scene.stride as u32,
        sh_stride: scene.sh_stride() as u32,
        sh_degree: options.sh_degree.min(scene.sh_degree) as u32,
        sh_mvsplat: flag(options.sh_basis == ShBasis::Mvsplat),
        sh_shared: flag(options.sh_direction == ShDirection::Parent),
        gain_channels: scene.gain_stride as u32,
        step,
        channel,
        ..RasterUniform::default()
    })
}
