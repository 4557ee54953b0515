//! Backward pass of a frame: per tile, then a sum over each splat's tiles, then one pass over all
//! splats and one over all parents.
//!
//! One submit. The order of summation is fixed and there are no float atomics, so results are
//! reproducible. CPU version, with the same order of summation: cpu/raster/rasterize_bwd.rs. Tests:
//! tests/gpu/raster_bwd.rs.
//!
//! Memory in addition to the forward pass: 40 bytes per (splat, tile) pair and per splat, and the
//! gradients. Where the sums of the pairs exceed a binding, or the frame was rendered in layers,
//! each band is rendered again in smaller layers (gpu/raster/layers.rs). The backward pass then
//! processes the farthest layer first; transmittance and the colour behind a layer are carried
//! from one layer to the next.
//!
//! A thread has eight pixels of a tile, one above the other. The sums of a pair are stored where
//! the pair was made: those of one splat are contiguous, and are added in order.
//!
//! Some adapters have float atomics. Ten atomic additions per pair would read and write 80 bytes;
//! a store, a load and an ordered sum move as much. For 524,288 splats and 818 thousand pairs,
//! atomics would save the splats' indices: 15 of the 278 MB of the backward pass (0.05 ms at
//! 300 GB/s) and one dispatch of 45. Results would not be reproducible, and a second path would
//! need tests.

use crate::camera::Camera;
use crate::gpu::buffers::{Binding, Buffer, Reading};
use crate::gpu::commands::{Commands, Groups};
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::raster::constants::{PAIR_SUMS, TILE_GPU};
use crate::gpu::raster::frame::{
    Channels, Depths, FrameBuffers, Store, THREADS, bind, pixels, tiles,
};
use crate::gpu::raster::kernels::{BLEND_BWD, COLOUR_BWD, PAIR_SUMS as SUM_PAIRS, PROJECT_BWD};
use crate::gpu::raster::layers::{Band, PICTURE_CHANNELS, Times, add_times, bands};
use crate::gpu::raster::rasterize::Rasterizer;
use crate::gpu::raster::scene::{COV6_STRIDE, Part, Scene};
use crate::gpu::uniforms::RasterUniform;
use crate::layout::{Gradients, RasterOptions, SplatSlices};
use std::sync::Arc;
use std::time::Duration;

/// A rendered frame, made by [`Rasterizer::frame`]. Its buffers stay on the device unless it was
/// rendered in layers.
#[derive(Debug)]
pub struct Frame {
    gpu: Arc<Gpu>,
    scene: Scene,
    call: RasterUniform,
    buffers: Option<FrameBuffers>,
    /// (splat, tile) pairs.
    pairs: usize,
    timed: bool,
    times: Times,
}

/// Sums over the pixels for the splats of a part of the scene.
struct PartSums<'a> {
    part: &'a Part,
    /// `[n, 12]`: footprints of the part, or of more splats.
    footprints: Buffer,
    /// `[n, 10]`: sums of the splats of `footprints`.
    sums: Buffer,
    /// Index of the part's first splat in both buffers.
    own: usize,
}

/// Floats of a pixel's gradients in the backward pass through layers: the picture's, and the
/// transmittance.
const LAYER_CHANNELS: usize = PICTURE_CHANNELS + 1;

/// Gradients with respect to the splats and the background, on the device.
struct Pending {
    parts: Vec<PartReading>,
    /// `[tiles, 4]` per band.
    background: Vec<Reading<f32>>,
}

/// Buffers that locate the pairs of splats.
struct SplatBuffers<'a> {
    footprints: &'a Buffer,
    depths: &'a Depths,
    offsets: &'a Buffer,
}

/// Pending read-back of the gradients of a part of the scene.
struct PartReading {
    rows: Reading<f32>,
    sh: Reading<f32>,
    gain: Reading<f32>,
}

/// Gradients by the splats of a part of the scene, in device memory, in the layout of the part.
pub(crate) struct PartGradients {
    pub(crate) rows: Buffer,
    pub(crate) sh: Buffer,
    pub(crate) gain: Buffer,
    /// Floats of the three.
    floats: [usize; 3],
}

impl PartGradients {
    /// Copies gradients by packed rows to the device.
    pub(crate) fn upload(gpu: &Gpu, gradients: &Gradients) -> Result<Self, GpuError> {
        let Gradients { rows, sh, gain, .. } = gradients;
        let floats = [rows.len(), sh.len(), gain.len()];
        let upload = |values: &[f32]| gpu.upload("gradients of splats", values);
        Ok(Self { rows: upload(rows)?, sh: upload(sh)?, gain: upload(gain)?, floats })
    }

