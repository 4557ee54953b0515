//! The rasterizer on the GPU: project, sort by depth, count and list (splat, tile) pairs, sort by
//! tile, composite (3DGS, section 6).
//!
//! One submit per frame. CPU version: cpu/raster/rasterize.rs. Tests: tests/gpu/raster.rs.
//!
//! The number of pairs exists on the device only; kernels read it from a buffer. The capacity for
//! pairs grows when the read-back of a frame reports that it was too small. Frames that exceed a
//! binding are drawn in layers (gpu/raster/layers.rs).
//!
//! A thread processes four pixels. llvmpipe reads memory lane by lane; without AVX-512 it puts each number into its
//! vector through the stack, where the reload waits for the store. There one pixel a thread takes 3.2 times the CPU time:
//! 3.9 s a frame instead of 1.2 s for 131,072 splats at 512² (Xeon; with AVX-512 0.86 s and 0.37 s).
//!
//! Commands are lists of calls, encoded and submitted at once inside error scopes.

use crate::camera::Camera;
use crate::gpu::buffers::Reading;
use crate::gpu::commands::Commands;
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::raster::constants::{FOOTPRINT_STRIDE, PLAN_REQUESTED, PLAN_WORDS};
use crate::gpu::raster::frame::{
    Channels, FrameBuffers, Store, composite, pixels, project, uniform,
};
use crate::gpu::raster::layers::PICTURE_CHANNELS;
use crate::gpu::raster::scene::Scene;
use crate::gpu::uniforms::RasterUniform;
use crate::layout::{RasterOptions, Rendered, SplatSlices};
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

/// Capacity for pairs at the first frame of a GPU.
const CAPACITY_START: usize = 1 << 16;

/// The rasterizer on a GPU, with the capacity that earlier frames required. Same results as
/// [`crate::cpu::Rasterizer`].
#[derive(Debug)]
pub struct Rasterizer {
    gpu: Arc<Gpu>,
    pub(crate) timed: bool,
    /// Capacity for (splat, tile) pairs.
    capacity: usize,
    pub(crate) pairs: usize,
    /// True if the last frame had more pairs than a binding holds.
    pairs_exceed_binding: bool,
    /// Pending read-back of the plan of the last frame that was drawn to a texture.
    pub(crate) pending: Option<Reading<u32>>,
    /// True if the pair count of a drawn frame has been read back.
    pub(crate) pairs_known: bool,
    pub(crate) times: Vec<(&'static str, Duration)>,
}

/// A rendered frame.
pub(crate) struct RenderedFrame {
    pub(crate) picture: Vec<f32>,
    /// Uniform of all splats and the whole picture.
    pub(crate) call: RasterUniform,
    /// Buffers of the frame; `None` for a frame in layers.
    pub(crate) buffers: Option<FrameBuffers>,
}

impl Rasterizer {
    /// Creates a rasterizer on `gpu`.
    pub fn new(gpu: Arc<Gpu>) -> Self {
        let capacity = gpu.pairs.load(Relaxed).max(CAPACITY_START);
        let capacity = capacity.min(gpu.rows_per_binding(1));
        Self {
            gpu,
            timed: false,
            capacity,
            pairs: 0,
            pairs_exceed_binding: false,
            pending: None,
            pairs_known: false,
            times: Vec::new(),
        }
    }

    /// Measures [`Rasterizer::stage_times`] where the device has timestamps.
    pub fn with_stage_times(mut self) -> Self {
        self.timed = true;
        self
    }

    /// Sets the initial capacity for (splat, tile) pairs, 16 bytes each. The capacity grows, and
    /// the picture does not depend on it.
    pub fn with_capacity(mut self, pairs: usize) -> Self {
        self.capacity = pairs.clamp(1, self.gpu.rows_per_binding(1));
        self
    }

    /// Returns the capacity for (splat, tile) pairs.
    pub(crate) fn capacity(&self) -> usize {
        self.capacity
    }

    /// Sets the capacity, and the start value of new rasterizers where it is larger than theirs.
    pub(crate) fn set_capacity(&mut self, pairs: usize) {
        self.capacity = pairs;
        self.gpu.pairs.fetch_max(pairs, Relaxed);
    }

    /// Returns the GPU.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// Returns the number of (splat, tile) pairs of the last frame, for tiles of 16×16 pixels.
    pub fn pairs(&self) -> usize {
        self.pairs
    }

