//! A frame on the GPU: project, sort by depth, count and list (splat, tile) pairs, sort by
//! tile, composite; one submit, whatever the counts are. Twin: src/cpu/rasterize.rs.
//!
//! The number of pairs is known to the device alone: kernels take it from a buffer, and
//! the room for pairs grows when a frame's read-back says that it was too small. What no
//! binding holds is drawn in layers (src/gpu/layers.rs).

use crate::abi::{
    FOOTPRINT_STRIDE, PLAN_REQUESTED, PLAN_WORDS, RasterOptions, RasterUniform, Rendered,
    SplatSlices,
};
use crate::camera::Camera;
use crate::gpu::buffers::Reading;
use crate::gpu::commands::Commands;
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::frame::{Channels, FrameBuffers, Store, composite, pixels, project, uniform};
use crate::gpu::layers::PICTURE_CHANNELS;
use crate::gpu::scene::Scene;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

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
    pub(crate) pairs: usize,
    /// The last frame had more pairs than a binding holds.
    crowded: bool,
    /// Counts of the last frame that was drawn to a texture, on their way.
    pub(crate) pending: Option<Reading<u32>>,
    /// Whether a frame has told how much room it takes.
    pub(crate) seen: bool,
    pub(crate) times: Vec<(&'static str, Duration)>,
}

/// A frame's picture, and the frame.
pub(crate) struct Drawn {
    pub(crate) picture: Vec<f32>,
    /// Of all splats and the whole picture.
    pub(crate) call: RasterUniform,
    /// What the frame left on the device, where it was drawn at once.
    pub(crate) buffers: Option<FrameBuffers>,
}

impl Rasterizer {
    /// A rasterizer on `gpu`.
    pub fn new(gpu: Arc<Gpu>) -> Self {
        let capacity = gpu.pairs.load(Relaxed).max(CAPACITY_START);
        let capacity = capacity.min(gpu.rows_per_binding(1));
        Self {
            gpu,
            timed: false,
            capacity,
            pairs: 0,
            crowded: false,
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
        self.capacity = pairs.clamp(1, self.gpu.rows_per_binding(1));
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
        self.drawn(scene, camera, options, channels).map(|drawn| drawn.picture)
    }

    /// A frame, drawn.
    pub(crate) fn drawn(
        &mut self,
        scene: &Scene,
        camera: &Camera,
        options: &RasterOptions,
        channels: Channels,
    ) -> Result<Drawn, GpuError> {
        let call = uniform(scene, camera, options, channels);
        loop {
            if self.needs_layers(scene, &call) {
                let picture = self.layered_picture(scene, &call)?;
                return Ok(Drawn { picture, call, buffers: None });
            }
            let gpu = self.gpu.clone();
            let mut commands = gpu.commands("frame", self.timed);
            let frame = self.record(&mut commands, scene, &call)?;
            let picture = commands.read::<f32>(&frame.picture, PICTURE_CHANNELS * pixels(&call))?;
            let plan = commands.read::<u32>(&frame.plan, PLAN_WORDS)?;
            let submitted = commands.submit()?;
            let plan = plan.take(&gpu)?;
            if !self.learn(&plan) {
                continue;
            }
            self.times = submitted.times(&gpu)?;
            let picture = picture.take(&gpu)?;
            return Ok(Drawn { picture, call, buffers: Some(frame) });
        }
    }

    /// Whether no binding holds all footprints, all pixels or all pairs.
    pub(crate) fn needs_layers(&self, scene: &Scene, call: &RasterUniform) -> bool {
        self.crowded
            || scene.len > self.gpu.rows_per_binding(FOOTPRINT_STRIDE)
            || pixels(call) > self.gpu.rows_per_binding(PICTURE_CHANNELS)
    }

    /// Takes in what a frame asked for; whether there was room for it.
    pub(crate) fn learn(&mut self, plan: &[u32]) -> bool {
        let asked = plan.get(PLAN_REQUESTED).copied().unwrap_or(u32::MAX) as usize;
        if asked <= self.capacity {
            self.pairs = asked;
            return true;
        }
        self.counted(asked);
        false
    }

    /// Takes in how many pairs a frame has.
    pub(crate) fn counted(&mut self, pairs: usize) {
        let most = self.gpu.rows_per_binding(1);
        self.pairs = pairs;
        self.crowded = pairs > most;
        if pairs > self.capacity && !self.crowded {
            self.capacity = pairs.next_power_of_two().min(most);
            self.gpu.pairs.fetch_max(self.capacity, Relaxed);
        }
    }

    /// Adds a frame to `commands`.
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
        composite(gpu, commands, call, (store, depths), &picture)
    }
}
