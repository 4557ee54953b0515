//! Fit and refinement of a reconstructed scene on its photographs.

use super::{Error, Refine, Result};
use crate::finish::{
    FinishError, FitOptions, FitReport, Groups, MaskedView, PhaseRun, RefineOptions, RefineReport,
    check_time, fit_masked, refine_groups,
};
use crate::reconstruct::inputs::crop::Cropped;
use crate::scene::mask::Mask;
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
    mask: Option<Cow<'a, Mask>>,
}

impl<'a> SharpPicture<'a> {
    /// The largest picture of `c` that is no enlargement of the photograph: of the target's size, of the
    /// photograph's own, or of the input's where the photograph is smaller.
    fn new(c: &'a Cropped) -> Self {
        let scale = c.window.scale.min_element();
        if !(scale < 1.0) {
            return Self {
                camera: c.target_camera,
                image: Cow::Borrowed(&c.target),
                mask: c.target_mask.as_ref().map(Cow::Borrowed),
            };
        }
        let side = |side: usize| (side as f32 * scale).round() as usize;
        let size = Size::new(side(c.target.width), side(c.target.height));
        if size.width > c.input.width
            && size.height > c.input.height
            && let Ok((image, camera)) = c.resized(size)
        {
            let mask = c.resized_mask(size).map(Cow::Owned);
            return Self { camera, image: Cow::Owned(image), mask };
        }
        Self {
            camera: c.input_camera,
            image: Cow::Borrowed(&c.input),
            mask: c.input_mask.as_ref().map(Cow::Borrowed),
        }
    }

    fn view(&self) -> MaskedView<'_> {
        MaskedView { camera: &self.camera, image: &self.image, mask: self.mask.as_deref() }
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
    fit_masked(splats, &views_of(&pictures), raster, options, renderer, progress).map_err(error)
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
pub(super) fn input_views(inputs: &[Cropped]) -> Vec<MaskedView<'_>> {
    let views = inputs.iter().map(|c| MaskedView {
        camera: &c.input_camera,
        image: &c.input,
        mask: c.input_mask.as_ref(),
    });
    views.collect()
}

/// Marks the parents, `per_view` of each photograph in the order of its pixels, whose pixels count; `None` where
/// all do.
pub(super) fn kept_parents(inputs: &[Cropped], per_view: usize) -> Option<Vec<bool>> {
    inputs.iter().any(|c| c.input_mask.is_some()).then(|| {
        let mut kept = Vec::with_capacity(inputs.len() * per_view);
        for c in inputs {
            let pixels = (c.input.width * c.input.height).max(1);
            // MVSplat may give a pixel several Gaussians.
            let per_pixel = (per_view / pixels).max(1);
            let mark = |i: usize| {
                let mask = c.input_mask.as_ref();
                mask.is_none_or(|mask| mask.kept().get(i / per_pixel) != Some(&false))
            };
            kept.extend((0..per_view).map(mark));
        }
        kept
    })
}

/// The Gaussians of each photograph where `kept` marks the parents, `per_view` of each photograph, that have
/// `children` Gaussians each.
pub(super) fn groups_of(kept: &[bool], per_view: usize, children: usize) -> Groups {
    let mut end = 0;
    let range = |view: &[bool]| {
        let begin = end;
        end += children * view.iter().filter(|kept| **kept).count();
        begin..end
    };
    let ranges = kept.chunks(per_view.max(1)).map(range).collect();
    Groups { ranges, equal_families: true }
}

fn sharp_pictures(inputs: &[Cropped]) -> Vec<SharpPicture<'_>> {
    inputs.iter().map(SharpPicture::new).collect()
}

fn views_of<'a>(pictures: &'a [SharpPicture<'_>]) -> Vec<MaskedView<'a>> {
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
