//! The way back of a frame: tiles, then a sum over each splat's tiles, then one pass over
//! all splats and one over all parents; one submit. Twin: src/cpu/raster_bwd.rs, same
//! meaning and order of sums; no float atomics, so the same bytes each time.
//!
//! Memory beyond the forward's: 40 bytes a (splat, tile) pair and a splat, and the
//! gradients. Where a binding does not hold the pairs' sums, or the frame itself was drawn
//! in layers, each band is drawn again in layers small enough (src/gpu/layers.rs) and goes
//! back farthest layer first, T and what lies behind carried from one to the next.

use crate::abi::{Gradients, PAIR_SUMS, RasterOptions, RasterUniform, SplatSlices, TILE_GPU};
use crate::camera::Camera;
use crate::gpu::buffers::{Buffer, Reading};
use crate::gpu::commands::{Commands, Groups};
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::frame::{Channels, Depths, FrameBuffers, Store, THREADS, bind, pixels, tiles};
use crate::gpu::layers::{Band, PICTURE_CHANNELS, Times, add_times, bands};
use crate::gpu::raster_kernels::{COLOUR_BWD, PAIR_SUMS as SUM_PAIRS, PROJECT_BWD, RASTERIZE_BWD};
use crate::gpu::rasterize::Rasterizer;
use crate::gpu::scene::{COV6_LANES, Part, Scene};
use std::sync::Arc;
use std::time::Duration;

/// A rendered frame, on the device where it was drawn at once. Made by
/// [`Rasterizer::frame`].
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

/// What the pixels say of a part's splats.
struct PartSums<'a> {
    part: &'a Part,
    /// Of the part or, with `own`, of more.
    footprints: Buffer,
    /// `[n, 10]`, beside `footprints`.
    sums: Buffer,
    /// Where the part's first splat stands in both.
    own: usize,
}

