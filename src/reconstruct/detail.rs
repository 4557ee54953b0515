//! Colour detail from photographs that are larger than the network's input.

use super::{Error, Result};
use crate::reconstruct::inputs::crop::Cropped;
use crate::scene::splats::Splats;
use subsplat_kernels::cpu::detail::{
    Photograph, SourceView, mixed_residuals, residuals, with_residuals,
};

/// Returns whether a photograph has more than one pixel for each of the input's pixels.
fn has_detail(c: &Cropped) -> bool {
    let ratio = c.target.width as f32 / c.input.width.max(1) as f32;
    (c.window.scale * ratio).min_element() > 1.0
}

/// Adds to children's colours the detail of the photographs ([`subsplat_kernels::cpu::detail`]). Returns
/// whether any photograph has detail. `upscale` is r; each parent has r² children.
///
/// # Errors
/// A photograph without pixels.
pub fn add_detail(splats: &mut Splats, inputs: &[Cropped], upscale: usize) -> Result<bool> {
    let per_view = splats.parents() / inputs.len().max(1);
    let children = splats.children_per_parent();
    add(splats, inputs, |sources, means| residuals(sources, means, per_view, children, upscale))
}

/// [`add_detail`] for Gaussians with the given `parents`, which have `counts` children each
/// ([`mixed_residuals`]).
///
/// # Errors
/// A photograph without pixels.
pub(crate) fn add_mixed(
    splats: &mut Splats,
    inputs: &[Cropped],
    parents: &[u32],
    counts: &[u8],
) -> Result<bool> {
    let per_view = counts.len() / inputs.len().max(1);
    add(splats, inputs, |sources, means| mixed_residuals(sources, means, per_view, parents, counts))
}

/// Adds the residuals that `of` returns for the sources and the means `[N, 3]`.
fn add(
    splats: &mut Splats,
    inputs: &[Cropped],
    of: impl FnOnce(&[SourceView<'_>], &[f32]) -> Vec<f32>,
) -> Result<bool> {
    if !inputs.iter().any(has_detail) {
        return Ok(false);
    }
    let pixels: Vec<Vec<f32>> = inputs.iter().map(|c| c.target.to_unit()).collect();
    let mut sources = Vec::with_capacity(inputs.len());
    for (c, pixels) in inputs.iter().zip(&pixels) {
        let (w, h) = (c.target.width, c.target.height);
        let photograph = if has_detail(c) {
            Some(Photograph::new(pixels, w, h).ok_or_else(|| {
                Error::argument("photograph", format!("{w}x{h} pixels"), pixels.len().to_string())
            })?)
        } else {
            None
        };
        sources.push(SourceView { photograph, camera: c.input_camera });
    }
    let means: Vec<f32> = splats.means().flatten().collect();
    let delta = of(&sources, &means);
    splats.gain = with_residuals(&splats.gain, &delta);
    Ok(true)
}