    /// Appends the read-back of the gradients.
    fn read(&self, commands: &mut Commands) -> Result<PartReading, GpuError> {
        let mut read = |buffer: &Buffer, floats| commands.read(buffer, floats);
        let [rows, sh, gain] = self.floats;
        Ok(PartReading {
            rows: read(&self.rows, rows)?,
            sh: read(&self.sh, sh)?,
            gain: read(&self.gain, gain)?,
        })
    }
}

impl Rasterizer {
    /// Renders into planes `[5, H, W]` as [`Rasterizer::render_planes`] does, and keeps the
    /// inputs of [`Frame::backward`].
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
        let rendered = self.render_frame(&scene, camera, options, Channels::Planes)?;
        let gpu = self.gpu().clone();
        let pairs = self.pairs();
        let timed = self.timed;
        let call = rendered.call;
        let buffers = rendered.buffers;
        let times = Times::new();
        Ok((rendered.picture, Frame { gpu, scene, call, buffers, pairs, timed, times }))
    }

    /// Renders a frame and computes the gradients of a loss. `gradients` `[5, H, W]` is the
    /// gradient of the loss with respect to R, G, B, alpha and Σ w·z.
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
    /// Computes the gradients of a loss, as [`crate::cpu::Frame::backward`] does. `gradients`
    /// `[5, H, W]` is the gradient of the loss with respect to R, G, B, alpha and Σ w·z of the
    /// frame.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for gradients of another size; [`GpuError::TooSmall`] and other
    /// errors of the device, after which the CPU rasterizer can be used.
    pub fn backward(&mut self, gradients: &[f32]) -> Result<Gradients, GpuError> {
        let numbers = PICTURE_CHANNELS * pixels(&self.call);
        let lengths = [("gradients", gradients.len(), numbers)];
        GpuError::check_lengths(BLEND_BWD.name, lengths)?;
        self.times.clear();
        let pending = match self.buffers.take() {
            Some(frame) if self.pairs <= self.gpu.rows_per_binding(PAIR_SUMS) => {
                let pending = self.at_once(&frame, gradients);
                self.buffers = Some(frame);
                pending?
            }
            _ => self.in_layers(gradients)?,
        };
        let mut out = Gradients::default();
        let mut rows = Vec::new();
        for part in pending.parts {
            rows.extend(part.rows.take(&self.gpu)?);
            out.sh.extend(part.sh.take(&self.gpu)?);
            out.gain.extend(part.gain.take(&self.gpu)?);
        }
        self.put_rows(rows, &mut out);
        let mut background = [0.0f64; 3];
        for band in pending.background {
            for tile in band.take(&self.gpu)?.chunks_exact(4) {
                for (sum, v) in background.iter_mut().zip(tile) {
                    *sum += f64::from(*v);
                }
            }
        }
        out.background = background.map(|v| v as f32);
        Ok(out)
    }

    /// Returns the time of each stage of the last backward pass on the device, in order; empty
    /// where [`Rasterizer::stage_times`] is.
    pub fn stage_times(&self) -> &[(&'static str, Duration)] {
        &self.times
    }

    fn submit(&mut self, commands: Commands) -> Result<(), GpuError> {
        let times = commands.submit()?.times(&self.gpu)?;
        add_times(&mut self.times, times);
        Ok(())
    }

    /// Computes the gradients in one submit.
    fn at_once(&mut self, frame: &FrameBuffers, gradients: &[f32]) -> Result<Pending, GpuError> {
        let gpu = self.gpu.clone();
        let mut commands = gpu.commands("backward", self.timed);
        let upstream = gpu.upload("gradients of the picture", gradients)?;
        let (parts, background) =
            record_backward(&mut commands, &gpu, &self.scene, frame, self.pairs, &upstream)?;
        let background = commands.read::<f32>(&background, 4 * tiles(&frame.call))?;
        let parts = parts.iter().map(|part| part.read(&mut commands)).collect::<Result<_, _>>()?;
        self.submit(commands)?;
        Ok(Pending { parts, background: vec![background] })
    }

    /// Computes the gradients in several submits, for frames of any size.
    fn in_layers(&mut self, gradients: &[f32]) -> Result<Pending, GpuError> {
        let (gpu, scene) = (self.gpu.clone(), self.scene.clone());
        let sums = scene
            .parts
            .iter()
            .map(|part| gpu.empty::<f32>("sums of splats", PAIR_SUMS * part.count));
        let sums: Vec<Buffer> = sums.collect::<Result<_, GpuError>>()?;
        let mut commands = gpu.commands("backward", false);
        sums.iter().for_each(|sums| commands.clear(sums));
        commands.submit()?;
        let (mut background, mut stores) = (Vec::new(), Vec::new());
        for call in bands(&gpu, &self.call, LAYER_CHANNELS)? {
            let band = Band::open(&gpu, &scene, call, PAIR_SUMS, self.timed)?;
            background.push(self.backward_of_band(&band, gradients, &sums)?);
            add_times(&mut self.times, band.times);
            stores = band.stores;
        }
        let mut commands = gpu.commands("backward", self.timed);
        let parts = scene.parts.iter().zip(stores).zip(sums);
        let parts = parts.map(|((part, Store { footprints, .. }), sums)| PartSums {
            part,
            footprints,
            sums,
            own: 0,
        });
        let parts = record_splats(&mut commands, &gpu, &scene, &self.call, parts)?;
        let parts = parts.iter().map(|part| part.read(&mut commands)).collect::<Result<_, _>>()?;
        self.submit(commands)?;
        Ok(Pending { parts, background })
    }

    /// Adds a band's contribution to the `sums` of the parts' splats; returns `[tiles, 4]`, the
    /// gradient of its background.
    fn backward_of_band(
        &mut self,
        band: &Band,
        gradients: &[f32],
        sums: &[Buffer],
    ) -> Result<Reading<f32>, GpuError> {
        let (gpu, scene) = (self.gpu.clone(), self.scene.clone());
        let picture = gpu.empty::<f32>("the picture", PICTURE_CHANNELS * pixels(&band.call))?;
        let mut frames = Vec::new();
        for index in 0..band.layers.len() {
            let mut commands = gpu.commands("layer", self.timed);
            frames.push(band.draw(&gpu, &mut commands, &scene, index, &picture)?);
            self.submit(commands)?;
        }
        let upstream =
            gpu.upload("gradients of the picture", &band_gradients(gradients, &band.call))?;
        let mut background = None;
        for ((index, layer), frame) in band.layers.iter().enumerate().zip(&frames).rev() {
            let mut commands = gpu.commands("backward", self.timed);
            let call = RasterUniform {
                resumes: u32::from(index + 1 < frames.len()),
                carries: u32::from(index > 0),
                ..frame.call
            };
            let (pairs, behind) =
                record_tiles(&mut commands, &gpu, frame, &call, layer.pairs, &upstream)?;
            // Only the farthest layer has a gradient of the background.
            if background.is_none() {
                background = Some(commands.read::<f32>(&behind, 4 * tiles(&call))?);
            }
            for ((part, store), sums) in scene.parts.iter().zip(&band.stores).zip(sums) {
                let call =
                    RasterUniform { resumes: 1, ..band.of_part(*layer, part.first, part.count) };
                let splats = SplatBuffers {
                    footprints: &store.footprints,
                    depths: &band.depths,
                    offsets: &frame.offsets,
                };
                sum_pairs(&mut commands, &gpu, &call, &splats, &pairs, sums)?;
            }
            self.submit(commands)?;
        }
        background.ok_or(GpuError::TooSmall { resource: "layers of a band", needed: 1, limit: 0 })
    }

    fn put_rows(&self, rows: Vec<f32>, out: &mut Gradients) {
        if self.scene.stride != COV6_STRIDE {
            out.rows = rows;
            return;
        }
        for row in rows.chunks_exact(COV6_STRIDE) {
            let (mean, rest) = row.split_at(3);
            let (cov6, opacity) = rest.split_at(6);
            out.means.extend_from_slice(mean);
            out.cov6.extend_from_slice(cov6);
            out.opacities.extend_from_slice(opacity);
        }
    }
}

