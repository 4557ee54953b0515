//! A frame on the GPU: project, sort by depth, count and list (splat, tile) pairs, sort by
//! tile, composite; one submit, whatever the counts are. Twin: src/cpu/rasterize.rs.
//!
//! The number of pairs is known to the device alone: kernels take it from a buffer, and
//! the room for pairs grows when a frame's read-back says that it was too small.

use crate::abi::{
    BlendRules, FOOTPRINT_LANES, GPU_BLOCK, PLAN_ASKED, PLAN_EACH, PLAN_WORDS, RasterOptions,
    RasterUniform, Rendered, ShBasis, ShDirection, SplatSlices, TILE_GPU,
};
use crate::camera::Camera;
use crate::gpu::buffers::{Binding, Buffer, Reading};
use crate::gpu::commands::{Commands, Groups};
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::raster_kernels::{
    INTERSECT, PLAN, PROJECT, RANGES, RASTERIZE, SCAN_APPLY, SCAN_REDUCE, SCAN_WHOLE,
};
use crate::gpu::scene::Scene;
use crate::gpu::sort::{Sort, plan_of};
use crate::view::View;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

/// Threads of a workgroup that takes one splat a thread.
pub(crate) const THREADS: usize = 64;
/// Room for pairs at the first frame, unless the GPU has seen more.
const CAPACITY_START: usize = 1 << 16;

/// The rasterizer with what it learnt about frames: same meaning as
/// [`crate::cpu::Rasterizer`].
#[derive(Debug)]
pub struct Rasterizer {
    gpu: Arc<Gpu>,
    pub(crate) timed: bool,
    /// Room for (splat, tile) pairs.
    capacity: usize,
    pairs: usize,
    /// Counts of the last frame that was drawn to a texture, on their way.
    pub(crate) pending: Option<Reading<u32>>,
    /// Whether a frame has told how much room it takes.
    pub(crate) seen: bool,
    times: Vec<(&'static str, Duration)>,
}

/// Where a frame's results lie on the device, and what its backward pass needs.
#[derive(Debug)]
pub(crate) struct FrameBuffers {
    /// Of all splats.
    pub(crate) call: RasterUniform,
    /// `[5·H·W]`, see [`RasterUniform::step`].
    pub(crate) picture: Buffer,
    /// Of the pairs.
    pub(crate) plan: Buffer,
    /// `[N, 12]`.
    pub(crate) footprints: Buffer,
    /// Splats by depth.
    pub(crate) order: Buffer,
    /// `[N]`: tiles that a splat meets.
    pub(crate) counts: Buffer,
    /// Place of the first pair of every splat, in the splats' order by depth.
    pub(crate) offsets: Buffer,
    /// Splat of every pair, as they were made.
    pub(crate) owners: Buffer,
    /// Places of the pairs, by tile.
    pub(crate) pairs: Buffer,
    /// First and past-the-last of `pairs` of every tile, and of those behind the last.
    pub(crate) ranges: Buffer,
    /// `[H, W, 2]`: see kernels/rasterize.wgsl.
    pub(crate) finals: Buffer,
}

/// How a picture's channels lie in memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Channels {
    /// RGB pixel by pixel, then alpha, then depth sums.
    Interleaved,
    /// Five planes.
    Planes,
}

impl Rasterizer {
    /// A rasterizer on `gpu`.
    pub fn new(gpu: Arc<Gpu>) -> Self {
        let capacity = gpu.pairs.load(Relaxed).max(CAPACITY_START);
        Self {
            gpu,
            timed: false,
            capacity,
            pairs: 0,
            pending: None,
            seen: false,
            times: Vec::new(),
        }
    }

    /// Measures what [`Rasterizer::stage_times`] tells, where the adapter can.
    pub fn with_stage_times(mut self) -> Self {
        self.timed = true;
        self
    }

    /// Room for `pairs` (splat, tile) pairs at the first frame, 16 bytes each; it grows.
    /// The picture does not depend on it.
    pub fn with_capacity(mut self, pairs: usize) -> Self {
        self.capacity = pairs.max(1);
        self
    }

    /// The GPU that it works on.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// (splat, tile) pairs of the last frame, tiles of 16×16 pixels.
    pub fn pairs(&self) -> usize {
        self.pairs
    }

