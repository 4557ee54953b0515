//! Photographs that are cropped and checked, and the network's run on them.

use super::progress::Tracker;
use super::repeated::hide_repeated;
use super::unit;
use super::{
    DepthBounds, Detail, Options, Progress, Reconstruction, Reconstructor, Result, SceneChildren,
    Stage, Warning, add_surroundings, counts_of, fit_to_inputs, match_parents, options_of_parents,
    refine_on_inputs, refine_parents,
};
use crate::cameras::check::PairReport;
use crate::cameras::estimation::PoseAdjustment;
use crate::finish::PhaseRun;
use crate::network::model::Views;
use crate::reconstruct::inputs::crop::Cropped;
use crate::scene::mask::Mask;
use crate::scene::pictures::Depth;
use crate::scene::render::Renderer;
use crate::scene::splats::Splats;
use std::cell::Cell;
use std::ops::ControlFlow;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::RasterOptions;

/// Steps of the estimate of the depth range.
const RANGE_STEPS: usize = 4;

/// Cropped photographs with a depth range, from [`Reconstructor::prepare`]. It holds nothing of
/// the photographs' full size.
pub struct Prepared<'a> {
    pub(super) model: &'a Reconstructor,
    pub(super) options: Options,
    pub(super) inputs: Vec<Cropped>,
    pub(super) adjustment: Option<PoseAdjustment>,
    pub(super) cut_shares: Vec<f32>,
    pub(super) bounds: DepthBounds,
    pub(super) reports: Vec<PairReport>,
    pub(super) warnings: Vec<Warning>,
    pub(super) tracker: Tracker,
}