/// Appends the backward pass of a frame that was drawn at once, with room for `pairs` pairs. `upstream`
/// `[5, H, W]` is the gradient of the picture. Returns the gradients of each part, and `[tiles, 4]`,
/// those of the background.
pub(crate) fn record_backward(
    commands: &mut Commands,
    gpu: &Gpu,
    scene: &Scene,
    frame: &FrameBuffers,
    pairs: usize,
    upstream: &Buffer,
) -> Result<(Vec<PartGradients>, Buffer), GpuError> {
    let call = frame.call;
    let (pairs, background) = record_tiles(commands, gpu, frame, &call, pairs, upstream)?;
    let sums = gpu.empty::<f32>("sums of splats", PAIR_SUMS * scene.len)?;
    let splats = SplatBuffers {
        footprints: &frame.footprints,
        depths: &frame.depths,
        offsets: &frame.offsets,
    };
    sum_pairs(commands, gpu, &call, &splats, &pairs, &sums)?;
    let parts = scene.parts.iter().map(|part| PartSums {
        part,
        footprints: frame.footprints.clone(),
        sums: sums.clone(),
        own: part.first,
    });
    Ok((record_splats(commands, gpu, scene, &call, parts)?, background))
}

/// Appends the gradients of all parts' splats from their sums.
fn record_splats<'a>(
    commands: &mut Commands,
    gpu: &Gpu,
    scene: &Scene,
    call: &RasterUniform,
    parts: impl Iterator<Item = PartSums<'a>>,
) -> Result<Vec<PartGradients>, GpuError> {
    commands.stage("project backward");
    parts.map(|part| record_part(commands, gpu, scene, call, &part)).collect()
}

