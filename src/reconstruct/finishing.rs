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
use std::ops::ControlFlow;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::clock::HAS_CLOCK;
use subsplat_kernels::layout::RasterOptions;

/// The largest picture of `c` that is no enlargement of the photograph, with its camera: the
/// target's size, else the input's.
fn sharp_picture(c: &Cropped) -> (&Camera, &Rgb) {
    if c.window.scale.min_element() < 1.0 {
        (&c.input_camera, &c.input)
    } else {
        (&c.target_camera, &c.target)
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
    fit(splats, &views_of(inputs), raster, options, renderer, progress).map_err(error)
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
    refine_groups(splats, groups, &views_of(inputs), raster, options, renderer, progress)
        .map_err(error)
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

fn views_of(inputs: &[Cropped]) -> Vec<TargetView<'_>> {
    let view = |c| {
        let (camera, image) = sharp_picture(c);
        TargetView { camera, image }
    };
    inputs.iter().map(view).collect()
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