    /// Returns the time of each stage of the last frame on the device, in order; empty without
    /// [`Rasterizer::with_stage_times`] or timestamps.
    pub fn stage_times(&self) -> &[(&'static str, Duration)] {
        &self.times
    }

    /// Renders `splats` as seen by `camera`.
    ///
    /// # Errors
    /// Errors of the device, or [`GpuError::TooSmall`]; the CPU rasterizer can be used instead.
    pub fn render(
        &mut self,
        splats: &SplatSlices,
        camera: &Camera,
        options: &RasterOptions,
    ) -> Result<Rendered, GpuError> {
        let scene = self.gpu.upload_splats(splats)?;
        self.render_scene(&scene, camera, options)
    }

    /// Renders splats of device memory.
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

    /// Renders splats of device memory into planes, as [`Rasterizer::render_planes`] does.
    ///
    /// # Errors
    /// As [`Rasterizer::render`].
    pub fn render_scene_planes(
        &mut self,
        scene: &Scene,
        camera: &Camera,
        options: &RasterOptions,
    ) -> Result<Vec<f32>, GpuError> {
        self.pixels(scene, camera, options, Channels::Planes)
    }

    fn pixels(
        &mut self,
        scene: &Scene,
        camera: &Camera,
        options: &RasterOptions,
        channels: Channels,
    ) -> Result<Vec<f32>, GpuError> {
        self.render_frame(scene, camera, options, channels).map(|frame| frame.picture)
    }

    /// Renders a frame and reads its picture back.
    pub(crate) fn render_frame(
        &mut self,
        scene: &Scene,
        camera: &Camera,
        options: &RasterOptions,
        channels: Channels,
    ) -> Result<RenderedFrame, GpuError> {
        let call = uniform(scene, camera, options, channels)?;
        loop {
            if self.needs_layers(scene, &call) {
                let picture = self.layered_picture(scene, &call)?;
                return Ok(RenderedFrame { picture, call, buffers: None });
            }
            let gpu = self.gpu.clone();
            let mut commands = gpu.commands("frame", self.timed);
            let frame = self.record(&mut commands, scene, &call)?;
            let picture = commands.read::<f32>(&frame.picture, PICTURE_CHANNELS * pixels(&call))?;
            let plan = commands.read::<u32>(&frame.plan, PLAN_WORDS)?;
            let submitted = commands.submit()?;
            let plan = plan.take(&gpu)?;
            if !self.update_capacity(&plan) {
                continue;
            }
            self.times = submitted.times(&gpu)?;
            let picture = picture.take(&gpu)?;
            return Ok(RenderedFrame { picture, call, buffers: Some(frame) });
        }
    }

    /// Returns whether the footprints, the pixels or the pairs exceed a binding.
    pub(crate) fn needs_layers(&self, scene: &Scene, call: &RasterUniform) -> bool {
        self.pairs_exceed_binding
            || scene.len > self.gpu.rows_per_binding(FOOTPRINT_STRIDE)
            || pixels(call) > self.gpu.rows_per_binding(PICTURE_CHANNELS)
    }

    /// Records the pair count of a frame from its plan; returns whether the capacity was
    /// sufficient.
    pub(crate) fn update_capacity(&mut self, plan: &[u32]) -> bool {
        let requested = plan.get(PLAN_REQUESTED).copied().unwrap_or(u32::MAX) as usize;
        if requested <= self.capacity {
            self.pairs = requested;
            return true;
        }
        self.set_pair_count(requested);
        false
    }

    /// Records the pair count of a frame and enlarges the capacity where necessary.
    pub(crate) fn set_pair_count(&mut self, pairs: usize) {
        let max_pairs = self.gpu.rows_per_binding(1);
        self.pairs = pairs;
        self.pairs_exceed_binding = pairs > max_pairs;
        if pairs > self.capacity && !self.pairs_exceed_binding {
            self.set_capacity(pairs.next_power_of_two().min(max_pairs));
        }
    }

    /// Appends a frame to `commands`.
    pub(crate) fn record(
        &self,
        commands: &mut Commands,
        scene: &Scene,
        call: &RasterUniform,
    ) -> Result<FrameBuffers, GpuError> {
        let gpu = &*self.gpu;
        let call = RasterUniform { capacity: self.capacity as u32, ..*call };
        let store = Store::new(gpu, 0, scene.len)?;
        let stores = vec![store.clone(); scene.parts.len()];
        let depths = project(gpu, commands, scene, call, &stores)?;
        let picture = gpu.empty::<f32>("the picture", PICTURE_CHANNELS * pixels(&call))?;
        composite(gpu, commands, call, store, depths, &picture)
    }
}