fn record_part(
    commands: &mut Commands,
    gpu: &Gpu,
    scene: &Scene,
    call: &RasterUniform,
    PartSums { part, footprints, sums, own }: &PartSums,
) -> Result<PartGradients, GpuError> {
    let call = RasterUniform {
        first: part.first as u32,
        count: part.count as u32,
        own: *own as u32,
        ..*call
    };
    let own = gpu.uniform(&call)?;
    let parents = part.count.div_ceil(scene.children);
    let floats =
        [scene.stride * part.count, scene.sh_stride() * parents, scene.gain_stride * part.count];
    let [rows, sh, gain] = floats.map(|n| gpu.empty::<f32>("gradients of splats", n));
    let (rows, sh, gain) = (rows?, sh?, gain?);
    let of = |buffer: &Buffer| Binding::from(buffer);
    let bindings = [of(&own), part.rows.clone(), of(footprints), of(sums), of(&rows)];
    commands.run(&PROJECT_BWD, &[], &bindings, Groups::of(part.count, THREADS))?;
    let splats = [&part.rows, &part.sh, &part.gain].map(Clone::clone);
    let results = bind([sums, &rows, &sh, &gain]);
    let bindings = [vec![of(&own)], splats.into(), results.into()].concat();
    commands.run(&COLOUR_BWD, &[], &bindings, Groups::of(parents, THREADS))?;
    Ok(PartGradients { rows, sh, gain, floats })
}

/// Returns the gradients of a band's pixels `[6, rows, W]`: its rows of `whole` `[5, H, W]`, and
/// space for the transmittance.
fn band_gradients(whole: &[f32], call: &RasterUniform) -> Vec<f32> {
    let plane = (call.width * call.height) as usize;
    let own = pixels(call);
    let first = call.top as usize * TILE_GPU * call.width as usize;
    let mut out = Vec::with_capacity(LAYER_CHANNELS * own);
    for plane in whole.chunks_exact(plane.max(1)) {
        out.extend_from_slice(plane.get(first..first + own).unwrap_or(&[]));
    }
    out.resize(LAYER_CHANNELS * own, 0.0);
    out
}

/// Appends the backward pass of the tiles. Returns ten sums for each of `pairs` pairs, and
/// `[tiles, 4]`, the gradients of the background. Where `call` carries, `upstream` receives the
/// input of the nearer layer.
fn record_tiles(
    commands: &mut Commands,
    gpu: &Gpu,
    frame: &FrameBuffers,
    call: &RasterUniform,
    pairs: usize,
    upstream: &Buffer,
) -> Result<(Buffer, Buffer), GpuError> {
    let tiles = tiles(call);
    let call = gpu.uniform(call)?;
    let sums = gpu.empty::<f32>("sums of pairs", PAIR_SUMS * pairs)?;
    let behind = gpu.empty::<f32>("gradients of the background", 4 * tiles)?;
    commands.stage("rasterize backward");
    let bindings = bind([
        &call,
        &frame.footprints,
        &frame.ranges,
        &frame.pairs,
        &frame.owners,
        &frame.finals,
        upstream,
        &sums,
        &behind,
    ]);
    commands.run(&BLEND_BWD, &[], &bindings, Groups::of(tiles + 1, 1))?;
    Ok((sums, behind))
}

/// Appends the sums over the pairs of the call's splats.
fn sum_pairs(
    commands: &mut Commands,
    gpu: &Gpu,
    call: &RasterUniform,
    splats: &SplatBuffers,
    pairs: &Buffer,
    sums: &Buffer,
) -> Result<(), GpuError> {
    commands.stage("sum pairs");
    let own = gpu.uniform(call)?;
    let SplatBuffers { footprints, depths: Depths { order, counts }, offsets } = splats;
    let bindings = bind([&own, footprints, order, counts, offsets, pairs, sums]);
    commands.run(&SUM_PAIRS, &[], &bindings, Groups::of(call.places as usize, THREADS))
}
