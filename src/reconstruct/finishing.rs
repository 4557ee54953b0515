//! Fit and refinement of a reconstructed scene on its photographs.

use super::{Error, Refine, Result};
use crate::finish::{
    FinishError, FitOptions, FitReport, Groups, PhaseRun, RefineOptions, RefineReport, TargetView,
    check_time, fit, refine_groups,
};
use crate::reconstruct::inputs::crop::Cropped;
use crate::scene::pictures::Rgb;
use crate::scene::render::Renderer;
use crate::scene::splats::Splats;
use std::borrow::Cow;
use std::ops::ControlFlow;
use subsplat_kernels::camera::{Camera, Size};
use subsplat_kernels::clock::HAS_CLOCK;
use subsplat_kernels::layout::RasterOptions;

/// A photograph at the size at which Gaussians are compared with it.
struct SharpPicture<'a> {
    camera: Camera,
    image: Cow<'a, Rgb>,
}

impl<'a> SharpPicture<'a> {
    /// The largest picture of `c` that is no enlargement of the photograph: of the target's size, of the
    /// photograph's own, or of the input's where the photograph is smaller.
    fn new(c: &'a Cropped) -> Self {
        let scale = c.window.scale.min_element();
        if !(scale < 1.0) {
            return Self { camera: c.target_camera, image: Cow::Borrowed(&c.target) };
        }
        let side = |side: usize| (side as f32 * scale).round() as usize;
        let size = Size::new(side(c.target.width), side(c.target.height));
        if size.width > c.input.width
            && size.height > c.input.height
            && let Ok((image, camera)) = c.resized(size)
        {
            return Self { camera, image: Cow::Owned(image) };
        }
        Self { camera: c.input_camera, image: Cow::Borrowed(&c.input) }
    }

    fn view(&self) -> TargetView<'_> {
        TargetView { camera: &self.camera, image: &self.image }
    }
}

/// Fits the Gaussians of `inputs` to their photographs. `progress` receives the number of steps
/// done.
///
/// # Errors
/// [`Error::Cancelled`]; a picture of another size than its camera.
pub fn fit_to_inputs(
    splats: &mut Splats,
    inputs: &[Cropped],
    raster: &RasterOptions,
    options: &FitOptions,
    renderer: &mut Renderer,
    progress: &mut dyn FnMut(usize) -> ControlFlow<()>,
) -> Result<FitReport> {
    let pictures = sharp_pictures(inputs);
    fit(splats, &views_of(&pictures), raster, options, renderer, progress).map_err(error)
}

/// Refines the Gaussians of `inputs`, those of each photograph in `groups`, on their photographs.
/// `progress` receives the refinement after each step.
///
/// # Errors
/// [`Error::Cancelled`]; a picture of another size than its camera.
pub fn refine_on_inputs(
    splats: &mut Splats,
    groups: &mut Groups,
    inputs: &[Cropped],
    raster: &RasterOptions,
    options: &RefineOptions,
    renderer: &mut Renderer,
    progress: &mut dyn FnMut(&PhaseRun<'_>) -> ControlFlow<()>,
) -> Result<RefineReport> {
    let pictures = sharp_pictures(inputs);
    let views = views_of(&pictures);
    refine_groups(splats, groups, &views, raster, options, renderer, progress).map_err(error)
}

/// Refuses a refinement that this platform cannot end.
///
/// # Errors
/// [`Refine::Seconds`] where there is no clock.
pub(crate) fn check_refine(refine: Refine) -> Result<()> {
    check_time(refine.time(), HAS_CLOCK).map_err(error)
}

/// The photographs of the input's size.
pub(super) fn input_views(inputs: &[Cropped]) -> Vec<TargetView<'_>> {
    inputs.iter().map(|c| TargetView { camera: &c.input_camera, image: &c.input }).collect()
}

fn sharp_pictures(inputs: &[Cropped]) -> Vec<SharpPicture<'_>> {
    inputs.iter().map(SharpPicture::new).collect()
}

fn views_of<'a>(pictures: &'a [SharpPicture<'_>]) -> Vec<TargetView<'a>> {
    pictures.iter().map(SharpPicture::view).collect()
}

/// The error of a run for one of the optimisation.
pub(super) fn error(e: FinishError) -> Error {
    match e {
        FinishError::Cancelled => Error::Cancelled,
        FinishError::NoClock => Error::argument(
            "refinement",
            "a number of steps, because WebAssembly without an operating system has no clock",
            "a time",
        ),
        FinishError::Size { view, expected, got } => {
            Error::argument(format!("photograph {view}"), expected, got)
        }
    }
}
