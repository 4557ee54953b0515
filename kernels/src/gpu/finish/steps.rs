//! Steps of the optimisation of a scene on photographs, in device memory: rasterizer, loss,
//! gradients and Adam's step. Nothing but 4 bytes a step is read back.
//!
//! A step is one submission for each of its pictures, because the buffers of a frame return to the
//! pool after a submission. The CPU is at most [`AHEAD`] steps ahead of the device: it reads the
//! status of an earlier step before it submits another one, so that clocks and progress follow the
//! device, and the device does not wait.
//!
//! The number of a frame's (splat, tile) pairs exists on the device only. A step with a frame of
//! more pairs than the buffers hold changes nothing, nor do those after it; the CPU finds their
//! number in the status, makes room and repeats them. The result is the same as with more room from
//! the start.
//!
//! Scenes and frames that exceed a binding are refused ([`GpuError::TooSmall`]); the caller can
//! then draw frame by frame ([`crate::gpu::Frame`]). CPU version: `src/finish` of the crate
//! `subsplat`. Tests: tests/gpu/refine.rs.

use crate::camera::Camera;
use crate::gpu::buffers::{Buffer, Reading};
use crate::gpu::commands::Commands;
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::finish::loss::{LossRules, PictureLoss, PixelWeights, TargetPicture};
use crate::gpu::finish::optimiser::{Drawn, LeftOut, OptimisedSplats, Optimiser, Rates};
use crate::gpu::raster::constants::PAIR_SUMS;
use crate::gpu::raster::frame::{Channels, FrameBuffers, uniform};
use crate::gpu::raster::rasterize::Rasterizer;
use crate::gpu::raster::rasterize_bwd::{PartGradients, record_backward};
use crate::gpu::raster::scene::Scene;
use crate::gpu::uniforms::RasterUniform;
use crate::layout::RasterOptions;
use std::collections::VecDeque;
use std::ops::Range;
use std::sync::Arc;

/// Steps that the device has not completed, at most.
const AHEAD: usize = 2;

/// A photograph of an optimisation.
#[derive(Clone, Debug)]
pub struct OptimiserTarget<'a> {
    /// Its camera.
    pub camera: &'a Camera,
    /// The photograph.
    pub picture: TargetPicture,
    /// Gaussians that are drawn alone as well, and of which only the rows' gradients count there;
    /// empty for none.
    pub across: Range<usize>,
}

/// Rules of the frames and the losses of an optimisation.
#[derive(Clone, Copy, Debug)]
pub struct OptimiserRules<'a> {
    /// Rules of rendering.
    pub raster: &'a RasterOptions,
    /// Rules of the loss.
    pub loss: LossRules,
    /// Weight of the picture across.
    pub across: f32,
}

/// One step of an optimisation.
#[derive(Clone, Debug)]
pub struct OptimiserStep {
    /// Photographs, whose gradients are added.
    pub targets: Range<usize>,
    /// Constants of Adam's step.
    pub rates: Rates,
    /// Gaussians that the step does not draw.
    pub left_out: Option<LeftOut>,
}

/// Gaussians of a picture that is measured.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum MeasuredSplats {
    /// All of them.
    All,
    /// All but these.
    Without(Range<usize>),
}

struct Target {
    call: RasterUniform,
    picture: TargetPicture,
    across: Range<usize>,
}

/// An optimisation of a scene in device memory.
pub struct SceneOptimiser {
    gpu: Arc<Gpu>,
    rasterizer: Rasterizer,
    optimiser: Optimiser,
    targets: Vec<Target>,
    loss: LossRules,
    across: f32,
    /// Steps that were submitted, and the read-backs of their status.
    submitted: VecDeque<(OptimiserStep, Reading<u32>)>,
}