/// Floats of a pixel's gradients on the way back through layers: the picture's, and T.
const LAYER_CHANNELS: usize = PICTURE_CHANNELS + 1;

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
        let drawn = self.drawn(&scene, camera, options, Channels::Planes)?;
        let (gpu, pairs, timed) = (self.gpu().clone(), self.pairs(), self.timed);
        let (call, buffers, times) = (drawn.call, drawn.buffers, Times::new());
        Ok((drawn.picture, Frame { gpu, scene, call, buffers, pairs, timed, times }))
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
        let numbers = PICTURE_CHANNELS * pixels(&self.call);
        let lengths = [("gradients", gradients.len(), numbers)];
        GpuError::unless_fitting(RASTERIZE_BWD.name, lengths)?;
        self.times.clear();
        let (parts, behind) = match self.buffers.take() {
            Some(frame) if self.pairs <= self.gpu.rows_per_binding(PAIR_SUMS) => {
                let found = self.at_once(&frame, gradients);
                self.buffers = Some(frame);
                found?
            }
            _ => self.in_layers(gradients)?,
        };
        let mut out = Gradients::default();
        let mut rows = Vec::new();
        for part in parts {
            rows.extend(part.rows.take(&self.gpu)?);
            out.sh.extend(part.sh.take(&self.gpu)?);
            out.gain.extend(part.gain.take(&self.gpu)?);
        }
        self.put_rows(rows, &mut out);
        let mut background = [0.0f64; 3];
        for band in behind {
            for tile in band.take(&self.gpu)?.chunks_exact(4) {
                for (sum, v) in background.iter_mut().zip(tile) {
                    *sum += f64::from(*v);
                }
            }
        }
        out.background = background.map(|v| v as f32);
        Ok(out)
    }

    /// Time of each stage of the last backward on the device, in order; empty where
    /// [`Rasterizer::stage_times`] is.
    pub fn stage_times(&self) -> &[(&'static str, Duration)] {
        &self.times
    }

    fn submit(&mut self, commands: Commands) -> Result<(), GpuError> {
        let times = commands.submit()?.times(&self.gpu)?;
        add_times(&mut self.times, times);
        Ok(())
    }

    /// Gradients of the parts, and `[tiles, 4]` of the background, in one submit.
    fn at_once(
        &mut self,
        frame: &FrameBuffers,
        gradients: &[f32],
    ) -> Result<(Vec<PartReading>, Vec<Reading<f32>>), GpuError> {
        let gpu = self.gpu.clone();
        let mut commands = gpu.commands("backward", self.timed);
        let upstream = gpu.upload("gradients of the picture", gradients)?;
        let call = frame.call;
        let (pairs, behind) =
            tiles_back(&mut commands, &gpu, frame, (&call, self.pairs), &upstream)?;
        let behind = commands.read::<f32>(&behind, 4 * tiles(&call))?;
        let sums = gpu.empty::<f32>("sums of splats", PAIR_SUMS * self.scene.len)?;
        let at = (&frame.footprints, &frame.depths, &frame.offsets);
        sum_pairs(&mut commands, &gpu, &call, at, (&pairs, &sums))?;
        let parts = self.scene.parts.iter().map(|part| PartSums {
            part,
            footprints: frame.footprints.clone(),
            sums: sums.clone(),
            own: part.first,
        });
        let parts = self.splats_back(&mut commands, parts)?;
        self.submit(commands)?;
        Ok((parts, vec![behind]))
    }

    /// The same by several submits, whatever the sizes.
    fn in_layers(
        &mut self,
        gradients: &[f32],
    ) -> Result<(Vec<PartReading>, Vec<Reading<f32>>), GpuError> {
        let (gpu, scene) = (self.gpu.clone(), self.scene.clone());
        let sums = scene
            .parts
            .iter()
            .map(|part| gpu.empty::<f32>("sums of splats", PAIR_SUMS * part.count));
        let sums: Vec<Buffer> = sums.collect::<Result<_, GpuError>>()?;
        let mut commands = gpu.commands("backward", false);
        sums.iter().for_each(|sums| commands.clear(sums));
        commands.submit()?;
        let (mut behind, mut stores) = (Vec::new(), Vec::new());
        for call in bands(&gpu, &self.call, LAYER_CHANNELS)? {
            let band = Band::open(&gpu, &scene, call, PAIR_SUMS, self.timed)?;
            behind.push(self.band_back(&band, gradients, &sums)?);
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
        let parts = self.splats_back(&mut commands, parts)?;
        self.submit(commands)?;
        Ok((parts, behind))
    }

    /// Adds a band to the `sums` of the parts' splats; `[tiles, 4]` of its background.
    fn band_back(
        &mut self,
        band: &Band,
        gradients: &[f32],
        sums: &[Buffer],
    ) -> Result<Reading<f32>, GpuError> {
        let (gpu, scene) = (self.gpu.clone(), self.scene.clone());
        let picture = gpu.empty::<f32>("the picture", PICTURE_CHANNELS * pixels(&band.call))?;
        let mut frames = Vec::new();
        for at in 0..band.layers.len() {
            let mut commands = gpu.commands("layer", self.timed);
            frames.push(band.draw(&gpu, &mut commands, &scene, at, &picture)?);
            self.submit(commands)?;
        }
        let upstream = gpu.upload("gradients of the picture", &of_band(gradients, &band.call))?;
        let mut background = None;
        for ((at, layer), frame) in band.layers.iter().enumerate().zip(&frames).rev() {
            let mut commands = gpu.commands("backward", self.timed);
            let call = RasterUniform {
                resumes: u32::from(at + 1 < frames.len()),
                carries: u32::from(at > 0),
                ..frame.call
            };
            let (pairs, behind) =
                tiles_back(&mut commands, &gpu, frame, (&call, layer.pairs), &upstream)?;
            // Those nearer know nothing of the background.
            if background.is_none() {
                background = Some(commands.read::<f32>(&behind, 4 * tiles(&call))?);
            }
            for ((part, store), sums) in scene.parts.iter().zip(&band.stores).zip(sums) {
                let call =
                    RasterUniform { resumes: 1, ..band.of_part(*layer, part.first, part.count) };
                let at = (&store.footprints, &band.depths, &frame.offsets);
                sum_pairs(&mut commands, &gpu, &call, at, (&pairs, sums))?;
            }
            self.submit(commands)?;
        }
        background.ok_or(GpuError::TooSmall { what: "layers of a band", needed: 1, limit: 0 })
    }

    fn splats_back<'a>(
        &self,
        commands: &mut Commands,
        parts: impl Iterator<Item = PartSums<'a>>,
    ) -> Result<Vec<PartReading>, GpuError> {
        commands.stage("project backward");
        parts.map(|part| self.record_part(commands, &part)).collect()
    }

    fn record_part(
        &self,
        commands: &mut Commands,
        PartSums { part, footprints, sums, own }: &PartSums,
    ) -> Result<PartReading, GpuError> {
        let (gpu, scene) = (&*self.gpu, &self.scene);
        let call = RasterUniform {
            first: part.first as u32,
            count: part.count as u32,
            own: *own as u32,
            ..self.call
        };
        let own = gpu.uniform(&call)?;
        let parents = part.count.div_ceil(scene.children);
        let lengths =
            [scene.stride * part.count, scene.sh_stride() * parents, scene.gain_lanes * part.count];
        let [rows, sh, gain] = lengths.map(|n| gpu.empty::<f32>("gradients of splats", n));
        let (rows, sh, gain) = (rows?, sh?, gain?);
        let bindings = bind([&own, &part.rows, footprints, sums, &rows]);
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

/// Gradients of a band's pixels `[6, rows, W]`: of its rows of `whole` `[5, H, W]`, and room
/// for T.
fn of_band(whole: &[f32], call: &RasterUniform) -> Vec<f32> {
    let (plane, own) = ((call.width * call.height) as usize, pixels(call));
    let first = call.top as usize * TILE_GPU * call.width as usize;
    let mut out = Vec::with_capacity(LAYER_CHANNELS * own);
    for plane in whole.chunks_exact(plane.max(1)) {
        out.extend_from_slice(plane.get(first..first + own).unwrap_or(&[]));
    }
    out.resize(LAYER_CHANNELS * own, 0.0);
    out
}

/// Adds what gives ten sums for each of `pairs` pairs of a frame, `[tiles, 4]` of the
/// background, and, where `call` carries, `upstream` for the layer before.
fn tiles_back(
    commands: &mut Commands,
    gpu: &Gpu,
    frame: &FrameBuffers,
    (call, pairs): (&RasterUniform, usize),
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
    commands.run(&RASTERIZE_BWD, &[], &bindings, Groups::of(tiles + 1, 1))?;
    Ok((sums, behind))
}

/// Adds what sums up the pairs of the call's places for its splats.
fn sum_pairs(
    commands: &mut Commands,
    gpu: &Gpu,
    call: &RasterUniform,
    (footprints, depths, offsets): (&Buffer, &Depths, &Buffer),
    (pairs, sums): (&Buffer, &Buffer),
) -> Result<(), GpuError> {
    commands.stage("sum pairs");
    let own = gpu.uniform(call)?;
    let Depths { order, counts } = depths;
    let bindings = bind([&own, footprints, order, counts, offsets, pairs, sums]);
    commands.run(&SUM_PAIRS, &[], &bindings, Groups::of(call.places as usize, THREADS))
}