impl Prepared<'_> {
    /// The photographs at the sizes of the network's input and of the target.
    pub fn inputs(&self) -> &[Cropped] {
        &self.inputs
    }

    /// Change of the given cameras ([`Poses::Adjusted`](super::Poses::Adjusted)); `None` where they
    /// stayed.
    pub fn pose_adjustment(&self) -> Option<&PoseAdjustment> {
        self.adjustment.as_ref()
    }

    /// Share of each photograph that its crop does not show, 0 to 1.
    pub fn cut_shares(&self) -> &[f32] {
        &self.cut_shares
    }

    /// The depth range before the network estimates its own.
    pub fn depth_range(&self) -> &DepthBounds {
        &self.bounds
    }

    /// Reports of the check, one for each pair of consecutive photographs; empty without one.
    pub fn reports(&self) -> &[PairReport] {
        &self.reports
    }

    /// Warnings so far.
    pub fn warnings(&self) -> &[Warning] {
        &self.warnings
    }

    /// Runs the network.
    ///
    /// # Errors
    /// An error of the network.
    pub fn reconstruct(self) -> Result<Reconstruction> {
        self.reconstruct_with(&mut |_| ControlFlow::Continue(()))
    }

    /// [`Prepared::reconstruct`] with a callback for progress, whose fractions continue those of
    /// [`Reconstructor::prepare_with`].
    ///
    /// # Errors
    /// Those of [`Prepared::reconstruct`]; [`Error::Cancelled`](super::Error::Cancelled).
    pub fn reconstruct_with(
        self,
        progress: &mut dyn FnMut(Progress) -> ControlFlow<()>,
    ) -> Result<Reconstruction> {
        self.reconstruct_showing(progress, &mut |_| {})
    }

    /// [`Prepared::reconstruct_with`] for a caller that shows the scene while it becomes sharper: `show` receives it
    /// after each step, first of the primaries at the input's size, then of the whole scene, and may end the steps
    /// ([`SceneSoFar::end`]).
    ///
    /// # Errors
    /// Those of [`Prepared::reconstruct_with`].
    pub fn reconstruct_showing(
        self,
        progress: &mut dyn FnMut(Progress) -> ControlFlow<()>,
        show: &mut dyn FnMut(&SceneSoFar<'_>),
    ) -> Result<Reconstruction> {
        let Self { model, options, mut inputs, adjustment, cut_shares, bounds, reports, .. } = self;
        let (mut warnings, mut tracker) = (self.warnings, self.tracker);
        if model.estimates_depth_range(&options) {
            tracker.begin(Stage::DepthRange, progress)?;
        }
        let initial_bounds = bounds.clone();
        let unit = unit::unit_of(bounds.near);
        unit::scale_cameras(&mut inputs, 1.0 / unit)?;
        let bounds = unit::scaled(bounds, 1.0 / unit);
        let depth_range = unit::scaled_range(options.depth_range, 1.0 / unit);
        let network = model.model();
        let estimate = |views: &Views| {
            tracker.run_steps(RANGE_STEPS, progress, |step| {
                network.estimate_depth_range_with(views, step)
            })
        };
        let (views, bounds) = model.views_with(&inputs, bounds, depth_range, estimate)?;
        tracker.begin(Stage::Backbone, progress)?;
        let steps = network.encode_steps(inputs.len());
        let features =
            tracker.run_steps(steps, progress, |step| network.encode_scene(&views, step))?;
        tracker.begin(Stage::Primaries, progress)?;
        let mut encoding = network.place(features)?;
        let config = model.config();
        let colour = Cropped::mean_colour(&inputs);
        let raster_at = |ratio: f32| config.raster_options(ratio, bounds.near, colour);
        let mut renderer = Renderer::new(model.backend());
        let density = options.density;
        let scene_options = options.parents_options(inputs.len());
        let count = encoding.per_view() * inputs.len();
        let most = density.limit(count, inputs.len(), config.upscale);
        let parents_options = options_of_parents(&scene_options, &inputs, most);
        let ended = Cell::new(false);
        let mut factors = Vec::new();
        let (mut parents, mut gains) = (None, Vec::new());
        if options.matches_depth() || parents_options.is_some() {
            let mut own = encoding.parents(network)?;
            if options.matches_depth() {
                tracker.begin(Stage::Matching, progress)?;
                let mut part = tracker.parts(progress);
                factors = match_parents(&mut own, &inputs, bounds.near_far(), &mut part)?;
            }
            hide_repeated(&mut own, &inputs, most, config.upscale);
            if let Some(options) = &parents_options {
                tracker.begin(Stage::Parents, progress)?;
                let mut part = tracker.parts(progress);
                let (raster, renderer) = (&raster_at(1.0), &mut renderer);
                let mut step = |phase: Option<&PhaseRun<'_>>| {
                    let Some(phase) = phase else { return part(0.0) };
                    let stage = Stage::Parents;
                    show(&SceneSoFar { stage, phase, unit, raster, ended: &ended });
                    part(phase.progress())
                };
                refine_parents(&mut own, &inputs, raster, options, renderer, &mut step)?;
            }
            encoding = encoding.with_parents(network, &own)?;
            gains = std::mem::take(&mut own.gain);
            parents = Some(own);
        }
        tracker.begin(Stage::Subsplat, progress)?;
        let (raster, of_counts) = (&raster_at(1.0), &mut renderer);
        let counts = counts_of(network, &encoding, parents, &inputs, density, raster, of_counts)?;
        let steps = encoding.steps(network.trunk());
        let mut children = tracker.run_steps(steps, progress, |step| {
            SceneChildren::new(network, &encoding, inputs.len(), counts, step)
        })?;
        drop((views, encoding));
        children.add_offsets(&gains, count);
        drop(gains);
        for (distances, factors) in children.distances.iter_mut().zip(&factors) {
            distances.iter_mut().zip(factors).for_each(|(distance, factor)| *distance *= factor);
        }
        let mut detail = Detail::Off;
        if options.detail == Detail::Photographs {
            tracker.begin(Stage::Detail, progress)?;
            if children.add_detail(&inputs, config.upscale)? {
                detail = Detail::Photographs;
            }
        }
        let parent_counts = children.counts().to_vec();
        let SceneChildren { mut splats, mut groups, distances, .. } = children;
        let mut raster_options = raster_at(inputs.first().map_or(1.0, Cropped::ratio));
        let (mut fit, mut refinement) = (None, None);
        let fit_options = &options.fit_options(inputs.len());
        let mut refine_options = options.refine_options(inputs.len());
        if let (Some(time), Some(used)) =
            (refine_options.time, parents_options.and_then(|options| options.refine.time))
        {
            refine_options.time = Some(time.saturating_sub(used));
        }
        if fit_options.steps > 0 {
            tracker.begin(Stage::Fit, progress)?;
            let mut part = tracker.parts(progress);
            let mut step = |step| part(step as f32 / fit_options.steps as f32);
            let raster = &raster_options;
            let how = fit_options;
            let done = fit_to_inputs(&mut splats, &inputs, raster, how, &mut renderer, &mut step)?;
            fit = Some(done);
        }
        if refine_options.steps > 0 && !ended.get() {
            tracker.begin(Stage::Refine, progress)?;
            let mut part = tracker.parts(progress);
            let mut step = |phase: &PhaseRun<'_>| {
                let (stage, raster) = (Stage::Refine, &raster_options);
                show(&SceneSoFar { stage, phase, unit, raster, ended: &ended });
                part(phase.progress())
            };
            let (raster, how) = (&raster_options, &refine_options);
            let (splats, groups) = (&mut splats, &mut groups);
            let done =
                refine_on_inputs(splats, groups, &inputs, raster, how, &mut renderer, &mut step)?;
            refinement = Some(done);
        }
        let mut surroundings = 0;
        if options.has_surroundings() {
            surroundings = add_surroundings(&mut splats, &inputs, &raster_at(1.0), &mut renderer);
        }
        warnings.extend(renderer.take_warning().map(|reason| Warning::CpuInsteadOfGpu { reason }));
        let depths = inputs.iter().zip(distances);
        let mut depths: Vec<Depth> =
            depths.map(|(c, d)| camera_depth(&c.input_camera, d)).collect();
        for (depth, c) in depths.iter_mut().zip(&inputs) {
            let kept = c.input_mask.iter().flat_map(Mask::kept);
            depth.data.iter_mut().zip(kept).filter(|(_, kept)| !**kept).for_each(|(z, _)| *z = 0.0);
        }
        if unit != 1.0 {
            unit::scale_splats(&mut splats, unit);
            depths.iter_mut().flat_map(|depth| &mut depth.data).for_each(|z| *z *= unit);
            raster_options.near *= unit;
        }
        unit::scale_cameras(&mut inputs, unit)?;
        let bounds = unit::scaled(bounds, unit);
        warnings.extend(Warning::of_bounds(&bounds));
        warnings.extend(model.backend_warning());
        Ok(Reconstruction {
            splats,
            surroundings,
            groups,
            counts: parent_counts,
            inputs,
            adjustment,
            cut_shares,
            depths,
            bounds,
            initial_bounds,
            raster_options,
            detail,
            fit,
            refinement,
            reports,
            warnings,
            stage_times: tracker.finish(progress)?,
        })
    }
}

