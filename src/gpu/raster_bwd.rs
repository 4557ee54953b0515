//! The way back of a frame: tiles, then a sum over each splat's tiles, then one pass over
//! all splats and one over all parents; one submit. Twin: src/cpu/raster_bwd.rs, same
//! meaning and order of sums; no float atomics, so the same bytes each time.
//!
//! Memory beyond the forward's: 40 bytes a (splat, tile) pair and a splat, and the
//! gradients.

use crate::abi::{Gradients, PAIR_SUMS, RasterOptions, SplatSlices};
use crate::camera::Camera;
use crate::gpu::buffers::{Buffer, Reading};
use crate::gpu::commands::{Commands, Groups};
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::raster_kernels::{COLOUR_BWD, PAIR_SUMS as SUM_PAIRS, PROJECT_BWD, RASTERIZE_BWD};
use crate::gpu::rasterize::{Channels, FrameBuffers, Rasterizer, THREADS, bind};
use crate::gpu::scene::{COV6_LANES, Part, Scene};
use std::sync::Arc;
use std::time::Duration;

/// A rendered frame whose splats and lists are still on the device. Made by
/// [`Rasterizer::frame`].
#[derive(Debug)]
pub struct Frame {
    gpu: Arc<Gpu>,
    scene: Scene,
    buffers: FrameBuffers,
    /// (splat, tile) pairs.
    pairs: usize,
    timed: bool,
    times: Vec<(&'static str, Duration)>,
}

/// Gradients of a part of the scene on their way.
struct PartReading {
    rows: Reading<f32>,
    sh: Reading<f32>,
    gain: Reading<f32>,
}

impl Rasterizer {
    /// Renders into planes `[5, H, W]` as [`Rasterizer::render_planes`] does, and keeps
    /// what [`Frame::backward`] needs.
    ///
    /// # Errors
    /// As [`Rasterizer::render`].
    pub fn frame(
        &mut self,
        splats: &SplatSlices,
        camera: &Camera,
        options: &RasterOptions,
    ) -> Result<(Vec<f32>, Frame), GpuError> {
        let scene = self.gpu().upload_splats(splats)?;
        let (planes, buffers) = self.drawn(&scene, camera, options, Channels::Planes)?;
        let (gpu, pairs, timed) = (self.gpu().clone(), self.pairs(), self.timed);
        Ok((planes, Frame { gpu, scene, buffers, pairs, timed, times: Vec::new() }))
    }

    /// Forward and backward: gradients of a loss whose gradient with respect to the planes
    /// `[5, H, W]` of this view (R, G, B, alpha, Σ w·z) is `gradients`.
    ///
    /// # Errors
    /// As [`Rasterizer::frame`] and [`Frame::backward`].
    pub fn backward(
        &mut self,
        splats: &SplatSlices,
        camera: &Camera,
        options: &RasterOptions,
        gradients: &[f32],
    ) -> Result<Gradients, GpuError> {
        self.frame(splats, camera, options)?.1.backward(gradients)
    }
}

impl Frame {
    /// Gradients of a loss whose gradient with respect to the frame's planes `[5, H, W]`
    /// (R, G, B, alpha, Σ w·z) is `gradients`: those of [`crate::cpu::Frame::backward`].
    ///
    /// # Errors
    /// Gradients of another size; what the device refuses, or is too small for: the
    /// CPU's rasterizer takes it.
    pub fn backward(&mut self, gradients: &[f32]) -> Result<Gradients, GpuError> {
        let call = &self.buffers.call;
        let numbers = 5 * call.width as usize * call.height as usize;
        if gradients.len() != numbers {
            return Err(GpuError::Argument {
                kernel: RASTERIZE_BWD.name,
                what: "gradients",
                expected: format!("{numbers} numbers"),
                got: gradients.len().to_string(),
            });
        }
        let gpu = self.gpu.clone();
        let mut commands = gpu.commands("backward", self.timed);
        let (sums, behind) = self.record_pixels(&mut commands, gradients)?;
        commands.stage("project backward");
        let parts =
            self.scene.parts.iter().map(|part| self.record_part(&mut commands, part, &sums));
        let parts = parts.collect::<Result<Vec<_>, GpuError>>()?;
        let behind = commands.read::<f32>(&behind, 4 * self.tiles())?;
        let submitted = commands.submit()?;
        let mut out = Gradients::default();
        let mut rows = Vec::new();
        for part in parts {
            rows.extend(part.rows.take(&gpu)?);
            out.sh.extend(part.sh.take(&gpu)?);
            out.gain.extend(part.gain.take(&gpu)?);
        }
        self.put_rows(rows, &mut out);
        let mut background = [0.0f64; 3];
        for tile in behind.take(&gpu)?.chunks_exact(4) {
            for (sum, v) in background.iter_mut().zip(tile) {
                *sum += f64::from(*v);
            }
        }
        out.background = background.map(|v| v as f32);
        self.times = submitted.times(&gpu)?;
        Ok(out)
    }