    /// Time of each stage of the last frame on the device, in order; empty without
    /// [`Rasterizer::with_stage_times`] or timestamps.
    pub fn stage_times(&self) -> &[(&'static str, Duration)] {
        &self.times
    }

    /// Renders `splats` seen by `camera`.
    ///
    /// # Errors
    /// What the device refuses, or is too small for: the CPU's rasterizer takes it.
    pub fn render(
        &mut self,
        splats: &SplatSlices,
        camera: &Camera,
        options: &RasterOptions,
    ) -> Result<Rendered, GpuError> {
        let scene = self.gpu.upload_splats(splats)?;
        self.render_scene(&scene, camera, options)
    }

    /// Renders splats that are on the device.
    ///
    /// # Errors
    /// As [`Rasterizer::render`].
    pub fn render_scene(
        &mut self,
        scene: &Scene,
        camera: &Camera,
        options: &RasterOptions,
    ) -> Result<Rendered, GpuError> {
        let mut rgb = self.pixels(scene, camera, options, Channels::Interleaved)?;
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let depth_sum = rgb.split_off((4 * width * height).min(rgb.len()));
        let alpha = rgb.split_off((3 * width * height).min(rgb.len()));
        Ok(Rendered { width, height, rgb, alpha, depth_sum })
    }

    /// Renders into planes `[5, H, W]`: R, G, B, alpha, Σ w·z.
    ///
    /// # Errors
    /// As [`Rasterizer::render`].
    pub fn render_planes(
        &mut self,
        splats: &SplatSlices,
        camera: &Camera,
        options: &RasterOptions,
    ) -> Result<Vec<f32>, GpuError> {
        let scene = self.gpu.upload_splats(splats)?;
        self.pixels(&scene, camera, options, Channels::Planes)
    }

    fn pixels(
        &mut self,
        scene: &Scene,
        camera: &Camera,
        options: &RasterOptions,
        channels: Channels,
    ) -> Result<Vec<f32>, GpuError> {
        self.drawn(scene, camera, options, channels).map(|(picture, _)| picture)
    }

    /// A frame's picture, and the frame.
    pub(crate) fn drawn(
        &mut self,
        scene: &Scene,
        camera: &Camera,
        options: &RasterOptions,
        channels: Channels,
    ) -> Result<(Vec<f32>, FrameBuffers), GpuError> {
        let floats = 5 * camera.intrinsics.width * camera.intrinsics.height;
        loop {
            let gpu = self.gpu.clone();
            let mut commands = gpu.commands("frame", self.timed);
            let frame = self.record(&mut commands, scene, camera, options, channels)?;
            let picture = commands.read::<f32>(&frame.picture, floats)?;
            let plan = commands.read::<u32>(&frame.plan, PLAN_WORDS)?;
            let submitted = commands.submit()?;
            let plan = plan.take(&gpu)?;
            if !self.learn(&plan)? {
                continue;
            }
            self.times = submitted.times(&gpu)?;
            return Ok((picture.take(&gpu)?, frame));
        }
    }

    /// Takes in what a frame asked for; whether there was room for it.
    pub(crate) fn learn(&mut self, plan: &[u32]) -> Result<bool, GpuError> {
        let asked = plan.get(PLAN_ASKED).copied().unwrap_or(u32::MAX) as usize;
        self.pairs = asked;
        if asked <= self.capacity {
            return Ok(true);
        }
        let most = self.gpu.rows_per_binding(1);
        if asked > most {
            let (needed, limit) = (asked as u64, most as u64);
            return Err(GpuError::TooSmall { what: "(splat, tile) pairs", needed, limit });
        }
        self.capacity = asked.next_power_of_two().min(most);
        self.gpu.pairs.fetch_max(self.capacity, Relaxed);
        Ok(false)
    }

    /// Adds a frame to `commands`.
    pub(crate) fn record(
        &self,
        commands: &mut Commands,
        scene: &Scene,
        camera: &Camera,
        options: &RasterOptions,
        channels: Channels,
    ) -> Result<FrameBuffers, GpuError> {
        let gpu = &*self.gpu;
        let n = scene.len;
        let mut call = uniform(scene, camera, options, channels);
        call.capacity = self.capacity as u32;
        let whole = gpu.uniform(&call)?;
        let splat_plan = gpu.upload("plan", &plan_of(n))?;
        let footprints = gpu.empty::<f32>("footprints", FOOTPRINT_LANES * n)?;
        let rectangles = gpu.empty::<u32>("tile rectangles", 2 * n)?;
        let counts = gpu.empty::<u32>("tile counts", n)?;
        let blocks = Groups::of(n, GPU_BLOCK);
        let mut depth = Sort::new(gpu, splat_plan.clone(), blocks.clone(), n, true)?;

        commands.stage("project");
        for part in &scene.parts {
            call.first = part.first as u32;
            call.count = part.count as u32;
            let own = gpu.uniform(&call)?;
            let bindings = bind([
                &own,
                &part.rows,
                &part.sh,
                &part.gain,
                &footprints,
                &rectangles,
                &depth.keys[0],
                &counts,
            ]);
            commands.run(&PROJECT, &[], &bindings, Groups::of(part.count, THREADS))?;
        }
        commands.stage("sort by depth");
        depth.record(commands, u32::BITS)?;
        let order = depth.values[0].clone();

        commands.stage("prefix sum");
        let sums = gpu.empty::<u32>("sums", n.div_ceil(GPU_BLOCK) + 1)?;
        let offsets = gpu.empty::<u32>("offsets", n)?;
        let plan = gpu.empty::<u32>("plan", PLAN_WORDS)?;
        let bindings = bind([&splat_plan, &order, &counts, &sums]);
        commands.run(&SCAN_REDUCE, &[], &bindings, blocks.clone())?;
        let bindings = bind([&splat_plan, &sums]);
        commands.run(&SCAN_WHOLE, &[], &bindings, Groups::Of([1; 3]))?;
        let bindings = bind([&splat_plan, &order, &counts, &sums, &offsets]);
        commands.run(&SCAN_APPLY, &[], &bindings, blocks)?;
        let bindings = bind([&whole, &splat_plan, &sums, &plan]);
        commands.run(&PLAN, &[], &bindings, Groups::Of([1; 3]))?;

        commands.stage("intersect");
        let groups = Groups::Indirect(plan.clone(), 0);
        let owners = gpu.empty::<u32>("owners of pairs", self.capacity)?;
        let mut pairs = Sort::new(gpu, plan.clone(), groups, self.capacity, true)?;
        let bindings = bind([
            &whole,
            &footprints,
            &rectangles,
            &order,
            &counts,
            &offsets,
            &pairs.keys[0],
            &owners,
        ]);
        commands.run(&INTERSECT, &[], &bindings, Groups::of(n, THREADS))?;

        commands.stage("sort by tile");
        // The tile behind the last is one too.
        let tiles = (call.columns * call.rows) as usize;
        pairs.record(commands, u32::BITS - (tiles as u32).leading_zeros())?;

        commands.stage("ranges");
        let ranges = gpu.empty::<u32>("tile ranges", 2 * (tiles + 1))?;
        commands.clear(&ranges);
        let bindings = bind([&whole, &plan, &pairs.keys[0], &ranges]);
        let each = Groups::Indirect(plan.clone(), 4 * PLAN_EACH as u64);
        commands.run(&RANGES, &[], &bindings, each)?;

        commands.stage("rasterize");
        let pixels = (call.width * call.height) as usize;
        let picture = gpu.empty::<f32>("the picture", 5 * pixels)?;
        let finals = gpu.empty::<u32>("ends of pixels", 2 * pixels)?;
        let pairs = pairs.values[0].clone();
        let bindings = bind([&whole, &footprints, &ranges, &pairs, &owners, &picture, &finals]);
        commands.run(&RASTERIZE, &[], &bindings, Groups::of(tiles, 1))?;
        (call.first, call.count) = (0, n as u32);
        Ok(FrameBuffers {
            call,
            picture,
            plan,
            footprints,
            order,
            counts,
            offsets,
            owners,
            pairs,
            ranges,
            finals,
        })
    }
}

pub(crate) fn bind<const N: usize>(buffers: [&Buffer; N]) -> [Binding; N] {
    buffers.map(Binding::from)
}

/// The call's uniform, for all splats; capacity left out.
fn uniform(
    scene: &Scene,
    camera: &Camera,
    options: &RasterOptions,
    channels: Channels,
) -> RasterUniform {
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
    RasterUniform {
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
        first: 0,
        count: scene.len as u32,
        children: scene.children as u32,
        stride: scene.stride as u32,
        sh_stride: scene.sh_stride() as u32,
        sh_degree: options.sh_degree.min(scene.sh_degree) as u32,
        sh_mvsplat: flag(options.sh_basis == ShBasis::Mvsplat),
        sh_shared: flag(options.sh_direction == ShDirection::Parent),
        gain_lanes: scene.gain_lanes as u32,
        capacity: 0,
        step,
        channel,
        pad: 0,
    }
}