impl SceneOptimiser {
    /// Copies the scene to the device.
    ///
    /// # Errors
    /// [`GpuError::TooSmall`] where scene or frames exceed a binding; [`GpuError::Argument`] for
    /// arguments of lengths that do not fit; errors of the device.
    pub fn new(
        gpu: Arc<Gpu>,
        splats: &OptimisedSplats,
        targets: Vec<OptimiserTarget>,
        rules: &OptimiserRules,
    ) -> Result<Self, GpuError> {
        let pairs_max = Self::pairs_max(&gpu);
        let new = Rasterizer::new(gpu.clone());
        let capacity = new.capacity().min(pairs_max);
        let rasterizer = new.with_capacity(capacity);
        let optimiser = Optimiser::new(&gpu, splats)?;
        let scene = &optimiser.scene;
        let target = |target: OptimiserTarget| {
            let call = uniform(scene, target.camera, rules.raster, Channels::Planes)?;
            if rasterizer.needs_layers(scene, &call) {
                let (needed, limit) = (scene.len() as u64, pairs_max as u64);
                return Err(GpuError::TooSmall { resource: "a frame at once", needed, limit });
            }
            let OptimiserTarget { picture, across, .. } = target;
            Ok(Target { call, picture, across })
        };
        let targets = targets.into_iter().map(target).collect::<Result<_, _>>()?;
        let (loss, across) = (rules.loss, rules.across);
        let submitted = VecDeque::new();
        Ok(Self { gpu, rasterizer, optimiser, targets, loss, across, submitted })
    }

    /// Sets the room for (splat, tile) pairs, which grows; the result does not depend on it.
    #[must_use]
    pub fn with_capacity(mut self, pairs: usize) -> Self {
        self.rasterizer = self.rasterizer.with_capacity(pairs);
        self
    }

    /// Most pairs of a frame whose backward pass is one call.
    fn pairs_max(gpu: &Gpu) -> usize {
        gpu.rows_per_binding(PAIR_SUMS)
    }

    /// Submits a step. Returns once the device has completed all but the last two.
    ///
    /// # Errors
    /// [`GpuError::TooSmall`] for a frame with more pairs than a binding holds; errors of the
    /// device. The state is then unknown.
    pub fn step(&mut self, step: OptimiserStep) -> Result<(), GpuError> {
        while self.submitted.len() >= AHEAD {
            self.complete()?;
        }
        self.submit(step)
    }

    /// Returns rows `[N, 11]`, gains `[N, 4]`, and SH coefficients where these move, after all
    /// steps.
    ///
    /// # Errors
    /// Those of [`SceneOptimiser::step`].
    pub fn numbers(&mut self) -> Result<[Vec<f32>; 3], GpuError> {
        self.complete_all()?;
        let mut commands = self.gpu.commands("refinement", false);
        let numbers = self.optimiser.read(&mut commands)?;
        commands.submit()?;
        numbers.take(&self.gpu)
    }

    /// Returns the loss of photograph `target` after all steps, drawn from some of the Gaussians.
    ///
    /// # Errors
    /// Those of [`SceneOptimiser::step`]; [`GpuError::Argument`] for a photograph that does not
    /// exist.
    pub fn loss(
        &mut self,
        target: usize,
        splats: &MeasuredSplats,
        weights: PixelWeights,
    ) -> Result<PictureLoss, GpuError> {
        self.complete_all()?;
        let drawn = match splats {
            MeasuredSplats::All => Drawn::All,
            MeasuredSplats::Without(range) => Drawn::Outside(range.clone()),
        };
        loop {
            let gpu = &*self.gpu;
            let mut commands = gpu.commands("measure", false);
            let target = self.target(target)?;
            let (_, frame) = self.record_frame(&mut commands, target, &drawn)?;
            let (picture, rules) = (&frame.picture, &self.loss);
            let loss = target.picture.record_loss(gpu, &mut commands, picture, rules, weights)?;
            let status = commands.read::<u32>(&self.optimiser.status, 1)?;
            commands.submit()?;
            let requested = Self::requested(gpu, status)?;
            if requested == 0 {
                return loss.take(gpu);
            }
            self.make_room(requested)?;
        }
    }

    fn target(&self, index: usize) -> Result<&Target, GpuError> {
        self.targets.get(index).ok_or_else(|| GpuError::Argument {
            kernel: "refinement",
            argument: "photograph",
            expected: format!("below {}", self.targets.len()),
            got: index.to_string(),
        })
    }

    fn requested(gpu: &Gpu, status: Reading<u32>) -> Result<usize, GpuError> {
        Ok(status.take(gpu)?.first().map_or(0, |pairs| *pairs as usize))
    }