    /// Time of each stage of the last backward on the device, in order; empty where
    /// [`Rasterizer::stage_times`] is.
    pub fn stage_times(&self) -> &[(&'static str, Duration)] {
        &self.times
    }

    fn tiles(&self) -> usize {
        self.buffers.call.columns as usize * self.buffers.call.rows as usize
    }

    /// Adds what gives the sums `[N, 10]` of the splats and `[tiles, 4]` of the background.
    fn record_pixels(
        &self,
        commands: &mut Commands,
        gradients: &[f32],
    ) -> Result<(Buffer, Buffer), GpuError> {
        let (gpu, b) = (&*self.gpu, &self.buffers);
        let whole = gpu.uniform(&b.call)?;
        let upstream = gpu.upload("gradients of the picture", gradients)?;
        let pairs = gpu.empty::<f32>("sums of pairs", PAIR_SUMS * self.pairs)?;
        let sums = gpu.empty::<f32>("sums of splats", PAIR_SUMS * self.scene.len)?;
        let behind = gpu.empty::<f32>("gradients of the background", 4 * self.tiles())?;
        commands.stage("rasterize backward");
        let bindings = bind([
            &whole,
            &b.footprints,
            &b.ranges,
            &b.pairs,
            &b.owners,
            &b.finals,
            &upstream,
            &pairs,
            &behind,
        ]);
        commands.run(&RASTERIZE_BWD, &[], &bindings, Groups::of(self.tiles() + 1, 1))?;
        commands.stage("sum pairs");
        let bindings =
            bind([&whole, &b.footprints, &b.order, &b.counts, &b.offsets, &pairs, &sums]);
        commands.run(&SUM_PAIRS, &[], &bindings, Groups::of(self.scene.len, THREADS))?;
        Ok((sums, behind))
    }

    fn record_part(
        &self,
        commands: &mut Commands,
        part: &Part,
        sums: &Buffer,
    ) -> Result<PartReading, GpuError> {
        let (gpu, scene) = (&*self.gpu, &self.scene);
        let mut call = self.buffers.call;
        (call.first, call.count) = (part.first as u32, part.count as u32);
        let own = gpu.uniform(&call)?;
        let parents = part.count.div_ceil(scene.children);
        let lengths =
            [scene.stride * part.count, scene.sh_stride() * parents, scene.gain_lanes * part.count];
        let [rows, sh, gain] = lengths.map(|n| gpu.empty::<f32>("gradients of splats", n));
        let (rows, sh, gain) = (rows?, sh?, gain?);
        let bindings = bind([&own, &part.rows, &self.buffers.footprints, sums, &rows]);
        commands.run(&PROJECT_BWD, &[], &bindings, Groups::of(part.count, THREADS))?;
        let bindings = bind([&own, &part.rows, &part.sh, &part.gain, sums, &rows, &sh, &gain]);
        commands.run(&COLOUR_BWD, &[], &bindings, Groups::of(parents, THREADS))?;
        let [n, d, g] = lengths;
        Ok(PartReading {
            rows: commands.read(&rows, n)?,
            sh: commands.read(&sh, d)?,
            gain: commands.read(&gain, g)?,
        })
    }

    fn put_rows(&self, rows: Vec<f32>, out: &mut Gradients) {
        if self.scene.stride != COV6_LANES {
            out.rows = rows;
            return;
        }
        for row in rows.chunks_exact(COV6_LANES) {
            let (mean, rest) = row.split_at(3);
            let (cov6, opacity) = rest.split_at(6);
            out.means.extend_from_slice(mean);
            out.cov6.extend_from_slice(cov6);
            out.opacities.extend_from_slice(opacity);
        }
    }
}