/// A scene that a refinement has not ended yet.
pub struct SceneSoFar<'a> {
    stage: Stage,
    phase: &'a PhaseRun<'a>,
    /// Length of the optimisation's unit, world units.
    unit: f32,
    raster: &'a RasterOptions,
    ended: &'a Cell<bool>,
}

impl SceneSoFar<'_> {
    /// The Gaussians after the steps so far, without those beyond the edges of the photographs.
    pub fn splats(&self) -> Splats {
        let mut splats = self.phase.splats();
        if self.unit != 1.0 {
            unit::scale_splats(&mut splats, self.unit);
        }
        splats
    }

    /// [`Stage::Parents`] while the primaries are refined, which have the input's size; then [`Stage::Refine`].
    pub fn stage(&self) -> Stage {
        self.stage
    }

    /// Number of steps of this stage so far.
    pub fn steps(&self) -> usize {
        self.phase.steps()
    }

    /// Ends the refinement after some more steps ([`PhaseRun::end`]). The scene is made from what they give.
    pub fn end(&self) {
        self.phase.end();
        self.ended.set(true);
    }

    /// The rules to render them at the size of the stage.
    pub fn raster_options(&self) -> RasterOptions {
        RasterOptions { near: self.raster.near * self.unit, ..*self.raster }
    }
}

/// Converts distances along the unit ray to camera z.
fn camera_depth(camera: &Camera, distances: Vec<f32>) -> Depth {
    let k = camera.intrinsics();
    let mut data = distances;
    for (i, d) in data.iter_mut().enumerate() {
        let px = glam::Vec2::new((i % k.width) as f32 + 0.5, (i / k.width) as f32 + 0.5);
        *d /= k.unproject(px).length();
    }
    Depth { width: k.width, height: k.height, data }
}
