//! A reconstructed scene.

use super::{
    DepthBounds, Detail, Refine, Result, StageTime, Warning, add_surroundings, refine_on_inputs,
    restore_surroundings, take_surroundings,
};
use crate::cameras::check::PairReport;
use crate::cameras::estimation::PoseAdjustment;
use crate::files::{SaveOptions, SaveReport, save_splats};
use crate::finish::{FitReport, Groups, PhaseRun, RefineReport};
use crate::reconstruct::inputs::crop::Cropped;
use crate::scene::pictures::Depth;
use crate::scene::render::{Picture, Renderer, comment_of_camera, comment_of_options, render};
use crate::scene::splats::Splats;
use std::ops::ControlFlow;
use std::path::Path;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::RasterOptions;

/// A reconstructed scene: Gaussians, the rules to render them, and a record of how they were
/// made.
#[derive(Clone, Debug)]
pub struct Reconstruction {
    pub(super) splats: Splats,
    /// The last of them, which lie where no photograph shows the scene.
    pub(super) surroundings: usize,
    /// Gaussians of each photograph.
    pub(super) groups: Groups,
    /// K of each parent; empty where all have the same.
    pub(super) counts: Vec<u8>,
    pub(super) inputs: Vec<Cropped>,
    pub(super) adjustment: Option<PoseAdjustment>,
    pub(super) cut_shares: Vec<f32>,
    pub(super) depths: Vec<Depth>,
    pub(super) bounds: DepthBounds,
    pub(super) initial_bounds: DepthBounds,
    pub(super) raster_options: RasterOptions,
    pub(super) detail: Detail,
    pub(super) fit: Option<FitReport>,
    pub(super) refinement: Option<RefineReport>,
    pub(super) reports: Vec<PairReport>,
    pub(super) warnings: Vec<Warning>,
    pub(super) stage_times: Vec<StageTime>,
}

impl Reconstruction {
    /// Renders the scene from `camera` on the CPU, at target resolution or any other.
    pub fn render(&self, camera: &Camera) -> Picture {
        render(&self.splats, camera, &self.raster_options)
    }

    /// Writes the Gaussians to a .ply, .glb, .spz or .splat file. Comments in .ply and .glb state
    /// the rules to render them and a first camera.
    ///
    /// # Errors
    /// Those of [`save_splats`].
    pub fn save(&self, path: impl AsRef<Path>) -> Result<SaveReport> {
        let comments = self.comments();
        Ok(save_splats(path, &self.splats, &SaveOptions { comments, ..SaveOptions::default() })?)
    }

    /// The rules to render the Gaussians and the first photograph's camera, as lines for a scene
    /// file ([`SaveOptions::comments`](crate::SaveOptions)).
    pub fn comments(&self) -> Vec<String> {
        let camera = self.inputs.first().map(|c| comment_of_camera(&c.target_camera));
        std::iter::once(comment_of_options(&self.raster_options)).chain(camera).collect()
    }

    /// The Gaussians.
    pub fn splats(&self) -> &Splats {
        &self.splats
    }

    /// The Gaussians, to be edited in place.
    pub fn splats_mut(&mut self) -> &mut Splats {
        &mut self.splats
    }

    /// Refines the Gaussians on the photographs, as [`Options::refine`](super::Options::refine) does
    /// within a run, for a caller that shows the scene first. `progress` receives the refinement
    /// after each step; [`PhaseRun::splats`] returns the Gaussians so far.
    ///
    /// # Errors
    /// [`Error::Cancelled`](super::Error::Cancelled); the Gaussians are then unchanged.
    pub fn refine(
        &mut self,
        refine: Refine,
        renderer: &mut Renderer,
        progress: &mut dyn FnMut(&PhaseRun<'_>) -> ControlFlow<()>,
    ) -> Result<RefineReport> {
        let Self { splats, surroundings, groups, inputs, raster_options: raster, fit, .. } = self;
        let options = refine.options_for(inputs.len(), fit.is_some());
        let taken = take_surroundings(splats, *surroundings);
        let done = refine_on_inputs(splats, groups, inputs, raster, &options, renderer, progress);
        let report = match done {
            Ok(report) => report,
            Err(e) => {
                restore_surroundings(splats, taken);
                return Err(e);
            }
        };
        if *surroundings > 0 {
            // The rules for pictures of the inputs' size differ in the low-pass alone, which is below a pixel.
            *surroundings = add_surroundings(splats, inputs, raster, renderer);
        }
        self.refinement = Some(report);
        Ok(report)
    }

    /// Number of children (K) of each input pixel's Gaussian, photograph by photograph, rows from the
    /// top. Empty where all pixels have the same number
    /// ([`Options::density`](super::Options::density)).
    pub fn children_counts(&self) -> &[u8] {
        &self.counts
    }

    /// The Gaussians alone.
    pub fn into_splats(self) -> Splats {
        self.splats
    }

    /// The photographs at the sizes of the network's input and of the target.
    pub fn inputs(&self) -> &[Cropped] {
        &self.inputs
    }

    /// Change of the given cameras ([`Poses::Adjusted`](super::Poses::Adjusted)); `None` where they
    /// stayed. [`Reconstruction::inputs`] has the adjusted ones.
    pub fn pose_adjustment(&self) -> Option<&PoseAdjustment> {
        self.adjustment.as_ref()
    }

    /// Share of each photograph that its crop does not show, 0 to 1.
    pub fn cut_shares(&self) -> &[f32] {
        &self.cut_shares
    }

    /// Predicted depth of each input, camera z, world units; 0 at masked pixels.
    pub fn depths(&self) -> &[Depth] {
        &self.depths
    }

    /// The depth range of the network's candidates.
    pub fn depth_range(&self) -> &DepthBounds {
        &self.bounds
    }

    /// The depth range before the network estimated its own. As a prior
    /// ([`Options::depth_prior`](super::Options::depth_prior)) of another call on the same
    /// photographs it makes another check unnecessary.
    pub fn initial_depth_range(&self) -> &DepthBounds {
        &self.initial_bounds
    }

    /// The rules to render the Gaussians at target resolution.
    pub fn raster_options(&self) -> &RasterOptions {
        &self.raster_options
    }

    /// Source of detail that was used: [`Detail::Off`] also where no photograph is larger than
    /// the network's input.
    pub fn detail(&self) -> Detail {
        self.detail
    }

    /// Losses before and after the fit to the photographs; `None` without one.
    pub fn fit(&self) -> Option<&FitReport> {
        self.fit.as_ref()
    }

    /// Errors before and after the refinement; `None` without one.
    pub fn refinement(&self) -> Option<&RefineReport> {
        self.refinement.as_ref()
    }

    /// Reports of the check, one for each pair of consecutive photographs; empty without one.
    pub fn reports(&self) -> &[PairReport] {
        &self.reports
    }

    /// All warnings.
    pub fn warnings(&self) -> &[Warning] {
        &self.warnings
    }

    /// Duration of each stage, in order of execution.
    pub fn stage_times(&self) -> &[StageTime] {
        &self.stage_times
    }
}