    /// Waits for the oldest step. Where a frame had too many pairs, makes room and repeats the
    /// steps from it on.
    fn complete(&mut self) -> Result<(), GpuError> {
        let Some((step, status)) = self.submitted.pop_front() else { return Ok(()) };
        let requested = Self::requested(&self.gpu, status)?;
        if requested == 0 {
            return Ok(());
        }
        let later = std::mem::take(&mut self.submitted).into_iter().map(|(step, _)| step);
        let again: Vec<OptimiserStep> = std::iter::once(step).chain(later).collect();
        self.make_room(requested)?;
        again.into_iter().try_for_each(|step| self.submit(step))
    }

    fn complete_all(&mut self) -> Result<(), GpuError> {
        while !self.submitted.is_empty() {
            self.complete()?;
        }
        Ok(())
    }

    /// Makes room for `pairs` pairs, and clears the status.
    fn make_room(&mut self, pairs: usize) -> Result<(), GpuError> {
        let most = Self::pairs_max(&self.gpu);
        if pairs > most {
            let (needed, limit) = (pairs as u64, most as u64);
            return Err(GpuError::TooSmall { resource: "(splat, tile) pairs", needed, limit });
        }
        self.rasterizer.set_capacity(pairs.next_power_of_two().min(most));
        let mut commands = self.gpu.commands("refinement", false);
        commands.clear(&self.optimiser.status);
        commands.submit().map(drop)
    }

    fn submit(&mut self, step: OptimiserStep) -> Result<(), GpuError> {
        let (gpu, optimiser) = (&*self.gpu, &self.optimiser);
        let drawn = step.left_out.map_or(Drawn::All, Drawn::Without);
        let mut status = None;
        for index in step.targets.clone() {
            let target = self.target(index)?;
            let mut commands = gpu.commands("refinement", false);
            let all = self.record_pass(&mut commands, target, &drawn, PixelWeights::Equal)?;
            let across = if target.across.is_empty() {
                None
            } else {
                // The buffers of the first frame return to the pool.
                commands.submit()?;
                commands = gpu.commands("refinement", false);
                let other = Drawn::Inside(target.across.clone());
                let pass =
                    self.record_pass(&mut commands, target, &other, PixelWeights::Covered)?;
                Some((pass, self.across))
            };
            let across = across.as_ref().map(|(pass, weight)| (pass, *weight));
            let adds = index > step.targets.start;
            optimiser.record_gradients(gpu, &mut commands, &drawn, &all, across, adds)?;
            if index + 1 == step.targets.end {
                optimiser.record_step(gpu, &mut commands, step.rates)?;
                status = Some(commands.read::<u32>(&optimiser.status, 1)?);
            }
            commands.submit()?;
        }
        self.submitted.extend(status.map(|status| (step, status)));
        Ok(())
    }

    /// Appends a frame of the Gaussians `drawn`.
    fn record_frame(
        &self,
        commands: &mut Commands,
        target: &Target,
        drawn: &Drawn,
    ) -> Result<(Scene, FrameBuffers), GpuError> {
        let scene = self.optimiser.record_scene(&self.gpu, commands, drawn)?;
        let frame = self.rasterizer.record(commands, &scene, &target.call)?;
        self.optimiser.watch(commands, &frame.plan)?;
        Ok((scene, frame))
    }

    /// Appends a frame, its loss and the backward pass; returns the gradients by the Gaussians.
    fn record_pass(
        &self,
        commands: &mut Commands,
        target: &Target,
        drawn: &Drawn,
        weights: PixelWeights,
    ) -> Result<PartGradients, GpuError> {
        let gpu = &*self.gpu;
        let (scene, frame) = self.record_frame(commands, target, drawn)?;
        let picture: &Buffer = &frame.picture;
        let upstream =
            target.picture.record_gradient(gpu, commands, picture, &self.loss, weights)?;
        let pairs = self.rasterizer.capacity();
        let (mut parts, _) = record_backward(commands, gpu, &scene, &frame, pairs, &upstream)?;
        // The optimiser's scene has one part.
        parts.pop().ok_or(GpuError::TooSmall { resource: "parts of a scene", needed: 1, limit: 0 })
    }
}
